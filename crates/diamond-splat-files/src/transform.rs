//! Moving a cloud: positions, orientations, sizes, normals and colours together.
use crate::SplatCloud;
use crate::cloud::{log_scale, unit};
use crate::harmonics::rotate_harmonics;
use glam::{DAffine3, DMat3, DQuat, DVec3, Quat};

/// How far the columns of a matrix may be from equal lengths and right angles, relative, and still be a similarity.
const SIMILARITY: f64 = 1e-6;

impl SplatCloud {
    /// Applies an affine map. Under rotation, reflection and uniform scale everything is exact but for rounding. Under
    /// shear and unequal scales the Gaussians are exact too (eigenvectors of A·Σ·Aᵀ), while colours turn with the
    /// rotation that is nearest, as no turn of theirs matches a shear; then a sentence that says so is returned.
    pub fn transform(&mut self, map: DAffine3) -> Option<String> {
        let a = map.matrix3;
        if map == DAffine3::IDENTITY {
            return None;
        }
        for mean in &mut self.means {
            *mean = map.transform_point3(mean.as_dvec3()).as_vec3();
        }
        let size = libm::cbrt(a.determinant().abs());
        let square = a.transpose() * a;
        let similar = size > 0.0
            && (square * (1.0 / (size * size)) - DMat3::IDENTITY).to_cols_array().iter().all(|v| v.abs() < SIMILARITY);
        let orthogonal = if similar { a * (1.0 / size) } else { nearest_orthogonal(a) };
        // A Gaussian is the same when mirrored through its centre, so a reflection turns it as its negative does.
        let proper = if orthogonal.determinant() < 0.0 { -orthogonal } else { orthogonal };
        let turn = DQuat::from_mat3(&proper);
        for (log, rotation) in self.log_scales.iter_mut().zip(&mut self.rotations) {
            let q = unit(*rotation).as_dquat();
            if similar {
                *rotation = quat((turn * q).normalize());
                *log += glam::Vec3::splat(log_scale(size));
            } else {
                let s = log.as_dvec3().map(libm::exp);
                let m = a * DMat3::from_quat(q) * DMat3::from_diagonal(s);
                let (values, vectors) = eigen(m * m.transpose());
                *log = DVec3::from(values.to_array().map(|v| f64::from(log_scale(v.max(0.0).sqrt())))).as_vec3();
                *rotation = quat(DQuat::from_mat3(&vectors).normalize());
            }
        }
        if let Some(normals) = &mut self.normals {
            let cofactor = if a.determinant() != 0.0 { a.inverse().transpose() } else { orthogonal };
            for normal in normals {
                *normal = (cofactor * normal.as_dvec3()).normalize_or_zero().as_vec3();
            }
        }
        let coefficients = self.coefficients();
        rotate_harmonics(&mut self.sh, coefficients, orthogonal);
        (!similar && self.degree > 0)
            .then(|| "scaled unequally or sheared: the dependence of colour on direction is approximate".to_string())
    }
}

fn quat(q: DQuat) -> Quat {
    Quat::from_xyzw(q.x as f32, q.y as f32, q.z as f32, q.w as f32)
}

/// The orthogonal matrix nearest to `a` (Higham's iteration: the mean of a matrix and its inverse transpose).
fn nearest_orthogonal(a: DMat3) -> DMat3 {
    const ROUNDS: usize = 60;
    let mut q = a;
    for _ in 0..ROUNDS {
        if q.determinant() == 0.0 || !q.is_finite() {
            return DMat3::IDENTITY;
        }
        q = (q + q.inverse().transpose()) * 0.5;
    }
    if q.is_finite() { q } else { DMat3::IDENTITY }
}

/// Eigenvalues and a right-handed frame of eigenvectors of a symmetric matrix (cyclic Jacobi rotations).
fn eigen(mut a: DMat3) -> (DVec3, DMat3) {
    const SWEEPS: usize = 24;
    let mut v = DMat3::IDENTITY;
    for _ in 0..SWEEPS {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let off = a.col(q)[p];
            if off == 0.0 {
                continue;
            }
            let theta = (a.col(q)[q] - a.col(p)[p]) / (2.0 * off);
            let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
            if !t.is_finite() {
                continue;
            }
            let c = 1.0 / (t * t + 1.0).sqrt();
            let s = t * c;
            let mut turn = DMat3::IDENTITY;
            turn.col_mut(p)[p] = c;
            turn.col_mut(q)[q] = c;
            turn.col_mut(q)[p] = s;
            turn.col_mut(p)[q] = -s;
            a = turn.transpose() * a * turn;
            v *= turn;
        }
    }
    if v.determinant() < 0.0 {
        v = -v;
    }
    (DVec3::new(a.col(0)[0], a.col(1)[1], a.col(2)[2]), v)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eigenvectors_diagonalise() {
        let r = DMat3::from_quat(DQuat::from_xyzw(0.1, -0.4, 0.3, 0.8).normalize());
        let a = r * DMat3::from_diagonal(DVec3::new(4.0, 0.25, 1.0)) * r.transpose();
        let (values, v) = eigen(a);
        let back = v * DMat3::from_diagonal(values) * v.transpose();
        assert!((back - a).to_cols_array().iter().all(|e| e.abs() < 1e-13));
        assert!((v.determinant() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn nearest_rotation_of_a_scaled_one() {
        let r = DMat3::from_rotation_z(0.7);
        let q = nearest_orthogonal(r * DMat3::from_diagonal(DVec3::new(3.0, 0.5, 2.0)).transpose());
        assert!((q - r).to_cols_array().iter().all(|e| e.abs() < 1e-12), "{q}");
    }
}
