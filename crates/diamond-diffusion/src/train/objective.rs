//! The training objective of one batch.
use super::image_terms::{blur_difference, ssim};
use crate::error::{DiffusionError, Result};
use crate::first_stage::FirstStage;
use crate::noise::Noise;
use crate::parameterization::{Parameterization, add_noise, combine};
use crate::schedule::{Level, Schedule};
use candle_core::Tensor;

/// Weights of the terms on predicted pictures; each picture's terms are weighted by its ᾱ besides.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageTerms {
    /// Mean absolute difference.
    pub l1: f64,
    /// 1 − structural similarity.
    pub ssim: f64,
    /// Difference under blurs.
    pub blur: f64,
    /// A perceptual distance, given from outside; 0 where there is none.
    pub perceptual: f64,
}

impl ImageTerms {
    /// No terms on pictures.
    pub const NONE: Self = Self { l1: 0.0, ssim: 0.0, blur: 0.0, perceptual: 0.0 };
}

impl Default for ImageTerms {
    fn default() -> Self {
        Self { l1: 0.5, ssim: 0.2, blur: 0.2, perceptual: 0.0 }
    }
}

/// A perceptual distance of pictures (batch, 3, height, width) in [−1, 1], one number each.
pub type Perceptual<'a> = &'a dyn Fn(&Tensor, &Tensor) -> Result<Tensor>;

/// What training lowers: the squared error of the prediction, weighted by signal to noise, and terms on pictures.
#[derive(Debug, Clone, PartialEq)]
pub struct Objective {
    /// Noise at each timestep.
    pub schedule: Schedule,
    /// What is predicted.
    pub parameterization: Parameterization,
    /// γ of Min-SNR: signal to noise beyond it counts as much as it; without, all timesteps weigh the same.
    pub min_snr: Option<f64>,
    /// Terms on predicted pictures.
    pub image: ImageTerms,
    /// Share of the pictures that are trained on at the last timestep, where sampling begins; the other timesteps are drawn evenly.
    pub noise_only: f32,
}

impl Objective {
    /// Level of a timestep; those of a flow are even in time.
    fn level(&self, timestep: usize) -> Level {
        match self.parameterization {
            Parameterization::Flow => Level::of_flow((timestep + 1) as f64 / self.schedule.steps() as f64),
            _ => self.schedule.level(timestep),
        }
    }

    /// The weight of a picture's squared error: min(SNR, γ)/SNR for ε, min(SNR + 1, γ)/(SNR + 1) for v, so that the last timestep of
    /// a schedule without signal there is learned too, and min(SNR, γ) for x₀.
    /// `[eq:min-snr]`
    pub fn weight(&self, timestep: usize) -> f64 {
        let Some(gamma) = self.min_snr else { return 1.0 };
        let snr = self.level(timestep).snr();
        let least = snr.min(gamma);
        match self.parameterization {
            Parameterization::X0 => least,
            // Without signal the first is 0/0 and the limit 1.
            Parameterization::Epsilon => {
                if snr > 0.0 {
                    least / snr
                } else {
                    1.0
                }
            }
            Parameterization::V => (snr + 1.0).min(gamma) / (snr + 1.0),
            Parameterization::Flow => 1.0,
        }
    }

    /// Timesteps for a batch of `batch` in groups of `views` that share theirs, from (seed, step).
    pub fn timesteps(&self, seed: u64, step: u64, batch: usize, views: usize) -> Vec<usize> {
        let mut noise = Noise::new(seed, "timesteps", step);
        let mut timesteps = Vec::with_capacity(batch);
        while timesteps.len() < batch {
            let steps = self.schedule.steps();
            let drawn =
                if self.noise_only > 0.0 && noise.uniform() < self.noise_only { steps - 1 } else { noise.below(steps) };
            timesteps.extend(std::iter::repeat_n(drawn, views.max(1).min(batch - timesteps.len())));
        }
        timesteps
    }

    /// The objective of clean latents (batch, channels, height, width) under given timesteps and noise. `predict` is given noisy
    /// latents and what the network is told of the timesteps.
    pub fn value(
        &self,
        clean: &Tensor,
        noise: &Tensor,
        timesteps: &[usize],
        stage: &dyn FirstStage,
        perceptual: Option<Perceptual<'_>>,
        predict: impl FnOnce(&Tensor, &[f32]) -> Result<Tensor>,
    ) -> Result<Tensor> {
        if clean.dims() != noise.dims() || clean.rank() != 4 || clean.dim(0)? != timesteps.len() {
            return Err(DiffusionError::shape("noise", clean.dims(), noise.dims()));
        }
        if let Some(t) = timesteps.iter().find(|t| **t >= self.schedule.steps()) {
            return Err(DiffusionError::setting("timestep", format!("below {}", self.schedule.steps()), t));
        }
        let levels: Vec<Level> = timesteps.iter().map(|t| self.level(*t)).collect();
        let noisy = add_noise(clean, noise, &levels)?;
        // As the samplers do: a flow's network is told a thousand times the time.
        let told = |t: &usize| match self.parameterization {
            Parameterization::Flow => 1000.0 * (t + 1) as f32 / self.schedule.steps() as f32,
            _ => *t as f32,
        };
        let told: Vec<f32> = timesteps.iter().map(told).collect();
        let prediction = predict(&noisy, &told)?;
        if prediction.dims() != clean.dims() {
            return Err(DiffusionError::shape("prediction of a network", clean.dims(), prediction.dims()));
        }
        let weights = |f: &dyn Fn(&Level) -> (f64, f64)| levels.iter().map(f).collect::<Vec<_>>();
        let target = combine(clean, noise, &weights(&|level| self.parameterization.target_weights(*level)))?;
        let error = (&prediction - target)?.sqr()?.flatten_from(1)?.mean(1)?;
        let mut sum = weighed(&error, timesteps.iter().map(|t| self.weight(*t)).collect())?;
        let terms = self.image;
        if terms == ImageTerms::NONE {
            return Ok(sum);
        }
        // Pictures of latents without signal say nothing, and their ᾱ is nothing: the recovery of such a level is not asked for.
        let recovered = |level: &Level| match self.parameterization.recover(*level) {
            Ok(recovery) => recovery.x0,
            Err(_) => (0.0, 0.0),
        };
        let predicted = stage.decode(&combine(&noisy, &prediction, &weights(&recovered))?)?;
        let wanted = stage.decode(clean)?;
        let alpha_bar = || levels.iter().map(|level| level.signal * level.signal).collect::<Vec<f64>>();
        let mut add = |weight: f64, term: Tensor| -> Result<()> {
            sum = (&sum + (weighed(&term, alpha_bar())? * weight)?)?;
            Ok(())
        };
        if terms.l1 > 0.0 {
            add(terms.l1, (&predicted - &wanted)?.abs()?.flatten_from(1)?.mean(1)?)?;
        }
        if terms.ssim > 0.0 {
            // Pictures are in [−1, 1], similarity is of [0, 1].
            let similarity = ssim(&predicted.affine(0.5, 0.5)?, &wanted.affine(0.5, 0.5)?)?;
            add(terms.ssim, similarity.affine(-1.0, 1.0)?)?;
        }
        if terms.blur > 0.0 {
            add(terms.blur, blur_difference(&predicted, &wanted)?)?;
        }
        match perceptual {
            Some(perceptual) if terms.perceptual > 0.0 => add(terms.perceptual, perceptual(&predicted, &wanted)?)?,
            None if terms.perceptual > 0.0 => {
                return Err(DiffusionError::setting("perceptual", "0 without a perceptual distance", terms.perceptual));
            }
            _ => {}
        }
        Ok(sum)
    }
}

/// The mean of one number a picture, each with its weight.
fn weighed(values: &Tensor, weights: Vec<f64>) -> Result<Tensor> {
    let weights = Tensor::new(weights.as_slice(), &candle_core::Device::Cpu)?;
    Ok(values.mul(&weights.to_dtype(values.dtype())?.to_device(values.device())?)?.mean_all()?)
}
