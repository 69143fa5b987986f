//! Turning colours in spherical harmonics.
//!
//! A band of harmonics is closed under rotations and reflections: the coefficients of a turned function are a matrix
//! times those of the function, D_mn = ∫ Y_m(d) Y_n(Rᵀd) dd. The integrand is a polynomial of degree 6 at most, which the
//! product of four Gauss–Legendre nodes in z and eight equal steps around it integrates exactly.
use diamond_light::spherical_harmonics::{COEFFICIENTS, basis};
use glam::{DMat3, DVec3};

/// Nodes and weights of Gauss–Legendre quadrature of order 4, exact to degree 7.
const NODES: [(f64, f64); 4] = [
    (-0.861_136_311_594_052_6, 0.347_854_845_137_453_9),
    (-0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
    (0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
    (0.861_136_311_594_052_6, 0.347_854_845_137_453_9),
];
const AROUND: usize = 8;

/// The matrix that takes coefficients of f to those of d ↦ f(Rᵀd), for an orthogonal `rotation` R; zero between bands.
pub(crate) fn matrix(rotation: DMat3) -> [[f64; COEFFICIENTS]; COEFFICIENTS] {
    let mut out = [[0.0; COEFFICIENTS]; COEFFICIENTS];
    let band = |i: usize| (i as f64).sqrt() as usize;
    for (z, weight) in NODES {
        let r = (1.0 - z * z).sqrt();
        for step in 0..AROUND {
            let (sin, cos) = libm::sincos((step as f64 + 0.5) * std::f64::consts::TAU / AROUND as f64);
            let direction = DVec3::new(r * cos, r * sin, z);
            let here = basis(direction.as_vec3());
            let there = basis((rotation.transpose() * direction).as_vec3());
            let weight = weight * std::f64::consts::TAU / AROUND as f64;
            for m in 0..COEFFICIENTS {
                for n in (0..COEFFICIENTS).filter(|n| band(*n) == band(m)) {
                    out[m][n] += weight * f64::from(here[m]) * f64::from(there[n]);
                }
            }
        }
    }
    out
}

/// Turns the colours of all Gaussians by an orthogonal matrix, in place: `sh` is N × `coefficients` × 3 with 1, 4, 9 or 16
/// coefficients. Afterwards the colour along R·d is what it was along d. Exact but for rounding (3·10⁻⁷ of the largest
/// coefficient, as the basis is evaluated in 32 bits).
pub fn rotate_harmonics(sh: &mut [f32], coefficients: usize, rotation: DMat3) {
    if coefficients <= 1 {
        return;
    }
    let matrix = matrix(rotation);
    let k = coefficients.min(COEFFICIENTS);
    for row in sh.chunks_exact_mut(coefficients * 3) {
        let mut turned = [[0.0f64; 3]; COEFFICIENTS];
        for m in 1..k {
            for n in 1..k {
                for channel in 0..3 {
                    turned[m][channel] += matrix[m][n] * f64::from(row[n * 3 + channel]);
                }
            }
        }
        for m in 1..k {
            for channel in 0..3 {
                row[m * 3 + channel] = turned[m][channel] as f32;
            }
        }
    }
}
