//! The relighter: a picture under one light becomes a picture of the same view under another.
//!
//! What is diffused is not the picture but the logarithm of its ratio to a prediction: that of a fitted medium, or the best shading of the source picture.
//! The ControlNet sees physical hints: shape, what each light does to it, and how far the source picture is from its own prediction.
mod base;
mod examples;
mod held_out;
mod hints;
mod note;
mod orientation;
mod predictions;
mod ratio;
mod relighter;
mod training;

#[cfg(test)]
mod tests;

pub use base::{Base, Prediction, RelightTarget, shading};
pub use examples::{RelightBatch, RelightExample, RelightExamples, Told};
pub use held_out::{HeldOut, PictureError, held_out};
pub use hints::{HINTS, RelightView, hint_planes};
pub use predictions::{PredictedView, prediction_path, write_predictions};
pub use ratio::{decode_ratio, encode_ratio};
pub use relighter::{RelightOptions, Relighter, RelighterConfig, Relit};
pub use training::{RelightTraining, train_relighter};
