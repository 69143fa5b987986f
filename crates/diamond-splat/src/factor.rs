//! The second form of a covariance: a lower triangular factor `L` with `Σ = L Lᵀ`, six numbers, no redundancy.
//!
//! Whoever splats needs any `M` with `Σ = M Mᵀ`, so the factor itself serves there as `R·diag(s)` does. Everybody else
//! (rays, density control, files) asks for axes and standard deviations: the singular value decomposition of `L`, taken
//! by Jacobi rotations of its columns. That never squares `L`, so the thinnest axis keeps its digits, and equal
//! axes are no special case: no gradient is taken through it.
use crate::density::unit_rotation;
use crate::footprint::finite_f32;
use glam::{DMat3, DQuat, DVec3, Quat, Vec3};

/// Lower factor of a covariance, row by row: `xx, yx, yy, zx, zy, zz`, scene units, world axes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LowerFactor(pub [f32; 6]);

/// Sweeps over the three pairs of columns. Convergence is quadratic: five suffice for f64, the rest is reserve.
const SWEEPS: usize = 12;
/// Columns whose cosine is below this count as orthogonal: f32 results need no more.
const ORTHOGONAL: f64 = 1e-12;
/// A column shorter than this fraction of the longest has no direction of its own.
const NO_DIRECTION: f64 = 1e-14;

impl LowerFactor {
    /// As a matrix, rows.
    pub(crate) fn matrix(&self) -> [[f64; 3]; 3] {
        let [xx, yx, yy, zx, zy, zz] = self.0.map(f64::from);
        [[xx, 0.0, 0.0], [yx, yy, 0.0], [zx, zy, zz]]
    }

    /// Pullback of [`LowerFactor::matrix`]: what lies above the diagonal is constant.
    pub(crate) fn matrix_pull(d: [[f64; 3]; 3]) -> Self {
        Self([d[0][0], d[1][0], d[1][1], d[2][0], d[2][1], d[2][2]].map(finite_f32))
    }

    /// Standard deviations along the axes of the ellipsoid, and the rotation from those axes to the world.
    ///
    /// `[eq:factor-decomposition]` `L V = R diag(s)` with V a product of plane rotations that make the columns of L
    /// orthogonal. Axes are not sorted: a diagonal factor keeps its own. Factors that are not finite give zeros.
    pub fn scale_rotation(&self) -> (Vec3, Quat) {
        if self.0.iter().any(|v| !v.is_finite()) {
            return (Vec3::ZERO, Quat::IDENTITY);
        }
        let m = self.matrix();
        let mut c: [DVec3; 3] = std::array::from_fn(|j| DVec3::new(m[0][j], m[1][j], m[2][j]));
        for _ in 0..SWEEPS {
            let mut worst = 0.0f64;
            for (i, j) in [(0, 1), (0, 2), (1, 2)] {
                let (a, b, dot) = (c[i].length_squared(), c[j].length_squared(), c[i].dot(c[j]));
                let cosine = dot.abs() / (a * b).sqrt();
                if cosine.is_nan() || cosine <= ORTHOGONAL {
                    continue;
                }
                worst = worst.max(cosine);
                // The smaller root of t² + 2ζt − 1 = 0, so that axes turn as little as possible.
                let zeta = (b - a) / (2.0 * dot);
                let t = zeta.signum() / (zeta.abs() + (1.0 + zeta * zeta).sqrt());
                let cos = 1.0 / (1.0 + t * t).sqrt();
                (c[i], c[j]) = (cos * (c[i] - t * c[j]), cos * (c[j] + t * c[i]));
            }
            if worst <= ORTHOGONAL {
                break;
            }
        }
        let lengths = c.map(DVec3::length);
        let scale = Vec3::from_array(lengths.map(finite_f32));
        (scale, rotation_of(c, lengths))
    }

    /// The factor of a Gaussian with these standard deviations and this rotation (need not be normalised).
    ///
    /// `[eq:lower-factor]` `R diag(s) = L Q`: rows are orthogonalised from the first to the last, in f64, without forming
    /// Σ. The diagonal is not negative.
    pub fn from_scale_rotation(scale: Vec3, rotation: Quat) -> Self {
        let m =
            DMat3::from_quat(unit_rotation(rotation).as_dquat().normalize()) * DMat3::from_diagonal(scale.as_dvec3());
        let [r0, r1, r2] = [m.row(0), m.row(1), m.row(2)];
        let unit = |v: DVec3| v.try_normalize().unwrap_or(DVec3::ZERO);
        let q0 = unit(r0);
        let yx = r1.dot(q0);
        let rest = r1 - yx * q0;
        let q1 = unit(rest);
        let (zx, zy) = (r2.dot(q0), r2.dot(q1));
        let last = (r2 - zx * q0) - zy * q1;
        // A second pass removes what cancellation left.
        let last = last - q0 * last.dot(q0) - q1 * last.dot(q1);
        Self([r0.length(), yx, rest.length(), zx, zy, last.length()].map(finite_f32))
    }
}

/// The right-handed frame along orthogonal columns; those without a direction are completed.
fn rotation_of(columns: [DVec3; 3], lengths: [f64; 3]) -> Quat {
    let longest = lengths.iter().fold(0.0f64, |m, l| m.max(*l));
    let has = |j: usize| lengths[j] > NO_DIRECTION * longest && lengths[j] > 0.0;
    let mut axes = [DVec3::ZERO; 3];
    (0..3).filter(|&j| has(j)).for_each(|j| axes[j] = columns[j] / lengths[j]);
    let missing: Vec<usize> = (0..3).filter(|&j| !has(j)).collect();
    match missing[..] {
        [] if axes[0].cross(axes[1]).dot(axes[2]) < 0.0 => axes[2] = -axes[2],
        [] => {}
        [k] => axes[k] = axes[(k + 1) % 3].cross(axes[(k + 2) % 3]),
        [_, _] => {
            let k = (0..3).find(|&j| has(j)).unwrap_or(0);
            axes[(k + 1) % 3] = axes[k].any_orthonormal_vector();
            axes[(k + 2) % 3] = axes[k].cross(axes[(k + 1) % 3]);
        }
        _ => return Quat::IDENTITY,
    }
    DQuat::from_mat3(&DMat3::from_cols(axes[0], axes[1], axes[2])).normalize().as_quat()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn covariance(scale: Vec3, rotation: Quat) -> DMat3 {
        let m = DMat3::from_quat(rotation.as_dquat().normalize()) * DMat3::from_diagonal(scale.as_dvec3());
        m * m.transpose()
    }

    fn product(factor: &LowerFactor) -> DMat3 {
        let l = DMat3::from_cols_array_2d(&factor.matrix()).transpose();
        l * l.transpose()
    }

    fn distance(a: DMat3, b: DMat3) -> f64 {
        let (a, b) = (a.to_cols_array(), b.to_cols_array());
        a.iter().zip(&b).map(|(x, y)| (x - y).abs()).fold(0.0, f64::max)
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]

        /// [eq:lower-factor], [eq:factor-decomposition]: both forms are the same covariance, there and back, down to
        /// axes 1e4 times thinner than others.
        #[test]
        fn both_forms_are_the_same_covariance(
            log_scale in [-9.0f32..0.0, -9.0f32..0.0, -9.0f32..0.0],
            q in [-1.0f32..1.0, -1.0f32..1.0, -1.0f32..1.0, -1.0f32..1.0],
        ) {
            prop_assume!(q.iter().map(|v| v * v).sum::<f32>() > 0.01);
            let (scale, rotation) = (Vec3::from_array(log_scale).exp(), Quat::from_array(q));
            let expected = covariance(scale, rotation);
            let largest = f64::from(scale.max_element()).powi(2);
            let factor = LowerFactor::from_scale_rotation(scale, rotation);
            prop_assert!(distance(product(&factor), expected) < 1e-6 * largest);
            let (s, r) = factor.scale_rotation();
            prop_assert!(distance(covariance(s, r), expected) < 2e-6 * largest);
            prop_assert!((r.length() - 1.0).abs() < 1e-5);
            // The thinnest axis too, as far as the factor's own f32 digits carry it.
            let error = (s.min_element() - scale.min_element()).abs();
            prop_assert!(error < 1e-6 * scale.max_element() + 1e-4 * scale.min_element(), "{error:e}");
            let mut sorted = [s.to_array(), scale.to_array()];
            sorted.iter_mut().for_each(|v| v.sort_by(f32::total_cmp));
            prop_assert!((sorted[0][1] - sorted[1][1]).abs() < 1e-5 * scale.max_element());
        }
    }

    #[test]
    fn degenerate_factors_have_a_decomposition() {
        for values in [
            [0.0; 6],
            [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, 1.0, 1.0, 0.0],
            [1.0, 1.0, 0.0, 1.0, 0.0, 0.0],
            [1e-30, 0.0, 1e-30, 0.0, 0.0, 1e-30],
            [1e18, -1e18, 1e18, 1e18, 1e18, 1e18],
            [f32::NAN, 0.0, 0.0, 0.0, 0.0, 0.0],
            [-1.0, 0.5, -2.0, 0.1, 0.2, 3.0],
        ] {
            let factor = LowerFactor(values);
            let (scale, rotation) = factor.scale_rotation();
            assert!(scale.is_finite() && scale.min_element() >= 0.0, "{values:?}: {scale}");
            assert!((rotation.length() - 1.0).abs() < 1e-5, "{values:?}: {rotation}");
            if values.iter().all(|v| v.is_finite()) {
                let size = f64::from(scale.max_element()).powi(2);
                assert!(distance(covariance(scale, rotation), product(&factor)) <= 1e-5 * size, "{values:?}");
            }
        }
        let (scale, rotation) = LowerFactor([1.0, 0.0, 2.0, 0.0, 0.0, 3.0]).scale_rotation();
        assert_eq!((scale, rotation), (Vec3::new(1.0, 2.0, 3.0), Quat::IDENTITY), "axes are not sorted");
    }
}
