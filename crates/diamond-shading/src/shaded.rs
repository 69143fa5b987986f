//! A shaded view: the radiance, the maps that it was made from, and the cotangents of both.
use crate::ShadingError;
use crate::error::check_image;
use crate::surface_point::{Lit, PointGrad, SurfacePoint, Transport};
use diamond_image::Image;
use glam::Vec3;
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

/// One pixel's record.
pub(crate) fn record(point: &SurfacePoint, transport: &Transport, lit: &Lit, opacity: f32) -> [f32; RECORD] {
    let mut out = [0.0; RECORD];
    let mut put = |range: Range<usize>, v: Vec3| out[range].copy_from_slice(&v.to_array());
    let (surface, subsurface) = (lit.surface * opacity, lit.subsurface * opacity);
    put(place::RADIANCE, surface + subsurface);
    put(place::SURFACE, surface);
    put(place::SUBSURFACE, subsurface);
    put(place::BASE_COLOR, point.material.base_color);
    put(place::NORMAL, point.normal);
    put(place::RESIDUAL, transport.residual);
    for (range, v) in [
        (place::ROUGHNESS, point.material.roughness),
        (place::METALNESS, point.material.metalness),
        (place::SUBSURFACENESS, point.subsurfaceness),
        (place::INCIDENT, transport.incident),
        (place::VISIBILITY, transport.visibility),
        (place::DEPTH, point.depth),
    ] {
        out[range.start] = v;
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

    /// The cotangents of one pixel.
    pub(crate) fn at(&self, x: usize, y: usize) -> (Vec3, PointGrad) {
        let scalar = |image: &Option<Image>| image.as_ref().map_or(0.0, |i| i.pixel(x, y)[0]);
        let vector = |image: &Option<Image>| image.as_ref().map_or(Vec3::ZERO, |i| Vec3::from_slice(i.pixel(x, y)));
        let m = &self.maps;
        let maps = PointGrad {
            base_color: vector(&m.base_color),
            roughness: scalar(&m.roughness),
            metalness: scalar(&m.metalness),
            subsurfaceness: scalar(&m.subsurfaceness),
            normal: vector(&m.normal),
            residual: vector(&m.residual),
            incident: scalar(&m.incident),
            visibility: scalar(&m.visibility),
            depth: scalar(&m.depth),
        };
        (vector(&self.radiance), maps)
    }
}
