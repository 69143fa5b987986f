//! Light that enters a translucent surface: irradiance of surfels under known lights.
//!
//! E = visibility · max(0, n·l) · transmittance · irradiance of the light, linear RGB per area. Visibility is given (from shadow rays or
//! from a grid) and is constant here; the pullback runs to normals and positions, through the cosine, the direction to the light
//! and its falloff. A surfel that faces away has no light and no gradient.
use crate::error::{ShadingError, check_length};
use diamond_light::{Falloff, IncidenceGrad, OlatLight};
use glam::Vec3;

/// What part of the light that arrives goes in.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Entry {
    /// All: a boundary without a jump of the refractive index, or a profile that is meant to hold the loss.
    #[default]
    Full,
    /// 1 − F(n·l) with Schlick's F for this reflectance at normal incidence, `[0, 1]`: a smooth boundary.
    Fresnel {
        /// Reflectance at normal incidence.
        f0: f32,
    },
}

impl Entry {
    /// The part that enters and its derivative by the cosine in `[0, 1]`.
    #[inline]
    fn transmittance(self, cos_theta_i: f32) -> (f32, f32) {
        match self {
            Entry::Full => (1.0, 0.0),
            Entry::Fresnel { f0 } => {
                let m = (1.0 - cos_theta_i).max(0.0);
                let m4 = m * m * m * m;
                ((1.0 - f0) * (1.0 - m4 * m), (1.0 - f0) * 5.0 * m4)
            }
        }
    }
}

/// What the irradiance of surfels depends on.
#[derive(Debug, Clone, Copy)]
pub struct SurfelLighting<'a> {
    /// World positions of the surfels.
    pub positions: &'a [Vec3],
    /// Outward unit normals.
    pub normals: &'a [Vec3],
    /// For each surfel each light, `[0, 1]`: surfels × lights.
    pub visibility: &'a [f32],
    /// The lights.
    pub lights: &'a [OlatLight],
    /// Their falloff.
    pub falloff: Falloff,
    /// What part enters.
    pub entry: Entry,
}

/// Gradient of a scalar with respect to a [`SurfelLighting`].
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SurfelLightingGrad {
    /// With respect to the positions.
    pub positions: Vec<Vec3>,
    /// With respect to the normals, as free vectors.
    pub normals: Vec<Vec3>,
}

impl SurfelLighting<'_> {
    fn check(&self) -> Result<(), ShadingError> {
        check_length("normals of surfels", self.positions.len(), self.normals.len())?;
        check_length("visibility of surfels × lights", self.positions.len() * self.lights.len(), self.visibility.len())
    }

    /// Irradiance of one surfel under one light, linear RGB.
    /// `[eq:surfel-irradiance]`
    #[inline]
    fn at(&self, surfel: usize, light: usize) -> Vec3 {
        let visibility = self.visibility[surfel * self.lights.len() + light];
        let arriving = self.lights[light].incidence(self.positions[surfel], self.falloff);
        let cos_theta_i = self.normals[surfel].dot(arriving.direction);
        if cos_theta_i > 0.0 && visibility > 0.0 {
            arriving.irradiance * (visibility * cos_theta_i * self.entry.transmittance(cos_theta_i).0)
        } else {
            Vec3::ZERO
        }
    }

    /// Irradiance of every surfel under every light: surfels × lights × 3.
    /// `[eq:surfel-irradiance]`
    pub fn irradiance(&self) -> Result<Vec<f32>, ShadingError> {
        self.check()?;
        let lights = self.lights.len();
        let each = (0..self.positions.len() * lights).flat_map(|i| self.at(i / lights, i % lights).to_array());
        Ok(each.collect())
    }

    /// Pullback of [`SurfelLighting::irradiance`] to positions and normals: `d_out` is surfels × lights × 3.
    /// `[eq:surfel-irradiance]`
    pub fn pull(&self, d_out: &[f32]) -> Result<SurfelLightingGrad, ShadingError> {
        self.check()?;
        let (surfels, lights) = (self.positions.len(), self.lights.len());
        check_length("cotangent of the irradiance of surfels × lights × 3", 3 * surfels * lights, d_out.len())?;
        let mut grad = SurfelLightingGrad { positions: vec![Vec3::ZERO; surfels], normals: vec![Vec3::ZERO; surfels] };
        for (i, d) in d_out.chunks_exact(3).enumerate() {
            let (surfel, light) = (i / lights, i % lights);
            let (at, normal, visibility) = (self.positions[surfel], self.normals[surfel], self.visibility[i]);
            let arriving = self.lights[light].incidence(at, self.falloff);
            let cos_theta_i = normal.dot(arriving.direction);
            if cos_theta_i > 0.0 && visibility > 0.0 {
                let (passes, slope) = self.entry.transmittance(cos_theta_i);
                let d = Vec3::from_slice(d);
                let d_cosine = visibility * (passes + cos_theta_i * slope) * d.dot(arriving.irradiance);
                let d_arriving = IncidenceGrad {
                    direction: normal * d_cosine,
                    distance: 0.0,
                    irradiance: d * (visibility * cos_theta_i * passes),
                };
                grad.normals[surfel] += arriving.direction * d_cosine;
                grad.positions[surfel] += self.lights[light].incidence_pull(at, self.falloff, &d_arriving).d_at;
            }
        }
        Ok(grad)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::adjoint::{adjoint_gap, relative_error};
    use diamond_testkit::strategies::{unit_vector, vector};
    use diamond_testkit::{Dual, Real, jvp, surfel_transport as oracle};
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// `[eq:surfel-irradiance]`: value and pullback to position and normal against dual numbers, with and without Fresnel.
        #[test]
        fn values_and_pullback_agree_with_the_oracle(
            at in vector(-1.0..1.0), normal in unit_vector(), from in unit_vector(), visibility in 0.1f32..1.0, fresnel in any::<bool>(),
            tangent in [-1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0],
        ) {
            let position = Vec3::from(from) * 4.0;
            let light = OlatLight::Point { position, intensity: Vec3::new(1.0, 0.0, 0.0) };
            let lighting = SurfelLighting {
                positions: &[at.into()], normals: &[normal.into()], visibility: &[visibility], lights: &[light],
                falloff: Falloff::InverseSquare { reference: 3.0 },
                entry: if fresnel { Entry::Fresnel { f0: 0.04 } } else { Entry::Full },
            };
            let x: Vec<f64> = at.iter().chain(&normal).map(|v| f64::from(*v)).collect();
            let f = |x: &[Dual]| vec![oracle::irradiance(
                position.to_array().map(|v| Dual::of(f64::from(v))), Some(Dual::of(3.0)), fresnel.then_some(f64::from(0.04f32)),
                [x[0], x[1], x[2]], [x[3], x[4], x[5]], Dual::of(f64::from(visibility)))];
            let value = f(&x.iter().map(|v| Dual::of(*v)).collect::<Vec<_>>())[0].v;
            // Not within rounding of the horizon.
            let l = (position - Vec3::from(at)).normalize();
            prop_assume!(l.dot(normal.into()).abs() > 1e-3);
            let found = lighting.irradiance().unwrap();
            prop_assert!(relative_error(f64::from(found[0]), value, 1e-3) <= 1e-4);
            let grad = lighting.pull(&[1.0, 0.0, 0.0]).unwrap();
            let vjp: Vec<f64> = grad.positions[0].to_array().iter().chain(&grad.normals[0].to_array()).map(|v| f64::from(*v)).collect();
            let forward = jvp(f, &x, &tangent);
            if value > 0.0 {
                prop_assert!(adjoint_gap(&[1.0], &forward, &vjp, &tangent) <= 1e-4);
            } else {
                prop_assert!(vjp.iter().all(|v| *v == 0.0));
            }
        }
    }

    #[test]
    fn lists_of_other_lengths_are_refused() {
        let lights = [OlatLight::Directional { direction: Vec3::Z, irradiance: Vec3::ONE }];
        let lighting = SurfelLighting {
            positions: &[Vec3::ZERO],
            normals: &[Vec3::Z],
            visibility: &[1.0],
            lights: &lights,
            falloff: Falloff::None,
            entry: Entry::Full,
        };
        assert_eq!(lighting.irradiance(), Ok(vec![1.0; 3]));
        assert!(lighting.pull(&[1.0]).is_err());
        assert!(SurfelLighting { normals: &[], ..lighting }.irradiance().is_err());
        assert!(SurfelLighting { visibility: &[], ..lighting }.irradiance().is_err());
    }
}
