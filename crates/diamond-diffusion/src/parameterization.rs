//! What a network predicts, and how picture and noise follow from it.
use crate::error::Result;
use crate::schedule::Level;
use candle_core::{Tensor, bail};

/// What a network predicts about x_t = signal·x₀ + noise·ε.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Parameterization {
    /// The noise ε. Says nothing where there is no signal.
    Epsilon,
    /// The velocity signal·ε − noise·x₀.
    V,
    /// The picture x₀. Says nothing about ε where there is no noise.
    X0,
    /// The direction ε − x₀ of a straight line (levels of [`Level::of_flow`]).
    Flow,
}

/// x₀ or ε as a weighted sum of x_t and the prediction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Recovery {
    /// Weights of (x_t, prediction) for x₀.
    pub x0: (f64, f64),
    /// Weights of (x_t, prediction) for ε.
    pub epsilon: (f64, f64),
}

impl Parameterization {
    /// Weights of (x₀, ε) in what the network should say.
    /// `[eq:parameterization]`
    pub fn target_weights(self, level: Level) -> (f64, f64) {
        match self {
            Self::Epsilon => (0.0, 1.0),
            Self::V => (-level.noise, level.signal),
            Self::X0 => (1.0, 0.0),
            Self::Flow => (-1.0, 1.0),
        }
    }

    /// How x₀ and ε follow from x_t and the prediction; an error where they do not: ε-prediction without signal.
    /// `[eq:parameterization]`
    pub fn recover(self, level: Level) -> Result<Recovery> {
        let Level { signal, noise } = level;
        Ok(match self {
            Self::Epsilon if signal == 0.0 => {
                return Err(crate::DiffusionError::setting(
                    "parameterization",
                    "v or x0 on a schedule that ends without signal",
                    "epsilon",
                ));
            }
            Self::Epsilon => Recovery { x0: (1.0 / signal, -noise / signal), epsilon: (0.0, 1.0) },
            Self::V => Recovery { x0: (signal, -noise), epsilon: (noise, signal) },
            // Without noise any ε gives the same x_t: zero is taken.
            Self::X0 if noise == 0.0 => Recovery { x0: (0.0, 1.0), epsilon: (0.0, 0.0) },
            Self::X0 => Recovery { x0: (0.0, 1.0), epsilon: (1.0 / noise, -signal / noise) },
            Self::Flow => Recovery { x0: (1.0, -noise), epsilon: (1.0, signal) },
        })
    }
}

/// a·x + b·y with one pair of weights for each picture of the batch.
pub fn combine(x: &Tensor, y: &Tensor, weights: &[(f64, f64)]) -> Result<Tensor> {
    if x.dims() != y.dims() || x.dim(0)? != weights.len() {
        let weights = weights.len();
        return Err(candle_core::Error::Msg(format!("{weights} weights for {:?} and {:?}", x.dims(), y.dims())).into());
    }
    let column = |values: Vec<f64>| -> candle_core::Result<Tensor> {
        let mut shape = vec![1; x.rank()];
        let Some(first) = shape.first_mut() else { bail!("expected pictures, found a number") };
        *first = values.len();
        Tensor::from_vec(values, shape, &candle_core::Device::Cpu)?.to_dtype(x.dtype())?.to_device(x.device())
    };
    let a = x.broadcast_mul(&column(weights.iter().map(|w| w.0).collect())?)?;
    let b = y.broadcast_mul(&column(weights.iter().map(|w| w.1).collect())?)?;
    Ok((a + b)?)
}

/// Noisy pictures signal·x₀ + noise·ε.
pub fn add_noise(x0: &Tensor, epsilon: &Tensor, levels: &[Level]) -> Result<Tensor> {
    combine(x0, epsilon, &levels.iter().map(|l| (l.signal, l.noise)).collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// [eq:parameterization]: what was mixed comes out again, whatever is predicted.
    #[test]
    fn the_exact_prediction_recovers_picture_and_noise() {
        for alpha_bar in [1.0, 0.9, 0.3, 1e-3, 0.0] {
            let preserving = Level::from_alpha_bar(alpha_bar);
            for parameterization in
                [Parameterization::Epsilon, Parameterization::V, Parameterization::X0, Parameterization::Flow]
            {
                let flow = parameterization == Parameterization::Flow;
                let level = if flow { Level::of_flow(1.0 - alpha_bar) } else { preserving };
                let (x0, epsilon) = (0.7, -1.3);
                let x = level.signal * x0 + level.noise * epsilon;
                let target = parameterization.target_weights(level);
                let prediction = target.0 * x0 + target.1 * epsilon;
                let Ok(recovery) = parameterization.recover(level) else {
                    assert!(parameterization == Parameterization::Epsilon && alpha_bar == 0.0);
                    continue;
                };
                assert!((recovery.x0.0 * x + recovery.x0.1 * prediction - x0).abs() < 1e-12);
                if level.noise > 0.0 || flow {
                    assert!((recovery.epsilon.0 * x + recovery.epsilon.1 * prediction - epsilon).abs() < 1e-12);
                }
            }
        }
    }

    #[test]
    fn each_picture_of_a_batch_has_its_own_weights() {
        let device = candle_core::Device::Cpu;
        let x = Tensor::new(&[[1.0f32, 2.0], [3.0, 4.0]], &device).unwrap();
        let y = Tensor::new(&[[10.0f32, 20.0], [30.0, 40.0]], &device).unwrap();
        let sum = combine(&x, &y, &[(1.0, 0.5), (2.0, 0.0)]).unwrap().to_vec2::<f32>().unwrap();
        assert_eq!(sum, [[6.0, 12.0], [6.0, 8.0]]);
        assert!(combine(&x, &y, &[(1.0, 1.0)]).is_err());
    }
}
