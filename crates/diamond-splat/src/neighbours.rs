//! Distances to the nearest other points: how large a Gaussian must be at first to touch its neighbours.
//!
//! A balanced k-d tree over the indices: the median of each range along its longest side is the node, ranges of a
//! few points are scanned. Exact, also for duplicates, clusters and points on a line.
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Ranges up to this size are scanned: below it a node costs more than the points it would exclude.
const LEAF: usize = 8;

/// The points in the order of the tree: node at the middle of a range, the two sides left and right of it.
struct KdTree {
    points: Vec<DVec3>,
    /// Index in the original list.
    indices: Vec<u32>,
    /// Axis of the node at this place.
    axes: Vec<u8>,
}

impl KdTree {
    fn build(points: &[Vec3]) -> Self {
        let mut indices: Vec<u32> = (0..points.len() as u32).filter(|&i| points[i as usize].is_finite()).collect();
        let mut axes = vec![0u8; indices.len()];
        split(points, &mut indices, &mut axes);
        Self { points: indices.iter().map(|&i| points[i as usize].as_dvec3()).collect(), indices, axes }
    }

    /// Collects the squared distances from `query` to the nearest points other than number `skip`, ascending.
    fn nearest(&self, query: DVec3, skip: u32, range: std::ops::Range<usize>, nearest: &mut Nearest) {
        if range.len() <= LEAF {
            for at in range {
                if self.indices[at] != skip {
                    nearest.offer(self.points[at].distance_squared(query));
                }
            }
            return;
        }
        let middle = range.start + range.len() / 2;
        if self.indices[middle] != skip {
            nearest.offer(self.points[middle].distance_squared(query));
        }
        let axis = self.axes[middle] as usize;
        let offset = query[axis] - self.points[middle][axis];
        let (near, far) = if offset < 0.0 {
            (range.start..middle, middle + 1..range.end)
        } else {
            (middle + 1..range.end, range.start..middle)
        };
        self.nearest(query, skip, near, nearest);
        if offset * offset < nearest.worst() {
            self.nearest(query, skip, far, nearest);
        }
    }
}

fn split(points: &[Vec3], indices: &mut [u32], axes: &mut [u8]) {
    if indices.len() <= LEAF {
        return;
    }
    let (low, high) = indices.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), &i| {
        (low.min(points[i as usize]), high.max(points[i as usize]))
    });
    // Halved before subtracting, or the difference of two finite numbers may overflow.
    let axis = (0.5 * high - 0.5 * low).max_position();
    let middle = indices.len() / 2;
    indices.select_nth_unstable_by(middle, |&a, &b| {
        points[a as usize][axis].total_cmp(&points[b as usize][axis]).then(a.cmp(&b))
    });
    axes[middle] = axis as u8;
    let (left, right) = indices.split_at_mut(middle);
    let (left_axes, right_axes) = axes.split_at_mut(middle);
    let (right, right_axes) = (&mut right[1..], &mut right_axes[1..]);
    if left.len() > 4096 {
        rayon::join(|| split(points, left, left_axes), || split(points, right, right_axes));
    } else {
        split(points, left, left_axes);
        split(points, right, right_axes);
    }
}

/// The k smallest values so far, ascending.
struct Nearest {
    k: usize,
    squared: Vec<f64>,
}

impl Nearest {
    fn worst(&self) -> f64 {
        if self.squared.len() < self.k { f64::INFINITY } else { self.squared.last().copied().unwrap_or(0.0) }
    }

    fn offer(&mut self, squared: f64) {
        if squared < self.worst() {
            if self.squared.len() == self.k {
                self.squared.pop();
            }
            let at = self.squared.partition_point(|&s| s <= squared);
            self.squared.insert(at, squared);
        }
    }
}

/// For each point the mean of the squared distances to its `k` nearest other points (scene units²).
///
/// `[eq:initial-scale]` The initial scale of a Gaussian is the square root of this with k = 3.
///
/// Exact (in f64, then rounded). Duplicates are neighbours at distance 0. Where there are fewer than `k` other points
/// the mean is over those; with none, or `k` = 0, it is 0. A point that is not finite is nobody's neighbour
/// and gets 0. The same bits for any number of threads.
pub fn mean_squared_distance_to_nearest(points: &[Vec3], k: usize) -> Vec<f32> {
    let tree = KdTree::build(points);
    points
        .par_iter()
        .enumerate()
        .with_min_len(256)
        .map_init(
            || Nearest { k, squared: Vec::with_capacity(k.min(points.len())) },
            |nearest, (index, point)| {
                nearest.squared.clear();
                if k == 0 || !point.is_finite() {
                    return 0.0;
                }
                tree.nearest(point.as_dvec3(), index as u32, 0..tree.points.len(), nearest);
                let mean = nearest.squared.iter().sum::<f64>() / nearest.squared.len().max(1) as f64;
                mean.min(f32::MAX as f64) as f32
            },
        )
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn brute_force(points: &[Vec3], k: usize) -> Vec<f32> {
        (0..points.len())
            .map(|i| {
                let mut squared: Vec<f64> = (0..points.len())
                    .filter(|&j| j != i)
                    .map(|j| points[j].as_dvec3().distance_squared(points[i].as_dvec3()))
                    .collect();
                squared.sort_by(f64::total_cmp);
                squared.truncate(k);
                (squared.iter().sum::<f64>() / squared.len().max(1) as f64) as f32
            })
            .collect()
    }

    /// Points with clusters, lines and duplicates.
    fn points() -> impl Strategy<Value = Vec<Vec3>> {
        let coordinate = prop_oneof![
            3 => -1.0f32..1.0,
            2 => (-2i32..3).prop_map(|v| v as f32),
            1 => (-1e-4f32..1e-4).prop_map(|v| v + 0.5),
            1 => -1e6f32..1e6,
        ];
        prop::collection::vec([coordinate.clone(), coordinate.clone(), coordinate].prop_map(Vec3::from), 0..200)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(96))]

        /// [eq:initial-scale]
        #[test]
        fn equals_brute_force(points in points(), k in 0usize..6) {
            prop_assert_eq!(mean_squared_distance_to_nearest(&points, k), brute_force(&points, k));
        }
    }

    #[test]
    fn few_extreme_and_invalid_points_are_finite() {
        assert_eq!(mean_squared_distance_to_nearest(&[], 3), []);
        assert_eq!(mean_squared_distance_to_nearest(&[Vec3::ONE], 3), [0.0]);
        assert_eq!(mean_squared_distance_to_nearest(&[Vec3::ZERO, Vec3::X * 2.0], 3), [4.0, 4.0]);
        let far = [Vec3::splat(f32::MAX), Vec3::splat(-f32::MAX), Vec3::ZERO];
        assert!(mean_squared_distance_to_nearest(&far, 3).iter().all(|v| v.is_finite()));
        let with_nan = [Vec3::ZERO, Vec3::X, Vec3::new(f32::NAN, 0.0, 0.0), Vec3::splat(f32::INFINITY)];
        assert_eq!(mean_squared_distance_to_nearest(&with_nan, 3), [1.0, 1.0, 0.0, 0.0]);
        // All the same point: as deep as any tree, and all distances zero.
        assert_eq!(mean_squared_distance_to_nearest(&vec![Vec3::ONE; 1000], 3), vec![0.0; 1000]);
    }

    #[test]
    fn thread_counts_do_not_change_a_bit() {
        let mut state = 1u32;
        let mut next = || {
            state = state.wrapping_mul(1664525).wrapping_add(1013904223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        let points: Vec<Vec3> = (0..20_000).map(|_| Vec3::new(next(), next(), next() * 0.01)).collect();
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| mean_squared_distance_to_nearest(&points, 3))
        };
        let one = run(1);
        assert_eq!(one, run(3));
        let some: Vec<usize> = (0..points.len()).step_by(997).collect();
        for i in some {
            let mut squared: Vec<f64> =
                points.iter().map(|p| p.as_dvec3().distance_squared(points[i].as_dvec3())).collect();
            squared.sort_by(f64::total_cmp);
            assert_eq!(one[i], ((squared[1] + squared[2] + squared[3]) / 3.0) as f32);
        }
    }
}
