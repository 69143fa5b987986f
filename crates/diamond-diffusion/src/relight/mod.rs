//! The relighter: a picture under one light becomes a picture of the same view under another.
//!
//! What is diffused is not the picture but the logarithm of its ratio to the source picture: texture and silhouette
//! are the source's. The ControlNet sees physical hints: shape, and what each light does to it.
mod examples;
mod hints;
mod ratio;
mod relighter;
mod training;

#[cfg(test)]
mod tests;

pub use examples::{RelightBatch, RelightExamples};
pub use hints::{HINTS, RelightView, hint_planes};
pub use ratio::{decode_ratio, encode_ratio};
pub use relighter::{RelightOptions, Relighter, RelighterConfig, Relit};
pub use training::{HeldOut, RelightTraining, held_out, train_relighter};
