//! A timestep as numbers that a network can read.
use super::activation::silu;
use super::linear::Linear;
use super::variables::Scope;
use crate::error::Result;
use candle_core::{DType, Device, Tensor};

/// The longest wavelength is 2π times this.
const LONGEST: f64 = 10_000.0;

/// cos(t·f) for all frequencies, then sin(t·f), f = 10000^(−i/half): (batch, channels), one timestep per picture.
/// `[eq:timestep-embedding]`
pub fn timestep_embedding(timesteps: &[f32], channels: usize, dtype: DType, device: &Device) -> Result<Tensor> {
    let half = channels / 2;
    let mut values = Vec::with_capacity(timesteps.len() * channels);
    for t in timesteps {
        let angle = |i: usize| f64::from(*t) * libm::exp(-libm::log(LONGEST) * i as f64 / half as f64);
        values.extend((0..half).map(|i| libm::cos(angle(i))));
        values.extend((0..half).map(|i| libm::sin(angle(i))));
        values.extend((2 * half..channels).map(|_| 0.0));
    }
    let embedding = Tensor::from_vec(values, (timesteps.len(), channels), &Device::Cpu)?;
    Ok(embedding.to_dtype(dtype)?.to_device(device)?)
}

/// The two linear layers behind [`timestep_embedding`]: `linear_1`, SiLU, `linear_2`.
#[derive(Debug, Clone)]
pub struct TimeEmbedding {
    linear_1: Linear,
    linear_2: Linear,
}

impl TimeEmbedding {
    /// From `channels` to `embedding` numbers.
    pub fn new(scope: &Scope<'_>, channels: usize, embedding: usize) -> Result<Self> {
        let linear_1 = Linear::new(&scope.at("linear_1"), channels, embedding)?;
        Ok(Self { linear_1, linear_2: Linear::new(&scope.at("linear_2"), embedding, embedding)? })
    }

    /// (batch, channels) to (batch, embedding).
    pub fn forward(&self, embedding: &Tensor) -> Result<Tensor> {
        self.linear_2.forward(&silu(&self.linear_1.forward(embedding)?)?)
    }
}

#[cfg(test)]
mod tests {
    use super::super::variables::{Source, VariablesBuilder};
    use super::*;
    use crate::gradient_check::{check_layer, variable};

    /// [eq:timestep-embedding]: cosines first, a timestep of its own for each picture.
    #[test]
    fn the_embedding_has_the_values_by_hand() {
        let e = timestep_embedding(&[0.0, 3.0], 4, DType::F64, &Device::Cpu).unwrap().to_vec2::<f64>().unwrap();
        assert_eq!(e[0], [1.0, 1.0, 0.0, 0.0]);
        let by_hand = [3f64.cos(), 0.03f64.cos(), 3f64.sin(), 0.03f64.sin()];
        assert!(e[1].iter().zip(by_hand).all(|(a, b)| (a - b).abs() < 1e-12), "{e:?}");
    }

    #[test]
    fn the_layers_have_gradients() {
        let builder = VariablesBuilder::new(Source::Seed(3)).dtype(DType::F64);
        let layer = TimeEmbedding::new(&builder.root(), 4, 6).unwrap();
        let (variables, _) = builder.finish();
        let x = variable("x", &[2, 4]);
        check_layer("time embedding", &variables, &[&x], || Ok(layer.forward(&x).unwrap()));
    }
}
