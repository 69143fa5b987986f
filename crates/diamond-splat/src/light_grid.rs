//! Visibility of one light without a tree: all rays toward a light meet in it, so that in its view each ray is a point.
//!
//! Seen from a light (or along its direction, if it is at infinity) a Gaussian covers a small rectangle, and a ray lies in
//! one cell of a grid. The Gaussians whose rectangles reach into the cell are all that the ray can meet. They are listed
//! from the light outward, so that the rays of a cell, a vector of them at a time, are done where the next Gaussian begins
//! behind them. Which Gaussians count, and by how much, is decided as in [`GaussianBvh`](crate::GaussianBvh), but in the
//! light's coordinates, where a squared distance from a ray is a quotient of two conics.
//!
//! A light must lie outside of the Gaussians, with all of them on one side; where it does not, there is no grid, and rays
//! through the tree are the answer.
use crate::density::unit_rotation;
use crate::recycle::Pool;
use crate::visibility::{
    MAX_OCCLUDER_ALPHA, MIN_OCCLUDER_ALPHA, MIN_TRANSMITTANCE, Occluder, check_lengths, ray_origin, thickened,
};
use crate::{Gaussians, SplatError, VisibilityConfig};
use diamond_light::OlatLight;
use diamond_simd::{Lanes, Level, Simd, WithSimd, exp2};
use glam::{Mat3, Vec3};
use rayon::prelude::*;

/// A point light's Gaussians begin at least at this share of the distance to their middle, in front of it.
const NEAREST: f32 = 0.05;
/// Rectangles are widened, and Gaussians taken to begin earlier, by this share of the grid or of the depth: rounding.
const MARGIN: f32 = 1e-4;
/// Rays of a cell, about: lists are longer in larger cells; in smaller ones the rays of a vector begin at very different
/// depths.
const RAYS_PER_CELL: f32 = 32.0;
/// Cells along a side at most; a number of a cell is a `u16`.
const MAX_CELLS: usize = 128;
/// Half a side of the grid in standard deviations of the Gaussians' places; what lies beyond belongs to the cells at the
/// edge.
const GRID_REACH: f32 = 2.5;
/// Depths that are told apart in the lists, `u16`s.
const DEPTHS: usize = 1024;
/// Cells that are one task.
const CELLS_PER_TASK: usize = 64;
/// Gaussians that are seen from a light in one task.
const OCCLUDERS_PER_TASK: usize = 2048;
/// Occluders of a list that go through the stages of a ray together.
const CHUNK: usize = 64;
/// Indices up to here are `f32`s.
const MAX_GAUSSIANS: usize = 1 << 24;
/// Lanes of the widest vector.
const MAX_LANES: usize = 16;

/// Columns of what is known of the occluders.
mod column {
    /// Mean, world.
    pub const MEAN: usize = 0;
    /// Three semi-axes of the ellipsoid at which an occluder ends, world.
    pub const AXES: usize = 3;
    /// World → units of standard deviations, three columns, relative to the largest of its numbers.
    pub const LOCAL: usize = 12;
    /// The square of that largest number.
    pub const SQUARE: usize = 21;
    pub const COUNT: usize = 22;
}

/// Gaussians as occluders and receivers, ready for any number of lights.
#[derive(Debug, Clone)]
pub struct LightGrid {
    /// Those that occlude anything.
    occluders: Vec<u32>,
    /// By [`column`], of the occluders; filled up with the last to whole vectors.
    columns: [Vec<f32>; column::COUNT],
    /// Logarithm to base 2 of the opacity, and squared reach in standard deviations, of the occluders.
    opacity: Vec<[f32; 2]>,
    receivers: Vec<Receiver>,
    /// Where rays without a normal begin, standard deviations.
    light_offset: f32,
    middle: Vec3,
}

/// Where a Gaussian's rays toward lights begin.
#[derive(Debug, Clone, Copy)]
struct Receiver {
    origin: Vec3,
    /// Scaled axes, for Gaussians without a normal.
    free: Option<Mat3>,
}

/// An occluder in a light's view. Places are (x, y) on its plane, and `e` is a ray's place less the occluder's.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(16))]
struct Seen {
    at: [f32; 2],
    /// Squared distance times `1 + …`: coefficients of e_x², e_x·e_y, e_y².
    distance: [f32; 3],
    /// Of e_x, e_y, e_x², e_x·e_y, e_y² in what the squared distance is divided by, besides 1.
    divisor: [f32; 5],
    /// Depth of the peak times the divisor: 1, e_x, e_y.
    peak: [f32; 3],
    log2_opacity: f32,
    /// Squared reach, standard deviations.
    max_q: f32,
    index: f32,
    /// Where it begins.
    begin: f32,
    low: [f32; 2],
    high: [f32; 2],
}

static SEEN: Pool<Seen> = Pool::new();

/// A light's view: points to its plane.
struct Plane {
    light: Option<Vec3>,
    u: Vec3,
    v: Vec3,
    /// From the light into the scene.
    w: Vec3,
    nearest: f32,
}

/// A ray toward the light.
#[derive(Debug, Clone, Copy)]
struct Ray {
    at: [f32; 2],
    /// Occluders count up to this depth.
    end: f32,
}

impl Plane {
    fn new(light: &OlatLight, middle: Vec3) -> Option<Self> {
        let (w, position, nearest) = match *light {
            OlatLight::Point { position, .. } => {
                let toward = middle - position;
                (toward.try_normalize()?, Some(position), NEAREST * toward.length())
            }
            OlatLight::Directional { direction, .. } => (-direction.try_normalize()?, None, f32::NEG_INFINITY),
        };
        let (u, v) = w.any_orthonormal_pair();
        Some(Self { light: position, u, v, w, nearest })
    }

    /// `None` where the ray does not begin in front of the light.
    fn ray(&self, receiver: &Receiver, light_offset: f32) -> Option<Ray> {
        let p = receiver.origin - self.light.unwrap_or(Vec3::ZERO);
        let (x, y, z) = (p.dot(self.u), p.dot(self.v), p.dot(self.w));
        let length = if self.light.is_some() { p.length() } else { 1.0 };
        // Depth per unit of the way toward the light.
        let slope = if self.light.is_some() { z / length } else { 1.0 };
        let begin = receiver.free.map_or(0.0, |axes| {
            let direction = if self.light.is_some() { p / length } else { self.w };
            light_offset * (axes.transpose() * direction).length()
        });
        let at = if self.light.is_some() { [x / z, y / z] } else { [x, y] };
        let ray = Ray { at, end: z - begin * slope };
        (z >= self.nearest && at[0].is_finite() && at[1].is_finite() && ray.end.is_finite()).then_some(ray)
    }
}

/// Sees the occluders `first..first + to.len()` from a light; whether all of them are in front of it and finite.
struct See<'a> {
    grid: &'a LightGrid,
    plane: &'a Plane,
    first: usize,
    to: &'a mut [Seen],
}

impl WithSimd for See<'_> {
    type Output = bool;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> bool {
        let Self { grid, plane, first, to } = self;
        let (u, v, w) = (vector(s, plane.u), vector(s, plane.v), vector(s, plane.w));
        let light = vector(s, plane.light.unwrap_or(Vec3::ZERO));
        let one = Lanes::splat(s, 1.0);
        let mut fine = true;
        for (block, to) in to.chunks_mut(S::F32_LANES).enumerate() {
            let i = first + block * S::F32_LANES;
            let at = triple(s, grid, column::MEAN, i);
            let p = [at[0] - light[0], at[1] - light[1], at[2] - light[2]];
            let (x, y, z) = (dot(&p, &u), dot(&p, &v), dot(&p, &w));
            let axes = [
                triple(s, grid, column::AXES, i),
                triple(s, grid, column::AXES + 3, i),
                triple(s, grid, column::AXES + 6, i),
            ];
            let (half_x, half_y, half_z) = (half(&axes, &u), half(&axes, &v), half(&axes, &w));
            let local = [
                triple(s, grid, column::LOCAL, i),
                triple(s, grid, column::LOCAL + 3, i),
                triple(s, grid, column::LOCAL + 6, i),
            ];
            let (a, b) = (apply(&local, &u), apply(&local, &v));
            let square = Lanes::load(s, &grid.columns[column::SQUARE][i..]);
            let (near, far) = (z - half_z, z + half_z);
            let (x_low, x_high, y_low, y_high) = (x - half_x, x + half_x, y - half_y, y + half_y);
            let lamp = plane.light.is_some();
            let inverse_z = if lamp { one / z } else { one };
            let (low, high) = if lamp {
                let (near, far) = (one / near, one / far);
                (
                    [(x_low * near).min(x_low * far), (y_low * near).min(y_low * far)],
                    [(x_high * near).max(x_high * far), (y_high * near).max(y_high * far)],
                )
            } else {
                ([x_low, y_low], [x_high, y_high])
            };
            // Along the ray through the mean, and what changes beside it.
            let along = if lamp { apply(&local, &p) } else { apply(&local, &w) };
            let d = [along[0] * inverse_z, along[1] * inverse_z, along[2] * inverse_z];
            let inverse = one / dot(&d, &d);
            let (g_x, g_y) = (dot(&d, &a) * inverse, dot(&d, &b) * inverse);
            let (across_x, across_y) = (cross(&d, &a), cross(&d, &b));
            let scale = if lamp { z * z * square * inverse } else { square * inverse };
            let distance = [
                scale * dot(&across_x, &across_x),
                scale * dot(&across_x, &across_y) * 2.0,
                scale * dot(&across_y, &across_y),
            ];
            let zero = Lanes::splat(s, 0.0);
            let (divisor, peak) = if lamp {
                let h = [dot(&a, &a) * inverse, dot(&a, &b) * inverse * 2.0, dot(&b, &b) * inverse];
                ([g_x * 2.0, g_y * 2.0, h[0], h[1], h[2]], [z, z * g_x, z * g_y])
            } else {
                ([zero; 5], [z, -g_x, -g_y])
            };
            let numbers = [
                x * inverse_z,
                y * inverse_z,
                distance[0],
                distance[1],
                distance[2],
                divisor[0],
                divisor[1],
                divisor[2],
                divisor[3],
                divisor[4],
                peak[0],
                peak[1],
                peak[2],
                near,
                low[0],
                low[1],
                high[0],
                high[1],
            ];
            let mut stored = [[0.0f32; MAX_LANES]; 18];
            for (stored, number) in stored.iter_mut().zip(&numbers) {
                number.store(stored);
            }
            for (lane, to) in to.iter_mut().enumerate() {
                let n = |k: usize| stored[k][lane];
                let [log2_opacity, max_q] = grid.opacity[i + lane];
                *to = Seen {
                    at: [n(0), n(1)],
                    distance: [n(2), n(3), n(4)],
                    divisor: [n(5), n(6), n(7), n(8), n(9)],
                    peak: [n(10), n(11), n(12)],
                    log2_opacity,
                    max_q,
                    index: grid.occluders[i + lane] as f32,
                    begin: n(13),
                    low: [n(14), n(15)],
                    high: [n(16), n(17)],
                };
                let sum: f32 = (0..stored.len()).map(|k| stored[k][lane].abs()).sum();
                fine &= to.begin >= plane.nearest && sum.is_finite();
            }
        }
        fine
    }
}

#[inline(always)]
fn vector<S: Simd>(s: S, v: Vec3) -> [Lanes<S>; 3] {
    [Lanes::splat(s, v.x), Lanes::splat(s, v.y), Lanes::splat(s, v.z)]
}

#[inline(always)]
fn triple<S: Simd>(s: S, grid: &LightGrid, column: usize, i: usize) -> [Lanes<S>; 3] {
    let c = &grid.columns;
    [Lanes::load(s, &c[column][i..]), Lanes::load(s, &c[column + 1][i..]), Lanes::load(s, &c[column + 2][i..])]
}

#[inline(always)]
fn dot<S: Simd>(a: &[Lanes<S>; 3], b: &[Lanes<S>; 3]) -> Lanes<S> {
    a[0].mul_add(b[0], a[1].mul_add(b[1], a[2] * b[2]))
}

#[inline(always)]
fn cross<S: Simd>(a: &[Lanes<S>; 3], b: &[Lanes<S>; 3]) -> [Lanes<S>; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Half of what an ellipsoid with these semi-axes covers along a direction.
#[inline(always)]
fn half<S: Simd>(axes: &[[Lanes<S>; 3]; 3], direction: &[Lanes<S>; 3]) -> Lanes<S> {
    let along = [dot(&axes[0], direction), dot(&axes[1], direction), dot(&axes[2], direction)];
    dot(&along, &along).sqrt()
}

/// A matrix of three columns times a vector.
#[inline(always)]
fn apply<S: Simd>(m: &[[Lanes<S>; 3]; 3], x: &[Lanes<S>; 3]) -> [Lanes<S>; 3] {
    [
        m[0][0].mul_add(x[0], m[1][0].mul_add(x[1], m[2][0] * x[2])),
        m[0][1].mul_add(x[0], m[1][1].mul_add(x[1], m[2][1] * x[2])),
        m[0][2].mul_add(x[0], m[1][2].mul_add(x[1], m[2][2] * x[2])),
    ]
}

/// Items listed by cell, in the order in which they were given.
struct Cells {
    starts: Vec<u32>,
    items: Vec<u32>,
}

impl Cells {
    /// Of every (item, cell).
    fn new(count: usize, each: impl Iterator<Item = (u32, usize)> + Clone) -> Self {
        let mut next = vec![0u32; count + 1];
        each.clone().for_each(|(_, cell)| next[cell + 1] += 1);
        for cell in 0..count {
            next[cell + 1] += next[cell];
        }
        let starts = next.clone();
        let mut items = vec![0; starts[count] as usize];
        each.for_each(|(item, cell)| {
            items[next[cell] as usize] = item;
            next[cell] += 1;
        });
        Self { starts, items }
    }

    fn of(&self, cell: usize) -> &[u32] {
        &self.items[self.starts[cell] as usize..self.starts[cell + 1] as usize]
    }
}

/// A regular grid on the plane, and the depths that are told apart.
struct Grid {
    low: [f32; 2],
    /// Cells per unit.
    scale: [f32; 2],
    /// Cells along a side.
    side: usize,
    nearest: f32,
    /// Depths per unit.
    depths: f32,
}

impl Grid {
    /// Fits the occluders, so that it does not depend on who asks.
    fn new(seen: &[Seen], receivers: usize) -> Self {
        let side = (receivers as f32 / RAYS_PER_CELL).sqrt() as usize;
        let n = seen.len().max(1) as f32;
        let (mut low, mut scale) = ([0.0; 2], [0.0; 2]);
        let side = side.clamp(1, MAX_CELLS);
        let (mut sum, mut first, mut last) = ([0.0f32; 2], [f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
        let (mut nearest, mut farthest) = (f32::INFINITY, f32::NEG_INFINITY);
        for s in seen {
            for k in 0..2 {
                sum[k] += s.at[k];
                (first[k], last[k]) = (first[k].min(s.low[k]), last[k].max(s.high[k]));
            }
            (nearest, farthest) = (nearest.min(s.begin), farthest.max(s.begin));
        }
        let mean = sum.map(|sum| sum / n);
        let mut squares = [0.0f32; 2];
        for s in seen {
            for k in 0..2 {
                squares[k] += (s.at[k] - mean[k]) * (s.at[k] - mean[k]);
            }
        }
        for k in 0..2 {
            let reach = GRID_REACH * (squares[k] / n).sqrt();
            let (begin, end) = (first[k].max(mean[k] - reach), last[k].min(mean[k] + reach));
            let cells = side as f32 / (end - begin);
            // Else everything is in one line of cells.
            if end > begin && cells.is_finite() {
                (low[k], scale[k]) = (begin, cells);
            }
        }
        let depths = (DEPTHS - 1) as f32 / (farthest - nearest);
        let depths = if depths.is_finite() { depths } else { 0.0 };
        Self { low, scale, side, nearest, depths }
    }

    fn line(&self, k: usize, value: f32) -> usize {
        // `as` saturates: below is 0, beyond is the last.
        (((value - self.low[k]) * self.scale[k]) as usize).min(self.side - 1)
    }

    fn cell(&self, at: [f32; 2]) -> usize {
        self.line(1, at[1]) * self.side + self.line(0, at[0])
    }

    fn margin(&self, k: usize) -> f32 {
        if self.scale[k] > 0.0 { MARGIN * self.side as f32 / self.scale[k] } else { 0.0 }
    }

    /// First and last cell along a side.
    fn lines(&self, k: usize, seen: &Seen) -> (usize, usize) {
        let margin = self.margin(k);
        (self.line(k, seen.low[k] - margin), self.line(k, seen.high[k] + margin))
    }

    fn depth(&self, z: f32) -> usize {
        (((z - self.nearest) * self.depths) as usize).min(DEPTHS - 1)
    }

    /// Nothing later in a list begins before this.
    fn begin_of_rest(&self, begin: f32) -> f32 {
        let depth = if self.depths > 0.0 { 1.0 / self.depths } else { 0.0 };
        begin - depth - MARGIN * begin.abs()
    }
}

impl LightGrid {
    /// Prepares the Gaussians, with outward `normals` if any (one per Gaussian; those of zero length count as absent).
    ///
    /// # Errors
    /// Arrays that differ in length. Gaussians that are not finite never occlude.
    pub fn new(gaussians: &Gaussians, normals: Option<&[Vec3]>, config: &VisibilityConfig) -> Result<Self, SplatError> {
        check_lengths(gaussians)?;
        let n = gaussians.len();
        if let Some(normals) = normals.filter(|normals| normals.len() != n) {
            return Err(SplatError::Shape {
                what: "LightGrid, normals",
                expected: format!("{n} (one per Gaussian)"),
                found: normals.len().to_string(),
            });
        }
        let mut columns: [Vec<f32>; column::COUNT] = Default::default();
        let (mut occluders, mut opacity) = (Vec::new(), Vec::new());
        let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for i in 0..n {
            let o = Occluder::new(gaussians, i);
            if o.max_q < 0.0 {
                continue;
            }
            (low, high) = (low.min(o.mean), high.max(o.mean));
            occluders.push(i as u32);
            opacity.push([libm::log2f(o.opacity), o.max_q]);
            let rotation = Mat3::from_quat(unit_rotation(gaussians.rotations[i]));
            let axes = rotation * Mat3::from_diagonal(thickened(gaussians.scales[i]) * o.max_q.sqrt());
            let local = o.to_local.to_cols_array();
            let largest = local.iter().fold(f32::MIN_POSITIVE, |m, v| m.max(v.abs()));
            let numbers = o.mean.to_array().into_iter().chain(axes.to_cols_array());
            let numbers = numbers.chain(local.map(|v| v / largest)).chain([largest * largest]);
            columns.iter_mut().zip(numbers).for_each(|(column, v)| column.push(v));
        }
        for column in &mut columns {
            let last = column.last().copied().unwrap_or(0.0);
            column.resize(column.len() + MAX_LANES, last);
        }
        let middle = 0.5 * low + 0.5 * high;
        let receivers = (0..n).map(|i| {
            let (origin, has_normal) = ray_origin(gaussians, normals, config, i);
            let axes =
                || Mat3::from_quat(unit_rotation(gaussians.rotations[i])) * Mat3::from_diagonal(gaussians.scales[i]);
            Receiver { origin, free: (!has_normal).then(axes) }
        });
        Ok(Self {
            receivers: receivers.collect(),
            occluders,
            columns,
            opacity,
            light_offset: config.light_offset,
            middle: if middle.is_finite() { middle } else { Vec3::ZERO },
        })
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.receivers.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.receivers.is_empty()
    }

    /// What [`GaussianBvh::visibility_subset`](crate::GaussianBvh::visibility_subset) gives for the Gaussians `receivers`,
    /// in their order, to rounding and to the transmittance of 1e-4 below which neither looks further. A receiver's bits
    /// depend neither on the other receivers nor on the number of threads. `None` where the light lies among or too near
    /// to the Gaussians, or a Gaussian is too large or too small for the light's coordinates.
    /// `[eq:ray-transmittance]`
    ///
    /// # Errors
    /// Receivers beyond the last Gaussian.
    pub fn visibility(&self, light: &OlatLight, receivers: &[u32]) -> Result<Option<Vec<f32>>, SplatError> {
        if let Some(bad) = receivers.iter().find(|&&i| i as usize >= self.len()) {
            return Err(SplatError::Shape {
                what: "LightGrid, receivers",
                expected: format!("indices below {}", self.len()),
                found: bad.to_string(),
            });
        }
        if self.len() > MAX_GAUSSIANS {
            return Ok(None);
        }
        let Some(plane) = Plane::new(light, self.middle) else { return Ok(None) };
        // Asked here: the setting belongs to the thread that called.
        let level = Level::current();
        let mut seen = SEEN.take();
        seen.resize(self.occluders.len(), Seen::default());
        let fine = seen
            .par_chunks_mut(OCCLUDERS_PER_TASK)
            .enumerate()
            .map(|(task, to)| level.dispatch(See { grid: self, plane: &plane, first: task * OCCLUDERS_PER_TASK, to }));
        let visibility = if fine.reduce(|| true, |a, b| a & b) {
            let rays = receivers.iter().map(|&i| plane.ray(&self.receivers[i as usize], self.light_offset));
            let rays: Option<Vec<Ray>> = rays.collect();
            rays.map(|rays| self.trace(level, &mut seen, &rays, receivers))
        } else {
            None
        };
        SEEN.give(seen);
        Ok(visibility)
    }

    fn trace(&self, level: Level, seen: &mut [Seen], rays: &[Ray], receivers: &[u32]) -> Vec<f32> {
        let grid = Grid::new(seen, self.len());
        let count = grid.side * grid.side;
        let depths: Vec<u16> = seen.iter().map(|s| grid.depth(s.begin) as u16).collect();
        let by_depth = Cells::new(DEPTHS, (0..).zip(depths.iter().map(|&depth| usize::from(depth))));
        // Left, right, top, bottom.
        let reached: Vec<[u8; 4]> = (by_depth.items.iter())
            .map(|&i| {
                let s = &seen[i as usize];
                let ((left, right), (top, bottom)) = (grid.lines(0, s), grid.lines(1, s));
                [left as u8, right as u8, top as u8, bottom as u8]
            })
            .collect();
        let side = grid.side;
        let cells_of = |(&i, reached): (&u32, &[u8; 4])| {
            let [left, right, top, bottom] = reached.map(usize::from);
            (top..bottom + 1).flat_map(move |y| (y * side + left..y * side + right + 1).map(move |cell| (i, cell)))
        };
        let lists = Cells::new(count, by_depth.items.iter().zip(&reached).flat_map(cells_of));
        seen.iter_mut().for_each(|s| s.begin = grid.begin_of_rest(s.begin));
        let seen = &*seen;
        let places: Vec<[u16; 2]> =
            rays.iter().map(|ray| [grid.depth(ray.end) as u16, grid.cell(ray.at) as u16]).collect();
        let by_depth = Cells::new(DEPTHS, (0..).zip(places.iter().map(|place| usize::from(place[0]))));
        let cell_of = |&k: &u32| (k, usize::from(places[k as usize][1]));
        let members = Cells::new(count, by_depth.items.iter().map(cell_of));
        let traced: Vec<Vec<(u32, f32)>> = (0..count.div_ceil(CELLS_PER_TASK))
            .into_par_iter()
            .map(|task| {
                let cells = task * CELLS_PER_TASK..count.min((task + 1) * CELLS_PER_TASK);
                level.dispatch(Trace { grid: &grid, seen, lists: &lists, members: &members, rays, receivers, cells })
            })
            .collect();
        let mut out = vec![1.0; rays.len()];
        for &(k, v) in traced.iter().flatten() {
            out[k as usize] = v;
        }
        out
    }
}

/// The rays of some cells, in the order of the cells' members.
struct Trace<'a> {
    grid: &'a Grid,
    seen: &'a [Seen],
    lists: &'a Cells,
    members: &'a Cells,
    rays: &'a [Ray],
    receivers: &'a [u32],
    cells: std::ops::Range<usize>,
}

impl WithSimd for Trace<'_> {
    type Output = Vec<(u32, f32)>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> Vec<(u32, f32)> {
        let members = self.members.starts[self.cells.start]..self.members.starts[self.cells.end];
        let mut out = Vec::with_capacity(members.len());
        let mut candidates = [0u32; CHUNK];
        let mut quotients = [[[0.0f32; MAX_LANES]; 2]; CHUNK];
        let mut opacities = [0.0f32; CHUNK];
        for cell in self.cells.clone() {
            let list = self.lists.of(cell);
            for rays in self.members.of(cell).chunks(S::F32_LANES) {
                let mut numbers = [[0.0f32; MAX_LANES]; 4];
                let mut farthest = f32::NEG_INFINITY;
                let (mut low, mut high) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
                for (lane, &k) in rays.iter().enumerate() {
                    let ray = &self.rays[k as usize];
                    farthest = farthest.max(ray.end);
                    for k in 0..2 {
                        (low[k], high[k]) = (low[k].min(ray.at[k]), high[k].max(ray.at[k]));
                    }
                    numbers[0][lane] = ray.at[0];
                    numbers[1][lane] = ray.at[1];
                    numbers[2][lane] = ray.end;
                    numbers[3][lane] = self.receivers[k as usize] as f32;
                }
                for k in 0..2 {
                    let margin = self.grid.margin(k);
                    (low[k], high[k]) = (low[k] - margin, high[k] + margin);
                }
                // Lanes without a ray: nothing lies in front of them.
                numbers[2][rays.len()..].fill(f32::NEG_INFINITY);
                let [x, y, end, receiver] = &numbers;
                let (x, y) = (Lanes::load(s, x), Lanes::load(s, y));
                let (end, receiver) = (Lanes::load(s, end), Lanes::load(s, receiver));
                let mut transmittance = Lanes::splat(s, 1.0);
                let half = Lanes::splat(s, 0.5);
                let least = Lanes::splat(s, MIN_TRANSMITTANCE);
                let (nothing, one, zero) = (Lanes::splat(s, f32::MAX), Lanes::splat(s, 1.0), Lanes::splat(s, 0.0));
                // Each stage appends to what the next reads, without a branch that depends on the data.
                for list in list.chunks(CHUNK) {
                    if self.seen[list[0] as usize].begin > farthest {
                        break;
                    }
                    let mut near = 0;
                    for &i in list {
                        let o = &self.seen[i as usize];
                        let beside = (o.low[0] > high[0])
                            | (o.high[0] < low[0])
                            | (o.low[1] > high[1])
                            | (o.high[1] < low[1])
                            | (o.begin > farthest);
                        candidates[near] = i;
                        near += usize::from(!beside);
                    }
                    let mut met = 0;
                    for &i in &candidates[..near] {
                        let o = &self.seen[i as usize];
                        let (e_x, e_y) = (x - o.at[0], y - o.at[1]);
                        let [xx, xy, yy] = o.distance;
                        let q = (e_x * xx).mul_add(e_x, (e_x * xy + e_y * yy) * e_y);
                        let [d_x, d_y, d_xx, d_xy, d_yy] = o.divisor;
                        let divisor = (e_x * d_xx + d_x).mul_add(e_x, (e_x * d_xy + (e_y * d_yy + d_y)) * e_y) + 1.0;
                        let peak = e_x * o.peak[1] + (e_y * o.peak[2] + o.peak[0]);
                        // Comparisons are false for NaN, which thus never occludes.
                        let counts =
                            q.lt(divisor * o.max_q) & peak.lt(end * divisor) & (receiver - o.index).abs().gt(half);
                        counts.select(q, nothing).store(&mut quotients[met][0]);
                        counts.select(divisor, one).store(&mut quotients[met][1]);
                        opacities[met] = o.log2_opacity;
                        met += usize::from(counts.any());
                    }
                    for (quotient, log2_opacity) in quotients[..met].iter().zip(&opacities) {
                        let q = (Lanes::load(s, &quotient[0]) / Lanes::load(s, &quotient[1])).max(zero);
                        let alpha = exp2(q * (-0.5 * std::f32::consts::LOG2_E) + *log2_opacity);
                        let alpha = alpha.min(alpha.same(MAX_OCCLUDER_ALPHA));
                        let alpha = alpha * (alpha * (1.0 / MIN_OCCLUDER_ALPHA) - 1.0).clamp(0.0, 1.0);
                        // Who lets nothing through stays as it is.
                        let open = transmittance.ge(least);
                        transmittance = open.select(transmittance.neg_mul_add(alpha, transmittance), transmittance);
                    }
                    if !transmittance.ge(least).any() {
                        break;
                    }
                }
                let mut stored = [0.0; MAX_LANES];
                transmittance.store(&mut stored);
                out.extend(rays.iter().copied().zip(stored));
            }
        }
        out
    }
}
