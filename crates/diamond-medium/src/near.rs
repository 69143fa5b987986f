//! Which of many points lie near a place: a grid of cells, in the order of the points.
use glam::{IVec3, Vec3};

/// Cells along the longest side are at most this many: memory is bounded whatever the spacing.
const MAX_CELLS: f32 = 256.0;

/// Points in cells.
#[derive(Debug, Clone)]
pub struct Near {
    low: Vec3,
    cell: f32,
    size: IVec3,
    /// Where each cell's points begin in `order`; one more than there are cells.
    starts: Vec<u32>,
    order: Vec<u32>,
}

impl Near {
    /// Of `points`, with cells about as large as the radii that will be asked for.
    pub fn new(points: &[Vec3], radius: f32) -> Self {
        let low = points.iter().copied().reduce(Vec3::min).unwrap_or(Vec3::ZERO);
        let high = points.iter().copied().reduce(Vec3::max).unwrap_or(Vec3::ZERO);
        let cell = radius.max((high - low).max_element() / MAX_CELLS).max(f32::MIN_POSITIVE);
        let size = ((high - low) / cell).floor().as_ivec3() + 1;
        let mut near = Self { low, cell, size, starts: Vec::new(), order: vec![0; points.len()] };
        let cells: Vec<usize> = points.iter().map(|p| near.index(near.cell_of(*p))).collect();
        let mut starts = vec![0u32; (size.x * size.y * size.z) as usize + 1];
        cells.iter().for_each(|c| starts[c + 1] += 1);
        (1..starts.len()).for_each(|c| starts[c] += starts[c - 1]);
        let mut next = starts.clone();
        for (i, c) in cells.iter().enumerate() {
            near.order[next[*c] as usize] = i as u32;
            next[*c] += 1;
        }
        near.starts = starts;
        near
    }

    fn cell_of(&self, p: Vec3) -> IVec3 {
        ((p - self.low) / self.cell).floor().as_ivec3().clamp(IVec3::ZERO, self.size - 1)
    }

    fn index(&self, c: IVec3) -> usize {
        ((c.z * self.size.y + c.y) * self.size.x + c.x) as usize
    }

    /// Calls `see` with each point whose cell lies within `radius` of `at` along every axis: all points within that distance, and
    /// some beyond.
    pub fn within(&self, at: Vec3, radius: f32, mut see: impl FnMut(usize)) {
        let low = ((at - radius - self.low) / self.cell).floor().as_ivec3().max(IVec3::ZERO);
        let high = ((at + radius - self.low) / self.cell).floor().as_ivec3().min(self.size - 1);
        for z in low.z..=high.z {
            for y in low.y..=high.y {
                if low.x > high.x {
                    return;
                }
                let (first, last) = (self.index(IVec3::new(low.x, y, z)), self.index(IVec3::new(high.x, y, z)));
                let range = self.starts[first] as usize..self.starts[last + 1] as usize;
                self.order[range].iter().for_each(|&i| see(i as usize));
            }
        }
    }

    /// The `count` points nearest to `at` with their squared distances, nearest first, equal ones in the order of the points; fewer where
    /// there are fewer.
    pub fn nearest(&self, points: &[Vec3], at: Vec3, count: usize) -> Vec<(usize, f32)> {
        let mut found: Vec<(usize, f32)> = Vec::new();
        if points.is_empty() || count == 0 {
            return found;
        }
        // Everything within the radius is known once a ball of that radius has been looked at.
        let outside = (self.low - at).max(at - (self.low + self.size.as_vec3() * self.cell)).max(Vec3::ZERO).length();
        let mut radius = outside + self.cell;
        let all = outside + self.size.as_vec3().length() * self.cell;
        loop {
            found.clear();
            self.within(at, radius, |i| found.push((i, points[i].distance_squared(at))));
            found.sort_unstable_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
            let enough = found.get(count - 1).is_some_and(|f| f.1 <= radius * radius);
            if enough || radius >= all {
                found.truncate(count);
                return found;
            }
            radius *= 2.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_are_those_that_a_search_of_all_finds() {
        let mut state = 5u32;
        let mut draw = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / 16_777_216.0
        };
        let points: Vec<Vec3> = (0..700).map(|_| Vec3::new(draw(), 0.3 * draw(), draw() * draw())).collect();
        let near = Near::new(&points, 0.04);
        for _ in 0..50 {
            let at = Vec3::new(draw(), draw(), draw()) * 2.0 - 0.5;
            let mut all: Vec<(usize, f32)> =
                points.iter().enumerate().map(|(i, p)| (i, p.distance_squared(at))).collect();
            all.sort_by(|a, b| a.1.total_cmp(&b.1));
            assert_eq!(near.nearest(&points, at, 5), all[..5]);
        }
        assert_eq!(near.nearest(&points, Vec3::ONE, 1000).len(), 700);
        assert!(Near::new(&[], 1.0).nearest(&[], Vec3::ZERO, 3).is_empty());
        assert_eq!(Near::new(&[Vec3::ONE; 3], 1.0).nearest(&[Vec3::ONE; 3], Vec3::ZERO, 2).len(), 2);
    }
}
