//! The CPU engine: one training step, written out in order.
//!
//! scatter → project → visibility → residual → rasterize → shade → objective → the same stairs back → Adam.
use crate::agreement::Comparison;
use crate::objective::{self, Terms};
use crate::random::{Purpose, Random};
use crate::resident::Resident;
use crate::visibility_cache::VisibilityCache;
use crate::{
    Activated, ActivatedGrad, Attribute, Blender, CaptureFacts, Counters, DensityStrategy, Engine, ExposureMode,
    GaussianParameters, Layout, MediumTerm, Model, Needs, ReconstructError, Rendering, StepPlan, StepReport, Stepper,
    TensorFile, TrainingPair, adam, error,
};
use crate::{forward, mcmc, residual_pull};
use diamond_camera::Camera;
use diamond_light::OlatLight;
use diamond_splat::GaussiansGrad;
use diamond_splat::density::DensityStats;
use std::path::Path;
use std::time::Instant;

/// The training step and renderer on the CPU.
pub struct CpuEngine {
    pub(crate) model: Model,
    pub(crate) needs: Needs,
    pub(crate) visibility: VisibilityCache,
    pub(crate) stats: DensityStats,
    pub(crate) profile: Profile,
    pub(crate) counters: Counters,
    /// Training views.
    pub(crate) views: usize,
    /// Who blends training pictures, if not the CPU.
    blender: Option<Box<dyn Blender>>,
    /// Who makes whole steps, if not the CPU.
    pub(crate) resident: Option<Resident>,
}

/// Steps after which Gaussians look anew for the surfels around them.
pub(crate) const ATTACH_STEPS: u64 = 100;

/// Seconds per part of a step.
#[derive(Debug, Clone, Default)]
pub struct Profile {
    parts: Vec<(&'static str, f64)>,
}

impl Profile {
    /// Adds the time since `since` to `part` and returns now.
    pub(crate) fn add(&mut self, part: &'static str, since: Instant) -> Instant {
        let now = Instant::now();
        let seconds = (now - since).as_secs_f64();
        match self.parts.iter_mut().find(|(name, _)| *name == part) {
            Some((_, total)) => *total += seconds,
            None => self.parts.push((part, seconds)),
        }
        now
    }
}

/// Stops at the first gradient that is not finite, and names it.
fn check_gradients(parameters: &GaussianParameters, gradients: &[Vec<f32>], step: u64) -> Result<(), ReconstructError> {
    for (attribute, gradient) in Attribute::ALL.iter().zip(gradients) {
        if let Some(i) = gradient.iter().position(|g| !g.is_finite()) {
            let width = parameters.group(*attribute).width.max(1);
            return Err(ReconstructError::NonFinite {
                what: format!("the gradient of `{}`", attribute.name()),
                step,
                detail: format!("Gaussian {}, component {}: {}", i / width, i % width, gradient[i]),
            });
        }
    }
    Ok(())
}

impl CpuEngine {
    /// An engine that trains `model` further and computes what its configuration needs.
    pub fn new(model: Model) -> Self {
        let needs = Needs::decide(&model.config, &CaptureFacts::default());
        Self::with_needs(model, needs)
    }

    /// An engine that trains `model` further and computes what `needs` says.
    pub fn with_needs(model: Model, needs: Needs) -> Self {
        let stats = DensityStats::new(model.len());
        Self {
            model,
            needs,
            visibility: VisibilityCache::default(),
            stats,
            profile: Profile::default(),
            counters: Counters::default(),
            views: 1,
            blender: None,
            resident: None,
        }
    }

    /// Told how many training views there are: the fewer, the less is left to the residual beside a medium.
    pub fn with_views(self, views: usize) -> Self {
        Self { views, ..self }
    }

    /// Whether an attribute has a gradient at all; one that has none stays as it is without Adam.
    fn learns(&self, attribute: Attribute, plan: &StepPlan) -> bool {
        match attribute {
            Attribute::Roughness => !plan.roughness_frozen,
            Attribute::Metalness => self.needs.metalness_learned.needed,
            Attribute::Subsurfaceness => self.needs.subsurfaceness_channel.needed,
            Attribute::VisibilitySh => self.needs.visibility_sh.needed,
            Attribute::Transfer => self.needs.transfer.needed,
            Attribute::Codes => self.needs.codes.needed,
            _ => true,
        }
    }

    /// Learning rate of each attribute at a step, in the order of [`Attribute::ALL`]; 0 for those that have no gradient.
    pub(crate) fn rates(&self, plan: &StepPlan) -> [f32; 13] {
        let (rates, factor) = (&self.model.config.rates, plan.attribute_factor);
        Attribute::ALL.map(|attribute| match attribute {
            attribute if !self.learns(attribute, plan) => 0.0,
            Attribute::Mean => plan.mean_rate * self.model.scene.extent,
            Attribute::Scale => rates.scale * factor,
            Attribute::Rotation => rates.rotation * factor,
            Attribute::Shear => rates.shear * factor,
            Attribute::Opacity => rates.opacity * factor,
            Attribute::Normal => rates.normal * plan.normal_factor,
            Attribute::BaseColor | Attribute::Roughness | Attribute::Metalness | Attribute::Subsurfaceness => {
                rates.material * plan.material_factor
            }
            Attribute::VisibilitySh => rates.visibility_sh * plan.material_factor,
            Attribute::Transfer => rates.transfer * plan.material_factor,
            Attribute::Codes => rates.codes * plan.material_factor,
        })
    }

    /// Finds the surfels around the Gaussians anew, where there is a medium.
    pub(crate) fn attach(&mut self) {
        let model = &mut self.model;
        if let Some(medium) = &mut model.medium {
            medium.attach(&model.parameters.activate());
        }
    }

    fn apply(
        &mut self,
        step: u64,
        plan: &StepPlan,
        activated: &Activated,
        grad: &ActivatedGrad,
        network: &[Vec<f32>],
    ) -> Result<(), ReconstructError> {
        let gradients = self.model.parameters.pull(activated, grad);
        check_gradients(&self.model.parameters, &gradients, step)?;
        let extent = self.model.scene.extent;
        let learns = Attribute::ALL.map(|attribute| self.learns(attribute, plan));
        for (group, _) in self.model.parameters.groups().iter().zip(learns).filter(|(_, learns)| !learns) {
            self.counters.add("Adam values left out", group.values.len());
        }
        let rates = self.rates(plan);
        self.model.parameters.adam_step(
            &gradients,
            |attribute| rates[attribute as usize],
            step + 1,
            self.model.config.adam.sparse,
        );
        if self.model.config.density.strategy == DensityStrategy::Mcmc {
            let mut random = Random::new(self.model.config.seed, Purpose::Noise, step);
            let settings = &self.model.config.density.mcmc;
            let g = &activated.gaussians;
            mcmc::disturb(&mut self.model.parameters, g, settings, plan.mean_rate, extent, &mut random);
        }
        let splat = &self.model.config.splat;
        let (low, high) = (splat.min_scale * extent, splat.max_scale * extent);
        self.model.parameters.clamp_covariances(low, high);
        if let Some(model_network) = &mut self.model.network {
            let parts = crate::model::network_parts_mut(model_network);
            for (((name, values), moments), gradient) in
                parts.into_iter().zip(&mut self.model.network_moments).zip(network)
            {
                if let Some(i) = gradient.iter().position(|g| !g.is_finite()) {
                    return Err(ReconstructError::NonFinite {
                        what: format!("the gradient of the network's {name}"),
                        step,
                        detail: format!("parameter {i}: {}", gradient[i]),
                    });
                }
                adam::adam_step(values, moments, gradient, plan.network_rate, step + 1, adam::Rows::All);
            }
        }
        if let Some((attribute, i)) = self.model.parameters.first_non_finite() {
            return Err(ReconstructError::NonFinite {
                what: format!("`{}`", attribute.name()),
                step,
                detail: format!("Gaussian {i}"),
            });
        }
        Ok(())
    }
}

impl Engine for CpuEngine {
    fn name(&self) -> &str {
        self.blender.as_ref().map_or("cpu", |blender| blender.name())
    }

    fn training_step(
        &mut self,
        step: u64,
        plan: &StepPlan,
        batch: &[TrainingPair<'_>],
    ) -> Result<StepReport, ReconstructError> {
        if self.resident.is_some() {
            let Some(lacking) = self.beyond_stepper(plan, batch) else {
                return self.step_there(step, plan, batch);
            };
            self.counters.add("steps on the CPU", 1);
            self.recall()?;
            self.changed_here();
            self.tell(step, lacking);
        }
        let start = Instant::now();
        let n = self.model.len();
        let activated = self.model.parameters.activate();
        let mut total = ActivatedGrad { gaussians: GaussiansGrad::zeros(n), ..Default::default() };
        let mut network_grad: Vec<Vec<f32>> = Vec::new();
        let mut terms = Terms::default();
        let mut psnr = 0.0;
        let mut visible = 0;
        self.profile.add("activate", start);
        let mut gains: Vec<(usize, [f32; 3])> = Vec::new();
        let share = 1.0 / batch.len().max(1) as f32;
        let needs = self.needs.at(plan);
        for pair in batch {
            let settings = forward::Settings::training(&self.model, plan);
            let traced = match self.model.config.visibility.traced && self.needs.traced_visibility.needed {
                true => {
                    let t = Instant::now();
                    let keep = !self.needs.unmoved_visibility.needed;
                    let g = &activated.gaussians;
                    let config = &self.model.config.visibility;
                    let v = self.visibility.get(config, keep, g, &activated.normals, pair.light, step)?;
                    self.profile.add("visibility", t);
                    Some(v)
                }
                false => None,
            };
            let light = self.model.scene.scaled_light(pair.light);
            let pass = forward::Pass {
                model: &self.model,
                activated: &activated,
                camera: pair.camera,
                light: &light,
                traced,
                content: pair.content,
                settings: &settings,
                needs: &needs,
                comparison: pair.neighbour.map(|neighbour| Comparison {
                    neighbour,
                    mask: pair.mask,
                    stereo: pair.guide.filter(|g| g.depth).map(|g| g.stereo),
                    factor: plan.consistency,
                    share,
                }),
            };
            let blender = self.blender.as_mut();
            let mut meters = forward::Meters { profile: &mut self.profile, counters: &mut self.counters, blender };
            let mode = self.model.config.exposure.mode;
            // Pictures that nobody took have the exposure of renderings, and do not change it.
            let (own, factor) = match pair.believed {
                None => (true, plan.exposure_factor),
                Some(_) => (mode == ExposureMode::Global, 0.0),
            };
            let gain = self.model.exposure.index(mode, pair.view, pair.image).filter(|_| own);
            let step_gain = gain.map(|i| {
                let model = &self.model;
                move |fitted| model.exposure.toward(&model.config, i, fitted, factor)
            });
            let mut outcome = None;
            let pulled = forward::value_and_grad(&pass, &mut meters, |view| {
                let step_gain = step_gain.as_ref().map(|f| f as &dyn Fn([Option<f32>; 3]) -> [f32; 3]);
                let mut o = objective::evaluate(&self.model.config, &needs, view, pair, share, step_gain)?;
                let grad = std::mem::take(&mut o.grad);
                outcome = Some(o);
                Ok(grad)
            })?;
            if let Some(outcome) = outcome {
                outcome.terms.iter().for_each(|term| self.counters.add(term.name, 1));
                self.counters.add("PSNR encoded anew", usize::from(outcome.psnr_encoded));
                terms.add(&outcome.terms, share);
                psnr += outcome.psnr * share;
                gains.extend(gain.zip(outcome.log_gain).filter(|_| pair.believed.is_none()));
            }
            pulled.agreement.iter().for_each(|term| self.counters.add(term.name, 1));
            terms.add(&pulled.agreement, share);
            visible = pulled.visible;
            let t = Instant::now();
            if plan.collect_density {
                let k = &pair.camera.intrinsics;
                self.stats
                    .record(&pulled.screen, &pulled.radii, k.width, k.height)
                    .map_err(error::stage("density statistics"))?;
            }
            pulled.add_to(&mut total, &mut network_grad)?;
            self.profile.add("accumulate", t);
            if let (Some(traced), true) = (traced, self.needs.visibility_sh.needed) {
                let t = Instant::now();
                let mut random = Random::new(self.model.config.seed, Purpose::VisibilitySamples, step);
                let value = objective::visibility_term(
                    &self.model,
                    &mut random,
                    &light,
                    traced,
                    share,
                    &mut total.visibility_sh,
                )?;
                terms.add(&[value], share);
                self.counters.add(value.name, 1);
                self.profile.add("visibility term", t);
            }
        }
        if self.needs.residual_pull.needed && self.model.medium.is_some() {
            let mut random = Random::new(self.model.config.seed, Purpose::ResidualPull, step);
            let value = residual_pull::pull_to_nothing(
                &self.model,
                &activated,
                self.views,
                &mut random,
                &mut total,
                &mut network_grad,
            )?;
            terms.add(&[value], 1.0);
        }
        if self.needs.transfer_smoothness.needed {
            objective::regularise(&self.model, &mut total, &mut terms);
        }
        mcmc::regularise(&self.model, &activated.gaussians, &mut total, &mut terms);
        let objective_value = terms.objective();
        if !objective_value.is_finite() {
            let culprit = terms.values.iter().find(|t| !t.value.is_finite());
            return Err(ReconstructError::NonFinite {
                what: format!("the loss term `{}`", culprit.map_or("objective", |t| t.name)),
                step,
                detail: format!("{objective_value}"),
            });
        }
        let t = Instant::now();
        self.apply(step, plan, &activated, &total, &network_grad)?;
        for (i, log_gain) in gains {
            self.model.exposure.set(self.model.config.exposure.mode, i, log_gain);
        }
        let t = self.profile.add("adam", t);
        let density = self.control_density(step, plan)?;
        let last = step + 1 == self.model.config.steps;
        if plan.densify || last || (step + 1).is_multiple_of(ATTACH_STEPS) {
            self.attach();
        }
        self.profile.add("density control", t);
        Ok(StepReport {
            step,
            objective: objective_value,
            terms: terms.values,
            psnr,
            gaussians: self.model.len(),
            visible,
            density,
        })
    }

    fn render(&mut self, camera: &Camera, lights: &[OlatLight]) -> Result<Vec<Rendering>, ReconstructError> {
        self.recall()?;
        self.model.render(camera, lights)
    }

    fn blend_by(&mut self, blender: Box<dyn Blender>) {
        self.blender = Some(blender);
    }

    fn step_by(&mut self, stepper: Box<dyn Stepper>, plan: &StepPlan) -> Option<String> {
        self.resident = Some(Resident { stepper, here: true, there: false, lacking: Vec::new(), notes: Vec::new() });
        self.beyond_stepper(plan, &[])
    }

    fn take_notes(&mut self) -> Vec<String> {
        self.resident.as_mut().map_or_else(Vec::new, |resident| std::mem::take(&mut resident.notes))
    }

    fn adopt_medium(&mut self, medium: MediumTerm) -> Result<(), ReconstructError> {
        self.recall()?;
        self.changed_here();
        let seeds = self.model.config.subsurface.seeds;
        if let Some(sources) = self.model.adopt_medium(medium, seeds)? {
            self.visibility.gather(&sources);
            self.stats = DensityStats::new(self.model.len());
        }
        Ok(())
    }

    fn model(&mut self) -> Result<&Model, ReconstructError> {
        self.recall()?;
        Ok(&self.model)
    }

    fn state(&mut self) -> Result<TensorFile, ReconstructError> {
        self.recall()?;
        let mut file = TensorFile::default();
        let n = self.model.len();
        for group in self.model.parameters.groups() {
            let name = group.attribute.name();
            let shape = [n, group.width];
            file.insert(format!("gaussians.{name}"), &shape, group.values.clone());
            file.insert(format!("gaussians.{name}.first_moment"), &shape, group.moments.first.clone());
            file.insert(format!("gaussians.{name}.second_moment"), &shape, group.moments.second.clone());
        }
        for ((name, values), moments) in self.model.network_tensors().into_iter().zip(&self.model.network_moments) {
            let shape = [values.len()];
            file.insert(format!("network.{name}"), &shape, values.to_vec());
            file.insert(format!("network.{name}.first_moment"), &shape, moments.first.clone());
            file.insert(format!("network.{name}.second_moment"), &shape, moments.second.clone());
        }
        self.visibility.store(&mut file);
        let exposure = &self.model.exposure;
        if !exposure.names.is_empty() {
            file.insert("exposure.log_gain", &[exposure.names.len(), 3], exposure.log_gains.clone());
        }
        if let Some(medium) = &self.model.medium {
            medium.store(&mut file)?;
        }
        // Counts are far below 2²⁴, so f32 holds them exactly.
        let views = self.stats.views.iter().map(|&v| v as f32).collect();
        file.insert("density.gradient_sum", &[n], self.stats.gradient_sum.clone());
        file.insert("density.views", &[n], views);
        file.insert("density.max_radius", &[n], self.stats.max_radius.clone());
        file.metadata.insert("gaussians".into(), n.to_string());
        Ok(file)
    }

    fn restore(&mut self, path: &Path, mut state: TensorFile) -> Result<(), ReconstructError> {
        let n: usize = state.metadata_value(path, "gaussians")?;
        let mut parameters = GaussianParameters::zeros(n, &Layout::of(&self.model.config));
        for attribute in Attribute::ALL {
            let group = parameters.group_mut(attribute);
            let (name, size) = (attribute.name(), n * group.width);
            group.values = state.take(path, &format!("gaussians.{name}"), size)?;
            group.moments.first = state.take(path, &format!("gaussians.{name}.first_moment"), size)?;
            group.moments.second = state.take(path, &format!("gaussians.{name}.second_moment"), size)?;
        }
        if let Some(network) = &mut self.model.network {
            let parts = crate::model::network_parts_mut(network);
            for ((name, values), moments) in parts.into_iter().zip(&mut self.model.network_moments) {
                let size = values.len();
                *values = state.take(path, &format!("network.{name}"), size)?;
                moments.first = state.take(path, &format!("network.{name}.first_moment"), size)?;
                moments.second = state.take(path, &format!("network.{name}.second_moment"), size)?;
            }
        }
        let exposure = &mut self.model.exposure;
        let gains = exposure.names.len();
        if gains > 0 {
            exposure.log_gains = state.take(path, "exposure.log_gain", 3 * gains)?;
        }
        self.stats = DensityStats {
            gradient_sum: state.take(path, "density.gradient_sum", n)?,
            views: state.take(path, "density.views", n)?.iter().map(|&v| v as u32).collect(),
            max_radius: state.take(path, "density.max_radius", n)?,
        };
        self.visibility = VisibilityCache::restore(path, &mut state, n)?;
        let falloff = self.model.scene.falloff(&self.model.config);
        self.model.medium = MediumTerm::restore(path, &mut state, n, self.model.config.subsurface.surfels, falloff)?;
        self.model.parameters = parameters;
        self.model.match_residual_output();
        self.changed_here();
        Ok(())
    }

    fn profile(&self) -> Vec<(&'static str, f64)> {
        self.profile.parts.clone()
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        let v = &self.visibility;
        let mut all = self.counters.all().to_vec();
        all.extend([
            ("visibility look-ups", v.lookups),
            ("visibility traced", v.traced),
            ("visibility kept, nothing moved", v.kept),
            ("visibility prepared", v.built),
        ]);
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Covariance;

    #[test]
    fn a_nan_in_a_gradient_is_found_and_named() {
        let parameters =
            GaussianParameters::zeros(4, &Layout { covariance: Covariance::RotationScale, transfer: 3, codes: 0 });
        let mut gradients: Vec<Vec<f32>> = parameters.groups().iter().map(|g| vec![0.0; g.values.len()]).collect();
        assert!(check_gradients(&parameters, &gradients, 7).is_ok());
        gradients[Attribute::Normal as usize][7] = f32::NAN;
        let text = check_gradients(&parameters, &gradients, 7).unwrap_err().to_string();
        assert!(
            text.contains("step 7") && text.contains("`normal`") && text.contains("Gaussian 2, component 1"),
            "{text}"
        );
    }
}
