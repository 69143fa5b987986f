//! Dual numbers, naive f64 oracles of every formula, the adjoint test, and proptest strategies.
//!
//! Invariant: depends on no crate of ours, so an oracle can never share a mistake with what it judges.
pub mod adjoint;
pub mod camera;
pub mod consistency;
pub mod deferred;
pub mod ggx;
pub mod image;
pub mod light;
pub mod losses;
pub mod metrics;
pub mod mlp;
pub mod pseudo_normal;
mod real;
pub mod splat;
pub mod strategies;
pub mod surfel_transport;
pub mod visibility;

pub use real::{Dual, Real, gradient, jvp, vjp};
