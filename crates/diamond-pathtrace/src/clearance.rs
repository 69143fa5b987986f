//! A grid that knows how far, at least, the surface is: flights that end sooner need no ray.
//!
//! Cells that a triangle's bounding box touches are marked; the exact Euclidean distance transform (Felzenszwalb and Huttenlocher
//! 2012) gives every cell its distance to the nearest marked one. A point of a cell at distance k (in cells, between centres)
//! is at least k − √3 cells away from everything inside the marked one.
use glam::Vec3;

/// Cells along the longest side of the bounding box.
const CELLS: usize = 64;

/// A distance that is larger than any in the grid, in cells squared.
const FAR: f32 = 1e9;

/// Lower bounds of the distance to a surface.
#[derive(Debug, Clone)]
pub(crate) struct Clearance {
    origin: Vec3,
    per_cell: f32,
    size: [usize; 3],
    /// Scene units.
    distance: Vec<f32>,
}

impl Clearance {
    /// A grid around triangles whose bounding boxes are given.
    pub fn new(boxes: &[(Vec3, Vec3)]) -> Self {
        let (low, high) =
            boxes.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(a, b), (low, high)| (a.min(*low), b.max(*high)));
        let cell = (high - low).max_element() / CELLS as f32;
        let unusable = !(cell > f32::MIN_POSITIVE && cell.is_finite() && cell.recip().is_finite());
        if unusable {
            return Self { origin: Vec3::ZERO, per_cell: 0.0, size: [0; 3], distance: Vec::new() };
        }
        let per_cell = 1.0 / cell;
        let size = ((high - low) * per_cell).to_array().map(|n| (n.ceil() as usize).clamp(1, CELLS) + 1);
        let mut squared = vec![FAR; size[0] * size[1] * size[2]];
        for (a, b) in boxes {
            // One hundredth of a cell covers the rounding of positions.
            let first = ((*a - low) * per_cell - 0.01).max(Vec3::ZERO).to_array();
            let last = ((*b - low) * per_cell + 0.01).max(Vec3::ZERO).to_array();
            let range = |k: usize| (first[k] as usize).min(size[k] - 1)..=(last[k] as usize).min(size[k] - 1);
            for z in range(2) {
                for y in range(1) {
                    for x in range(0) {
                        squared[(z * size[1] + y) * size[0] + x] = 0.0;
                    }
                }
            }
        }
        let strides = [1, size[0], size[0] * size[1]];
        for axis in 0..3 {
            let (n, stride) = (size[axis], strides[axis]);
            let (p, q) = ((axis + 1) % 3, (axis + 2) % 3);
            let mut line = vec![0.0; n];
            for i in 0..size[p] {
                for j in 0..size[q] {
                    let start = i * strides[p] + j * strides[q];
                    (0..n).for_each(|k| line[k] = squared[start + k * stride]);
                    let transformed = lower_envelope(&line);
                    (0..n).for_each(|k| squared[start + k * stride] = transformed[k]);
                }
            }
        }
        let margin = 3f32.sqrt() + 0.02;
        let distance = squared.iter().map(|d| (d.sqrt() - margin).max(0.0) * cell).collect();
        Self { origin: low, per_cell, size, distance }
    }

    /// The surface is at least this far from `point` (scene units); 0 where nothing is known.
    #[inline]
    pub fn at(&self, point: Vec3) -> f32 {
        let p = (point - self.origin) * self.per_cell;
        if self.distance.is_empty() || p.is_nan() || p.min_element() < 0.0 {
            return 0.0;
        }
        let [x, y, z] = p.to_array().map(|v| v as usize);
        if x >= self.size[0] || y >= self.size[1] || z >= self.size[2] {
            return 0.0;
        }
        self.distance[(z * self.size[1] + y) * self.size[0] + x]
    }
}

/// min over q of (p − q)² + f(q), for each p: the lower envelope of parabolas.
fn lower_envelope(f: &[f32]) -> Vec<f32> {
    let n = f.len();
    let mut roots = vec![0usize; n];
    let mut borders = vec![f64::NEG_INFINITY; n + 1];
    let height = |q: usize| f64::from(f[q]) + (q * q) as f64;
    let mut k = 0;
    for q in 1..n {
        loop {
            let r = roots[k];
            let s = (height(q) - height(r)) / (2.0 * (q - r) as f64);
            if s > borders[k] || k == 0 {
                let keep = if s > borders[k] { k + 1 } else { k };
                roots[keep] = q;
                borders[keep] = if s > borders[k] { s } else { f64::NEG_INFINITY };
                k = keep;
                break;
            }
            k -= 1;
        }
    }
    let last = k;
    k = 0;
    (0..n)
        .map(|p| {
            while k < last && borders[k + 1] < p as f64 {
                k += 1;
            }
            let d = p as f64 - roots[k] as f64;
            (d * d + f64::from(f[roots[k]])) as f32
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Rng;

    #[test]
    fn the_transform_is_the_minimum_over_all_parabolas() {
        let mut rng = Rng::new(9, 9);
        for _ in 0..200 {
            let n = 1 + (rng.bits() % 40) as usize;
            let f: Vec<f32> =
                (0..n).map(|_| if rng.uniform() < 0.7 { FAR } else { (rng.uniform() * 100.0).floor() }).collect();
            let fast = lower_envelope(&f);
            for p in 0..n {
                let slow = (0..n).map(|q| f[q] + ((p as f32) - (q as f32)).powi(2)).fold(f32::INFINITY, f32::min);
                assert!((fast[p] - slow).abs() <= 1e-6 * slow, "{p}: {} {slow} of {f:?}", fast[p]);
            }
        }
    }

    /// No point is farther from the boxes than the grid says it is at least.
    #[test]
    fn bounds_are_lower_bounds() {
        let mut rng = Rng::new(5, 5);
        let mut point = |scale: f32| Vec3::new(rng.uniform(), rng.uniform(), rng.uniform()) * scale;
        for _ in 0..5 {
            let boxes: Vec<(Vec3, Vec3)> = (0..6)
                .map(|_| {
                    let a = point(2.0) - 1.0;
                    (a, a + point(0.1))
                })
                .collect();
            let grid = Clearance::new(&boxes);
            let mut positive = 0;
            for _ in 0..2000 {
                let p = point(2.2) - 1.1;
                let true_distance =
                    boxes.iter().map(|(a, b)| (p.clamp(*a, *b) - p).length()).fold(f32::INFINITY, f32::min);
                let bound = grid.at(p);
                assert!(bound <= true_distance);
                positive += usize::from(bound > 0.3 * true_distance);
            }
            assert!(positive > 100, "{positive}");
        }
        assert_eq!(Clearance::new(&[(Vec3::ONE, Vec3::ONE)]).at(Vec3::ONE), 0.0);
    }
}
