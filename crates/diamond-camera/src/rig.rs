//! Camera rigs: cameras around an object, for captures that are rendered and for views that were never photographed.
use crate::{Camera, CameraError, Intrinsics, Pose, Trajectory};
use glam::Vec3;

/// π·(3 − √5): turning by this angle from one camera to the next leaves no two cameras in one direction.
const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;

/// A set of cameras that look at one target.
///
/// ```
/// use diamond_camera::{CameraRig, Intrinsics};
/// use glam::Vec3;
/// let rig = CameraRig::dome(24, Intrinsics::from_fov_x(0.7, 128, 128), Vec3::ZERO, Vec3::Z, 3.0, 0.1)?;
/// for camera in &rig.cameras {
///     let (pixel, z) = camera.project(Vec3::ZERO).unwrap();
///     assert!((pixel - 64.0).length() < 1e-3 && (z - 3.0).abs() < 1e-5);
/// }
/// # Ok::<(), diamond_camera::CameraError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CameraRig {
    /// The cameras.
    pub cameras: Vec<Camera>,
}

impl CameraRig {
    /// `count` cameras at `distance` (scene units, > 0) from `target`, on the side of `up` (any length but 0), at
    /// elevations of at least `min_elevation` (radians, −π/2 … π/2), spread evenly in solid angle by the golden angle,
    /// the first nearest the zenith. All look at `target` with `up` upward.
    /// `[eq:golden-dome]`
    pub fn dome(
        count: usize,
        intrinsics: Intrinsics,
        target: Vec3,
        up: Vec3,
        distance: f32,
        min_elevation: f32,
    ) -> Result<Self, CameraError> {
        intrinsics.validate()?;
        let up = checked_up(up)?;
        check_distance(distance)?;
        check_elevation(min_elevation)?;
        let (tangent, bitangent) = up.any_orthonormal_pair();
        let lowest = libm::sin(f64::from(min_elevation));
        let cameras = (0..count)
            .map(|i| {
                // The cap's area is proportional to its height, so equal steps of height are equal areas.
                let z = 1.0 - (1.0 - lowest) * (i as f64 + 0.5) / count as f64;
                let radius = (1.0 - z * z).max(0.0).sqrt();
                let phi = (i as f64 * GOLDEN_ANGLE) % std::f64::consts::TAU;
                let (x, y) = (radius * libm::cos(phi), radius * libm::sin(phi));
                let direction = tangent * x as f32 + bitangent * y as f32 + up * z as f32;
                Camera { intrinsics, pose: Pose::look_at(target + direction * distance, target, up) }
            })
            .collect();
        Ok(Self { cameras })
    }

    /// `count` cameras on a circle around `up` through `target`, at `distance` and `elevation` (radians); the views of
    /// [`Trajectory::orbit`].
    pub fn orbit(
        count: usize,
        intrinsics: Intrinsics,
        target: Vec3,
        up: Vec3,
        distance: f32,
        elevation: f32,
    ) -> Result<Self, CameraError> {
        intrinsics.validate()?;
        let poses = Trajectory::orbit(target, up, distance, elevation)?.poses(count);
        Ok(Self { cameras: poses.into_iter().map(|pose| Camera { intrinsics, pose }).collect() })
    }
}

/// `up` with unit length.
pub(crate) fn checked_up(up: Vec3) -> Result<Vec3, CameraError> {
    up.try_normalize().ok_or_else(|| CameraError::Value {
        what: "up of a rig or orbit",
        expected: "three finite numbers, not all zero",
        found: format!("{up}"),
    })
}

pub(crate) fn check_distance(distance: f32) -> Result<(), CameraError> {
    if distance.is_finite() && distance > 0.0 {
        return Ok(());
    }
    let expected = "a finite number > 0 (scene units)";
    Err(CameraError::Value { what: "distance of a rig or orbit", expected, found: format!("{distance}") })
}

pub(crate) fn check_elevation(elevation: f32) -> Result<(), CameraError> {
    let vertical = std::f32::consts::FRAC_PI_2 + 1e-6;
    if (-vertical..=vertical).contains(&elevation) {
        return Ok(());
    }
    let expected = "radians between −π/2 and π/2";
    Err(CameraError::Value { what: "elevation of a rig or orbit", expected, found: format!("{elevation}") })
}

#[cfg(test)]
mod tests {
    use super::*;

    const TARGET: Vec3 = Vec3::new(1.0, -2.0, 0.5);

    fn intrinsics() -> Intrinsics {
        Intrinsics::from_fov_x(0.6, 64, 48)
    }

    /// [eq:golden-dome]: evenness, elevation, aim.
    #[test]
    fn every_camera_of_a_dome_sees_the_target_in_the_middle_and_up_upward() {
        let rig = CameraRig::dome(100, intrinsics(), TARGET, Vec3::Y * 3.0, 2.0, 0.2).unwrap();
        let mut mean = Vec3::ZERO;
        for c in &rig.cameras {
            c.validate().unwrap();
            let (pixel, z) = c.project(TARGET).unwrap();
            assert!((pixel.x - 32.0).abs() < 1e-3 && (pixel.y - 24.0).abs() < 1e-3 && (z - 2.0).abs() < 1e-5);
            assert!(c.project(TARGET + 0.1 * Vec3::Y).unwrap().0.y < pixel.y);
            let direction = (c.pose.centre() - TARGET) / 2.0;
            assert!(direction.y >= 0.2f32.sin() - 1e-5);
            mean += direction / 100.0;
        }
        assert!((mean - Vec3::Y * 0.5 * (1.0 + 0.2f32.sin())).length() < 0.02, "{mean}");
    }

    #[test]
    fn an_orbit_keeps_distance_and_elevation() {
        let rig = CameraRig::orbit(12, intrinsics(), TARGET, Vec3::Z, 2.0, -0.3).unwrap();
        assert_eq!(rig.cameras.len(), 12);
        for c in &rig.cameras {
            let offset = c.pose.centre() - TARGET;
            assert!((offset.length() - 2.0).abs() < 1e-5 && (offset.z - 2.0 * (-0.3f32).sin()).abs() < 1e-5);
            assert!((c.pose.forward() + offset / 2.0).length() < 1e-5);
        }
    }

    #[test]
    fn bad_rigs_are_refused() {
        let k = intrinsics();
        assert!(CameraRig::dome(3, k, TARGET, Vec3::ZERO, 1.0, 0.0).is_err());
        assert!(CameraRig::dome(3, k, TARGET, Vec3::Z, -1.0, 0.0).is_err());
        assert!(CameraRig::dome(3, k, TARGET, Vec3::Z, 1.0, f32::NAN).is_err());
        assert!(CameraRig::orbit(3, Intrinsics { width: 0, ..k }, TARGET, Vec3::Z, 1.0, 0.0).is_err());
        assert!(CameraRig::orbit(3, k, TARGET, Vec3::Z, f32::INFINITY, 0.0).is_err());
        assert!(CameraRig::orbit(0, k, TARGET, Vec3::Z, 1.0, 0.0).unwrap().cameras.is_empty());
        // Straight down is allowed: some up is chosen.
        assert!(CameraRig::orbit(1, k, TARGET, Vec3::Z, 1.0, 1.5707964).unwrap().cameras[0].validate().is_ok());
    }
}
