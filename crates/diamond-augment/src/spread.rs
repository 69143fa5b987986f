//! Directions that lie far from others.
use glam::Vec3;

/// Indices of `count` of the `candidates` (unit), each as far as possible from `taken` and from those before it, farther ones first; fewer where there are
/// fewer. A candidate that others have used `used` times counts as 1 + `used` times nearer, and is used once more. The lower index wins a tie.
pub(crate) fn farthest(candidates: &[Vec3], taken: &[Vec3], count: usize, used: &mut [u32]) -> Vec<usize> {
    let mut gaps: Vec<f32> =
        candidates.iter().map(|c| taken.iter().map(|t| t.distance_squared(*c)).fold(4.0, f32::min)).collect();
    let mut chosen = Vec::with_capacity(count.min(candidates.len()));
    while chosen.len() < count.min(candidates.len()) {
        let mut best = (usize::MAX, f32::NEG_INFINITY);
        for (i, gap) in gaps.iter().enumerate() {
            let times = (1 + used[i]) as f32;
            if !chosen.contains(&i) && gap / (times * times) > best.1 {
                best = (i, gap / (times * times));
            }
        }
        let next = best.0;
        if next == usize::MAX {
            break;
        }
        chosen.push(next);
        used[next] += 1;
        gaps.iter_mut().zip(candidates).for_each(|(g, c)| *g = g.min(c.distance_squared(candidates[next])));
    }
    chosen
}

/// `n` unit directions that are spread evenly over the sphere, along a spiral by the golden angle.
pub(crate) fn sphere(n: usize) -> Vec<Vec3> {
    let golden = std::f32::consts::PI * (3.0 - 5f32.sqrt());
    let of = |i: usize| {
        let z = 1.0 - (2 * i + 1) as f32 / n as f32;
        let (sin, cos) = libm::sincosf(golden * i as f32);
        let r = (1.0 - z * z).max(0.0).sqrt();
        Vec3::new(r * cos, r * sin, z)
    };
    (0..n).map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_farthest_come_first_and_are_shared_out() {
        let candidates = [Vec3::X, Vec3::Y, Vec3::NEG_X, Vec3::Z];
        let mut used = [0; 4];
        assert_eq!(farthest(&candidates, &[Vec3::X], 1, &mut used), [2]);
        // The one that was used counts as half as far.
        assert_eq!(farthest(&candidates, &[Vec3::X], 1, &mut used), [1]);
        assert_eq!(used, [0, 1, 1, 0]);
        assert_eq!(farthest(&candidates, &[], 9, &mut [0; 4]).len(), 4);
        assert!(farthest(&[], &[Vec3::X], 3, &mut []).is_empty());
        assert_eq!(farthest(&[Vec3::X; 2], &[Vec3::X], 2, &mut [0; 2]), [0, 1], "equal ones are still two");
    }

    #[test]
    fn the_sphere_is_even() {
        let all = sphere(200);
        assert!(all.iter().all(|d| (d.length() - 1.0).abs() < 1e-5) && all.iter().sum::<Vec3>().length() < 1.0);
        for d in &all {
            let near = all.iter().filter(|e| *e != d).map(|e| e.distance(*d)).fold(f32::INFINITY, f32::min);
            assert!((0.1..0.4).contains(&near), "{near}");
        }
    }
}
