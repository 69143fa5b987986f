//! Mean squared and absolute error, and the peak signal-to-noise ratio. Sums are in f64, row by row, in row order.
use diamond_image::{Image, Mask};

use crate::MetricError;
use crate::error::{expect_comparable, expect_mask};

const NAMES: [&str; 3] = ["PSNR", "PSNR: first image", "PSNR: second image"];

/// Σ f(a − b) per channel, weighted by `weight` per pixel, and Σ weight.
fn sums(a: &Image, b: &Image, weight: Option<&[f32]>, f: impl Fn(f64) -> f64) -> (Vec<f64>, f64) {
    let channels = a.channels();
    let row_length = a.width() * channels;
    let mut total = vec![0.0; channels];
    let mut total_weight = 0.0;
    for y in 0..a.height() {
        let row = y * row_length..(y + 1) * row_length;
        let mut row_sum = vec![0.0; channels];
        for (x, (p, q)) in a.data()[row.clone()].chunks(channels).zip(b.data()[row].chunks(channels)).enumerate() {
            let w = weight.map_or(1.0, |w| w[y * a.width() + x] as f64);
            total_weight += w;
            for c in 0..channels {
                row_sum[c] += w * f(p[c] as f64 - q[c] as f64);
            }
        }
        for c in 0..channels {
            total[c] += row_sum[c];
        }
    }
    (total, total_weight)
}

/// Mean squared error `mean (a − b)²` over all pixels and channels. Symmetric. Unit: the square of the images'.
/// Errors: unequal shapes, no pixels, NaN or infinity.
pub fn mse(a: &Image, b: &Image) -> Result<f64, MetricError> {
    expect_comparable(a, b, NAMES)?;
    let (sum, weight) = sums(a, b, None, |d| d * d);
    Ok(sum.iter().sum::<f64>() / (weight * a.channels() as f64))
}

/// Mean absolute error `mean |a − b|` over all pixels and channels. Symmetric. Errors as [`mse`].
pub fn l1(a: &Image, b: &Image) -> Result<f64, MetricError> {
    expect_comparable(a, b, ["L1", "L1: first image", "L1: second image"])?;
    let (sum, weight) = sums(a, b, None, f64::abs);
    Ok(sum.iter().sum::<f64>() / (weight * a.channels() as f64))
}

fn decibel(mse: f64, peak: f64) -> f64 {
    if mse == 0.0 { f64::INFINITY } else { 10.0 * libm::log10(peak * peak / mse) }
}

fn expect_peak(peak: f64) -> Result<(), MetricError> {
    if peak > 0.0 && peak.is_finite() {
        return Ok(());
    }
    Err(MetricError::Parameter { what: "PSNR: peak", expected: "a positive finite number", found: peak })
}

/// `[eq:psnr]` Peak signal-to-noise ratio in decibel, `10·log10(peak² / mean (a − b)²)`, the mean over all pixels
/// and channels together. Identical images give `f64::INFINITY`. Symmetric.
///
/// `peak` is the largest possible value: 1 for images in `[0, 1]`. Errors: unequal shapes, no pixels, NaN or infinity
/// in an image, a peak that is not positive.
pub fn psnr(a: &Image, b: &Image, peak: f64) -> Result<f64, MetricError> {
    expect_peak(peak)?;
    Ok(decibel(mse(a, b)?, peak))
}

/// PSNR of each channel on its own, in decibel; their mean is another number than [`psnr`] of all channels together,
/// and never smaller. Errors as [`psnr`].
pub fn psnr_channels(a: &Image, b: &Image, peak: f64) -> Result<Vec<f64>, MetricError> {
    expect_peak(peak)?;
    expect_comparable(a, b, NAMES)?;
    let (sum, weight) = sums(a, b, None, |d| d * d);
    Ok(sum.iter().map(|s| decibel(s / weight, peak)).collect())
}

/// [`psnr`] with the mean squared error `Σ M·(a − b)² / (channels·Σ M)`: inside the mask, fractional coverage counts
/// as much as it covers. Errors also if the mask has another size or covers nothing.
pub fn psnr_masked(a: &Image, b: &Image, mask: &Mask, peak: f64) -> Result<f64, MetricError> {
    expect_peak(peak)?;
    expect_comparable(a, b, NAMES)?;
    expect_mask(a, mask, "PSNR: mask")?;
    let (sum, weight) = sums(a, b, Some(mask.data()), |d| d * d);
    if weight <= 0.0 {
        return Err(MetricError::EmptyMask { what: "PSNR" });
    }
    Ok(decibel(sum.iter().sum::<f64>() / (weight * a.channels() as f64), peak))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// [eq:psnr]
    #[test]
    fn a_known_offset() {
        let a = Image::filled(5, 3, 3, 0.25);
        let b = Image::filled(5, 3, 3, 0.75);
        assert!((psnr(&a, &b, 1.0).unwrap() - 20.0 * 2f64.log10()).abs() < 1e-12);
        assert!((psnr(&a, &b, 2.0).unwrap() - 20.0 * 4f64.log10()).abs() < 1e-12);
        assert_eq!(psnr(&a, &a, 1.0).unwrap(), f64::INFINITY);
        assert_eq!(l1(&a, &b).unwrap(), 0.5);
        assert!(matches!(psnr(&a, &b, 0.0), Err(MetricError::Parameter { .. })));
        assert!(matches!(psnr(&a, &Image::new(5, 2, 3), 1.0), Err(MetricError::Shape { .. })));
        assert!(matches!(psnr(&Image::new(0, 2, 3), &Image::new(0, 2, 3), 1.0), Err(MetricError::Empty { .. })));
    }

    #[test]
    fn the_mask_selects() {
        let a = Image::new(2, 1, 1);
        let b = Image::from_vec(2, 1, 1, vec![0.1, 0.9]).unwrap();
        let left = Mask::from_vec(2, 1, vec![1.0, 0.0]).unwrap();
        assert!((psnr_masked(&a, &b, &left, 1.0).unwrap() - 20.0).abs() < 1e-6);
        assert_eq!(psnr_masked(&a, &b, &Mask::full(2, 1), 1.0), psnr(&a, &b, 1.0));
        let none = Mask::from_vec(2, 1, vec![0.0, 0.0]).unwrap();
        assert!(matches!(psnr_masked(&a, &b, &none, 1.0), Err(MetricError::EmptyMask { .. })));
        assert!(matches!(psnr_masked(&a, &b, &Mask::full(3, 1), 1.0), Err(MetricError::Shape { .. })));
    }
}
