//! Density control as the engine does it: plans of `diamond-splat` applied to raw parameters, Adam moments, and whatever
//! else has one row per Gaussian.
//!
//! Moments follow their Gaussians: one that stays as it is keeps them; a clone, a child of a split, and everybody on a
//! spot onto which something was relocated begins with zero moments, since its values jump. After a reset of
//! opacities the moments of all opacities are zero.
use crate::random::{Purpose, Random};
use crate::{Attribute, CpuEngine, DensityStrategy, ReconstructError, StepPlan, error, logit};
use diamond_splat::density::{self, DensityConfig, DensityStats, OriginKind, split_child};
use diamond_splat::relocation::{relocate, relocated};

impl CpuEngine {
    /// What the plan of this step asks for; returns how many Gaussians were cloned (or added), split, and pruned (or
    /// moved).
    pub(crate) fn control_density(&mut self, step: u64, plan: &StepPlan) -> Result<[usize; 3], ReconstructError> {
        let mut changes = [0; 3];
        if plan.densify {
            changes = match self.model.config.density.strategy {
                DensityStrategy::None => changes,
                DensityStrategy::Adaptive => self.densify(step, plan)?,
                DensityStrategy::Mcmc => self.relocate(step, plan)?,
            };
        }
        if plan.reset_opacity {
            self.reset_opacity();
        }
        Ok(changes)
    }

    /// Clones, splits and prunes; returns how many of each.
    fn densify(&mut self, step: u64, step_plan: &StepPlan) -> Result<[usize; 3], ReconstructError> {
        let d = &self.model.config.density;
        let late = |limit: f32| (step_plan.prune_large && limit > 0.0).then_some(limit);
        let config = DensityConfig {
            gradient_threshold: d.gradient_threshold,
            percent_dense: d.percent_dense,
            split_divisor: d.split_divisor,
            prune_opacity: d.prune_opacity,
            max_screen_radius: late(d.max_screen_radius),
            max_world_scale: late(d.max_world_scale),
            max_gaussians: Some(d.max_gaussians),
        };
        let extent = self.model.scene.extent;
        let activated = self.model.parameters.activate();
        let g = &activated.gaussians;
        let plan = density::plan(g, &self.stats, &config, extent).map_err(error::stage("density control"))?;
        if plan.origins.is_empty() {
            // Everything would be pruned (an all-black capture, say): keep the set rather than end with nothing.
            self.stats = DensityStats::new(self.model.len());
            return Ok([0, 0, 0]);
        }
        let sources: Vec<(u32, bool)> = plan.origins.iter().map(|o| (o.source, o.kind == OriginKind::Kept)).collect();
        let mut parameters = self.model.parameters.gather(&sources);
        let mut random = Random::new(self.model.config.seed, Purpose::Split, step);
        for (i, origin) in plan.origins.iter().enumerate() {
            if origin.kind == OriginKind::SplitChild {
                let s = origin.source as usize;
                let (mean, _) =
                    split_child(g.means[s], g.scales[s], g.rotations[s], random.normal3(), config.split_divisor);
                parameters.row_mut(Attribute::Mean, i).copy_from_slice(&mean.to_array());
                parameters.scale_covariance(i, 1.0 / config.split_divisor);
            }
        }
        self.model.parameters = parameters;
        self.visibility.gather(&sources);
        self.stats = DensityStats::new(self.model.len());
        Ok([plan.cloned, plan.split, plan.pruned])
    }

    /// Moves dead Gaussians onto live ones and adds new ones there; returns how many were added, none, how many moved.
    fn relocate(&mut self, step: u64, plan: &StepPlan) -> Result<[usize; 3], ReconstructError> {
        let d = &self.model.config.density;
        let opacities = self.model.parameters.opacities();
        let n = opacities.len();
        let growth = if plan.grow { (n as f64 * f64::from(d.mcmc.growth)).ceil() as usize } else { 0 };
        let grow_to = n.saturating_add(growth).min(d.max_gaussians).max(n);
        let mut random = Random::new(self.model.config.seed, Purpose::Relocation, step);
        let moves = relocate(&opacities, d.prune_opacity, grow_to, &mut || random.uniform64())
            .map_err(error::stage("relocation"))?;
        let crowded = |source: u32| moves.copies[source as usize] > 1;
        let sources: Vec<(u32, bool)> = moves.sources.iter().map(|&s| (s, !crowded(s))).collect();
        let mut parameters = self.model.parameters.gather(&sources);
        for (i, &source) in moves.sources.iter().enumerate() {
            if crowded(source) {
                let (opacity, ratio) = relocated(opacities[source as usize], moves.copies[source as usize]);
                // Not below what would be dead again at once.
                parameters.row_mut(Attribute::Opacity, i)[0] = logit(opacity.max(d.prune_opacity));
                parameters.scale_covariance(i, ratio);
            }
        }
        self.model.parameters = parameters;
        self.visibility.gather(&sources);
        self.stats = DensityStats::new(self.model.len());
        Ok([moves.added, 0, moves.moved])
    }

    fn reset_opacity(&mut self) {
        let ceiling = logit(self.model.config.density.reset_opacity);
        let group = self.model.parameters.group_mut(Attribute::Opacity);
        group.values.iter_mut().for_each(|v| *v = v.min(ceiling));
        group.moments.first.fill(0.0);
        group.moments.second.fill(0.0);
    }
}
