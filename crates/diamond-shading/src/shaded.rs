//! A shaded view: the radiance, the maps that it was made from, and the cotangents of both.
use crate::ShadingError;
use crate::error::check_image;
use crate::number::Number;
use crate::pixel_block::{Planes, gather};
use crate::surface_point::{Lit, PointGrad, SurfacePoint, Transport};
use crate::vector::Vector;
use diamond_image::Image;
use std::ops::Range;

/// What each pixel was shaded with, zero where it is empty. Divided by opacity (but see
/// [`ShadingConfig::normalise`](crate::ShadingConfig::normalise)).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ShadedMaps {
    /// Linear RGB.
    pub base_color: Image,
    /// In `[0, 1]`, one channel.
    pub roughness: Image,
    /// In `[0, 1]`, one channel.
    pub metalness: Image,
    /// In `[0, 1]`, one channel.
    pub subsurfaceness: Image,
    /// Unit normal in world axes.
    pub normal: Image,
    /// Linear RGB, without the light's intensity and the subsurfaceness.
    pub residual: Image,
    /// The incident channel, without the offset, one channel.
    pub incident: Image,
    /// In `[0, 1]`, one channel.
    pub visibility: Image,
    /// View-space z, scene units, one channel; always divided by opacity.
    pub depth: Image,
}

/// A shaded view.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Shaded {
    /// Linear RGB, composited by opacity over black: the sum of `surface` and `subsurface`.
    pub radiance: Image,
    /// What it was made from.
    pub maps: ShadedMaps,
    /// The surface's part of the radiance, weighted and composited.
    pub surface: Image,
    /// The subsurface part of the radiance, weighted and composited.
    pub subsurface: Image,
}

/// Cotangents of [`ShadedMaps`]; `None` is zero.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ShadedMapsGrad {
    /// Three channels.
    pub base_color: Option<Image>,
    /// One channel; without effect where the roughness is a constant of the configuration.
    pub roughness: Option<Image>,
    /// One channel.
    pub metalness: Option<Image>,
    /// One channel.
    pub subsurfaceness: Option<Image>,
    /// Three channels.
    pub normal: Option<Image>,
    /// Three channels.
    pub residual: Option<Image>,
    /// One channel.
    pub incident: Option<Image>,
    /// One channel.
    pub visibility: Option<Image>,
    /// One channel.
    pub depth: Option<Image>,
}

/// Cotangents of [`Shaded`]; `None` is zero. The two parts of the radiance are for inspection and have none.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ShadedGrad {
    /// Three channels.
    pub radiance: Option<Image>,
    /// Of the maps.
    pub maps: ShadedMapsGrad,
}

/// Values of a pixel's record.
pub(crate) const RECORD: usize = 24;

/// Where each result lies in a pixel's record.
mod place {
    use super::Range;
    pub const RADIANCE: Range<usize> = 0..3;
    pub const SURFACE: Range<usize> = 3..6;
    pub const SUBSURFACE: Range<usize> = 6..9;
    pub const BASE_COLOR: Range<usize> = 9..12;
    pub const ROUGHNESS: Range<usize> = 12..13;
    pub const METALNESS: Range<usize> = 13..14;
    pub const SUBSURFACENESS: Range<usize> = 14..15;
    pub const NORMAL: Range<usize> = 15..18;
    pub const RESIDUAL: Range<usize> = 18..21;
    pub const INCIDENT: Range<usize> = 21..22;
    pub const VISIBILITY: Range<usize> = 22..23;
    pub const DEPTH: Range<usize> = 23..24;
}

/// The records of one pixel or many, in the order of [`place`]; zero where `covered` is false.
#[inline(always)]
pub(crate) fn record<T: Number>(
    point: &SurfacePoint<T>,
    transport: &Transport<T>,
    lit: &Lit<T>,
    opacity: T,
    covered: T::Mask,
) -> [T; RECORD] {
    let (surface, subsurface) = (lit.surface * opacity, lit.subsurface * opacity);
    let (c, s, u) = (surface + subsurface, surface, subsurface);
    let (m, n, r) = (&point.material, point.normal, transport.residual);
    let b = m.base_color;
    let mut out = [
        c.x,
        c.y,
        c.z,
        s.x,
        s.y,
        s.z,
        u.x,
        u.y,
        u.z,
        b.x,
        b.y,
        b.z,
        m.roughness,
        m.metalness,
        point.subsurfaceness,
        n.x,
        n.y,
        n.z,
        r.x,
        r.y,
        r.z,
        transport.incident,
        transport.visibility,
        point.depth,
    ];
    for v in &mut out {
        *v = v.only_where(covered);
    }
    out
}

/// The images of a view's records.
pub(crate) fn unpack(records: &Image) -> Shaded {
    let part = |range| records.channels_range(range);
    Shaded {
        radiance: part(place::RADIANCE),
        surface: part(place::SURFACE),
        subsurface: part(place::SUBSURFACE),
        maps: ShadedMaps {
            base_color: part(place::BASE_COLOR),
            roughness: part(place::ROUGHNESS),
            metalness: part(place::METALNESS),
            subsurfaceness: part(place::SUBSURFACENESS),
            normal: part(place::NORMAL),
            residual: part(place::RESIDUAL),
            incident: part(place::INCIDENT),
            visibility: part(place::VISIBILITY),
            depth: part(place::DEPTH),
        },
    }
}

impl ShadedGrad {
    /// Every cotangent beside its name and its number of channels.
    fn parts(&self) -> [(&'static str, &Option<Image>, usize); 10] {
        let m = &self.maps;
        [
            ("ShadedGrad::radiance", &self.radiance, 3),
            ("ShadedMapsGrad::base_color", &m.base_color, 3),
            ("ShadedMapsGrad::roughness", &m.roughness, 1),
            ("ShadedMapsGrad::metalness", &m.metalness, 1),
            ("ShadedMapsGrad::subsurfaceness", &m.subsurfaceness, 1),
            ("ShadedMapsGrad::normal", &m.normal, 3),
            ("ShadedMapsGrad::residual", &m.residual, 3),
            ("ShadedMapsGrad::incident", &m.incident, 1),
            ("ShadedMapsGrad::visibility", &m.visibility, 1),
            ("ShadedMapsGrad::depth", &m.depth, 1),
        ]
    }

    pub(crate) fn check(&self, width: usize, height: usize) -> Result<(), ShadingError> {
        for (what, image, channels) in self.parts() {
            if let Some(image) = image {
                check_image(what, image, (width, height, channels))?;
            }
        }
        Ok(())
    }

    /// The cotangents of the pixels of row `y` from `x` on, plane by plane in the order of [`cotangents`].
    #[inline(always)]
    pub(crate) fn gather(&self, planes: &mut Planes<COTANGENTS>, x: usize, y: usize) {
        let mut first = 0;
        for (_, image, channels) in self.parts() {
            if let Some(image) = image {
                gather(&mut planes[first..first + channels], image, 0, x, y);
            }
            first += channels;
        }
    }
}

/// Cotangents of a pixel.
pub(crate) const COTANGENTS: usize = 18;

/// The cotangents of the radiance and the maps of one pixel or many.
#[inline(always)]
pub(crate) fn cotangents<T: Number>(d: [T; COTANGENTS]) -> (Vector<T>, PointGrad<T>) {
    let maps = PointGrad {
        base_color: Vector::new(d[3], d[4], d[5]),
        roughness: d[6],
        metalness: d[7],
        subsurfaceness: d[8],
        normal: Vector::new(d[9], d[10], d[11]),
        residual: Vector::new(d[12], d[13], d[14]),
        incident: d[15],
        visibility: d[16],
        depth: d[17],
    };
    (Vector::new(d[0], d[1], d[2]), maps)
}
