//! The watertight ray–triangle test of Woop, Benthin and Wald (2013), for eight triangles at once.
//!
//! The triangles are sheared into a frame in which the ray is the z axis; the signs of three 2D edge functions decide. An edge that
//! two triangles share gives exactly opposite numbers in both, so no ray passes between them. Where a function is zero in
//! `f32` it is computed again in `f64`. Products and sums are rounded one by one, so bits do not depend on the instruction set.
use diamond_simd::{Eight, Octet};
use glam::Vec3;

/// Triangles of a block.
pub(crate) const EIGHT: usize = 8;

/// Corners of up to eight triangles.
#[derive(Debug, Clone)]
#[repr(align(32))]
pub(crate) struct TriangleBlock {
    /// For each axis, for each corner.
    corners: [[[f32; EIGHT]; 3]; 3],
    /// What the triangles are called; unused places have NaN for corners and meet nothing.
    pub names: [u32; EIGHT],
}

impl TriangleBlock {
    /// At most eight triangles with their names.
    pub fn new(triangles: impl IntoIterator<Item = (u32, [Vec3; 3])>) -> Self {
        let mut block = Self { corners: [[[f32::NAN; EIGHT]; 3]; 3], names: [u32::MAX; EIGHT] };
        for (i, (name, corners)) in triangles.into_iter().take(EIGHT).enumerate() {
            block.names[i] = name;
            for (k, corner) in corners.iter().enumerate() {
                for axis in 0..3 {
                    block.corners[axis][k][i] = corner[axis];
                }
            }
        }
        block
    }
}

/// A ray with what the test needs of it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ShearedRay {
    /// In the order of `axes`.
    origin: [f32; 3],
    /// The axis along which the direction is longest last, and the two others in an order that keeps the handedness.
    axes: [usize; 3],
    shear: [f32; 3],
}

/// Where a ray meets the triangles of a block.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BlockHits {
    /// Triangles that are met from their outer side (against the normal), one bit each, and from the inner side.
    pub entering: u32,
    /// See `entering`.
    pub leaving: u32,
    /// Distances in units of the ray's direction; only where a bit is set and, unless > 0 and finite, not a hit at all.
    pub t: [f32; EIGHT],
    edges: [[f32; EIGHT]; 3],
}

impl BlockHits {
    /// The edge functions: weights of the corners, but for their sum.
    #[inline]
    pub fn edges(&self, i: usize) -> [f32; 3] {
        [self.edges[0][i], self.edges[1][i], self.edges[2][i]]
    }
}

impl ShearedRay {
    #[inline]
    pub fn new(origin: Vec3, direction: Vec3) -> Self {
        let (o, d) = (origin.to_array(), direction.to_array());
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
        Self { origin: [o[x], o[y], o[z]], axes: [x, y, z], shear: [d[x] * inverse, d[y] * inverse, inverse] }
    }

    /// Where the ray's line meets the triangles; `None` if it passes beside all of them.
    #[inline(always)]
    pub fn meet<E: Eight>(&self, e: E, block: &TriangleBlock) -> Option<BlockHits> {
        let [cx, cy, cz] = self.axes.map(|axis| &block.corners[axis]);
        let ([ox, oy, oz], [sx, sy, sz]) =
            (self.origin.map(|o| Octet::splat(e, o)), self.shear.map(|s| Octet::splat(e, s)));
        let z = [Octet::load(e, &cz[0]) - oz, Octet::load(e, &cz[1]) - oz, Octet::load(e, &cz[2]) - oz];
        let sheared =
            |c: &[[f32; EIGHT]; 3], k: usize, o: Octet<E>, s: Octet<E>| (Octet::load(e, &c[k]) - o) - s * z[k];
        let x = [sheared(cx, 0, ox, sx), sheared(cx, 1, ox, sx), sheared(cx, 2, ox, sx)];
        let y = [sheared(cy, 0, oy, sy), sheared(cy, 1, oy, sy), sheared(cy, 2, oy, sy)];
        let u = x[2] * y[1] - y[2] * x[1];
        let v = x[0] * y[2] - y[0] * x[2];
        let w = x[1] * y[0] - y[1] * x[0];
        let zero = Octet::splat(e, 0.0);
        let (low, high) = (u.smaller(v).smaller(w), u.larger(v).larger(w));
        let (entering, leaving) = (zero.at_most(low), high.at_most(zero));
        let met = entering | leaving;
        if met == 0 {
            return None;
        }
        // A function that is zero leaves the side open.
        let open = (low.equal(zero) | high.equal(zero)) & met;
        if open != 0 {
            return self.meet_closely(
                entering,
                leaving,
                open,
                x.map(Octet::store),
                y.map(Octet::store),
                z.map(Octet::store),
                [u.store(), v.store(), w.store()],
            );
        }
        let t = sz * (u * z[0] + v * z[1] + w * z[2]) / (u + v + w);
        Some(BlockHits { entering, leaving, t: t.store(), edges: [u.store(), v.store(), w.store()] })
    }

    /// [`ShearedRay::meet`] where edge functions of the triangles `open` are zero.
    #[cold]
    #[inline(never)]
    fn meet_closely(
        &self,
        mut entering: u32,
        mut leaving: u32,
        open: u32,
        x: [[f32; EIGHT]; 3],
        y: [[f32; EIGHT]; 3],
        z: [[f32; EIGHT]; 3],
        mut edges: [[f32; EIGHT]; 3],
    ) -> Option<BlockHits> {
        let mut t = [0.0; EIGHT];
        for i in 0..EIGHT {
            if open >> i & 1 == 1 {
                let edge = |a: usize, b: usize| {
                    (f64::from(x[a][i]) * f64::from(y[b][i]) - f64::from(y[a][i]) * f64::from(x[b][i])) as f32
                };
                let exact = [edge(2, 1), edge(0, 2), edge(1, 0)];
                let (enters, leaves) = (exact.iter().all(|e| *e >= 0.0), exact.iter().all(|e| *e <= 0.0));
                // In the triangle's plane: met from neither side.
                let bit = |met: bool| u32::from(met && !(enters && leaves)) << i;
                entering = entering & !(1 << i) | bit(enters);
                leaving = leaving & !(1 << i) | bit(leaves);
                (0..3).for_each(|k| edges[k][i] = exact[k]);
            }
            let [u, v, w] = [edges[0][i], edges[1][i], edges[2][i]];
            t[i] = self.shear[2] * (u * z[0][i] + v * z[1][i] + w * z[2][i]) / (u + v + w);
        }
        (entering | leaving != 0).then_some(BlockHits { entering, leaving, t, edges })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Rng;
    use crate::sampling::uniform_sphere;
    use diamond_simd::{Level, WithEight};

    struct Meet<'a>(&'a ShearedRay, &'a TriangleBlock);

    impl WithEight for Meet<'_> {
        type Output = Option<BlockHits>;
        #[inline(always)]
        fn with_eight<E: Eight>(self, e: E) -> Option<BlockHits> {
            self.0.meet(e, self.1)
        }
    }

    /// Distance, weights, side.
    fn meet(ray: &ShearedRay, corners: [Vec3; 3], place: u32) -> Option<(f32, [f32; 2], bool)> {
        let nowhere = [Vec3::NAN; 3];
        let block = TriangleBlock::new((0..8).map(|i| (i, if i == place { corners } else { nowhere })));
        let hits = Level::current().dispatch_eight(Meet(ray, &block))?;
        let i = place as usize;
        assert_eq!((hits.entering | hits.leaving) & !(1 << i), 0);
        let met = (hits.entering | hits.leaving) >> i & 1 == 1 && hits.t[i] > 0.0 && hits.t[i] < f32::INFINITY;
        let [u, v, w] = hits.edges(i);
        met.then(|| (hits.t[i], [v / (u + v + w), w / (u + v + w)], hits.entering >> i & 1 == 1))
    }

    /// The point that the weights give is the point at the distance, and the side is that of the normal.
    #[test]
    fn distance_weights_and_side_agree() {
        let mut rng = Rng::new(3, 1);
        let mut hits = [0; 2];
        for i in 0..20_000 {
            let corners = [0; 3].map(|_| uniform_sphere(&mut rng) * 2.0);
            let (origin, direction) = (uniform_sphere(&mut rng) * 3.0, uniform_sphere(&mut rng));
            let Some((t, [v, w], entering)) = meet(&ShearedRay::new(origin, direction), corners, i % 8) else {
                continue;
            };
            let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]);
            if normal.normalize().dot(direction).abs() < 1e-2 {
                continue;
            }
            let point = corners[0] * (1.0 - v - w) + corners[1] * v + corners[2] * w;
            assert!((origin + direction * t - point).length() < 1e-4);
            assert!(v >= 0.0 && w >= 0.0 && v + w <= 1.0 + 1e-6);
            assert_eq!(entering, normal.dot(direction) < 0.0);
            hits[usize::from(entering)] += 1;
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
            let of = |t: [Vec3; 3]| meet(&ray, t, i as u32 % 8);
            assert!(of([a, b, c]).is_some() || of([b, a, d]).is_some(), "ray {i}");
        }
    }
}
