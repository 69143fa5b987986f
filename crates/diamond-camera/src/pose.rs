//! Rigid transforms from world to camera.
use crate::CameraError;
use glam::{Mat3, Mat4, Quat, Vec3};

/// Rigid transform from world to camera: `p_camera = rotation · p_world + translation`.
///
/// ```
/// use diamond_camera::Pose;
/// use glam::Vec3;
/// let pose = Pose::look_at(Vec3::new(0.0, -4.0, 1.0), Vec3::ZERO, Vec3::Z);
/// assert!((pose.centre() - Vec3::new(0.0, -4.0, 1.0)).length() < 1e-6);
/// assert!(pose.transform_point(Vec3::ZERO).z > 4.0); // the target lies ahead, along +z
/// assert!(pose.transform_point(Vec3::Z).y < 0.0); // what is up in the world has smaller y (rows go down)
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Rotation from world axes to camera axes.
    pub rotation: Mat3,
    /// The world origin in camera coordinates, scene units.
    pub translation: Vec3,
}

/// How far RᵀR may be from the identity for a matrix read from a file: text files carry six digits.
const ORTHONORMAL_TOLERANCE: f32 = 1e-3;

/// Axes that are this near to orthonormal are as good as `f32` can make them and are kept to the bit, so that what was
/// written by [`Pose::to_opengl_camera_to_world`] comes back unchanged.
const ROUNDING: f32 = 1e-6;

/// The largest element of |RᵀR − 1|, NaN where an element is.
fn orthonormal_error(r: Mat3) -> f32 {
    let gram = r.transpose() * r - Mat3::IDENTITY;
    gram.to_cols_array().iter().fold(0.0, |m, v| if v.is_nan() || m < v.abs() { v.abs() } else { m })
}

/// The right-handed orthonormal axes nearest to nearly orthonormal ones: z kept, x made perpendicular to it.
fn orthonormalised(r: Mat3) -> Mat3 {
    if orthonormal_error(r) <= ROUNDING {
        return r;
    }
    let z = r.z_axis.normalize();
    let x = (r.x_axis - z * z.dot(r.x_axis)).normalize();
    Mat3::from_cols(x, z.cross(x), z)
}

impl Pose {
    /// World and camera coincide.
    pub const IDENTITY: Pose = Pose { rotation: Mat3::IDENTITY, translation: Vec3::ZERO };

    /// From a world-to-camera rotation that need be orthonormal to six digits or so only, and a translation.
    ///
    /// Errors where a number is not finite, the axes are mirrored, or they are not orthonormal to 10⁻³.
    pub fn new(rotation: Mat3, translation: Vec3) -> Result<Self, CameraError> {
        let pose = Self { rotation, translation };
        pose.validate()?;
        Ok(Self { rotation: orthonormalised(rotation), translation })
    }

    /// From a world-to-camera quaternion (any length but 0) and translation, as COLMAP's `images` files have them.
    pub fn from_quaternion(rotation: Quat, translation: Vec3) -> Result<Self, CameraError> {
        let length = rotation.length();
        if !(length.is_finite() && length > 1e-8) {
            let found = format!("a quaternion of length {length}");
            return Err(CameraError::NotRigid { what: "world-to-camera quaternion", found });
        }
        Self::new(Mat3::from_quat(rotation / length), translation)
    }

    /// `Err` where a number is not finite or the rotation is mirrored or not orthonormal to 10⁻³.
    pub fn validate(&self) -> Result<(), CameraError> {
        let fail = |found: String| Err(CameraError::NotRigid { what: "pose (world to camera)", found });
        if !(self.rotation.is_finite() && self.translation.is_finite()) {
            return fail(format!("a value that is not finite in {} | {}", self.rotation, self.translation));
        }
        let error = orthonormal_error(self.rotation);
        if error.is_nan() || error > ORTHONORMAL_TOLERANCE {
            return fail(format!("axes that are not orthonormal (largest error {error:.2e})"));
        }
        if self.rotation.determinant() < 0.0 {
            return fail("mirrored axes (determinant −1)".into());
        }
        Ok(())
    }

    /// A camera at `eye` that looks at `target`; `up` is the world direction that should appear upward.
    /// Falls back to another up where `up` is parallel to the view, and to the view along +z where eye and target
    /// coincide.
    pub fn look_at(eye: Vec3, target: Vec3, up: Vec3) -> Self {
        let forward = (target - eye).try_normalize().unwrap_or(Vec3::Z);
        // Normalised first, so that the test for parallel does not depend on the length of `up`.
        let across = forward.cross(up.try_normalize().unwrap_or(Vec3::ZERO));
        let right = match across.try_normalize() {
            Some(right) if across.length() > ROUNDING => right,
            _ => forward.any_orthonormal_vector(),
        };
        let down = forward.cross(right);
        let rotation = Mat3::from_cols(right, down, forward).transpose();
        Self { rotation, translation: -(rotation * eye) }
    }

    /// From a camera-to-world matrix in OpenGL axes (x right, y up, z back), as NeRF's `transform_matrix`. A uniform
    /// scale of the axes is divided out.
    ///
    /// Errors where a number is not finite, the axes are mirrored, flat or not orthonormal to 10⁻³ after that, or the last
    /// row is not 0 0 0 1.
    pub fn from_opengl_camera_to_world(matrix: Mat4) -> Result<Self, CameraError> {
        let fail = |found: String| CameraError::NotRigid { what: "transform_matrix (camera to world)", found };
        if !matrix.is_finite() {
            return Err(fail(format!("a value that is not finite in {matrix}")));
        }
        let last = matrix.row(3);
        if (last - glam::Vec4::W).abs().max_element() > ORTHONORMAL_TOLERANCE {
            return Err(fail(format!("last row {last} instead of 0 0 0 1 (a transposed or projective matrix)")));
        }
        let axes = Mat3::from_mat4(matrix);
        let scale = libm::cbrtf(axes.determinant());
        if scale.is_nan() || scale <= 1e-8 {
            return Err(fail(format!("determinant {} (a mirrored or flat matrix)", axes.determinant())));
        }
        let axes = if (scale - 1.0).abs() <= ROUNDING { axes } else { axes * (1.0 / scale) };
        let error = orthonormal_error(axes);
        if error.is_nan() || error > ORTHONORMAL_TOLERANCE {
            return Err(fail(format!("axes that are not orthonormal (largest error {error:.2e})")));
        }
        let axes = orthonormalised(axes);
        let camera_to_world = Mat3::from_cols(axes.x_axis, -axes.y_axis, -axes.z_axis);
        let rotation = camera_to_world.transpose();
        let eye = matrix.w_axis.truncate();
        Ok(Self { rotation, translation: -(rotation * eye) })
    }

    /// The inverse of [`Pose::from_opengl_camera_to_world`].
    pub fn to_opengl_camera_to_world(self) -> Mat4 {
        let r = self.rotation.transpose();
        let c = self.centre();
        Mat4::from_cols(r.x_axis.extend(0.0), (-r.y_axis).extend(0.0), (-r.z_axis).extend(0.0), c.extend(1.0))
    }

    /// World point → camera coordinates.
    #[inline]
    pub fn transform_point(&self, world: Vec3) -> Vec3 {
        self.rotation * world + self.translation
    }

    /// Camera coordinates → world point.
    #[inline]
    pub fn inverse_transform_point(&self, camera: Vec3) -> Vec3 {
        self.rotation.transpose() * (camera - self.translation)
    }

    /// The camera centre in world coordinates.
    #[inline]
    pub fn centre(&self) -> Vec3 {
        -(self.rotation.transpose() * self.translation)
    }

    /// Unit direction of the view in world coordinates (the camera's +z).
    #[inline]
    pub fn forward(&self) -> Vec3 {
        self.rotation.row(2)
    }

    /// The pose a fraction `t` (0 … 1) of the way to `other`: centres on a straight line, rotations on the shortest arc
    /// (slerp). `[eq:pose-slerp]`
    pub fn interpolate(&self, other: &Pose, t: f32) -> Pose {
        let a = Quat::from_mat3(&self.rotation);
        let b = Quat::from_mat3(&other.rotation);
        let rotation = Mat3::from_quat(slerp(a, b, t).normalize());
        let centre = self.centre().lerp(other.centre(), t);
        Pose { rotation, translation: -(rotation * centre) }
    }
}

/// From unit quaternion `a` to `b` on the shorter arc. `[eq:pose-slerp]` (sin((1−t)θ)·a + sin(tθ)·b)/sin θ.
fn slerp(a: Quat, b: Quat, t: f32) -> Quat {
    let b = if a.dot(b) < 0.0 { -b } else { b };
    // Half the angle by its sine and cosine: exact for small angles, where 1 − a·b has no digits left.
    let theta = 2.0 * libm::atan2f((a - b).length(), (a + b).length());
    let sin = libm::sinf(theta);
    if sin < SMALL_ANGLE {
        return a * (1.0 - t) + b * t;
    }
    (a * libm::sinf((1.0 - t) * theta) + b * libm::sinf(t * theta)) * (1.0 / sin)
}

/// Below this angle the arc is straight to all digits, and its sine a bad divisor.
const SMALL_ANGLE: f32 = 1e-4;

#[cfg(test)]
mod tests {
    use super::*;

    fn camera_to_world() -> Mat4 {
        Pose::look_at(Vec3::new(1.0, -2.0, 0.5), Vec3::ZERO, Vec3::Z).to_opengl_camera_to_world()
    }

    fn found(matrix: Mat4) -> String {
        Pose::from_opengl_camera_to_world(matrix).unwrap_err().to_string()
    }

    #[test]
    fn matrices_that_are_no_poses_are_refused_with_the_reason() {
        let good = camera_to_world();
        assert!(Pose::from_opengl_camera_to_world(good).is_ok());
        for i in 0..4 {
            for bad in [f32::NAN, f32::INFINITY] {
                let mut m = good;
                m.col_mut(i)[i.min(2)] = bad;
                assert!(found(m).contains("not finite"), "{}", found(m));
            }
        }
        let mut mirrored = good;
        mirrored.x_axis = -mirrored.x_axis;
        assert!(found(mirrored).contains("mirrored"));
        let mut flat = good;
        flat.y_axis = flat.x_axis;
        assert!(found(flat).contains("flat"));
        let mut sheared = good;
        sheared.x_axis += 0.1 * sheared.y_axis;
        assert!(found(sheared).contains("not orthonormal"));
        assert!(found(good.transpose()).contains("last row"));
        let mut huge = good;
        for i in 0..3 {
            *huge.col_mut(i) *= 1e20;
        }
        assert!(Pose::from_opengl_camera_to_world(huge).is_err());
        assert!(found(Mat4::ZERO).contains("last row"));
    }

    #[test]
    fn a_uniform_scale_is_divided_out_and_six_digits_are_repaired() {
        let good = camera_to_world();
        let expected = Pose::from_opengl_camera_to_world(good).unwrap();
        let mut scaled = good;
        for i in 0..3 {
            *scaled.col_mut(i) *= 2.5;
        }
        let pose = Pose::from_opengl_camera_to_world(scaled).unwrap();
        assert!((pose.rotation - expected.rotation).to_cols_array().iter().all(|v| v.abs() < 1e-6));
        let mut rough = good;
        rough.x_axis.x += 3e-4;
        rough.y_axis.z -= 3e-4;
        let pose = Pose::from_opengl_camera_to_world(rough).unwrap();
        assert!(orthonormal_error(pose.rotation) < 1e-6);
        assert!((pose.rotation - expected.rotation).to_cols_array().iter().all(|v| v.abs() < 1e-3));
    }

    #[test]
    fn poses_are_validated() {
        assert!(Pose::IDENTITY.validate().is_ok());
        assert!(Pose { translation: Vec3::NAN, ..Pose::IDENTITY }.validate().is_err());
        assert!(Pose::new(Mat3::from_diagonal(Vec3::new(-1.0, 1.0, 1.0)), Vec3::ZERO).is_err());
        assert!(Pose::new(Mat3::ZERO, Vec3::ZERO).is_err());
        assert!(Pose::from_quaternion(Quat::from_xyzw(0.0, 0.0, 0.0, 0.0), Vec3::ZERO).is_err());
        assert!(Pose::from_quaternion(Quat::from_xyzw(f32::NAN, 0.0, 0.0, 1.0), Vec3::ZERO).is_err());
        let pose = Pose::from_quaternion(Quat::from_xyzw(0.0, 0.0, 3.0, 3.0), Vec3::ONE).unwrap();
        assert!((pose.rotation * Vec3::X - Vec3::Y).length() < 1e-6);
    }

    #[test]
    fn look_at_survives_degenerate_input() {
        for up in [Vec3::Z, -Vec3::Z, Vec3::ZERO, Vec3::Z * 1e-30, Vec3::new(1e-12, 0.0, 1.0)] {
            let pose = Pose::look_at(Vec3::new(0.0, 0.0, 5.0), Vec3::ZERO, up);
            assert!(pose.validate().is_ok(), "up {up}: {pose:?}");
            assert!((pose.forward() + Vec3::Z).length() < 1e-6);
        }
        assert!(Pose::look_at(Vec3::ONE, Vec3::ONE, Vec3::Y).validate().is_ok());
    }
}
