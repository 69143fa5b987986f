//! Which pixels of a relief lie in its own shadow.
use crate::object_pixels::{NONE, ObjectPixels};
use diamond_camera::Camera;
use glam::Vec3;

/// Pixels between two samples of a ray.
const STEP: f32 = 1.5;
/// A ray must be this deep below the relief to be stopped, pixels: the relief's own error.
const BIAS: f32 = 1.5;

/// A relief as something that light cannot pass: from the surface to its mirror image behind its deepest point.
pub(crate) struct Occluder<'a> {
    pixels: &'a ObjectPixels,
    camera: &'a Camera,
    distances: &'a [f32],
    nearest: f32,
    deepest: f32,
}

impl<'a> Occluder<'a> {
    /// Of the surface at these distances from the camera.
    pub fn new(pixels: &'a ObjectPixels, camera: &'a Camera, distances: &'a [f32]) -> Self {
        let nearest = distances.iter().fold(f32::INFINITY, |a, b| a.min(*b));
        let deepest = distances.iter().fold(0f32, |a, b| a.max(*b));
        Self { pixels, camera, distances, nearest, deepest }
    }

    /// Whether something of the relief stands between the surface point of pixel `i` and the light in `direction`.
    pub fn shades(&self, i: usize, direction: Vec3) -> bool {
        let centre = self.camera.pose.centre();
        let unit = self.distances[i] * self.pixels.angle;
        let start = centre + self.pixels.rays[i] * self.distances[i];
        let steps = (self.pixels.width + self.pixels.height) as f32 / STEP;
        for k in 1..=steps as usize {
            let point = start + direction * (unit * STEP * (k as f32 + 0.5));
            let Some((at, _)) = self.camera.project(point) else { return false };
            let inside =
                at.x >= 0.0 && at.y >= 0.0 && at.x < self.pixels.width as f32 && at.y < self.pixels.height as f32;
            let distance = point.distance(centre);
            let behind = distance > 2.0 * self.deepest - self.nearest;
            if !inside || behind || distance < self.nearest {
                return false;
            }
            let number = self.pixels.numbers[at.y as usize * self.pixels.width + at.x as usize];
            if number != NONE {
                let front = self.distances[number as usize];
                if distance > front + BIAS * unit && distance < 2.0 * self.deepest - front - BIAS * unit {
                    return true;
                }
            }
        }
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes;

    #[test]
    fn a_post_throws_its_shadow_and_a_sphere_none() {
        let sphere = scenes::Ellipsoid::sphere(96);
        let pixels = ObjectPixels::of(&sphere.camera, &sphere.mask());
        let mut distances: Vec<f32> = pixels.rays.iter().map(|r| sphere.hit(*r).unwrap().0).collect();
        // From the left, and a little from the front.
        let frame = pixels.frames[pixels.len() / 2];
        let light = (frame.toward - 2.0 * frame.right).normalize();
        let lit = |distances: &[f32]| -> Vec<bool> {
            let occluder = Occluder::new(&pixels, &sphere.camera, distances);
            (0..pixels.len()).map(|i| !occluder.shades(i, light)).collect()
        };
        // A sphere shades only what does not face the light anyway.
        for (i, lit) in lit(&distances).iter().enumerate() {
            let normal = sphere.hit(pixels.rays[i]).unwrap().1;
            assert!(*lit || normal.dot(light) < 0.3, "pixel {i}, cosine {}", normal.dot(light));
        }
        // A bar across the middle column, half a radius high: shade to its right.
        let column = |i: usize| pixels.places[i] as usize % pixels.width;
        for i in 0..pixels.len() {
            if (46..49).contains(&column(i)) {
                distances[i] -= 0.5;
            }
        }
        let lit = lit(&distances);
        let right: Vec<usize> = (0..pixels.len()).filter(|&i| (50..56).contains(&column(i))).collect();
        let left: Vec<usize> = (0..pixels.len()).filter(|&i| (39..45).contains(&column(i))).collect();
        let share = |of: &[usize]| of.iter().filter(|&&i| lit[i]).count() as f32 / of.len() as f32;
        assert!(share(&right) < 0.2 && share(&left) > 0.8, "{} {}", share(&right), share(&left));
    }
}
