//! Proptest strategies for what shaders and cameras eat: finite numbers, directions, rotations, colours, extremes.
//!
//! They return plain arrays, so that every crate can turn them into its own types. Ranges are half-open where `f32`
//! ranges are (`low..high`); every value is finite.
//!
//! ```
//! use diamond_testkit::strategies::{colour, unit_vector};
//! use proptest::prelude::*;
//! proptest!(|(direction in unit_vector(), rgb in colour())| {
//!     let length: f32 = direction.iter().map(|v| v * v).sum::<f32>().sqrt();
//!     prop_assert!((length - 1.0).abs() < 1e-6);
//!     prop_assert!(rgb.iter().all(|v| (0.0..=1.0).contains(v)));
//! });
//! ```
use proptest::collection::vec;
use proptest::prelude::*;
use std::ops::Range;

/// A finite number in `range`, uniformly; an empty range gives its start.
pub fn finite(range: Range<f32>) -> impl Strategy<Value = f32> + Clone {
    let span = f64::from(range.end) - f64::from(range.start);
    (0.0f64..1.0).prop_map(move |u| {
        let v = (f64::from(range.start) + u * span.max(0.0)) as f32;
        v.min(range.end.max(range.start))
    })
}

/// Three independent numbers in `range`: a point or an unconstrained vector.
pub fn vector(range: Range<f32>) -> impl Strategy<Value = [f32; 3]> + Clone {
    [finite(range.clone()), finite(range.clone()), finite(range)]
}

/// `len` independent numbers in `range`.
pub fn values(len: usize, range: Range<f32>) -> impl Strategy<Value = Vec<f32>> + Clone {
    vec(finite(range), len)
}

/// A unit vector, uniform on the sphere; the six axis directions are as likely together as one in eight draws.
pub fn unit_vector() -> impl Strategy<Value = [f32; 3]> + Clone {
    let anywhere = (-1.0f64..=1.0, 0.0f64..std::f64::consts::TAU).prop_map(|(z, phi)| {
        let r = (1.0 - z * z).max(0.0).sqrt();
        [(r * phi.cos()) as f32, (r * phi.sin()) as f32, z as f32]
    });
    let axis = (0usize..3, prop::bool::ANY).prop_map(|(i, negative)| {
        let mut v = [0.0f32; 3];
        v[i] = if negative { -1.0 } else { 1.0 };
        v
    });
    prop_oneof![7 => anywhere, 1 => axis]
}

/// A unit vector in the upper hemisphere whose z is at least `min_z` (in `[0, 1)`), uniform in solid angle.
pub fn upper_direction(min_z: f32) -> impl Strategy<Value = [f32; 3]> + Clone {
    (f64::from(min_z)..1.0, 0.0f64..std::f64::consts::TAU).prop_map(|(z, phi)| {
        let r = (1.0 - z * z).max(0.0).sqrt();
        [(r * phi.cos()) as f32, (r * phi.sin()) as f32, z as f32]
    })
}

/// A unit quaternion w, x, y, z, uniform over the rotations (Shoemake's three uniform numbers).
pub fn rotation_wxyz() -> impl Strategy<Value = [f32; 4]> + Clone {
    use std::f64::consts::TAU;
    (0.0f64..1.0, 0.0f64..TAU, 0.0f64..TAU).prop_map(|(u, a, b)| {
        let (p, q) = ((1.0 - u).sqrt(), u.sqrt());
        [(q * b.cos()) as f32, (p * a.sin()) as f32, (p * a.cos()) as f32, (q * b.sin()) as f32]
    })
}

/// The row-major rotation matrix of a unit quaternion w, x, y, z.
pub fn rotation_matrix(wxyz: [f32; 4]) -> [[f64; 3]; 3] {
    let [w, x, y, z] = wxyz.map(f64::from);
    let n = w * w + x * x + y * y + z * z;
    let s = if n > 0.0 { 2.0 / n } else { 0.0 };
    [
        [1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)],
    ]
}

/// Linear RGB in `[0, 1]`, with pure black, white and single primaries in one of eight draws.
pub fn colour() -> impl Strategy<Value = [f32; 3]> + Clone {
    let anywhere = [finite(0.0..1.0), finite(0.0..1.0), finite(0.0..1.0)];
    let corner = (0u8..8).prop_map(|bits| [0, 1, 2].map(|i| f32::from((bits >> i) & 1)));
    prop_oneof![7 => anywhere, 1 => corner]
}

/// Any finite number: zeros of both signs, subnormals, the largest values, and everything between on a log scale.
/// For "finite in, finite out" laws.
pub fn extreme() -> impl Strategy<Value = f32> + Clone {
    let special = prop::sample::select(vec![
        0.0,
        -0.0,
        1.0,
        -1.0,
        f32::MIN_POSITIVE,
        -f32::MIN_POSITIVE,
        f32::from_bits(1),
        -f32::from_bits(1),
        f32::EPSILON,
        f32::MAX,
        f32::MIN,
        1e-30,
        1e19,
        -1e19,
        1e30,
    ]);
    let log = (-38.0f64..38.0, prop::bool::ANY).prop_map(|(e, negative)| {
        let v = 10f64.powf(e) as f32;
        if negative { -v } else { v }
    });
    prop_oneof![1 => special, 1 => log, 1 => -2.0f32..2.0]
}

#[cfg(test)]
mod tests {
    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        #[test]
        fn everything_is_finite_and_in_range(
            v in finite(-2.0..3.0), same in finite(4.0..4.0), p in vector(-1.0..1.0), many in values(7, 0.0..2.0),
            rgb in colour(), e in extreme(), up in upper_direction(0.2),
        ) {
            prop_assert!((-2.0..=3.0).contains(&v));
            prop_assert_eq!(same, 4.0);
            prop_assert!(p.iter().all(|v| v.abs() <= 1.0));
            prop_assert!(many.len() == 7 && many.iter().all(|v| (0.0..=2.0).contains(v)));
            prop_assert!(rgb.iter().all(|v| (0.0..=1.0).contains(v)));
            prop_assert!(e.is_finite());
            prop_assert!(up[2] >= 0.2);
        }

        #[test]
        fn directions_and_rotations_have_unit_length(d in unit_vector(), q in rotation_wxyz()) {
            let square = |v: &[f32]| v.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>();
            prop_assert!((square(&d) - 1.0).abs() < 1e-6);
            prop_assert!((square(&q) - 1.0).abs() < 1e-6);
        }

        #[test]
        fn rotation_matrices_are_orthonormal_and_right_handed(q in rotation_wxyz()) {
            let r = rotation_matrix(q);
            for i in 0..3 {
                for j in 0..3 {
                    let dot: f64 = (0..3).map(|k| r[i][k] * r[j][k]).sum();
                    let identity = f64::from(u8::from(i == j));
                    prop_assert!((dot - identity).abs() < 1e-9);
                }
            }
            let det = r[0][0] * (r[1][1] * r[2][2] - r[1][2] * r[2][1])
                - r[0][1] * (r[1][0] * r[2][2] - r[1][2] * r[2][0])
                + r[0][2] * (r[1][0] * r[2][1] - r[1][1] * r[2][0]);
            prop_assert!((det - 1.0).abs() < 1e-9);
        }
    }

    #[test]
    fn a_quarter_turn_about_z_takes_x_to_y() {
        let h = std::f32::consts::FRAC_1_SQRT_2;
        let r = rotation_matrix([h, 0.0, 0.0, h]);
        assert!((r[1][0] - 1.0).abs() < 1e-6 && r[0][0].abs() < 1e-6, "{r:?}");
    }
}
