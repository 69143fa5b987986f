//! A homogeneous medium inside a surface: fitted to a few photographs, and the light that leaves it under any light.
//!
//! Steps, each of use on its own:
//!
//! - [`carve`] makes a closed [`Surface`] from points and silhouettes, with surfels between which light is carried;
//! - [`fit_profile`] and [`fit_walk`] find a [`Medium`] in it that explains photographs under known lights: a radial profile by least squares, or σ_t and albedo by random
//!   walks. Everything is linear in the light, so one photograph is enough to render lights that nobody lit;
//! - [`Exitance`] is the light that leaves each surfel under any lights, [`MediumPictures`] what a camera sees of it;
//! - [`Prior`] makes pictures that nobody took of it, with a confidence that its error on the photographs decides, as a [`Source`](diamond_augment::Source).
//!
//! This crate knows surfaces and photographs. It knows neither Gaussians nor networks nor how a run goes on; `diamond-reconstruct` makes a part of its model of it.
//!
//! ```
//! use diamond_light::{Falloff, OlatLight};
//! use diamond_medium::{Exitance, Medium, Surface};
//! use diamond_pathtrace::Mesh;
//! use glam::Vec3;
//! let surface = Surface::new(Mesh::icosphere(Vec3::ZERO, 1.0, 3), 500)?;
//! let medium = Medium::parse("unit = 1\n[transport]\nkind = \"profile\"\nwidths = [0.2]\nweights = [[0.8, 0.5, 0.3]]\n\
//!     local = [0, 0, 0]\n[coat]\nroughness = 0.3\nscale = 1\n")?;
//! let lamp = OlatLight::Directional { direction: Vec3::Z, irradiance: Vec3::ONE };
//! let leaving = &Exitance::new(&surface, &medium)?.under(&surface, &[lamp], Falloff::None)?[0];
//! // Light goes round the edge: surfels a little below the equator, where no light arrives, shine too.
//! let below = surface.patches().iter().position(|p| p.position.z < -0.1 && p.position.z > -0.2);
//! assert!(below.is_some_and(|j| leaving[3 * j] > 0.001));
//! # Ok::<(), diamond_medium::MediumError>(())
//! ```
mod carve;
mod error;
mod exitance;
mod fit;
mod medium;
mod near;
mod orient;
mod photograph;
mod prior;
mod sight;
mod surface;
mod walk_fit;
pub use carve::{CarveOptions, OrientedPoint, Silhouette, carve, hull_bounds};
pub use error::MediumError;
pub use exitance::Exitance;
pub use fit::{COATS, FitOptions, fit_profile, offered_widths};
pub use medium::{Coat, Described, Medium, Quality, Transport};
pub use near::Near;
pub use orient::outward_normals;
pub use photograph::{FitImage, FitPhotograph};
pub use prior::{Prior, PriorOptions};
pub use sight::{MediumPictures, Sight};
pub use surface::{Attachment, Surface};
pub use walk_fit::fit_walk;
