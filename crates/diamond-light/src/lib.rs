//! One-light-at-a-time (OLAT) lights, light rigs, and real spherical harmonics.
//!
//! Invariant: nothing here knows of surfaces, cameras or files.
//!
//! Light directions point from the surface to the light and have unit length. Intensities are linear RGB; lengths are
//! scene units. [`OlatLight::incidence`] is all that shading needs of a light, [`OlatLight::incidence_pull`] its reverse.
//!
//! ```
//! use diamond_light::{Falloff, LightRig};
//! use glam::Vec3;
//! // Twelve lights above an object at the origin, three units away, one unit of irradiance each at the object.
//! let rig = LightRig::dome(12, Vec3::ZERO, Vec3::Z, 3.0, 0.2, Vec3::ONE)?;
//! let falloff = Falloff::InverseSquare { reference: 3.0 };
//! for light in &rig.lights {
//!     let incidence = light.incidence(Vec3::ZERO, falloff);
//!     assert!((incidence.irradiance - Vec3::ONE).length() < 1e-5);
//! }
//! # Ok::<(), diamond_light::LightError>(())
//! ```
mod error;
mod olat;
mod rig;
pub mod spherical_harmonics;

pub use error::LightError;
pub use olat::{Falloff, Incidence, IncidenceGrad, IncidencePull, MIN_LIGHT_DISTANCE, OlatLight};
pub use rig::LightRig;
