//! Visibility as a function of direction: sixteen spherical-harmonic coefficients per point, trained against traced rays so
//! that shadows can be drawn without tracing.
//!
//! V(l) = clamp(½ + Σₖ cₖ·Yₖ(l), 0, 1): all coefficients zero is half visible from everywhere. Where the sum leaves
//! `[0, 1]` there is no gradient; other directions of the same point bring it back.
//!
//! ```
//! use diamond_shading::sh_visibility::{COEFFICIENTS, visibility};
//! use glam::Vec3;
//! let mut c = [0.0; COEFFICIENTS];
//! c[2] = 0.5; // Y(1,0) ∝ z: open above, shadowed below
//! assert!(visibility(&c, Vec3::Z) > 0.7 && visibility(&c, Vec3::NEG_Z) < 0.3);
//! ```
use crate::ShadingError;
use crate::error::check_length;
use crate::row_chunks::map_chunks_mut;
use diamond_light::spherical_harmonics::{basis, basis_pull};
use glam::Vec3;

pub use diamond_light::spherical_harmonics::COEFFICIENTS;

/// Visibility of a point whose coefficients are all zero.
const OFFSET: f32 = 0.5;

/// Points per chunk of a batch; fixed, so that the bits do not depend on the number of threads.
const CHUNK: usize = 1024;

/// Gradient of a scalar with respect to the arguments of [`visibilities`].
#[derive(Debug, Clone, PartialEq, Default)]
pub struct VisibilityGrad {
    /// With respect to the coefficients, 16 per point.
    pub coefficients: Vec<f32>,
    /// With respect to the directions, one per point, as free vectors (see
    /// [`basis_pull`]).
    pub directions: Vec<Vec3>,
}

/// The sum before the clamp.
#[inline]
fn raw(coefficients: &[f32; COEFFICIENTS], basis: &[f32; COEFFICIENTS]) -> f32 {
    coefficients.iter().zip(basis).fold(OFFSET, |sum, (c, y)| sum + c * y)
}

/// Visibility in `[0, 1]` of the unit direction `light` (from the point to the light, world axes).
/// `[eq:sh-visibility]`
#[inline]
pub fn visibility(coefficients: &[f32; COEFFICIENTS], light: Vec3) -> f32 {
    raw(coefficients, &basis(light)).clamp(0.0, 1.0)
}

/// Pullback of [`visibility`]: `(d_coefficients, d_light)`, zero where the sum is outside `[0, 1]`.
/// `[eq:sh-visibility]`
#[inline]
pub fn visibility_pull(coefficients: &[f32; COEFFICIENTS], light: Vec3, d_out: f32) -> ([f32; COEFFICIENTS], Vec3) {
    let y = basis(light);
    if !(0.0..=1.0).contains(&raw(coefficients, &y)) {
        return ([0.0; COEFFICIENTS], Vec3::ZERO);
    }
    (y.map(|y| d_out * y), basis_pull(light, &coefficients.map(|c| d_out * c)))
}

/// [`visibility`] of many points: `coefficients` holds 16 per point, `lights` one unit direction per point.
///
/// # Errors
/// [`ShadingError::Shape`] unless `coefficients` is 16 times as long as `lights`.
/// `[eq:sh-visibility]`
pub fn visibilities(coefficients: &[f32], lights: &[Vec3]) -> Result<Vec<f32>, ShadingError> {
    check_length("visibilities: coefficients (16 per direction)", lights.len() * COEFFICIENTS, coefficients.len())?;
    let (points, _) = coefficients.as_chunks::<COEFFICIENTS>();
    let mut out = vec![0.0; lights.len()];
    map_chunks_mut(&mut out, CHUNK, |chunk, out| {
        for (k, out) in out.iter_mut().enumerate() {
            let i = chunk * CHUNK + k;
            *out = visibility(&points[i], lights[i]);
        }
    });
    Ok(out)
}

/// Pullback of [`visibilities`] for the cotangents `d_out`, one per point.
///
/// # Errors
/// [`ShadingError::Shape`] where lengths disagree.
/// `[eq:sh-visibility]`
pub fn visibilities_pull(coefficients: &[f32], lights: &[Vec3], d_out: &[f32]) -> Result<VisibilityGrad, ShadingError> {
    check_length(
        "visibilities_pull: coefficients (16 per direction)",
        lights.len() * COEFFICIENTS,
        coefficients.len(),
    )?;
    check_length("visibilities_pull: d_out (one per direction)", lights.len(), d_out.len())?;
    let (points, _) = coefficients.as_chunks::<COEFFICIENTS>();
    let mut d_coefficients = vec![0.0; coefficients.len()];
    let directions = map_chunks_mut(&mut d_coefficients, CHUNK * COEFFICIENTS, |chunk, out| {
        let mut directions = Vec::with_capacity(CHUNK);
        for (k, out) in out.as_chunks_mut::<COEFFICIENTS>().0.iter_mut().enumerate() {
            let i = chunk * CHUNK + k;
            let (d_c, d_l) = visibility_pull(&points[i], lights[i], d_out[i]);
            *out = d_c;
            directions.push(d_l);
        }
        directions
    });
    Ok(VisibilityGrad { coefficients: d_coefficients, directions: directions.concat() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::adjoint::{relative_error, relative_l2};
    use diamond_testkit::strategies::{finite, unit_vector, values};
    use diamond_testkit::{Dual, Real, gradient, light::sh_basis};
    use proptest::prelude::*;

    fn oracle<R: Real>(x: &[R]) -> R {
        let y = sh_basis([x[16], x[17], x[18]], 3);
        let mut sum = R::of(0.5);
        for k in 0..COEFFICIENTS {
            sum += x[k] * y[k];
        }
        sum.max(R::of(0.0)).min(R::of(1.0))
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]

        /// `[eq:sh-visibility]`: some draws are clamped on either side.
        #[test]
        fn values_and_gradient_agree_with_the_oracle(
            c in values(16, -0.4..0.4), l in unit_vector(), d in finite(-1.0..1.0),
        ) {
            let coefficients: [f32; 16] = c.clone().try_into().expect("16 values");
            let x: Vec<f64> = c.iter().chain(&l).map(|&v| f64::from(v)).collect();
            prop_assume!(oracle::<f64>(&x) == 0.0 || oracle::<f64>(&x) > 1e-5);
            let v = visibility(&coefficients, l.into());
            prop_assert!(relative_error(f64::from(v), oracle(&x), 1.0) <= 2e-6);
            let expected = gradient(|x| oracle(x) * Dual::of(f64::from(d)), &x);
            let (d_c, d_l) = visibility_pull(&coefficients, l.into(), d);
            let actual: Vec<f64> = d_c.iter().map(|&v| f64::from(v)).collect();
            prop_assert!(relative_l2(&actual, &expected[..16], 1e-2) <= 1e-5);
            // The part along the direction depends on the polynomial chosen: compare on the tangent plane.
            let u = Vec3::from(l);
            let tangent = |g: Vec3| (g - u * u.dot(g)).to_array().map(f64::from);
            let theirs = Vec3::new(expected[16] as f32, expected[17] as f32, expected[18] as f32);
            prop_assert!(relative_l2(&tangent(d_l), &tangent(theirs), 1e-1) <= 1e-5);
        }
    }

    /// `[eq:sh-visibility]`
    #[test]
    fn a_batch_is_its_points_and_its_shape_is_checked() {
        let n = 2 * CHUNK + 3;
        let lights: Vec<Vec3> = (0..n).map(|i| Vec3::new(i as f32, 1.0, -3.0).normalize()).collect();
        let c: Vec<f32> = (0..16 * n).map(|i| ((i * 7919) % 101) as f32 / 400.0 - 0.125).collect();
        let d: Vec<f32> = (0..n).map(|i| i as f32 * 1e-3 - 1.0).collect();
        let v = visibilities(&c, &lights).expect("shapes agree");
        let g = visibilities_pull(&c, &lights, &d).expect("shapes agree");
        for i in [0, 1, CHUNK - 1, CHUNK, 2 * CHUNK + 2] {
            let point: &[f32; 16] = c[16 * i..16 * i + 16].try_into().expect("16 values");
            let (d_c, d_l) = visibility_pull(point, lights[i], d[i]);
            assert_eq!(v[i], visibility(point, lights[i]));
            assert_eq!((&g.coefficients[16 * i..16 * i + 16], g.directions[i]), (d_c.as_slice(), d_l));
        }
        assert!(visibilities(&c[1..], &lights).is_err() && visibilities_pull(&c, &lights, &d[1..]).is_err());
        assert!(visibilities(&[], &[]).expect("nothing is a batch").is_empty());
    }
}
