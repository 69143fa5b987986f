//! Whether a silhouette lies where the photographs leave room for the object.
use diamond_camera::Camera;
use diamond_image::Mask;
use glam::{Vec2, Vec3};

/// Points along a ray at which the hull is asked.
const SAMPLES: usize = 128;
/// Pixels of a silhouette that are looked at, about.
const PIXELS: usize = 4096;

/// Overlap over union of two masks of one size, by coverage: Σ min / Σ max; 1 where both are empty.
pub(crate) fn overlap(a: &Mask, b: &Mask) -> f32 {
    let (mut both, mut either) = (0.0f64, 0.0f64);
    for (a, b) in a.data().iter().zip(b.data()) {
        both += f64::from(a.min(*b));
        either += f64::from(a.max(*b));
    }
    if either > 0.0 { (both / either) as f32 } else { 1.0 }
}

/// The photographs' masks: the object lies where no mask that sees a point denies it.
pub(crate) struct Hull {
    pub masks: Vec<(Camera, Mask)>,
    pub centre: Vec3,
    /// Radius round the centre beyond which nothing is.
    pub radius: f32,
}

impl Hull {
    fn holds(&self, point: Vec3) -> bool {
        self.masks.iter().all(|(camera, mask)| {
            let Some((pixel, _)) = camera.project(point) else { return true };
            let (x, y) = (pixel.x.floor(), pixel.y.floor());
            let inside = x >= 0.0 && y >= 0.0 && x < mask.width() as f32 && y < mask.height() as f32;
            !inside || mask.coverage(x as usize, y as usize) >= 0.5
        })
    }

    /// The share of the pixels of `silhouette`, seen by `camera`, whose rays meet no point of the hull; 0 where nothing is covered.
    pub fn outside(&self, camera: &Camera, silhouette: &Mask) -> f32 {
        let covered: Vec<usize> = (0..silhouette.data().len()).filter(|i| silhouette.data()[*i] >= 0.5).collect();
        let stride = covered.len().div_ceil(PIXELS).max(1);
        let (mut asked, mut outside) = (0usize, 0usize);
        for i in covered.iter().step_by(stride) {
            let (x, y) = (i % silhouette.width(), i / silhouette.width());
            let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
            let middle = (self.centre - ray.origin).dot(ray.direction);
            let meets = (0..SAMPLES).any(|k| {
                let t = middle + self.radius * (2.0 * (k as f32 + 0.5) / SAMPLES as f32 - 1.0);
                t > 0.0 && self.holds(ray.at(t))
            });
            asked += 1;
            outside += usize::from(!meets);
        }
        if asked > 0 { outside as f32 / asked as f32 } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_camera::{Intrinsics, Pose};

    fn camera(eye: Vec3) -> Camera {
        Camera { intrinsics: Intrinsics::from_fov_x(0.8, 48, 48), pose: Pose::look_at(eye, Vec3::ZERO, Vec3::Z) }
    }

    /// A ball of radius 0.6 about `centre`, as a camera sees it.
    fn ball(camera: &Camera, centre: Vec3) -> Mask {
        let covered = (0..48 * 48).map(|i| {
            let ray = camera.ray(Vec2::new((i % 48) as f32 + 0.5, (i / 48) as f32 + 0.5));
            let to = centre - ray.origin;
            let apart = (to - ray.direction * to.dot(ray.direction)).length();
            if apart < 0.6 { 1.0 } else { 0.0 }
        });
        Mask::from_vec(48, 48, covered.collect()).unwrap()
    }

    #[test]
    fn a_silhouette_elsewhere_is_outside() {
        let eyes = [Vec3::X * 3.0, Vec3::Y * 3.0, Vec3::new(2.0, 2.0, 1.5)];
        let masks = eyes.map(camera).map(|c| (c, ball(&c, Vec3::ZERO))).to_vec();
        let hull = Hull { masks, centre: Vec3::ZERO, radius: 1.2 };
        let other = camera(Vec3::new(-1.5, 2.2, 1.0));
        assert!(hull.outside(&other, &ball(&other, Vec3::ZERO)) < 0.02);
        let moved = hull.outside(&other, &ball(&other, Vec3::new(0.5, 0.3, 0.0)));
        assert!(moved > 0.2, "{moved}");
        assert_eq!(hull.outside(&other, &Mask::from_vec(48, 48, vec![0.0; 48 * 48]).unwrap()), 0.0);
        let (a, b) = (ball(&other, Vec3::ZERO), ball(&other, Vec3::Z * 0.3));
        assert!(overlap(&a, &a) == 1.0 && (0.3..0.8).contains(&overlap(&a, &b)));
    }
}
