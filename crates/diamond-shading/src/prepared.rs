//! One view under many lights: what does not depend on the light is done once.
use crate::ShadingError;
use crate::deferred::{ShadingConfig, centre, features};
use crate::error::check_image;
use crate::gbuffer::{Blended, GBuffer, channel};
use crate::row_chunks::map_chunks_mut;
use crate::shaded::{RECORD, Shaded, record, unpack};
use crate::surface_point::{GEOMETRY, SurfacePoint, TRANSPORT, Transport};
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::OlatLight;
use glam::Vec3;

/// The light-independent half of a view, ready for any number of lights.
///
/// Of the rasteriser it needs the [`channel::GEOMETRY`] channels once, and the [`channel::TRANSPORT`] channels for each
/// light. The result has the same bits as [`shade`](crate::shade)'s.
#[derive(Debug, Clone)]
pub struct Prepared {
    width: usize,
    height: usize,
    config: ShadingConfig,
    /// Point, opacity, and the factor of the blended features; `None` where the pixel is empty.
    points: Vec<Option<(SurfacePoint, f32, f32)>>,
}

impl Prepared {
    /// `gbuffer.features` holds all [`channel::COUNT`] channels, or the first nine only ([`channel::GEOMETRY`]).
    ///
    /// # Errors
    /// As [`shade`](crate::shade).
    pub fn new(gbuffer: &GBuffer<'_>, camera: &Camera, config: &ShadingConfig) -> Result<Self, ShadingError> {
        let channels = if gbuffer.features.channels() == GEOMETRY { GEOMETRY } else { channel::COUNT };
        let (width, height) = gbuffer.check(camera, channels)?;
        config.check()?;
        let mut points = vec![None; width * height];
        map_chunks_mut(&mut points, width, |y, row| {
            for (x, out) in row.iter_mut().enumerate() {
                let sums: [f32; GEOMETRY] = features(gbuffer.features.pixel(x, y), 0);
                let (opacity, depth) = (gbuffer.opacity.pixel(x, y)[0], gbuffer.depth.pixel(x, y)[0]);
                *out = Blended::new(&sums, opacity, depth, config.normalise).map(|blended| {
                    let point = SurfacePoint::new(&blended.features, blended.depth, centre(x, y), camera, config);
                    (point, blended.opacity, blended.weight)
                });
            }
        });
        Ok(Self { width, height, config: *config, points })
    }

    /// Shades under one light; `transport` holds Σ w·f of the five light-dependent channels (residual, incident,
    /// visibility), `None` is zero.
    ///
    /// # Errors
    /// [`ShadingError::Shape`] where `transport` has another size than the view, or not five channels.
    pub fn shade(&self, light: &OlatLight, transport: Option<&Image>) -> Result<Shaded, ShadingError> {
        if let Some(image) = transport {
            check_image("Prepared::shade: transport", image, (self.width, self.height, TRANSPORT))?;
        }
        let mut records = Image::new(self.width, self.height, RECORD);
        map_chunks_mut(records.data_mut(), self.width * RECORD, |y, row| {
            for (x, out) in row.as_chunks_mut::<RECORD>().0.iter_mut().enumerate() {
                let Some((point, opacity, weight)) = &self.points[y * self.width + x] else { continue };
                let sums = transport.map_or([0.0; TRANSPORT], |image| features(image.pixel(x, y), 0));
                let transport = Transport::new(&sums.map(|f| f * weight));
                let lit = point.light(&transport, light, &self.config);
                *out = record(point, &transport, &lit, *opacity);
            }
        });
        Ok(unpack(&records))
    }

    /// The radiance alone under one light, with the bits of [`Prepared::shade`]. `transport` may hold the channels of
    /// many lights; `channels` says where this light's are, and what is absent is 0.
    ///
    /// # Errors
    /// [`ShadingError::Shape`] where `transport` has another size than the view or too few channels.
    pub fn radiance(
        &self,
        light: &OlatLight,
        transport: &Image,
        channels: &TransportChannels,
    ) -> Result<Image, ShadingError> {
        let least = channels.end();
        let enough = transport.channels().max(least);
        check_image("Prepared::radiance: transport", transport, (self.width, self.height, enough))?;
        let mut radiance = Image::new(self.width, self.height, 3);
        map_chunks_mut(radiance.data_mut(), self.width * 3, |y, row| {
            for (x, out) in row.as_chunks_mut::<3>().0.iter_mut().enumerate() {
                let Some((point, opacity, weight)) = &self.points[y * self.width + x] else { continue };
                let pixel = transport.pixel(x, y);
                let scalar = |c: Option<usize>| c.map_or(0.0, |c| pixel[c] * weight);
                let residual = channels.residual.map_or(Vec3::ZERO, |c| Vec3::from_slice(&pixel[c..]) * *weight);
                let transport = Transport {
                    residual,
                    incident: scalar(channels.incident),
                    visibility: scalar(channels.visibility),
                };
                let lit = point.light(&transport, light, &self.config);
                *out = (lit.surface * *opacity + lit.subsurface * *opacity).to_array();
            }
        });
        Ok(radiance)
    }
}

/// Where one light's channels lie among those of many; `None` where they were not rasterised.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TransportChannels {
    /// First of three.
    pub residual: Option<usize>,
    /// Learned incident light.
    pub incident: Option<usize>,
    /// Visibility.
    pub visibility: Option<usize>,
}

impl TransportChannels {
    /// One past the last channel.
    fn end(&self) -> usize {
        let last = self.residual.map(|c| c + 2).max(self.incident).max(self.visibility);
        last.map_or(0, |c| c + 1)
    }
}
