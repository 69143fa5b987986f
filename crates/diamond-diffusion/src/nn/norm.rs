//! Normalisations: of groups of channels and of the last dimension.
use super::activation::silu;
use super::group_norm_op::GroupNormalisation;
use super::variables::{Init, Scope};
use crate::error::{DiffusionError, Result};
use candle_core::{D, Tensor};

/// Groups of channels normalised to mean 0 and variance 1 over channels of the group and pixels, then scaled and shifted per
/// channel; with `with_silu`, x·σ(x) of that. `x` is (batch, channels, …), `weight` and `bias` (channels).
/// `[eq:group-norm]`
pub fn group_norm(
    x: &Tensor,
    weight: &Tensor,
    bias: &Tensor,
    groups: usize,
    eps: f64,
    with_silu: bool,
) -> candle_core::Result<Tensor> {
    if x.device().is_cpu() {
        let operation = GroupNormalisation { groups, eps, silu: with_silu };
        x.contiguous()?.apply_op3(&weight.contiguous()?, &bias.contiguous()?, operation)
    } else {
        composed_group_norm(x, weight, bias, groups, eps, with_silu)
    }
}

/// [`group_norm`] of candle's operations.
fn composed_group_norm(
    x: &Tensor,
    weight: &Tensor,
    bias: &Tensor,
    groups: usize,
    eps: f64,
    with_silu: bool,
) -> candle_core::Result<Tensor> {
    let batch = x.dim(0)?;
    let grouped = x.reshape((batch * groups, ()))?;
    let mut per_channel = vec![1; x.rank()];
    per_channel[1] = x.dim(1)?;
    let normal = normalised(&grouped, eps)?.reshape(x.shape())?;
    let y = normal.broadcast_mul(&weight.reshape(per_channel.as_slice())?)?;
    let y = y.broadcast_add(&bias.reshape(per_channel.as_slice())?)?;
    if with_silu { silu(&y) } else { Ok(y) }
}

/// The last dimension with mean 0 and variance 1.
fn normalised(x: &Tensor, eps: f64) -> candle_core::Result<Tensor> {
    let centred = x.broadcast_sub(&x.mean_keepdim(D::Minus1)?)?;
    let variance = centred.sqr()?.mean_keepdim(D::Minus1)?;
    centred.broadcast_div(&(variance + eps)?.sqrt()?)
}

/// The last dimension normalised to mean 0 and variance 1, then scaled and shifted per entry.
pub fn layer_norm(x: &Tensor, weight: &Tensor, bias: &Tensor, eps: f64) -> candle_core::Result<Tensor> {
    normalised(x, eps)?.broadcast_mul(weight)?.broadcast_add(bias)
}

/// [`group_norm`] as a layer.
#[derive(Debug, Clone)]
pub struct GroupNorm {
    weight: Tensor,
    bias: Tensor,
    groups: usize,
    eps: f64,
}

impl GroupNorm {
    /// `groups` must divide `channels`.
    pub fn new(scope: &Scope<'_>, channels: usize, groups: usize, eps: f64) -> Result<Self> {
        if groups == 0 || !channels.is_multiple_of(groups) {
            return Err(DiffusionError::setting("groups", format!("a divisor of {channels} channels"), groups));
        }
        let weight = scope.weight("weight", channels, Init::Ones)?;
        Ok(Self { weight, bias: scope.weight("bias", channels, Init::Zeros)?, groups, eps })
    }

    /// `x` is (batch, channels, …).
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        Ok(group_norm(x, &self.weight, &self.bias, self.groups, self.eps, false)?)
    }

    /// With x·σ(x) behind it.
    pub fn forward_silu(&self, x: &Tensor) -> Result<Tensor> {
        Ok(group_norm(x, &self.weight, &self.bias, self.groups, self.eps, true)?)
    }
}

/// [`layer_norm`] as a layer.
#[derive(Debug, Clone)]
pub struct LayerNorm {
    weight: Tensor,
    bias: Tensor,
    eps: f64,
}

impl LayerNorm {
    /// Over a last dimension of `size`.
    pub fn new(scope: &Scope<'_>, size: usize, eps: f64) -> Result<Self> {
        let weight = scope.weight("weight", size, Init::Ones)?;
        Ok(Self { weight, bias: scope.weight("bias", size, Init::Zeros)?, eps })
    }

    /// `x` is (…, size).
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        Ok(layer_norm(x, &self.weight, &self.bias, self.eps)?)
    }
}

#[cfg(test)]
mod tests {
    use super::super::variables::{Source, VariablesBuilder};
    use super::*;
    use crate::gradient_check::{check, check_layer, variable};
    use candle_core::{DType, Device};

    /// [eq:group-norm]
    #[test]
    fn the_fused_operation_agrees_with_differences_and_with_the_composed_one() {
        let x = variable("x", &[2, 6, 3, 4]);
        let (w, b) = (variable("w", &[6]), variable("b", &[6]));
        for (groups, with_silu) in [(3, false), (2, true), (6, true), (1, false)] {
            let what = format!("group norm of {groups}, SiLU {with_silu}");
            check(&what, &[&x, &w, &b], || group_norm(&x, &w, &b, groups, 1e-5, with_silu));
            let composed = || composed_group_norm(&x, &w, &b, groups, 1e-5, with_silu);
            check(&format!("composed {what}"), &[&x, &w, &b], composed);
            let fused = group_norm(&x, &w, &b, groups, 1e-5, with_silu).unwrap();
            let worst = (fused - composed().unwrap()).unwrap().abs().unwrap().max_all().unwrap();
            assert!(worst.to_scalar::<f64>().unwrap() < 1e-12, "{what}");
            let single = |t: &Tensor| t.to_dtype(DType::F32).unwrap();
            let fused = group_norm(&single(&x), &single(&w), &single(&b), groups, 1e-5, with_silu).unwrap();
            let worst = (fused.to_dtype(DType::F64).unwrap() - composed().unwrap()).unwrap().abs().unwrap();
            assert!(worst.max_all().unwrap().to_scalar::<f64>().unwrap() < 1e-5, "{what} in f32");
        }
    }

    #[test]
    fn large_values_stay_finite() {
        let x = Tensor::new(&[[[3e4f32, -3e4, 3e4, -3e4]]], &Device::Cpu).unwrap();
        let hundred = Tensor::new(&[200.0f32], &Device::Cpu).unwrap();
        let y = group_norm(&x, &hundred, &hundred.zeros_like().unwrap(), 1, 1e-5, true).unwrap();
        assert!(y.flatten_all().unwrap().to_vec1::<f32>().unwrap().iter().all(|v| v.is_finite()));
    }

    #[test]
    fn layers_have_gradients_and_refuse_what_does_not_fit() {
        let builder = VariablesBuilder::new(Source::Seed(2)).dtype(DType::F64);
        let norm = LayerNorm::new(&builder.root(), 5, 1e-5).unwrap();
        let group = GroupNorm::new(&builder.root().at("group"), 6, 2, 1e-5).unwrap();
        assert!(GroupNorm::new(&builder.root().at("wrong"), 6, 4, 1e-5).is_err());
        let (variables, _) = builder.finish();
        let x = variable("x", &[2, 6, 5]);
        check_layer("norms", &variables, &[&x], || Ok(norm.forward(&group.forward_silu(&x).unwrap()).unwrap()));
        assert!(group.forward(&variable("y", &[2, 5, 6])).is_err());
    }
}
