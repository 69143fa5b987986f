//! A residual that is linear in the light: per Gaussian and colour channel, a transfer vector in spherical harmonics of
//! the light's direction.
//!
//! Light transport is linear, so what leaves a point is, for a distant light, a function of the light's direction times
//! its intensity. Storing that function as a few spherical-harmonic coefficients, residual_c = Σ_k t_ck·Y_k(l), makes it
//! smooth in the direction by construction, and the response to several lights the sum of the responses to each; a free
//! network has neither property. Degree 3 has 16 coefficients per channel and cannot follow sharp shadows, which belong to
//! the surface term's visibility.
//!
//! With [`TransferActivation::Linear`] the residual may be negative. [`TransferActivation::Softplus`] keeps it positive and
//! loses additivity over lights where the sum is below a few `1/sharpness`: softplus(a) + softplus(b) ≠ softplus(a + b).
//! It stays linear in the intensity as long as the intensity multiplies the result, not the coefficients.
use crate::error::{ShadingError, check_length};
use crate::number::Number;
use crate::row_chunks::map_chunks_mut;
use crate::simd::MAGNITUDE_LIMIT;
use crate::vector::Vector;
use diamond_light::spherical_harmonics::{COEFFICIENTS, MAX_DEGREE, basis, basis_pull};
use diamond_simd::{BLOCK, Lanes, Simd};
use glam::Vec3;

/// Rows per parallel task.
const ROWS: usize = 512;

/// What follows the sum over coefficients.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TransferActivation {
    /// Nothing: exactly linear, may be negative.
    Linear,
    /// ln(1 + e^(sharpness·x)) / sharpness: positive, and x up to ln 2 / sharpness.
    Softplus {
        /// In 1/radiance, (0, 1e6]: larger is closer to max(x, 0).
        sharpness: f32,
    },
}

/// Size and activation of a transfer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TransferConfig {
    /// Spherical-harmonic degree, 0 to 3.
    pub degree: usize,
    /// What follows the sum.
    pub activation: TransferActivation,
}

impl TransferConfig {
    /// Coefficients per channel: (degree + 1)².
    pub fn coefficients(&self) -> usize {
        (self.degree.min(MAX_DEGREE) + 1).pow(2)
    }

    /// `Ok` if the degree is at most 3 and a sharpness lies in (0, 1e6].
    pub fn check(&self) -> Result<(), ShadingError> {
        if self.degree > MAX_DEGREE {
            return Err(ShadingError::Setting {
                what: "TransferConfig::degree",
                expected: format!("0 to {MAX_DEGREE}"),
                found: format!("{}", self.degree),
            });
        }
        if let TransferActivation::Softplus { sharpness } = self.activation
            && !(sharpness > 0.0 && sharpness <= 1e6)
        {
            return Err(ShadingError::Setting {
                what: "TransferActivation::Softplus::sharpness",
                expected: "a value in (0, 1e6]".into(),
                found: format!("{sharpness}"),
            });
        }
        Ok(())
    }

    fn activate(&self, x: f32) -> f32 {
        match self.activation {
            TransferActivation::Linear => x,
            TransferActivation::Softplus { sharpness } => {
                x.max(0.0) + libm::log1pf(libm::expf(-sharpness * x.abs())) / sharpness
            }
        }
    }

    /// [`TransferConfig::activate`] in every lane.
    #[inline(always)]
    pub(crate) fn activate_lanes<S: Simd>(&self, x: Lanes<S>) -> Lanes<S> {
        if self.activation == TransferActivation::Linear {
            return x;
        }
        let mut lanes = [0.0; BLOCK];
        x.store(&mut lanes);
        for v in &mut lanes[..S::F32_LANES] {
            *v = self.activate(*v);
        }
        Lanes::load(x.s, &lanes)
    }

    fn slope(&self, x: f32) -> f32 {
        match self.activation {
            TransferActivation::Linear => 1.0,
            TransferActivation::Softplus { sharpness } => 1.0 / (1.0 + libm::expf(-sharpness * x)),
        }
    }
}

/// [`basis`] over a [`Number`]; a test holds both to the same values.
/// `[eq:sh-basis]`
#[inline(always)]
pub(crate) fn basis_at<T: Number>(d: Vector<T>) -> [T; COEFFICIENTS] {
    // √(1/4π), √(3/4π), √(15/4π), √(5/16π), √(15/16π), √(35/32π), √(105/4π), √(21/32π), √(7/16π)
    const K: [f32; 9] = [
        0.282_094_79,
        0.488_602_51,
        1.092_548_4,
        0.315_391_57,
        0.546_274_2,
        0.590_043_6,
        2.890_611_4,
        0.457_045_8,
        0.373_176_34,
    ];
    let Vector { x, y, z } = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        x.same(K[0]),
        y * -K[1],
        z * K[1],
        x * -K[1],
        x * y * K[2],
        y * z * -K[2],
        (zz * 3.0 - 1.0) * K[3],
        x * z * -K[2],
        (xx - yy) * K[4],
        y * (xx * 3.0 - yy) * -K[5],
        x * y * z * K[6],
        y * (zz * 5.0 - 1.0) * -K[7],
        z * (zz * 5.0 - 3.0) * K[8],
        x * (zz * 5.0 - 1.0) * -K[7],
        z * (xx - yy) * (0.5 * K[6]),
        x * (xx - yy * 3.0) * -K[5],
    ]
}

/// The gradient of a transfer.
#[derive(Debug, Clone, PartialEq)]
pub struct TransferGrad {
    /// `[rows × 3 × coefficients]`.
    pub transfer: Vec<f32>,
    /// Per row, if asked for; of the direction as a free vector (pull it through its normalisation).
    pub light_directions: Option<Vec<Vec3>>,
}

/// The reverse of one [`transfer_radiance`].
#[derive(Debug)]
pub struct TransferPullback<'a> {
    transfer: &'a [f32],
    light_directions: &'a [Vec3],
    config: TransferConfig,
}

fn saturate(value: f32) -> f32 {
    value.clamp(-MAGNITUDE_LIMIT, MAGNITUDE_LIMIT)
}

/// Directions have unit length; whatever has not is brought into the cube that holds them, so that sums stay finite.
fn basis_of(direction: Vec3) -> [f32; COEFFICIENTS] {
    basis(direction.clamp(Vec3::NEG_ONE, Vec3::ONE))
}

/// Σ_k t_k·Y_k in four interleaved partial sums.
fn dot(t: &[f32], y: &[f32]) -> f32 {
    let ((t4, t1), (y4, y1)) = (t.as_chunks::<4>(), y.as_chunks::<4>());
    let mut sums = [0.0f32; 4];
    for (t, y) in t4.iter().zip(y4) {
        for lane in 0..4 {
            sums[lane] += saturate(t[lane]) * y[lane];
        }
    }
    let rest: f32 = t1.iter().zip(y1).map(|(&t, y)| saturate(t) * y).sum();
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + rest
}

/// The residual radiance per unit of light `[rows × 3]`: σ(Σ_k t\[i, c, k\]·Y_k(l_i)).
///
/// `transfer` is `[rows × 3 × coefficients]` with k = l² + l + m, `light_directions` one unit vector per row. Coefficients
/// saturate at ±1e12. Errors: [`ShadingError::Shape`] if the lengths disagree, [`ShadingError::Setting`] as in
/// [`TransferConfig::check`].
/// `[eq:light-transfer]`
pub fn transfer_radiance<'a>(
    transfer: &'a [f32],
    light_directions: &'a [Vec3],
    config: TransferConfig,
) -> Result<(Vec<f32>, TransferPullback<'a>), ShadingError> {
    config.check()?;
    let (rows, size) = (light_directions.len(), config.coefficients());
    check_length("transfer (rows × 3 × coefficients)", rows.saturating_mul(3 * size), transfer.len())?;
    let mut radiance = vec![0.0; 3 * rows];
    map_chunks_mut(&mut radiance, 3 * ROWS, |chunk, radiance| {
        for (offset, radiance) in radiance.chunks_exact_mut(3).enumerate() {
            let i = chunk * ROWS + offset;
            let y = basis_of(light_directions[i]);
            for (radiance, t) in radiance.iter_mut().zip(transfer[i * 3 * size..].chunks_exact(size)) {
                *radiance = config.activate(dot(t, &y[..size]));
            }
        }
    });
    Ok((radiance, TransferPullback { transfer, light_directions, config }))
}

impl TransferPullback<'_> {
    /// Pulls `d_radiance` `[rows × 3]` (saturating at ±1e12) back to the coefficients and, if `direction_gradient`, to
    /// the light directions.
    ///
    /// Errors: [`ShadingError::Shape`] if `d_radiance` has the wrong length.
    /// `[eq:light-transfer]`
    pub fn pull(&self, d_radiance: &[f32], direction_gradient: bool) -> Result<TransferGrad, ShadingError> {
        let (rows, size) = (self.light_directions.len(), self.config.coefficients());
        check_length("d_radiance of TransferPullback::pull (rows × 3)", 3 * rows, d_radiance.len())?;
        let mut transfer = vec![0.0; self.transfer.len()];
        let directions = map_chunks_mut(&mut transfer, ROWS * 3 * size, |chunk, d_transfer| {
            let mut directions = Vec::new();
            for (offset, d_row) in d_transfer.chunks_exact_mut(3 * size).enumerate() {
                let i = chunk * ROWS + offset;
                let y = basis_of(self.light_directions[i]);
                let mut d_y = [0.0; COEFFICIENTS];
                for (c, d_t) in d_row.chunks_exact_mut(size).enumerate() {
                    let t = &self.transfer[(i * 3 + c) * size..][..size];
                    let mut d = saturate(d_radiance[i * 3 + c]);
                    if self.config.activation != TransferActivation::Linear {
                        d *= self.config.slope(dot(t, &y[..size]));
                    }
                    for (d_t, &y) in d_t.iter_mut().zip(&y) {
                        *d_t = d * y;
                    }
                    if direction_gradient {
                        for (d_y, &t) in d_y.iter_mut().zip(t) {
                            *d_y += d * saturate(t);
                        }
                    }
                }
                if direction_gradient {
                    directions.push(basis_pull(self.light_directions[i].clamp(Vec3::NEG_ONE, Vec3::ONE), &d_y));
                }
            }
            directions
        });
        Ok(TransferGrad { transfer, light_directions: direction_gradient.then(|| directions.concat()) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// [eq:sh-basis] What the harmonics of `diamond-light` are, on and off the unit sphere.
    #[test]
    fn vectors_have_the_same_basis() {
        for i in 0..200 {
            let t = i as f32;
            let d = Vec3::new((1.3 * t).sin(), (2.1 * t + 0.4).sin(), (0.7 * t + 1.0).sin());
            for (a, b) in basis(d).iter().zip(basis_at(Vector::from(d))) {
                assert!((a - b).abs() <= 1e-6, "{d}: {a} {b}");
            }
        }
    }
}
