//! The lights of a rig as the bulk renderer uses them: points and directions, one colour each, and a factor that depends on the place.
//!
//! Irradiance is `factor · colour`, so that everything up to the finished picture is one number for each light.
use crate::{Geometry, Light, PathtraceError};
use diamond_light::{Falloff, OlatLight};
use glam::Vec3;

/// The lights of a rig.
#[derive(Debug, Clone)]
pub(crate) struct Lamps {
    lamps: Vec<(OlatLight, Falloff)>,
    /// Linear RGB; irradiance at the reference distance.
    colours: Vec<Vec3>,
}

/// How a light shines on a point.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shine {
    /// Unit direction to the light.
    pub direction: Vec3,
    /// Distance to it; infinite for directional lights.
    pub distance: f32,
    /// Irradiance on a facing plane over the light's colour.
    pub factor: f32,
}

/// A direction and a distance are not computed from points nearer to a light than this (scene units), as in `diamond-light`.
const MIN_DISTANCE: f32 = 1e-4;

impl Lamps {
    /// `Err` for lights that have an extent.
    pub fn new(lights: &[Light]) -> Result<Self, PathtraceError> {
        let mut lamps = Vec::new();
        for (i, light) in lights.iter().enumerate() {
            let Light::Olat { light, falloff } = light else {
                return Err(PathtraceError::Unreachable {
                    light: i,
                    reason: "the bulk renderer knows point and directional lights; use the reference for discs and environments",
                });
            };
            lamps.push((*light, *falloff));
        }
        let colours = lamps.iter().map(|(light, _)| light.intensity()).collect();
        Ok(Self { lamps, colours })
    }

    /// `Err` where one stands inside the object.
    pub fn check_outside(&self, geometry: &Geometry) -> Result<(), PathtraceError> {
        match (0..self.len()).find(|l| self.position(*l).is_some_and(|at| geometry.contains(at))) {
            None => Ok(()),
            Some(light) => Err(PathtraceError::Unreachable {
                light,
                reason: "it stands inside the object, where the bulk renderer connects nothing; use the reference",
            }),
        }
    }

    /// Number of lights.
    pub fn len(&self) -> usize {
        self.lamps.len()
    }

    /// Linear RGB of a light.
    pub fn colour(&self, light: usize) -> Vec3 {
        self.colours[light]
    }

    /// Where a point light stands; `None` for directions.
    pub fn position(&self, light: usize) -> Option<Vec3> {
        self.lamps[light].0.position()
    }

    /// How a light shines on `at`.
    #[inline]
    pub fn shine(&self, light: usize, at: Vec3) -> Shine {
        match self.lamps[light] {
            (OlatLight::Directional { direction, .. }, _) => Shine { direction, distance: f32::INFINITY, factor: 1.0 },
            (OlatLight::Point { position, .. }, falloff) => {
                let offset = position - at;
                let distance = offset.length().max(MIN_DISTANCE);
                let factor = match falloff {
                    Falloff::None => 1.0,
                    Falloff::InverseSquare { reference } => (reference / distance) * (reference / distance),
                };
                Shine { direction: offset / distance, distance, factor }
            }
        }
    }
}
