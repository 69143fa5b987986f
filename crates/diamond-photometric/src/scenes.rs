//! Scenes for tests: a posed ellipsoid under a dome of lights, with every answer known.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::{Image, Mask};
use diamond_light::{Falloff, OlatLight};
use glam::{Vec2, Vec3};

/// An ellipsoid about the origin, axes along the world's.
pub(crate) struct Ellipsoid {
    pub camera: Camera,
    pub half_axes: Vec3,
}

impl Ellipsoid {
    fn seen(size: u32, half_axes: Vec3, eye: Vec3) -> Self {
        let pose = Pose::look_at(eye, Vec3::ZERO, Vec3::Z);
        Self { camera: Camera { intrinsics: Intrinsics::from_fov_x(0.9, size, size), pose }, half_axes }
    }

    pub fn sphere(size: u32) -> Self {
        Self::seen(size, Vec3::ONE, Vec3::new(0.0, -3.0, 0.6))
    }

    /// Seen so that its outline tells little of its shape.
    pub fn tilted(size: u32) -> Self {
        Self::seen(size, Vec3::new(1.0, 0.5, 0.7), Vec3::new(-1.8, -2.4, 0.9))
    }

    /// Distance and normal where a ray from the camera meets it.
    pub fn hit(&self, ray: Vec3) -> Option<(f32, Vec3)> {
        let (o, d) = (self.camera.pose.centre() / self.half_axes, ray / self.half_axes);
        let (a, b, c) = (d.length_squared(), o.dot(d), o.length_squared() - 1.0);
        let under = b * b - a * c;
        if under <= 0.0 {
            return None;
        }
        let t = (-b - under.sqrt()) / a;
        let at = self.camera.pose.centre() + ray * t;
        Some((t, (at / (self.half_axes * self.half_axes)).normalize()))
    }

    fn each(&self) -> impl Iterator<Item = (usize, Option<(f32, Vec3)>, Vec3)> + '_ {
        let w = self.camera.intrinsics.width as usize;
        (0..w * self.camera.intrinsics.height as usize).map(move |i| {
            let ray = self.camera.ray(Vec2::new((i % w) as f32 + 0.5, (i / w) as f32 + 0.5)).direction;
            (i, self.hit(ray), ray)
        })
    }

    pub fn mask(&self) -> Mask {
        let size = self.camera.intrinsics.width as usize;
        Mask::from_vec(size, size, self.each().map(|(_, hit, _)| f32::from(hit.is_some())).collect()).unwrap()
    }

    pub fn normals(&self) -> Vec<Option<Vec3>> {
        self.each().map(|(_, hit, _)| hit.map(|h| h.1)).collect()
    }

    /// Radiance under a light: albedo × irradiance × response of the cosine.
    pub fn image(&self, light: &OlatLight, falloff: Falloff, response: impl Fn(f32, usize) -> f32) -> Image {
        let size = self.camera.intrinsics.width as usize;
        let mut image = Image::new(size, size, 3);
        for (i, hit, ray) in self.each() {
            if let Some((t, normal)) = hit {
                let incidence = light.incidence(self.camera.pose.centre() + ray * t, falloff);
                for c in 0..3 {
                    image.data_mut()[3 * i + c] =
                        [0.8, 0.5, 0.3][c] * incidence.irradiance[c] * response(normal.dot(incidence.direction), c);
                }
            }
        }
        image
    }
}
