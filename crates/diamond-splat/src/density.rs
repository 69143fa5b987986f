//! Density control: where the set of Gaussians grows and where it shrinks.
//!
//! A Gaussian whose projected mean is pulled about strongly, on average over the views that see it, covers detail
//! that it cannot show. If it is small, a copy is put beside it (clone); if it is large, two smaller ones take its
//! place (split). Gaussians that have become transparent or too large are dropped (prune).
//!
//! This file decides and moves nothing: raw parameters and optimiser moments live elsewhere, so a [`DensityPlan`]
//! lists for each Gaussian of the new set where it comes from. Everything is a function of its inputs: no random
//! numbers, ties are broken by index.
use crate::{Gaussians, SplatError};
use glam::{Quat, Vec2, Vec3};

/// Thresholds of density control.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DensityConfig {
    /// Mean screen-space gradient from which a Gaussian is cloned or split, per normalised device unit
    /// (the image is 2 units wide and 2 high).
    pub gradient_threshold: f32,
    /// Up to this largest standard deviation, as a fraction of the scene extent, a Gaussian is cloned, beyond it split.
    pub percent_dense: f32,
    /// The children of a split have their parent's scale divided by this.
    pub split_divisor: f32,
    /// Gaussians below this opacity are pruned.
    pub prune_opacity: f32,
    /// Gaussians that were larger than this on screen are pruned, unless they are split (radius, pixels).
    pub max_screen_radius: Option<f32>,
    /// Gaussians with a standard deviation beyond this fraction of the scene extent are pruned, unless they are split
    /// and the children are small enough.
    pub max_world_scale: Option<f32>,
    /// Growth stops at this number: the largest gradients win. It never causes pruning.
    pub max_gaussians: Option<usize>,
}

impl Default for DensityConfig {
    fn default() -> Self {
        Self {
            gradient_threshold: 2e-4,
            percent_dense: 0.01,
            split_divisor: 1.6,
            prune_opacity: 0.005,
            max_screen_radius: None,
            max_world_scale: None,
            max_gaussians: None,
        }
    }
}

/// What was seen of each Gaussian since the last time density was controlled.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DensityStats {
    /// Sum over views of the gradient norm, per normalised device unit.
    pub gradient_sum: Vec<f32>,
    /// Number of views that saw the Gaussian.
    pub views: Vec<u32>,
    /// Largest radius on screen, pixels.
    pub max_radius: Vec<f32>,
}

impl DensityStats {
    /// Nothing seen yet of `n` Gaussians.
    pub fn new(n: usize) -> Self {
        Self { gradient_sum: vec![0.0; n], views: vec![0; n], max_radius: vec![0.0; n] }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.views.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.views.is_empty()
    }

    /// Adds one view of `width` × `height` pixels. `d_mean2d` is the loss gradient of each projected mean, per pixel;
    /// `radii` the radius of each Gaussian on screen in pixels, 0 (or less) where it is not seen.
    ///
    /// `[eq:density-gradient]` The norm is that of (∂L/∂x · width/2, ∂L/∂y · height/2): moving by one normalised
    /// device unit moves by half an image, so thresholds do not depend on the resolution. A gradient that is not
    /// finite counts as 0.
    pub fn record(&mut self, d_mean2d: &[Vec2], radii: &[f32], width: u32, height: u32) -> Result<(), SplatError> {
        let n = self.len();
        same_length("DensityStats::record, d_mean2d", n, d_mean2d.len())?;
        same_length("DensityStats::record, radii", n, radii.len())?;
        let half_size = 0.5 * Vec2::new(width as f32, height as f32);
        for i in 0..n {
            if radii[i] > 0.0 {
                let norm = (d_mean2d[i] * half_size).length();
                self.gradient_sum[i] += if norm.is_finite() { norm } else { 0.0 };
                self.views[i] += 1;
                self.max_radius[i] = self.max_radius[i].max(radii[i]);
            }
        }
        Ok(())
    }

    /// Mean gradient norm of Gaussian `i` over the views that saw it; 0 if none did.
    pub fn mean_gradient(&self, i: usize) -> f32 {
        if self.views[i] == 0 { 0.0 } else { self.gradient_sum[i] / self.views[i] as f32 }
    }
}

/// How a Gaussian of the new set comes from one of the old.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OriginKind {
    /// It is the old one; parameters and optimiser moments are kept.
    Kept,
    /// It is a copy of one that is kept as well; its moments start at zero.
    Clone,
    /// It is one of two that replace the old one: see [`split_child`]; its moments start at zero.
    SplitChild,
}

/// Where a Gaussian of the new set comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Origin {
    /// Index in the old set.
    pub source: u32,
    /// How.
    pub kind: OriginKind,
}

/// The new set.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct DensityPlan {
    /// One entry per Gaussian of the new set: first those kept, then the clones, then the children of splits in
    /// pairs; each group in order of the source.
    pub origins: Vec<Origin>,
    /// Number of Gaussians that were cloned.
    pub cloned: usize,
    /// Number of Gaussians that were split.
    pub split: usize,
    /// Number of Gaussians that were dropped without successor.
    pub pruned: usize,
}

fn same_length(what: &'static str, expected: usize, found: usize) -> Result<(), SplatError> {
    if expected == found {
        return Ok(());
    }
    Err(SplatError::Shape { what, expected: format!("{expected} (one per Gaussian)"), found: found.to_string() })
}

/// Decides which Gaussians are kept, cloned, split and pruned. `extent` is the size of the scene in scene units (the
/// radius of the cameras' positions, customarily).
///
/// Transparent Gaussians, and such as are not finite, are pruned whatever their gradient.
pub fn plan(
    gaussians: &Gaussians,
    stats: &DensityStats,
    config: &DensityConfig,
    extent: f32,
) -> Result<DensityPlan, SplatError> {
    let n = gaussians.len();
    same_length("Gaussians::scales", n, gaussians.scales.len())?;
    same_length("Gaussians::rotations", n, gaussians.rotations.len())?;
    same_length("Gaussians::opacities", n, gaussians.opacities.len())?;
    for found in [stats.gradient_sum.len(), stats.views.len(), stats.max_radius.len()] {
        same_length("DensityStats", n, found)?;
    }
    let clone_up_to = config.percent_dense * extent;
    let world_limit = config.max_world_scale.map_or(f32::INFINITY, |fraction| fraction * extent);
    let screen_limit = config.max_screen_radius.unwrap_or(f32::INFINITY);

    /// What becomes of a Gaussian.
    #[derive(Clone, Copy, PartialEq)]
    enum Fate {
        Pruned,
        Kept,
        Cloned,
        Split,
    }
    let size = |i: usize| gaussians.scales[i].max_element();
    let too_large = |i: usize| size(i) > world_limit || stats.max_radius[i] > screen_limit;
    let mut fates: Vec<Fate> = (0..n)
        .map(|i| {
            let finite = gaussians.means[i].is_finite()
                && gaussians.scales[i].is_finite()
                && gaussians.rotations[i].is_finite()
                && gaussians.opacities[i].is_finite();
            let grows = stats.mean_gradient(i) >= config.gradient_threshold;
            if !finite || gaussians.opacities[i] < config.prune_opacity {
                Fate::Pruned
            } else if grows && size(i) > clone_up_to && size(i) / config.split_divisor <= world_limit {
                Fate::Split
            } else if too_large(i) {
                Fate::Pruned
            } else if grows {
                Fate::Cloned
            } else {
                Fate::Kept
            }
        })
        .collect();

    // Each clone and each split adds one. Where there is no room for all, the largest gradients win.
    let grows = |fate: Fate| matches!(fate, Fate::Cloned | Fate::Split);
    if let Some(max) = config.max_gaussians {
        let stay = fates.iter().filter(|&&fate| fate != Fate::Pruned).count();
        let room = max.saturating_sub(stay);
        let mut growing: Vec<usize> = (0..n).filter(|&i| grows(fates[i])).collect();
        if growing.len() > room {
            growing.sort_by(|&a, &b| stats.mean_gradient(b).total_cmp(&stats.mean_gradient(a)).then(a.cmp(&b)));
            for &i in &growing[room..] {
                fates[i] = if too_large(i) { Fate::Pruned } else { Fate::Kept };
            }
        }
    }

    let mut plan = DensityPlan::default();
    let sources = |wanted: fn(Fate) -> bool| {
        fates.iter().enumerate().filter(move |(_, fate)| wanted(**fate)).map(|(i, _)| i as u32)
    };
    let origin = |kind: OriginKind| move |source: u32| Origin { source, kind };
    plan.origins.extend(sources(|f| matches!(f, Fate::Kept | Fate::Cloned)).map(origin(OriginKind::Kept)));
    let kept = plan.origins.len();
    plan.origins.extend(sources(|f| f == Fate::Cloned).map(origin(OriginKind::Clone)));
    plan.cloned = plan.origins.len() - kept;
    let children = sources(|f| f == Fate::Split).flat_map(|source| [source, source]);
    plan.origins.extend(children.map(origin(OriginKind::SplitChild)));
    plan.split = (plan.origins.len() - kept - plan.cloned) / 2;
    plan.pruned = n - kept - plan.split;
    Ok(plan)
}

/// Mean and scale of one child of a split.
///
/// `[eq:density-split]` mean' = mean + R·(scale ∘ z), scale' = scale / divisor, with z a sample of the standard normal
/// distribution that the caller draws, so that children are samples of the parent. Rotation and opacity are
/// the parent's. `rotation` need not be normalised; the zero quaternion is the identity.
pub fn split_child(mean: Vec3, scale: Vec3, rotation: Quat, unit_normal_sample: Vec3, divisor: f32) -> (Vec3, Vec3) {
    let rotation = unit_rotation(rotation);
    (mean + rotation * (scale * unit_normal_sample), scale / divisor)
}

/// The opacity that a reset leaves: `[eq:opacity-reset]` min(opacity, ceiling). What is not needed then stays transparent and is pruned.
pub fn reset_opacity(opacity: f32, ceiling: f32) -> f32 {
    opacity.min(ceiling)
}

/// [`reset_opacity`] on the logit of the opacity, which is what an optimiser holds; `ceiling` in (0, 1) is an opacity.
pub fn reset_opacity_logit(logit: f32, ceiling: f32) -> f32 {
    logit.min(libm::logf(ceiling / (1.0 - ceiling)))
}

/// Normalised; the identity where that is impossible.
pub(crate) fn unit_rotation(rotation: Quat) -> Quat {
    // The length is taken after scaling by the largest component, so that neither 1e-30 nor 1e30 is lost.
    let largest = rotation.to_array().iter().fold(0.0f32, |m, v| m.max(v.abs()));
    if largest > 0.0 && largest.is_finite() {
        Quat::from_array(rotation.to_array().map(|v| v / largest)).normalize()
    } else {
        Quat::IDENTITY
    }
}
