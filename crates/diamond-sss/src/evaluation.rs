//! How good a model is on held-out images.
//!
//! Protocol: render, encode as sRGB, clamp, round to 8 bits, and compare with the photograph in the same form. PSNR with
//! peak 1 over all pixels and channels; SSIM with an 11×11 window, zero-padded; FLIP for low dynamic range at 67 pixels
//! per degree. *Masked* means inside the photograph's mask, that is where coverage exceeds ½. A light is *seen* where it
//! coincides with a light of the training selection.
//!
//! A held-out photograph whose exposure is not known by itself is compared as the model renders it: under the global gain
//! if one was learned, else under gain 1, which is the geometric mean of the learned exposures. Where gains belong to views
//! or images, the gain that would have fitted each photograph best is reported beside it, and the PSNR under that one.
use crate::{AtOnce, SssError, render_lights};
use diamond_dataset::{Capture, to_display};
use diamond_image::{Image, Mask};
use diamond_metrics::{FlipOptions, SsimWindow, flip_ldr, psnr, psnr_masked, ssim};
use diamond_reconstruct::{ExposureMode, Model, fitted_gain};

/// PSNR of identical images is infinite, which JSON cannot say and no mean survives; it is reported as this, dB. Two
/// different 8-bit images of fewer than 3·10⁹ values are never as close.
pub const PSNR_CAP: f64 = 150.0;

/// The metrics of one image, or of one part of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scored {
    /// dB, at most [`PSNR_CAP`].
    pub psnr: f64,
    /// In `[−1, 1]`.
    pub ssim: f64,
    /// In `[0, 1]`, 0 is best.
    pub flip: f64,
}

/// One held-out image and its metrics.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageScore {
    /// Name of the image.
    pub name: String,
    /// Index of the view among the held-out views.
    pub view: usize,
    /// Index of the image in the view.
    pub shot: usize,
    /// Width and height, pixels.
    pub size: (u32, u32),
    /// Whether its light was seen in training.
    pub seen_light: bool,
    /// Over all pixels.
    pub all: Scored,
    /// Inside the mask; `None` without a mask or where it is empty.
    pub masked: Option<Scored>,
    /// Where gains belong to views or images: the gain that fits this photograph best.
    pub fitted: Option<FittedGain>,
}

/// What a gain of its own would do for a held-out photograph.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FittedGain {
    /// Factors on linear red, green and blue (equal unless gains are per channel).
    pub gain: [f32; 3],
    /// PSNR over all pixels under it, dB, at most [`PSNR_CAP`].
    pub psnr: f64,
}

/// The gain under which held-out photographs are compared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum HeldOutGain {
    /// Exposure is fixed: what the model renders.
    None,
    /// The learned global one: linear red, green, blue.
    Global([f32; 3]),
    /// 1, the geometric mean of the gains of views or images.
    Mean,
}

impl HeldOutGain {
    /// That of a model.
    pub fn of(model: &Model) -> Self {
        match model.config.exposure.mode {
            ExposureMode::Fixed => HeldOutGain::None,
            mode @ ExposureMode::Global => HeldOutGain::Global(model.exposure.of_renderings(mode).to_array()),
            ExposureMode::PerView | ExposureMode::PerImage => HeldOutGain::Mean,
        }
    }

    /// As in `metrics.json`.
    pub fn name(self) -> &'static str {
        match self {
            HeldOutGain::None => "none",
            HeldOutGain::Global(_) => "global",
            HeldOutGain::Mean => "mean",
        }
    }

    /// In words.
    pub fn sentence(self) -> String {
        match self {
            HeldOutGain::None => "none, exposure is fixed".into(),
            HeldOutGain::Global([r, g, b]) => format!("the learned global one, {r:.4} {g:.4} {b:.4}"),
            HeldOutGain::Mean => "1, the geometric mean of the learned gains".into(),
        }
    }
}

/// What was compared, for whoever wants to keep the pictures.
pub(crate) struct Compared<'a> {
    pub score: &'a ImageScore,
    pub render: &'a [u8],
    pub truth: &'a [u8],
    pub flip: &'a Image,
}

/// Evaluates a model on every held-out image of `capture`, whose training part must be the selection that the model was
/// made from (it decides which lights count as seen). Calls `progress` with images done and all.
pub fn evaluate_model(
    model: &Model,
    capture: &Capture,
    mut progress: impl FnMut(usize, usize),
) -> Result<Vec<ImageScore>, SssError> {
    evaluate_with(model, &AtOnce::default(), capture, |done, all, _| {
        progress(done, all);
        Ok(())
    })
}

pub(crate) fn evaluate_with(
    model: &Model,
    at_once: &AtOnce,
    capture: &Capture,
    mut each: impl FnMut(usize, usize, Compared<'_>) -> Result<(), SssError>,
) -> Result<Vec<ImageScore>, SssError> {
    let total = capture.test.iter().map(|v| v.shots.len()).sum();
    let mut scores = Vec::with_capacity(total);
    let renderer = at_once.renderer(model);
    for (v, view) in capture.test.iter().enumerate() {
        let lights: Vec<_> = view.shots.iter().map(|s| s.light).collect();
        render_lights(&renderer, &view.camera, &lights, |s, picture| {
            let shot = &view.shots[s];
            let observation = capture.observation(shot)?;
            let (width, height) = (shot.width as usize, shot.height as usize);
            let bytes = to_display(picture);
            let as_image = |bytes: &[u8]| {
                Image::from_vec(width, height, 3, bytes.iter().map(|b| f32::from(*b) / 255.0).collect())
                    .map_err(|e| SssError::Internal(e.to_string()))
            };
            let (render, truth) = (as_image(&bytes)?, as_image(&observation.display)?);
            let (similarity, _) = ssim(&render, &truth, SsimWindow::ZeroPadded)?;
            let flip = flip_ldr(&truth, &render, FlipOptions::default())?;
            let all =
                Scored { psnr: psnr(&render, &truth, 1.0)?.min(PSNR_CAP), ssim: similarity.mean, flip: flip.mean };
            let masked = match observation.mask.as_ref().and_then(foreground) {
                Some(mask) => Some(Scored {
                    psnr: psnr_masked(&render, &truth, &mask, 1.0)?.min(PSNR_CAP),
                    ssim: similarity.mean_over(&mask)?,
                    flip: flip.mean_over(&mask)?,
                }),
                None => None,
            };
            let fitted = match HeldOutGain::of(model) {
                HeldOutGain::Mean => {
                    let per_channel = model.config.exposure.per_channel;
                    let gain = fitted_gain(picture, &observation.radiance, observation.mask.as_ref(), per_channel)
                        .map(|g| g.unwrap_or(1.0));
                    let mut exposed = picture.clone();
                    for pixel in exposed.data_mut().chunks_exact_mut(3) {
                        pixel.iter_mut().zip(gain).for_each(|(v, g)| *v *= g);
                    }
                    let psnr = psnr(&as_image(&to_display(&exposed))?, &truth, 1.0)?.min(PSNR_CAP);
                    Some(FittedGain { gain, psnr })
                }
                _ => None,
            };
            let score = ImageScore {
                name: shot.name.clone(),
                view: v,
                shot: s,
                size: (shot.width, shot.height),
                seen_light: capture.is_seen_light(&shot.light),
                all,
                masked,
                fitted,
            };
            each(
                scores.len() + 1,
                total,
                Compared { score: &score, render: &bytes, truth: &observation.display, flip: &flip.map },
            )?;
            scores.push(score);
            Ok(())
        })?;
    }
    Ok(scores)
}

/// Where coverage exceeds ½, as a mask of zeros and ones; `None` where nowhere.
fn foreground(mask: &Mask) -> Option<Mask> {
    let inside: Vec<f32> = mask.data().iter().map(|c| f32::from(u8::from(*c > 0.5))).collect();
    inside.contains(&1.0).then(|| Mask::from_vec(mask.width(), mask.height(), inside).ok()).flatten()
}
