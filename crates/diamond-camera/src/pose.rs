//! Rigid transforms from world to camera.
use glam::{Mat3, Mat4, Vec3};

/// What can be wrong with a camera.
#[derive(Debug, Clone, PartialEq)]
pub enum CameraError {
    /// A matrix has NaN, infinity, or is no rotation plus translation (up to uniform scale).
    NotRigid {
        /// Which matrix.
        what: &'static str,
        /// What was found.
        found: String,
    },
}

impl std::fmt::Display for CameraError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            CameraError::NotRigid { what, found } => {
                write!(f, "{what}: expected a finite rigid transform (rotation and translation), found {found}")
            }
        }
    }
}

impl std::error::Error for CameraError {}

/// Rigid transform from world to camera: `p_camera = rotation · p_world + translation`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Rotation from world axes to camera axes.
    pub rotation: Mat3,
    /// The world origin in camera coordinates, scene units.
    pub translation: Vec3,
}

/// How far RᵀR may be from the identity for a matrix read from a file: text files carry six digits.
const ORTHONORMAL_TOLERANCE: f32 = 1e-3;

impl Pose {
    /// World and camera coincide.
    pub const IDENTITY: Pose = Pose { rotation: Mat3::IDENTITY, translation: Vec3::ZERO };

    /// A camera at `eye` that looks at `target`; `up` is the world direction that should appear upward.
    /// Falls back to another up where `up` is parallel to the view.
    pub fn look_at(eye: Vec3, target: Vec3, up: Vec3) -> Self {
        let forward = (target - eye).try_normalize().unwrap_or(Vec3::Z);
        let right = forward.cross(up).try_normalize().unwrap_or_else(|| forward.any_orthonormal_vector());
        let down = forward.cross(right);
        let rotation = Mat3::from_cols(right, down, forward).transpose();
        Self { rotation, translation: -(rotation * eye) }
    }

    /// From a camera-to-world matrix in OpenGL axes (x right, y up, z back), as NeRF's `transform_matrix`.
    pub fn from_opengl_camera_to_world(matrix: Mat4) -> Result<Self, CameraError> {
        let fail = |found: String| CameraError::NotRigid { what: "transform_matrix (camera to world)", found };
        if !matrix.is_finite() {
            return Err(fail(format!("a value that is not finite in {matrix}")));
        }
        let axes = Mat3::from_mat4(matrix);
        let scale = axes.determinant().cbrt();
        if scale.is_nan() || scale <= 1e-8 {
            return Err(fail(format!("determinant {} (a mirrored or flat matrix)", axes.determinant())));
        }
        let axes = axes * (1.0 / scale);
        let error =
            (axes.transpose() * axes - Mat3::IDENTITY).to_cols_array().iter().fold(0.0f32, |m, v| m.max(v.abs()));
        if error > ORTHONORMAL_TOLERANCE {
            return Err(fail(format!("axes that are not orthonormal (largest error {error:.2e})")));
        }
        let camera_to_world = Mat3::from_cols(axes.x_axis, -axes.y_axis, -axes.z_axis);
        let rotation = camera_to_world.transpose();
        let eye = matrix.w_axis.truncate();
        Ok(Self { rotation, translation: -(rotation * eye) })
    }

    /// The inverse of [`Pose::from_opengl_camera_to_world`].
    pub fn to_opengl_camera_to_world(&self) -> Mat4 {
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
}
