//! Image metrics: PSNR, SSIM, FLIP, and overlap and depth of a shape; value and map, and the gradient where the metric is a loss.
//!
//! Invariant: a metric is computed as it is named or not at all; nothing is ever substituted for it. What cannot be
//! computed is an error that says why. Values are f64, sums are in a fixed order, and the result does not depend on
//! the number of threads or the instruction set.
//!
//! | metric | whole image | inside a mask | gradient |
//! |---|---|---|---|
//! | PSNR, MSE, L1 | [`psnr`], [`psnr_channels`], [`mse`], [`l1`] | [`psnr_masked`] | – |
//! | SSIM 11×11, σ 1.5 | [`ssim`], [`ssim_mean`] | [`ssim_masked`] | [`ssim`], [`ssim_mean_and_grad`] |
//! | FLIP | [`flip_ldr`], [`flip_hdr`] | [`flip_ldr_masked`], [`flip_hdr_masked`] | – |
//! | silhouette IoU, depth | [`silhouette_iou`], [`depth_error`] | – | – |
//!
//! Images hold values in `[0, 1]` unless said otherwise; NaN and infinity are errors that name the culprit.
//!
//! ```
//! use diamond_image::Image;
//! use diamond_metrics::{psnr, ssim_mean, SsimWindow};
//! let (a, b) = (Image::filled(32, 32, 3, 0.5), Image::filled(32, 32, 3, 0.6));
//! assert!((psnr(&a, &b, 1.0)? - 20.0).abs() < 1e-5);
//! assert!(ssim_mean(&a, &b, SsimWindow::ZeroPadded)? < 1.0);
//! # Ok::<(), diamond_metrics::MetricError>(())
//! ```
mod error;
mod flip;
mod flip_colour;
mod flip_hdr;
mod geometry;
mod masked;
mod psnr;
mod ssim;
mod ssim_rows;

pub use error::MetricError;
pub use flip::{FLIP_PIXELS_PER_DEGREE, Flip, FlipInput, FlipOptions, flip_ldr, flip_ldr_masked};
pub use flip_hdr::{FlipExposures, FlipHdr, FlipHdrOptions, FlipToneMapper, flip_exposures, flip_hdr, flip_hdr_masked};
pub use geometry::{depth_error, silhouette_iou};
pub use masked::masked_mean;
pub use psnr::{l1, mse, psnr, psnr_channels, psnr_masked};
pub use ssim::{
    Ssim, SsimGrad, SsimPullback, SsimWindow, ssim, ssim_masked, ssim_mean, ssim_mean_and_grad, ssim_weighted_and_grad,
};
