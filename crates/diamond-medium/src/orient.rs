//! Normals of a bare point cloud: planes through the points around, turned the same way all over the surface.
//!
//! The normal of a point is the direction in which its neighbours spread least. Its sign comes along a spanning tree of neighbours whose
//! normals agree best, from the farthest point along z, which faces upward (Hoppe, DeRose, Duchamp, McDonald and Stuetzle 1992).
use crate::near::Near;
use glam::{Mat3, Vec3};
use std::collections::BinaryHeap;

/// Points through which a plane is put.
const AROUND: usize = 14;
/// Rounds of the power iteration that finds a plane's normal.
const ROUNDS: usize = 32;

/// An edge of the spanning tree that could be next: the better two normals agree, the sooner.
#[derive(PartialEq)]
struct Edge {
    agreement: f32,
    from: usize,
    to: usize,
}

impl Eq for Edge {}

impl PartialOrd for Edge {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Edge {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.agreement.total_cmp(&other.agreement).then((other.to, other.from).cmp(&(self.to, self.from)))
    }
}

/// Unit normals of points on a closed surface, outward where the points are dense enough to tell one side from the other. Deterministic.
/// Fewer than four points have no surface: their normals are zero.
pub fn outward_normals(points: &[Vec3]) -> Vec<Vec3> {
    let n = points.len();
    if n < 4 {
        return vec![Vec3::ZERO; n];
    }
    let low = points.iter().copied().reduce(Vec3::min).unwrap_or(Vec3::ZERO);
    let high = points.iter().copied().reduce(Vec3::max).unwrap_or(Vec3::ZERO);
    let near = Near::new(points, (high - low).max_element() * 2.0 / (n as f32).sqrt());
    let around: Vec<Vec<usize>> =
        points.iter().map(|p| near.nearest(points, *p, AROUND).into_iter().map(|f| f.0).collect()).collect();
    let mut normals: Vec<Vec3> = around.iter().map(|of| plane_normal(points, of)).collect();
    let mut done = vec![false; n];
    let mut edges = BinaryHeap::new();
    // A cloud in several pieces has a tree for each.
    while let Some(start) =
        (0..n).filter(|&i| !done[i]).max_by(|&a, &b| points[a].z.total_cmp(&points[b].z).then(b.cmp(&a)))
    {
        if normals[start].z < 0.0 {
            normals[start] = -normals[start];
        }
        done[start] = true;
        let mut last = start;
        loop {
            for &to in around[last].iter().filter(|&&to| !done[to]) {
                edges.push(Edge { agreement: normals[last].dot(normals[to]).abs(), from: last, to });
            }
            let Some(edge) = edges.pop() else { break };
            last = edge.from;
            if !done[edge.to] {
                if normals[edge.from].dot(normals[edge.to]) < 0.0 {
                    normals[edge.to] = -normals[edge.to];
                }
                done[edge.to] = true;
                last = edge.to;
            }
        }
    }
    normals
}

/// The direction in which points spread least.
fn plane_normal(points: &[Vec3], of: &[usize]) -> Vec3 {
    let mean = of.iter().map(|&i| points[i]).sum::<Vec3>() / of.len().max(1) as f32;
    let mut spread = Mat3::ZERO;
    for &i in of {
        let d = points[i] - mean;
        spread += Mat3::from_cols(d * d.x, d * d.y, d * d.z);
    }
    let trace = spread.x_axis.x + spread.y_axis.y + spread.z_axis.z;
    if trace <= f32::MIN_POSITIVE {
        return Vec3::Z;
    }
    // The largest of trace − eigenvalue belongs to the smallest eigenvalue.
    let turned = Mat3::from_diagonal(Vec3::splat(1.0)) - spread * (1.0 / trace);
    let mut best = Vec3::ZERO;
    for start in [Vec3::X, Vec3::Y, Vec3::Z] {
        let mut v = start;
        for _ in 0..ROUNDS {
            v = (turned * (turned * v)).normalize_or(start);
        }
        if best == Vec3::ZERO || v.dot(spread * v) < best.dot(spread * best) {
            best = v;
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_lobes_have_outward_normals() {
        // A surface with a waist, its points out of order.
        let point = |i: usize| {
            let z = 1.0 - 2.0 * ((i * 1597) % 3000) as f32 / 3000.0;
            let (s, c) = (2.399_963 * ((i * 1597) % 3000) as f32).sin_cos();
            let r = (1.0 - z * z).sqrt() * (0.55 + 0.45 * (3.0 * z).cos().abs());
            Vec3::new(r * c, r * s, 1.5 * z)
        };
        let points: Vec<Vec3> = (0..3000).map(point).collect();
        let normals = outward_normals(&points);
        let good = points.iter().zip(&normals).filter(|(p, n)| n.dot(Vec3::new(p.x, p.y, 0.3 * p.z)) > 0.0).count();
        assert!(good > 2950, "{good}");
        assert!(normals.iter().all(|n| n.is_normalized()));
        assert_eq!(outward_normals(&[Vec3::ONE; 3]), [Vec3::ZERO; 3]);
        assert!(outward_normals(&[Vec3::ONE; 9]).iter().all(|n| n.is_normalized()));
    }
}
