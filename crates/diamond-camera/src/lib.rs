//! Intrinsics, poses, projection π and unprojection π⁻¹ with pullbacks, rays, rigs and trajectories.
//!
//! Invariant: nothing here knows of images' contents, lights or files.
//!
//! World and camera are right-handed; the camera looks along +z, x right, y down (OpenCV). [`Pose`] maps world to
//! camera. Pixel centres are at +0.5. Depth is view-space z unless the type says [`Depth::Distance`].
//!
//! ```
//! use diamond_camera::{Camera, Intrinsics, Pose};
//! use glam::{Vec2, Vec3};
//! let pose = Pose::look_at(Vec3::new(0.0, 0.0, 3.0), Vec3::ZERO, Vec3::Y);
//! let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.7, 128, 128), pose };
//! camera.validate()?;
//! let (pixel, z) = camera.project(Vec3::ZERO).expect("the origin is before the camera");
//! assert_eq!((pixel, z), (Vec2::splat(64.0), 3.0));
//! // One unit of world-x moves the point right by fx/z pixels; its pullback says so.
//! let d_world = camera.project_pull(Vec3::ZERO, Vec2::X, 0.0);
//! assert!((d_world.x - camera.intrinsics.fx / z).abs() < 1e-4);
//! # Ok::<(), diamond_camera::CameraError>(())
//! ```
mod camera;
mod depth;
mod distortion;
mod error;
mod intrinsics;
mod plucker;
mod pose;
mod rig;
mod trajectory;

pub use camera::{Camera, Ray};
pub use depth::Depth;
pub use distortion::Distortion;
pub use error::CameraError;
pub use intrinsics::Intrinsics;
pub use plucker::plucker_map;
pub use pose::Pose;
pub use rig::CameraRig;
pub use trajectory::Trajectory;
