//! The single-view losses as their definitions write them: one scalar from flat lists of numbers, generic over [`Real`].
//!
//! Images are row-major and interleaved. What the objective treats as a constant (photograph, mask, pseudo-normal) is a
//! list of `f64`; what is differentiated is a list of `T`.
use crate::Real;

fn mean<T: Real>(values: impl Iterator<Item = T>, count: f64) -> T {
    values.fold(T::of(0.0), |sum, v| sum + v) / T::of(count)
}

fn magnitude<T: Real>(v: T) -> T {
    // The subgradient 0 at 0.
    if v.value() == 0.0 { T::of(0.0) } else { v.abs() }
}

/// sRGB encoding of linear values ≥ 0.
pub fn srgb<T: Real>(v: T) -> T {
    if v.value() <= 0.003_130_8 { T::of(12.92) * v } else { T::of(1.055) * v.powf(1.0 / 2.4) - T::of(0.055) }
}

/// (1 − λ)·mean|I − G| + λ·(1 − SSIM) + λ₂·mean (I − G)², SSIM with zero padding.
pub fn photometric<T: Real>(
    image: &[T],
    target: &[T],
    shape: crate::metrics::Shape,
    lambda_ssim: f64,
    lambda_l2: f64,
) -> T {
    let n = image.len() as f64;
    let l1 = mean(image.iter().zip(target).map(|(&a, &b)| magnitude(a - b)), n);
    let l2 = mean(image.iter().zip(target).map(|(&a, &b)| (a - b) * (a - b)), n);
    let dssim = T::of(1.0) - crate::metrics::ssim(image, target, shape, 0);
    T::of(1.0 - lambda_ssim) * l1 + T::of(lambda_ssim) * dssim + T::of(lambda_l2) * l2
}

/// Σ wᵢ·((1 − λ)·|I − G|ᵢ + λ·(1 − SSIM)ᵢ + λ₂·(I − G)²ᵢ) / n with a weight for each pixel, SSIM with zero padding.
pub fn believed_photometric<T: Real>(
    image: &[T],
    target: &[T],
    weights: &[f64],
    shape: crate::metrics::Shape,
    lambda_ssim: f64,
    lambda_l2: f64,
) -> T {
    let map = crate::metrics::ssim_map(image, target, shape, 0);
    let each = (0..image.len()).map(|i| {
        let d = image[i] - target[i];
        let dissimilar = T::of(lambda_ssim) * (T::of(1.0) - map[i]);
        T::of(weights[i / shape.2]) * (T::of(1.0 - lambda_ssim) * magnitude(d) + dissimilar + T::of(lambda_l2) * d * d)
    });
    mean(each, image.len() as f64)
}

/// Opacity clamped to `[1e-6, 1 − 1e-6]`, constant where the clamp acts.
fn clamped<T: Real>(o: T) -> T {
    let (low, high) = (1e-6, 1.0 - 1e-6);
    if o.value() < low {
        T::of(low)
    } else if o.value() > high {
        T::of(high)
    } else {
        o
    }
}

/// Mean binary cross-entropy of opacity against a mask.
pub fn mask_bce<T: Real>(opacity: &[T], mask: &[f64]) -> T {
    let each = |(&o, &m): (&T, &f64)| {
        let o = clamped(o);
        -(T::of(m) * o.ln() + T::of(1.0 - m) * (T::of(1.0) - o).ln())
    };
    mean(opacity.iter().zip(mask).map(each), opacity.len() as f64)
}

/// Mean entropy of opacities.
pub fn entropy<T: Real>(opacity: &[T]) -> T {
    let each = |&o: &T| {
        let o = clamped(o);
        let rest = T::of(1.0) - o;
        -(o * o.ln() + rest * rest.ln())
    };
    mean(opacity.iter().map(each), opacity.len() as f64)
}

/// Σ M·(N − P)² / (3·denominator), where the denominator is the area of the mask or the number of pixels.
pub fn normal<T: Real>(normal: &[T], pseudo: &[T], mask: &[f64], denominator: f64) -> T {
    let each = (0..normal.len()).map(|i| {
        let d = normal[i] - pseudo[i];
        T::of(mask[i / 3]) * d * d
    });
    mean(each, 3.0 * denominator)
}

/// Edge-aware smoothness of a map with `shape` under a photograph of `photo_channels` channels: forward differences.
pub fn smoothness<T: Real>(
    map: &[T],
    shape: crate::metrics::Shape,
    photo: &[f64],
    photo_channels: usize,
    mask: &[f64],
) -> T {
    let (width, height, channels) = shape;
    let mut sum = T::of(0.0);
    for (dx, dy) in [(1, 0), (0, 1)] {
        for y in 0..height - dy {
            for x in 0..width - dx {
                let (p, r) = (y * width + x, (y + dy) * width + x + dx);
                let edge: f64 = (0..photo_channels)
                    .map(|c| (photo[r * photo_channels + c] - photo[p * photo_channels + c]).abs())
                    .sum();
                let weight = (-edge / photo_channels as f64).exp() * mask[p] * mask[r] / channels as f64;
                for c in 0..channels {
                    sum += T::of(weight) * magnitude(map[r * channels + c] - map[p * channels + c]);
                }
            }
        }
    }
    sum / T::of((width * height) as f64)
}

/// Σ M·|T − base| / (3·denominator), T the enhanced photograph.
pub fn enhancement<T: Real>(base: &[T], photo: &[f64], mask: &[f64], denominator: f64) -> T {
    let target = |i: usize| {
        let pixel = &photo[i / 3 * 3..i / 3 * 3 + 3];
        let w = (5.0 * (pixel.iter().fold(0.0, |m: f64, &v| m.max(v.min(1.0))) - 0.5)).sigmoid();
        let g = photo[i].clamp(0.0, 1.0);
        w * g * g + (1.0 - w) * (1.0 - (1.0 - g) * (1.0 - g))
    };
    let each = (0..base.len()).map(|i| T::of(mask[i / 3]) * magnitude(T::of(target(i)) - base[i]));
    mean(each, 3.0 * denominator)
}

/// mean|a − b|.
pub fn absolute<T: Real>(a: &[T], b: &[T]) -> T {
    mean(a.iter().zip(b).map(|(&a, &b)| magnitude(a - b)), a.len() as f64)
}

/// mean|clamp(L, 0, 1) − V|.
pub fn incident<T: Real>(incident: &[T], visibility: &[T]) -> T {
    let clamp = |&l: &T| {
        if l.value() < 0.0 {
            T::of(0.0)
        } else if l.value() > 1.0 {
            T::of(1.0)
        } else {
            l
        }
    };
    absolute(&incident.iter().map(clamp).collect::<Vec<_>>(), visibility)
}

/// Mean of the smallest of each three scales.
pub fn flatness<T: Real>(scale: &[T]) -> T {
    mean(scale.chunks(3).map(|s| s[0].min(s[1]).min(s[2])), scale.len() as f64 / 3.0)
}

/// Mean of 1 − (n·a)².
pub fn alignment<T: Real>(normal: &[T], axis: &[T]) -> T {
    let each = normal.chunks(3).zip(axis.chunks(3)).map(|(n, a)| {
        let cosine = n[0] * a[0] + n[1] * a[1] + n[2] * a[2];
        T::of(1.0) - cosine * cosine
    });
    mean(each, normal.len() as f64 / 3.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_values() {
        assert!((mask_bce(&[0.5, 0.5], &[0.0, 1.0]) - 2f64.ln()).abs() < 1e-12);
        assert!((entropy(&[0.5]) - 2f64.ln()).abs() < 1e-12);
        assert_eq!(flatness(&[3.0, 1.0, 2.0]), 1.0);
        assert_eq!(alignment(&[0.0, 0.0, 1.0], &[0.0, 0.0, -1.0]), 0.0);
        assert_eq!(incident(&[2.0, 0.5], &[1.0, 0.0]), 0.25);
        assert_eq!(smoothness(&[0.0, 1.0], (2, 1, 1), &[0.5, 0.5], 1, &[1.0, 1.0]), 0.5);
        assert!((enhancement(&[0.5, 0.5, 0.5], &[0.5, 0.5, 0.5], &[1.0], 1.0)).abs() < 1e-12);
    }
}
