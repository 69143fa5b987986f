//! Brute-force transmittance of a ray through anisotropic Gaussians, in f64, without any hierarchy.
//!
//! Written in world space with inverse covariance matrices found by elimination, so that it shares no step with an
//! implementation that goes to the local axes of each Gaussian.

/// A Gaussian of the oracle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Occluder {
    /// Centre, world coordinates.
    pub mean: [f64; 3],
    /// Standard deviations along the local axes, above 0.
    pub scale: [f64; 3],
    /// Local → world rotation w, x, y, z; any length but 0.
    pub rotation: [f64; 4],
    /// Peak opacity.
    pub opacity: f64,
}

/// Σ = R·diag(s²)·Rᵀ, from the quaternion by the sandwich product with each axis.
pub fn covariance(o: &Occluder) -> [[f64; 3]; 3] {
    let [w, x, y, z] = o.rotation;
    let norm = (w * w + x * x + y * y + z * z).sqrt();
    let (w, v) = (w / norm, [x / norm, y / norm, z / norm]);
    let mut sigma = [[0.0; 3]; 3];
    for k in 0..3 {
        let mut axis = [0.0; 3];
        axis[k] = 1.0;
        // q·a·q* = a + 2w(v×a) + 2v×(v×a)
        let first = cross(v, axis);
        let second = cross(v, first);
        let turned: [f64; 3] = std::array::from_fn(|i| axis[i] + 2.0 * w * first[i] + 2.0 * second[i]);
        for i in 0..3 {
            for j in 0..3 {
                sigma[i][j] += o.scale[k] * o.scale[k] * turned[i] * turned[j];
            }
        }
    }
    sigma
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Σ⁻¹·b by Gaussian elimination with pivoting.
pub fn solve(mut sigma: [[f64; 3]; 3], mut b: [f64; 3]) -> [f64; 3] {
    for k in 0..3 {
        let pivot = (k..3).max_by(|&i, &j| sigma[i][k].abs().total_cmp(&sigma[j][k].abs())).unwrap_or(k);
        sigma.swap(k, pivot);
        b.swap(k, pivot);
        for i in k + 1..3 {
            let f = sigma[i][k] / sigma[k][k];
            for j in k..3 {
                sigma[i][j] -= f * sigma[k][j];
            }
            b[i] -= f * b[k];
        }
    }
    let mut x = [0.0; 3];
    for k in (0..3).rev() {
        let known: f64 = (k + 1..3).map(|j| sigma[k][j] * x[j]).sum();
        x[k] = (b[k] - known) / sigma[k][k];
    }
    x
}

/// Where along the ray a Gaussian peaks, and what it takes away there: `(t, α)` with
/// α = a·clamp(a/c − 1, 0, 1), a = min(max_alpha, o·e^(−q/2)), c = min_alpha.
pub fn peak(o: &Occluder, origin: [f64; 3], direction: [f64; 3], min_alpha: f64, max_alpha: f64) -> (f64, f64) {
    let sigma = covariance(o);
    let e: [f64; 3] = std::array::from_fn(|i| origin[i] - o.mean[i]);
    // q(t) = (e + t·d)ᵀ Σ⁻¹ (e + t·d) is a parabola: a·t² + 2b·t + c.
    let (a, b) = (dot(direction, solve(sigma, direction)), dot(direction, solve(sigma, e)));
    let t = -b / a;
    let at: [f64; 3] = std::array::from_fn(|i| e[i] + t * direction[i]);
    let alpha = (o.opacity * (-0.5 * dot(at, solve(sigma, at))).exp()).min(max_alpha);
    (t, alpha * (alpha / min_alpha - 1.0).clamp(0.0, 1.0))
}

/// T = Π(1 − α) over all Gaussians whose peak lies strictly between `t_min` and `t_max`.
pub fn transmittance(
    occluders: &[Occluder],
    origin: [f64; 3],
    direction: [f64; 3],
    (t_min, t_max): (f64, f64),
    (min_alpha, max_alpha): (f64, f64),
) -> f64 {
    let mut product = 1.0;
    for o in occluders {
        let (t, alpha) = peak(o, origin, direction, min_alpha, max_alpha);
        if t > t_min && t < t_max {
            product *= 1.0 - alpha;
        }
    }
    product
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_disc_seen_face_on_and_aside() {
        let disc =
            Occluder { mean: [0.0, 0.0, 2.0], scale: [0.5, 0.5, 0.01], rotation: [2.0, 0.0, 0.0, 0.0], opacity: 0.8 };
        let seen = |x: f64| transmittance(&[disc], [x, 0.0, 0.0], [0.0, 0.0, 1.0], (0.0, 10.0), (1.0 / 255.0, 0.99));
        assert!((seen(0.0) - 0.2).abs() < 1e-12);
        assert!((seen(0.5) - (1.0 - 0.8 * (-0.5f64).exp())).abs() < 1e-12);
        assert_eq!(seen(5.0), 1.0);
        // A quarter turn about x stands it on edge along y: (x, y, z) extents .5, .01, .5.
        let h = 0.5f64.sqrt();
        let edge = covariance(&Occluder { rotation: [h, h, 0.0, 0.0], ..disc });
        for (i, expected) in [0.25, 1e-4, 0.25].into_iter().enumerate() {
            assert!((edge[i][i] - expected).abs() < 1e-12);
        }
        // Behind the ray, and beyond its end.
        assert_eq!(transmittance(&[disc], [0.0; 3], [0.0, 0.0, -1.0], (0.0, 10.0), (1.0 / 255.0, 0.99)), 1.0);
        assert_eq!(transmittance(&[disc], [0.0; 3], [0.0, 0.0, 1.0], (0.0, 1.9), (1.0 / 255.0, 0.99)), 1.0);
    }

    #[test]
    fn elimination_solves() {
        let m = [[0.0, 2.0, 1.0], [1.0, -1.0, 0.5], [3.0, 0.0, 4.0]];
        let x = solve(m, [1.0, 2.0, 3.0]);
        for (row, b) in m.iter().zip([1.0, 2.0, 3.0]) {
            assert!((dot(*row, x) - b).abs() < 1e-12);
        }
    }
}
