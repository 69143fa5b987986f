//! The photometric loss of a picture of which parts are believed more than others.
use crate::average::{finite, subgradient};
use crate::encode::encode_image;
use crate::error::expect_finite;
use crate::photometric::checked;
use crate::{LossError, PhotometricLoss, PhotometricOptions};
use diamond_image::{Image, Transfer};
use diamond_metrics::{SsimWindow, ssim_weighted_and_grad};

/// `[eq:believed]` Σ wᵢ·((1 − λ)·|I − G|ᵢ + λ·(1 − SSIM)ᵢ + λ₂·(I − G)²ᵢ) / n of the rendered image I and a picture G that nobody took, with a weight wᵢ ≥ 0 for each
/// pixel (one channel) and n the number of values: what is believed little counts little, also where nothing else is believed. With weights of 1 it is
/// [`crate::photometric`].
///
/// The parts of the result are weighted too; [`PhotometricLoss::display_error`] is not.
///
/// Errors: those of [`crate::photometric`]; weights of another size, negative or not finite; a window that is not zero-padded.
pub fn believed_photometric(
    rendered: &Image,
    target: &Image,
    weights: &Image,
    options: &PhotometricOptions,
) -> Result<PhotometricLoss, LossError> {
    checked(rendered, target, options, 1.0)?;
    let (width, height, channels) = rendered.shape();
    weights.expect_shape((width, height, 1), "believed photometric loss: weights")?;
    expect_finite(weights, "believed photometric loss: weights")?;
    if let Some(found) = weights.data().iter().find(|w| **w < 0.0) {
        let what = "believed photometric loss: weights";
        return Err(LossError::Parameter { what, expected: "numbers that are not negative", found: *found });
    }
    if options.window != SsimWindow::ZeroPadded && options.lambda_ssim > 0.0 {
        let (expected, found) = ("zero-padded".to_owned(), format!("{:?}", options.window));
        return Err(LossError::Shape { what: "believed photometric loss: window", expected, found });
    }
    let space = options.space;
    let (a, b) = (encode_image(space, rendered), encode_image(space, target));
    let (lambda, lambda_l2) = (f64::from(options.lambda_ssim), f64::from(options.lambda_l2));
    let (dssim, mut grad) = match lambda > 0.0 {
        true => {
            let (similar, whole, grad) = ssim_weighted_and_grad(&a, &b, weights)?;
            (whole - similar, grad)
        }
        false => (0.0, Image::new(width, height, channels)),
    };
    let scale = 1.0 / a.data().len() as f64;
    let (mut absolute, mut squared, mut display) = (0.0f64, 0.0f64, 0.0f64);
    let each = a.data().iter().zip(b.data()).zip(rendered.data()).zip(grad.data_mut()).enumerate();
    for (i, (((a, b), linear), grad)) in each {
        let weight = f64::from(weights.data()[i / channels]);
        let d = f64::from(*a) - f64::from(*b);
        absolute += weight * d.abs();
        squared += weight * d * d;
        let seen = |stored: f32| match space {
            Transfer::Srgb => f64::from(stored.clamp(0.0, 1.0)),
            other => f64::from(Transfer::Srgb.encode(other.decode(stored)).clamp(0.0, 1.0)),
        };
        let d_display = seen(*a) - seen(*b);
        display += d_display * d_display;
        let sign = f64::from(subgradient(*a - *b));
        let step = weight * scale * ((1.0 - lambda) * sign + 2.0 * lambda_l2 * d) - lambda * f64::from(*grad);
        *grad = space.encode_pull(*linear, finite(step));
    }
    let (l1, l2) = (absolute * scale, squared * scale);
    Ok(PhotometricLoss {
        value: finite((1.0 - lambda) * l1 + lambda * dssim + lambda_l2 * l2),
        l1: finite(l1),
        dssim: finite(dssim),
        l2: finite(l2),
        display_error: Some(finite(display * scale)),
        grad,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::photometric;

    fn pair() -> (Image, Image) {
        let a = Image::from_vec(7, 6, 3, (0..126).map(|i| (i as f32 * 0.7).sin().abs()).collect()).unwrap();
        let b = a.map(|v| v * 0.6 + 0.1);
        (a, b)
    }

    #[test]
    fn whole_belief_is_the_photometric_loss() {
        let (a, b) = pair();
        for space in [Transfer::Linear, Transfer::Srgb] {
            let options = PhotometricOptions { lambda_ssim: 0.3, lambda_l2: 0.5, space, ..Default::default() };
            let plain = photometric(&a, &b, &options, 1.0).unwrap();
            let found = believed_photometric(&a, &b, &Image::filled(7, 6, 1, 1.0), &options).unwrap();
            assert!((plain.value - found.value).abs() < 1e-6 && (plain.l1 - found.l1).abs() < 1e-6);
            assert!((plain.display_error.unwrap() - found.display_error.unwrap()).abs() < 1e-6);
            for (p, f) in plain.grad.data().iter().zip(found.grad.data()) {
                assert!((p - f).abs() < 1e-6, "{p} {f}");
            }
            let half = believed_photometric(&a, &b, &Image::filled(7, 6, 1, 0.5), &options).unwrap();
            assert!((half.value - 0.5 * found.value).abs() < 1e-6);
        }
    }

    #[test]
    fn what_is_not_believed_has_no_say_of_its_own() {
        let (a, b) = pair();
        let weights = Image::from_vec(7, 6, 1, (0..42).map(|i| if i % 7 < 3 { 1.0 } else { 0.0 }).collect()).unwrap();
        let options = PhotometricOptions { lambda_ssim: 0.0, ..Default::default() };
        let found = believed_photometric(&a, &b, &weights, &options).unwrap();
        for (i, g) in found.grad.data().iter().enumerate() {
            assert_eq!(*g != 0.0, (i / 3) % 7 < 3 && a.data()[i] != b.data()[i]);
        }
        for wrong in [Image::filled(6, 7, 1, 1.0), Image::filled(7, 6, 1, -1.0), Image::filled(7, 6, 1, f32::NAN)] {
            assert!(believed_photometric(&a, &b, &wrong, &options).is_err());
        }
    }
}
