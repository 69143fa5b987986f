//! The four numbers that an isotropic BRDF sees of its three directions.
//!
//! With n the surface normal, v the direction to the viewer, l the direction to the light and h = (v+l)/|v+l| halfway
//! between them, an isotropic microfacet BRDF depends on n·l, n·v, v·h and the angle between n and h only. For a
//! smooth surface the last one must be known to a small fraction of a small angle: 1 − (n·h)² has lost it in `f32`, so
//! it is kept as sin² = |n×h|² = |n×(v+l)|²/|v+l|². Both squares come from `f64`, and are divided after they are rounded.
use crate::number::{Number, PerLane};
use crate::vector::Vector;
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

/// [`Angles`], or [`AnglesGrad`], of one pixel or many.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AnglesOf<T> {
    pub cos_theta_i: T,
    pub cos_theta_o: T,
    pub cos_theta_d: T,
    pub sin2_theta_h: T,
}

/// [`DirectionsGrad`] of one pixel or many.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DirectionsGradOf<T> {
    pub normal: Vector<T>,
    pub view: Vector<T>,
    pub light: Vector<T>,
}

#[inline(always)]
fn widen(x: f32, y: f32, z: f32) -> DVec3 {
    DVec3::new(f64::from(x), f64::from(y), f64::from(z))
}

/// Half vector and 1/|v + l|; both 0 where v = −l.
#[inline(always)]
fn half_vector(v: DVec3, l: DVec3) -> (DVec3, f64) {
    let sum = v + l;
    let length = sum.dot(sum).sqrt();
    let inverse = if length >= MIN_HALF_LENGTH { 1.0 / length } else { 0.0 };
    (sum * inverse, inverse)
}

/// n, v, l → n·l, n·v, v·(v+l), |v+l|², |n×(v+l)|²: sums of products, without a root or a quotient.
struct Products;

impl PerLane<9, 5> for Products {
    #[inline(always)]
    fn at(&self, x: [f32; 9]) -> [f32; 5] {
        let (n, v, l) = (widen(x[0], x[1], x[2]), widen(x[3], x[4], x[5]), widen(x[6], x[7], x[8]));
        let sum = v + l;
        let cross = n.cross(sum);
        [n.dot(l) as f32, n.dot(v) as f32, v.dot(sum) as f32, sum.dot(sum) as f32, cross.dot(cross) as f32]
    }
}

/// n, v, l and the cotangents of the four angles → those of n, v, l.
struct Pullback;

impl PerLane<13, 9> for Pullback {
    #[inline(always)]
    fn at(&self, x: [f32; 13]) -> [f32; 9] {
        let (n, v, l) = (widen(x[0], x[1], x[2]), widen(x[3], x[4], x[5]), widen(x[6], x[7], x[8]));
        let (d_i, d_o, d_d, d_s) = (f64::from(x[9]), f64::from(x[10]), f64::from(x[11]), f64::from(x[12]));
        // Without a half vector, h and the inverse length are 0, and so is what comes by way of them.
        let (h, inverse) = half_vector(v, l);
        let d_cross = n.cross(h) * (2.0 * d_s);
        let d_h = d_cross.cross(n) + v * d_d;
        let d_sum = (d_h - h * h.dot(d_h)) * inverse;
        let d_n = l * d_i + v * d_o + h.cross(d_cross);
        let d_v = n * d_o + h * d_d + d_sum;
        let d_l = n * d_i + d_sum;
        let narrow = [d_n.x, d_n.y, d_n.z, d_v.x, d_v.y, d_v.z, d_l.x, d_l.y, d_l.z];
        let mut out = [0.0; 9];
        for i in 0..9 {
            out[i] = narrow[i] as f32;
        }
        out
    }
}

impl<T: Number> AnglesOf<T> {
    /// [`Angles::new`] of one pixel or many.
    #[inline(always)]
    pub fn new(n: Vector<T>, v: Vector<T>, l: Vector<T>) -> Self {
        let x = [n.x, n.y, n.z, v.x, v.y, v.z, l.x, l.y, l.z];
        let [cos_theta_i, cos_theta_o, along, square, across] = T::per_lane(&Products, x);
        let exists = square.reaches((MIN_HALF_LENGTH * MIN_HALF_LENGTH) as f32);
        let square = square.or_where_not(exists, square.same(1.0));
        let cos_theta_d = (along / square.root()).only_where(exists);
        let sin2_theta_h = (across / square).at_most(1.0).or_where_not(exists, square.same(1.0));
        Self { cos_theta_i, cos_theta_o, cos_theta_d, sin2_theta_h }
    }

    /// [`Angles::pull`] of one pixel or many.
    #[inline(always)]
    pub fn pull(n: Vector<T>, v: Vector<T>, l: Vector<T>, d: &Self) -> DirectionsGradOf<T> {
        let (i, o) = (d.cos_theta_i, d.cos_theta_o);
        let x = [n.x, n.y, n.z, v.x, v.y, v.z, l.x, l.y, l.z, i, o, d.cos_theta_d, d.sin2_theta_h];
        let d = T::per_lane(&Pullback, x);
        DirectionsGradOf {
            normal: Vector::new(d[0], d[1], d[2]),
            view: Vector::new(d[3], d[4], d[5]),
            light: Vector::new(d[6], d[7], d[8]),
        }
    }
}

impl From<&Angles> for AnglesOf<f32> {
    #[inline(always)]
    fn from(a: &Angles) -> Self {
        let Angles { cos_theta_i, cos_theta_o, cos_theta_d, sin2_theta_h } = *a;
        Self { cos_theta_i, cos_theta_o, cos_theta_d, sin2_theta_h }
    }
}

impl From<DirectionsGradOf<f32>> for DirectionsGrad {
    #[inline(always)]
    fn from(d: DirectionsGradOf<f32>) -> Self {
        Self { normal: d.normal.into(), view: d.view.into(), light: d.light.into() }
    }
}

impl Angles {
    /// From unit vectors: the normal, and the directions from the surface to the viewer and to the light.
    /// Where v = −l the half vector is taken as perpendicular to both n and v: sin² θ_h = 1, cos θ_d = 0.
    /// `[eq:half-vector]`
    pub fn new(normal: Vec3, view: Vec3, light: Vec3) -> Self {
        let a = AnglesOf::new(normal.into(), view.into(), light.into());
        let AnglesOf { cos_theta_i, cos_theta_o, cos_theta_d, sin2_theta_h } = a;
        Self { cos_theta_i, cos_theta_o, cos_theta_d, sin2_theta_h }
    }

    /// Pullback of [`Angles::new`].
    /// `[eq:half-vector]`
    pub fn pull(normal: Vec3, view: Vec3, light: Vec3, d: &AnglesGrad) -> DirectionsGrad {
        let AnglesGrad { cos_theta_i, cos_theta_o, cos_theta_d, sin2_theta_h } = *d;
        let d = AnglesOf { cos_theta_i, cos_theta_o, cos_theta_d, sin2_theta_h };
        AnglesOf::pull(normal.into(), view.into(), light.into(), &d).into()
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
