//! The linear layer.
use super::variables::{Init, Scope};
use crate::error::{DiffusionError, Result};
use candle_core::Tensor;

/// y = x·Wᵀ + b over the last dimension.
#[derive(Debug, Clone)]
pub struct Linear {
    weight: Tensor,
    bias: Option<Tensor>,
}

impl Linear {
    /// With a bias.
    pub fn new(scope: &Scope<'_>, inputs: usize, outputs: usize) -> Result<Self> {
        let bias = Some(scope.weight("bias", outputs, Init::FanIn(inputs))?);
        Ok(Self { bias, ..Self::without_bias(scope, inputs, outputs)? })
    }

    /// Without a bias.
    pub fn without_bias(scope: &Scope<'_>, inputs: usize, outputs: usize) -> Result<Self> {
        Ok(Self { weight: scope.weight("weight", (outputs, inputs), Init::FanIn(inputs))?, bias: None })
    }

    /// With weight and bias zero, so that the layer adds nothing before it has learned something.
    pub fn zeros(scope: &Scope<'_>, inputs: usize, outputs: usize) -> Result<Self> {
        let bias = Some(scope.weight("bias", outputs, Init::Zeros)?);
        Ok(Self { weight: scope.weight("weight", (outputs, inputs), Init::Zeros)?, bias })
    }

    /// `x` is (…, inputs), the result (…, outputs).
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let (outputs, inputs) = self.weight.dims2()?;
        let Some((&last, outer)) = x.dims().split_last().filter(|(last, _)| **last == inputs) else {
            return Err(DiffusionError::shape("input of a linear layer", format!("[…, {inputs}]"), x.dims()));
        };
        let rows = x.elem_count() / last.max(1);
        let y = x.reshape((rows, inputs))?.matmul(&self.weight.t()?)?;
        let y = match &self.bias {
            Some(bias) => y.broadcast_add(bias)?,
            None => y,
        };
        Ok(y.reshape([outer, &[outputs]].concat())?)
    }
}

#[cfg(test)]
mod tests {
    use super::super::variables::{Source, VariablesBuilder};
    use super::*;
    use crate::gradient_check::{check_layer, variable};
    use candle_core::DType;

    #[test]
    fn value_gradient_and_a_wrong_shape() {
        let builder = VariablesBuilder::new(Source::Seed(1)).dtype(DType::F64);
        let layer = Linear::new(&builder.root(), 3, 4).unwrap();
        let (variables, _) = builder.finish();
        let x = variable("x", &[2, 5, 3]);
        check_layer("linear", &variables, &[&x], || Ok(layer.forward(&x).unwrap()));
        let y = layer.forward(&x).unwrap().to_vec3::<f64>().unwrap();
        let (w, b) = (layer.weight.to_vec2::<f64>().unwrap(), layer.bias.as_ref().unwrap().to_vec1::<f64>().unwrap());
        let x_values = x.to_vec3::<f64>().unwrap();
        let by_hand = b[2] + (0..3).map(|i| w[2][i] * x_values[1][4][i]).sum::<f64>();
        assert!((y[1][4][2] - by_hand).abs() < 1e-12);
        assert!(layer.forward(&variable("y", &[2, 4])).unwrap_err().to_string().contains("expected shape"));
    }
}
