//! From noise to a picture: deterministic samplers, guidance, and noise that several pictures share.
use crate::error::{DiffusionError, Result};
use crate::noise::Noise;
use crate::parameterization::{Parameterization, combine};
use crate::schedule::{Level, Schedule};
use candle_core::{Device, Tensor};

/// Which timesteps of a schedule a short run visits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Spacing {
    /// Multiples of steps/n, plus 1: never the last timestep. The run ends at the first level of the schedule.
    Leading,
    /// Counted from the end, so that the last timestep is visited. The run ends without noise.
    Trailing,
}

/// One step of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Step {
    /// What the network is told.
    timestep: f64,
    from: Level,
    to: Level,
}

/// A deterministic run from noise to picture: DDIM with η 0, or Euler's method on straight lines.
///
/// ```
/// use diamond_diffusion::{Parameterization, Sampler, Schedule, Spacing};
/// let schedule = Schedule::stable_diffusion().with_zero_terminal_snr();
/// let sampler = Sampler::ddim(&schedule, 4, Spacing::Trailing, Parameterization::V)?;
/// assert_eq!(sampler.timesteps().collect::<Vec<_>>(), [999.0, 749.0, 499.0, 249.0]);
/// # Ok::<(), diamond_diffusion::DiffusionError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Sampler {
    steps: Vec<Step>,
    parameterization: Parameterization,
}

impl Sampler {
    /// DDIM in `steps` steps. ε-prediction is refused where a visited timestep has no signal.
    /// `[eq:ddim]`
    pub fn ddim(
        schedule: &Schedule,
        steps: usize,
        spacing: Spacing,
        parameterization: Parameterization,
    ) -> Result<Self> {
        let all = schedule.steps();
        if steps == 0 || steps > all {
            return Err(DiffusionError::setting("sampler steps", format!("1 to {all}"), steps));
        }
        if parameterization == Parameterization::Flow {
            return Err(DiffusionError::setting("parameterization", "epsilon, v or x0 for DDIM", "flow"));
        }
        let (timesteps, last): (Vec<usize>, Level) = match spacing {
            Spacing::Leading => {
                let ratio = all / steps;
                ((0..steps).rev().map(|i| (i * ratio + 1).min(all - 1)).collect(), schedule.level(0))
            }
            Spacing::Trailing => {
                let at = |i: usize| (all as f64 - i as f64 * all as f64 / steps as f64).round() as usize - 1;
                ((0..steps).map(at).collect(), Level::CLEAN)
            }
        };
        let next = timesteps.iter().skip(1).map(|t| schedule.level(*t)).chain([last]);
        let steps: Vec<Step> = timesteps
            .iter()
            .zip(next)
            .map(|(t, to)| Step { timestep: *t as f64, from: schedule.level(*t), to })
            .collect();
        for step in &steps {
            parameterization.recover(step.from)?;
        }
        Ok(Self { steps, parameterization })
    }

    /// Euler's method along the straight lines of a flow, in equal steps from time 1 (noise) to 0; the network is told time·1000.
    /// `[eq:euler-flow]`
    pub fn flow(steps: usize) -> Result<Self> {
        if steps == 0 {
            return Err(DiffusionError::setting("sampler steps", "at least 1", steps));
        }
        let time = |i: usize| 1.0 - i as f64 / steps as f64;
        let step = |i: usize| Step {
            timestep: 1000.0 * time(i),
            from: Level::of_flow(time(i)),
            to: Level::of_flow(time(i + 1)),
        };
        Ok(Self { steps: (0..steps).map(step).collect(), parameterization: Parameterization::Flow })
    }

    /// What the network is told at each step.
    pub fn timesteps(&self) -> impl Iterator<Item = f64> + '_ {
        self.steps.iter().map(|step| step.timestep)
    }

    /// Runs from `noise` (batch, …) to a picture. `predict` is given x_t and the timestep.
    pub fn sample(&self, noise: &Tensor, mut predict: impl FnMut(&Tensor, f64) -> Result<Tensor>) -> Result<Tensor> {
        let batch = noise.dim(0)?;
        let mut x = noise.clone();
        for step in &self.steps {
            let prediction = predict(&x, step.timestep)?;
            if prediction.dims() != x.dims() {
                return Err(DiffusionError::shape("prediction of a network", x.dims(), prediction.dims()));
            }
            let recovery = self.parameterization.recover(step.from)?;
            // signal·x₀ + noise·ε at the next level, both from x_t and the prediction.
            let weight = |x0: f64, epsilon: f64| step.to.signal * x0 + step.to.noise * epsilon;
            let of_x = weight(recovery.x0.0, recovery.epsilon.0);
            let of_prediction = weight(recovery.x0.1, recovery.epsilon.1);
            x = combine(&x, &prediction.detach(), &vec![(of_x, of_prediction); batch])?;
        }
        Ok(x)
    }
}

/// Classifier-free guidance: without + scale·(with − without) the condition. At scale 1 the second is not needed and not computed.
/// `[eq:guidance]`
pub fn guided(with: Tensor, scale: f64, without: impl FnOnce() -> Result<Tensor>) -> Result<Tensor> {
    if scale == 1.0 {
        return Ok(with);
    }
    let without = without()?;
    Ok((&without + ((with - &without)? * scale)?)?)
}

/// One draw of noise for all pictures of a batch: (batch, channels, height, width).
///
/// Views of one object, or lights of one view, that begin from the same noise agree better with each other. `key` names what is
/// shared.
pub fn shared_noise(
    seed: u64,
    key: &str,
    batch: usize,
    picture: (usize, usize, usize),
    device: &Device,
) -> Result<Tensor> {
    let (channels, height, width) = picture;
    let one = Noise::new(seed, key, 0).normal_tensor((1, channels, height, width), device)?;
    Ok(one.broadcast_as((batch, channels, height, width))?.contiguous()?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::DType;

    fn picture(name: &str) -> Tensor {
        Noise::new(8, name, 0).normal_tensor((2, 1, 3, 3), &Device::Cpu).unwrap().to_dtype(DType::F64).unwrap()
    }

    fn distance(a: &Tensor, b: &Tensor) -> f64 {
        (a - b).unwrap().abs().unwrap().max_all().unwrap().to_scalar().unwrap()
    }

    /// [eq:ddim]: a network that knows the answer gets there, whatever it predicts and however many steps there are.
    #[test]
    fn ddim_with_the_exact_prediction_recovers_the_picture() {
        let (x0, epsilon) = (picture("x0"), picture("noise"));
        let plain = Schedule::stable_diffusion();
        let zero = plain.with_zero_terminal_snr();
        for (schedule, parameterization, spacing, steps) in [
            (&zero, Parameterization::V, Spacing::Trailing, 4),
            (&zero, Parameterization::X0, Spacing::Trailing, 1),
            (&plain, Parameterization::Epsilon, Spacing::Leading, 50),
            (&plain, Parameterization::V, Spacing::Leading, 7),
        ] {
            let sampler = Sampler::ddim(schedule, steps, spacing, parameterization).unwrap();
            let first = sampler.steps[0].from;
            let start = combine(&x0, &epsilon, &[(first.signal, first.noise); 2]).unwrap();
            let out = sampler.sample(&start, |x, t| {
                let level = schedule.level(t as usize);
                // x_t lies on the line of x₀ and ε all the way.
                let on_line = combine(&x0, &epsilon, &[(level.signal, level.noise); 2])?;
                assert!(distance(x, &on_line) < 1e-9);
                combine(&x0, &epsilon, &[parameterization.target_weights(level); 2])
            });
            let last = if spacing == Spacing::Trailing { Level::CLEAN } else { schedule.level(0) };
            let expected = combine(&x0, &epsilon, &[(last.signal, last.noise); 2]).unwrap();
            assert!(distance(&out.unwrap(), &expected) < 1e-9, "{parameterization:?} {spacing:?}");
        }
        // A wrong prediction does not get there.
        let sampler = Sampler::ddim(&zero, 4, Spacing::Trailing, Parameterization::V).unwrap();
        let out = sampler.sample(&epsilon, |x, _| Ok(x.clone())).unwrap();
        assert!(distance(&out, &x0) > 0.1);
    }

    #[test]
    fn timesteps_and_refusals() {
        let s = Schedule::stable_diffusion();
        let leading = Sampler::ddim(&s, 50, Spacing::Leading, Parameterization::Epsilon).unwrap();
        let timesteps: Vec<f64> = leading.timesteps().collect();
        assert_eq!((timesteps.len(), timesteps[0], timesteps[49]), (50, 981.0, 1.0));
        let zero = s.with_zero_terminal_snr();
        let refused = Sampler::ddim(&zero, 4, Spacing::Trailing, Parameterization::Epsilon).unwrap_err();
        assert!(refused.to_string().contains("epsilon"));
        assert!(Sampler::ddim(&s, 0, Spacing::Leading, Parameterization::V).is_err());
        assert!(Sampler::ddim(&s, 1001, Spacing::Leading, Parameterization::V).is_err());
        assert!(Sampler::ddim(&s, 3, Spacing::Leading, Parameterization::Flow).is_err() && Sampler::flow(0).is_err());
        let wrong = leading.sample(&picture("x"), |x, _| Ok(x.narrow(0, 0, 1)?)).unwrap_err();
        assert!(wrong.to_string().contains("prediction"));
    }

    /// [eq:euler-flow]: a straight line is followed exactly.
    #[test]
    fn euler_follows_a_straight_line() {
        let (x0, epsilon) = (picture("x0"), picture("noise"));
        for steps in [1, 3, 10] {
            let sampler = Sampler::flow(steps).unwrap();
            assert_eq!(sampler.timesteps().next(), Some(1000.0));
            let out = sampler.sample(&epsilon, |_, _| Ok((&epsilon - &x0)?)).unwrap();
            assert!(distance(&out, &x0) < 1e-12);
        }
    }

    /// [eq:guidance]
    #[test]
    fn guidance_goes_from_without_through_with() {
        let (with, without) = (picture("with"), picture("without"));
        let none = guided(with.clone(), 1.0, || unreachable!("not needed at scale 1")).unwrap();
        assert_eq!(distance(&none, &with), 0.0);
        let zero = guided(with.clone(), 0.0, || Ok(without.clone())).unwrap();
        assert!(distance(&zero, &without) < 1e-15);
        let three = guided(with.clone(), 3.0, || Ok(without.clone())).unwrap();
        let expected = ((&with * 3.0).unwrap() - (&without * 2.0).unwrap()).unwrap();
        assert!(distance(&three, &expected) < 1e-12);
    }

    #[test]
    fn shared_noise_is_the_same_for_all_and_repeats() {
        let draw = |key: &str| shared_noise(1, key, 3, (2, 4, 4), &Device::Cpu).unwrap();
        let noise = draw("view 2").to_dtype(DType::F64).unwrap();
        assert_eq!(distance(&noise.get(0).unwrap(), &noise.get(2).unwrap()), 0.0);
        assert_eq!(distance(&noise, &draw("view 2").to_dtype(DType::F64).unwrap()), 0.0);
        assert!(distance(&noise, &draw("view 3").to_dtype(DType::F64).unwrap()) > 0.1);
    }
}
