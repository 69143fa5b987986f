//! What changes with the step: learning rates, warm-ups, unfreezing, rounds of density control.
use crate::{Config, DensityStrategy};

/// Everything that depends on the step number, for one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepPlan {
    /// Learning rate of the means, × scene extent still to come.
    pub mean_rate: f32,
    /// Factor on the rates of all other Gaussian attributes.
    pub attribute_factor: f32,
    /// Learning rate of the networks.
    pub network_rate: f32,
    /// Factor on the rate of photographs' gains: 0 outside their window, in it as the Gaussians' attributes.
    pub exposure_factor: f32,
    /// Added to learned incident light.
    pub incident_offset: f32,
    /// Whether roughness is still the constant 0.5.
    pub roughness_frozen: bool,
    /// Whether density statistics are collected.
    pub collect_density: bool,
    /// Whether a round of density control follows this step.
    pub densify: bool,
    /// Whether a round of density control may add Gaussians.
    pub grow: bool,
    /// Whether a round of density control drops too large Gaussians.
    pub prune_large: bool,
    /// Whether opacities are reset after this step.
    pub reset_opacity: bool,
    /// Factor on the rate of normals.
    pub normal_factor: f32,
    /// Factor on the rates of materials.
    pub material_factor: f32,
    /// Whether surface and medium are fitted before this step.
    pub fit_medium: bool,
    /// Factor on the weights of geometric consistency: as many steps as this one stands for, 0 where it stands for none.
    pub consistency: f32,
    /// Factor on the weight of photometric stereo's normals: from 1 to 0 at `photometric.until`.
    pub photometric: f32,
}

/// From so many photographs on materials learn at [`Subsurface::material_rate`](crate::Subsurface::material_rate). With fewer the rate falls with their root, as what
/// a Gaussian can know of itself beside the noise of the pixels that see it does (decision 0030 has the figures for 9 and 384).
const MANY_PHOTOGRAPHS: f32 = 400.0;

/// Geometric interpolation from `a` to `b`; linear where one of them is 0.
fn log_lerp(a: f32, b: f32, t: f32) -> f32 {
    let t = t.clamp(0.0, 1.0);
    if a > 0.0 && b > 0.0 { libm::expf(libm::logf(a) * (1.0 - t) + libm::logf(b) * t) } else { a * (1.0 - t) + b * t }
}

impl StepPlan {
    /// The plan of `step` (0-based) under `config`, where a medium that it names has been found and photographs are many.
    pub fn new(config: &Config, step: u64) -> Self {
        Self::of(config, step, Some(usize::MAX))
    }

    /// The plan of `step` for a model that has a medium, learned from so many photographs, or, although `config` may name one, has none: then
    /// everything learns at its own rate.
    pub fn of(config: &Config, step: u64, medium: Option<usize>) -> Self {
        let fraction = step as f32 / config.steps as f32;
        let r = &config.rates;
        let s = &config.shading;
        let mean_progress = if r.mean_decay > 0.0 { fraction / r.mean_decay } else { 1.0 };
        let incident_offset = if s.incident_warm_up == 0.0 || s.incident_warm_up_fraction <= 0.0 {
            0.0
        } else {
            let x = fraction / s.incident_warm_up_fraction;
            match x {
                x if x < 1.0 => s.incident_warm_up * x,
                x if x < 2.0 && !s.incident_warm_up_drop => s.incident_warm_up * (2.0 - x),
                _ => 0.0,
            }
        };
        let d = &config.density;
        let at = |f: f32| (f as f64 * config.steps as f64).round() as u64;
        let (from, until) = (at(d.from), at(d.until));
        let done = step + 1;
        let frozen = fraction >= d.freeze_count;
        let active = done <= until
            && match d.strategy {
                DensityStrategy::Adaptive => !frozen,
                DensityStrategy::Mcmc => true,
                DensityStrategy::None => false,
            };
        let adaptive = active && d.strategy == DensityStrategy::Adaptive;
        let reset = at(d.reset_every);
        let c = &config.consistency;
        let first_round = match d.strategy {
            DensityStrategy::None => 0,
            _ => (from / d.every_steps + 1) * d.every_steps,
        };
        let m = &config.subsurface;
        let photographs = medium.filter(|_| m.model.has_medium() && step >= at(m.from));
        let with_medium = photographs.is_some();
        let (shape_rate, normal_rate, material_rate) = match photographs {
            Some(n) => (m.shape_rate, m.normal_rate, m.material_rate * (n as f32 / MANY_PHOTOGRAPHS).sqrt().min(1.0)),
            None => (1.0, 1.0, 1.0),
        };
        let mut fits = std::iter::once(&m.from).chain(&m.refit);
        let comparing = done > at(c.from).max(first_round) && done <= at(c.until) && done.is_multiple_of(c.every_steps);
        Self {
            mean_rate: log_lerp(r.mean, r.mean_final, mean_progress) * shape_rate,
            attribute_factor: log_lerp(1.0, r.attribute_final, fraction) * shape_rate,
            normal_factor: log_lerp(1.0, r.attribute_final, fraction) * normal_rate,
            material_factor: log_lerp(1.0, r.attribute_final, fraction) * material_rate,
            exposure_factor: match (config.exposure.from..config.exposure.until).contains(&fraction) {
                true => log_lerp(1.0, r.attribute_final, fraction),
                false => 0.0,
            },
            network_rate: log_lerp(r.network, r.network_final, fraction),
            incident_offset,
            roughness_frozen: fraction < s.roughness_unfreeze,
            collect_density: adaptive,
            densify: active && done > from && done.is_multiple_of(d.every_steps),
            grow: !frozen,
            prune_large: fraction >= d.large_from,
            fit_medium: m.model.has_medium() && fits.any(|f| at(*f) == step),
            photometric: match config.photometric.until {
                until if until > 0.0 => (1.0 - fraction / until).max(0.0),
                _ => 0.0,
            },
            consistency: if comparing { c.every_steps as f32 } else { 0.0 },
            reset_opacity: adaptive
                && reset > 0
                && done.is_multiple_of(reset)
                && done < until
                && !(with_medium && m.seeds > 0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn without_a_medium() -> Config {
        let mut config = Config::preset("resolved").unwrap();
        config.subsurface.model = crate::SubsurfaceModel::Mlp;
        config
    }

    #[test]
    fn rates_fall_and_rounds_end() {
        let mut config = without_a_medium();
        config.steps = 1000;
        config.rates.mean_decay = 1.0;
        let first = StepPlan::new(&config, 0);
        let last = StepPlan::new(&config, 1000);
        assert!((first.mean_rate - config.rates.mean).abs() < 1e-9);
        assert!((last.mean_rate - config.rates.mean_final).abs() < 1e-9);
        let rounds = (0..1000).filter(|&s| StepPlan::new(&config, s).densify).count() as u64;
        let expected = (1..=1000u64)
            .filter(|s| s % config.density.every_steps == 0)
            .filter(|&s| s as f32 > config.density.from * 1000.0 && s as f32 <= config.density.until * 1000.0)
            .count() as u64;
        assert_eq!(rounds, expected);
        assert!(StepPlan::new(&config, 10).roughness_frozen && !StepPlan::new(&config, 500).roughness_frozen);
    }

    /// A run that found no medium learns as one that asked for none.
    #[test]
    fn rates_fall_only_beside_a_medium() {
        let (mut asked, without) = (Config::preset("resolved").unwrap(), without_a_medium());
        asked.subsurface.from = 0.1;
        for step in [0, 600, 1500, 9999] {
            let plain = StepPlan::new(&without, step);
            assert_eq!(StepPlan { fit_medium: false, ..StepPlan::of(&asked, step, None) }, plain);
            assert_eq!(StepPlan::of(&without, step, Some(9)), plain);
            let planned = StepPlan::new(&asked, step);
            assert_eq!(planned.normal_factor < plain.normal_factor, step >= 1000, "{step}");
            let few = StepPlan::of(&asked, step, Some(4));
            let ratio = few.material_factor / planned.material_factor;
            assert!((ratio - if step < 1000 { 1.0 } else { 0.1 }).abs() < 1e-6, "{step}: {ratio}");
            assert_eq!(StepPlan { material_factor: planned.material_factor, ..few }, planned);
        }
    }

    #[test]
    fn gains_have_a_window() {
        let mut config = Config::preset("resolved").unwrap();
        config.steps = 1000;
        let moved: Vec<u64> = (0..1000).filter(|s| StepPlan::new(&config, *s).exposure_factor > 0.0).collect();
        assert_eq!((moved[0], moved.len(), moved.last()), (100, 300, Some(&399)));
    }

    #[test]
    fn a_frozen_count_stops_all_but_relocation() {
        let mut config = without_a_medium();
        config.steps = 1000;
        config.density.until = 1.0;
        config.density.freeze_count = 0.5;
        let rounds = |c: &Config, from: u64| {
            (from..from + 500).map(|s| StepPlan::new(c, s)).fold([0, 0, 0], |[a, b, c], p| {
                [a + u32::from(p.densify), b + u32::from(p.densify && p.grow), c + u32::from(p.reset_opacity)]
            })
        };
        assert!(rounds(&config, 0).iter().all(|n| *n > 0));
        assert_eq!(rounds(&config, 500), [0, 0, 0]);
        config.density.strategy = DensityStrategy::Mcmc;
        let [moves, grows, resets] = rounds(&config, 500);
        assert!(moves > 0 && grows == 0 && resets == 0);
        config.density.strategy = DensityStrategy::None;
        assert_eq!(rounds(&config, 0), [0, 0, 0]);
    }

    #[test]
    fn views_are_compared_after_the_first_round_and_with_the_weight_of_all_steps() {
        let mut config = without_a_medium();
        config.steps = 1000;
        (config.consistency.every_steps, config.consistency.until) = (5, 0.9);
        let factors = |c: &Config| (0..1000).map(|s| StepPlan::new(c, s).consistency).collect::<Vec<f32>>();
        let first_round = (0..1000u16).find(|&s| StepPlan::new(&config, s.into()).densify).unwrap().into();
        let (all, first_round): (_, usize) = (factors(&config), first_round);
        assert!(all[..=first_round].iter().all(|f| *f == 0.0) && all[900..].iter().all(|f| *f == 0.0));
        assert_eq!(all.iter().sum::<f32>(), (900 - first_round - 1) as f32);
        config.density.strategy = DensityStrategy::None;
        assert_eq!(factors(&config).iter().sum::<f32>(), 900.0);
        config.consistency.from = 0.5;
        assert_eq!(factors(&config).iter().sum::<f32>(), 400.0);
    }

    #[test]
    fn the_warm_up_ramps_down_or_drops() {
        let mut config = Config::preset("resolved").unwrap();
        config.steps = 100;
        config.shading.incident_warm_up = 4.0;
        config.shading.incident_warm_up_fraction = 0.1;
        let offset = |c: &Config, s| StepPlan::new(c, s).incident_offset;
        assert!((offset(&config, 5) - 2.0).abs() < 1e-5 && (offset(&config, 15) - 2.0).abs() < 1e-5);
        config.shading.incident_warm_up_drop = true;
        assert_eq!(offset(&config, 11), 0.0);
    }
}
