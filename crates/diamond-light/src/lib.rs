//! One-light-at-a-time (OLAT) lights, light rigs, and real spherical harmonics.
//!
//! Light directions point from the surface to the light and have unit length.
mod olat;
pub mod spherical_harmonics;

pub use olat::{Falloff, Incidence, OlatLight};
