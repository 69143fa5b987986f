//! Radial profiles: how much of the light that enters a translucent surface leaves it at a distance.
//!
//! A profile R_c(r) is the radiosity at distance r from a point through which one unit of power enters, per area and colour
//! channel. Here it is a mixture of Gaussians of fixed widths with weights ≥ 0, each normalised over the plane:
//! R_c(r) = Σ_k w_kc·exp(−r²/2σ_k²)/(2πσ_k²). The weights of a channel add up to its reflectance. Because the widths
//! are fixed the profile, and with it every picture, is linear in the weights: they are fitted by least squares
//! ([`crate::NormalEquations`]), and transport of each width is computed once ([`crate::SurfelTransport`]).
//!
//! ```
//! use diamond_shading::RadialProfile;
//! use glam::Vec3;
//! let profile = RadialProfile::new(vec![0.1, 0.3], vec![Vec3::splat(0.5), Vec3::new(0.3, 0.1, 0.0)])?;
//! assert!((profile.reflectance() - Vec3::new(0.8, 0.6, 0.5)).length() < 1e-6);
//! assert!(profile.mean_radius().x > profile.mean_radius().z);
//! # Ok::<(), diamond_shading::ShadingError>(())
//! ```
use crate::error::{ShadingError, check_length};
use glam::Vec3;
use std::f32::consts::{PI, SQRT_2};

/// A reflectance at or below this has no mean radius; 0 is reported (guards the division).
const MIN_REFLECTANCE: f32 = 1e-12;

/// `Ok` if there is a width and all are finite, above 0 and ascending.
pub(crate) fn check_widths(widths: &[f32]) -> Result<(), ShadingError> {
    // Written so that NaN fails it; squares of widths and of their reciprocals must fit an `f32`.
    let usable = widths.iter().all(|w| (1e-9..=1e9).contains(w));
    if usable && !widths.is_empty() && widths.windows(2).all(|pair| pair[0] < pair[1]) {
        return Ok(());
    }
    Err(ShadingError::Setting {
        what: "widths of a radial profile",
        expected: "at least one, ascending, from 10⁻⁹ to 10⁹ scene units".into(),
        found: format!("{widths:?}"),
    })
}

/// exp(−r²/2σ²)/(2πσ²), per area, from the squared distance: it integrates to 1 over the plane.
/// `[eq:profile-gaussian]`
#[inline]
pub fn plane_gaussian(radius_squared: f32, width: f32) -> f32 {
    let inverse = 1.0 / (width * width);
    libm::expf(-0.5 * radius_squared * inverse) * inverse / (2.0 * PI)
}

/// Pullback of [`plane_gaussian`] to the squared distance; the width is fixed.
/// `[eq:profile-gaussian]`
#[inline]
pub fn plane_gaussian_pull(radius_squared: f32, width: f32, d_out: f32) -> f32 {
    -0.5 * d_out * plane_gaussian(radius_squared, width) / (width * width)
}

/// A mixture of Gaussians of fixed widths, per colour channel.
#[derive(Debug, Clone, PartialEq)]
pub struct RadialProfile {
    /// Standard deviations along one axis of the plane, scene units, ascending.
    widths: Vec<f32>,
    /// Weights ≥ 0, linear RGB, one for each width.
    pub weights: Vec<Vec3>,
}

/// Gradient of a scalar with respect to a [`RadialProfile`].
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RadialProfileGrad {
    /// With respect to the weights.
    pub weights: Vec<Vec3>,
}

impl RadialProfile {
    /// A profile. Errors where widths are not ascending and positive, or there is not one weight ≥ 0 for each.
    pub fn new(widths: Vec<f32>, weights: Vec<Vec3>) -> Result<Self, ShadingError> {
        check_widths(&widths)?;
        check_length("weights of a radial profile", widths.len(), weights.len())?;
        if let Some(w) = weights.iter().find(|w| !(w.is_finite() && w.min_element() >= 0.0)) {
            return Err(ShadingError::Setting {
                what: "weights of a radial profile",
                expected: "finite numbers ≥ 0".into(),
                found: format!("{w}"),
            });
        }
        Ok(Self { widths, weights })
    }

    /// `count` widths in geometric progression from `narrowest` to `widest`, scene units.
    pub fn geometric_widths(narrowest: f32, widest: f32, count: usize) -> Vec<f32> {
        let last = count.saturating_sub(1).max(1) as f32;
        (0..count).map(|k| narrowest * libm::powf(widest / narrowest, k as f32 / last)).collect()
    }

    /// The widths, scene units, ascending.
    pub fn widths(&self) -> &[f32] {
        &self.widths
    }

    /// R at a distance, linear RGB per area.
    /// `[eq:radial-profile]`
    pub fn value(&self, radius: f32) -> Vec3 {
        let r2 = radius * radius;
        self.widths.iter().zip(&self.weights).map(|(s, w)| *w * plane_gaussian(r2, *s)).sum()
    }

    /// Pullback of [`RadialProfile::value`]: cotangents of the weights and of the radius.
    /// `[eq:radial-profile]`
    pub fn value_pull(&self, radius: f32, d_out: Vec3) -> (RadialProfileGrad, f32) {
        let r2 = radius * radius;
        let weights = self.widths.iter().map(|s| d_out * plane_gaussian(r2, *s)).collect();
        let each = self.widths.iter().zip(&self.weights);
        let d_r2: f32 = each.map(|(s, w)| plane_gaussian_pull(r2, *s, d_out.dot(*w))).sum();
        (RadialProfileGrad { weights }, 2.0 * radius * d_r2)
    }

    /// ∫ R dA over the plane = Σ_k w_k: the fraction of what enters that leaves again. At most 1 in each channel of anything
    /// that emits nothing itself.
    /// `[eq:profile-reflectance]`
    pub fn reflectance(&self) -> Vec3 {
        self.weights.iter().copied().sum()
    }

    /// ∫ r·R dA / ∫ R dA = √(π/2)·Σ w_k·σ_k / Σ w_k per channel, scene units; 0 where nothing is reflected.
    /// `[eq:profile-mean-radius]`
    pub fn mean_radius(&self) -> Vec3 {
        let sum: Vec3 = self.widths.iter().zip(&self.weights).map(|(s, w)| *w * *s).sum();
        let reflectance = self.reflectance();
        let per = |s: f32, w: f32| if w > MIN_REFLECTANCE { 0.5 * SQRT_2 * PI.sqrt() * s / w } else { 0.0 };
        Vec3::new(per(sum.x, reflectance.x), per(sum.y, reflectance.y), per(sum.z, reflectance.z))
    }

    /// The same with every channel's weights divided by its reflectance where that exceeds 1, so that no energy is created.
    pub fn within_energy(&self) -> Self {
        let scale = self.reflectance().max(Vec3::ONE).recip();
        Self { widths: self.widths.clone(), weights: self.weights.iter().map(|w| *w * scale).collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::adjoint::{relative_error, worst_relative};
    use diamond_testkit::{Dual, Real, gradient, surfel_transport as oracle};
    use proptest::prelude::*;

    const WIDTHS: [f32; 3] = [0.05, 0.2, 0.9];

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// `[eq:profile-gaussian]` `[eq:radial-profile]`: value and gradient against dual numbers.
        #[test]
        fn values_and_gradient_agree_with_the_oracle(r in 0.001f32..0.6, w in [0.01f32..1.0, 0.01f32..1.0, 0.01f32..1.0]) {
            let profile = RadialProfile::new(WIDTHS.to_vec(), w.iter().map(|w| Vec3::new(*w, 0.0, 0.0)).collect()).unwrap();
            let widths = WIDTHS.map(f64::from);
            let x = [f64::from(w[0]), f64::from(w[1]), f64::from(w[2]), f64::from(r)];
            let value = oracle::profile(&widths, &x[..3], x[3] * x[3]);
            prop_assert!(relative_error(f64::from(profile.value(r).x), value, 1e-6) <= 1e-5);
            let expected = gradient(
                |x: &[Dual]| oracle::profile(&widths.map(Dual::of), &x[..3], x[3] * x[3]), &x);
            let (grad, d_radius) = profile.value_pull(r, Vec3::X);
            let mut found: Vec<f64> = grad.weights.iter().map(|w| f64::from(w.x)).collect();
            found.push(f64::from(d_radius));
            prop_assert!(worst_relative(&found, &expected, 1e-4) <= 1e-4, "{found:?} {expected:?}");
        }
    }

    /// `[eq:profile-reflectance]` `[eq:profile-mean-radius]`: both against the integral over the plane.
    #[test]
    fn moments_are_those_of_the_plane() {
        let weights = vec![Vec3::new(0.4, 0.0, 0.1), Vec3::new(0.2, 0.7, 0.1), Vec3::new(0.1, 0.0, 0.8)];
        let profile = RadialProfile::new(WIDTHS.to_vec(), weights).unwrap();
        let (mut area, mut first, step) = ([0.0f64; 3], [0.0f64; 3], 0.001f32);
        for i in 0..10_000 {
            let r = (i as f32 + 0.5) * step;
            for c in 0..3 {
                let ring = 2.0 * std::f64::consts::PI * f64::from(r * step * profile.value(r)[c]);
                area[c] += ring;
                first[c] += ring * f64::from(r);
            }
        }
        for c in 0..3 {
            assert!(relative_error(f64::from(profile.reflectance()[c]), area[c], 0.0) < 1e-4);
            assert!(relative_error(f64::from(profile.mean_radius()[c]), first[c] / area[c], 0.0) < 1e-4);
        }
        let dark = RadialProfile::new(vec![1.0], vec![Vec3::ZERO]).unwrap();
        assert_eq!(dark.mean_radius(), Vec3::ZERO);
    }

    #[test]
    fn what_cannot_be_a_profile_is_refused() {
        assert!(RadialProfile::new(vec![0.2, 0.1], vec![Vec3::ONE; 2]).is_err());
        assert!(RadialProfile::new(vec![0.1, f32::NAN], vec![Vec3::ONE; 2]).is_err());
        assert!(RadialProfile::new(vec![], vec![]).is_err());
        assert!(RadialProfile::new(vec![0.1], vec![Vec3::ONE; 2]).is_err());
        assert!(RadialProfile::new(vec![0.1], vec![-Vec3::ONE]).is_err());
        let bright = RadialProfile::new(vec![0.1, 0.2], vec![Vec3::new(1.5, 0.1, 0.0); 2]).unwrap().within_energy();
        assert!((bright.reflectance() - Vec3::new(1.0, 0.2, 0.0)).length() < 1e-6);
    }
}
