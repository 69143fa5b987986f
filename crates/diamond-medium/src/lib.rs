//! A homogeneous medium inside a surface: fitted to a few photographs, and the light that leaves it under any lights.
mod carve;
mod error;
mod exitance;
mod fit;
mod medium;
mod near;
mod orient;
mod surface;
mod walk_fit;
pub use carve::{CarveOptions, OrientedPoint, Silhouette, carve, hull_bounds};
pub use error::MediumError;
pub use exitance::Exitance;
pub use fit::{COATS, FitImage, FitOptions, fit_profile, offered_widths};
pub use medium::{Coat, Described, Medium, Quality, Transport};
pub use near::Near;
pub use orient::outward_normals;
pub use surface::{Attachment, Surface};
pub use walk_fit::fit_walk;
