//! Activations, composed of operations whose backward pass is exact.
use candle_core::{D, Result, Tensor};

/// 1/√2.
const ROOT_HALF: f64 = std::f64::consts::FRAC_1_SQRT_2;

/// 1/(1 + e^−x).
pub fn sigmoid(x: &Tensor) -> Result<Tensor> {
    // As a hyperbolic tangent it cannot overflow.
    // tidy: allow(candle's; matrix products differ between machines too)
    (x * 0.5)?.tanh()?.affine(0.5, 0.5)
}

/// x·σ(x), the sigmoid linear unit.
pub fn silu(x: &Tensor) -> Result<Tensor> {
    x.mul(&sigmoid(x)?)
}

/// x·Φ(x) with the normal distribution function, exactly and not by a hyperbolic tangent.
pub fn gelu(x: &Tensor) -> Result<Tensor> {
    x.mul(&(x * ROOT_HALF)?.erf()?.affine(0.5, 0.5)?)
}

/// Softmax over the last dimension, with its gradient (candle's `softmax_last_dim` has none).
pub fn softmax(x: &Tensor) -> Result<Tensor> {
    // The maximum cancels in the value, so that it may be a constant of the gradient.
    // tidy: allow(candle's; only other devices than the CPU come here)
    let e = x.broadcast_sub(&x.max_keepdim(D::Minus1)?.detach())?.exp()?;
    e.broadcast_div(&e.sum_keepdim(D::Minus1)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradient_check::{check, variable};

    #[test]
    fn gradients_and_known_values() {
        let x = variable("x", &[3, 5]);
        check("sigmoid", &[&x], || sigmoid(&x));
        check("silu", &[&x], || silu(&x));
        check("gelu", &[&x], || gelu(&x));
        check("softmax", &[&x], || softmax(&x));
        let one = Tensor::new(&[1.0f64, -300.0, 300.0], &candle_core::Device::Cpu).unwrap();
        let values: Vec<f64> = gelu(&one).unwrap().to_vec1().unwrap();
        assert!((values[0] - 0.841_344_746_068_543).abs() < 1e-12 && values[1].abs() < 1e-12 && values[2] == 300.0);
        let values: Vec<f64> = silu(&one).unwrap().to_vec1().unwrap();
        assert!((values[0] - 0.731_058_578_630_005).abs() < 1e-12 && values[1] == 0.0 && values[2] == 300.0);
        assert_eq!(softmax(&one).unwrap().to_vec1::<f64>().unwrap()[2], 1.0);
    }
}
