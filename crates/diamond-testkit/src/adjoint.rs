//! The adjoint identity ⟨ū, J·ẋ⟩ = ⟨Jᵀ·ū, ẋ⟩, and relative errors.
//!
//! Compare what these functions return with `<=`: a NaN on either side then fails the test. One random pair (ū, ẋ) sees
//! only one number of the Jacobian's many, and an error in an entry that matters little to that number hides behind the
//! others: draw several pairs, and draw some that are zero but for one element.
//!
//! ```
//! use diamond_testkit::{adjoint::adjoint_gap, jvp};
//! // y = (x₀·x₁, sin x₀) and its hand-written pullback.
//! let (x, tangent, cotangent) = ([0.3, -1.2], [1.0, 0.5], [0.7, -0.4]);
//! let forward = jvp(|x| vec![x[0] * x[1], diamond_testkit::Real::sin(x[0])], &x, &tangent);
//! let vjp = [cotangent[0] * x[1] + cotangent[1] * x[0].cos(), cotangent[0] * x[0]];
//! assert!(adjoint_gap(&cotangent, &forward, &vjp, &tangent) <= 1e-12);
//! ```

/// ⟨a, b⟩ in f64.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len(), "dot of vectors of different length");
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

/// Relative L2 error ‖a − b‖ / max(‖b‖, floor).
pub fn relative_l2(a: &[f64], b: &[f64], floor: f64) -> f64 {
    assert_eq!(a.len(), b.len(), "relative_l2 of vectors of different length");
    let diff: f64 = a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum();
    let norm: f64 = b.iter().map(|y| y * y).sum();
    diff.sqrt() / norm.sqrt().max(floor)
}

/// The relative gap between ⟨ū, J·ẋ⟩ (`jvp` = J·ẋ from an oracle) and ⟨Jᵀ·ū, ẋ⟩ (`vjp` = Jᵀ·ū from the code under
/// test), measured against the sum of the magnitudes of the products, so that cancellation does not count as error.
pub fn adjoint_gap(cotangent: &[f64], jvp: &[f64], vjp: &[f64], tangent: &[f64]) -> f64 {
    let left = dot(cotangent, jvp);
    let right = dot(vjp, tangent);
    let magnitude: f64 = cotangent.iter().zip(jvp).map(|(a, b)| (a * b).abs()).sum::<f64>()
        + vjp.iter().zip(tangent).map(|(a, b)| (a * b).abs()).sum::<f64>();
    (left - right).abs() / magnitude.max(1e-300)
}

/// |actual − expected| / max(|expected|, floor): the relative error of one number, NaN where either is NaN.
pub fn relative_error(actual: f64, expected: f64, floor: f64) -> f64 {
    (actual - expected).abs() / expected.abs().max(floor)
}

/// The largest of `errors`, infinite if one of them is NaN (`f64::max` would drop it), 0 where there are none.
pub fn worst(errors: impl IntoIterator<Item = f64>) -> f64 {
    errors.into_iter().fold(0.0, |worst, e| if e.is_nan() { f64::INFINITY } else { worst.max(e) })
}

/// The largest relative error over all elements, each against max(|expected|, floor); infinite if a value is NaN.
pub fn worst_relative(actual: &[f64], expected: &[f64], floor: f64) -> f64 {
    assert_eq!(actual.len(), expected.len(), "worst_relative of vectors of different length");
    worst(actual.iter().zip(expected).map(|(&a, &e)| relative_error(a, e, floor)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Dual, Real, jvp};
    use proptest::prelude::*;

    /// A map with every kind of coupling: R³ → R².
    fn forward(x: &[Dual]) -> Vec<Dual> {
        vec![x[0] * x[1] + x[2].exp(), (x[0] * x[2]).sin() - x[1] * x[1]]
    }

    /// Its pullback by hand; `planted` breaks it.
    fn pull(x: &[f64], d: &[f64], planted: Option<usize>) -> Vec<f64> {
        let c = (x[0] * x[2]).cos();
        let mut g =
            vec![d[0] * x[1] + d[1] * c * x[2], d[0] * x[0] - 2.0 * d[1] * x[1], d[0] * x[2].exp() + d[1] * c * x[0]];
        match planted {
            Some(0) => g[0] = -g[0],            // a sign
            Some(1) => g[1] += d[1] * x[1],     // a lost factor 2
            Some(2) => g[2] -= d[1] * c * x[0], // a forgotten term
            Some(3) => g.swap(0, 2),            // two inputs exchanged
            Some(4) => g[1] *= 1.001,           // one part in a thousand
            Some(5) => g[2] = f64::NAN,
            _ => {}
        }
        g
    }

    fn gap(x: &[f64], tangent: &[f64], cotangent: &[f64], planted: Option<usize>) -> f64 {
        adjoint_gap(cotangent, &jvp(forward, x, tangent), &pull(x, cotangent, planted), tangent)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]

        #[test]
        fn the_identity_holds(x in [-1.5f64..1.5, -1.5f64..1.5, -1.5f64..1.5],
                              t in [-1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0], u in [-1.0f64..1.0, -1.0f64..1.0]) {
            prop_assert!(gap(&x, &t, &u, None) <= 1e-12);
        }
    }

    /// The harness's own test: each planted error is noticed at 1e-4 by at least one of a few pairs.
    #[test]
    fn planted_errors_are_noticed() {
        let x = [0.7, -1.1, 0.4];
        let pairs = [([1.0, 0.0, 0.0], [0.6, -0.8]), ([0.0, 1.0, 0.0], [0.6, -0.8]), ([0.0, 0.0, 1.0], [0.6, -0.8])];
        assert!(pairs.iter().all(|(t, u)| gap(&x, t, u, None) <= 1e-12));
        for planted in 0..=5 {
            let noticed = pairs.iter().any(|(t, u)| {
                let gap = gap(&x, t, u, Some(planted));
                gap.is_nan() || gap > 1e-4
            });
            assert!(noticed, "planted error {planted} went unnoticed");
        }
    }

    #[test]
    fn errors_are_relative_and_nan_is_the_worst() {
        assert_eq!(relative_error(1.1, 1.0, 1e-3), 1.1 - 1.0);
        assert_eq!(relative_error(1e-4, 0.0, 1e-3), 0.1);
        assert_eq!(worst([0.5, f64::NAN, 0.1]), f64::INFINITY);
        assert_eq!(worst([]), 0.0);
        assert_eq!(worst_relative(&[1.0, 2.5], &[1.0, 2.0], 1.0), 0.25);
        assert_eq!(relative_l2(&[3.0, 4.0], &[0.0, 0.0], 1.0), 5.0);
        assert!(worst_relative(&[f64::NAN], &[1.0], 1.0) > 1e-4);
    }
}
