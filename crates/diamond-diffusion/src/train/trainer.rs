//! Steps of training that can be interrupted: rates, averaged weights, checkpoints.
use super::optimizer::AdamW;
use crate::error::{DiffusionError, Result};
use crate::nn::Variables;
use crate::weights::{NumberType, WeightsHeader, read_weights, write_weights};
use candle_core::Tensor;
use std::collections::BTreeMap;
use std::path::Path;

/// Prefixes of what a checkpoint holds.
const PARTS: [&str; 4] = ["weight.", "average.", "mean.", "square."];

/// How training goes.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainSettings {
    /// Seed of everything that is drawn.
    pub seed: u64,
    /// Steps in all; the rate falls as a cosine until then.
    pub steps: u64,
    /// Steps over which the rate rises.
    pub warm_up: u64,
    /// Largest rate.
    pub rate: f64,
    /// Decay of weights.
    pub decay: f64,
    /// Largest length of the gradient.
    pub clip: f64,
    /// Memory of the averaged weights, reached gradually.
    pub average: f64,
}

impl Default for TrainSettings {
    fn default() -> Self {
        Self { seed: 0, steps: 5000, warm_up: 100, rate: 1e-4, decay: 0.01, clip: 1.0, average: 0.999 }
    }
}

impl TrainSettings {
    /// Whether the numbers make sense.
    pub fn validate(&self) -> Result<()> {
        let checks: [(&'static str, f64, bool, &str); 5] = [
            ("rate", self.rate, self.rate > 0.0 && self.rate <= 1.0, "in (0, 1]"),
            ("decay", self.decay, (0.0..1.0).contains(&self.decay), "in [0, 1)"),
            ("clip", self.clip, self.clip > 0.0, "above 0"),
            ("average", self.average, (0.0..1.0).contains(&self.average), "in [0, 1)"),
            ("steps", self.steps as f64, self.steps > 0, "at least 1"),
        ];
        match checks.into_iter().find(|check| !check.2) {
            Some((what, found, _, expected)) => Err(DiffusionError::setting(what, expected, found)),
            None => Ok(()),
        }
    }

    /// The rate at a step: a line up, then a cosine down to nothing.
    /// `[eq:training-rate]`
    pub fn rate_at(&self, step: u64) -> f64 {
        if step < self.warm_up {
            return self.rate * (step + 1) as f64 / self.warm_up as f64;
        }
        let rest = self.steps.saturating_sub(self.warm_up).max(1) as f64;
        let done = ((step - self.warm_up) as f64 / rest).min(1.0);
        self.rate * 0.5 * (1.0 + libm::cos(std::f64::consts::PI * done))
    }

    /// Memory of the averaged weights at a step: short at first, so that the average forgets the beginning.
    /// `[eq:average]`
    pub fn average_at(&self, step: u64) -> f64 {
        ((1 + step) as f64 / (10 + step) as f64).min(self.average)
    }
}

/// What a step did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepReport {
    /// Steps done, with this one.
    pub step: u64,
    /// The objective before the step.
    pub loss: f64,
    /// Length of the gradient before it was limited.
    pub gradient: f64,
    /// The rate.
    pub rate: f64,
}

/// A model in training. What a step draws must depend on (seed, step) alone: then a run that is resumed from a checkpoint
/// goes on with the bits of one that was not interrupted (on the CPU).
#[derive(Debug)]
pub struct Trainer {
    settings: TrainSettings,
    variables: Variables,
    optimizer: AdamW,
    averages: BTreeMap<String, Tensor>,
    step: u64,
}

impl Trainer {
    /// At the beginning.
    pub fn new(variables: Variables, settings: TrainSettings) -> Result<Self> {
        settings.validate()?;
        let averages = variables.vars().map(|(name, var)| Ok((name.to_owned(), var.as_tensor().copy()?.detach())));
        let averages = averages.collect::<Result<_>>()?;
        Ok(Self { settings, variables, optimizer: AdamW::new(settings.decay), averages, step: 0 })
    }

    /// The weights in training.
    pub fn variables(&self) -> &Variables {
        &self.variables
    }

    /// The averaged weights, which are the result.
    pub fn averages(&self) -> impl Iterator<Item = (&str, &Tensor)> {
        self.averages.iter().map(|(name, tensor)| (name.as_str(), tensor))
    }

    /// Steps done.
    pub fn step_number(&self) -> u64 {
        self.step
    }

    /// One step down `loss`, which is given the step's number. A loss or gradient that is not finite is an error, and nothing moves.
    pub fn step(&mut self, loss: impl FnOnce(u64) -> Result<Tensor>) -> Result<StepReport> {
        let loss = loss(self.step)?;
        let value = loss.to_dtype(candle_core::DType::F64)?.to_scalar::<f64>()?;
        if !value.is_finite() {
            return Err(DiffusionError::NonFinite { what: format!("objective of step {}", self.step) });
        }
        let gradients = loss.backward()?;
        let rate = self.settings.rate_at(self.step);
        let gradient = self.optimizer.step(&self.variables, &gradients, rate, self.settings.clip)?;
        let memory = self.settings.average_at(self.step);
        for (name, var) in self.variables.vars() {
            if let Some(average) = self.averages.get_mut(name) {
                *average = ((&*average * memory)? + (var.as_tensor().detach() * (1.0 - memory))?)?;
            }
        }
        self.step += 1;
        Ok(StepReport { step: self.step, loss: value, gradient, rate })
    }

    /// Writes everything that is needed to go on: weights, averages, the optimiser's means, in `f32`.
    pub fn save(&self, path: &Path) -> Result<()> {
        let [weight, average, mean, square] = PARTS;
        let mut tensors: BTreeMap<String, Tensor> = BTreeMap::new();
        tensors.extend(self.variables.vars().map(|(name, var)| (format!("{weight}{name}"), var.as_tensor().clone())));
        tensors.extend(self.averages.iter().map(|(name, tensor)| (format!("{average}{name}"), tensor.clone())));
        for (name, first, second) in self.optimizer.state() {
            tensors.insert(format!("{mean}{name}"), first.clone());
            tensors.insert(format!("{square}{name}"), second.clone());
        }
        let note = format!("step {} of {}, seed {}", self.step, self.settings.steps, self.settings.seed);
        write_weights(path, tensors.iter().map(|(name, tensor)| (name.as_str(), tensor)), NumberType::F32, &note)
    }

    /// Goes on from a checkpoint of the same model and settings.
    pub fn resume(variables: Variables, settings: TrainSettings, path: &Path) -> Result<Self> {
        let wrong = |problem: String| DiffusionError::Weights { origin: path.display().to_string(), problem };
        let header = WeightsHeader::read(path)?;
        let note = header.metadata.get("note").map(String::as_str).unwrap_or_default();
        let step = note.strip_prefix("step ").and_then(|rest| rest.split(' ').next()?.parse::<u64>().ok());
        let step = step.ok_or_else(|| wrong("no checkpoint of a training run".into()))?;
        let expected = format!("step {step} of {}, seed {}", settings.steps, settings.seed);
        if note != expected {
            return Err(wrong(format!("a checkpoint of other settings: expected \"{expected}\", found \"{note}\"")));
        }
        let mut tensors = read_weights(path)?;
        let mut trainer = Self::new(variables, settings)?;
        let mut moments = BTreeMap::new();
        for (name, var) in trainer.variables.vars() {
            let mut take = |part: &str| {
                let tensor = tensors.remove(&format!("{part}{name}"));
                let found = tensor.as_ref().map(|tensor| tensor.dims().to_vec());
                match tensor.filter(|tensor| tensor.dims() == var.dims()) {
                    Some(tensor) => Ok(tensor.to_dtype(var.dtype())?.to_device(var.device())?),
                    None => Err(wrong(format!("{part}{name}: expected {:?}, found {found:?}", var.dims()))),
                }
            };
            var.set(&take(PARTS[0])?)?;
            trainer.averages.insert(name.to_owned(), take(PARTS[1])?);
            // A weight that has had no gradient has no means.
            if header.tensors.contains_key(&format!("{}{name}", PARTS[2])) {
                moments.insert(name.to_owned(), (take(PARTS[2])?, take(PARTS[3])?));
            }
        }
        if let Some(name) = tensors.keys().next() {
            return Err(wrong(format!("{name}: the model has no such weight")));
        }
        trainer.optimizer.restore(moments, step);
        trainer.step = step;
        Ok(trainer)
    }
}
