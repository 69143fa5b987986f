//! Photometric stereo for translucent objects: what one view under several known lights says about shape.
//!
//! Brightness that changes with the light shows which way a surface faces. On a translucent body it shows that
//! blurred: light enters, wanders and leaves elsewhere, so that places shine that no light reaches. What is done about it,
//! each for a measured gain, is in the table; it takes the error of the textbook's method to half or less, on wax with a
//! glossy coat. It remains a blurred cue, and [`PhotometricStereo::confidence`] says where.
//!
//! | what | how |
//! |---|---|
//! | lights that are near | directions and falloff from where the surface is, which is found in turns with the normals |
//! | light that comes through | lights that lean toward the camera by as much as explains the images best; the channel that scatters least, less what the one that scatters most shows too |
//! | shadows and highlights | robust weights; shadows that the found relief throws |
//! | few lights | a pull toward a relief that begins as the inflated silhouette |
//!
//! Invariant: one camera, one mask, at least three images and their lights go in. Nothing here knows of other views.
//!
//! ```
//! use diamond_camera::{Camera, Intrinsics, Pose};
//! use diamond_image::{Image, Mask};
//! use diamond_light::{Falloff, OlatLight};
//! use diamond_photometric::*;
//! use glam::{Vec2, Vec3};
//! // A matte ball of radius 1 at the origin, three units away.
//! let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.9, 48, 48), pose: Pose::look_at(Vec3::NEG_Y * 3.0, Vec3::ZERO, Vec3::Z) };
//! let lights: Vec<OlatLight> = [Vec3::ZERO, Vec3::X, Vec3::Z, -Vec3::X, -Vec3::Z]
//!     .iter()
//!     .map(|side| OlatLight::Point { position: 4.0 * (Vec3::NEG_Y + *side).normalize(), intensity: Vec3::ONE })
//!     .collect();
//! let falloff = Falloff::InverseSquare { reference: 4.0 };
//! let normal = |i: usize| {
//!     let ray = camera.ray(Vec2::new((i % 48) as f32 + 0.5, (i / 48) as f32 + 0.5));
//!     let b = ray.origin.dot(ray.direction);
//!     let under = b * b - ray.origin.length_squared() + 1.0;
//!     (under > 0.0).then(|| ray.origin + ray.direction * (-b - under.sqrt()))
//! };
//! let mask = Mask::from_vec(48, 48, (0..48 * 48).map(|i| f32::from(normal(i).is_some())).collect())?;
//! let images: Vec<Image> = lights
//!     .iter()
//!     .map(|light| {
//!         let shade = |i: usize| normal(i).map_or(0.0, |n| {
//!             let incidence = light.incidence(n, falloff);
//!             incidence.irradiance.x * n.dot(incidence.direction).max(0.0)
//!         });
//!         Image::from_vec(48, 48, 1, (0..48 * 48).map(shade).collect()).unwrap()
//!     })
//!     .collect();
//! let images: Vec<&Image> = images.iter().collect();
//! let view = PhotometricView { camera: &camera, mask: &mask, images: &images, lights: &lights, falloff, distance: 3.0 };
//! let found = photometric_stereo(&view, &PhotometricOptions::default())?;
//! let middle = Vec3::from_slice(found.normals.pixel(24, 24));
//! assert!(middle.angle_between(Vec3::NEG_Y).to_degrees() < 3.0);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
mod cast_shadow;
mod confidence;
mod error;
mod estimate;
mod naive;
mod normal_fit;
mod object_pixels;
mod relief;
mod response;
#[cfg(test)]
mod scenes;
mod sharpest_channel;
mod spread;

pub use confidence::{Doubts, HALF_CONFIDENCE_DEGREES};
pub use error::PhotometricError;
pub use estimate::{PhotometricOptions, PhotometricStereo, PhotometricView, photometric_stereo, silhouette_normals};
pub use naive::naive_normals;
pub use response::leaned;
pub use sharpest_channel::Channels;
