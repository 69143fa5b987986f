//! The photometric loss: absolute difference and structural dissimilarity of the rendered image and the photograph.
use diamond_image::{Image, Transfer};
use diamond_metrics::{SsimWindow, ssim_mean_and_grad};

use crate::LossError;
use crate::average::finite;
use crate::compare::Compare;
use crate::encode::encode_image;
use crate::error::expect_finite;
use diamond_simd::Level;

/// How rendered image and photograph are compared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhotometricOptions {
    /// λ in `[0, 1]`: weight of 1 − SSIM, against 1 − λ of the absolute difference.
    pub lambda_ssim: f32,
    /// Weight ≥ 0 of the mean squared difference, in addition (0: off).
    pub lambda_l2: f32,
    /// The space in which the differences are taken. Both images are given in linear RGB and encoded first;
    /// [`Transfer::Linear`] compares radiance itself.
    pub space: Transfer,
    /// How SSIM treats the image's edge.
    pub window: SsimWindow,
}

impl Default for PhotometricOptions {
    fn default() -> Self {
        Self { lambda_ssim: 0.2, lambda_l2: 0.0, space: Transfer::Linear, window: SsimWindow::ZeroPadded }
    }
}

/// Value and gradient of [`photometric`].
#[derive(Debug, Clone, PartialEq)]
pub struct PhotometricLoss {
    /// `weight·((1 − λ)·l1 + λ·dssim + λ₂·l2)`.
    pub value: f32,
    /// Mean absolute difference, unweighted.
    pub l1: f32,
    /// 1 − SSIM, unweighted; 0 and not computed where λ is 0.
    pub dssim: f32,
    /// Mean squared difference, unweighted.
    pub l2: f32,
    /// Mean squared difference in sRGB with both sides cut to [0, 1], which the PSNR of the displayed picture is made of;
    /// a by-product, `None` where images are compared with γ 2.2.
    pub display_error: Option<f32>,
    /// Gradient of `value` with respect to the rendered image (its shape, in linear RGB).
    pub grad: Image,
}

/// `[eq:photometric]` `weight·((1 − λ)·mean|I − G| + λ·(1 − SSIM(I, G)) + λ₂·mean (I − G)²)` of the rendered image I
/// and the photograph G: linear RGB (or any number of channels) of equal shape, compared in `options.space`.
///
/// `weight` ≥ 0 is the sample's weight, e.g. ½ for a synthetic image. One fused pass gives the SSIM and its gradient;
/// with λ = 0 SSIM is not computed. The gradient of |·| at 0 is 0.
///
/// Errors: unequal shapes, no pixels, NaN or infinity, λ outside `[0, 1]`, a negative weight, a window that does not fit.
pub fn photometric(
    rendered: &Image,
    target: &Image,
    options: &PhotometricOptions,
    weight: f32,
) -> Result<PhotometricLoss, LossError> {
    photometric_with(rendered, target, false, options, weight)
}

/// [`photometric`] with a photograph that is already encoded in `options.space`, by [`encode_image`] or as a file stores it: saves
/// encoding it anew at every step.
pub fn photometric_encoded(
    rendered: &Image,
    encoded_target: &Image,
    options: &PhotometricOptions,
    weight: f32,
) -> Result<PhotometricLoss, LossError> {
    photometric_with(rendered, encoded_target, true, options, weight)
}

fn photometric_with(
    rendered: &Image,
    target: &Image,
    encoded: bool,
    options: &PhotometricOptions,
    weight: f32,
) -> Result<PhotometricLoss, LossError> {
    checked(rendered, target, options, weight)?;
    let space = options.space;
    if space == Transfer::Linear {
        return compared(rendered, rendered, target, options, weight);
    }
    let seen = encode_image(space, rendered);
    if encoded {
        compared(rendered, &seen, target, options, weight)
    } else {
        compared(rendered, &seen, &encode_image(space, target), options, weight)
    }
}

/// Refuses parameters and images that have no loss.
pub(crate) fn checked(
    rendered: &Image,
    target: &Image,
    options: &PhotometricOptions,
    weight: f32,
) -> Result<(), LossError> {
    let lambda = options.lambda_ssim;
    if !(0.0..=1.0).contains(&lambda) {
        let what = "photometric loss: lambda_ssim";
        return Err(LossError::Parameter { what, expected: "a number from 0 to 1", found: lambda });
    }
    for (what, v) in [("photometric loss: lambda_l2", options.lambda_l2), ("photometric loss: weight", weight)] {
        if !(0.0..f32::INFINITY).contains(&v) {
            return Err(LossError::Parameter { what, expected: "a finite number that is not negative", found: v });
        }
    }
    target.expect_same_shape(rendered, "photometric loss: photograph")?;
    expect_finite(rendered, "photometric loss: rendered image")?;
    expect_finite(target, "photometric loss: photograph")?;
    if rendered.data().is_empty() {
        let expected = "at least one pixel".to_owned();
        return Err(LossError::Shape { what: "photometric loss", expected, found: "none".to_owned() });
    }
    Ok(())
}

/// The loss of `linear`, which is `a` encoded, against the encoded `b`: SSIM in one fused pass, and everything else in
/// another.
fn compared(
    linear: &Image,
    a: &Image,
    b: &Image,
    options: &PhotometricOptions,
    weight: f32,
) -> Result<PhotometricLoss, LossError> {
    let (width, height, channels) = a.shape();
    let scale = 1.0 / a.data().len() as f64;
    let weight = f64::from(weight);
    let lambda = f64::from(options.lambda_ssim);
    let lambda_l2 = f64::from(options.lambda_l2);
    let (dssim, mut grad) = if lambda > 0.0 {
        let (mean, grad) = ssim_mean_and_grad(a, b, options.window)?;
        (1.0 - mean, grad)
    } else {
        (0.0, Image::new(width, height, channels))
    };
    let compare = Compare {
        space: options.space,
        linear: linear.data(),
        a: a.data(),
        b: b.data(),
        grad: grad.data_mut(),
        step_ssim: (-weight * lambda) as f32,
        step_l1: (weight * (1.0 - lambda) * scale) as f32,
        step_l2: 2.0 * weight * lambda_l2 * scale,
    };
    let sums = compare.run(Level::current());
    let (l1, l2) = (sums.absolute * scale, sums.squared * scale);
    let value = weight * ((1.0 - lambda) * l1 + lambda * dssim + lambda_l2 * l2);
    Ok(PhotometricLoss {
        value: finite(value),
        l1: finite(l1),
        dssim: dssim as f32,
        l2: finite(l2),
        display_error: (options.space != Transfer::Gamma22).then(|| finite(sums.display * scale)),
        grad,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// [eq:photometric] parts add up, and the weight scales all.
    #[test]
    fn parts_and_weight() {
        let a = Image::from_vec(4, 3, 3, (0..36).map(|i| (i as f32 * 0.7).sin().abs()).collect()).unwrap();
        let b = a.map(|v| v * 0.5 + 0.1);
        let options = PhotometricOptions { lambda_ssim: 0.3, lambda_l2: 2.0, ..Default::default() };
        let one = photometric(&a, &b, &options, 1.0).unwrap();
        let half = photometric(&a, &b, &options, 0.5).unwrap();
        assert!((one.value - (0.7 * one.l1 + 0.3 * one.dssim + 2.0 * one.l2)).abs() < 1e-6);
        assert!((half.value - 0.5 * one.value).abs() < 1e-7 && half.l1 == one.l1);
        for (g, h) in one.grad.data().iter().zip(half.grad.data()) {
            assert!((0.5 * g - h).abs() < 1e-7);
        }
    }

    #[test]
    fn an_encoded_photograph_is_the_same() {
        let a = Image::from_vec(4, 3, 3, (0..36).map(|i| (i as f32 * 0.7).sin().abs()).collect()).unwrap();
        let b = a.map(|v| v * 0.5 + 0.1);
        for space in [Transfer::Linear, Transfer::Srgb, Transfer::Gamma22] {
            let options = PhotometricOptions { space, ..Default::default() };
            let stored = encode_image(space, &b);
            assert_eq!(
                photometric(&a, &b, &options, 1.0).unwrap(),
                photometric_encoded(&a, &stored, &options, 1.0).unwrap()
            );
        }
    }

    #[test]
    fn the_display_error_is_that_of_psnr() {
        let a = Image::from_vec(4, 3, 3, (0..36).map(|i| (i as f32 * 0.7).sin() * 1.4).collect()).unwrap();
        let b = a.map(|v| v * 0.5 + 0.1);
        let display = |image: &Image| image.map(|v| Transfer::Srgb.encode(v).clamp(0.0, 1.0));
        let expected = diamond_metrics::psnr(&display(&a), &display(&b), 1.0).unwrap();
        for space in [Transfer::Linear, Transfer::Srgb] {
            let loss = photometric(&a, &b, &PhotometricOptions { space, ..Default::default() }, 1.0).unwrap();
            let psnr = -10.0 * f64::from(loss.display_error.unwrap()).log10();
            assert!((psnr - expected).abs() < 1e-4, "{space:?} {psnr} {expected}");
        }
        let gamma = PhotometricOptions { space: Transfer::Gamma22, ..Default::default() };
        assert_eq!(photometric(&a, &b, &gamma, 1.0).unwrap().display_error, None);
    }

    #[test]
    fn parameters_are_checked() {
        let a = Image::new(2, 2, 3);
        for (lambda_ssim, lambda_l2, weight) in
            [(1.5, 0.0, 1.0), (f32::NAN, 0.0, 1.0), (0.2, -1.0, 1.0), (0.2, 0.0, -1.0)]
        {
            let options = PhotometricOptions { lambda_ssim, lambda_l2, ..Default::default() };
            assert!(matches!(photometric(&a, &a, &options, weight), Err(LossError::Parameter { .. })));
        }
    }
}
