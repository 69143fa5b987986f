//! Which views are compared with which, and at which pixels.
use crate::{ConsistencyOptions, ViewGeometry};
use diamond_camera::Camera;
use glam::Vec3;

/// For each camera the `count` others whose directions from `centre` are nearest to its own by angle, nearest first, ties
/// by index. A camera at `centre` itself has no direction and comes last.
pub fn nearest_views(cameras: &[Camera], centre: Vec3, count: usize) -> Vec<Vec<usize>> {
    let directions: Vec<Option<Vec3>> = cameras.iter().map(|c| (c.pose.centre() - centre).try_normalize()).collect();
    // The chord, which keeps its digits where the cosine is next to 1.
    let apart = |a: Option<Vec3>, b: Option<Vec3>| match (a, b) {
        (Some(a), Some(b)) => a.distance_squared(b),
        _ => f32::INFINITY,
    };
    (0..cameras.len())
        .map(|i| {
            let mut others: Vec<usize> = (0..cameras.len()).filter(|j| *j != i).collect();
            others.sort_by(|&a, &b| {
                apart(directions[i], directions[a]).total_cmp(&apart(directions[i], directions[b])).then(a.cmp(&b))
            });
            others.truncate(count);
            others
        })
        .collect()
}

/// At most `count` different pixels of those where the view shows an object (silhouette, and mask where there is one, above
/// `options.min_silhouette`), drawn evenly by `seed` and sorted; all of them where there are no more.
pub fn draw_pixels(view: &ViewGeometry<'_>, options: &ConsistencyOptions, count: usize, seed: u64) -> Vec<u32> {
    let shows = |i: usize| view.silhouette.data()[i] > options.min_silhouette && view.label(i) > options.min_silhouette;
    let pixels = view.silhouette.data().len().min(view.mask.map_or(usize::MAX, |m| m.data().len()));
    let mut shown: Vec<u32> = (0..pixels).filter(|&i| shows(i)).map(|i| i as u32).collect();
    if shown.len() <= count {
        return shown;
    }
    let mut random = SplitMix(seed);
    for k in 0..count {
        let pick = random.below(shown.len() - k);
        shown.swap(k, k + pick);
    }
    shown.truncate(count);
    shown.sort_unstable();
    shown
}

/// Random numbers: SplitMix64 (Steele, Lea and Flood 2014).
pub(crate) struct SplitMix(pub u64);

impl SplitMix {
    /// The next index below `count` (at least 1).
    pub fn below(&mut self, count: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        // The high half of a product: a remainder would prefer small numbers.
        ((u128::from(z ^ (z >> 31)) * count as u128) >> 64) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{DepthRange, DepthSource};
    use diamond_camera::{Intrinsics, Pose};
    use diamond_image::Image;

    #[test]
    fn neighbours_on_a_ring_are_those_beside() {
        let intrinsics = Intrinsics::from_fov_x(0.8, 8, 8);
        let cameras: Vec<Camera> = (0..8)
            .map(|i| {
                let (s, c) = (i as f32 * std::f32::consts::FRAC_PI_4).sin_cos();
                // At different distances: only the angle counts.
                let eye = (2.0 + i as f32) * Vec3::new(c, s, 0.1);
                Camera { intrinsics, pose: Pose::look_at(eye, Vec3::ZERO, Vec3::Z) }
            })
            .collect();
        let near = nearest_views(&cameras, Vec3::ZERO, 2);
        let sorted: Vec<Vec<usize>> = near
            .iter()
            .map(|n| {
                let mut n = n.clone();
                n.sort_unstable();
                n
            })
            .collect();
        assert_eq!((&sorted[0][..], &sorted[3][..]), (&[1, 7][..], &[2, 4][..]));
        assert_eq!(nearest_views(&cameras[..1], Vec3::ZERO, 2), vec![Vec::<usize>::new()]);
        assert_eq!(nearest_views(&cameras[..3], Vec3::ZERO, 9)[0].len(), 2);
        // Equal cameras, and one at the centre.
        let twice = [cameras[2], cameras[2], cameras[5]];
        assert_eq!(nearest_views(&twice, Vec3::ZERO, 1)[0], [1]);
        assert_eq!(nearest_views(&twice, twice[2].pose.centre(), 2)[2], [0, 1]);
    }

    #[test]
    fn pixels_are_drawn_evenly_and_reproducibly() {
        let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.8, 40, 40), pose: Pose::IDENTITY };
        let mut silhouette = Image::filled(40, 40, 1, 1.0);
        silhouette.data_mut()[..400].fill(0.3);
        let view = ViewGeometry {
            camera: &camera,
            silhouette: &silhouette,
            depth: DepthSource::Rendered(&silhouette),
            mask: None,
        };
        let options = ConsistencyOptions::new(DepthRange { near: 0.0, far: 1.0 });
        let draw = |seed| draw_pixels(&view, &options, 300, seed);
        assert_eq!(draw(7), draw(7));
        assert_ne!(draw(7), draw(8));
        assert_eq!(draw_pixels(&view, &options, 5000, 1), (400..1600).collect::<Vec<u32>>());
        let mut hits = vec![0u32; 1600];
        for seed in 0..400 {
            let pixels = draw(seed);
            assert!(pixels.len() == 300 && pixels.windows(2).all(|w| w[0] < w[1]));
            pixels.iter().for_each(|p| hits[*p as usize] += 1);
        }
        // 100 expected each, standard deviation 8.7.
        assert!(hits[..400].iter().all(|h| *h == 0) && hits[400..].iter().all(|h| (55..150).contains(h)));
    }
}
