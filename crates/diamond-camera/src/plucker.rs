//! Plücker coordinates of pixel rays: a camera as an image that a network can read.
//!
//! A line with unit direction d through any of its points o is (d, o × d): six numbers that do not depend on which point
//! was chosen, with d·(o × d) = 0. The moment's length is the line's distance from the world origin.
use crate::Camera;
use glam::Vec2;

impl Camera {
    /// Plücker coordinates (d, o × d) of the ray through pixel coordinates: unit direction in world axes, then the moment
    /// about the world origin in scene units.
    /// `[eq:plucker]`
    pub fn plucker(&self, pixel: Vec2) -> [f32; 6] {
        let ray = self.ray(pixel);
        let (d, m) = (ray.direction, ray.origin.cross(ray.direction));
        [d.x, d.y, d.z, m.x, m.y, m.z]
    }
}

/// [`Camera::plucker`] of every pixel centre: `width·height` entries, row-major.
///
/// ```
/// use diamond_camera::{Camera, Intrinsics, Pose, plucker_map};
/// let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.8, 8, 6), pose: Pose::IDENTITY };
/// let map = plucker_map(&camera);
/// assert_eq!(map.len(), 48);
/// assert!(map[0][0] < 0.0 && map[0][1] < 0.0); // the first pixel is at the top left
/// assert_eq!(map[0][3..], [0.0; 3]); // a camera at the origin: no moment
/// ```
pub fn plucker_map(camera: &Camera) -> Vec<[f32; 6]> {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    (0..height)
        .flat_map(|y| (0..width).map(move |x| camera.plucker(Vec2::new(x as f32 + 0.5, y as f32 + 0.5))))
        .collect()
}
