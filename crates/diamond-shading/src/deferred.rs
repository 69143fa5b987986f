//! Deferred shading: the radiance image of one view under one light, from blended feature channels, and back.
//!
//! Every pixel's features are divided by its opacity, its depth becomes a world position, the light's direction and
//! irradiance at that position meet the normal and the material in the BRDF, the subsurface residual is blended in, and the
//! result is multiplied by the opacity, over black. [`shade`] returns the image, the maps that it was made from, and a
//! pullback to the blended channels. [`Prepared`](crate::Prepared) shades many lights of one view with the light-independent half done once.
//!
//! Radiance is linear RGB, and linear in the light's intensity but for the residual, which is so with
//! [`ShadingConfig::scale_residual_by_light`].
use crate::ShadingError;
use crate::brdf::BrdfModel;
use crate::gbuffer::{Blended, GBuffer, GBufferGrad, channel};
use crate::row_chunks::map_chunks_mut;
use crate::shaded::{RECORD, Shaded, ShadedGrad, record, unpack};
use crate::surface_point::{SurfacePoint, Transport};
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::{Falloff, OlatLight};
use glam::Vec2;

/// Where the light's irradiance at a point comes from.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum IncidentModel {
    /// (incident channel + offset)·intensity: falloff and shadows are learned.
    #[default]
    Learned,
    /// The light's own irradiance; the incident channel is not used.
    Physical(Falloff),
}

/// How surface and subsurface are put together by subsurfaceness s.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Combine {
    /// (1 − s)·surface + s·residual.
    #[default]
    Lerp,
    /// surface + s·residual.
    Additive,
}

/// What the visibility channel does to the surface part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SurfaceVisibility {
    /// Nothing.
    #[default]
    Ignored,
    /// It multiplies it.
    Multiplied,
}

/// The choices of deferred shading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShadingConfig {
    /// Surface BRDF.
    pub brdf: BrdfModel,
    /// Irradiance.
    pub incident: IncidentModel,
    /// Surface and subsurface.
    pub combine: Combine,
    /// Divide features by opacity. Without, materials fade at silhouettes (SSS-3DGS). The depth is always divided.
    pub normalise: bool,
    /// Shadows of the surface part.
    pub visibility: SurfaceVisibility,
    /// Least n·l, in `[0, 1]`: 0 is black below the horizon, SSS-3DGS has 0.001.
    pub horizon_leak: f32,
    /// A constant in place of the roughness channel, which then has no gradient; also what the roughness map shows.
    pub roughness: Option<f32>,
    /// Without, the subsurface part is left out, and the surface is taken whole, as if s were 0.
    pub use_residual: bool,
    /// Added to the learned incident light (a warm-up).
    pub incident_offset: f32,
    /// Multiply the residual by the light's intensity, which makes the image linear in it.
    pub scale_residual_by_light: bool,
}

impl Default for ShadingConfig {
    fn default() -> Self {
        Self {
            brdf: BrdfModel::default(),
            incident: IncidentModel::default(),
            combine: Combine::default(),
            normalise: true,
            visibility: SurfaceVisibility::default(),
            horizon_leak: 0.0,
            roughness: None,
            use_residual: true,
            incident_offset: 0.0,
            scale_residual_by_light: false,
        }
    }
}

/// Pullback of [`shade`]; borrows what it read.
#[derive(Debug, Clone, Copy)]
pub struct ShadePullback<'a> {
    gbuffer: GBuffer<'a>,
    camera: Camera,
    light: OlatLight,
    config: ShadingConfig,
}

/// The centre of a pixel.
pub(crate) fn centre(x: usize, y: usize) -> Vec2 {
    Vec2::new(x as f32 + 0.5, y as f32 + 0.5)
}

/// The `N` values of `pixel` from channel `from` on.
pub(crate) fn features<const N: usize>(pixel: &[f32], from: usize) -> [f32; N] {
    std::array::from_fn(|i| pixel[from + i])
}

impl ShadingConfig {
    /// Refuses numbers that are not finite or out of range.
    pub(crate) fn check(&self) -> Result<(), ShadingError> {
        let fail = |what, expected: &str, found: f32| {
            Err(ShadingError::Setting { what, expected: expected.into(), found: found.to_string() })
        };
        if !(0.0..=1.0).contains(&self.horizon_leak) {
            return fail("ShadingConfig::horizon_leak", "a number in [0, 1]", self.horizon_leak);
        }
        if !self.incident_offset.is_finite() {
            return fail("ShadingConfig::incident_offset", "a finite number", self.incident_offset);
        }
        match self.roughness {
            Some(roughness) if !(0.0..=1.0).contains(&roughness) => {
                fail("ShadingConfig::roughness", "a number in [0, 1]", roughness)
            }
            _ => Ok(()),
        }
    }
}

/// Shades one view under one light.
///
/// All images of `gbuffer` have the camera's size. The pullback borrows the G-buffer. Empty pixels (opacity below
/// [`MIN_OPACITY`](crate::gbuffer::MIN_OPACITY)) are zero everywhere and have no gradient.
/// `[eq:deferred-composite]`
///
/// # Errors
/// [`ShadingError::Shape`] where an image has another size than the camera or the wrong number of channels;
/// [`ShadingError::Setting`] where the configuration holds a number out of range.
pub fn shade<'a>(
    gbuffer: &GBuffer<'a>,
    camera: &Camera,
    light: &OlatLight,
    config: &ShadingConfig,
) -> Result<(Shaded, ShadePullback<'a>), ShadingError> {
    let (width, height) = gbuffer.check(camera, channel::COUNT)?;
    config.check()?;
    let pullback = ShadePullback { gbuffer: *gbuffer, camera: *camera, light: *light, config: *config };
    let mut records = Image::new(width, height, RECORD);
    map_chunks_mut(records.data_mut(), width * RECORD, |y, row| {
        for (x, out) in row.as_chunks_mut::<RECORD>().0.iter_mut().enumerate() {
            if let Some((blended, point, transport)) = pullback.point(x, y) {
                let lit = point.light(&transport, light, config);
                *out = record(&point, &transport, &lit, blended.opacity);
            }
        }
    });
    Ok((unpack(&records), pullback))
}

impl ShadePullback<'_> {
    /// What pixel `(x, y)` is shaded with; `None` where it is empty.
    fn point(&self, x: usize, y: usize) -> Option<(Blended<{ channel::COUNT }>, SurfacePoint, Transport)> {
        let g = &self.gbuffer;
        let sums = features(g.features.pixel(x, y), 0);
        let blended = Blended::new(&sums, g.opacity.pixel(x, y)[0], g.depth.pixel(x, y)[0], self.config.normalise)?;
        let geometry = features(&blended.features, channel::GEOMETRY.start);
        let point = SurfacePoint::new(&geometry, blended.depth, centre(x, y), &self.camera, &self.config);
        let transport = Transport::new(&features(&blended.features, channel::TRANSPORT.start));
        Some((blended, point, transport))
    }

    /// Cotangents of the blended channels, opacity and depth for those of the shaded view.
    /// `[eq:deferred-composite]`
    ///
    /// # Errors
    /// [`ShadingError::Shape`] where a cotangent does not have the shape of what it belongs to.
    pub fn pull(&self, d: &ShadedGrad) -> Result<GBufferGrad, ShadingError> {
        let (width, height, _) = self.gbuffer.opacity.shape();
        d.check(width, height)?;
        const COUNT: usize = channel::COUNT + 2;
        let mut grads = Image::new(width, height, COUNT);
        map_chunks_mut(grads.data_mut(), width * COUNT, |y, row| {
            for (x, out) in row.as_chunks_mut::<COUNT>().0.iter_mut().enumerate() {
                let Some((blended, point, transport)) = self.point(x, y) else { continue };
                let (d_radiance, maps) = d.at(x, y);
                let lit = point.light(&transport, &self.light, &self.config);
                let d_opacity = d_radiance.dot(lit.surface + lit.subsurface);
                let (geometry, transported, d_depth) = point.light_pull(
                    &transport,
                    &self.light,
                    &self.camera,
                    &self.config,
                    d_radiance * blended.opacity,
                    maps,
                );
                let mut d_features = [0.0; channel::COUNT];
                d_features[channel::GEOMETRY].copy_from_slice(&geometry);
                d_features[channel::TRANSPORT].copy_from_slice(&transported);
                let (d_sums, d_opacity, d_depth) = blended.pull(&d_features, d_opacity, d_depth, self.config.normalise);
                out[..channel::COUNT].copy_from_slice(&d_sums);
                out[channel::COUNT] = d_opacity;
                out[channel::COUNT + 1] = d_depth;
            }
        });
        Ok(GBufferGrad {
            features: grads.channels_range(0..channel::COUNT),
            opacity: grads.channels_range(channel::COUNT..channel::COUNT + 1),
            depth: grads.channels_range(channel::COUNT + 1..COUNT),
        })
    }
}
