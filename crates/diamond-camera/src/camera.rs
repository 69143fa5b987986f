//! A posed camera: π, π⁻¹ and rays, each with its pullback.
//!
//! π takes a world point to pixel coordinates and view-space z, π⁻¹ takes pixel coordinates and a depth of either kind
//! back to the world point. They are inverses of each other wherever a point lies before the camera.
//!
//! ```
//! use diamond_camera::{Camera, Depth, Intrinsics, Pose};
//! use glam::Vec3;
//! let pose = Pose::look_at(Vec3::new(0.0, -3.0, 0.0), Vec3::ZERO, Vec3::Z);
//! let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.8, 128, 128), pose };
//! let point = Vec3::new(0.2, 0.1, -0.3);
//! let (pixel, z) = camera.project(point).unwrap();
//! assert!((camera.unproject(pixel, Depth::Z(z)) - point).length() < 1e-5);
//! ```
use crate::{CameraError, Depth, Intrinsics, Pose};
use glam::{Vec2, Vec3};

/// Points at or nearer than this view-space z cannot be projected (scene units; guards the division by z only,
/// renderers cull at a larger, scene-scaled distance).
const MIN_Z: f32 = 1e-6;

/// Points whose pixel coordinates would exceed this are not projected: no image is that wide, and the pullback's
/// d_pixel·pixel/z still fits an `f32`.
const MAX_PIXEL: f32 = 1e9;

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
    /// `Err` where the intrinsics or the pose are unusable; see [`Intrinsics::validate`] and [`Pose::validate`].
    pub fn validate(&self) -> Result<(), CameraError> {
        self.intrinsics.validate()?;
        self.pose.validate()
    }

    /// Camera coordinates and pixel of a world point before the camera.
    #[inline]
    fn project_camera(&self, world: Vec3) -> Option<(Vec3, Vec2)> {
        let p = self.pose.transform_point(world);
        if !p.is_finite() || p.z <= MIN_Z {
            return None;
        }
        let k = &self.intrinsics;
        let pixel = Vec2::new(k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy);
        // Written so that NaN fails it.
        (pixel.x.abs() <= MAX_PIXEL && pixel.y.abs() <= MAX_PIXEL).then_some((p, pixel))
    }

    /// π: world point → pixel coordinates and view-space z; `None` at or behind the camera (z ≤ 10⁻⁶), and so far to the
    /// side that the pixel coordinates exceed 10⁹.
    /// `[eq:project]`
    pub fn project(&self, world: Vec3) -> Option<(Vec2, f32)> {
        self.project_camera(world).map(|(p, pixel)| (pixel, p.z))
    }

    /// Pullback of [`Camera::project`] with respect to the world point; zero where it gives `None`.
    /// `[eq:project]`
    pub fn project_pull(&self, world: Vec3, d_pixel: Vec2, d_z: f32) -> Vec3 {
        let Some((p, _)) = self.project_camera(world) else {
            return Vec3::ZERO;
        };
        let k = &self.intrinsics;
        let inv_z = 1.0 / p.z;
        let slope = Vec2::new(k.fx * p.x, k.fy * p.y) * inv_z;
        let d_camera = Vec3::new(d_pixel.x * k.fx * inv_z, d_pixel.y * k.fy * inv_z, d_z - d_pixel.dot(slope) * inv_z);
        self.pose.rotation.transpose() * d_camera
    }

    /// Direction through a pixel in camera coordinates with z = 1.
    #[inline]
    pub fn pixel_direction(&self, pixel: Vec2) -> Vec3 {
        let k = &self.intrinsics;
        Vec3::new((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy, 1.0)
    }

    /// π⁻¹: pixel coordinates and depth → world point.
    /// `[eq:unproject]`
    pub fn unproject(&self, pixel: Vec2, depth: Depth) -> Vec3 {
        let q = self.pixel_direction(pixel);
        let z = match depth {
            Depth::Z(z) => z,
            Depth::Distance(distance) => distance / q.length(),
        };
        self.pose.inverse_transform_point(q * z)
    }

    /// Pullback of [`Camera::unproject`]: `(d_pixel, d_depth)` of the cotangent of the world point; `d_depth` is of the
    /// kind of `depth`.
    /// `[eq:unproject]`
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

    /// The view-space z of a depth at a pixel; the inverse of [`Camera::to_distance`].
    /// `[eq:depth-kinds]`
    pub fn to_z(self, pixel: Vec2, depth: Depth) -> f32 {
        match depth {
            Depth::Z(z) => z,
            Depth::Distance(distance) => distance / self.pixel_direction(pixel).length(),
        }
    }

    /// The Euclidean distance from the camera centre of a depth at a pixel.
    /// `[eq:depth-kinds]`
    pub fn to_distance(self, pixel: Vec2, depth: Depth) -> f32 {
        match depth {
            Depth::Z(z) => z * self.pixel_direction(pixel).length(),
            Depth::Distance(distance) => distance,
        }
    }

    /// The world ray through pixel coordinates.
    pub fn ray(&self, pixel: Vec2) -> Ray {
        let direction = (self.pose.rotation.transpose() * self.pixel_direction(pixel)).normalize();
        Ray { origin: self.pose.centre(), direction }
    }

    /// The same view resampled to `width` × `height` pixels; see [`Intrinsics::resized`].
    pub fn resized(&self, width: u32, height: u32) -> Self {
        Self { intrinsics: self.intrinsics.resized(width, height), ..*self }
    }
}

impl Ray {
    /// The point at `distance` (scene units) along the ray.
    #[inline]
    pub fn at(&self, distance: f32) -> Vec3 {
        self.origin + self.direction * distance
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::adjoint::{adjoint_gap, relative_l2};
    use diamond_testkit::camera::{project, unproject_distance, unproject_z};
    use diamond_testkit::strategies::{extreme, finite, rotation_wxyz, vector};
    use diamond_testkit::{Dual, Real, jvp, vjp};
    use glam::{Mat3, Quat};
    use proptest::prelude::*;

    /// Any rotation, a centre near the origin, off-centre principal point, pixels that are not square.
    fn camera() -> impl Strategy<Value = Camera> + Clone {
        let pinhole = [finite(40.0..300.0), finite(40.0..300.0), finite(-20.0..150.0), finite(-20.0..150.0)];
        (pinhole, rotation_wxyz(), vector(-2.0..2.0)).prop_map(|([fx, fy, cx, cy], [w, x, y, z], t)| Camera {
            intrinsics: Intrinsics { fx, fy, cx, cy, width: 128, height: 96 },
            pose: Pose { rotation: Mat3::from_quat(Quat::from_xyzw(x, y, z, w)), translation: t.into() },
        })
    }

    type Constants = ([Dual; 4], [[Dual; 3]; 3], [Dual; 3]);

    fn constants(c: &Camera) -> Constants {
        let of = |v: f32| Dual::of(f64::from(v));
        let k = c.intrinsics;
        let rotation = [0, 1, 2].map(|i| c.pose.rotation.row(i).to_array().map(of));
        ([k.fx, k.fy, k.cx, k.cy].map(of), rotation, c.pose.translation.to_array().map(of))
    }

    fn wide(v: &[f32]) -> Vec<f64> {
        v.iter().map(|&v| f64::from(v)).collect()
    }

    fn value(y: Vec<Dual>) -> Vec<f64> {
        y.iter().map(|y| y.v).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// [eq:project]: value, gradient and adjoint identity against dual numbers.
        #[test]
        fn project_and_its_pullback_agree_with_the_oracle(
            c in camera(), x in finite(-1.0..1.0), y in finite(-1.0..1.0), z in finite(0.3..8.0),
            d in vector(-1.0..1.0), t in [-1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0],
        ) {
            let world = c.pose.inverse_transform_point(Vec3::new(x * z, y * z, z));
            let (k, r, tr) = constants(&c);
            let oracle = |p: &[Dual]| project(k, r, tr, [p[0], p[1], p[2]]).to_vec();
            let at = wide(&world.to_array());
            let seed: Vec<Dual> = at.iter().map(|&v| Dual::of(v)).collect();
            let (pixel, depth) = c.project(world).unwrap();
            let error = relative_l2(&wide(&[pixel.x, pixel.y, depth]), &value(oracle(&seed)), 1.0);
            prop_assert!(error <= 1e-5, "value: {error:e}");
            let got = wide(&c.project_pull(world, Vec2::new(d[0], d[1]), d[2]).to_array());
            let expected = vjp(oracle, &at, &wide(&d));
            let error = relative_l2(&got, &expected, 1e-1);
            prop_assert!(error <= 1e-4, "gradient: {error:e}, {got:?} instead of {expected:?}");
            prop_assert!(adjoint_gap(&wide(&d), &jvp(oracle, &at, &t), &got, &t) <= 1e-4);
        }

        /// [eq:unproject]: the same for both kinds of depth.
        #[test]
        fn unproject_and_its_pullback_agree_with_the_oracle(
            c in camera(), u in finite(-30.0..160.0), v in finite(-30.0..130.0), depth in finite(0.1..8.0),
            kind in prop::bool::ANY, d in vector(-1.0..1.0), t in [-1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0],
        ) {
            let (k, r, tr) = constants(&c);
            let oracle = |p: &[Dual]| {
                let pixel = [p[0], p[1]];
                if kind { unproject_z(k, r, tr, pixel, p[2]) } else { unproject_distance(k, r, tr, pixel, p[2]) }.to_vec()
            };
            let typed = if kind { Depth::Z(depth) } else { Depth::Distance(depth) };
            let at = wide(&[u, v, depth]);
            let seed: Vec<Dual> = at.iter().map(|&v| Dual::of(v)).collect();
            let got = wide(&c.unproject(Vec2::new(u, v), typed).to_array());
            prop_assert!(relative_l2(&got, &value(oracle(&seed)), 1.0) <= 1e-5);
            let (d_pixel, d_depth) = c.unproject_pull(Vec2::new(u, v), typed, d.into());
            let got = wide(&[d_pixel.x, d_pixel.y, d_depth]);
            let expected = vjp(oracle, &at, &wide(&d));
            let pixels = relative_l2(&got[..2], &expected[..2], 1e-3);
            let depths = relative_l2(&got[2..], &expected[2..], 1e-2);
            prop_assert!(pixels <= 1e-4 && depths <= 1e-4, "{got:?} instead of {expected:?}");
            prop_assert!(adjoint_gap(&wide(&d), &jvp(oracle, &at, &t), &got, &t) <= 1e-4);
        }

        #[test]
        fn any_finite_point_projects_finitely_or_not_at_all(
            c in camera(), x in extreme(), y in extreme(), z in extreme(), d in vector(-1e3..1e3),
        ) {
            let world = Vec3::new(x, y, z);
            if let Some((pixel, z)) = c.project(world) {
                prop_assert!(pixel.is_finite() && z.is_finite());
            }
            prop_assert!(c.project_pull(world, Vec2::new(d[0], d[1]), d[2]).is_finite());
        }
    }

    #[test]
    fn points_at_and_behind_the_camera_are_not_projected() {
        let intrinsics = Intrinsics::from_fov_x(0.8, 64, 64);
        let c = Camera { intrinsics, pose: Pose::IDENTITY };
        for world in [Vec3::ZERO, -Vec3::Z, Vec3::X, Vec3::new(1e6, 0.0, 1e-5), Vec3::NAN, Vec3::splat(f32::INFINITY)] {
            assert_eq!(c.project(world), None, "{world}");
            assert_eq!(c.project_pull(world, Vec2::ONE, 1.0), Vec3::ZERO);
        }
        assert_eq!(c.project(Vec3::Z), Some((Vec2::new(32.0, 32.0), 1.0)));
        assert!(c.validate().is_ok());
        assert!(Camera { pose: Pose { translation: Vec3::NAN, ..c.pose }, ..c }.validate().is_err());
        assert!(Camera { intrinsics: Intrinsics { fx: 0.0, ..intrinsics }, ..c }.validate().is_err());
    }
}
