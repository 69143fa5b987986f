//! Steps that a [`Stepper`] makes: what the engine prepares for them, and how parameters come back when something here needs them.
use crate::cpu::ATTACH_STEPS;
use crate::objective::{self, Terms};
use crate::random::{Purpose, Random};
use crate::rows::input_scaling;
use crate::stepper::{StepImage, StepTask, Stepper};
use crate::{
    Activated, CpuEngine, DensityStrategy, ExposureMode, ReconstructError, StepPlan, StepReport, TrainingPair, error,
    forward, residual_pull,
};
use std::sync::Arc;
use std::time::Instant;

fn device(detail: String) -> ReconstructError {
    ReconstructError::Device { detail }
}

/// Who makes steps elsewhere, and where the parameters are up to date.
pub(crate) struct Resident {
    pub stepper: Box<dyn Stepper>,
    /// The model here is the current one.
    pub here: bool,
    /// The stepper has the current one.
    pub there: bool,
    /// What it was found to lack so far.
    pub lacking: Vec<String>,
    /// To be told.
    pub notes: Vec<String>,
}

impl CpuEngine {
    /// Gets back what the stepper has changed.
    pub(crate) fn recall(&mut self) -> Result<(), ReconstructError> {
        if let Some(resident) = self.resident.as_mut().filter(|r| !r.here) {
            let t = Instant::now();
            resident.stepper.store(&mut self.model, &mut self.stats).map_err(device)?;
            resident.here = true;
            self.profile.add("parameters from the device", t);
        }
        Ok(())
    }

    /// Says that the model here has changed.
    pub(crate) fn changed_here(&mut self) {
        if let Some(resident) = &mut self.resident {
            (resident.here, resident.there) = (true, false);
        }
    }

    /// Says, once for each reason, that a step is made here.
    pub(crate) fn tell(&mut self, step: u64, lacking: String) {
        if let Some(resident) = self.resident.as_mut().filter(|r| !r.lacking.contains(&lacking)) {
            let name = resident.stepper.name();
            resident.notes.push(format!("step {step} and others like it are made on the CPU: {name} lacks {lacking}"));
            resident.lacking.push(lacking);
        }
    }

    /// What of a step the stepper cannot do; `None` where it does all, or there is none.
    pub(crate) fn beyond_stepper(&self, plan: &StepPlan, batch: &[TrainingPair<'_>]) -> Option<String> {
        let resident = self.resident.as_ref()?;
        let config = &self.model.config;
        if config.exposure.mode != ExposureMode::Fixed {
            return Some("exposure.mode: gains of photographs".into());
        }
        if config.density.strategy == DensityStrategy::Mcmc {
            return Some("density.strategy = \"mcmc\": noise on the means".into());
        }
        resident.stepper.lacks(&self.model, &self.needs.at(plan), batch)
    }

    /// Traced visibility toward the light of an image; parameters come back where rays are traced anew.
    fn traced(
        &mut self,
        pair: &TrainingPair<'_>,
        step: u64,
        activated: &mut Option<Activated>,
    ) -> Result<Option<Arc<Vec<f32>>>, ReconstructError> {
        if !(self.model.config.visibility.traced && self.needs.traced_visibility.needed) {
            return Ok(None);
        }
        let every = self.model.config.visibility.every_steps;
        if let Some(known) = self.visibility.young(every, self.model.len(), pair.light, step) {
            return Ok(Some(Arc::new(known.to_vec())));
        }
        self.recall()?;
        let t = Instant::now();
        let activated = activated.get_or_insert_with(|| self.model.parameters.activate());
        let (config, keep) = (&self.model.config.visibility, !self.needs.unmoved_visibility.needed);
        let v = self.visibility.get(config, keep, &activated.gaussians, &activated.normals, pair.light, step)?;
        let v = Arc::new(v.to_vec());
        self.profile.add("visibility", t);
        Ok(Some(v))
    }

    /// A step by the stepper, then what it leaves to the CPU: density control and the surfels around the Gaussians.
    pub(crate) fn step_there(
        &mut self,
        step: u64,
        plan: &StepPlan,
        batch: &[TrainingPair<'_>],
    ) -> Result<StepReport, ReconstructError> {
        let start = Instant::now();
        let share = 1.0 / batch.len().max(1) as f32;
        let mut activated = None;
        let mut images = Vec::with_capacity(batch.len());
        for pair in batch {
            let traced = self.traced(pair, step, &mut activated)?;
            let light = self.model.scene.scaled_light(pair.light);
            let samples = match (&traced, self.needs.visibility_sh.needed) {
                (Some(_), true) => {
                    let mut random = Random::new(self.model.config.seed, Purpose::VisibilitySamples, step);
                    counted(objective::visibility_samples(&self.model, &mut random))
                }
                _ => Vec::new(),
            };
            let leaving = match &self.model.medium {
                Some(medium) => medium.leaving(&[light])?.pop(),
                None => None,
            };
            images.push(StepImage { pair, light, traced, samples, leaving });
        }
        let start = self.profile.add("step prepared", start);
        let needs = self.needs.at(plan);
        let settings = forward::Settings::training(&self.model, plan);
        let raster = forward::raster_config(&self.model);
        let splat = &self.model.config.splat;
        let extent = self.model.scene.extent;
        let (smoothness, residual) = (self.needs.transfer_smoothness.needed, &self.model.config.residual);
        let pull = self.needs.residual_pull.needed && self.model.medium.is_some();
        let task = StepTask {
            step,
            plan,
            needs: &needs,
            shading: &settings.shading,
            raster: &raster,
            scaling: input_scaling(&self.model),
            rates: self.rates(plan),
            scales: [splat.min_scale * extent, splat.max_scale * extent],
            images,
            transfer_smoothness: (smoothness && residual.transfer).then_some(residual.transfer_smoothness),
            medium: self.model.medium.as_ref().and_then(|medium| medium.constants()),
            residual_pull: pull.then(|| {
                let mut random = Random::new(self.model.config.seed, Purpose::ResidualPull, step);
                residual_pull::draw(&self.model, self.views, &mut random)
            }),
            model: &self.model,
        };
        let Some(resident) = &mut self.resident else {
            return Err(error::stage("step")("there is no stepper"));
        };
        if !resident.there {
            resident.stepper.load(&self.model, &self.stats).map_err(device)?;
            resident.there = true;
        }
        let outcome = resident.stepper.step(&task).map_err(device)?;
        resident.here = false;
        let t = self.profile.add("step on the device", start);
        if let Some([what, detail]) = outcome.not_finite {
            return Err(ReconstructError::NonFinite { what, step, detail });
        }
        self.counters.add("steps on the device", 1);
        let mut terms = Terms::default();
        let (mut psnr, mut visible) = (0.0, 0);
        for image in &outcome.images {
            terms.add(&image.terms, share);
            (psnr, visible) = (psnr + image.psnr * share, image.visible);
        }
        terms.add(&outcome.terms, 1.0);
        let objective = terms.objective();
        if !objective.is_finite() {
            let culprit = terms.values.iter().find(|t| !t.value.is_finite());
            let what = format!("the loss term `{}`", culprit.map_or("objective", |t| t.name));
            return Err(ReconstructError::NonFinite { what, step, detail: format!("{objective}") });
        }
        let mut density = [0; 3];
        if plan.densify || plan.reset_opacity {
            self.recall()?;
            density = self.control_density(step, plan)?;
            self.changed_here();
        }
        let last = step + 1 == self.model.config.steps;
        if self.model.medium.is_some() && (plan.densify || last || (step + 1).is_multiple_of(ATTACH_STEPS)) {
            self.recall()?;
            self.attach();
            self.changed_here();
        }
        self.profile.add("density control", t);
        let gaussians = self.model.len();
        Ok(StepReport { step, objective, terms: terms.values, psnr, gaussians, visible, density })
    }
}

/// Each number once, ascending, with how often it occurs.
fn counted(mut drawn: Vec<usize>) -> Vec<[u32; 2]> {
    drawn.sort_unstable();
    let mut out: Vec<[u32; 2]> = Vec::with_capacity(drawn.len());
    for i in drawn {
        match out.last_mut() {
            Some([last, times]) if *last as usize == i => *times += 1,
            _ => out.push([i as u32, 1]),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_drawn_twice_counts_twice() {
        assert_eq!(counted(vec![5, 2, 5, 9, 2, 5]), [[2, 2], [5, 3], [9, 1]]);
        assert!(counted(Vec::new()).is_empty());
    }
}
