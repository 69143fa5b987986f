//! Losses on a device: the photometric one with SSIM, and the mask's cross-entropy, each with its gradient.
use crate::adam::no_frame;
use crate::job::{Job, words};
use crate::kernels::Module;
use crate::{Device, GpuError};
use bytemuck::{Pod, Zeroable};
use diamond_image::{Image, Mask, Transfer};
use diamond_losses::{ImageLoss, LossError, PhotometricLoss, PhotometricOptions, encode_image};

/// `Photometric` of `photometric.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct Photometric {
    pub width: u32,
    pub height: u32,
    pub channels: u32,
    pub border: u32,
    pub space: u32,
    pub step_ssim: f32,
    pub step_l1: f32,
    pub step_l2: f32,
    pub stride: u32,
    pub weighted: u32,
    pub unused_0: u32,
    pub unused_1: u32,
}

/// The photometric loss of the rendered image and the photograph, both linear, as [`diamond_losses::photometric`] gives it
/// `[eq:photometric]`. [`PhotometricLoss::display_error`] is `None`: it is not computed here.
///
/// # Errors
/// What the CPU refuses; arrays beyond the device's limits or memory; a lost device.
pub fn photometric(
    device: &Device,
    rendered: &Image,
    photograph: &Image,
    options: &PhotometricOptions,
    weight: f32,
) -> Result<PhotometricLoss, GpuError> {
    // The CPU checks the options, on one window.
    let small = Image::new(11, 11, 1);
    diamond_losses::photometric(&small, &small, options, weight)?;
    let (width, height, channels) = rendered.shape();
    photograph.expect_same_shape(rendered, "photometric loss: photograph").map_err(LossError::from)?;
    let border = options.window.border();
    if width.min(height) < 2 * border + 1 || rendered.data().is_empty() {
        let expected = format!("at least {0}×{0} pixels", 2 * border + 1);
        let found = format!("{width}×{height}");
        return Err(LossError::Shape { what: "photometric loss", expected, found }.into());
    }
    for (what, image) in [("photometric loss: rendered image", rendered), ("photometric loss: photograph", photograph)]
    {
        if let Some((x, y, c)) = image.first_non_finite() {
            return Err(LossError::NonFinite { what, at: format!("column {x}, row {y}, channel {c}") }.into());
        }
    }
    let n = rendered.data().len() as u64;
    let windows = ((width - 2 * border) * (height - 2 * border) * channels) as f64;
    let (lambda, lambda_l2, weight) = (f64::from(options.lambda_ssim), f64::from(options.lambda_l2), f64::from(weight));
    let scale = 1.0 / n as f64;
    let settings = Photometric {
        width: width as u32,
        height: height as u32,
        channels: channels as u32,
        border: border as u32,
        space: match options.space {
            Transfer::Linear => 0,
            Transfer::Srgb => 1,
            Transfer::Gamma22 => 2,
        },
        step_ssim: (-weight * lambda / windows) as f32,
        step_l1: (weight * (1.0 - lambda) * scale) as f32,
        step_l2: (2.0 * weight * lambda_l2 * scale) as f32,
        stride: channels as u32,
        weighted: 0,
        unused_0: 0,
        unused_1: 0,
    };
    let mut job = Job::new(device, &no_frame(0, [1, 1]))?;
    let settings = job.input("settings", bytemuck::cast_slice(bytemuck::bytes_of(&settings)))?;
    let linear = job.input("rendered picture", words(rendered.data()))?;
    let seen = job.zeros("encoded picture", n)?;
    let target = job.input("photograph", words(encode_image(options.space, photograph).data()))?;
    let fields = job.zeros("derivatives of SSIM", 4 * n)?;
    let means = job.zeros("means of windows", n)?;
    let gradient = job.zeros("gradient of the picture", n)?;
    let sums = job.zeros("terms of the loss", 4 * n)?;
    let all = [settings, linear, seen, target, fields, means, gradient, sums];
    let tiles = [width.div_ceil(16) as u32, height.div_ceil(16) as u32];
    job.over(Module::Photometric, "encode", &all, n)?;
    job.run(Module::Photometric, "compare_windows", &[], &all, tiles)?;
    job.run(Module::Photometric, "gather_gradient", &[], &all, tiles)?;
    let blocks = n.div_ceil(2048);
    job.run(Module::Photometric, "add_up", &[], &all, crate::stage::grid(blocks))?;
    let mut read = job.finish(&[(fields, 4 * blocks), (gradient, n)])?;
    let grad = read.pop().unwrap_or_default();
    let total = |k: usize| read[0].chunks_exact(4).map(|sum| f64::from(sum[k])).sum::<f64>();
    let dssim = if lambda > 0.0 { total(0) / windows } else { 0.0 };
    let (l1, l2) = (total(1) * scale, total(2) * scale);
    Ok(PhotometricLoss {
        value: (weight * ((1.0 - lambda) * l1 + lambda * dssim + lambda_l2 * l2)) as f32,
        l1: l1 as f32,
        dssim: dssim as f32,
        l2: l2 as f32,
        display_error: None,
        grad: Image::from_vec(width, height, channels, grad).map_err(LossError::from)?,
    })
}

/// Binary cross-entropy of the opacity (one channel) against a mask, as [`diamond_losses::mask_bce`] gives it `[eq:mask-bce]`.
///
/// # Errors
/// Another shape; arrays beyond the device's limits or memory; a lost device.
pub fn mask_bce(device: &Device, opacity: &Image, mask: &Mask) -> Result<ImageLoss, GpuError> {
    let (width, height, _) = opacity.shape();
    opacity.expect_shape((mask.width(), mask.height(), 1), "mask loss: opacity").map_err(LossError::from)?;
    let n = opacity.pixels() as u64;
    if n == 0 {
        return Ok(diamond_losses::mask_bce(opacity, mask)?);
    }
    let mut job = Job::new(device, &no_frame(0, [width as u32, height as u32]))?;
    let o = job.input("opacity", words(opacity.data()))?;
    let m = job.input("mask", words(mask.data()))?;
    let gradient = job.zeros("gradient of the opacity", n)?;
    let values = job.zeros("terms of the loss", n)?;
    job.over(Module::MaskBce, "mask_bce", &[o, m, gradient, values], n)?;
    let mut read = job.finish(&[(gradient, n), (values, n)])?;
    let sum: f64 = read.pop().unwrap_or_default().iter().map(|v| f64::from(*v)).sum();
    let grad = Image::from_vec(width, height, 1, read.swap_remove(0)).map_err(LossError::from)?;
    Ok(ImageLoss { value: (sum / n as f64) as f32, grad })
}
