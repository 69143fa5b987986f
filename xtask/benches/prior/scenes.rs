//! The objects, their media and lamps, and what the path tracer says of them.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::Image;
use diamond_pathtrace::{
    Boundary, Facing, Geometry, Light, Material, Medium, Mesh, NO_PRIMITIVE, Patch, PatchInterpolation,
    ReferenceOptions, Scene, WalkStart, read_ply, render_reference,
};
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::path::Path;

/// Side of the pictures.
pub const SIDE: u32 = 48;

/// Camera rays per pixel are the square of this.
const RAYS: u32 = 4;

/// Towards the lamps: beside the camera, from the side, from above, and from behind.
pub const LAMPS: [Vec3; 4] =
    [Vec3::new(0.2, 0.5, 1.0), Vec3::new(1.0, 0.2, -0.1), Vec3::new(-0.3, 1.0, 0.2), Vec3::new(0.3, 0.4, -1.0)];

/// Albedos of the three channels.
pub const ALBEDO: Vec3 = Vec3::new(0.99, 0.95, 0.7);

/// An object of one medium.
pub struct Case {
    pub scene: Scene,
    pub patches: Vec<Patch>,
    pub camera: Camera,
}

/// What a mesh is: its name, and itself of the size of the unit ball.
pub fn mesh(root: &Path, name: &str) -> Result<Mesh, String> {
    Ok(match name {
        "slab" => Mesh::cuboid(Vec3::new(-0.7, -0.7, -0.2), Vec3::new(0.7, 0.7, 0.2)),
        "sheet" => Mesh::cuboid(Vec3::new(-0.7, -0.7, -0.04), Vec3::new(0.7, 0.7, 0.04)),
        "sphere" => Mesh::icosphere(Vec3::ZERO, 0.8, 4),
        _ => {
            let path = root.join("assets/fixtures/transport/mitsuba/spot.ply");
            read_ply(&path).map_err(|e| e.to_string())?.fitted(Vec3::ZERO, 1.0)
        }
    })
}

impl Case {
    pub fn new(
        root: &Path,
        name: &'static str,
        sigma_t: f32,
        g: f32,
        boundary: Boundary,
        surfels: f32,
    ) -> Result<Self, String> {
        let mesh = mesh(root, name)?;
        let area: f64 = (0..mesh.triangles.len())
            .map(|t| {
                let [a, b, c] = mesh.corners(t);
                f64::from((b - a).cross(c - a).length()) * 0.5
            })
            .sum();
        let patches = mesh.patches(area as f32 / surfels).map_err(|e| e.to_string())?;
        let geometry = Geometry::from_mesh(mesh).map_err(|e| e.to_string())?;
        let medium = Medium { sigma_t: Vec3::splat(sigma_t), albedo: ALBEDO, g, veins: None };
        let lights = LAMPS.iter().map(|d| Light::directional(d.normalize(), Vec3::splat(3.0))).collect();
        let scene = Scene { geometry, material: Material { medium, boundary, coat: None }, lights };
        let eye = if matches!(name, "slab" | "sheet") { Vec3::new(1.6, 1.2, 2.9) } else { Vec3::new(0.8, 0.7, 3.3) };
        let pose = Pose::look_at(eye, Vec3::ZERO, Vec3::Y);
        let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.6, SIDE, SIDE), pose };
        Ok(Self { scene, patches, camera })
    }

    /// Whether its boundary is one.
    pub fn refracts(&self) -> bool {
        self.scene.material.boundary.effective() != Boundary::IndexMatched
    }

    /// Irradiance of every patch under every lamp, shadows by rays, and the cosines: patches × lamps.
    pub fn light(&self) -> (Vec<f32>, Vec<f32>) {
        let one = |p: &Patch| -> Vec<(f32, f32)> {
            let each = LAMPS.iter().map(|d| {
                let (direction, geometry) = (d.normalize(), &self.scene.geometry);
                let cos = p.normal.dot(direction);
                let dark = cos <= 0.0
                    || geometry.occluded(p.position, direction, f32::INFINITY, Facing::Entering, NO_PRIMITIVE);
                (if dark { 0.0 } else { 3.0 * cos }, cos)
            });
            each.collect()
        };
        self.patches.par_iter().flat_map_iter(one).unzip()
    }

    /// Light that was inside the medium, a picture for each lamp, with the squares of its standard errors.
    pub fn reference(&self, samples: u32, seed: u64) -> Result<Truth, String> {
        let render = |scene: &Scene, samples: u32| {
            let options = ReferenceOptions { samples, seed, ..Default::default() };
            render_reference(scene, &self.camera, &options).map_err(|e| e.to_string())
        };
        let all = render(&self.scene, samples)?;
        let mut truth = Truth {
            means: all.lights.iter().map(|l| l.mean.clone()).collect(),
            variances: all.lights.iter().map(|l| squared(&l.standard_error)).collect(),
            coverage: all.coverage,
        };
        if self.refracts() {
            // What the boundary reflects on its outer side, which a black medium shows alone.
            let mut black = self.scene.clone();
            black.material.medium.albedo = Vec3::ZERO;
            let surface = render(&black, 4 * samples)?;
            for (l, light) in surface.lights.iter().enumerate() {
                let add = |to: &mut Image, from: &Image, sign: f32| {
                    to.data_mut().iter_mut().zip(from.data()).for_each(|(t, f)| *t += sign * f);
                };
                add(&mut truth.means[l], &light.mean, -1.0);
                add(&mut truth.variances[l], &squared(&light.standard_error), 1.0);
            }
        }
        Ok(truth)
    }

    /// Where the camera's rays meet the surface, and which patches stand for these places.
    pub fn film(&self) -> Result<Film, String> {
        let between = PatchInterpolation::new(&self.patches).map_err(|e| e.to_string())?;
        let pixel = |i: usize| {
            let corner = Vec2::new((i as u32 % SIDE) as f32, (i as u32 / SIDE) as f32);
            let mut rays = Vec::new();
            for k in 0..RAYS * RAYS {
                let offset = Vec2::new((k % RAYS) as f32 + 0.5, (k / RAYS) as f32 + 0.5) / RAYS as f32;
                let ray = self.camera.ray(corner + offset);
                let geometry = &self.scene.geometry;
                let hit =
                    geometry.closest_hit(ray.origin, ray.direction, f32::INFINITY, Facing::Entering, NO_PRIMITIVE);
                if let Some(hit) = hit {
                    let mut weights = Vec::new();
                    between.weights(hit.position, hit.normal, &mut weights);
                    let cos = -ray.direction.dot(hit.normal);
                    let direction = Some(-ray.direction);
                    let start = WalkStart { position: hit.position, normal: hit.normal, direction };
                    rays.push(FilmRay { cos, start, weights });
                }
            }
            rays
        };
        Ok(Film { pixels: (0..(SIDE * SIDE) as usize).into_par_iter().map(pixel).collect() })
    }
}

fn squared(image: &Image) -> Image {
    let mut out = image.clone();
    out.data_mut().iter_mut().for_each(|v| *v *= *v);
    out
}

/// Pictures of the path tracer, one for each lamp.
pub struct Truth {
    pub means: Vec<Image>,
    /// Squared standard errors.
    pub variances: Vec<Image>,
    pub coverage: Image,
}

/// A camera ray that met the object.
pub struct FilmRay {
    /// Outer cosine.
    pub cos: f32,
    pub start: WalkStart,
    pub weights: Vec<(u32, f32)>,
}

/// The camera's rays, pixel by pixel.
pub struct Film {
    pixels: Vec<Vec<FilmRay>>,
}

impl Film {
    /// All rays, with the number of the pixel and what of it each stands for.
    pub fn starts(&self) -> (Vec<WalkStart>, Vec<(usize, f32)>) {
        let share = 1.0 / (RAYS * RAYS) as f32;
        let each = |(pixel, rays): (usize, &Vec<FilmRay>)| {
            rays.iter().map(|ray| ray.start).map(|start| (start, (pixel, share))).collect::<Vec<_>>()
        };
        self.pixels.iter().enumerate().flat_map(each).unzip()
    }

    /// Pictures of `columns` values of each patch (patches × columns): SIDE² × columns, each ray's value times `factor` of its cosine.
    pub fn develop(&self, values: &[f32], columns: usize, factor: impl Fn(f32) -> f32 + Sync) -> Vec<f32> {
        self.pixels
            .par_iter()
            .flat_map_iter(|rays| {
                let mut sums = vec![0.0f32; columns];
                for ray in rays {
                    let scale = factor(ray.cos) / (RAYS * RAYS) as f32;
                    for (k, weight) in &ray.weights {
                        let row = &values[*k as usize * columns..][..columns];
                        sums.iter_mut().zip(row).for_each(|(s, v)| *s += scale * weight * v);
                    }
                }
                sums
            })
            .collect()
    }
}

/// Errors of pictures, per channel, over all lamps and covered pixels, in per cent of the mean.
#[derive(Debug, Clone, Copy)]
pub struct Errors {
    pub bias: Vec3,
    /// Of the reference's noise in `bias`, lamps taken as fully correlated.
    pub bias_error: Vec3,
    pub rmse: Vec3,
}

impl Truth {
    /// `pictures`: for each lamp SIDE² × 3. `lamp`: only that one.
    pub fn errors(&self, pictures: &[Vec<f32>], lamp: Option<usize>) -> Errors {
        let mut errors = Errors { bias: Vec3::ZERO, bias_error: Vec3::ZERO, rmse: Vec3::ZERO };
        for c in 0..3 {
            let (mut sum, mut truth, mut squares, mut own, mut spread, mut n) = (0.0f64, 0.0f64, 0.0f64, 0.0, 0.0, 0);
            for l in (0..pictures.len()).filter(|l| lamp.is_none_or(|k| k == *l)) {
                let mut variance = 0.0;
                for (i, covered) in self.coverage.data().iter().enumerate() {
                    if *covered <= 0.0 {
                        continue;
                    }
                    let (x, r) = (f64::from(pictures[l][3 * i + c]), f64::from(self.means[l].data()[3 * i + c]));
                    sum += x;
                    truth += r;
                    squares += (x - r) * (x - r);
                    variance += f64::from(self.variances[l].data()[3 * i + c]);
                    n += 1;
                }
                own += variance;
                spread += variance.sqrt();
            }
            errors.bias[c] = (100.0 * (sum / truth - 1.0)) as f32;
            errors.bias_error[c] = (100.0 * spread / truth) as f32;
            errors.rmse[c] = (100.0 * ((squares - own).max(0.0) * f64::from(n)).sqrt() / truth) as f32;
        }
        errors
    }
}
