//! One view under many lights: what does not depend on the light is done once.
use crate::ShadingError;
use crate::deferred::ShadingConfig;
use crate::error::check_image;
use crate::gbuffer::{GBuffer, channel};
use crate::pixel_block::{Planes, gather};
use crate::pixels::{KEPT, LightRow, PrepareRow};
use crate::row_chunks::map_chunks_mut;
use crate::shaded::{RECORD, Shaded, unpack};
use crate::surface_point::{Eye, GEOMETRY, TRANSPORT};
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_simd::{BLOCK, Level};

/// The light-independent half of a view, ready for any number of lights.
///
/// Of the rasteriser it needs the [`channel::GEOMETRY`] channels once, and the [`channel::TRANSPORT`] channels for each
/// light. The result has the same bits as [`shade`](crate::shade)'s.
#[derive(Debug, Clone)]
pub struct Prepared {
    width: usize,
    height: usize,
    config: ShadingConfig,
    /// Blocks of each row, left to right.
    blocks: Vec<Planes<KEPT>>,
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
        let row = width.div_ceil(BLOCK);
        let mut blocks = vec![[[0.0; BLOCK]; KEPT]; row * height];
        let (level, eye) = (Level::current(), Eye::new(camera));
        map_chunks_mut(&mut blocks, row, |y, out| level.dispatch(PrepareRow { gbuffer, eye: &eye, config, y, out }));
        Ok(Self { width, height, config: *config, blocks })
    }

    /// The first `WIDTH` numbers of all records; `gather` fills the transport sums of the pixels from (x, y) on.
    fn light<const WIDTH: usize>(
        &self,
        light: &OlatLight,
        gather: impl Fn(&mut Planes<TRANSPORT>, usize, usize) + Sync,
    ) -> Image {
        let mut records = Image::new(self.width, self.height, WIDTH);
        let (level, row, config) = (Level::current(), self.width.div_ceil(BLOCK), &self.config);
        map_chunks_mut(records.data_mut(), self.width * WIDTH, |y, out| {
            let kept = &self.blocks[y * row..(y + 1) * row];
            let gather = |planes: &mut Planes<TRANSPORT>, x| gather(planes, x, y);
            level.dispatch(LightRow::<WIDTH, _> { kept, light, config, gather, out });
        });
        records
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
        Ok(unpack(&self.light::<RECORD>(light, |planes, x, y| {
            if let Some(image) = transport {
                gather(planes, image, 0, x, y);
            }
        })))
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
        let TransportChannels { residual, incident, visibility } = *channels;
        Ok(self.light::<3>(light, |planes, x, y| {
            for (range, first) in [(0..3, residual), (3..4, incident), (4..5, visibility)] {
                if let Some(first) = first {
                    gather(&mut planes[range], transport, first, x, y);
                }
            }
        }))
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
    pub(crate) fn end(&self) -> usize {
        let last = self.residual.map(|c| c + 2).max(self.incident).max(self.visibility);
        last.map_or(0, |c| c + 1)
    }
}
