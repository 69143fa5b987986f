//! The single-view losses of a translucent reconstruction: each a pure function from what was rendered and what was
//! measured to a value and a gradient.
//!
//! Invariant: losses know images, masks and slices of numbers, and nothing of Gaussians, cameras or optimisers. No loss
//! applies its own λ; [`TERMS`] lists the terms with the names that configuration, logs and documents share.
//!
//! Every gradient is with respect to the rendered side, in the shape of that input; the measured side is a constant unless
//! a function says otherwise. Sums are in f64 in row order. |·| has the subgradient 0 at 0, so an optimum stays put. An
//! empty mask or slice gives value 0 and gradient 0. NaN and infinity in an input are errors that say where.
//!
//! | term | function | rendered side |
//! |---|---|---|
//! | photometric | [`photometric`], [`believed_photometric`] | image, any channels |
//! | mask, mask entropy | [`mask_bce`], [`mask_entropy`] | opacity, 1 channel |
//! | normal | [`normal_consistency`] | normals, 3 channels |
//! | smoothness | [`smoothness`] | material map, 1 or 3 channels |
//! | enhancement | [`enhancement`] | base colour, 3 channels |
//! | incident, visibility | [`incident_light`], [`visibility`] | one number per Gaussian |
//! | opacity entropy, flatness, alignment | [`opacity_entropy`], [`flatness`], [`normal_alignment`] | per Gaussian |
//!
//! ```
//! use diamond_image::Image;
//! use diamond_losses::{PhotometricOptions, photometric};
//! let (rendered, photograph) = (Image::filled(8, 8, 3, 0.5), Image::filled(8, 8, 3, 0.4));
//! let loss = photometric(&rendered, &photograph, &PhotometricOptions::default(), 1.0)?;
//! assert!((loss.l1 - 0.1).abs() < 1e-6 && loss.grad.pixel(4, 4)[0] > 0.0);
//! # Ok::<(), diamond_losses::LossError>(())
//! ```
mod average;
mod believed;
mod compare;
mod encode;
mod enhancement;
mod error;
mod normal;
mod photometric;
mod silhouette;
mod smoothness;
mod terms;
mod visibility;

pub use average::Average;
pub use believed::believed_photometric;
pub use encode::encode_image;
pub use enhancement::{enhanced, enhancement};
pub use error::LossError;
pub use normal::{AlignmentLoss, NormalLoss, flatness, normal_alignment, normal_consistency};
pub use photometric::{PhotometricLoss, PhotometricOptions, photometric, photometric_encoded};
pub use silhouette::{OPACITY_MARGIN, mask_bce, mask_entropy, opacity_entropy};
pub use smoothness::{EdgeWeights, smoothness};
pub use terms::{TERMS, Term, TermInfo};
pub use visibility::{IncidentLoss, incident_light, visibility};

use diamond_image::Image;

/// A loss on an image.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageLoss {
    /// The loss.
    pub value: f32,
    /// Gradient with respect to the rendered image, in its shape.
    pub grad: Image,
}

/// A loss on one number per Gaussian or sample.
#[derive(Debug, Clone, PartialEq)]
pub struct SliceLoss {
    /// The loss.
    pub value: f32,
    /// Gradient with respect to each number.
    pub grad: Vec<f32>,
}
