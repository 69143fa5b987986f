//! Blocks of sixteen pixels of one view under many lights, from blended channels to radiance without images between.
//!
//! [`Prepared`](crate::Prepared) shades images. A rasteriser that hands out its pixels block by block can have each block
//! shaded while its channels are in the first cache: [`BlockShader::prepare`] does once per view what does not depend
//! on the light, and [`BlockShader::radiance`] the rest for all lights of a group.
use crate::ShadingError;
use crate::deferred::ShadingConfig;
use crate::gbuffer::{MIN_OPACITY, channel};
use crate::many_lights::LightChannels;
use crate::pixel_block::{Planes, load, store};
use crate::pixels::{KEPT, light_pixels, prepare_pixels};
use crate::prepared::TransportChannels;
use crate::shaded::{RECORD, Shaded, unpack};
use crate::surface_point::{Eye, GEOMETRY, POINT, TRANSPORT};
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_simd::{BLOCK, Level, Simd, WithSimd};

/// Sixteen pixels of a view, blended.
#[derive(Debug, Clone, Copy)]
pub struct BlendedBlock {
    /// Columns and rows of the pixels' centres, px.
    pub centres: [[f32; BLOCK]; 2],
    /// Σ w·f of the [`channel::GEOMETRY`] channels.
    pub sums: [[f32; BLOCK]; GEOMETRY],
    /// Σ w in `[0, 1]`.
    pub opacity: [f32; BLOCK],
    /// Σ w·z of view-space z, scene units.
    pub depth: [f32; BLOCK],
}

impl BlendedBlock {
    /// Whether all pixels are: they have no radiance under any light.
    pub fn is_empty(&self) -> bool {
        !self.opacity.iter().any(|o| *o >= MIN_OPACITY)
    }
}

/// The light-independent half of sixteen pixels.
#[derive(Debug, Clone)]
pub struct PreparedBlock {
    kept: Planes<KEPT>,
}

/// Shades blocks of sixteen pixels, wherever they lie in the view.
#[derive(Debug, Clone, Copy)]
pub struct BlockShader {
    eye: Eye,
    config: ShadingConfig,
    level: Level,
}

impl BlockShader {
    /// For the pixels of `camera`, on the instruction set of the process.
    ///
    /// # Errors
    /// [`ShadingError::Setting`] where the configuration holds a number out of range.
    pub fn new(camera: &Camera, config: &ShadingConfig) -> Result<Self, ShadingError> {
        config.check()?;
        Ok(Self { eye: Eye::new(camera), config: *config, level: Level::current() })
    }

    /// The light-independent half.
    /// `[eq:gbuffer-normalise]`
    pub fn prepare(&self, block: &BlendedBlock) -> PreparedBlock {
        PreparedBlock { kept: self.level.dispatch(PrepareBlock { shader: self, block }) }
    }

    /// Radiance of the block's pixels under each light, linear RGB, with the bits of [`shade`](crate::shade()). `sums` holds
    /// Σ w·f of the lights' channels, `channels.per_light` of each; what has no place among them is 0.
    ///
    /// # Errors
    /// [`ShadingError::Shape`] where there are fewer channels or results than the lights need.
    /// `[eq:deferred-composite]`
    pub fn radiance(
        &self,
        block: &PreparedBlock,
        lights: &[OlatLight],
        channels: &LightChannels,
        sums: &[[f32; BLOCK]],
        out: &mut [[[f32; BLOCK]; 3]],
    ) -> Result<(), ShadingError> {
        check(lights, channels, sums, out.len())?;
        self.level.dispatch(LightBlock { shader: self, block, lights, channels, sums, out });
        Ok(())
    }

    /// As [`BlockShader::radiance`], and everything it was made from: [`ShadedRecords::WIDTH`] values.
    ///
    /// # Errors
    /// As [`BlockShader::radiance`].
    /// `[eq:deferred-composite]`
    pub fn records(
        &self,
        block: &PreparedBlock,
        lights: &[OlatLight],
        channels: &LightChannels,
        sums: &[[f32; BLOCK]],
        out: &mut [[[f32; BLOCK]; ShadedRecords::WIDTH]],
    ) -> Result<(), ShadingError> {
        check(lights, channels, sums, out.len())?;
        self.level.dispatch(LightBlock { shader: self, block, lights, channels, sums, out });
        Ok(())
    }
}

fn check(
    lights: &[OlatLight],
    channels: &LightChannels,
    sums: &[[f32; BLOCK]],
    results: usize,
) -> Result<(), ShadingError> {
    let wrong = |what, expected: usize, found: usize| {
        Err(ShadingError::Shape { what, expected: expected.to_string(), found: found.to_string() })
    };
    let needed = lights.len() * channels.per_light;
    if channels.places.end() > channels.per_light {
        return wrong("LightChannels::per_light (past the last place)", channels.places.end(), channels.per_light);
    }
    if sums.len() != needed {
        return wrong("BlockShader: sums (lights × channels of one)", needed, sums.len());
    }
    if results != lights.len() {
        return wrong("BlockShader: results (lights)", lights.len(), results);
    }
    Ok(())
}

/// What [`BlockShader::records`] gives, as the images of a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ShadedRecords;

impl ShadedRecords {
    /// Values of a pixel.
    pub const WIDTH: usize = RECORD;

    /// The images of a view whose pixels hold records.
    ///
    /// # Errors
    /// [`ShadingError::Shape`] where the image has another number of channels than [`ShadedRecords::WIDTH`].
    pub fn unpack(records: &Image) -> Result<Shaded, ShadingError> {
        crate::error::check_image("records", records, (records.width(), records.height(), RECORD))?;
        Ok(unpack(records))
    }
}

struct PrepareBlock<'a> {
    shader: &'a BlockShader,
    block: &'a BlendedBlock,
}

impl WithSimd for PrepareBlock<'_> {
    type Output = Planes<KEPT>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> Planes<KEPT> {
        let Self { shader, block } = self;
        let mut planes = [[0.0; BLOCK]; GEOMETRY + 2];
        planes[..GEOMETRY].copy_from_slice(&block.sums);
        (planes[GEOMETRY], planes[GEOMETRY + 1]) = (block.opacity, block.depth);
        let mut kept = [[0.0; BLOCK]; KEPT];
        for at in (0..BLOCK).step_by(S::F32_LANES) {
            let [x, y] = load(s, &block.centres, at);
            store(prepare_pixels(&shader.eye, &shader.config, load(s, &planes, at), (x, y)), &mut kept, at);
        }
        kept
    }
}

struct LightBlock<'a, const WIDTH: usize> {
    shader: &'a BlockShader,
    block: &'a PreparedBlock,
    lights: &'a [OlatLight],
    channels: &'a LightChannels,
    sums: &'a [[f32; BLOCK]],
    out: &'a mut [[[f32; BLOCK]; WIDTH]],
}

impl<const WIDTH: usize> WithSimd for LightBlock<'_, WIDTH> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let Self { shader, block, lights, channels, sums, out } = self;
        let TransportChannels { residual, incident, visibility } = channels.places;
        let mut planes = [[0.0; BLOCK]; TRANSPORT];
        for (k, (light, out)) in lights.iter().zip(out).enumerate() {
            let sums = &sums[k * channels.per_light..][..channels.per_light];
            if let Some(first) = residual {
                planes[..3].copy_from_slice(&sums[first..first + 3]);
            }
            if let Some(place) = incident {
                planes[3] = sums[place];
            }
            if let Some(place) = visibility {
                planes[4] = sums[place];
            }
            for at in (0..BLOCK).step_by(S::F32_LANES) {
                let record = light_pixels(light, &shader.config, load(s, &block.kept, at), load(s, &planes, at));
                let mut part = [record[0]; WIDTH];
                part.copy_from_slice(&record[..WIDTH]);
                store::<S, WIDTH>(part, out, at);
            }
        }
    }
}

const _: () = assert!(POINT + 2 == KEPT && channel::TRANSPORT.end - channel::TRANSPORT.start == TRANSPORT);
