//! What is asked of predicted pictures beside the prediction itself: structure, and sharpness at several scales.
use crate::error::{DiffusionError, Result};
use crate::nn::conv2d;
use candle_core::{DType, Device, Tensor};

/// Side of the window of structural similarity.
const SSIM_WINDOW: usize = 11;

/// Its standard deviation, in pixels.
const SSIM_SIGMA: f64 = 1.5;

/// Guards of structural similarity for values in a range of 1: 0.01² and 0.03².
const SSIM_GUARDS: (f64, f64) = (1e-4, 9e-4);

/// Standard deviations of the blurs that pictures are compared under, in pixels.
const BLURS: [f64; 3] = [1.0, 2.0, 4.0];

/// A Gaussian of `size` entries (odd), of sum 1.
fn gaussian(size: usize, sigma: f64) -> Vec<f64> {
    let centre = (size / 2) as f64;
    let weight = |i: usize| libm::exp(-(i as f64 - centre) * (i as f64 - centre) / (2.0 * sigma * sigma));
    let sum: f64 = (0..size).map(weight).sum();
    (0..size).map(|i| weight(i) / sum).collect()
}

/// Each channel filtered by a Gaussian, zeros around the picture.
fn blurred(x: &Tensor, size: usize, sigma: f64) -> Result<Tensor> {
    let (batch, channels, height, width) = x.dims4()?;
    let row =
        Tensor::from_vec(gaussian(size, sigma), size, &Device::Cpu)?.to_dtype(x.dtype())?.to_device(x.device())?;
    let square = row.reshape((size, 1))?.matmul(&row.reshape((1, size))?)?.reshape((1, 1, size, size))?;
    let y = conv2d(&x.contiguous()?.reshape((batch * channels, 1, height, width))?, &square, 1, size / 2)?;
    Ok(y.reshape((batch, channels, height, width))?)
}

/// Structural similarity of each pair of pictures (batch, channels, height, width) with values in [0, 1]: (batch), 1 where they
/// are equal. Window 11 × 11 with σ 1.5, zeros around the picture, as the metrics of this workspace.
/// `[eq:ssim-tensor]`
pub fn ssim(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    if a.dims() != b.dims() || a.rank() != 4 {
        return Err(DiffusionError::shape("pictures to compare", a.dims(), b.dims()));
    }
    let mean = |x: &Tensor| blurred(x, SSIM_WINDOW, SSIM_SIGMA);
    let (mean_a, mean_b) = (mean(a)?, mean(b)?);
    let (aa, bb, ab) = (mean_a.sqr()?, mean_b.sqr()?, mean_a.mul(&mean_b)?);
    let variance_a = (mean(&a.sqr()?)? - &aa)?;
    let variance_b = (mean(&b.sqr()?)? - &bb)?;
    let covariance = (mean(&a.mul(b)?)? - &ab)?;
    let (c1, c2) = SSIM_GUARDS;
    let above = ab.affine(2.0, c1)?.mul(&covariance.affine(2.0, c2)?)?;
    let below = ((aa + bb)? + c1)?.mul(&((variance_a + variance_b)? + c2)?)?;
    Ok(above.div(&below)?.flatten_from(1)?.mean(1)?)
}

/// Mean absolute difference under three blurs, (batch): tells a picture that is blurred from one that is displaced or dark.
/// `[eq:blur-difference]`
pub fn blur_difference(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    if a.dims() != b.dims() || a.rank() != 4 {
        return Err(DiffusionError::shape("pictures to compare", a.dims(), b.dims()));
    }
    let difference = (a - b)?;
    let mut sum = Tensor::zeros(a.dim(0)?, if a.dtype() == DType::F64 { DType::F64 } else { DType::F32 }, a.device())?;
    for sigma in BLURS {
        let size = 2 * (3.0 * sigma) as usize + 1;
        sum = (sum + blurred(&difference, size, sigma)?.abs()?.flatten_from(1)?.mean(1)?)?;
    }
    Ok((sum / BLURS.len() as f64)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradient_check::{check, variable};

    fn values(t: &Tensor) -> Vec<f64> {
        t.to_vec1().unwrap()
    }

    /// [eq:ssim-tensor]: one window by hand, equal pictures, the gradient.
    #[test]
    fn similarity_has_the_value_by_hand_and_its_gradient() {
        let (a, b) = (variable("a", &[2, 1, 5, 6]), variable("b", &[2, 1, 5, 6]));
        check("ssim", &[&a, &b], || Ok(ssim(&a, &b).unwrap()));
        assert!(values(&ssim(&a, &a).unwrap()).iter().all(|s| (s - 1.0).abs() < 1e-12));
        // A single pixel: the window's weight at its middle is w, the means w·a and w·b.
        let w = gaussian(11, 1.5)[5] * gaussian(11, 1.5)[5];
        let (x, y) = (0.8, 0.3);
        let one = |v: f64| Tensor::new(&[[[[v]]]], &Device::Cpu).unwrap();
        let (ma, mb) = (w * x, w * y);
        let (va, vb, c) = (w * x * x - ma * ma, w * y * y - mb * mb, w * x * y - ma * mb);
        let by_hand = (2.0 * ma * mb + 1e-4) * (2.0 * c + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4));
        assert!((values(&ssim(&one(x), &one(y)).unwrap())[0] - by_hand).abs() < 1e-12);
        assert!(ssim(&a, &one(1.0)).is_err());
    }

    /// [eq:blur-difference]: of a constant away from the border it is the constant; the gradient.
    #[test]
    fn the_difference_of_blurs_has_its_value_and_gradient() {
        let (a, b) = (variable("a", &[1, 2, 5, 4]), variable("b", &[1, 2, 5, 4]));
        check("blur difference", &[&a], || Ok(blur_difference(&a, &b).unwrap()));
        let flat = |v: f64| Tensor::full(v, (1, 1, 200, 200), &Device::Cpu).unwrap();
        let value = values(&blur_difference(&flat(0.75), &flat(0.5)).unwrap())[0];
        assert!((value - 0.25).abs() < 0.01 && value < 0.25, "{value}");
        assert_eq!(values(&blur_difference(&a, &a).unwrap()), [0.0]);
    }
}
