//! Light rigs: the lights of a capture, and domes of lights for rendering under light that was never photographed.
use crate::{LightError, OlatLight};
use glam::Vec3;

/// π·(3 − √5): turning by this angle from one light to the next leaves no two lights in one direction.
const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;

/// A set of lights that are lit one at a time.
///
/// ```
/// use diamond_light::LightRig;
/// use glam::Vec3;
/// let rig = LightRig::dome(16, Vec3::ZERO, Vec3::Z, 3.0, 10f32.to_radians(), Vec3::ONE)?;
/// assert_eq!(rig.lights.len(), 16);
/// assert!(rig.lights.iter().all(|l| l.direction_from_origin().z >= 10f32.to_radians().sin() - 1e-6));
/// # Ok::<(), diamond_light::LightError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LightRig {
    /// The lights, in the order in which they are lit.
    pub lights: Vec<OlatLight>,
}

impl LightRig {
    /// `count` point lights on a dome: at `distance` (scene units, > 0) from `target`, on the side of `up` (need not have
    /// unit length), at elevations of at least `min_elevation` (radians, −π/2 … π/2; 0 is a hemisphere, −π/2 the whole
    /// sphere). They are spread evenly in solid angle by the golden angle, the first nearest the zenith.
    /// `[eq:golden-dome]`
    pub fn dome(
        count: usize,
        target: Vec3,
        up: Vec3,
        distance: f32,
        min_elevation: f32,
        intensity: Vec3,
    ) -> Result<Self, LightError> {
        if !(distance > 0.0 && distance.is_finite()) {
            return Err(LightError::Value {
                what: "distance of a dome of lights",
                expected: "a finite number > 0 (scene units)",
                found: format!("{distance}"),
            });
        }
        let lights = dome_directions(count, up, min_elevation)?
            .into_iter()
            .map(|direction| OlatLight::Point { position: target + direction * distance, intensity })
            .collect();
        let rig = Self { lights };
        rig.validate()?;
        Ok(rig)
    }

    /// The dome of [`LightRig::dome`] at infinity: `count` directional lights of the given irradiance.
    pub fn directional_dome(count: usize, up: Vec3, min_elevation: f32, irradiance: Vec3) -> Result<Self, LightError> {
        let lights = dome_directions(count, up, min_elevation)?
            .into_iter()
            .map(|direction| OlatLight::Directional { direction, irradiance })
            .collect();
        let rig = Self { lights };
        rig.validate()?;
        Ok(rig)
    }

    /// The first light's error, if one has any; see [`OlatLight::validate`].
    pub fn validate(&self) -> Result<(), LightError> {
        self.lights.iter().try_for_each(OlatLight::validate)
    }

    /// The index of the light whose direction from the origin is nearest to `direction`; the first on a tie, `None` in
    /// an empty rig.
    pub fn nearest(&self, direction: Vec3) -> Option<usize> {
        let mut best = None;
        for (i, light) in self.lights.iter().enumerate() {
            let cos = light.direction_from_origin().dot(direction);
            if best.is_none_or(|(_, most)| cos > most) {
                best = Some((i, cos));
            }
        }
        best.map(|(i, _)| i)
    }
}

/// `count` unit directions, even in solid angle, over the cap around `up` down to `min_elevation` (radians).
fn dome_directions(count: usize, up: Vec3, min_elevation: f32) -> Result<Vec<Vec3>, LightError> {
    let Some(up) = up.try_normalize() else {
        return Err(LightError::Value {
            what: "up of a dome of lights",
            expected: "three finite numbers, not all zero",
            found: format!("{up}"),
        });
    };
    let vertical = std::f32::consts::FRAC_PI_2 + 1e-6;
    if !(-vertical..=vertical).contains(&min_elevation) {
        return Err(LightError::Value {
            what: "minimum elevation of a dome of lights",
            expected: "radians between −π/2 and π/2",
            found: format!("{min_elevation}"),
        });
    }
    let (tangent, bitangent) = up.any_orthonormal_pair();
    let lowest = libm::sin(f64::from(min_elevation));
    Ok((0..count)
        .map(|i| {
            // The cap's area is proportional to its height, so equal steps of height are equal areas.
            let z = 1.0 - (1.0 - lowest) * (i as f64 + 0.5) / count as f64;
            let radius = (1.0 - z * z).max(0.0).sqrt();
            let phi = (i as f64 * GOLDEN_ANGLE) % std::f64::consts::TAU;
            let (x, y) = (radius * libm::cos(phi), radius * libm::sin(phi));
            (tangent * x as f32 + bitangent * y as f32 + up * z as f32).normalize()
        })
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// [eq:golden-dome]: evenness, spacing, elevation.
    #[test]
    fn a_dome_is_even_and_above_its_elevation() {
        let elevation = 0.3f32;
        let rig = LightRig::dome(200, Vec3::new(1.0, 2.0, 3.0), Vec3::Y, 2.5, elevation, Vec3::ONE).unwrap();
        let directions: Vec<Vec3> = rig
            .lights
            .iter()
            .map(|l| {
                let offset = l.position().unwrap() - Vec3::new(1.0, 2.0, 3.0);
                assert!((offset.length() - 2.5).abs() < 1e-5);
                offset / 2.5
            })
            .collect();
        assert!(directions.iter().all(|d| d.y >= elevation.sin() - 1e-5));
        // The mean of a cap is at half its height; evenness keeps it near the axis.
        let mean = directions.iter().sum::<Vec3>() / 200.0;
        let half = 0.5 * (1.0 + elevation.sin());
        assert!((mean - Vec3::Y * half).length() < 0.01, "{mean}");
        // No two lights are nearer than half of what a perfect hexagonal packing would give.
        let area = std::f32::consts::TAU * (1.0 - elevation.sin()) / 200.0;
        let ideal = (2.0 * area / 3f32.sqrt()).sqrt();
        for (i, a) in directions.iter().enumerate() {
            for b in &directions[i + 1..] {
                assert!(a.distance(*b) > 0.5 * ideal);
            }
        }
    }

    #[test]
    fn edge_cases_of_a_dome() {
        assert!(LightRig::dome(0, Vec3::ZERO, Vec3::Z, 1.0, 0.0, Vec3::ONE).unwrap().lights.is_empty());
        assert_eq!(LightRig::dome(1, Vec3::ZERO, Vec3::Z, 1.0, 0.0, Vec3::ONE).unwrap().lights.len(), 1);
        assert!(LightRig::dome(3, Vec3::ZERO, Vec3::ZERO, 1.0, 0.0, Vec3::ONE).is_err());
        assert!(LightRig::dome(3, Vec3::ZERO, Vec3::Z, 0.0, 0.0, Vec3::ONE).is_err());
        assert!(LightRig::dome(3, Vec3::ZERO, Vec3::Z, f32::NAN, 0.0, Vec3::ONE).is_err());
        assert!(LightRig::dome(3, Vec3::ZERO, Vec3::Z, 1.0, 2.0, Vec3::ONE).is_err());
        assert!(LightRig::dome(3, Vec3::ZERO, Vec3::Z, 1.0, f32::NAN, Vec3::ONE).is_err());
        assert!(LightRig::dome(3, Vec3::splat(f32::NAN), Vec3::Z, 1.0, 0.0, Vec3::ONE).is_err());
    }

    #[test]
    fn nearest_finds_each_light_from_its_own_direction() {
        let rig = LightRig::directional_dome(24, Vec3::Z, 0.1, Vec3::ONE).unwrap();
        for (i, light) in rig.lights.iter().enumerate() {
            assert_eq!(rig.nearest(light.direction_from_origin()), Some(i));
        }
        assert_eq!(LightRig::default().nearest(Vec3::Z), None);
    }
}
