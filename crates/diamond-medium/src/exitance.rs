//! The light that leaves the surfels of a surface under any lights, for a given medium.
use crate::fit::{irradiance, normals_of, surfel_transport, white};
use crate::{Medium, MediumError, Surface, Transport};
use diamond_light::{Falloff, OlatLight};
use diamond_shading::{RadialProfile, SurfelTransport};

/// Transport of a medium between the surfels of a surface, made once for all lights.
#[derive(Debug)]
pub struct Exitance {
    profile: RadialProfile,
    transport: SurfelTransport,
}

impl Exitance {
    /// Prepares transport.
    pub fn new(surface: &Surface, medium: &Medium) -> Result<Self, MediumError> {
        medium.validate()?;
        let profile = medium.profile()?;
        let transport = surfel_transport(surface, profile.widths().to_vec())?;
        Ok(Self { profile, transport })
    }

    /// Radiance that leaves each surfel in any direction under each light with intensity 1: for each light surfels × 3, linear RGB.
    pub fn under(
        &self,
        surface: &Surface,
        lights: &[OlatLight],
        falloff: Falloff,
    ) -> Result<Vec<Vec<f32>>, MediumError> {
        let lamps: Vec<OlatLight> = lights.iter().map(white).collect();
        let entering = irradiance(surface, surface.positions(), &normals_of(surface), &lamps, falloff)?;
        let coloured: Vec<f32> = entering.iter().flat_map(|e| [*e; 3]).collect();
        let receivers = self.transport.receivers(surface.positions())?;
        let (out, _) = receivers.exitance(&self.profile, &coloured)?;
        let n = lamps.len();
        let each = (0..n).map(|l| {
            let surfels = 0..surface.positions().len();
            surfels.flat_map(|j| (0..3).map(move |c| (j, c))).map(|(j, c)| out[(j * n + l) * 3 + c] / std::f32::consts::PI).collect()
        });
        Ok(each.collect())
    }
}

impl Medium {
    /// The part that leaves where it enters, radiance per irradiance: linear RGB.
    pub fn local(&self) -> glam::Vec3 {
        match &self.transport {
            Transport::Profile { local, .. } => glam::Vec3::from(*local) / std::f32::consts::PI,
            Transport::Walk { .. } => glam::Vec3::ZERO,
        }
    }
}
