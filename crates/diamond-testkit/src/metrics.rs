//! Structural similarity and PSNR as their papers write them: direct two-dimensional sums, nothing shared, nothing fast.
use crate::Real;

/// Shape of an image: width, height, channels; values are row-major and interleaved.
pub type Shape = (usize, usize, usize);

/// SSIM at each pixel and channel at least `border` pixels from every edge, row by row; outside the image values are 0.
///
/// Window 11×11, Gaussian of σ 1.5, weights that sum to 1; C1 = 0.01², C2 = 0.03²; biased variance.
pub fn ssim_map<T: Real>(a: &[T], b: &[T], (width, height, channels): Shape, border: usize) -> Vec<T> {
    let weight = |dx: i64, dy: i64| (-((dx * dx + dy * dy) as f64) / (2.0 * 1.5 * 1.5)).exp();
    let total: f64 = (-5..=5).flat_map(|dy| (-5..=5).map(move |dx| weight(dx, dy))).sum();
    let mut map = Vec::new();
    for y in border..height.saturating_sub(border) {
        for x in border..width.saturating_sub(border) {
            for c in 0..channels {
                let zero = T::of(0.0);
                let [mut mean_a, mut mean_b, mut aa, mut bb, mut ab] = [zero; 5];
                for dy in -5..=5i64 {
                    for dx in -5..=5i64 {
                        let (u, v) = (x as i64 + dx, y as i64 + dy);
                        if u < 0 || v < 0 || u >= width as i64 || v >= height as i64 {
                            continue;
                        }
                        let i = (v as usize * width + u as usize) * channels + c;
                        let w = T::of(weight(dx, dy) / total);
                        mean_a += w * a[i];
                        mean_b += w * b[i];
                        aa += w * a[i] * a[i];
                        bb += w * b[i] * b[i];
                        ab += w * a[i] * b[i];
                    }
                }
                let (c1, c2, two) = (T::of(0.01 * 0.01), T::of(0.03 * 0.03), T::of(2.0));
                let (var_a, var_b) = (aa - mean_a * mean_a, bb - mean_b * mean_b);
                let covariance = ab - mean_a * mean_b;
                let numerator = (two * mean_a * mean_b + c1) * (two * covariance + c2);
                let denominator = (mean_a * mean_a + mean_b * mean_b + c1) * (var_a + var_b + c2);
                map.push(numerator / denominator);
            }
        }
    }
    map
}

/// Mean of [`ssim_map`].
pub fn ssim<T: Real>(a: &[T], b: &[T], shape: Shape, border: usize) -> T {
    mean(&ssim_map(a, b, shape, border))
}

/// The mean of `values`.
pub fn mean<T: Real>(values: &[T]) -> T {
    let sum = values.iter().fold(T::of(0.0), |sum, &v| sum + v);
    sum / T::of(values.len() as f64)
}

/// Peak signal-to-noise ratio in decibel, peak 1.
pub fn psnr<T: Real>(a: &[T], b: &[T]) -> T {
    let squares: Vec<T> = a.iter().zip(b).map(|(&p, &q)| (p - q) * (p - q)).collect();
    T::of(-10.0 / std::f64::consts::LN_10) * mean(&squares).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identical_images_are_similar_and_a_known_offset_is_20_db() {
        let a: Vec<f64> = (0..48).map(|i| (i as f64 * 0.7).sin() * 0.5 + 0.5).collect();
        assert!((ssim(&a, &a, (4, 4, 3), 0) - 1.0).abs() < 1e-12);
        let b: Vec<f64> = a.iter().map(|v| v + 0.1).collect();
        assert!((psnr(&a, &b) - 20.0).abs() < 1e-9);
        assert!(ssim(&a, &b, (4, 4, 3), 0) < 1.0);
    }
}
