//! The pixels that show the object: their neighbours, and the frame in which each one's relief is measured.
//!
//! A relief h is measured along the ray of each pixel, from a sphere around the camera's centre, in units of a pixel's angle δ:
//! the surface point is at the distance D·exp(−δ·h). With the logarithm, slopes of h are slopes of the surface
//! under perspective too: a constant h is a sphere around the camera, whose normals point at it. All pixels count as equally
//! wide, which toward the corners of a wide picture they are not: 2° of a normal at 25° from the axis.
use diamond_camera::Camera;
use diamond_image::{Image, Mask};
use glam::{Vec2, Vec3};

/// Coverage from which a pixel shows the object.
const INSIDE: f32 = 0.5;

/// No neighbour.
pub(crate) const NONE: u32 = u32::MAX;

/// World directions at a pixel: columns, rows, and toward the camera.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Frame {
    /// Along rising columns.
    pub right: Vec3,
    /// Along rising rows.
    pub down: Vec3,
    /// From the surface to the camera.
    pub toward: Vec3,
}

impl Frame {
    /// A vector of this frame (right, down, toward) in the world.
    pub fn world(&self, v: Vec3) -> Vec3 {
        self.right * v.x + self.down * v.y + self.toward * v.z
    }

    /// A vector of the world in this frame.
    pub fn local(&self, v: Vec3) -> Vec3 {
        Vec3::new(self.right.dot(v), self.down.dot(v), self.toward.dot(v))
    }
}

/// The object's pixels in reading order.
pub(crate) struct ObjectPixels {
    /// Width of the picture.
    pub width: usize,
    /// Height of the picture.
    pub height: usize,
    /// Position of each in the picture, row · width + column.
    pub places: Vec<u32>,
    /// Of each pixel of the picture its number among the object's, or [`NONE`].
    pub numbers: Vec<u32>,
    /// Neighbours among the object's pixels: left, right, above, below, or [`NONE`].
    pub neighbours: Vec<[u32; 4]>,
    /// Frame of each.
    pub frames: Vec<Frame>,
    /// Unit ray of each, world.
    pub rays: Vec<Vec3>,
    /// Cosine between ray and optical axis: view-space z over distance.
    pub cosines: Vec<f32>,
    /// Angle of a pixel, radians.
    pub angle: f32,
    /// Width and height of a pixel's angle over `angle`: 1 where pixels are square.
    pub aspect: Vec2,
}

impl ObjectPixels {
    /// Those with a coverage of at least ½.
    pub fn of(camera: &Camera, mask: &Mask) -> Self {
        let (width, height) = (mask.width(), mask.height());
        let mut numbers = vec![NONE; width * height];
        let mut places = Vec::new();
        for (i, &coverage) in mask.data().iter().enumerate() {
            if coverage >= INSIDE {
                numbers[i] = places.len() as u32;
                places.push(i as u32);
            }
        }
        let axis = camera.pose.rotation.row(2);
        let columns = camera.pose.rotation.row(0);
        let mut out = Self {
            width,
            height,
            neighbours: Vec::with_capacity(places.len()),
            frames: Vec::with_capacity(places.len()),
            rays: Vec::with_capacity(places.len()),
            cosines: Vec::with_capacity(places.len()),
            angle: 1.0 / (camera.intrinsics.fx * camera.intrinsics.fy).sqrt(),
            aspect: Vec2::ZERO,
            places,
            numbers,
        };
        let k = &camera.intrinsics;
        out.aspect = Vec2::new(1.0 / (k.fx * out.angle), 1.0 / (k.fy * out.angle));
        for &place in &out.places {
            let (x, y) = (place as usize % width, place as usize / width);
            let at = |inside: bool, i: usize| if inside { out.numbers[i] } else { NONE };
            let i = place as usize;
            out.neighbours.push([
                at(x > 0, i.wrapping_sub(1)),
                at(x + 1 < width, i + 1),
                at(y > 0, i.wrapping_sub(width)),
                at(y + 1 < height, i + width),
            ]);
            let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)).direction;
            let toward = -ray;
            let right = (columns - toward * columns.dot(toward)).try_normalize().unwrap_or(columns);
            out.frames.push(Frame { right, down: right.cross(toward), toward });
            out.rays.push(ray);
            out.cosines.push(ray.dot(axis));
        }
        out
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.places.len()
    }

    /// The distance from the camera of relief `h`, where relief 0 is at `distance`.
    pub fn distance(&self, h: f32, distance: f32) -> f32 {
        // A relief of 60 pixel angles' radians would be a factor of 10²⁶; no picture has one.
        distance * libm::expf((-h * self.angle).clamp(-60.0, 60.0))
    }

    /// `[eq:relief-normal]` Unit normals of a relief, world: (−∂h/∂x, −∂h/∂y, 1) in each pixel's frame, slopes by central
    /// differences, or one-sided at the outline.
    pub fn relief_normals(&self, h: &[f32]) -> Vec<Vec3> {
        (0..self.len())
            .map(|i| {
                let n = self.neighbours[i];
                let slope = |before: u32, after: u32| match (before, after) {
                    (NONE, NONE) => 0.0,
                    (NONE, b) => h[b as usize] - h[i],
                    (a, NONE) => h[i] - h[a as usize],
                    (a, b) => 0.5 * (h[b as usize] - h[a as usize]),
                };
                let local =
                    Vec3::new(-slope(n[0], n[1]) / self.aspect.x, -slope(n[2], n[3]) / self.aspect.y, 1.0).normalize();
                self.frames[i].world(local)
            })
            .collect()
    }

    /// A map of the picture's size, 0 off the object.
    pub fn map(&self, values: impl Iterator<Item = f32>) -> Image {
        let mut image = Image::new(self.width, self.height, 1);
        for (&place, value) in self.places.iter().zip(values) {
            image.data_mut()[place as usize] = value;
        }
        image
    }

    /// A map of vectors of the picture's size, 0 off the object.
    pub fn vector_map(&self, values: &[Vec3]) -> Image {
        let mut image = Image::new(self.width, self.height, 3);
        for (&place, value) in self.places.iter().zip(values) {
            image.data_mut()[3 * place as usize..3 * place as usize + 3].copy_from_slice(&value.to_array());
        }
        image
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes;

    /// [eq:relief-normal]: the relief of a sphere has a sphere's normals; next to the outline differences have no chance.
    #[test]
    fn the_relief_of_a_sphere_has_its_normals() {
        let sphere = scenes::Ellipsoid::sphere(96);
        let pixels = ObjectPixels::of(&sphere.camera, &sphere.mask());
        let distance = 3.0;
        let h: Vec<f32> =
            pixels.rays.iter().map(|r| -libm::logf(sphere.hit(*r).unwrap().0 / distance) / pixels.angle).collect();
        let normals = pixels.relief_normals(&h);
        for (i, ray) in pixels.rays.iter().enumerate() {
            let (at, truth) = sphere.hit(*ray).unwrap();
            assert!((pixels.distance(h[i], distance) - at).abs() < 1e-4);
            if truth.dot(-*ray) > 0.5 {
                let error = normals[i].angle_between(truth).to_degrees();
                assert!(error < 2.5, "{error}° at {i}");
            }
        }
        assert!(pixels.frames.iter().all(|f| {
            let v = Vec3::new(0.3, -0.2, 0.7);
            (f.local(f.world(v)) - v).length() < 1e-6 && f.right.cross(f.down).dot(f.toward) < -0.999
        }));
    }
}
