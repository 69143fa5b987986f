//! What light that has entered in one direction counts for a walk that arrives in another.
//!
//! In place of the Dirac function, which no walk meets, stands a Fisher distribution around the light's direction times a linear function.
//! The linear function is such that over the hemisphere (but its rim) constants and linear functions of the direction are integrated as the
//! Dirac function would, whatever the angle to the normal. What is left is an error of curvature.
use glam::{DMat3, DVec3};
use std::f64::consts::TAU;

/// Concentration: at this value the kernel's noise is that of a lobe of some 15°.
const CONCENTRATION: f64 = 8.0;

/// Walks that arrive at smaller cosines are not asked; behind a boundary light comes from a cone of larger ones.
pub(crate) const MIN_INNER_COSINE: f32 = 0.1;

/// Intervals of the cosine between normal and light in the table.
const STEPS: usize = 32;

/// Steps of the quadrature over cosine and angle around the normal.
const QUADRATURE: usize = 96;

/// Relative to the diagonal: keeps the equations solvable where normal and light coincide and one of them says 0 = 0.
const RIDGE: f64 = 1e-9;

/// Coefficients a, b, c of e^(κ(x − 1))·(a + b·x + c·z): x the cosine between light and walk, z that between normal and walk.
#[derive(Debug)]
pub(crate) struct EnteringKernel {
    table: Vec<[f32; 3]>,
}

impl EnteringKernel {
    pub fn new() -> Self {
        Self { table: (0..=STEPS).map(|k| coefficients(k as f64 / STEPS as f64)).collect() }
    }

    /// Coefficients for light whose direction has the cosine `cos` ≥ 0 with the normal.
    pub fn around(&self, cos: f32) -> [f32; 3] {
        let at = cos.clamp(0.0, 1.0) * STEPS as f32;
        let k = (at as usize).min(STEPS - 1);
        let t = at - k as f32;
        std::array::from_fn(|i| self.table[k][i] * (1.0 - t) + self.table[k + 1][i] * t)
    }

    /// The kernel, per steradian. `[eq:entering-kernel]`
    #[inline]
    pub fn at(&self, [a, b, c]: &[f32; 3], x: f32, z: f32) -> f32 {
        (CONCENTRATION as f32 * (x - 1.0)).exp() * (a + b * x + c * z)
    }
}

/// Solves for the coefficients such that ∫ K = 1 and ∫ K·ω is the light's direction.
fn coefficients(cos: f64) -> [f32; 3] {
    let sin = (1.0 - cos * cos).max(0.0).sqrt();
    let low = f64::from(MIN_INNER_COSINE);
    let mut matrix = DMat3::ZERO;
    let weight = TAU * (1.0 - low) / (QUADRATURE * QUADRATURE) as f64;
    for i in 0..QUADRATURE {
        let z = low + (1.0 - low) * (i as f64 + 0.5) / QUADRATURE as f64;
        for j in 0..QUADRATURE {
            let phi = TAU * (j as f64 + 0.5) / QUADRATURE as f64;
            let x = cos * z + sin * (1.0 - z * z).sqrt() * phi.cos();
            // Functions and conditions alike: 1, x, and what is across the light in the plane of the normal.
            let row = DVec3::new(1.0, x, z - cos * x);
            let value = weight * (CONCENTRATION * (x - 1.0)).exp();
            matrix += DMat3::from_cols(row * (value * row.x), row * (value * row.y), row * (value * row.z));
        }
    }
    matrix.x_axis.x *= 1.0 + RIDGE;
    matrix.y_axis.y *= 1.0 + RIDGE;
    matrix.z_axis.z = matrix.z_axis.z * (1.0 + RIDGE) + RIDGE * matrix.x_axis.x;
    let solved = matrix.inverse() * DVec3::new(1.0, 1.0, 0.0);
    // a + b·x + c·(z − cos·x).
    [solved.x, solved.y - cos * solved.z, solved.z].map(|v| v as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    /// `[eq:entering-kernel]`: constants and linear functions over the hemisphere, for every angle.
    #[test]
    fn the_kernel_reproduces_linear_functions() {
        let kernel = EnteringKernel::new();
        for cos in [0.3f32, 0.55, 0.7, 0.86, 0.99, 1.0] {
            let light = Vec3::new((1.0 - cos * cos).sqrt(), 0.0, cos);
            let around = kernel.around(cos);
            let (mut one, mut mean) = (0.0f32, Vec3::ZERO);
            let n = 200;
            let weight = std::f32::consts::TAU * (1.0 - MIN_INNER_COSINE) / (n * n) as f32;
            for i in 0..n * n {
                let z = MIN_INNER_COSINE + (1.0 - MIN_INNER_COSINE) * ((i / n) as f32 + 0.5) / n as f32;
                let (sin, c) = (std::f32::consts::TAU * ((i % n) as f32 + 0.5) / n as f32).sin_cos();
                let direction = Vec3::new((1.0 - z * z).sqrt() * c, (1.0 - z * z).sqrt() * sin, z);
                let value = weight * kernel.at(&around, direction.dot(light), z);
                one += value;
                mean += direction * value;
            }
            assert!((one - 1.0).abs() < 0.01 && (mean - light).length() < 0.01, "{cos}: {one} {mean} {light}");
        }
    }
}
