//! Real spherical harmonics up to degree 3 (16 coefficients), with gradient in the direction.
//!
//! A spherical function f(ω) = Σᵢ cᵢ·Yᵢ(ω) is stored as the coefficients cᵢ in the order (l, m) = (0,0), (1,−1), (1,0),
//! (1,1), (2,−2), …, (3,3): coefficient `l² + l + m`. The basis is orthonormal over the unit sphere, ∫Yᵢ·Yⱼ dω = δᵢⱼ,
//! and carries the Condon–Shortley phase (−1)^m, as radiance coefficients in splat files do.
//!
//! The functions are polynomials in x, y, z: where the unit sphere allows several forms (x²+y²+z² = 1), the one used is
//! written with 3z² − 1 and its like, and the pullback is that of the polynomial as written. Directions are expected to
//! have unit length; the gradient's part along the direction is an artefact of the form chosen, and it vanishes when the
//! pullback of the caller's normalisation is applied.
//!
//! ```
//! use diamond_light::spherical_harmonics::{basis, basis_to_degree};
//! use glam::Vec3;
//! let y = basis(Vec3::Z);
//! assert!((y[2] - 0.4886025).abs() < 1e-6); // Y(1,0) = √(3/4π)·z
//! assert_eq!(basis_to_degree(Vec3::Z, 1), y[..4]);
//! ```
use glam::Vec3;

/// The highest degree.
pub const MAX_DEGREE: usize = 3;

/// Number of coefficients of degree 3: (3 + 1)².
pub const COEFFICIENTS: usize = 16;

/// ½·√(1/π).
const C0: f32 = 0.282_094_8;
/// √(3/4π).
const C1: f32 = 0.488_602_5;
/// ½·√(15/π): xy, yz, xz.
const C2_PRODUCT: f32 = 1.092_548_4;
/// ¼·√(5/π): 3z² − 1.
const C2_ZONAL: f32 = 0.315_391_57;
/// ¼·√(15/π): x² − y².
const C2_SQUARES: f32 = 0.546_274_2;
/// ¼·√(35/2π): m = ±3.
const C3_3: f32 = 0.590_043_6;
/// ½·√(105/π): xyz; half of it for z(x² − y²).
const C3_2: f32 = 2.890_611_4;
/// ¼·√(21/2π): m = ±1.
const C3_1: f32 = 0.457_045_8;
/// ¼·√(7/π): z(5z² − 3).
const C3_0: f32 = 0.373_176_33;

/// Components are cut to this before use: unit directions never come near it, and its cube still fits an `f32`, so that
/// any finite input gives finite output.
const MAX_COMPONENT: f32 = 1e6;

/// Number of coefficients up to `degree`: (degree + 1)². Degrees above [`MAX_DEGREE`] count as it.
pub const fn coefficients_to_degree(degree: usize) -> usize {
    let n = if degree < MAX_DEGREE { degree + 1 } else { MAX_DEGREE + 1 };
    n * n
}

/// The 16 basis functions in the unit direction `direction` (dimensionless, order `l² + l + m`).
/// `[eq:sh-basis]`
pub fn basis(direction: Vec3) -> [f32; COEFFICIENTS] {
    let Vec3 { x, y, z } = direction.clamp(Vec3::splat(-MAX_COMPONENT), Vec3::splat(MAX_COMPONENT));
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        C0,
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2_PRODUCT * x * y,
        -C2_PRODUCT * y * z,
        C2_ZONAL * (3.0 * zz - 1.0),
        -C2_PRODUCT * x * z,
        C2_SQUARES * (xx - yy),
        -C3_3 * y * (3.0 * xx - yy),
        C3_2 * x * y * z,
        -C3_1 * y * (5.0 * zz - 1.0),
        C3_0 * z * (5.0 * zz - 3.0),
        -C3_1 * x * (5.0 * zz - 1.0),
        0.5 * C3_2 * z * (xx - yy),
        -C3_3 * x * (xx - 3.0 * yy),
    ]
}

/// Pullback of [`basis`]: the cotangent of the 16 values → that of the direction (unconstrained; project it on the
/// tangent plane, or pull it through a normalisation, where the direction is a unit vector).
/// `[eq:sh-basis]`
pub fn basis_pull(direction: Vec3, d_basis: &[f32; COEFFICIENTS]) -> Vec3 {
    let Vec3 { x, y, z } = direction.clamp(Vec3::splat(-MAX_COMPONENT), Vec3::splat(MAX_COMPONENT));
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let d = d_basis;
    let mut g = Vec3::new(-C1 * d[3], -C1 * d[1], C1 * d[2]);
    g += C2_PRODUCT * Vec3::new(y * d[4] - z * d[7], x * d[4] - z * d[5], -y * d[5] - x * d[7]);
    g += Vec3::new(2.0 * C2_SQUARES * x * d[8], -2.0 * C2_SQUARES * y * d[8], 6.0 * C2_ZONAL * z * d[6]);
    // d[9]: −C·(3x²y − y³); d[15]: −C·(x³ − 3xy²).
    g -= C3_3 * d[9] * Vec3::new(6.0 * x * y, 3.0 * (xx - yy), 0.0);
    g -= C3_3 * d[15] * Vec3::new(3.0 * (xx - yy), -6.0 * x * y, 0.0);
    g += C3_2 * d[10] * Vec3::new(y * z, x * z, x * y);
    g += 0.5 * C3_2 * d[14] * Vec3::new(2.0 * x * z, -2.0 * y * z, xx - yy);
    g -= C3_1 * d[11] * Vec3::new(0.0, 5.0 * zz - 1.0, 10.0 * y * z);
    g -= C3_1 * d[13] * Vec3::new(5.0 * zz - 1.0, 0.0, 10.0 * x * z);
    g += C3_0 * d[12] * Vec3::new(0.0, 0.0, 15.0 * zz - 3.0);
    g
}

/// The first `(degree + 1)²` basis functions; degrees above [`MAX_DEGREE`] count as it.
/// `[eq:sh-basis]`
pub fn basis_to_degree(direction: Vec3, degree: usize) -> Vec<f32> {
    basis(direction)[..coefficients_to_degree(degree)].to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::adjoint::{adjoint_gap, relative_l2};
    use diamond_testkit::light::sh_basis;
    use diamond_testkit::strategies::{extreme, unit_vector, values, vector};
    use diamond_testkit::{Dual, jvp, vjp};
    use proptest::prelude::*;

    fn wide(v: &[f32]) -> Vec<f64> {
        v.iter().map(|&v| f64::from(v)).collect()
    }

    fn oracle(x: &[Dual]) -> Vec<Dual> {
        sh_basis([x[0], x[1], x[2]], MAX_DEGREE)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// [eq:sh-basis]: value, gradient and adjoint identity against the recurrence, in and off the unit sphere.
        #[test]
        fn basis_and_pullback_agree_with_the_oracle(
            d in prop_oneof![unit_vector(), vector(-1.5..1.5)], u in values(COEFFICIENTS, -1.0..1.0),
            t in [-1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0],
        ) {
            let x = wide(&d);
            let u: [f32; COEFFICIENTS] = u.try_into().unwrap();
            let value = wide(&basis(d.into()));
            let expected = sh_basis([x[0], x[1], x[2]], MAX_DEGREE);
            prop_assert!(relative_l2(&value, &expected, 1e-3) <= 1e-6);
            let got = wide(&basis_pull(d.into(), &u).to_array());
            let expected = vjp(oracle, &x, &wide(&u));
            let error = relative_l2(&got, &expected, 1e-1);
            prop_assert!(error <= 1e-5, "{error:e}: {got:?} instead of {expected:?}");
            prop_assert!(adjoint_gap(&wide(&u), &jvp(oracle, &x, &t), &got, &t) <= 1e-5);
        }

        /// One coefficient at a time, so that an error in a small one cannot hide behind the others.
        #[test]
        fn every_single_gradient_agrees(d in unit_vector(), i in 0..COEFFICIENTS) {
            let mut u = [0.0f32; COEFFICIENTS];
            u[i] = 1.0;
            let got = wide(&basis_pull(d.into(), &u).to_array());
            let error = relative_l2(&got, &vjp(oracle, &wide(&d), &wide(&u)), 1e-2);
            prop_assert!(error <= 1e-5, "coefficient {i}: {error:e}");
        }

        #[test]
        fn any_finite_direction_gives_finite_results(x in extreme(), y in extreme(), z in extreme()) {
            let d = Vec3::new(x, y, z);
            prop_assert!(basis(d).iter().all(|v| v.is_finite()));
            prop_assert!(basis_pull(d, &[1.0; COEFFICIENTS]).is_finite());
        }
    }

    /// The comparison above has been seen to fail: an exchanged pair of coefficients and a wrong sign are noticed.
    #[test]
    fn planted_errors_are_noticed() {
        let d = Vec3::new(0.48, -0.6, 0.64);
        let expected = sh_basis(wide(&d.to_array()).try_into().unwrap(), MAX_DEGREE);
        let right = wide(&basis(d));
        assert!(relative_l2(&right, &expected, 1e-3) <= 1e-6);
        let mut exchanged = right.clone();
        exchanged.swap(11, 13);
        let mut negated = right;
        negated[5] = -negated[5];
        assert!([exchanged, negated].iter().all(|broken| relative_l2(broken, &expected, 1e-3) > 1e-2));
    }

    #[test]
    fn degrees_nest() {
        let d = Vec3::new(0.6, 0.0, -0.8);
        for degree in 0..6 {
            let y = basis_to_degree(d, degree);
            assert_eq!(y.len(), coefficients_to_degree(degree));
            assert_eq!(y, basis(d)[..y.len()]);
        }
        assert_eq!(coefficients_to_degree(MAX_DEGREE), COEFFICIENTS);
    }
}
