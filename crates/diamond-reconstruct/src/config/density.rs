//! How Gaussians are added, removed and moved.
use serde::{Deserialize, Serialize};

/// How Gaussians are added, removed and moved.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DensityStrategy {
    /// Clone, split and prune by screen-space gradient, size and opacity; reset opacities.
    Adaptive,
    /// Relocate transparent Gaussians onto opaque ones, grow by a share per round, add noise to the means.
    Mcmc,
    /// The first Gaussians are the last.
    None,
}

/// Density control.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Density {
    /// Which kind.
    pub strategy: DensityStrategy,
    /// Steps between two rounds.
    pub every_steps: u64,
    /// First round, fraction of the run.
    pub from: f32,
    /// Last round, fraction of the run.
    pub until: f32,
    /// Mean screen-space positional gradient (NDC) at which a Gaussian is cloned or split.
    pub gradient_threshold: f32,
    /// Largest scale (× extent) that is cloned rather than split.
    pub percent_dense: f32,
    /// The two children of a split have their parent's scale divided by this.
    pub split_divisor: f32,
    /// Opacity below which a Gaussian is pruned, or relocated.
    pub prune_opacity: f32,
    /// Gaussians whose footprint had a larger radius than this (px) since the last round are pruned; 0 for never.
    pub max_screen_radius: f32,
    /// Gaussians with a larger standard deviation than this (× extent) are pruned unless a split helps; 0 for never.
    pub max_world_scale: f32,
    /// Fraction of the run from which too large Gaussians are pruned.
    pub large_from: f32,
    /// Opacity is reset every this fraction of the run; 0 for never.
    pub reset_every: f32,
    /// Opacity after a reset.
    pub reset_opacity: f32,
    /// Never more Gaussians than this, the first ones included. Where room is short the largest gradients win.
    pub max_gaussians: usize,
    /// From this fraction of the run the number of Gaussians stays what it is: nothing is cloned, split, pruned, added or
    /// reset; relocation goes on. 0 for the whole run, 1 for never.
    pub freeze_count: f32,
    /// What relocation needs to know.
    pub mcmc: Mcmc,
}

/// Relocation, noise and pressure of the `mcmc` strategy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mcmc {
    /// Share of the Gaussians that is added in each round, until `max_gaussians`.
    pub growth: f32,
    /// Noise on the means, over the learning rate and × Σ/extent².
    pub noise: f32,
    /// Steepness of the gate that spares opaque Gaussians from noise.
    pub noise_sharpness: f32,
    /// Opacity at which the gate is half open.
    pub noise_opacity: f32,
    /// Weight of the mean opacity in the objective.
    pub opacity_weight: f32,
    /// Weight of the mean sum of standard deviations over extent in the objective.
    pub scale_weight: f32,
}
