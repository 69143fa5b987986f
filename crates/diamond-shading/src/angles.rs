//! The four numbers that an isotropic BRDF sees of its three directions.
//!
//! With n the surface normal, v the direction to the viewer, l the direction to the light and h = (v+l)/|v+l| halfway
//! between them, an isotropic microfacet BRDF depends on n·l, n·v, v·h and the angle between n and h only. For a
//! smooth surface the last one must be known to a small fraction of a small angle: 1 − (n·h)² has lost it in `f32`, so
//! it is kept as sin² = |n×h|², and the few operations up to here run in `f64`.
use glam::{DVec3, Vec3};

/// Where |v + l| is smaller, v and l are opposite to within rounding and no half vector exists (both are unit vectors).
const MIN_HALF_LENGTH: f64 = 1e-6;

/// Angles between normal, viewer, light and half vector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Angles {
    /// cos θᵢ = n·l.
    pub cos_theta_i: f32,
    /// cos θₒ = n·v.
    pub cos_theta_o: f32,
    /// cos θ_d = v·h (equal to l·h).
    pub cos_theta_d: f32,
    /// sin² θ_h = |n×h|².
    pub sin2_theta_h: f32,
}

/// Gradient of a scalar with respect to [`Angles`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct AnglesGrad {
    /// With respect to cos θᵢ.
    pub cos_theta_i: f32,
    /// With respect to cos θₒ.
    pub cos_theta_o: f32,
    /// With respect to cos θ_d.
    pub cos_theta_d: f32,
    /// With respect to sin² θ_h.
    pub sin2_theta_h: f32,
}

/// Gradient of a scalar with respect to the three directions, as free vectors: the part along a direction is an
/// artefact of the formula and vanishes in the pullback of whatever normalised that direction.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DirectionsGrad {
    /// With respect to the normal n.
    pub normal: Vec3,
    /// With respect to the direction v to the viewer.
    pub view: Vec3,
    /// With respect to the direction l to the light.
    pub light: Vec3,
}

/// Half vector and |v + l|; `None` where v = −l.
fn half_vector(v: DVec3, l: DVec3) -> Option<(DVec3, f64)> {
    let sum = v + l;
    let length = sum.length();
    (length >= MIN_HALF_LENGTH).then(|| (sum / length, length))
}

impl Angles {
    /// From unit vectors: the normal, and the directions from the surface to the viewer and to the light.
    /// Where v = −l the half vector is taken as perpendicular to both n and v: sin² θ_h = 1, cos θ_d = 0.
    /// `[eq:half-vector]`
    pub fn new(normal: Vec3, view: Vec3, light: Vec3) -> Self {
        let (n, v, l) = (normal.as_dvec3(), view.as_dvec3(), light.as_dvec3());
        let (cos_theta_d, sin2_theta_h) = match half_vector(v, l) {
            Some((h, _)) => (v.dot(h) as f32, n.cross(h).length_squared().min(1.0) as f32),
            None => (0.0, 1.0),
        };
        Self { cos_theta_i: n.dot(l) as f32, cos_theta_o: n.dot(v) as f32, cos_theta_d, sin2_theta_h }
    }

    /// Pullback of [`Angles::new`].
    /// `[eq:half-vector]`
    pub fn pull(normal: Vec3, view: Vec3, light: Vec3, d: &AnglesGrad) -> DirectionsGrad {
        let (n, v, l) = (normal.as_dvec3(), view.as_dvec3(), light.as_dvec3());
        let (d_i, d_o) = (f64::from(d.cos_theta_i), f64::from(d.cos_theta_o));
        let mut d_n = l * d_i + v * d_o;
        let mut d_v = n * d_o;
        let mut d_l = n * d_i;
        if let Some((h, length)) = half_vector(v, l) {
            let (d_d, d_s) = (f64::from(d.cos_theta_d), f64::from(d.sin2_theta_h));
            let d_cross = n.cross(h) * (2.0 * d_s);
            d_n += h.cross(d_cross);
            let d_h = d_cross.cross(n) + v * d_d;
            let d_sum = (d_h - h * h.dot(d_h)) / length;
            d_v += h * d_d + d_sum;
            d_l += d_sum;
        }
        DirectionsGrad { normal: d_n.as_vec3(), view: d_v.as_vec3(), light: d_l.as_vec3() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::strategies::unit_vector;
    use diamond_testkit::{Dual, Real, adjoint, ggx, gradient};
    use proptest::prelude::*;

    fn widen(v: [f32; 3]) -> [f64; 3] {
        v.map(f64::from)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// `[eq:half-vector]`
        #[test]
        fn values_and_gradient_agree_with_the_oracle(
            n in unit_vector(), v in unit_vector(), l in unit_vector(),
            d in [-1.0f32..1.0, -1.0f32..1.0, -1.0f32..1.0, -1.0f32..1.0],
        ) {
            // Nearly opposite directions magnify their rounding, which the oracle normalises away.
            prop_assume!((Vec3::from(v) + Vec3::from(l)).length() > 0.2);
            let x: Vec<f64> = [widen(n), widen(v), widen(l)].concat();
            let naive = |x: &[Dual]| {
                let a = ggx::angles([x[0], x[1], x[2]], [x[3], x[4], x[5]], [x[6], x[7], x[8]]);
                // sin² = 1 − cos²
                [a[0], a[1], a[2], Dual::of(1.0) - a[3] * a[3]]
            };
            let constants: Vec<Dual> = x.iter().map(|&v| Dual::of(v)).collect();
            let expected = naive(&constants).map(|a| a.v);
            let a = Angles::new(n.into(), v.into(), l.into());
            let actual = [a.cos_theta_i, a.cos_theta_o, a.cos_theta_d, a.sin2_theta_h].map(f64::from);
            prop_assert!(adjoint::worst_relative(&actual, &expected, 1.0) <= 1e-6, "{actual:?} {expected:?}");

            let expected = gradient(|x| {
                let a = naive(x);
                (0..4).fold(Dual::of(0.0), |s, i| s + a[i] * Dual::of(f64::from(d[i])))
            }, &x);
            let d = AnglesGrad { cos_theta_i: d[0], cos_theta_o: d[1], cos_theta_d: d[2], sin2_theta_h: d[3] };
            let g = Angles::pull(n.into(), v.into(), l.into(), &d);
            // The oracle normalises its inputs: compare on the tangent planes.
            for (k, (g, u)) in [(g.normal, n), (g.view, v), (g.light, l)].into_iter().enumerate() {
                let u = Vec3::from(u);
                let tangent = (g - u * u.dot(g)).to_array().map(f64::from);
                let gap = adjoint::relative_l2(&tangent, &expected[3 * k..3 * k + 3], 0.1);
                prop_assert!(gap <= 1e-5, "direction {k}: {tangent:?} {expected:?}");
            }
        }
    }

    #[test]
    fn opposite_directions_have_no_half_vector_and_stay_finite() {
        let a = Angles::new(Vec3::Z, Vec3::X, Vec3::NEG_X);
        assert_eq!((a.cos_theta_d, a.sin2_theta_h), (0.0, 1.0));
        let d = AnglesGrad { cos_theta_i: 1.0, cos_theta_o: 1.0, cos_theta_d: 1.0, sin2_theta_h: 1.0 };
        let g = Angles::pull(Vec3::Z, Vec3::X, Vec3::NEG_X, &d);
        assert!(g.normal.is_finite() && g.view.is_finite() && g.light.is_finite());
    }

    #[test]
    fn small_half_angles_keep_their_digits() {
        // h is tilted from n by 1e-4 rad: sin² = 1e-8, which 1 − cos² cannot hold in f32.
        let (s, c) = 1e-4f64.sin_cos();
        let a = Angles::new(Vec3::Z, Vec3::new(s as f32, 0.0, c as f32), Vec3::new(s as f32, 0.0, c as f32));
        assert!((f64::from(a.sin2_theta_h) / (s * s) - 1.0).abs() < 1e-6, "{}", a.sin2_theta_h);
    }
}
