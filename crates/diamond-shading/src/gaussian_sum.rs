//! Σ_j G(|x_i − y_j|)·v_j for many points x, y and one Gaussian, without visiting all pairs.
//!
//! *Narrow* Gaussians, that reach few sources, are summed pair by pair over the neighbouring cells of a grid, up to
//! [`REACH`] widths. *Wide* ones go through a lattice, because a Gaussian is a sum of products of two narrower ones over its nodes n,
//!
//! exp(−|x−y|²/2σ²) ≈ (h/σ·√(2/π))³ · Σ_n exp(−|x−n|²/σ²)·exp(−|n−y|²/σ²):
//!
//! every source is spread to the 6³ nodes around it, every target gathers from the 6³ around it, at a cost that does not depend
//! on the width. The sum over an infinite lattice has, by Poisson's formula, a relative error of 2·e^(−π²σ²/2h²) per axis, 9·10⁻⁴ for the spacing
//! h = 0.8·σ; leaving out nodes beyond six costs up to 2·10⁻³ two widths away. Both together stay below [`GAUSSIAN_SUM_TOLERANCE`] of the Gaussian's
//! peak per unit of Σ v, for a single source; over a surface errors of both signs mostly cancel (Greengard and Strain 1991 expand in polynomials instead; a lattice has no boxes to expand about, and its weights
//! factor over the axes).
//!
//! The lattice is fixed by an origin, not by the points, so that the sum with targets and sources exchanged is the exact
//! transpose. Sums run in the order of the points: the bits do not depend on threads or on the instruction set.
use diamond_simd::{Level, Simd, WithSimd};
use glam::Vec3;
use std::f32::consts::PI;

/// Error of a sum, as a fraction of Σ|v| times the Gaussian's value at 0.
pub const GAUSSIAN_SUM_TOLERANCE: f32 = 5e-3;

/// Pairs farther apart than this many widths count as 0: e^(−8) = 3·10⁻⁴ of the peak.
const REACH: f32 = 4.0;
/// Spacing of the lattice in widths.
const SPACING: f32 = 0.8;
/// Nodes along an axis that a point spreads to.
const STENCIL: usize = 6;
/// Nodes of the stencil below the one under the point.
const BELOW: i64 = 2;
/// Sources within reach from which on the lattice is faster than pairs.
const MAX_PAIRS: f32 = 64.0;
/// Lattices of more nodes than this are not made (64 bytes per node at 16 columns: half a gigabyte); pairs are summed.
const MAX_NODES: usize = 1 << 23;
/// Coordinates in units of cells or nodes are cut to this: they are used as integers.
const MAX_CELL: f32 = 1e9;

/// Points of one side and of the other, ready for sums with one Gaussian.
pub(crate) struct GaussianSum<'a> {
    sources: &'a [Vec3],
    targets: &'a [Vec3],
    width: f32,
    origin: Vec3,
    plan: Plan,
}

enum Plan {
    /// Sources ordered by cell.
    Pairs(Vec<([i32; 3], u32)>),
    Lattice(Lattice),
}

/// Rows of nodes along x: from `low`, stored from `start` on.
struct Lattice {
    /// Smallest (y, z).
    corner: [i64; 2],
    /// Rows along y and z.
    size: [i64; 2],
    /// First node of a row, where it is stored, and number of nodes.
    rows: Vec<(i64, usize, i64)>,
    nodes: usize,
    /// exp(−a²h²/σ²), a = −2 … 3.
    table: [f32; STENCIL],
}

/// Where a point's stencil begins and its weights along each axis.
struct Stencil {
    first: [i64; 3],
    weights: [[f32; STENCIL]; 3],
}

/// Whether the lattice is faster, for sources with this much area each.
pub(crate) fn prefers_lattice(width: f32, area_per_source: f32) -> bool {
    PI * REACH * REACH * width * width > MAX_PAIRS * area_per_source
}

impl<'a> GaussianSum<'a> {
    /// Prepares sums; `lattice` as [`prefers_lattice`] says, and the same `origin` in both directions.
    pub fn new(sources: &'a [Vec3], targets: &'a [Vec3], width: f32, origin: Vec3, lattice: bool) -> Self {
        let found = if lattice { Lattice::new(sources, width, origin) } else { None };
        let plan = found.map_or_else(|| Plan::Pairs(by_cell(sources, width, origin)), Plan::Lattice);
        Self { sources, targets, width, origin, plan }
    }

    /// Σ_j G(|x_i − y_j|)·v_j for each target, with G normalised over the plane.
    /// `[eq:gaussian-sum]`
    pub fn apply<const C: usize>(&self, values: &[[f32; C]]) -> Vec<[f32; C]> {
        match &self.plan {
            Plan::Pairs(cells) => self.over_pairs(cells, values),
            Plan::Lattice(lattice) => Level::current().dispatch(OverLattice { sum: self, lattice, values }),
        }
    }

    fn over_pairs<const C: usize>(&self, cells: &[([i32; 3], u32)], values: &[[f32; C]]) -> Vec<[f32; C]> {
        let inverse = 1.0 / (self.width * self.width);
        let (peak, limit) = (inverse / (2.0 * PI), REACH * REACH * self.width * self.width);
        let mut out = vec![[0.0; C]; self.targets.len()];
        for (target, out) in self.targets.iter().zip(&mut out) {
            let [x, y, z] = cell(*target, self.width, self.origin);
            for dz in -1..=1 {
                for dy in -1..=1 {
                    let key = |dx: i32| [z + dz, y + dy, x + dx];
                    let first = cells.partition_point(|(k, _)| *k < key(-1));
                    for (k, j) in &cells[first..] {
                        if *k > key(1) {
                            break;
                        }
                        let r2 = target.distance_squared(self.sources[*j as usize]);
                        if r2 <= limit {
                            let g = peak * libm::expf(-0.5 * r2 * inverse);
                            let v = &values[*j as usize];
                            for c in 0..C {
                                out[c] += g * v[c];
                            }
                        }
                    }
                }
            }
        }
        out
    }
}

/// The cell of a point, x first; cells have the side of the reach.
fn cell(p: Vec3, width: f32, origin: Vec3) -> [i32; 3] {
    let cell = ((p - origin) / (REACH * width)).floor().clamp(Vec3::splat(-MAX_CELL), Vec3::splat(MAX_CELL));
    cell.to_array().map(|v| v as i32)
}

/// Sources with their cells (z, y, x), in order.
fn by_cell(sources: &[Vec3], width: f32, origin: Vec3) -> Vec<([i32; 3], u32)> {
    let key = |p: &Vec3| {
        let [x, y, z] = cell(*p, width, origin);
        [z, y, x]
    };
    let mut cells: Vec<_> = sources.iter().enumerate().map(|(j, p)| (key(p), j as u32)).collect();
    cells.sort_unstable();
    cells
}

/// The first node of a point's stencil, and the fraction of a node by which the point lies beyond the third.
#[inline(always)]
fn place(p: Vec3, width: f32, origin: Vec3) -> ([i64; 3], [f32; 3]) {
    let u = ((p - origin) / (SPACING * width)).clamp(Vec3::splat(-MAX_CELL), Vec3::splat(MAX_CELL));
    let whole = u.floor();
    (whole.to_array().map(|v| v as i64 - BELOW), (u - whole).to_array())
}

impl Lattice {
    /// The rows that sources spread to; `None` where they are too many.
    fn new(sources: &[Vec3], width: f32, origin: Vec3) -> Option<Self> {
        let (mut low, mut high) = ([i64::MAX; 2], [i64::MIN; 2]);
        for p in sources {
            let ([_, y, z], _) = place(*p, width, origin);
            for (axis, v) in [y, z].into_iter().enumerate() {
                low[axis] = low[axis].min(v);
                high[axis] = high[axis].max(v + STENCIL as i64);
            }
        }
        if sources.is_empty() {
            (low, high) = ([0; 2], [0; 2]);
        }
        let size = [high[0] - low[0], high[1] - low[1]];
        let count = usize::try_from(size[0].checked_mul(size[1])?).ok().filter(|n| *n <= MAX_NODES)?;
        let mut rows = vec![(i64::MAX, 0usize, i64::MIN); count];
        for p in sources {
            let ([x, y, z], _) = place(*p, width, origin);
            for dz in 0..STENCIL as i64 {
                for dy in 0..STENCIL as i64 {
                    let row = &mut rows[((z + dz - low[1]) * size[0] + y + dy - low[0]) as usize];
                    row.0 = row.0.min(x);
                    row.2 = row.2.max(x + STENCIL as i64);
                }
            }
        }
        let mut nodes = 0usize;
        for row in &mut rows {
            let length = if row.0 < row.2 { row.2 - row.0 } else { 0 };
            *row = (if length > 0 { row.0 } else { 0 }, nodes, length);
            nodes += length as usize;
            if nodes > MAX_NODES {
                return None;
            }
        }
        let table = std::array::from_fn(|m| {
            let a = (m as f32 - BELOW as f32) * SPACING;
            libm::expf(-a * a)
        });
        Some(Self { corner: low, size, rows, nodes, table })
    }

    /// Weights exp(−(a − f)²q) = exp(−a²q)·exp(2f·q)^a·exp(−f²q), q = h²/σ².
    #[inline(always)]
    fn stencil(&self, p: Vec3, width: f32, origin: Vec3) -> Stencil {
        let (first, fraction) = place(p, width, origin);
        let q = SPACING * SPACING;
        let mut weights = [[0.0; STENCIL]; 3];
        for axis in 0..3 {
            let f = fraction[axis];
            let (up, here) = (libm::expf(2.0 * f * q), libm::expf(-f * f * q));
            let down = 1.0 / up;
            let powers = [down * down, down, 1.0, up, up * up, up * up * up];
            for m in 0..STENCIL {
                weights[axis][m] = self.table[m] * powers[m] * here;
            }
        }
        Stencil { first, weights }
    }

    /// The row at (y, z), if sources spread to it.
    #[inline(always)]
    fn row(&self, y: i64, z: i64) -> Option<&(i64, usize, i64)> {
        let (y, z) = (y - self.corner[0], z - self.corner[1]);
        let within = y >= 0 && z >= 0 && y < self.size[0] && z < self.size[1];
        if within { Some(&self.rows[(z * self.size[0] + y) as usize]) } else { None }
    }
}

/// One sum through the lattice.
struct OverLattice<'s, 'a, const C: usize> {
    sum: &'s GaussianSum<'a>,
    lattice: &'s Lattice,
    values: &'s [[f32; C]],
}

impl<const C: usize> WithSimd for OverLattice<'_, '_, C> {
    type Output = Vec<[f32; C]>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Vec<[f32; C]> {
        let (sum, lattice) = (self.sum, self.lattice);
        let mut nodes = vec![[0.0f32; C]; lattice.nodes];
        for (p, v) in sum.sources.iter().zip(self.values) {
            let Stencil { first: [x, y, z], weights } = lattice.stencil(*p, sum.width, sum.origin);
            for dz in 0..STENCIL {
                for dy in 0..STENCIL {
                    let Some((low, start, _)) = lattice.row(y + dy as i64, z + dz as i64) else { continue };
                    let at = start + (x - low) as usize;
                    let run = &mut nodes[at..at + STENCIL];
                    let plane = weights[2][dz] * weights[1][dy];
                    for m in 0..STENCIL {
                        let w = plane * weights[0][m];
                        for c in 0..C {
                            run[m][c] += w * v[c];
                        }
                    }
                }
            }
        }
        let side = SPACING * (2.0 / PI).sqrt();
        let scale = side * side * side / (2.0 * PI * sum.width * sum.width);
        let mut out = vec![[0.0f32; C]; sum.targets.len()];
        for (p, out) in sum.targets.iter().zip(&mut out) {
            let Stencil { first: [x, y, z], weights } = lattice.stencil(*p, sum.width, sum.origin);
            for dz in 0..STENCIL {
                for dy in 0..STENCIL {
                    let Some((low, start, length)) = lattice.row(y + dy as i64, z + dz as i64) else { continue };
                    let plane = scale * weights[2][dz] * weights[1][dy];
                    let begin = (low - x).clamp(0, STENCIL as i64) as usize;
                    let end = (low + length - x).clamp(0, STENCIL as i64) as usize;
                    for m in begin..end {
                        let node = &nodes[start + (x + m as i64 - low) as usize];
                        let w = plane * weights[0][m];
                        for c in 0..C {
                            out[c] += w * node[c];
                        }
                    }
                }
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::surfel_transport as oracle;
    use proptest::prelude::*;

    fn points(count: usize, seed: u32, extent: f32) -> Vec<Vec3> {
        // A low-discrepancy sequence in the box, shifted by the seed.
        let at = |i: usize, a: f64| ((i as f64 + 0.37 * f64::from(seed)) * a).fract() as f32 * extent;
        let each = |i| Vec3::new(at(i, 0.819_172_513_4), at(i, 0.671_043_606_7), at(i, 0.549_700_478)) - 0.5 * extent;
        (0..count).map(each).collect()
    }

    /// Worst error of a sum, as a fraction of what [`GAUSSIAN_SUM_TOLERANCE`] is a fraction of.
    fn error(sources: &[Vec3], targets: &[Vec3], width: f32, lattice: bool) -> f64 {
        let values: Vec<[f32; 4]> =
            (0..sources.len()).map(|j| [1.0, j as f32 % 3.0 - 1.0, (j % 5) as f32, -0.5]).collect();
        let found = GaussianSum::new(sources, targets, width, Vec3::new(0.3, -0.2, 0.1), lattice).apply(&values);
        let wide = |p: &Vec3| p.to_array().map(f64::from);
        let (x, y): (Vec<_>, Vec<_>) = (targets.iter().map(wide).collect(), sources.iter().map(wide).collect());
        let flat: Vec<f64> = values.iter().flatten().map(|v| f64::from(*v)).collect();
        let expected = oracle::gaussian_sum(f64::from(width), &x, &y, &vec![1.0; y.len()], &flat, 4);
        let peak = oracle::plane_gaussian(0.0, f64::from(width));
        let mut worst = 0.0f64;
        for c in 0..4 {
            let total: f64 = values.iter().map(|v| f64::from(v[c].abs())).sum();
            for (i, found) in found.iter().enumerate() {
                worst = worst.max((f64::from(found[c]) - expected[4 * i + c]).abs() / (peak * total));
            }
        }
        worst
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// `[eq:gaussian-sum]`: one source, so that nothing averages out; both ways within the tolerance.
        #[test]
        fn one_source_is_within_the_tolerance(seed in 0u32..1000, width in 0.02f32..3.0) {
            for lattice in [false, true] {
                let e = error(&points(1, seed, 1.0), &points(200, seed + 1, 6.0 * width), width, lattice);
                prop_assert!(e <= f64::from(GAUSSIAN_SUM_TOLERANCE), "{lattice} {e}");
            }
        }

        /// `[eq:gaussian-sum]`: many sources.
        #[test]
        fn sums_are_within_the_tolerance(seed in 0u32..1000, width in 0.05f32..3.0) {
            for lattice in [false, true] {
                let e = error(&points(100, seed, 1.0), &points(50, seed + 1, 2.0), width, lattice);
                prop_assert!(e <= f64::from(GAUSSIAN_SUM_TOLERANCE), "{lattice} {e}");
            }
        }
    }

    /// Targets and sources exchanged: the transpose, to rounding, although each way has its own rows.
    #[test]
    fn the_other_direction_is_the_transpose() {
        let (a, b) = (points(60, 1, 1.0), points(40, 2, 1.5));
        for (width, lattice) in [(0.1, false), (0.1, true), (0.6, true)] {
            let u: Vec<[f32; 4]> = (0..b.len()).map(|i| [(i as f32 * 0.7).sin(); 4]).collect();
            let v: Vec<[f32; 4]> = (0..a.len()).map(|i| [(i as f32 * 1.3).cos() + 0.5; 4]).collect();
            let forward = GaussianSum::new(&a, &b, width, Vec3::ZERO, lattice).apply(&v);
            let back = GaussianSum::new(&b, &a, width, Vec3::ZERO, lattice).apply(&u);
            let dot = |p: &[[f32; 4]], q: &[[f32; 4]]| -> f64 {
                p.iter().zip(q).map(|(p, q)| f64::from(p[0]) * f64::from(q[0])).sum()
            };
            let magnitude: f64 = u.iter().zip(&forward).map(|(p, q)| f64::from((p[0] * q[0]).abs())).sum();
            assert!((dot(&u, &forward) - dot(&back, &v)).abs() <= 1e-5 * magnitude);
        }
    }

    #[test]
    fn places_far_away_and_no_places_are_no_harm() {
        let far = [Vec3::splat(1e30), Vec3::splat(-1e30), Vec3::ZERO];
        for lattice in [false, true] {
            let sum = GaussianSum::new(&far, &far, 0.1, Vec3::ZERO, lattice).apply(&[[1.0f32; 4]; 3]);
            assert!(sum.iter().flatten().all(|v| v.is_finite()));
            assert!(
                GaussianSum::new(&[], &far, 0.1, Vec3::ZERO, lattice)
                    .apply::<4>(&[])
                    .iter()
                    .flatten()
                    .all(|v| *v == 0.0)
            );
        }
    }
}
