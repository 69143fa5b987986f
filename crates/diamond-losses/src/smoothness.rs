//! Smoothness of a material map, except where the photograph has an edge.
use diamond_image::{Image, Mask};

use crate::average::{coverage, finite, subgradient};
use crate::error::{expect_image, expect_mask};
use crate::{ImageLoss, LossError};

/// `[eq:smoothness]` Edge-aware smoothness of the rendered map q (1 or 3 channels) under the photograph I (1 or 3 channels,
/// the same size, a constant): `mean(|∇q|·exp(−|∇I|)·M)`.
///
/// Differences are forward differences to the right and downward neighbour, pixel to pixel; the last column has no right
/// neighbour and the last row none below. Each direction has its own edge weight: the term of a neighbouring pair (p, r)
/// is `M_p·M_r · exp(−mean_c |I_r − I_p|) · mean_c |q_r − q_p|`, and the loss is the sum of all pairs of both directions
/// divided by the number of pixels. Both pixels must be inside the mask, so that the map is not drawn toward what lies
/// outside the silhouette. The gradient (with respect to q) of |·| at 0 is 0.
///
/// No mask means all pixels. Errors: other sizes, other channel counts, NaN or infinity.
pub fn smoothness(map: &Image, photograph: &Image, mask: Option<&Mask>) -> Result<ImageLoss, LossError> {
    let (width, height, channels) = map.shape();
    let size = (width, height);
    for (image, what) in [(map, "smoothness: map"), (photograph, "smoothness: photograph")] {
        let channels = if image.channels() == 3 { 3 } else { 1 };
        expect_image(image, size, channels, what)?;
    }
    if let Some(mask) = mask {
        expect_mask(mask, size, "smoothness: mask")?;
    }
    let mut grad = Image::new(width, height, channels);
    let scale = 1.0 / (map.pixels().max(1) * channels) as f64;
    let mut sum = 0.0f64;
    let (q, photo) = (map.data(), photograph.data());
    let photo_channels = photograph.channels();
    let mut pair = |p: usize, r: usize, g: &mut [f32]| {
        let inside = coverage(mask, p) * coverage(mask, r);
        if inside == 0.0 {
            return;
        }
        let (i, j) = (p * photo_channels, r * photo_channels);
        let edge: f64 = (0..photo_channels).map(|c| (f64::from(photo[j + c]) - f64::from(photo[i + c])).abs()).sum();
        let weight = f64::from(inside) * f64::from((-(edge / photo_channels as f64) as f32).exp()) * scale;
        for c in 0..channels {
            let (i, j) = (p * channels + c, r * channels + c);
            let d = f64::from(q[j]) - f64::from(q[i]);
            sum += weight * d.abs();
            let step = (weight as f32) * subgradient(d as f32);
            g[j] += step;
            g[i] -= step;
        }
    };
    for y in 0..height {
        for x in 0..width {
            let p = y * width + x;
            if x + 1 < width {
                pair(p, p + 1, grad.data_mut());
            }
            if y + 1 < height {
                pair(p, p + width, grad.data_mut());
            }
        }
    }
    Ok(ImageLoss { value: finite(sum), grad })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// [eq:smoothness] one step, with and without an edge in the photograph, and across a silhouette.
    #[test]
    fn one_step() {
        let map = Image::from_vec(2, 1, 1, vec![0.2, 0.6]).unwrap();
        let flat = Image::filled(2, 1, 3, 0.5);
        let loss = smoothness(&map, &flat, None).unwrap();
        assert!((loss.value - 0.2).abs() < 1e-7 && loss.grad.data() == [-0.5, 0.5]);
        let edge = Image::from_vec(2, 1, 1, vec![0.0, 1.0]).unwrap();
        assert!((smoothness(&map, &edge, None).unwrap().value - 0.2 * (-1.0f32).exp()).abs() < 1e-7);
        let half = Mask::from_vec(2, 1, vec![1.0, 0.0]).unwrap();
        let loss = smoothness(&map, &flat, Some(&half)).unwrap();
        assert!(loss.value == 0.0 && loss.grad.data() == [0.0, 0.0]);
        assert!(smoothness(&Image::new(2, 1, 2), &flat, None).is_err());
        assert_eq!(smoothness(&Image::new(1, 1, 3), &Image::new(1, 1, 3), None).unwrap().value, 0.0);
    }
}
