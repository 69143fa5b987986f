//! Diffusion models that invent what was not photographed: an object under other lights, and from other views.
//!
//! | module | what it is |
//! |---|---|
//! | [`nn`] | layers whose gradients are checked, fast on the CPU, and named weights |
//! | [`Schedule`], [`Parameterization`], [`Sampler`] | from noise to picture |
//! | [`unet`] | the networks: one family, from published sizes to small ones |
//! | [`FirstStage`] | from pictures to what is diffused and back: [`KlVae`], [`SpaceToDepth`], [`Identity`] |
//! | [`ray_map`], [`light_code`] | cameras and lights as numbers that a network can read |
//! | [`relight`] | the relighter: ratios of pictures to predictions, physical hints, examples from shards, errors on held-out objects |
//! | [`train`] | the objective, AdamW, steps that can be resumed |
//! | [`read_weights`], [`WeightsHeader`], [`published`] | files of weights, and names of published ones |
//! | [`Noise`] | seeded random tensors |
//!
//! Invariant: what is random is drawn from a seed. The same seed gives the same bits on the same machine, for any number of threads;
//! matrix products choose instructions by processor, so other machines may differ in last bits.
pub mod nn;
pub mod published;
pub mod relight;
pub mod train;
pub mod unet;

mod error;
mod first_stage;
#[cfg(test)]
mod gradient_check;
mod light_code;
mod noise;
mod parameterization;
mod ray_embedding;
mod sampler;
mod schedule;
mod vae;
mod weights;

pub use error::{DiffusionError, Result};
pub use first_stage::{FirstStage, Identity, SpaceToDepth};
pub use light_code::{light_code, light_codes};
pub use noise::Noise;
pub use parameterization::{Parameterization, Recovery, add_noise, combine};
pub use ray_embedding::{ray_embedding, ray_map, relative_camera};
pub use sampler::{Sampler, Spacing, guided, shared_noise};
pub use schedule::{Level, Schedule};
pub use vae::{KlVae, VaeConfig};
pub use weights::{NumberType, StoredTensor, WeightsHeader, read_weights, weights_of_bytes, write_weights};
