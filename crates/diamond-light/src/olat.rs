//! Point and directional lights.
//!
//! A light knows nothing of surfaces: [`OlatLight::incidence`] says from where and how strongly it shines on a point,
//! before any visibility or cosine. A point light at position `p` sends to `x` the irradiance `I·(r/|p − x|)²` on a plane
//! that faces it, where `r` is the distance at which the irradiance equals the intensity; a directional light is the
//! limit of that for `|p| → ∞` with `r = |p|`.
//!
//! ```
//! use diamond_light::{Falloff, OlatLight};
//! use glam::Vec3;
//! let light = OlatLight::Point { position: Vec3::new(0.0, 0.0, 4.0), intensity: Vec3::ONE };
//! let incidence = light.incidence(Vec3::ZERO, Falloff::InverseSquare { reference: 2.0 });
//! assert_eq!(incidence.direction, Vec3::Z);
//! assert_eq!(incidence.irradiance, Vec3::splat(0.25));
//! ```
use crate::LightError;
use glam::Vec3;

/// Lights nearer to a point than this are treated as if they were this far (scene units; guards 1/d² and the
/// direction of a light that coincides with the point).
pub const MIN_LIGHT_DISTANCE: f32 = 1e-4;

/// Offsets from point to light are cut to this per axis (scene units): its square still fits an `f32`.
const MAX_OFFSET: f32 = 1e15;

/// reference/distance is cut to this: its square times an intensity of 10⁸ still fits an `f32`.
const MAX_RATIO: f32 = 1e15;

/// How far a stored direction's length may be from 1: text files carry a few digits.
const UNIT_TOLERANCE: f32 = 1e-3;

/// How the irradiance of a point light falls with distance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Falloff {
    /// No falloff: irradiance on a facing plane equals the intensity.
    None,
    /// (reference / distance)²: irradiance equals the intensity at distance `reference` (scene units).
    InverseSquare {
        /// Distance at which the irradiance equals the intensity, scene units.
        reference: f32,
    },
}

/// One light of a one-light-at-a-time capture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum OlatLight {
    /// A point light.
    Point {
        /// Position in world coordinates, scene units.
        position: Vec3,
        /// Linear RGB intensity.
        intensity: Vec3,
    },
    /// A light at infinity.
    Directional {
        /// Unit direction from the scene to the light.
        direction: Vec3,
        /// Linear RGB irradiance on a plane that faces the light.
        irradiance: Vec3,
    },
}

/// What arrives from a light at a point, before any visibility or cosine.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Incidence {
    /// Unit direction from the point to the light.
    pub direction: Vec3,
    /// Distance to the light, scene units; infinite for directional lights.
    pub distance: f32,
    /// Linear RGB irradiance on a plane that faces the light.
    pub irradiance: Vec3,
}

/// Cotangent of an [`Incidence`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct IncidenceGrad {
    /// Of the direction (its part along the direction has no effect).
    pub direction: Vec3,
    /// Of the distance; ignored for directional lights.
    pub distance: f32,
    /// Of the irradiance.
    pub irradiance: Vec3,
}

/// What [`OlatLight::incidence_pull`] returns: cotangents of everything [`OlatLight::incidence`] reads.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct IncidencePull {
    /// Of the lit point (world).
    pub d_at: Vec3,
    /// Of a point light's position (the negative of `d_at`); 0 for directional lights.
    pub d_position: Vec3,
    /// Of a directional light's direction, unconstrained; 0 for point lights.
    pub d_direction: Vec3,
    /// Of the intensity (point) or irradiance (directional).
    pub d_intensity: Vec3,
    /// Of the reference distance of [`Falloff::InverseSquare`]; 0 for other falloffs.
    pub d_reference: f32,
}

/// The offset of a point light, its length (not cut) and its direction.
fn offset(position: Vec3, at: Vec3) -> (f32, Vec3) {
    let to_light = (position - at).clamp(Vec3::splat(-MAX_OFFSET), Vec3::splat(MAX_OFFSET));
    (to_light.length(), to_light.try_normalize().unwrap_or(Vec3::Z))
}

impl OlatLight {
    /// A directional light, its direction (from the scene to the light) normalised.
    ///
    /// Errors where the direction has no length or a number is not finite.
    pub fn directional(direction: Vec3, irradiance: Vec3) -> Result<Self, LightError> {
        let Some(unit) = direction.try_normalize() else {
            return Err(LightError::Value {
                what: "direction of a directional light",
                expected: "three finite numbers, not all zero",
                found: format!("{direction}"),
            });
        };
        let light = OlatLight::Directional { direction: unit, irradiance };
        light.validate()?;
        Ok(light)
    }

    /// The same light with intensity (or irradiance) 1, linear RGB: what a renderer that is linear in light is asked for.
    pub fn of_unit_intensity(&self) -> Self {
        match *self {
            OlatLight::Point { position, .. } => OlatLight::Point { position, intensity: Vec3::ONE },
            OlatLight::Directional { direction, .. } => OlatLight::Directional { direction, irradiance: Vec3::ONE },
        }
    }

    /// `Err` where a number is not finite, an intensity is negative, or a direction is not of unit length (to 10⁻³).
    pub fn validate(&self) -> Result<(), LightError> {
        let finite = |what, v: Vec3| {
            if v.is_finite() {
                return Ok(());
            }
            Err(LightError::Value { what, expected: "three finite numbers", found: format!("{v}") })
        };
        let strength = |what, v: Vec3| {
            if v.is_finite() && v.min_element() >= 0.0 {
                return Ok(());
            }
            Err(LightError::Value { what, expected: "three finite numbers ≥ 0 (linear RGB)", found: format!("{v}") })
        };
        match *self {
            OlatLight::Point { position, intensity } => {
                finite("position of a point light", position)?;
                strength("intensity of a point light", intensity)
            }
            OlatLight::Directional { direction, irradiance } => {
                finite("direction of a directional light", direction)?;
                if (direction.length() - 1.0).abs() > UNIT_TOLERANCE {
                    return Err(LightError::Value {
                        what: "direction of a directional light",
                        expected: "unit length",
                        found: format!("{direction} of length {}", direction.length()),
                    });
                }
                strength("irradiance of a directional light", irradiance)
            }
        }
    }

    /// Direction, distance and irradiance at the world point `at`. Finite for finite input: a light within
    /// [`MIN_LIGHT_DISTANCE`] counts as that far, and one that coincides with `at` as above it (+z).
    /// `[eq:light-incidence]`
    pub fn incidence(&self, at: Vec3, falloff: Falloff) -> Incidence {
        match *self {
            OlatLight::Point { position, intensity } => {
                let (length, direction) = offset(position, at);
                let distance = length.max(MIN_LIGHT_DISTANCE);
                let factor = match falloff {
                    Falloff::None => 1.0,
                    Falloff::InverseSquare { reference } => {
                        let ratio = (reference / distance).clamp(-MAX_RATIO, MAX_RATIO);
                        ratio * ratio
                    }
                };
                let irradiance = (intensity * factor).clamp(Vec3::MIN, Vec3::MAX);
                Incidence { direction, distance, irradiance }
            }
            OlatLight::Directional { direction, irradiance } => {
                Incidence { direction, distance: f32::INFINITY, irradiance }
            }
        }
    }

    /// Pullback of [`OlatLight::incidence`] at the same point and falloff. A light within [`MIN_LIGHT_DISTANCE`] is
    /// pulled as one that far away whose distance and irradiance are constant.
    /// `[eq:light-incidence]`
    pub fn incidence_pull(&self, at: Vec3, falloff: Falloff, d: &IncidenceGrad) -> IncidencePull {
        match *self {
            OlatLight::Point { position, intensity } => {
                let (length, direction) = offset(position, at);
                let distance = length.max(MIN_LIGHT_DISTANCE);
                // ∂direction/∂position = (1 − ω·ωᵀ)/distance, ∂distance/∂position = ω.
                let mut d_position = (d.direction - direction * d.direction.dot(direction)) / distance;
                let mut d_distance = d.distance;
                let mut pull = IncidencePull { d_intensity: d.irradiance, ..IncidencePull::default() };
                if let Falloff::InverseSquare { reference } = falloff {
                    let ratio = (reference / distance).clamp(-MAX_RATIO, MAX_RATIO);
                    let d_factor = d.irradiance.dot(intensity);
                    pull.d_intensity = d.irradiance * (ratio * ratio);
                    pull.d_reference = 2.0 * d_factor * ratio / distance;
                    d_distance -= 2.0 * d_factor * ratio * ratio / distance;
                }
                if length > MIN_LIGHT_DISTANCE {
                    d_position += direction * d_distance;
                }
                IncidencePull { d_at: -d_position, d_position, ..pull }
            }
            OlatLight::Directional { .. } => {
                IncidencePull { d_direction: d.direction, d_intensity: d.irradiance, ..IncidencePull::default() }
            }
        }
    }

    /// Unit direction from the world origin to the light; +z for a point light at the origin.
    pub fn direction_from_origin(&self) -> Vec3 {
        match *self {
            OlatLight::Point { position, .. } => offset(position, Vec3::ZERO).1,
            OlatLight::Directional { direction, .. } => direction,
        }
    }

    /// The position of a point light in world coordinates; `None` for a directional light.
    pub fn position(&self) -> Option<Vec3> {
        match *self {
            OlatLight::Point { position, .. } => Some(position),
            OlatLight::Directional { .. } => None,
        }
    }

    /// Linear RGB intensity of a point light, or irradiance of a directional one.
    pub fn intensity(&self) -> Vec3 {
        match *self {
            OlatLight::Point { intensity, .. } => intensity,
            OlatLight::Directional { irradiance, .. } => irradiance,
        }
    }

    /// The same light with its intensity multiplied per channel: light is linear, so images scale alike.
    pub fn scaled(&self, factor: Vec3) -> Self {
        match *self {
            OlatLight::Point { position, intensity } => OlatLight::Point { position, intensity: intensity * factor },
            OlatLight::Directional { direction, irradiance } => {
                OlatLight::Directional { direction, irradiance: irradiance * factor }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::adjoint::{adjoint_gap, relative_l2, worst, worst_relative};
    use diamond_testkit::light::point_incidence;
    use diamond_testkit::strategies::{colour, extreme, finite, unit_vector, vector};
    use diamond_testkit::{Dual, Real, jvp, vjp};
    use proptest::prelude::*;

    /// The oracle over position, intensity, at, reference (10 numbers in, 7 out).
    fn oracle(x: &[Dual], falloff: bool) -> Vec<Dual> {
        let triple = |i: usize| [x[i], x[i + 1], x[i + 2]];
        point_incidence(triple(0), triple(3), triple(6), falloff.then_some(x[9])).to_vec()
    }

    fn wide(parts: &[&[f32]]) -> Vec<f64> {
        parts.iter().flat_map(|p| p.iter().map(|&v| f64::from(v))).collect()
    }

    fn falloff_of(inverse_square: bool, reference: f32) -> Falloff {
        if inverse_square { Falloff::InverseSquare { reference } } else { Falloff::None }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// [eq:light-incidence]: value, gradient and adjoint identity against dual numbers.
        #[test]
        fn incidence_and_its_pullback_agree_with_the_oracle(
            to_light in unit_vector(), distance in finite(0.05..20.0), at in vector(-2.0..2.0), intensity in colour(),
            reference in finite(0.1..10.0), inverse_square in prop::bool::ANY,
            d_direction in vector(-1.0..1.0), d_distance in finite(-1.0..1.0), d_irradiance in vector(-1.0..1.0),
            tangent in prop::collection::vec(-1.0f64..1.0, 10),
        ) {
            let at = Vec3::from(at);
            let position = at + Vec3::from(to_light) * distance;
            let light = OlatLight::Point { position, intensity: intensity.into() };
            let falloff = falloff_of(inverse_square, reference);
            let x = wide(&[&position.to_array(), &intensity, &at.to_array(), &[reference]]);
            let constant: Vec<Dual> = x.iter().map(|&v| Dual::of(v)).collect();

            let got = light.incidence(at, falloff);
            let got = wide(&[&got.direction.to_array(), &[got.distance], &got.irradiance.to_array()]);
            let value: Vec<f64> = oracle(&constant, inverse_square).iter().map(|y| y.v).collect();
            let error = relative_l2(&got[..3], &value[..3], 1.0).max(worst_relative(&got[3..], &value[3..], 1e-3));
            prop_assert!(error <= 1e-5, "value: {error:e}");

            let d = IncidenceGrad { direction: d_direction.into(), distance: d_distance, irradiance: d_irradiance.into() };
            let pull = light.incidence_pull(at, falloff, &d);
            let got = wide(&[
                &pull.d_position.to_array(), &pull.d_intensity.to_array(), &pull.d_at.to_array(), &[pull.d_reference],
            ]);
            let cotangent = wide(&[&d_direction, &[d_distance], &d_irradiance]);
            let expected = vjp(|x| oracle(x, inverse_square), &x, &cotangent);
            let error = worst([0..3, 3..6, 6..9, 9..10].map(|r| relative_l2(&got[r.clone()], &expected[r], 1e-2)));
            prop_assert!(error <= 1e-4, "gradient: {error:e}, {got:?} instead of {expected:?}");

            let forward = jvp(|x| oracle(x, inverse_square), &x, &tangent);
            prop_assert!(adjoint_gap(&cotangent, &forward, &got, &tangent) <= 1e-4);
        }

        #[test]
        fn any_finite_positions_give_finite_results(
            px in extreme(), py in extreme(), pz in extreme(), ax in extreme(), ay in extreme(), az in extreme(),
            reference in finite(1e-3..1e6), d in vector(-1e3..1e3), intensity in vector(0.0..1e6),
        ) {
            let light = OlatLight::Point { position: Vec3::new(px, py, pz), intensity: intensity.into() };
            let at = Vec3::new(ax, ay, az);
            for falloff in [Falloff::None, Falloff::InverseSquare { reference }] {
                let i = light.incidence(at, falloff);
                prop_assert!(i.direction.is_finite() && i.distance.is_finite() && i.irradiance.is_finite(), "{i:?}");
                prop_assert!((i.direction.length() - 1.0).abs() < 1e-5);
                let d = IncidenceGrad { direction: d.into(), distance: d[0], irradiance: d.into() };
                let p = light.incidence_pull(at, falloff, &d);
                prop_assert!(p.d_at.is_finite() && p.d_intensity.is_finite() && p.d_reference.is_finite(), "{p:?}");
            }
        }
    }

    #[test]
    fn a_light_at_the_point_itself_is_finite() {
        let light = OlatLight::Point { position: Vec3::ONE, intensity: Vec3::ONE };
        let i = light.incidence(Vec3::ONE, Falloff::InverseSquare { reference: 1.0 });
        assert_eq!(i.direction, Vec3::Z);
        assert_eq!(i.distance, MIN_LIGHT_DISTANCE);
        let d = IncidenceGrad { direction: Vec3::X, distance: 1.0, irradiance: Vec3::ONE };
        let p = light.incidence_pull(Vec3::ONE, Falloff::InverseSquare { reference: 1.0 }, &d);
        assert_eq!(p.d_at, -Vec3::X / MIN_LIGHT_DISTANCE);
    }

    #[test]
    fn directional_lights_pull_to_themselves() {
        let light = OlatLight::Directional { direction: Vec3::Y, irradiance: Vec3::ONE };
        let d = IncidenceGrad { direction: Vec3::X, distance: 5.0, irradiance: Vec3::new(1.0, 2.0, 3.0) };
        let p = light.incidence_pull(Vec3::ONE, Falloff::None, &d);
        assert_eq!((p.d_at, p.d_direction, p.d_intensity), (Vec3::ZERO, Vec3::X, Vec3::new(1.0, 2.0, 3.0)));
    }

    #[test]
    fn bad_lights_are_refused() {
        assert!(OlatLight::directional(Vec3::ZERO, Vec3::ONE).is_err());
        assert!(OlatLight::directional(Vec3::new(f32::NAN, 0.0, 1.0), Vec3::ONE).is_err());
        assert!(OlatLight::directional(Vec3::X, Vec3::new(-1.0, 0.0, 0.0)).is_err());
        assert!(OlatLight::Directional { direction: Vec3::splat(1.0), irradiance: Vec3::ONE }.validate().is_err());
        let light = OlatLight::Point { position: Vec3::new(0.0, f32::INFINITY, 0.0), intensity: Vec3::ONE };
        let message = light.validate().unwrap_err().to_string();
        assert!(message.contains("position of a point light") && message.contains("inf"), "{message}");
        let light = OlatLight::directional(Vec3::new(0.0, 3.0, 4.0), Vec3::ONE).unwrap();
        assert!(light.validate().is_ok());
        assert_eq!(light.direction_from_origin(), Vec3::new(0.0, 0.6, 0.8));
        assert_eq!(light.scaled(Vec3::splat(2.0)).intensity(), Vec3::splat(2.0));
        assert_eq!(light.position(), None);
    }
}
