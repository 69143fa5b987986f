//! Which surfel stands for a place of the surface: the nearest, unless it faces another way.
use crate::{Patch, PathtraceError};
use glam::Vec3;

/// How much farther than it is a surfel counts that faces away: with normals apart by the angle θ the squared distance is multiplied by
/// 1 + this·(1 − cos θ). Keeps exits on their side of thin parts.
const TURNED_AWAY: f32 = 6.0;

/// Cells along each axis at most.
const MAX_CELLS: usize = 256;

/// Surfels sorted into the cells of a grid.
#[derive(Debug)]
pub(crate) struct SurfelGrid {
    low: Vec3,
    cell: f32,
    size: [usize; 3],
    starts: Vec<u32>,
    members: Vec<u32>,
    /// Positions and normals in the order of `members`.
    places: Vec<(Vec3, Vec3)>,
}

/// `Ok` for at least one patch, all of them finite.
pub(crate) fn check_patches(patches: &[Patch]) -> Result<(), PathtraceError> {
    let sound = |p: &Patch| {
        let unit = (p.normal.length_squared() - 1.0).abs() < 1e-3;
        p.position.is_finite() && unit && p.area > 0.0 && p.area.is_finite()
    };
    let bad = patches.iter().position(|p| !sound(p));
    if bad.is_none() && !patches.is_empty() && u32::try_from(patches.len()).is_ok() {
        return Ok(());
    }
    Err(PathtraceError::Shape {
        what: "patches",
        expected: "at least one, fewer than 2³², finite, with unit normals and areas > 0".into(),
        found: bad.map_or_else(|| format!("{}", patches.len()), |k| format!("{:?} at index {k}", patches[k])),
    })
}

impl SurfelGrid {
    pub fn new(patches: &[Patch]) -> Result<Self, PathtraceError> {
        check_patches(patches)?;
        let low = patches.iter().fold(Vec3::INFINITY, |a, p| a.min(p.position));
        let high = patches.iter().fold(Vec3::NEG_INFINITY, |a, p| a.max(p.position));
        let area: f64 = patches.iter().map(|p| f64::from(p.area)).sum();
        let extent = (high - low).max_element();
        // About two surfels in a cell that the surface crosses.
        let wanted = (2.0 * area / patches.len() as f64).sqrt() as f32;
        let cell = wanted.max(extent / MAX_CELLS as f32).max(f32::MIN_POSITIVE);
        let size = ((high - low) / cell).to_array().map(|n| (n as usize).min(MAX_CELLS) + 1);
        let mut grid = Self { low, cell, size, starts: Vec::new(), members: Vec::new(), places: Vec::new() };
        let cells: Vec<usize> = patches.iter().map(|p| grid.index(grid.cell_of(p.position))).collect();
        let mut starts = vec![0u32; size[0] * size[1] * size[2] + 1];
        cells.iter().for_each(|c| starts[c + 1] += 1);
        (1..starts.len()).for_each(|k| starts[k] += starts[k - 1]);
        let mut next = starts.clone();
        let mut members = vec![0u32; patches.len()];
        for (k, &c) in cells.iter().enumerate() {
            members[next[c] as usize] = k as u32;
            next[c] += 1;
        }
        grid.places = members.iter().map(|k| (patches[*k as usize].position, patches[*k as usize].normal)).collect();
        (grid.starts, grid.members) = (starts, members);
        Ok(grid)
    }

    fn cell_of(&self, p: Vec3) -> [usize; 3] {
        let at = ((p - self.low) / self.cell).to_array();
        std::array::from_fn(|k| (at[k].max(0.0) as usize).min(self.size[k] - 1))
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (z * self.size[1] + y) * self.size[0] + x
    }

    /// The surfel that stands for a place with a unit normal; of equals the one that comes first in the grid.
    pub fn nearest(&self, position: Vec3, normal: Vec3) -> u32 {
        let centre = self.cell_of(position);
        let mut best = (f32::INFINITY, 0u32);
        let rings = self.size.into_iter().max().unwrap_or(1);
        for ring in 0..=rings {
            // Everything beyond the last ring is farther than this.
            let beyond = (ring as f32 - 1.0).max(0.0) * self.cell;
            if best.0 <= beyond * beyond {
                break;
            }
            self.visit_ring(centre, ring, |k| {
                let (at, n) = self.places[k];
                let cost = (at - position).length_squared() * (1.0 + TURNED_AWAY * (1.0 - n.dot(normal)).max(0.0));
                if cost < best.0 {
                    best = (cost, self.members[k]);
                }
            });
        }
        best.1
    }

    /// Members of the cells at the distance `ring` (in the largest coordinate) from a cell.
    fn visit_ring(&self, centre: [usize; 3], ring: usize, mut visit: impl FnMut(usize)) {
        let range = |k: usize| centre[k].saturating_sub(ring)..(centre[k] + ring + 1).min(self.size[k]);
        for z in range(2) {
            for y in range(1) {
                let on_shell = z.abs_diff(centre[2]) == ring || y.abs_diff(centre[1]) == ring;
                if on_shell {
                    let row = range(0);
                    let first = self.starts[self.index([row.start, y, z])];
                    let last = self.starts[self.index([row.end - 1, y, z]) + 1];
                    (first..last).for_each(|k| visit(k as usize));
                    continue;
                }
                for x in [centre[0].checked_sub(ring), Some(centre[0] + ring)].into_iter().flatten() {
                    if x < self.size[0] {
                        let c = self.index([x, y, z]);
                        (self.starts[c]..self.starts[c + 1]).for_each(|k| visit(k as usize));
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Mesh, Rng, sampling::uniform_sphere};

    #[test]
    fn the_nearest_surfel_is_that_of_a_search_through_all() {
        let mesh = Mesh::cuboid(Vec3::new(-1.0, -0.7, -0.02), Vec3::new(1.0, 0.7, 0.02));
        let patches = mesh.patches(0.01).unwrap();
        let grid = SurfelGrid::new(&patches).unwrap();
        let mut rng = Rng::new(3, 3);
        for _ in 0..2000 {
            let p = Vec3::new(rng.uniform() * 3.0 - 1.5, rng.uniform() * 2.0 - 1.0, 0.1 * rng.uniform() - 0.05);
            let normal = uniform_sphere(&mut rng);
            let cost = |q: &Patch| {
                (q.position - p).length_squared() * (1.0 + TURNED_AWAY * (1.0 - q.normal.dot(normal)).max(0.0))
            };
            let best = patches.iter().map(cost).fold(f32::INFINITY, f32::min);
            assert!(cost(&patches[grid.nearest(p, normal) as usize]) <= best * (1.0 + 1e-6));
        }
        // In a sheet an exit keeps to its side.
        for _ in 0..500 {
            let p = Vec3::new(1.8 * rng.uniform() - 0.9, 1.2 * rng.uniform() - 0.6, 0.02);
            assert!(patches[grid.nearest(p, Vec3::Z) as usize].normal.z > 0.9);
        }
        assert!(SurfelGrid::new(&[]).is_err());
    }
}
