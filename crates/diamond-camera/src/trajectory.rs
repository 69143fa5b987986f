//! Camera paths: an orbit around an object, or a journey through given poses.
use crate::rig::{check_distance, check_elevation, checked_up};
use crate::{CameraError, Pose};
use glam::{Quat, Vec3};

/// A path of poses over a parameter `t` from 0 to 1.
///
/// ```
/// use diamond_camera::Trajectory;
/// use glam::Vec3;
/// let orbit = Trajectory::orbit(Vec3::ZERO, Vec3::Z, 3.0, 0.4)?;
/// let poses = orbit.poses(60);
/// assert_eq!(poses.len(), 60);
/// assert!(poses.iter().all(|p| (p.centre().length() - 3.0).abs() < 1e-5));
/// # Ok::<(), diamond_camera::CameraError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub enum Trajectory {
    /// One turn of a camera that starts at `eye` around the axis `up` through `target`, always looking at `target`.
    Orbit {
        /// Where the turn starts and ends, world, scene units.
        eye: Vec3,
        /// What is looked at.
        target: Vec3,
        /// The axis of the turn, unit length; upward in the picture.
        up: Vec3,
    },
    /// Through given poses at equal steps of `t`, interpolated by [`Pose::interpolate`].
    Keyframes {
        /// The poses, in order; at least one.
        poses: Vec<Pose>,
        /// Whether the path returns from the last pose to the first.
        closed: bool,
    },
}

impl Trajectory {
    /// One turn at `distance` (scene units, > 0) from `target` and `elevation` (radians) above the plane across `up` (any
    /// length but 0), counter-clockwise seen from above.
    pub fn orbit(target: Vec3, up: Vec3, distance: f32, elevation: f32) -> Result<Self, CameraError> {
        let up = checked_up(up)?;
        check_distance(distance)?;
        check_elevation(elevation)?;
        let (start, _) = up.any_orthonormal_pair();
        let eye = target + (start * libm::cosf(elevation) + up * libm::sinf(elevation)) * distance;
        Ok(Trajectory::Orbit { eye, target, up })
    }

    /// One turn around `target` that starts where `pose` is.
    pub fn orbit_from(pose: &Pose, target: Vec3, up: Vec3) -> Result<Self, CameraError> {
        pose.validate()?;
        let (eye, up) = (pose.centre(), checked_up(up)?);
        check_distance(eye.distance(target))?;
        Ok(Trajectory::Orbit { eye, target, up })
    }

    /// Through `poses`; errors where there are none or one of them is no rigid transform.
    pub fn keyframes(poses: Vec<Pose>, closed: bool) -> Result<Self, CameraError> {
        if poses.is_empty() {
            let expected = "at least one";
            return Err(CameraError::Value { what: "keyframes of a trajectory", expected, found: "none".into() });
        }
        poses.iter().try_for_each(Pose::validate)?;
        Ok(Trajectory::Keyframes { poses, closed })
    }

    /// Whether `t = 1` is the pose of `t = 0`.
    pub fn is_closed(&self) -> bool {
        match self {
            Trajectory::Orbit { .. } => true,
            Trajectory::Keyframes { closed, .. } => *closed,
        }
    }

    /// The pose at `t`, which is cut to 0 … 1 (NaN counts as 0).
    pub fn at(&self, t: f32) -> Pose {
        let t = if t.is_nan() { 0.0 } else { t.clamp(0.0, 1.0) };
        match self {
            Trajectory::Orbit { eye, target, up } => {
                let (sin, cos) = libm::sincosf(t * std::f32::consts::PI);
                let turn = Quat::from_xyzw(up.x * sin, up.y * sin, up.z * sin, cos);
                Pose::look_at(*target + turn * (*eye - *target), *target, *up)
            }
            Trajectory::Keyframes { poses, .. } if poses.is_empty() => Pose::IDENTITY,
            Trajectory::Keyframes { poses, closed } => {
                let spans = if *closed { poses.len() } else { poses.len() - 1 };
                if spans == 0 {
                    return poses[0];
                }
                let along = t * spans as f32;
                let i = (along.floor() as usize).min(spans - 1);
                let fraction = along - i as f32;
                if fraction == 0.0 {
                    return poses[i];
                }
                if fraction == 1.0 {
                    return poses[(i + 1) % poses.len()];
                }
                poses[i].interpolate(&poses[(i + 1) % poses.len()], fraction)
            }
        }
    }

    /// `frames` poses at equal steps: closed paths leave out the last, which is the first again, so that a film of them
    /// loops; open paths include both ends.
    pub fn poses(&self, frames: usize) -> Vec<Pose> {
        let steps = if self.is_closed() { frames } else { frames.saturating_sub(1) };
        (0..frames).map(|i| self.at(i as f32 / steps.max(1) as f32)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn poses() -> Vec<Pose> {
        [Vec3::new(3.0, 0.0, 1.0), Vec3::new(0.0, 3.0, 1.0), Vec3::new(-3.0, 0.0, 0.5)]
            .map(|eye| Pose::look_at(eye, Vec3::ZERO, Vec3::Z))
            .to_vec()
    }

    #[test]
    fn keyframes_are_passed_exactly() {
        for closed in [false, true] {
            let path = Trajectory::keyframes(poses(), closed).unwrap();
            let sampled = path.poses(3);
            assert_eq!(sampled[0], poses()[0]);
            assert!((sampled[1].centre() - poses()[1].centre()).length() < 1e-5);
            assert!((sampled[2].centre() - poses()[2].centre()).length() < 1e-5);
            assert_eq!(path.at(1.0), poses()[if closed { 0 } else { 2 }]);
            assert!(path.poses(50).iter().all(|p| p.validate().is_ok()));
        }
    }

    #[test]
    fn an_orbit_closes_and_turns_evenly() {
        let path = Trajectory::orbit(Vec3::ONE, Vec3::Y, 2.0, 0.3).unwrap();
        assert!((path.at(0.0).centre() - path.at(1.0).centre()).length() < 1e-5);
        let poses = path.poses(8);
        let steps: Vec<f32> = (0..8).map(|i| poses[i].centre().distance(poses[(i + 1) % 8].centre())).collect();
        assert!(steps.iter().all(|s| (s - steps[0]).abs() < 1e-5), "{steps:?}");
        let from = Trajectory::orbit_from(&poses[3], Vec3::ONE, Vec3::Y).unwrap();
        assert!((from.at(0.0).centre() - poses[3].centre()).length() < 1e-5);
    }

    #[test]
    fn edge_cases() {
        assert!(Trajectory::keyframes(vec![], false).is_err());
        assert!(Trajectory::keyframes(vec![Pose { translation: Vec3::NAN, ..Pose::IDENTITY }], false).is_err());
        let one = Trajectory::keyframes(poses()[..1].to_vec(), false).unwrap();
        assert_eq!(one.poses(3), vec![poses()[0]; 3]);
        assert_eq!(one.at(f32::NAN), poses()[0]);
        assert!(one.poses(0).is_empty());
        assert_eq!(one.poses(1).len(), 1);
        assert!(Trajectory::orbit_from(&poses()[0], poses()[0].centre(), Vec3::Z).is_err());
        assert!(Trajectory::orbit(Vec3::ZERO, Vec3::NAN, 1.0, 0.0).is_err());
    }
}
