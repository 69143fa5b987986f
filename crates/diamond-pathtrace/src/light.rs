//! Lamps as a path sees them: something to be sampled from a point, or to be met by chance.
use crate::error::{PathtraceError, check, check_rgb};
use crate::sampling::uniform_disc;
use crate::{Environment, Frame, Rng};
use diamond_light::{Falloff, OlatLight};
use glam::Vec3;

/// A lamp. Lamps cast no shadows on each other, and each makes a picture of its own.
#[derive(Debug, Clone, PartialEq)]
pub enum Light {
    /// A point or directional light of a capture.
    Olat {
        /// The light.
        light: OlatLight,
        /// How a point light's irradiance falls with distance.
        falloff: Falloff,
    },
    /// A disc that shines from one side, the same in all directions.
    Disc {
        /// Centre, world.
        centre: Vec3,
        /// Unit normal of the side that shines.
        normal: Vec3,
        /// Radius, scene units.
        radius: f32,
        /// Linear RGB radiance.
        radiance: Vec3,
    },
    /// Light from infinity.
    Environment(Environment),
}

impl From<OlatLight> for Light {
    /// With inverse-square falloff from distance 1.
    fn from(light: OlatLight) -> Self {
        Light::Olat { light, falloff: Falloff::InverseSquare { reference: 1.0 } }
    }
}

/// A way to a lamp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LightSample {
    /// Unit direction from the point to the lamp.
    pub direction: Vec3,
    /// Distance to it, scene units; infinite for lamps at infinity.
    pub distance: f32,
    /// Linear RGB radiance over density, or the irradiance of a lamp without extent.
    pub irradiance: Vec3,
    /// Density per steradian; infinite for a lamp without extent.
    pub pdf: f32,
}

/// `Err` unless the vector has unit length (to 10⁻³).
pub(crate) fn check_unit(what: &str, v: Vec3) -> Result<(), PathtraceError> {
    if (v.length() - 1.0).abs() < 1e-3 {
        return Ok(());
    }
    Err(PathtraceError::Value { what: what.into(), expected: "unit length", found: format!("{v}") })
}

impl Light {
    /// A point light that gives `intensity` (linear RGB) as irradiance at distance 1.
    pub fn point(position: Vec3, intensity: Vec3) -> Self {
        OlatLight::Point { position, intensity }.into()
    }

    /// A light at infinity in the unit `direction` (from the scene to it) that gives `irradiance` (linear RGB) on a facing plane.
    pub fn directional(direction: Vec3, irradiance: Vec3) -> Self {
        OlatLight::Directional { direction, irradiance }.into()
    }

    /// A disc that shines towards `target` and gives about `irradiance` there.
    pub fn disc_towards(target: Vec3, centre: Vec3, radius: f32, irradiance: Vec3) -> Self {
        let offset = target - centre;
        let area = std::f32::consts::PI * radius * radius;
        // Exactly on the axis of a disc: E = πL·r²/(r² + d²).
        let radiance = irradiance * ((radius * radius + offset.length_squared()) / area.max(f32::MIN_POSITIVE));
        Light::Disc { centre, normal: offset.normalize_or(Vec3::Z), radius, radiance }
    }

    /// `Err` where a number is outside its range.
    pub fn validate(&self) -> Result<(), PathtraceError> {
        match self {
            Light::Olat { light, falloff } => {
                light.validate().map_err(|e| PathtraceError::Value {
                    what: "a light".into(),
                    expected: "a valid light",
                    found: e.to_string(),
                })?;
                match falloff {
                    Falloff::None => Ok(()),
                    Falloff::InverseSquare { reference } => {
                        check("reference distance of a light", *reference, "a finite number > 0", |v| v > 0.0)
                    }
                }
            }
            Light::Disc { centre, normal, radius, radiance } => {
                check_rgb("centre of a disc light", *centre, "a finite number", |_| true)?;
                check_unit("normal of a disc light", *normal)?;
                check("radius of a disc light", *radius, "a number from 10⁻⁶ to 10⁶", |v| {
                    (1e-6..=1e6).contains(&v)
                })?;
                check_rgb("radiance of a disc light", *radiance, "a finite number ≥ 0", |v| v >= 0.0)
            }
            Light::Environment(environment) => environment.validate(),
        }
    }

    /// Whether no path finds the lamp by chance, because it is a point or a single direction.
    pub fn is_delta(&self) -> bool {
        matches!(self, Light::Olat { .. })
    }

    /// A ball (centre, radius) that holds the lamp; `None` for lamps at infinity.
    pub fn ball(&self) -> Option<(Vec3, f32)> {
        match self {
            Light::Olat { light, .. } => light.position().map(|p| (p, 0.0)),
            Light::Disc { centre, radius, .. } => Some((*centre, *radius)),
            Light::Environment(_) => None,
        }
    }

    /// A way from `at` to the lamp. `None` where the lamp does not shine there, or is better found by chance.
    #[inline]
    pub fn sample(&self, at: Vec3, rng: &mut Rng) -> Option<LightSample> {
        match self {
            Light::Olat { light, falloff } => {
                let i = light.incidence(at, *falloff);
                Some(LightSample {
                    direction: i.direction,
                    distance: i.distance,
                    irradiance: i.irradiance,
                    pdf: f32::INFINITY,
                })
            }
            Light::Disc { centre, normal, radius, radiance } => {
                let frame = Frame::new(*normal);
                let p = uniform_disc(rng) * *radius;
                let offset = *centre + frame.x * p.x + frame.y * p.y - at;
                let distance = offset.length();
                let direction = offset.try_normalize()?;
                let pdf = disc_pdf(-direction.dot(*normal), *radius, distance)?;
                Some(LightSample { direction, distance, irradiance: *radiance / pdf, pdf })
            }
            Light::Environment(environment) => {
                let (direction, radiance, pdf) = environment.sample(rng)?;
                let lit = pdf > 0.0;
                lit.then(|| LightSample { direction, distance: f32::INFINITY, irradiance: radiance / pdf, pdf })
            }
        }
    }

    /// What a ray (unit `direction`) that reaches infinity finds there, and the density with which [`Light::sample`] would have
    /// sent it; `None` for lamps that are not at infinity.
    #[inline]
    pub fn at_infinity(&self, direction: Vec3) -> Option<(Vec3, Option<f32>)> {
        let Light::Environment(environment) = self else { return None };
        Some((environment.radiance(direction), environment.pdf(direction)))
    }

    /// Where a ray (unit `direction`) meets the shining side of a disc: distance and radiance.
    #[inline]
    pub fn met_by(&self, origin: Vec3, direction: Vec3) -> Option<(f32, Vec3)> {
        let Light::Disc { centre, normal, radius, radiance } = self else { return None };
        let cos = -direction.dot(*normal);
        if cos <= 0.0 {
            return None;
        }
        let distance = (origin - *centre).dot(*normal) / cos;
        let point = origin + direction * distance;
        let met = distance > 0.0 && (point - *centre).length_squared() <= radius * radius;
        met.then_some((distance, *radiance))
    }

    /// Density per steradian with which [`Light::sample`] draws the direction towards a point of a disc.
    #[inline]
    pub(crate) fn disc_pdf_towards(&self, at: Vec3, direction: Vec3, point: Vec3) -> f32 {
        let Light::Disc { normal, radius, .. } = self else { return 0.0 };
        disc_pdf(-direction.dot(*normal), *radius, (point - at).length()).unwrap_or(0.0)
    }
}

/// distance²/(cos·area); `None` on the dark side, and where a point so near the disc's plane would be lit without bound.
#[inline]
fn disc_pdf(cos: f32, radius: f32, distance: f32) -> Option<f32> {
    let pdf = distance * distance / (cos * std::f32::consts::PI * radius * radius);
    (cos > 0.0 && pdf > f32::MIN_POSITIVE && pdf.is_finite()).then_some(pdf)
}
