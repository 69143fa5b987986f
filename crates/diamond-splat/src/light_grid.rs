//! Visibility of one light without a tree: all rays toward a light meet in it, so that in its view each ray is a point.
//!
//! Seen from a light (or along its direction, if it is at infinity) a Gaussian covers a small rectangle, and a ray lies
//! in one cell of a grid. The Gaussians whose rectangles reach into the cell are all that the ray can meet. They are
//! listed from the light outward, so that a ray is done where the first of them begins behind its receiver. Which
//! Gaussians count, and by how much, is decided as in [`GaussianBvh`](crate::GaussianBvh): the same numbers in another order of
//! multiplication. A whole light takes about a fifth of the time that rays through the tree take.
//!
//! A light must lie outside of the Gaussians, with all of them on one side; where it does not, there is no grid, and
//! rays through the tree are the answer.
use crate::bvh::{NO_BOX, WIDTH};
use crate::density::unit_rotation;
use crate::visibility::{
    MIN_TRANSMITTANCE, Occluder, Packet, Ray, check_lengths, occluder_alpha, ray_to_light, thickened,
};
use crate::{Gaussians, SplatError, VisibilityConfig};
use diamond_light::OlatLight;
use glam::{Mat3, Vec3};
use rayon::prelude::*;

/// A point light's Gaussians begin at least at this share of the distance to their middle, in front of it.
const NEAREST: f32 = 0.05;
/// Rectangles are widened by this share of the grid against rounding.
const MARGIN: f32 = 1e-4;
/// Cells along a side at most.
const MAX_CELLS: usize = 96;
/// Cells per mean rectangle of a Gaussian along a side: finer grids have shorter lists and more of them.
const CELLS_PER_RECTANGLE: f32 = 2.0;
/// Cells that are one task.
const CELLS_PER_TASK: usize = 32;

/// Gaussians as occluders, ready for any number of lights.
#[derive(Debug, Clone)]
pub struct LightGrid {
    occluders: Vec<Occluder>,
    /// Semi-axes of the ellipsoid at which an occluder ends, world.
    axes: Vec<[Vec3; 3]>,
    middle: Vec3,
}

/// A light's view: points to its plane.
struct Plane {
    light: Option<Vec3>,
    u: Vec3,
    v: Vec3,
    /// From the light into the scene.
    w: Vec3,
    nearest: f32,
}

/// A rectangle on the plane and where along the view it begins.
#[derive(Clone, Copy)]
struct Rectangle {
    low: [f32; 2],
    high: [f32; 2],
    begin: f32,
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

    /// In the light's axes, and the plane's coordinates.
    fn place(&self, point: Vec3) -> ([f32; 2], f32) {
        let p = point - self.light.unwrap_or(Vec3::ZERO);
        let (x, y, z) = (p.dot(self.u), p.dot(self.v), p.dot(self.w));
        if self.light.is_some() { ([x / z, y / z], z) } else { ([x, y], z) }
    }

    /// What the ellipsoid of semi-axes `axes` about `centre` covers; `None` if part of it is too near to the light.
    fn rectangle(&self, centre: Vec3, axes: &[Vec3; 3]) -> Option<Rectangle> {
        let half = |d: Vec3| Vec3::new(axes[0].dot(d), axes[1].dot(d), axes[2].dot(d)).length();
        let p = centre - self.light.unwrap_or(Vec3::ZERO);
        let (z, depth) = (p.dot(self.w), half(self.w));
        let begin = z - depth;
        let near_enough = begin >= self.nearest && (z + depth).is_finite();
        let side = |d: Vec3| {
            let (x, half) = (p.dot(d), half(d));
            match self.light {
                Some(_) => {
                    let (low, high) = (x - half, x + half);
                    ((low / begin).min(low / (z + depth)), (high / begin).max(high / (z + depth)))
                }
                None => (x - half, x + half),
            }
        };
        let (x, y) = (side(self.u), side(self.v));
        near_enough.then_some(Rectangle { low: [x.0, y.0], high: [x.1, y.1], begin })
    }
}

/// Items listed by cell, in the order in which they were given.
struct Cells {
    starts: Vec<u32>,
    items: Vec<u32>,
}

impl Cells {
    /// `each` calls its argument with every (item, cell).
    fn new(count: usize, each: impl Fn(&mut dyn FnMut(u32, usize))) -> Self {
        let mut starts = vec![0u32; count + 1];
        each(&mut |_, cell| starts[cell + 1] += 1);
        for cell in 0..count {
            starts[cell + 1] += starts[cell];
        }
        let mut items = vec![0; starts[count] as usize];
        let mut next = starts.clone();
        each(&mut |item, cell| {
            items[next[cell] as usize] = item;
            next[cell] += 1;
        });
        Self { starts, items }
    }

    fn of(&self, cell: usize) -> &[u32] {
        &self.items[self.starts[cell] as usize..self.starts[cell + 1] as usize]
    }
}

/// A regular grid on the plane.
struct Grid {
    low: [f32; 2],
    /// Cells per unit.
    scale: [f32; 2],
    size: [usize; 2],
}

impl Grid {
    /// Over the `points` of rays, with cells that fit the `rectangles`.
    fn new(points: &[[f32; 2]], rectangles: &[Option<Rectangle>]) -> Self {
        let mut grid = Self { low: [0.0; 2], scale: [0.0; 2], size: [1; 2] };
        for k in 0..2 {
            let low = points.iter().map(|p| p[k]).fold(f32::INFINITY, f32::min);
            let high = points.iter().map(|p| p[k]).fold(f32::NEG_INFINITY, f32::max);
            let range = high - low;
            let (sum, n) = rectangles.iter().flatten().fold((0.0, 0), |(s, n), r| (s + (r.high[k] - r.low[k]), n + 1));
            let cells = CELLS_PER_RECTANGLE * range / (sum / n.max(1) as f32);
            // The comparison is false for NaN and where there is nothing to divide.
            if range > 0.0 && cells > 1.0 {
                grid.size[k] = (cells as usize).clamp(1, MAX_CELLS);
                grid.scale[k] = grid.size[k] as f32 / range;
            }
            grid.low[k] = if low.is_finite() { low } else { 0.0 };
        }
        grid
    }

    fn line(&self, k: usize, value: f32) -> usize {
        // `as` saturates: below is 0, beyond is the last.
        (((value - self.low[k]) * self.scale[k]) as usize).min(self.size[k] - 1)
    }

    fn cell(&self, p: [f32; 2]) -> usize {
        self.line(1, p[1]) * self.size[0] + self.line(0, p[0])
    }

    /// Calls `f` with every cell that `r` reaches into.
    fn covered(&self, r: &Rectangle, f: &mut dyn FnMut(usize)) {
        let lines = |k: usize| {
            let margin = MARGIN * self.size[k] as f32 / self.scale[k].max(f32::MIN_POSITIVE);
            let margin = if self.scale[k] > 0.0 { margin } else { 0.0 };
            let end = self.low[k] + self.size[k] as f32 / self.scale[k].max(f32::MIN_POSITIVE) + margin;
            let outside = self.scale[k] > 0.0 && (r.high[k] + margin < self.low[k] || r.low[k] - margin > end);
            (!outside).then(|| self.line(k, r.low[k] - margin)..=self.line(k, r.high[k] + margin))
        };
        if let (Some(columns), Some(rows)) = (lines(0), lines(1)) {
            for y in rows {
                columns.clone().for_each(|x| f(y * self.size[0] + x));
            }
        }
    }
}

impl LightGrid {
    /// Prepares the Gaussians. Errors only where the arrays differ in length; Gaussians that are not finite never occlude.
    pub fn new(gaussians: &Gaussians) -> Result<Self, SplatError> {
        check_lengths(gaussians)?;
        let n = gaussians.len();
        let occluders: Vec<Occluder> = (0..n).map(|i| Occluder::new(gaussians, i)).collect();
        let axes = (0..n).map(|i| {
            let reach = occluders[i].max_q.max(0.0).sqrt();
            if reach == 0.0 {
                return [Vec3::ZERO; 3];
            }
            let rotation = Mat3::from_quat(unit_rotation(gaussians.rotations[i]));
            let s = thickened(gaussians.scales[i]) * reach;
            [rotation.x_axis * s.x, rotation.y_axis * s.y, rotation.z_axis * s.z]
        });
        let axes = axes.collect();
        let valid = || occluders.iter().filter(|o| o.max_q >= 0.0);
        let low = valid().map(|o| o.mean).fold(Vec3::INFINITY, Vec3::min);
        let high = valid().map(|o| o.mean).fold(Vec3::NEG_INFINITY, Vec3::max);
        let middle = 0.5 * low + 0.5 * high;
        let middle = if middle.is_finite() { middle } else { Vec3::ZERO };
        Ok(Self { occluders, axes, middle })
    }

    /// What [`GaussianBvh::visibility_subset`](crate::GaussianBvh::visibility_subset) gives for the Gaussians `receivers`,
    /// in their order, to rounding and to the transmittance of 1e-4 below which neither looks further. A receiver's bits
    /// depend neither on the other receivers nor on the number of threads. `None` where the light lies among or too near
    /// to the Gaussians.
    /// `[eq:ray-transmittance]`
    ///
    /// # Errors
    /// Other Gaussians than those it was made of; normals of another number; receivers beyond the last Gaussian.
    pub fn visibility(
        &self,
        gaussians: &Gaussians,
        normals: Option<&[Vec3]>,
        light: &OlatLight,
        config: &VisibilityConfig,
        receivers: &[u32],
    ) -> Result<Option<Vec<f32>>, SplatError> {
        self.check(gaussians, normals, receivers)?;
        let Some(plane) = Plane::new(light, self.middle) else { return Ok(None) };
        let rectangles: Vec<Option<Rectangle>> = (0..self.occluders.len())
            .into_par_iter()
            .with_min_len(1024)
            .map(|i| {
                let o = &self.occluders[i];
                (o.max_q >= 0.0).then(|| plane.rectangle(o.mean, &self.axes[i]))
            })
            .map(|r| match r {
                Some(None) => Err(()),
                Some(r) => Ok(r),
                None => Ok(None),
            })
            .collect::<Result<_, ()>>()
            .unwrap_or_default();
        if rectangles.len() != self.occluders.len() {
            return Ok(None);
        }
        let rays: Vec<Option<(Ray, [f32; 2], f32)>> = receivers
            .par_iter()
            .with_min_len(512)
            .map(|&i| {
                let ray = ray_to_light(gaussians, normals, light, config, i as usize)?;
                let (p, z) = plane.place(ray.origin);
                (p[0].is_finite() && p[1].is_finite() && z.is_finite()).then_some((ray, p, z))
            })
            .collect();
        if rays.iter().flatten().any(|(.., z)| *z < plane.nearest) {
            return Ok(None);
        }
        let mut order: Vec<(f32, u32)> =
            rectangles.iter().enumerate().filter_map(|(i, r)| r.map(|r| (r.begin, i as u32))).collect();
        order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let points: Vec<[f32; 2]> = rays.iter().flatten().map(|(_, p, _)| *p).collect();
        let grid = Grid::new(&points, &rectangles);
        let count = grid.size[0] * grid.size[1];
        let lists = Cells::new(count, |put| {
            for (rank, (_, i)) in order.iter().enumerate() {
                if let Some(r) = &rectangles[*i as usize] {
                    grid.covered(r, &mut |cell| put(rank as u32, cell));
                }
            }
        });
        let members = Cells::new(count, |put| {
            for (k, ray) in rays.iter().enumerate() {
                if let Some((_, p, _)) = ray {
                    put(k as u32, grid.cell(*p));
                }
            }
        });
        // Asked here: the setting belongs to the thread that called.
        let level = diamond_simd::Level::current();
        let traced: Vec<Vec<f32>> = (0..count.div_ceil(CELLS_PER_TASK))
            .into_par_iter()
            .map(|task| {
                let cells = task * CELLS_PER_TASK..count.min((task + 1) * CELLS_PER_TASK);
                let task = Task { grid: self, order: &order, lists: &lists, members: &members, rays: &rays, cells };
                level.dispatch(task)
            })
            .collect();
        let mut out = vec![1.0; receivers.len()];
        for (&k, v) in members.items.iter().zip(traced.iter().flatten()) {
            out[k as usize] = *v;
        }
        Ok(Some(out))
    }

    fn check(&self, gaussians: &Gaussians, normals: Option<&[Vec3]>, receivers: &[u32]) -> Result<(), SplatError> {
        check_lengths(gaussians)?;
        let n = self.occluders.len();
        let fail = |what, expected: String, found: String| Err(SplatError::Shape { what, expected, found });
        if gaussians.len() != n {
            return fail("LightGrid", format!("{n} (as when it was made)"), gaussians.len().to_string());
        }
        if let Some(normals) = normals.filter(|normals| normals.len() != n) {
            return fail("LightGrid, normals", format!("{n} (one per Gaussian)"), normals.len().to_string());
        }
        match receivers.iter().find(|&&i| i as usize >= n) {
            Some(bad) => fail("LightGrid, receivers", format!("indices below {n}"), bad.to_string()),
            None => Ok(()),
        }
    }
}

/// The rays of some cells, in the order of the cells' members.
struct Task<'a> {
    grid: &'a LightGrid,
    order: &'a [(f32, u32)],
    lists: &'a Cells,
    members: &'a Cells,
    rays: &'a [Option<(Ray, [f32; 2], f32)>],
    cells: std::ops::Range<usize>,
}

impl diamond_simd::WithSimd for Task<'_> {
    type Output = Vec<f32>;

    #[inline(always)]
    fn with_simd<S: diamond_simd::Simd>(self, _: S) -> Vec<f32> {
        let mut out = Vec::new();
        let mut packets: Vec<Packet> = Vec::new();
        for cell in self.cells.clone() {
            let list = self.lists.of(cell);
            packets.clear();
            for &k in self.members.of(cell) {
                let Some((ray, _, z)) = &self.rays[k as usize] else { continue };
                // Nothing that begins behind the receiver lies between it and the light.
                let behind = z + MARGIN * z.abs();
                let mut transmittance = 1.0f32;
                'list: for (at, ranks) in list.chunks(WIDTH).enumerate() {
                    if self.order[ranks[0] as usize].0 > behind {
                        break;
                    }
                    if at == packets.len() {
                        let mut indices = [NO_BOX; WIDTH];
                        indices.iter_mut().zip(ranks).for_each(|(i, &rank)| *i = self.order[rank as usize].1);
                        packets.push(Packet::of(&self.grid.occluders, &indices));
                    }
                    let packet = &packets[at];
                    let (peaks, mut counting) = packet.peaks(ray.skip, ray.origin, ray.direction, ray.begin, ray.end);
                    while counting != 0 {
                        let lane = counting.trailing_zeros() as usize;
                        counting &= counting - 1;
                        transmittance *= 1.0 - occluder_alpha(packet.opacity[lane], peaks[lane]);
                        // After each, so that the result does not depend on how the list is cut into packets.
                        if transmittance < MIN_TRANSMITTANCE {
                            break 'list;
                        }
                    }
                }
                out.push(transmittance);
            }
        }
        out
    }
}
