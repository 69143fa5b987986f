//! Fresnel reflectance: how much a facet mirrors, from its reflectance at normal incidence.
use crate::number::Number;
use crate::vector::Vector;
use glam::Vec3;
use std::f32::consts::LN_2;

/// Linear and quadratic coefficient of the spherical-Gaussian fit's exponent, for base 2.
const SPHERICAL_GAUSSIAN: (f32, f32) = (-6.98316, -5.55473);

/// Which Fresnel approximation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Fresnel {
    /// F0 + (1 − F0)·(1 − v·h)⁵.
    #[default]
    Schlick,
    /// F0 + (1 − F0)·2^((−5.55473·v·h − 6.98316)·v·h), a fit of the former (SSS-3DGS).
    SphericalGaussian,
}

impl Fresnel {
    /// The weight between F0 and 1, and its derivative by v·h.
    #[inline(always)]
    fn weight<T: Number>(self, cos_theta_d: T) -> (T, T) {
        match self {
            Fresnel::Schlick => {
                let m = cos_theta_d.complement().at_least(0.0).at_most(1.0);
                let m2 = m * m;
                (m2 * m2 * m, m2 * m2 * -5.0)
            }
            Fresnel::SphericalGaussian => {
                let (linear, quadratic) = SPHERICAL_GAUSSIAN;
                // tidy: allow(the exponential of diamond-simd)
                let weight = ((cos_theta_d * (quadratic * LN_2) + linear * LN_2) * cos_theta_d).exp();
                (weight, weight * LN_2 * (cos_theta_d * (2.0 * quadratic) + linear))
            }
        }
    }

    /// [`Fresnel::reflectance`] of one pixel or many.
    #[inline(always)]
    pub(crate) fn reflectance_of<T: Number>(self, f0: Vector<T>, cos_theta_d: T) -> Vector<T> {
        let (weight, _) = self.weight(cos_theta_d);
        f0 + f0.complement() * weight
    }

    /// [`Fresnel::reflectance_pull`] of one pixel or many.
    #[inline(always)]
    pub(crate) fn reflectance_pull_of<T: Number>(
        self,
        f0: Vector<T>,
        cos_theta_d: T,
        d_out: Vector<T>,
    ) -> (Vector<T>, T) {
        let (weight, slope) = self.weight(cos_theta_d);
        (d_out * weight.complement(), d_out.dot(f0.complement()) * slope)
    }

    /// Reflectance of a facet, linear RGB, for the reflectance `f0` at normal incidence and v·h in `[0, 1]`.
    /// `[eq:fresnel-schlick]` `[eq:fresnel-spherical-gaussian]`
    #[inline]
    pub fn reflectance(self, f0: Vec3, cos_theta_d: f32) -> Vec3 {
        self.reflectance_of(f0.into(), cos_theta_d).into()
    }

    /// Pullback of [`Fresnel::reflectance`]: `(d_f0, d_cos_theta_d)`.
    /// `[eq:fresnel-schlick]` `[eq:fresnel-spherical-gaussian]`
    #[inline]
    pub fn reflectance_pull(self, f0: Vec3, cos_theta_d: f32, d_out: Vec3) -> (Vec3, f32) {
        let (d_f0, d_cos_theta_d) = self.reflectance_pull_of(f0.into(), cos_theta_d, d_out.into());
        (d_f0.into(), d_cos_theta_d)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::adjoint::relative_error;
    use diamond_testkit::{Dual, ggx, gradient};
    use proptest::prelude::*;

    const BOTH: [(Fresnel, ggx::Fresnel); 2] =
        [(Fresnel::Schlick, ggx::Fresnel::Schlick), (Fresnel::SphericalGaussian, ggx::Fresnel::SphericalGaussian)];

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// `[eq:fresnel-schlick]` `[eq:fresnel-spherical-gaussian]`
        #[test]
        fn agrees_with_the_oracle(f0 in 0.02f32..1.0, c in 0.0f32..1.0) {
            let x = [f64::from(f0), f64::from(c)];
            for (ours, theirs) in BOTH {
                let value = ggx::fresnel(theirs, x[0], x[1]);
                let actual = ours.reflectance(Vec3::splat(f0), c).x;
                prop_assert!(relative_error(f64::from(actual), value, 0.0) <= 2e-6, "{ours:?}: {actual} {value}");
                let expected = gradient(|x: &[Dual]| ggx::fresnel(theirs, x[0], x[1]), &x);
                let (d_f0, d_c) = ours.reflectance_pull(Vec3::splat(f0), c, Vec3::X);
                prop_assert!(relative_error(f64::from(d_f0.x), expected[0], 1e-2) <= 1e-4);
                prop_assert!(relative_error(f64::from(d_c), expected[1], 1e-2) <= 1e-4);
            }
        }
    }

    /// `[eq:fresnel-schlick]` `[eq:fresnel-spherical-gaussian]`
    #[test]
    fn everything_mirrors_at_grazing_incidence() {
        for (fresnel, _) in BOTH {
            assert_eq!(fresnel.reflectance(Vec3::new(0.04, 0.5, 0.0), 0.0), Vec3::ONE);
        }
        assert_eq!(Fresnel::Schlick.reflectance(Vec3::splat(0.04), 1.0), Vec3::splat(0.04));
    }

    /// The two fits are not mistaken for one another by the comparison above.
    #[test]
    fn planted_errors_are_noticed() {
        let swapped = Fresnel::SphericalGaussian.reflectance(Vec3::splat(0.04), 0.5).x;
        assert!(
            relative_error(f64::from(swapped), ggx::fresnel(ggx::Fresnel::Schlick, 0.04f32 as f64, 0.5), 0.0) > 1e-4
        );
    }
}
