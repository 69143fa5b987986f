//! AdamW with a limit on the gradient's length.
use crate::error::{DiffusionError, Result};
use crate::nn::Variables;
use candle_core::backprop::GradStore;
use candle_core::{DType, Tensor};
use std::collections::BTreeMap;

/// AdamW: running means of gradients and of their squares, both corrected for their beginning, and decay of the weights themselves.
/// `[eq:adamw]`
#[derive(Debug, Clone)]
pub struct AdamW {
    /// Memory of the mean and of the mean of squares.
    pub beta: (f64, f64),
    /// Added to the root of the mean of squares.
    pub eps: f64,
    /// Share of a weight that goes per step, times the rate.
    pub decay: f64,
    moments: BTreeMap<String, (Tensor, Tensor)>,
    steps: u64,
}

impl AdamW {
    /// With β (0.9, 0.999), ε 1e-8.
    pub fn new(decay: f64) -> Self {
        Self { beta: (0.9, 0.999), eps: 1e-8, decay, moments: BTreeMap::new(), steps: 0 }
    }

    /// Steps done.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// What must be kept to go on: mean and mean of squares of each weight.
    pub fn state(&self) -> impl Iterator<Item = (&str, &Tensor, &Tensor)> {
        self.moments.iter().map(|(name, (mean, square))| (name.as_str(), mean, square))
    }

    /// Goes on from what was kept.
    pub fn restore(&mut self, moments: BTreeMap<String, (Tensor, Tensor)>, steps: u64) {
        (self.moments, self.steps) = (moments, steps);
    }

    /// One step of all weights with the gradients' common length limited to `clip`; that length before it is returned.
    /// A weight without a gradient stays and keeps its means. A gradient that is not finite is an error, and nothing is moved.
    pub fn step(&mut self, variables: &Variables, gradients: &GradStore, rate: f64, clip: f64) -> Result<f64> {
        let mut squares = 0.0;
        for (_, var) in variables.vars() {
            if let Some(gradient) = gradients.get(var) {
                squares += gradient.to_dtype(DType::F64)?.sqr()?.sum_all()?.to_scalar::<f64>()?;
            }
        }
        let length = squares.sqrt();
        if !length.is_finite() {
            return Err(DiffusionError::NonFinite { what: format!("gradient of step {}", self.steps) });
        }
        let factor = if length > clip { clip / length } else { 1.0 };
        self.steps += 1;
        let (beta1, beta2) = self.beta;
        let correction = |beta: f64| 1.0 - libm::pow(beta, self.steps as f64);
        let (correct1, correct2) = (correction(beta1), correction(beta2));
        for (name, var) in variables.vars() {
            let Some(gradient) = gradients.get(var) else { continue };
            let gradient = (gradient.detach() * factor)?;
            let (mean, square) = match self.moments.remove(name) {
                Some(moments) => moments,
                None => (gradient.zeros_like()?, gradient.zeros_like()?),
            };
            let mean = ((mean * beta1)? + (&gradient * (1.0 - beta1))?)?;
            let square = ((square * beta2)? + (gradient.sqr()? * (1.0 - beta2))?)?;
            let direction = (&mean / correct1)?.div(&((&square / correct2)?.sqrt()? + self.eps)?)?;
            let kept = (var.as_tensor().detach() * (1.0 - rate * self.decay))?;
            var.set(&(kept - (direction * rate)?)?)?;
            self.moments.insert(name.to_owned(), (mean, square));
        }
        Ok(length)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{Init, Source, VariablesBuilder};

    /// [eq:adamw]: two steps of one weight by hand, the second with a limited gradient.
    #[test]
    fn two_steps_are_those_by_hand() {
        let builder = VariablesBuilder::new(Source::Seed(0)).dtype(DType::F64);
        let w = builder.root().weight("w", 1, Init::Ones).unwrap();
        let unused = builder.root().weight("unused", 1, Init::Ones).unwrap();
        let (variables, _) = builder.finish();
        let mut optimizer = AdamW::new(0.1);
        let (mut by_hand, mut mean, mut square) = (1.0f64, 0.0f64, 0.0f64);
        for (step, clip) in [(1, 10.0), (2, 0.5)] {
            let gradients = w.sqr().unwrap().sum_all().unwrap().backward().unwrap();
            let length = optimizer.step(&variables, &gradients, 0.01, clip).unwrap();
            assert!((length - 2.0 * by_hand).abs() < 1e-12);
            let g = (2.0 * by_hand).min(clip);
            mean = 0.9 * mean + 0.1 * g;
            square = 0.999 * square + 0.001 * g * g;
            let direction = mean / (1.0 - 0.9f64.powi(step)) / ((square / (1.0 - 0.999f64.powi(step))).sqrt() + 1e-8);
            by_hand = by_hand * (1.0 - 0.01 * 0.1) - 0.01 * direction;
            assert!((w.to_vec1::<f64>().unwrap()[0] - by_hand).abs() < 1e-12);
        }
        assert_eq!(unused.to_vec1::<f64>().unwrap(), [1.0]);
        let infinite = (w.recip().unwrap() * f64::INFINITY).unwrap().sum_all().unwrap().backward().unwrap();
        let before = w.to_vec1::<f64>().unwrap();
        assert!(optimizer.step(&variables, &infinite, 0.01, 1.0).unwrap_err().to_string().contains("step 2"));
        assert_eq!(w.to_vec1::<f64>().unwrap(), before);
    }
}
