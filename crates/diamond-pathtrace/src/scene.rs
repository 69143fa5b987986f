//! What is traced: one translucent object and the lamps around it.
use crate::{Boundary, Coat, Geometry, Light, Medium, PathtraceError};

/// What the object is made of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    /// The inside.
    pub medium: Medium,
    /// The boundary to the air.
    pub boundary: Boundary,
    /// A reflection on top, if any.
    pub coat: Option<Coat>,
}

impl Material {
    /// A medium without boundary or coat.
    pub fn index_matched(medium: Medium) -> Self {
        Self { medium, boundary: Boundary::IndexMatched, coat: None }
    }

    /// `Err` where a number is outside its range.
    pub fn validate(&self) -> Result<(), PathtraceError> {
        self.medium.validate()?;
        self.boundary.validate()?;
        self.coat.map_or(Ok(()), |coat| coat.validate())
    }
}

/// A translucent object under lamps; each lamp makes its own picture.
#[derive(Debug, Clone)]
pub struct Scene {
    /// The object's shape.
    pub geometry: Geometry,
    /// What it is made of.
    pub material: Material,
    /// The lamps, in the order of the pictures.
    pub lights: Vec<Light>,
}

impl Scene {
    /// `Err` where a part is invalid, or a lamp cannot be reached: a point or directional light outside a polished boundary, since
    /// the one path that connects it with a point inside bends at the boundary and is never drawn.
    pub fn validate(&self) -> Result<(), PathtraceError> {
        self.geometry.validate()?;
        self.material.validate()?;
        self.lights.iter().try_for_each(Light::validate)?;
        if !matches!(self.material.boundary.effective(), Boundary::Smooth { .. }) {
            return Ok(());
        }
        for (i, light) in self.lights.iter().enumerate() {
            let inside = light.ball().is_some_and(|(centre, _)| self.geometry.contains(centre));
            if light.is_delta() && !inside {
                return Err(PathtraceError::Unreachable {
                    light: i,
                    reason: "a point or directional light outside a smooth dielectric cannot be connected with anything \
                             inside; use a rough boundary, a disc of finite size, or an environment",
                });
            }
        }
        Ok(())
    }
}
