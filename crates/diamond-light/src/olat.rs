//! Point and directional lights.
use glam::Vec3;

/// Lights nearer to a point than this are treated as if they were this far (scene units; guards 1/d² and the
/// direction of a light that coincides with the point).
pub const MIN_LIGHT_DISTANCE: f32 = 1e-4;

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

impl OlatLight {
    /// Direction, distance and irradiance at the world point `at`.
    pub fn incidence(&self, at: Vec3, falloff: Falloff) -> Incidence {
        match *self {
            OlatLight::Point { position, intensity } => {
                let to_light = position - at;
                let distance = to_light.length().max(MIN_LIGHT_DISTANCE);
                let direction = to_light.try_normalize().unwrap_or(Vec3::Z);
                let factor = match falloff {
                    Falloff::None => 1.0,
                    Falloff::InverseSquare { reference } => (reference / distance) * (reference / distance),
                };
                Incidence { direction, distance, irradiance: intensity * factor }
            }
            OlatLight::Directional { direction, irradiance } => {
                Incidence { direction, distance: f32::INFINITY, irradiance }
            }
        }
    }
}
