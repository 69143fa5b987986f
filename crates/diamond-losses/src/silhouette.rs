//! Losses on the rendered opacity: cross-entropy against the mask, and entropy, which asks for a decision.
use diamond_image::{Image, Mask};

use crate::error::{expect_image, expect_mask, expect_slice};
use crate::{ImageLoss, LossError, SliceLoss};

/// Opacity is clamped to `[ε, 1 − ε]` before its logarithm is taken; outside, the gradient is 0. In f64, where 1 − ε keeps
/// its digits.
pub const OPACITY_MARGIN: f64 = 1e-6;

/// Opacity within its margins, and whether the gradient passes.
fn clamped(opacity: f32) -> (f64, bool) {
    let o = f64::from(opacity);
    (o.clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN), (OPACITY_MARGIN..=1.0 - OPACITY_MARGIN).contains(&o))
}

/// `[eq:mask-bce]` Binary cross-entropy `mean −(M·ln O + (1 − M)·ln(1 − O))` of the rendered opacity O (one channel)
/// against the mask M, over all pixels; gradient with respect to O.
///
/// O is clamped to `[1e-6, 1 − 1e-6]`; where the clamp acts the gradient is 0. Fractional coverage is a fractional
/// label, and then the optimum is O = M with the mask's own entropy left over, not 0.
/// Errors: another size, more than one channel, NaN or infinity.
pub fn mask_bce(opacity: &Image, mask: &Mask) -> Result<ImageLoss, LossError> {
    expect_image(opacity, (opacity.width(), opacity.height()), 1, "mask loss: opacity")?;
    expect_mask(mask, (opacity.width(), opacity.height()), "mask loss: mask")?;
    let mut grad = Image::new(opacity.width(), opacity.height(), 1);
    let scale = 1.0 / opacity.pixels().max(1) as f64;
    let mut sum = 0.0f64;
    for ((g, &o), &m) in grad.data_mut().iter_mut().zip(opacity.data()).zip(mask.data()) {
        let ((o, passes), m) = (clamped(o), f64::from(m));
        if m > 0.0 {
            sum -= m * libm::log(o);
        }
        if m < 1.0 {
            sum -= (1.0 - m) * libm::log(1.0 - o);
        }
        if passes {
            *g = (scale * (o - m) / (o * (1.0 - o))) as f32;
        }
    }
    Ok(ImageLoss { value: (sum * scale) as f32, grad })
}

/// Entropy of one clamped opacity, and its derivative.
fn entropy(opacity: f32) -> (f64, f64) {
    let (o, passes) = clamped(opacity);
    let (a, b) = (libm::log(o), libm::log(1.0 - o));
    (-(o * a + (1.0 - o) * b), if passes { b - a } else { 0.0 })
}

/// `[eq:opacity-entropy]` Mean entropy `mean −(o·ln o + (1 − o)·ln(1 − o))` of the Gaussians' opacities: least where each
/// is 0 or 1, largest (ln 2) at ½. Ours; a regulariser against haze. Clamped like [`mask_bce`].
/// An empty slice gives 0. Errors: NaN or infinity.
pub fn opacity_entropy(opacity: &[f32]) -> Result<SliceLoss, LossError> {
    expect_slice(opacity, opacity.len(), "opacity entropy: opacity")?;
    let scale = 1.0 / opacity.len().max(1) as f64;
    let mut sum = 0.0f64;
    let grad = opacity.iter().map(|&o| {
        let (h, d) = entropy(o);
        sum += h;
        (d * scale) as f32
    });
    let grad = grad.collect();
    Ok(SliceLoss { value: (sum * scale) as f32, grad })
}

/// `[eq:mask-entropy]` The same entropy of the rendered opacity (one channel), mean over all pixels. Ours; for captures
/// without masks. Errors: more than one channel, NaN or infinity.
pub fn mask_entropy(opacity: &Image) -> Result<ImageLoss, LossError> {
    expect_image(opacity, (opacity.width(), opacity.height()), 1, "mask entropy: opacity")?;
    let loss = opacity_entropy(opacity.data())?;
    Ok(ImageLoss { value: loss.value, grad: Image::from_vec(opacity.width(), opacity.height(), 1, loss.grad)? })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// [eq:mask-bce] at the optimum, at the worst, and where the clamp acts.
    #[test]
    fn extremes_are_finite() {
        let mask = Mask::from_vec(2, 1, vec![0.0, 1.0]).unwrap();
        let image = |v: [f32; 2]| Image::from_vec(2, 1, 1, v.to_vec()).unwrap();
        let right = mask_bce(&image([0.0, 1.0]), &mask).unwrap();
        assert!(right.value >= 0.0 && right.value < 2e-6 && right.grad.data() == [0.0, 0.0]);
        let wrong = mask_bce(&image([1.0, 0.0]), &mask).unwrap();
        assert!(wrong.value > 13.0 && wrong.value < 14.0 && wrong.grad.data() == [0.0, 0.0]);
        let unsure = mask_bce(&image([0.5, 0.5]), &mask).unwrap();
        assert_eq!(unsure.grad.data(), [1.0, -1.0]);
    }

    /// [eq:opacity-entropy] [eq:mask-entropy]
    #[test]
    fn entropy_peaks_at_one_half() {
        let loss = opacity_entropy(&[0.5]).unwrap();
        assert!((loss.value - 2f32.ln()).abs() < 1e-6 && loss.grad == [0.0]);
        let loss = opacity_entropy(&[0.1, 0.9]).unwrap();
        assert!(loss.grad[0] > 0.0 && loss.grad[1] < 0.0);
        assert_eq!(opacity_entropy(&[]).unwrap(), SliceLoss { value: 0.0, grad: vec![] });
        assert!(mask_entropy(&Image::new(3, 3, 2)).is_err());
    }
}
