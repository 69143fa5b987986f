//! Tiny captures: a shaded ball, photographed by a formula.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_dataset::{CaptureDescription, Provenance, ShotDescription, Split, ViewDescription, write_capture};
use diamond_image::{Image, Mask};
use diamond_light::OlatLight;
use glam::{Vec2, Vec3};
use std::path::{Path, PathBuf};

/// An empty folder of this test and process.
pub fn scratch(name: &str) -> PathBuf {
    let dir = std::env::temp_dir().join(format!("diamond-{name}-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&dir);
    std::fs::create_dir_all(&dir).unwrap();
    dir
}

/// A configuration that takes few steps and Gaussians and writes checkpoints often.
pub fn small_config(dir: &Path) -> PathBuf {
    let path = dir.join("small.toml");
    let text = "base = \"resolved\"\nname = \"small\"\nsteps = 6\ncheckpoint_steps = 5\n[initial]\ncount = 200\n\
                hull_resolution = 16\n[residual]\nhidden = [16, 16]\n[density]\nevery_steps = 10\nmax_gaussians = 400\n";
    std::fs::write(&path, text).unwrap();
    path
}

fn camera(i: usize, side: u32) -> Camera {
    let phi = i as f32 * 2.1;
    let eye = Vec3::new(3.0 * phi.cos(), 3.0 * phi.sin(), 1.0 + 0.3 * (i % 8) as f32);
    Camera { intrinsics: Intrinsics::from_fov_x(0.8, side, side), pose: Pose::look_at(eye, Vec3::ZERO, Vec3::Z) }
}

fn light(i: usize) -> OlatLight {
    let phi = 0.4 + i as f32 * 1.3;
    OlatLight::Point { position: Vec3::new(4.0 * phi.cos(), 4.0 * phi.sin(), 2.0), intensity: Vec3::ONE }
}

/// Lambert's ball of radius 0.8 under one light.
fn photograph(camera: &Camera, light: &OlatLight) -> (Image, Option<Mask>) {
    let side = camera.intrinsics.width as usize;
    let (mut radiance, mut coverage) = (Image::new(side, side, 3), vec![0.0; side * side]);
    for y in 0..side {
        for x in 0..side {
            let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
            let b = ray.origin.dot(ray.direction);
            let discriminant = b * b - ray.origin.length_squared() + 0.64;
            if discriminant > 0.0 {
                let p = ray.at(-b - discriminant.sqrt());
                let l = (light.position().unwrap() - p).normalize();
                let shade = 0.1 + 0.7 * p.normalize().dot(l).max(0.0);
                radiance.pixel_mut(x, y).copy_from_slice(&[shade, 0.7 * shade, 0.5 * shade]);
                coverage[y * side + x] = 1.0;
            }
        }
    }
    (radiance, Some(Mask::from_vec(side, side, coverage).unwrap()))
}

/// [`ball_capture`] at 32².
pub fn tiny_capture(dir: &Path, views: usize, lights: usize) {
    ball_capture(dir, views, lights, 32, 2);
}

/// Writes a capture of `views` × `lights` at `side`², and one held-out view under `held_out` lights, the last one unseen (all beyond `lights` are).
pub fn ball_capture(dir: &Path, views: usize, lights: usize, side: u32, held_out: usize) {
    let view = |i: usize, lights: &[usize]| ViewDescription {
        camera: camera(i, side),
        shots: lights
            .iter()
            .map(|&l| ShotDescription {
                name: format!("r_{i}_l_{l}"),
                light: light(l),
                provenance: Provenance::Photograph,
                weight: 1.0,
            })
            .collect(),
    };
    let all: Vec<usize> = (0..lights).collect();
    let shown: Vec<usize> = (0..held_out - 1).chain([lights.max(held_out - 1)]).collect();
    let description = CaptureDescription {
        train: (0..views).map(|i| view(i, &all)).collect(),
        test: vec![view(views, &shown)],
        ..Default::default()
    };
    write_capture(dir, &description, |split, v, s| {
        let view = match split {
            Split::Train => &description.train[v],
            Split::Test => &description.test[v],
        };
        Ok(photograph(&view.camera, &view.shots[s].light))
    })
    .unwrap();
}
