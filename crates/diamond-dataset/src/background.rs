//! Masks by comparison with a photograph of the background alone.
//!
//! The difference of the two photographs is compared, pixel by pixel, with a threshold that is derived from the noise of
//! that very difference, so that it needs no setting. On encoded values (sRGB or γ), where the noise of a camera is about
//! the same at all brightnesses. What the threshold leaves is cleaned: specks and threads go (opening by 1), gaps close
//! (closing by 2), the largest connected part remains, its holes are filled. The shadow that the object throws on the
//! background differs from the background too and counts as object: photograph against black, or something far behind.
use crate::stored::StoredImage;
use diamond_image::Mask;

/// The threshold in standard deviations of the noise: with three channels, fewer than one pixel in 500,000 exceeds it by
/// chance if the noise is Gaussian; the cleaning removes that one.
const SIGMAS: f32 = 5.0;

/// The least threshold: four steps of an 8-bit image, which compression alone may cause.
const LEAST_THRESHOLD: f32 = 4.0 / 255.0;

/// A median absolute deviation × this is the standard deviation, for Gaussian noise.
const MAD_TO_SIGMA: f32 = 1.4826;

/// Where `image` differs from `background`, and the threshold per channel; both images have one size.
pub(crate) fn subtract(image: &StoredImage, background: &StoredImage) -> (Mask, [f32; 3]) {
    let (w, h) = (image.width as usize, image.height as usize);
    let difference: Vec<[f32; 3]> = (0..image.pixels())
        .map(|i| {
            let (a, b) = (image.rgba(i), background.rgba(i));
            [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
        })
        .collect();
    let threshold = [0, 1, 2].map(|c| {
        // Differences of neighbours see noise and edges, but no smooth shading: the median is noise wherever most of the
        // picture has no edge, whether it shows background or object. They have twice the variance.
        let mut steps: Vec<f32> = (0..h)
            .flat_map(|y| (1..w).map(move |x| y * w + x))
            .map(|i| (difference[i][c] - difference[i - 1][c]).abs())
            .collect();
        let middle = steps.len() / 2;
        let median = match steps.is_empty() {
            true => 0.0,
            false => *steps.select_nth_unstable_by(middle, f32::total_cmp).1,
        };
        (SIGMAS * MAD_TO_SIGMA * median / std::f32::consts::SQRT_2).max(LEAST_THRESHOLD)
    });
    let coverage =
        difference.iter().map(|d| f32::from((0..3).any(|c| d[c].abs() > threshold[c]))).collect::<Vec<f32>>();
    let raw = Mask::from_vec(w, h, coverage).unwrap_or_default();
    let cleaned = raw.shrunk(1).grown(1).grown(2).shrunk(2).largest_part().filled();
    (cleaned, threshold)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Deterministic noise, about Gaussian: the sum of four uniform numbers.
    fn noise(seed: &mut u64) -> f32 {
        let mut sum = 0.0;
        for _ in 0..4 {
            *seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            sum += (*seed >> 40) as f32 / (1u64 << 24) as f32 - 0.5;
        }
        sum * (12.0f32 / 4.0).sqrt()
    }

    /// A disc on a gradient, and the gradient alone, both with noise of `sigma` (in 8-bit steps).
    fn pair(sigma: f32, radius: f32) -> (StoredImage, StoredImage, Vec<bool>) {
        let n = 96usize;
        let mut seed = 7;
        let (mut with, mut without, mut truth) = (vec![], vec![], vec![]);
        for i in 0..n * n {
            let (x, y) = ((i % n) as f32 - 47.5, (i / n) as f32 - 47.5);
            let inside = (x * x + y * y).sqrt() < radius;
            for c in 0..3 {
                let base = 60.0 + 0.3 * x + 10.0 * c as f32;
                let shade = 150.0 + 0.8 * y - 20.0 * c as f32;
                let byte = |v: f32, seed: &mut u64| (v + sigma * noise(seed)).round().clamp(0.0, 255.0) as u8;
                with.push(byte(if inside { shade } else { base }, &mut seed));
                without.push(byte(base, &mut seed));
            }
            truth.push(inside);
        }
        (StoredImage::from_bytes(96, 96, 3, with), StoredImage::from_bytes(96, 96, 3, without), truth)
    }

    #[test]
    fn an_object_is_found_whatever_the_noise_and_its_size() {
        for sigma in [0.0, 1.0, 3.0, 6.0] {
            for radius in [8.0, 25.0, 44.0] {
                let (with, without, truth) = pair(sigma, radius);
                let (mask, threshold) = subtract(&with, &without);
                let wrong = mask.data().iter().zip(&truth).filter(|(m, t)| (**m > 0.5) != **t).count();
                let area = truth.iter().filter(|t| **t).count();
                assert!(wrong * 100 <= area * 4, "σ {sigma}, radius {radius}: {wrong} of {area} wrong");
                // The difference of two noisy images has √2 of the noise of one; quantisation adds to small ones.
                let expected = 5.0 * sigma * 2f32.sqrt() / 255.0;
                if sigma >= 3.0 {
                    assert!((threshold[0] / expected - 1.0).abs() < 0.2, "{threshold:?}, expected {expected}");
                }
            }
        }
        let (_, without, _) = pair(2.0, 10.0);
        assert_eq!(subtract(&without, &without).0.area(), 0.0);
    }
}
