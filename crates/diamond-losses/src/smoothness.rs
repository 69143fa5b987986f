//! Smoothness of a material map, except where the photograph has an edge.
use diamond_image::{Image, Mask};

use crate::average::{coverage, finite, subgradient};
use crate::error::{expect_image, expect_mask};
use crate::{ImageLoss, LossError};

/// How much each difference between neighbouring pixels counts, from the photograph and the mask: the part of
/// [`smoothness`] that all maps of one view share.
#[derive(Debug, Clone, PartialEq)]
pub struct EdgeWeights {
    width: usize,
    height: usize,
    /// Weight of the pair (pixel, its right neighbour); 0 in the last column.
    right: Vec<f32>,
    /// Weight of the pair (pixel, its lower neighbour); 0 in the last row.
    down: Vec<f32>,
}

impl EdgeWeights {
    /// Weights under a `photograph` of 1 or 3 channels, inside `mask` (the same size; none is all pixels).
    /// Errors: other sizes, other channel counts, NaN or infinity.
    pub fn new(photograph: &Image, mask: Option<&Mask>) -> Result<Self, LossError> {
        let (width, height, channels) = photograph.shape();
        expect_image(photograph, (width, height), if channels == 3 { 3 } else { 1 }, "smoothness: photograph")?;
        if let Some(mask) = mask {
            expect_mask(mask, (width, height), "smoothness: mask")?;
        }
        let photo = photograph.data();
        let weight = |p: usize, r: usize| {
            let inside = coverage(mask, p) * coverage(mask, r);
            if inside == 0.0 {
                return 0.0;
            }
            let (i, j) = (p * channels, r * channels);
            let edge: f64 = (0..channels).map(|c| (f64::from(photo[j + c]) - f64::from(photo[i + c])).abs()).sum();
            inside * libm::expf(-(edge / channels as f64) as f32)
        };
        let (mut right, mut down) = (vec![0.0; width * height], vec![0.0; width * height]);
        for y in 0..height {
            for x in 0..width {
                let p = y * width + x;
                if x + 1 < width {
                    right[p] = weight(p, p + 1);
                }
                if y + 1 < height {
                    down[p] = weight(p, p + width);
                }
            }
        }
        Ok(Self { width, height, right, down })
    }

    /// `[eq:smoothness]` [`smoothness`] of `map` under these weights. Errors: another size, channels other than 1 or 3, NaN
    /// or infinity.
    pub fn smoothness(&self, map: &Image) -> Result<ImageLoss, LossError> {
        let (width, height, channels) = map.shape();
        expect_image(map, (self.width, self.height), if channels == 3 { 3 } else { 1 }, "smoothness: map")?;
        let mut grad = Image::new(width, height, channels);
        let scale = 1.0 / (map.pixels().max(1) * channels) as f64;
        let mut sum = 0.0f64;
        let (q, g) = (map.data(), grad.data_mut());
        for (weights, stride) in [(&self.right, channels), (&self.down, width * channels)] {
            for (p, &weight) in weights.iter().enumerate() {
                if weight == 0.0 {
                    continue;
                }
                let step = (f64::from(weight) * scale) as f32;
                for i in p * channels..(p + 1) * channels {
                    let d = f64::from(q[i + stride]) - f64::from(q[i]);
                    sum += f64::from(weight) * d.abs();
                    let step = step * subgradient(d as f32);
                    g[i + stride] += step;
                    g[i] -= step;
                }
            }
        }
        Ok(ImageLoss { value: finite(sum * scale), grad })
    }
}

/// `[eq:smoothness]` Edge-aware smoothness of the rendered map q (1 or 3 channels) under the photograph I (1 or 3 channels,
/// the same size, a constant): `mean(|∇q|·exp(−|∇I|)·M)`.
///
/// Differences are forward differences to the right and downward neighbour, pixel to pixel; the last column has no right
/// neighbour and the last row none below. Each direction has its own edge weight: the term of a neighbouring pair (p, r)
/// is `M_p·M_r · exp(−mean_c |I_r − I_p|) · mean_c |q_r − q_p|`, and the loss is the sum of all pairs of both directions
/// divided by the number of pixels. Both pixels must be inside the mask, so that the map is not drawn toward what lies
/// outside the silhouette. The gradient (with respect to q) of |·| at 0 is 0.
///
/// No mask means all pixels. For several maps of one view build the [`EdgeWeights`] once. Errors: other sizes, other
/// channel counts, NaN or infinity.
pub fn smoothness(map: &Image, photograph: &Image, mask: Option<&Mask>) -> Result<ImageLoss, LossError> {
    EdgeWeights::new(photograph, mask)?.smoothness(map)
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
