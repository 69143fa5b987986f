//! Intrinsics, poses, projection π and unprojection π⁻¹ with pullbacks, rays.
//!
//! World and camera are right-handed; the camera looks along +z, x right, y down (OpenCV). [`Pose`] maps world to
//! camera. Pixel centres are at +0.5. Depth is view-space z unless the type says [`Depth::Distance`].
mod camera;
mod depth;
mod intrinsics;
mod pose;

pub use camera::{Camera, Ray};
pub use depth::Depth;
pub use intrinsics::Intrinsics;
pub use pose::{CameraError, Pose};
