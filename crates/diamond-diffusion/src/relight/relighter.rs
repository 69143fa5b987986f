//! The network of the relighter, what it is trained for, and its use.
use super::base::{Base, RelightTarget};
use super::examples::{RelightBatch, view_light_code};
use super::hints::{HINTS, RelightView, hint_planes};
use super::ratio::decode_ratio;
use crate::error::{DiffusionError, Result};
use crate::first_stage::{FirstStage, SpaceToDepth};
use crate::nn::{Scope, resize_bilinear};
use crate::noise::Noise;
use crate::parameterization::Parameterization;
use crate::sampler::{Sampler, Spacing, shared_noise};
use crate::schedule::Schedule;
use crate::train::{ImageTerms, Objective};
use crate::unet::{Conditions, ControlConfig, ControlNet, LIGHT_CHANNELS, UNet, UNetConfig};
use candle_core::{Device, Tensor};
use diamond_image::Image;

/// Pixels of a side that become one place with more channels.
const BLOCK: usize = 2;

/// Sizes of a relighter.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RelighterConfig {
    /// UNet and ControlNet; 12 channels in and out, [`HINTS`] hints, one halving in the hint network.
    pub networks: ControlConfig,
    /// Pixels of a side that it works at.
    pub size: usize,
}

impl RelighterConfig {
    /// The small one, at 64 × 64 pixels.
    pub fn tiny() -> Self {
        Self { networks: ControlConfig::tiny_relighter(HINTS), size: 64 }
    }

    /// That of `assets/models`, which trains in an hour on one core: 48 × 48 pixels, a few hundred thousand weights.
    pub fn shipped() -> Self {
        let unet = UNetConfig {
            channels: vec![32, 48, 64],
            attention: vec![false, false, true],
            heads: vec![2, 3, 4],
            context: Some(32),
            ..UNetConfig::tiny_relighter()
        };
        Self { networks: ControlConfig { unet, hints: HINTS, hint_channels: vec![16, 32] }, size: 48 }
    }

    /// Whether the numbers fit together.
    pub fn validate(&self) -> Result<()> {
        let (unet, multiple) = (&self.networks.unet, BLOCK * self.networks.unet.multiple());
        unet.validate()?;
        let channels = 3 * BLOCK * BLOCK;
        if (unet.in_channels, unet.out_channels) != (channels, channels) {
            let found = format!("{} and {}", unet.in_channels, unet.out_channels);
            return Err(DiffusionError::setting("channels in and out", format!("{channels}"), found));
        }
        if self.networks.hints != HINTS || self.networks.hint_channels.len() != 2 || unet.light.is_none() {
            let expected = format!("{HINTS} hints, two hint channels, a light code");
            return Err(DiffusionError::setting("networks", expected, "others"));
        }
        if self.size == 0 || !self.size.is_multiple_of(multiple) {
            return Err(DiffusionError::setting("size", format!("a multiple of {multiple}"), self.size));
        }
        Ok(())
    }
}

/// How pictures are made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RelightOptions {
    /// Steps of the sampler.
    pub steps: usize,
    /// Runs from different noise that are averaged.
    pub runs: usize,
    /// Seed of the noise. All lights and views share it.
    pub seed: u64,
}

impl Default for RelightOptions {
    fn default() -> Self {
        Self { steps: 4, runs: 2, seed: 0 }
    }
}

/// A relit picture.
#[derive(Debug, Clone)]
pub struct Relit {
    /// Linear radiance under a light of intensity 1, at the size of the view.
    pub image: Image,
    /// How far the runs differ: standard deviation of the radiance over runs and channels, 1 channel. Zero for one run.
    pub deviation: Image,
}

/// A UNet and a ControlNet that turn a picture's light.
#[derive(Debug)]
pub struct Relighter {
    config: RelighterConfig,
    unet: UNet,
    control: ControlNet,
    objective: Objective,
    /// On held-out objects, from the shape alone and with a fitted medium; see [`Relighter::expected_error`].
    pub(super) errors: [Option<f32>; 2],
    /// See [`Relighter::digest`].
    pub(super) digest: u64,
}

impl Relighter {
    /// With weights `unet.*` and `control.*` from `scope`'s source.
    pub fn new(scope: &Scope<'_>, config: &RelighterConfig) -> Result<Self> {
        config.validate()?;
        let objective = Objective {
            schedule: Schedule::stable_diffusion().with_zero_terminal_snr(),
            parameterization: Parameterization::V,
            min_snr: Some(5.0),
            // Of ratios, which are no pictures: structure is not asked for.
            image: ImageTerms { ssim: 0.0, ..ImageTerms::default() },
            // Sampling begins there, and with few steps most is decided there.
            noise_only: 0.3,
        };
        Ok(Self {
            unet: UNet::new(&scope.at("unet"), &config.networks.unet)?,
            control: ControlNet::new(&scope.at("control"), &config.networks)?,
            config: config.clone(),
            objective,
            errors: [None; 2],
            digest: 0,
        })
    }

    /// The sizes that it was built with.
    pub fn config(&self) -> &RelighterConfig {
        &self.config
    }

    fn predict(&self, noisy: &Tensor, told: &[f32], hints: &Tensor, lights: &Tensor) -> Result<Tensor> {
        let conditions = Conditions { light: Some(lights), ..Conditions::default() };
        let control = self.control.forward(noisy, told, hints, &conditions)?;
        self.unet.forward(noisy, told, &conditions, Some(&control))
    }

    /// The objective of a batch at a step; noise and timesteps come from (seed, step).
    pub fn loss(&self, batch: &RelightBatch, seed: u64, step: u64) -> Result<Tensor> {
        let clean = SpaceToDepth(BLOCK).encode(&batch.ratios)?;
        let noise = Noise::new(seed, "relighter", step).normal_tensor(clean.shape(), clean.device())?;
        let timesteps = self.objective.timesteps(seed, step, clean.dim(0)?, 1);
        self.objective.value(&clean, &noise, &timesteps, &SpaceToDepth(BLOCK), None, |noisy, told| {
            self.predict(noisy, told, &batch.hints, &batch.lights)
        })
    }

    /// The view under other lights, one picture each. A view of any size goes in and comes out: the network works at its own
    /// size, and its ratios are enlarged and applied to what is predicted at the view's.
    pub fn relight(
        &self,
        view: &RelightView,
        targets: &[RelightTarget],
        options: &RelightOptions,
    ) -> Result<Vec<Relit>> {
        view.validate()?;
        if options.runs == 0 || targets.is_empty() {
            return Err(DiffusionError::setting("runs and lights", "at least one of each", "none"));
        }
        let size = self.config.size;
        let small = view.resized(size, size)?;
        let (mut hints, mut codes, mut bases) = (Vec::new(), Vec::new(), Vec::new());
        for target in targets {
            let base = Base::of(view, target)?;
            hints.extend(hint_planes(&small, target.light, &base.resized(size, size)?)?);
            codes.extend(view_light_code(&small, target.light)?);
            bases.push(base.prediction.target);
        }
        let (batch, device) = (targets.len(), &Device::Cpu);
        let hints = Tensor::from_vec(hints, (batch, HINTS, size, size), device)?;
        let codes = Tensor::from_vec(codes, (batch, LIGHT_CHANNELS), device)?;
        let sampler = Sampler::ddim(&self.objective.schedule, options.steps, Spacing::Trailing, Parameterization::V)?;
        let stage = SpaceToDepth(BLOCK);
        let latent = (stage.latent_channels(3), size / BLOCK, size / BLOCK);
        let (width, height, _) = view.source.shape();
        let mut runs = Vec::with_capacity(options.runs);
        for run in 0..options.runs {
            let noise = shared_noise(options.seed, &format!("relighter {run}"), batch, latent, device)?;
            let ratios = sampler.sample(&noise, |x, t| self.predict(x, &vec![t as f32; batch], &hints, &codes))?;
            let ratios = resize_bilinear(&stage.decode(&ratios)?, height, width, false)?;
            runs.push(ratios.permute((0, 2, 3, 1))?.contiguous()?.flatten_all()?.to_vec1::<f32>()?);
        }
        let values = width * height * 3;
        let of = |i: usize| runs.iter().map(|run| &run[i * values..][..values]).collect();
        bases.iter().enumerate().map(|(i, base)| relit(base, of(i))).collect()
    }
}

/// Mean and deviation of the radiances that several runs' ratios give.
fn relit(base: &Image, runs: Vec<&[f32]>) -> Result<Relit> {
    let (width, height, _) = base.shape();
    let count = runs.len() as f32;
    let mut image = Image::new(width, height, 3);
    let mut deviation = Image::new(width, height, 1);
    for (i, (value, base)) in image.data_mut().iter_mut().zip(base.data()).enumerate() {
        let radiances = runs.iter().map(|run| decode_ratio(*base, run[i]));
        let (sum, squares) = radiances.fold((0.0f32, 0.0f32), |(sum, squares), r| (sum + r, squares + r * r));
        *value = sum / count;
        deviation.data_mut()[i / 3] += ((squares / count - *value * *value).max(0.0)) / 3.0;
    }
    if let Some((x, y, _)) = image.first_non_finite() {
        return Err(DiffusionError::NonFinite { what: format!("relit picture, pixel ({x}, {y})") });
    }
    Ok(Relit { image, deviation: deviation.map(f32::sqrt) })
}
