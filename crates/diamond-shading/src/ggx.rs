//! The GGX microfacet distribution and its masking: how many facets point halfway, and how many of them are seen.
//!
//! All variants of the masking are offered as G/(4·n·v·n·l), which is how the BRDF uses it: written that way the
//! cosines cancel, and nothing has to be clamped at grazing angles. [`Masking::attenuation`] gives G itself.
//!
//! Arguments are scalars: α = roughness² in `[1e-6, 1]`, cosines in `(0, 1]`, sin² θ_h in `[0, 1]` (see
//! [`Angles`](crate::Angles)).
use crate::number::Number;
use std::f32::consts::FRAC_1_PI;

/// The denominator of the height-correlated term is at least this: it vanishes where both cosines do (reached only below
/// cosines of 1e-6), and its square and the distribution's peak must stay inside the range of `f32`.
const MIN_CORRELATED_DENOMINATOR: f32 = 1e-12;

/// Normal distribution D of GGX, per steradian: D = α² / (π·(α²·cos²θ_h + sin²θ_h)²).
///
/// It equals α² / (π·((n·h)²(α²−1)+1)²) on paper, and keeps its digits for small α.
/// `[eq:ggx-d]`
#[inline]
pub fn distribution(alpha: f32, sin2_theta_h: f32) -> f32 {
    distribution_of(alpha, sin2_theta_h)
}

/// [`distribution`] of one pixel or many.
#[inline(always)]
pub(crate) fn distribution_of<T: Number>(alpha: T, sin2_theta_h: T) -> T {
    let ratio = alpha / ellipsoid(alpha, sin2_theta_h);
    ratio * ratio * FRAC_1_PI
}

/// α²·cos²θ_h + sin²θ_h, a sum of positive terms.
#[inline(always)]
fn ellipsoid<T: Number>(alpha: T, sin2_theta_h: T) -> T {
    alpha * alpha * sin2_theta_h.complement() + sin2_theta_h
}

/// Pullback of [`distribution`]: `(d_alpha, d_sin2_theta_h)`.
/// `[eq:ggx-d]`
#[inline]
pub fn distribution_pull(alpha: f32, sin2_theta_h: f32, d_out: f32) -> (f32, f32) {
    distribution_pull_of(alpha, sin2_theta_h, d_out)
}

/// [`distribution_pull`] of one pixel or many.
#[inline(always)]
pub(crate) fn distribution_pull_of<T: Number>(alpha: T, sin2_theta_h: T, d_out: T) -> (T, T) {
    let t = ellipsoid(alpha, sin2_theta_h);
    let ratio = alpha / t;
    let d = d_out * 2.0 * ratio * ratio * FRAC_1_PI;
    // ∂t/∂α = 2α·cos²θ_h, ∂t/∂sin² = 1 − α².
    let d_alpha = d * (sin2_theta_h - alpha * alpha * sin2_theta_h.complement()) / (alpha * t);
    (d_alpha, -d * alpha.complement() * (alpha + 1.0) / t)
}

/// Which masking and shadowing term G.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Masking {
    /// Exact Smith for GGX, masking and shadowing independent: G₁(n·v)·G₁(n·l).
    SmithSeparable,
    /// Exact Smith for GGX, correlated by height.
    #[default]
    SmithCorrelated,
    /// Schlick's rational approximation with k = (roughness + 1)²/8 (real-time rendering; SSS-3DGS).
    SchlickRoughness,
    /// Schlick's rational approximation with k = α/2.
    SchlickHalfAlpha,
}

/// Gradient of a masking term with respect to its arguments.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct MaskingGrad {
    /// With respect to the roughness (not α).
    pub roughness: f32,
    /// With respect to n·v.
    pub cos_theta_o: f32,
    /// With respect to n·l.
    pub cos_theta_i: f32,
}

/// [`MaskingGrad`] of one pixel or many.
pub(crate) struct MaskingGradOf<T> {
    pub roughness: T,
    pub cos_theta_o: T,
    pub cos_theta_i: T,
}

/// One direction's factor of the masking, with its derivatives.
struct Factor<T> {
    value: T,
    by_cosine: T,
    /// By α for Smith, by k for Schlick.
    by_width: T,
}

/// √(cos² + α²·sin²): the length that Smith's Λ = (root/cos − 1)/2 is made of.
#[inline(always)]
fn smith_root<T: Number>(alpha: T, cosine: T) -> Factor<T> {
    let sin2 = cosine.complement() * (cosine + 1.0);
    let value = (cosine * cosine + alpha * alpha * sin2).root();
    let by_cosine = cosine * alpha.complement() * (alpha + 1.0) / value;
    Factor { value, by_cosine, by_width: alpha * sin2 / value }
}

/// cos·(1 − k) + k: the denominator of Schlick's G₁ = cos / (cos·(1 − k) + k).
#[inline(always)]
fn schlick_denominator<T: Number>(k: T, cosine: T) -> Factor<T> {
    Factor { value: cosine * k.complement() + k, by_cosine: k.complement(), by_width: cosine.complement() }
}

impl Masking {
    /// k of Schlick's form and dk/droughness.
    #[inline(always)]
    fn schlick_k<T: Number>(self, roughness: T) -> (T, T) {
        match self {
            Masking::SchlickRoughness => ((roughness + 1.0) * (roughness + 1.0) * 0.125, (roughness + 1.0) * 0.25),
            _ => (roughness * roughness * 0.5, roughness),
        }
    }

    /// [`Masking::over_cosines`] of one pixel or many.
    #[inline(always)]
    pub(crate) fn over_cosines_of<T: Number>(self, roughness: T, cos_theta_o: T, cos_theta_i: T) -> T {
        let alpha = roughness * roughness;
        match self {
            Masking::SmithSeparable => {
                let o = cos_theta_o + smith_root(alpha, cos_theta_o).value;
                let i = cos_theta_i + smith_root(alpha, cos_theta_i).value;
                (o * i).inverse()
            }
            Masking::SmithCorrelated => {
                let (o, i) = (smith_root(alpha, cos_theta_o).value, smith_root(alpha, cos_theta_i).value);
                let sum = cos_theta_i * o + cos_theta_o * i;
                sum.same(0.5) / sum.at_least(MIN_CORRELATED_DENOMINATOR)
            }
            Masking::SchlickRoughness | Masking::SchlickHalfAlpha => {
                let (k, _) = self.schlick_k(roughness);
                k.same(0.25) / (schlick_denominator(k, cos_theta_o).value * schlick_denominator(k, cos_theta_i).value)
            }
        }
    }

    /// [`Masking::over_cosines_pull`] of one pixel or many.
    #[inline(always)]
    pub(crate) fn over_cosines_pull_of<T: Number>(
        self,
        roughness: T,
        cos_theta_o: T,
        cos_theta_i: T,
        d_out: T,
    ) -> MaskingGradOf<T> {
        let alpha = roughness * roughness;
        match self {
            Masking::SmithSeparable => {
                let (root_o, root_i) = (smith_root(alpha, cos_theta_o), smith_root(alpha, cos_theta_i));
                let (o, i) = (cos_theta_o + root_o.value, cos_theta_i + root_i.value);
                let d = -d_out / (o * i);
                MaskingGradOf {
                    roughness: d * (root_o.by_width / o + root_i.by_width / i) * 2.0 * roughness,
                    cos_theta_o: d * (root_o.by_cosine + 1.0) / o,
                    cos_theta_i: d * (root_i.by_cosine + 1.0) / i,
                }
            }
            Masking::SmithCorrelated => {
                let (o, i) = (smith_root(alpha, cos_theta_o), smith_root(alpha, cos_theta_i));
                let sum = cos_theta_i * o.value + cos_theta_o * i.value;
                // Below the guard the value is constant. One division at a time: sum² may leave the range of f32.
                let free = sum.reaches(MIN_CORRELATED_DENOMINATOR);
                let sum = sum.at_least(MIN_CORRELATED_DENOMINATOR);
                let d = (-d_out * (sum.same(0.5) / sum) / sum).only_where(free);
                MaskingGradOf {
                    roughness: d * (cos_theta_i * o.by_width + cos_theta_o * i.by_width) * 2.0 * roughness,
                    cos_theta_o: d * (cos_theta_i * o.by_cosine + i.value),
                    cos_theta_i: d * (o.value + cos_theta_o * i.by_cosine),
                }
            }
            Masking::SchlickRoughness | Masking::SchlickHalfAlpha => {
                let (k, k_by_roughness) = self.schlick_k(roughness);
                let (o, i) = (schlick_denominator(k, cos_theta_o), schlick_denominator(k, cos_theta_i));
                let d = -d_out * 0.25 / (o.value * i.value);
                MaskingGradOf {
                    roughness: d * (o.by_width / o.value + i.by_width / i.value) * k_by_roughness,
                    cos_theta_o: d * o.by_cosine / o.value,
                    cos_theta_i: d * i.by_cosine / i.value,
                }
            }
        }
    }

    /// G/(4·n·v·n·l) for a roughness in `[1e-3, 1]` and cosines in `(0, 1]`.
    /// `[eq:smith-separable]` `[eq:smith-correlated]` `[eq:schlick-ggx]`
    #[inline]
    pub fn over_cosines(self, roughness: f32, cos_theta_o: f32, cos_theta_i: f32) -> f32 {
        self.over_cosines_of(roughness, cos_theta_o, cos_theta_i)
    }

    /// Pullback of [`Masking::over_cosines`].
    /// `[eq:smith-separable]` `[eq:smith-correlated]` `[eq:schlick-ggx]`
    #[inline]
    pub fn over_cosines_pull(self, roughness: f32, cos_theta_o: f32, cos_theta_i: f32, d_out: f32) -> MaskingGrad {
        let d = self.over_cosines_pull_of(roughness, cos_theta_o, cos_theta_i, d_out);
        MaskingGrad { roughness: d.roughness, cos_theta_o: d.cos_theta_o, cos_theta_i: d.cos_theta_i }
    }

    /// G itself, in `[0, 1]`: the share of facets that both the viewer and the light see.
    /// `[eq:smith-separable]` `[eq:smith-correlated]` `[eq:schlick-ggx]`
    #[inline]
    pub fn attenuation(self, roughness: f32, cos_theta_o: f32, cos_theta_i: f32) -> f32 {
        4.0 * cos_theta_o * cos_theta_i * self.over_cosines(roughness, cos_theta_o, cos_theta_i)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::adjoint::{relative_error, worst_relative};
    use diamond_testkit::{Dual, Real, ggx, gradient};
    use proptest::prelude::*;

    /// A cosine or sine, often small.
    fn cosine() -> impl Strategy<Value = f32> {
        prop_oneof![1e-3f32..1.0, (-9.0f32..0.0).prop_map(f32::exp)]
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// `[eq:ggx-d]`
        #[test]
        fn distribution_agrees_with_the_oracle(roughness in 0.03f32..1.0, sine in cosine()) {
            let (alpha, sin2) = (roughness * roughness, sine * sine);
            // The oracle takes cos θ_h, as the textbook does.
            let naive = |alpha: Dual, sin2: Dual| ggx::distribution(alpha, (Dual::of(1.0) - sin2).sqrt());
            let x = [f64::from(alpha), f64::from(sin2)];
            let value = naive(Dual::of(x[0]), Dual::of(x[1])).v;
            prop_assert!(relative_error(f64::from(distribution(alpha, sin2)), value, 0.0) <= 2e-6);
            let expected = gradient(|x| naive(x[0], x[1]), &x);
            let (d_alpha, d_sin2) = distribution_pull(alpha, sin2, 1.0);
            prop_assert!(relative_error(f64::from(d_alpha), expected[0], 1e-2 * value / x[0]) <= 1e-4);
            prop_assert!(relative_error(f64::from(d_sin2), expected[1], 1e-2 * value) <= 1e-4);
        }

        /// `[eq:smith-separable]` `[eq:smith-correlated]` `[eq:schlick-ggx]`
        #[test]
        fn masking_agrees_with_the_oracle(roughness in 0.03f32..1.0, o in cosine(), i in cosine()) {
            let x = [f64::from(roughness), f64::from(o), f64::from(i)];
            for (ours, theirs) in [
                (Masking::SmithSeparable, ggx::Masking::SmithSeparable),
                (Masking::SmithCorrelated, ggx::Masking::SmithCorrelated),
                (Masking::SchlickRoughness, ggx::Masking::SchlickRoughness),
                (Masking::SchlickHalfAlpha, ggx::Masking::SchlickHalfAlpha),
            ] {
                let g = ggx::masking(theirs, x[0], x[1], x[2]);
                prop_assert!(relative_error(f64::from(ours.attenuation(roughness, o, i)), g, 0.0) <= 2e-6, "{ours:?}");
                let naive = |x: &[Dual]| ggx::masking(theirs, x[0], x[1], x[2]) / (Dual::of(4.0) * x[1] * x[2]);
                let expected = gradient(naive, &x);
                let grad = ours.over_cosines_pull(roughness, o, i, 1.0);
                let actual = [grad.roughness, grad.cos_theta_o, grad.cos_theta_i].map(f64::from);
                let value = g / (4.0 * x[1] * x[2]);
                for k in 0..3 {
                    let gap = relative_error(actual[k], expected[k], 1e-3 * value);
                    prop_assert!(gap <= 1e-4, "{ours:?} argument {k}: {actual:?} {expected:?}");
                }
            }
        }
    }

    /// `[eq:smith-separable]` `[eq:smith-correlated]` `[eq:schlick-ggx]`
    #[test]
    fn nothing_is_masked_at_normal_incidence() {
        for masking in
            [Masking::SmithSeparable, Masking::SmithCorrelated, Masking::SchlickRoughness, Masking::SchlickHalfAlpha]
        {
            assert!((masking.attenuation(0.4, 1.0, 1.0) - 1.0).abs() < 1e-6, "{masking:?}");
        }
    }

    /// The comparisons above notice the mistakes that are made with this formula.
    #[test]
    fn planted_errors_are_noticed() {
        let (roughness, o, i) = (0.5f32, 0.4f32, 0.7f32);
        let x = [0.5, f64::from(o), f64::from(i)];
        let expected = ggx::masking(ggx::Masking::SmithSeparable, x[0], x[1], x[2]);
        // α taken for the roughness, the other masking, a lost factor.
        let roughness_as_alpha = Masking::SmithSeparable.attenuation(roughness.sqrt(), o, i);
        let other = Masking::SmithCorrelated.attenuation(roughness, o, i);
        let lost = 0.5 * Masking::SmithSeparable.attenuation(roughness, o, i);
        for wrong in [roughness_as_alpha, other, lost] {
            assert!(worst_relative(&[f64::from(wrong)], &[expected], 0.0) > 1e-4);
        }
        let naive = |x: &[Dual]| ggx::distribution(x[0], (Dual::of(1.0) - x[1]).sqrt());
        let expected = gradient(naive, &[0.25, 0.1]);
        let (d_alpha, d_sin2) = distribution_pull(0.25, 0.1, 1.0);
        assert!(worst_relative(&[f64::from(-d_alpha), f64::from(d_sin2)], &expected, 0.0) > 1e-4);
        assert!(worst_relative(&[f64::from(d_alpha), f64::from(d_sin2) * 0.999], &expected, 0.0) > 1e-4);
    }

    #[test]
    fn the_smoothest_surface_at_the_lowest_angle_is_finite() {
        let alpha = crate::material::MIN_ROUGHNESS * crate::material::MIN_ROUGHNESS;
        for sin2 in [0.0, 1e-12, 1e-6, 1.0] {
            let (a, s) = distribution_pull(alpha, sin2, 1.0);
            assert!(distribution(alpha, sin2).is_finite() && a.is_finite() && s.is_finite());
        }
        for masking in
            [Masking::SmithSeparable, Masking::SmithCorrelated, Masking::SchlickRoughness, Masking::SchlickHalfAlpha]
        {
            for (o, i) in [(f32::MIN_POSITIVE, f32::MIN_POSITIVE), (1e-12, 1.0), (1.0, 1e-20)] {
                let g = masking.over_cosines_pull(crate::material::MIN_ROUGHNESS, o, i, 1.0);
                let value = masking.over_cosines(crate::material::MIN_ROUGHNESS, o, i);
                let all = [value, g.roughness, g.cos_theta_o, g.cos_theta_i];
                assert!(all.iter().all(|v| v.is_finite()), "{masking:?} {o} {i}: {all:?}");
            }
        }
    }
}
