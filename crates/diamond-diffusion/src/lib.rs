//! Diffusion models that invent what was not photographed: an object under other lights, and from other views.
//!
//! | module | what it is |
//! |---|---|
//! | [`nn`] | layers whose gradients are checked, fast on the CPU, and named weights |
//! | [`Schedule`], [`Parameterization`], [`Sampler`] | from noise to picture |
//! | [`unet`] | the networks: one family, from published sizes to small ones |
//! | [`read_weights`], [`WeightsHeader`] | files of weights |
//! | [`Noise`] | seeded random tensors |
//!
//! Invariant: what is random is drawn from a seed. The same seed gives the same bits on the same machine, for any number of threads;
//! matrix products choose instructions by processor, so other machines may differ in last bits.
pub mod nn;
pub mod unet;

mod error;
#[cfg(test)]
mod gradient_check;
mod noise;
mod parameterization;
mod sampler;
mod schedule;
mod weights;

pub use error::{DiffusionError, Result};
pub use noise::Noise;
pub use parameterization::{Parameterization, Recovery, add_noise, combine};
pub use sampler::{Sampler, Spacing, guided, shared_noise};
pub use schedule::{Level, Schedule};
pub use weights::{NumberType, StoredTensor, WeightsHeader, read_weights, write_weights};
