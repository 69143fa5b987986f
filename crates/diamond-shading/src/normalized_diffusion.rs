//! Normalised diffusion: a profile of two physical parameters per channel.
//!
//! R(r) = A·(e^(−r/d) + e^(−r/3d))/(8π·d·r), d = ℓ/s(A), is the fit by Christensen and Burley ("Approximate Reflectance Profiles for
//! Efficient Subsurface Scattering", 2015) to light that a half space of isotropically scattering medium returns from a
//! point of diffuse illumination: A is the surface's reflectance, ℓ the mean free path. [`NormalizedDiffusion::on_widths`]
//! expresses it in the Gaussians of a [`RadialProfile`], so that one transport serves both.
use crate::error::ShadingError;
use crate::radial_profile::{RadialProfile, check_widths, plane_gaussian};
use crate::{NormalEquations, SolveOptions};
use glam::Vec3;
use std::f32::consts::PI;

/// Distances and lengths below this are taken for this (scene units): R has a pole at 0.
pub const MIN_DIFFUSION_LENGTH: f32 = 1e-9;

/// Samples of the radius from which a projection is made.
const PROJECTION_SAMPLES: usize = 512;

/// Per colour channel, the two parameters of normalised diffusion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NormalizedDiffusion {
    /// Reflectance A of the surface, `[0, 1]`.
    pub albedo: Vec3,
    /// Mean free path ℓ, scene units, > 0.
    pub mean_free_path: Vec3,
}

/// Gradient of a scalar with respect to a [`NormalizedDiffusion`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct NormalizedDiffusionGrad {
    /// With respect to the albedo.
    pub albedo: Vec3,
    /// With respect to the mean free path.
    pub mean_free_path: Vec3,
}

/// s(A) = 1.9 − A + 3.5·(A − 0.8)², the fit for diffuse illumination, and its slope.
/// `[eq:diffusion-shape]`
fn shape(albedo: f32) -> (f32, f32) {
    let a = albedo - 0.8;
    (1.9 - albedo + 3.5 * a * a, 7.0 * a - 1.0)
}

impl NormalizedDiffusion {
    /// d = ℓ/s(A) per channel, scene units: the mean radius is 2.5·d.
    pub fn decay_length(&self) -> Vec3 {
        let d = |a: f32, l: f32| l.max(MIN_DIFFUSION_LENGTH) / shape(a).0;
        let (a, l) = (self.albedo, self.mean_free_path);
        Vec3::new(d(a.x, l.x), d(a.y, l.y), d(a.z, l.z))
    }

    /// R at a distance, linear RGB per area.
    /// `[eq:normalized-diffusion]`
    pub fn value(&self, radius: f32) -> Vec3 {
        let r = radius.max(MIN_DIFFUSION_LENGTH);
        let d = self.decay_length();
        let at = |a: f32, d: f32| a * (libm::expf(-r / d) + libm::expf(-r / (3.0 * d))) / (8.0 * PI * d * r);
        Vec3::new(at(self.albedo.x, d.x), at(self.albedo.y, d.y), at(self.albedo.z, d.z))
    }

    /// Pullback of [`NormalizedDiffusion::value`] to its parameters; a length below [`MIN_DIFFUSION_LENGTH`] has none.
    /// `[eq:normalized-diffusion]` `[eq:diffusion-shape]`
    pub fn value_pull(&self, radius: f32, d_out: Vec3) -> NormalizedDiffusionGrad {
        let r = radius.max(MIN_DIFFUSION_LENGTH);
        let mut grad = NormalizedDiffusionGrad::default();
        for c in 0..3 {
            let (albedo, length) = (self.albedo[c], self.mean_free_path[c].max(MIN_DIFFUSION_LENGTH));
            let (s, slope) = shape(albedo);
            let d = length / s;
            let (near, far) = (libm::expf(-r / d), libm::expf(-r / (3.0 * d)));
            let scale = d_out[c] / (8.0 * PI * d * r);
            let d_d = scale * albedo * ((near + far / 3.0) * r / d - (near + far)) / d;
            grad.albedo[c] = scale * (near + far) - d_d * d / s * slope;
            grad.mean_free_path[c] = if self.mean_free_path[c] > MIN_DIFFUSION_LENGTH { d_d / s } else { 0.0 };
        }
        grad
    }

    /// The mixture of Gaussians of these widths that is nearest to the profile and has its reflectance. What is compared is the
    /// power between two circles, 2π·r·R, at radii in geometric progression from a tenth of the narrowest width to six times the
    /// widest, each with the weight of its interval.
    ///
    /// Errors where the widths are no widths of a profile, or a parameter is not finite or outside its range.
    pub fn on_widths(&self, widths: &[f32]) -> Result<RadialProfile, ShadingError> {
        check_widths(widths)?;
        let fits = |v: Vec3, high: f32| v.is_finite() && v.min_element() >= 0.0 && v.max_element() <= high;
        if !(fits(self.albedo, 1.0) && fits(self.mean_free_path, f32::MAX) && self.mean_free_path.min_element() > 0.0) {
            return Err(ShadingError::Setting {
                what: "NormalizedDiffusion",
                expected: "albedos in [0, 1] and mean free paths > 0".into(),
                found: format!("{self:?}"),
            });
        }
        let (low, high) = (0.1 * widths[0], 6.0 * widths[widths.len() - 1]);
        let ratio = libm::powf(high / low, 1.0 / PROJECTION_SAMPLES as f32);
        let mut equations = [(); 3].map(|()| NormalEquations::new(widths.len()));
        let mut r = low;
        for _ in 0..PROJECTION_SAMPLES {
            let row: Vec<f64> = widths.iter().map(|s| f64::from(2.0 * PI * r * plane_gaussian(r * r, *s))).collect();
            let value = self.value(r) * (2.0 * PI * r);
            for (c, equations) in equations.iter_mut().enumerate() {
                equations.add(&row, f64::from(value[c]), f64::from(r));
            }
            r *= ratio;
        }
        let mut weights = vec![Vec3::ZERO; widths.len()];
        for (c, equations) in equations.iter().enumerate() {
            let solved = equations.solve(&SolveOptions::default());
            let total: f64 = solved.iter().sum();
            let scale = if total > 0.0 { f64::from(self.albedo[c]) / total } else { 0.0 };
            weights.iter_mut().zip(&solved).for_each(|(w, s)| w[c] = (s * scale) as f32);
        }
        RadialProfile::new(widths.to_vec(), weights)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::adjoint::{relative_error, worst_relative};
    use diamond_testkit::{Dual, gradient, surfel_transport as oracle};
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// `[eq:normalized-diffusion]` `[eq:diffusion-shape]`: value and gradient against dual numbers.
        #[test]
        fn values_and_gradient_agree_with_the_oracle(a in 0.01f32..1.0, l in 0.05f32..2.0, r in 0.01f32..2.0) {
            let x = [f64::from(a), f64::from(l)];
            let d = NormalizedDiffusion { albedo: Vec3::splat(a), mean_free_path: Vec3::splat(l) };
            let value = oracle::normalized_diffusion(x[0], x[1], f64::from(r));
            prop_assert!(relative_error(f64::from(d.value(r).y), value, 1e-12) <= 2e-5);
            let expected =
                gradient(|x: &[Dual]| oracle::normalized_diffusion(x[0], x[1], Dual::new(f64::from(r), 0.0)), &x);
            let grad = d.value_pull(r, Vec3::Y);
            let found = [f64::from(grad.albedo.y), f64::from(grad.mean_free_path.y)];
            prop_assert!(worst_relative(&found, &expected, 1e-3 * (expected[0].abs() + expected[1].abs())) <= 1e-4,
                "{found:?} {expected:?}");
        }
    }

    /// `[eq:normalized-diffusion]`: it integrates to A, with mean radius 2.5·d; and what a projection keeps of it.
    #[test]
    fn a_projection_keeps_reflectance_and_mean_radius() {
        let diffusion =
            NormalizedDiffusion { albedo: Vec3::new(0.9, 0.5, 0.1), mean_free_path: Vec3::new(0.1, 0.2, 0.05) };
        let profile = diffusion.on_widths(&RadialProfile::geometric_widths(0.005, 2.0, 14)).unwrap();
        for c in 0..3 {
            assert!((profile.reflectance()[c] - diffusion.albedo[c]).abs() < 1e-5);
            let mean = 2.5 * diffusion.decay_length()[c];
            assert!((profile.mean_radius()[c] / mean - 1.0).abs() < 0.08, "{c}: {} {mean}", profile.mean_radius()[c]);
            // The power within a circle, the quantity that light transport sees.
            let (mut ours, mut theirs, step) = (0.0f32, 0.0f32, 0.0005f32);
            for i in 0..4000 {
                let r = (i as f32 + 0.5) * step;
                ours += 2.0 * PI * r * step * profile.value(r)[c];
                theirs += 2.0 * PI * r * step * diffusion.value(r)[c];
                // The narrowest Gaussian is wider than the pole.
                let off = (ours - theirs).abs() / diffusion.albedo[c];
                assert!(r < 0.01 || off < 0.05, "{c} at {r}: {ours} {theirs}");
            }
            assert!((theirs / diffusion.albedo[c] - 1.0).abs() < 5e-3);
        }
    }
}
