//! The watertight ray–triangle test of Woop, Benthin and Wald (2013).
//!
//! The triangle is sheared into a frame in which the ray is the z axis; the signs of three 2D edge functions decide. An edge that
//! two triangles share gives exactly opposite numbers in both, so no ray passes between them. Where a function is zero in
//! `f32` it is computed again in `f64`.
use glam::Vec3;

/// A ray with what the test needs of it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ShearedRay {
    origin: [f32; 3],
    /// The axis along which the direction is longest, and the two others in an order that keeps the handedness.
    axes: [usize; 3],
    shear: [f32; 3],
}

/// Where a ray meets a triangle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TriangleHit {
    /// Distance in units of the ray's direction, > 0.
    pub t: f32,
    /// Weights of the second and third corner.
    pub barycentric: [f32; 2],
    /// Whether the ray meets the outer side (it goes against the normal).
    pub entering: bool,
}

impl ShearedRay {
    #[inline]
    pub fn new(origin: Vec3, direction: Vec3) -> Self {
        let d = direction.to_array();
        let a = direction.abs();
        let z = if a.x > a.y && a.x > a.z {
            0
        } else if a.y > a.z {
            1
        } else {
            2
        };
        let (mut x, mut y) = ((z + 1) % 3, (z + 2) % 3);
        if d[z] < 0.0 {
            std::mem::swap(&mut x, &mut y);
        }
        let inverse = 1.0 / d[z];
        Self { origin: origin.to_array(), axes: [x, y, z], shear: [d[x] * inverse, d[y] * inverse, inverse] }
    }

    /// The nearest point ahead where the ray meets the triangle; `None` beside it, in its plane, and behind.
    #[inline]
    pub fn intersect(&self, corners: &[[f32; 3]; 3]) -> Option<TriangleHit> {
        let [kx, ky, kz] = self.axes;
        let [sx, sy, sz] = self.shear;
        let o = &self.origin;
        let mut x = [0.0f32; 3];
        let mut y = [0.0f32; 3];
        let mut z = [0.0f32; 3];
        for k in 0..3 {
            let c = &corners[k];
            z[k] = c[kz] - o[kz];
            x[k] = (c[kx] - o[kx]) - sx * z[k];
            y[k] = (c[ky] - o[ky]) - sy * z[k];
        }
        let mut u = x[2] * y[1] - y[2] * x[1];
        let mut v = x[0] * y[2] - y[0] * x[2];
        let mut w = x[1] * y[0] - y[1] * x[0];
        if u == 0.0 || v == 0.0 || w == 0.0 {
            let edge =
                |a: usize, b: usize| (f64::from(x[a]) * f64::from(y[b]) - f64::from(y[a]) * f64::from(x[b])) as f32;
            (u, v, w) = (edge(2, 1), edge(0, 2), edge(1, 0));
        }
        let entering = u >= 0.0 && v >= 0.0 && w >= 0.0;
        let leaving = u <= 0.0 && v <= 0.0 && w <= 0.0;
        if !(entering || leaving) {
            return None;
        }
        let determinant = u + v + w;
        if determinant == 0.0 {
            return None;
        }
        let t = sz * (u * z[0] + v * z[1] + w * z[2]) / determinant;
        (t > 0.0 && t < f32::INFINITY).then(|| TriangleHit {
            t,
            barycentric: [v / determinant, w / determinant],
            entering,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Rng;
    use crate::sampling::uniform_sphere;

    /// The point that the weights give is the point at the distance, and the side is that of the normal.
    #[test]
    fn distance_weights_and_side_agree() {
        let mut rng = Rng::new(3, 1);
        let mut hits = [0; 2];
        for _ in 0..20_000 {
            let corners = [0; 3].map(|_| uniform_sphere(&mut rng) * 2.0);
            let (origin, direction) = (uniform_sphere(&mut rng) * 3.0, uniform_sphere(&mut rng));
            let Some(hit) = ShearedRay::new(origin, direction).intersect(&corners.map(|c| c.to_array())) else {
                continue;
            };
            let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]);
            if normal.normalize().dot(direction).abs() < 1e-2 {
                continue;
            }
            let [v, w] = hit.barycentric;
            let point = corners[0] * (1.0 - v - w) + corners[1] * v + corners[2] * w;
            assert!((origin + direction * hit.t - point).length() < 1e-4);
            assert!(v >= 0.0 && w >= 0.0 && v + w <= 1.0 + 1e-6);
            assert_eq!(hit.entering, normal.dot(direction) < 0.0);
            hits[usize::from(hit.entering)] += 1;
        }
        assert!(hits.iter().all(|n| *n > 100), "{hits:?}");
    }

    /// Rays at the shared edge of two triangles never pass between them, also far away and nearly in their plane.
    #[test]
    fn no_ray_passes_through_a_shared_edge() {
        let mut rng = Rng::new(4, 1);
        for i in 0..20_000 {
            let scale = [1.0, 1e3, 1e-3][i % 3];
            let [a, b] = [0; 2].map(|_| uniform_sphere(&mut rng) * scale);
            let along = (b - a).normalize();
            let side = along.any_orthonormal_vector() * scale;
            let bend = along.cross(side);
            let (c, d) = (a + side + 0.3 * bend, a - side + 0.2 * bend);
            let direction = (-bend + 0.2 * side).normalize();
            let target = a + (b - a) * (0.05 + 0.9 * rng.uniform());
            let ray = ShearedRay::new(target - direction * scale, direction);
            let of = |t: [Vec3; 3]| ray.intersect(&t.map(|c| c.to_array()));
            assert!(of([a, b, c]).is_some() || of([b, a, d]).is_some(), "ray {i}");
        }
    }
}
