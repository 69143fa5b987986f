//! How bright a small piece of a translucent surface is under light from one direction.
//!
//! Light that enters a translucent body leaves it at some distance, so that a place is lit a little by light that only
//! its neighbours face, and one that faces the camera has more body about it that is lit than one at the outline. Both
//! are caught by a Lambertian response to a light that leans toward the camera.
use glam::Vec3;

/// `[eq:leaned-light]` The direction (l + β·v)/‖l + β·v‖ in which a light at `light` seems to be, for a surface seen from
/// `toward`; both unit vectors. β = 0 leaves it where it is.
#[inline]
pub fn leaned(light: Vec3, toward: Vec3, lean: f32) -> Vec3 {
    (light + lean * toward).try_normalize().unwrap_or(light)
}

/// max(0, t) of the cosine t between normal and light, and its derivative; 0 at the kink.
#[inline]
pub(crate) fn lambert(t: f32) -> (f32, f32) {
    if t > 0.0 { (t, 1.0) } else { (0.0, 0.0) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::strategies::unit_vector;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]

        /// [eq:leaned-light]: of unit length, in the plane of light and camera, between the two, and nearer the camera for
        /// a larger lean.
        #[test]
        fn a_light_leans_toward_the_camera(light in unit_vector(), toward in unit_vector(), lean in 0.0f32..2.0) {
            let (light, toward) = (Vec3::from(light), Vec3::from(toward));
            prop_assume!(light.dot(toward) > -0.99);
            let at = leaned(light, toward, lean);
            prop_assert!((at.length() - 1.0).abs() < 1e-5);
            prop_assert!(at.dot(light.cross(toward)).abs() < 1e-5);
            prop_assert!(at.dot(toward) >= light.dot(toward) - 1e-5);
            prop_assert!(leaned(light, toward, lean + 0.1).dot(toward) >= at.dot(toward) - 1e-5);
            let expected = (light + toward * lean) / f64::from((light + toward * lean).length()) as f32;
            prop_assert!((at - expected).length() < 1e-5);
        }
    }

    #[test]
    fn a_light_opposite_the_camera_stays_finite() {
        assert_eq!(leaned(Vec3::Z, -Vec3::Z, 1.0), Vec3::Z);
        assert_eq!(leaned(Vec3::X, Vec3::Z, 0.0), Vec3::X);
    }
}
