//! A posed camera: π, π⁻¹ and rays, each with its pullback.
use crate::{Depth, Intrinsics, Pose};
use glam::{Vec2, Vec3};

/// Points at or nearer than this view-space z cannot be projected (scene units; guards the division by z only,
/// renderers cull at a larger, scene-scaled distance).
const MIN_Z: f32 = 1e-6;

/// A ray in world coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Origin, scene units.
    pub origin: Vec3,
    /// Unit direction.
    pub direction: Vec3,
}

/// Intrinsics and pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Focal lengths, principal point, image size.
    pub intrinsics: Intrinsics,
    /// World → camera.
    pub pose: Pose,
}

impl Camera {
    /// π: world point → pixel coordinates and view-space z; `None` at or behind the camera.
    pub fn project(&self, world: Vec3) -> Option<(Vec2, f32)> {
        let p = self.pose.transform_point(world);
        if p.z <= MIN_Z || p.z.is_nan() {
            return None;
        }
        let k = &self.intrinsics;
        Some((Vec2::new(k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy), p.z))
    }

    /// Pullback of [`Camera::project`] with respect to the world point; zero where it gives `None`.
    pub fn project_pull(&self, world: Vec3, d_pixel: Vec2, d_z: f32) -> Vec3 {
        let p = self.pose.transform_point(world);
        if p.z <= MIN_Z || p.z.is_nan() {
            return Vec3::ZERO;
        }
        let k = &self.intrinsics;
        let inv_z = 1.0 / p.z;
        let d_camera = Vec3::new(
            d_pixel.x * k.fx * inv_z,
            d_pixel.y * k.fy * inv_z,
            d_z - (d_pixel.x * k.fx * p.x + d_pixel.y * k.fy * p.y) * inv_z * inv_z,
        );
        self.pose.rotation.transpose() * d_camera
    }

    /// Direction through a pixel in camera coordinates with z = 1.
    #[inline]
    pub fn pixel_direction(&self, pixel: Vec2) -> Vec3 {
        let k = &self.intrinsics;
        Vec3::new((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy, 1.0)
    }

    /// π⁻¹: pixel coordinates and depth → world point.
    pub fn unproject(&self, pixel: Vec2, depth: Depth) -> Vec3 {
        let q = self.pixel_direction(pixel);
        let z = match depth {
            Depth::Z(z) => z,
            Depth::Distance(distance) => distance / q.length(),
        };
        self.pose.inverse_transform_point(q * z)
    }

    /// Pullback of [`Camera::unproject`]: `(d_pixel, d_depth)` of the cotangent of the world point.
    pub fn unproject_pull(&self, pixel: Vec2, depth: Depth, d_world: Vec3) -> (Vec2, f32) {
        let k = &self.intrinsics;
        let q = self.pixel_direction(pixel);
        let d_camera = self.pose.rotation * d_world;
        let (d_q, d_depth) = match depth {
            Depth::Z(z) => (d_camera * z, d_camera.dot(q)),
            Depth::Distance(distance) => {
                let length = q.length();
                let unit = q / length;
                let along = d_camera.dot(unit);
                ((d_camera - unit * along) * (distance / length), along)
            }
        };
        (Vec2::new(d_q.x / k.fx, d_q.y / k.fy), d_depth)
    }

    /// The world ray through pixel coordinates.
    pub fn ray(&self, pixel: Vec2) -> Ray {
        let direction = (self.pose.rotation.transpose() * self.pixel_direction(pixel)).normalize();
        Ray { origin: self.pose.centre(), direction }
    }
}
