//! Dual numbers, naive f64 oracles of every formula, the adjoint test, and proptest strategies.
//!
//! Invariant: depends on no crate of ours, so an oracle can never share a mistake with what it judges.
pub mod adjoint;
pub mod camera;
pub mod ggx;
pub mod image;
pub mod light;
mod real;
pub mod strategies;

pub use real::{Dual, Real, gradient, jvp, vjp};
