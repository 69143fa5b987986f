//! Losses on normals: rendered normals against normals of the rendered depth, and against the shape of the Gaussians.
use diamond_image::{Image, Mask};

use crate::LossError;
use crate::average::{Average, coverage, finite};
use crate::error::{expect_image, expect_mask, expect_vectors};

/// Value and gradient of [`normal_consistency`].
#[derive(Debug, Clone, PartialEq)]
pub struct NormalLoss {
    /// The loss.
    pub value: f32,
    /// Gradient with respect to the rendered normal.
    pub grad: Image,
}

impl NormalLoss {
    /// Gradient with respect to the pseudo-normal, for those who do not detach it: the other one's negative.
    pub fn d_pseudo_normal(&self) -> Image {
        self.grad.map(|v| -v)
    }
}

/// `[eq:normal]` Mean squared difference `Σ M·|N − P|² / (3·Σ M)` of the rendered normals N and the pseudo-normals P of the
/// depth (`width × height × 3`, one frame, nominally unit), inside the mask; without a mask over all pixels.
///
/// The gradient is with respect to N; P counts as a constant. [`Average::AllPixels`] divides by 3·pixels instead. An
/// empty mask gives 0. Errors: other shapes, NaN or infinity.
pub fn normal_consistency(
    normal: &Image,
    pseudo_normal: &Image,
    mask: Option<&Mask>,
    average: Average,
) -> Result<NormalLoss, LossError> {
    let size = (normal.width(), normal.height());
    expect_image(normal, size, 3, "normal loss: rendered normal")?;
    expect_image(pseudo_normal, size, 3, "normal loss: pseudo-normal")?;
    if let Some(mask) = mask {
        expect_mask(mask, size, "normal loss: mask")?;
    }
    let scale = average.scale(mask, normal.pixels(), 3);
    let mut grad = Image::new(size.0, size.1, 3);
    let mut sum = 0.0f64;
    let pixels = normal.data().chunks_exact(3).zip(pseudo_normal.data().chunks_exact(3));
    for (i, (g, (n, p))) in grad.data_mut().chunks_exact_mut(3).zip(pixels).enumerate() {
        let m = f64::from(coverage(mask, i));
        for c in 0..3 {
            let d = f64::from(n[c]) - f64::from(p[c]);
            sum += m * d * d;
            g[c] = finite(2.0 * m * scale * d);
        }
    }
    Ok(NormalLoss { value: finite(sum * scale), grad })
}

/// Value and gradients of [`normal_alignment`].
#[derive(Debug, Clone, PartialEq)]
pub struct AlignmentLoss {
    /// The loss.
    pub value: f32,
    /// Gradient with respect to each normal.
    pub d_normal: Vec<[f32; 3]>,
    /// Gradient with respect to each axis.
    pub d_axis: Vec<[f32; 3]>,
}

/// `[eq:normal-alignment]` Mean of `1 − (n·a)²` over the Gaussians' unit normals n and the unit vectors a of their
/// shortest axes: 0 where they are parallel, whichever way the axis points. Ours.
///
/// Gradients are plain derivatives with respect to the components; pull them through the normalisations. An empty slice
/// gives 0. Errors: unequal lengths, NaN or infinity.
pub fn normal_alignment(normal: &[[f32; 3]], shortest_axis: &[[f32; 3]]) -> Result<AlignmentLoss, LossError> {
    expect_vectors(normal, normal.len(), "normal alignment: normal")?;
    expect_vectors(shortest_axis, normal.len(), "normal alignment: shortest axis")?;
    let scale = 1.0 / normal.len().max(1) as f64;
    let mut loss =
        AlignmentLoss { value: 0.0, d_normal: vec![[0.0; 3]; normal.len()], d_axis: vec![[0.0; 3]; normal.len()] };
    let mut sum = 0.0f64;
    for (i, (n, a)) in normal.iter().zip(shortest_axis).enumerate() {
        let cosine: f64 = (0..3).map(|c| f64::from(n[c]) * f64::from(a[c])).sum();
        sum += 1.0 - cosine * cosine;
        for c in 0..3 {
            loss.d_normal[i][c] = finite(-2.0 * scale * cosine * f64::from(a[c]));
            loss.d_axis[i][c] = finite(-2.0 * scale * cosine * f64::from(n[c]));
        }
    }
    loss.value = finite(sum * scale);
    Ok(loss)
}

/// `[eq:flatness]` Mean of the smallest of each Gaussian's three scales (activated, in scene units): pulls toward flat,
/// surface-like Gaussians. Ours. The gradient, one per scale, goes to the smallest; the first of equals.
/// An empty slice gives 0. Errors: NaN or infinity.
pub fn flatness(scale: &[[f32; 3]]) -> Result<(f32, Vec<[f32; 3]>), LossError> {
    expect_vectors(scale, scale.len(), "flatness: scale")?;
    let share = 1.0 / scale.len().max(1) as f64;
    let mut grad = vec![[0.0; 3]; scale.len()];
    let mut sum = 0.0f64;
    for (g, s) in grad.iter_mut().zip(scale) {
        let smallest = (1..3).fold(0, |best, c| if s[c] < s[best] { c } else { best });
        sum += f64::from(s[smallest]);
        g[smallest] = share as f32;
    }
    Ok((finite(sum * share), grad))
}
