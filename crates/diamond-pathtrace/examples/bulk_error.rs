//! Time against error of the bulk renderer, for points, walks, light maps and samples, on three media.
//!
//!     cargo run --release -p diamond-pathtrace --example bulk_error -- [MEDIUM|all] [PATHS] [SIDE] [PICTURE.ppm]
//!
//! MEDIUM is `jade`, `wax`, `skin` or `all`; PATHS of the reference per pixel, SIDE of its pictures in pixels. `default` instead of a sweep is chosen
//! by the environment: BULK_SWEEP=none. With a file name, a picture of reference, bulk and ten times their difference (grey is none).
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::Transfer;
use diamond_light::LightRig;
use diamond_pathtrace::{
    Boundary, Bulk, BulkError, BulkOptions, Coat, Geometry, Light, Material, Medium, Mesh, ReferenceImage,
    ReferenceOptions, Scene, reference_pairs,
};
use glam::Vec3;
use std::error::Error;
use std::time::Instant;

/// A ball with bumps and hollows that shadow each other; circumscribed radius about 1.
fn object() -> Mesh {
    let mut mesh = Mesh::icosphere(Vec3::ZERO, 1.0, 5);
    for p in &mut mesh.positions {
        let bump = (3.1 * p.x + 0.4).sin() * (2.7 * p.y - 0.3).sin() + 0.6 * (4.3 * p.z + p.x).sin();
        *p *= 0.78 + 0.16 * bump;
    }
    mesh.normals = None;
    mesh.with_smooth_normals()
}

fn material(name: &str) -> Result<Material, String> {
    let coat = Some(Coat { roughness: 0.3, f0: Vec3::splat(0.04) });
    let matched = |medium| Material { medium, boundary: Boundary::IndexMatched, coat };
    Ok(match name {
        "jade" => Material {
            medium: Medium {
                sigma_t: Vec3::new(14.0, 10.0, 16.0),
                albedo: Vec3::new(0.95, 0.985, 0.94),
                g: 0.0,
                veins: None,
            },
            boundary: Boundary::Rough { eta: 1.5, alpha: 0.2 },
            coat: None,
        },
        "wax" => {
            matched(Medium { sigma_t: Vec3::splat(40.0), albedo: Vec3::new(0.998, 0.99, 0.96), g: 0.0, veins: None })
        }
        "skin" => matched(Medium {
            sigma_t: Vec3::new(25.0, 35.0, 55.0),
            albedo: Vec3::new(0.995, 0.98, 0.96),
            g: 0.8,
            veins: None,
        }),
        "thin" => matched(Medium { sigma_t: Vec3::splat(4.0), albedo: Vec3::new(0.99, 0.9, 0.6), g: 0.3, veins: None }),
        _ => return Err(format!("no medium {name}; there are jade, wax, skin, thin")),
    })
}

fn cameras(side: u32) -> Vec<Camera> {
    [Vec3::new(0.0, 0.8, 3.9), Vec3::new(3.2, -0.6, -2.3)]
        .map(|eye| Camera {
            intrinsics: Intrinsics::from_fov_x(0.5, side, side),
            pose: Pose::look_at(eye, Vec3::ZERO, Vec3::Y),
        })
        .to_vec()
}

/// A row of pictures for a few lamps: reference, bulk, and ten times their difference around grey.
fn picture(reference: &ReferenceImage, bulk: &[diamond_image::Image], lamps: &[usize]) -> Vec<u8> {
    let (side, height, _) = bulk[0].shape();
    let mut file = format!("P6 {} {} 255\n", 3 * side, height * lamps.len()).into_bytes();
    for &l in lamps {
        let peak = reference.lights[l].mean.data().iter().fold(1e-9f32, |a, b| a.max(*b)).min(1.0);
        for y in 0..height {
            for kind in 0..3 {
                for x in 0..side {
                    for c in 0..3 {
                        let r = reference.lights[l].mean.pixel(x, y)[c] / peak;
                        let b = bulk[l].pixel(x, y)[c] / peak;
                        let v = [r, b, 0.2 + 10.0 * (b - r)][kind].clamp(0.0, 1.0);
                        file.push((255.0 * Transfer::Srgb.encode(v) + 0.5) as u8);
                    }
                }
            }
        }
    }
    file
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let word = |i: usize, default: &str| arguments.get(i).cloned().unwrap_or_else(|| default.to_string());
    let (which, samples, side): (String, u32, u32) = (word(0, "all"), word(1, "256").parse()?, word(2, "40").parse()?);
    let sweep = std::env::var("BULK_SWEEP").unwrap_or_default() != "none";
    let rig = LightRig::dome(
        std::env::var("BULK_LIGHTS").ok().and_then(|v| v.parse().ok()).unwrap_or(16),
        Vec3::ZERO,
        Vec3::Y,
        4.5,
        -0.6,
        Vec3::ONE,
    )?;
    let names: Vec<&str> = if which == "all" { vec!["jade", "wax", "skin"] } else { vec![which.as_str()] };
    for name in names {
        let scene = Scene {
            geometry: Geometry::from_mesh(object())?,
            material: material(name)?,
            lights: rig.lights.iter().map(|light| Light::from(light.scaled(Vec3::splat(60.0)))).collect(),
        };
        let cameras = cameras(side);
        let start = Instant::now();
        let options = ReferenceOptions { samples, ..Default::default() };
        let references = reference_pairs(&scene, &cameras, &options)?;
        println!(
            "{name}: reference {} views × 16 lights, {samples} paths: {:.1} s",
            cameras.len(),
            start.elapsed().as_secs_f32()
        );
        println!(
            "| setting | points | solve s | view s | MB | bias % | ± | RMSE % of mean | of rms | noise % | noise dB |"
        );
        println!("|---|---|---|---|---|---|---|---|---|---|---|");
        let env = |name: &str, default: u32| std::env::var(name).ok().and_then(|v| v.parse().ok()).unwrap_or(default);
        let base = BulkOptions {
            points: env("BULK_POINTS", 4000),
            walks: env("BULK_WALKS", 1024),
            visibility: env("BULK_VISIBILITY", 256),
            connections: env("BULK_CONNECTIONS", 20) as f32 / 100.0,
            ..Default::default()
        };
        let mut settings = vec![("base".to_string(), base)];
        if sweep {
            for points in [250, 1000, 2000, 8000] {
                settings.push((format!("points {points}"), BulkOptions { points, ..base }));
            }
            for walks in [64, 256, 2048] {
                settings.push((format!("walks {walks}"), BulkOptions { walks, ..base }));
            }
            for visibility in [0, 64, 128] {
                settings.push((format!("maps {visibility}"), BulkOptions { visibility, ..base }));
            }
            for connections in [0.05, 0.6] {
                settings.push((format!("connections {connections}"), BulkOptions { connections, ..base }));
            }
            for samples_per_axis in [2, 6] {
                settings.push((format!("samples {samples_per_axis}²"), BulkOptions { samples_per_axis, ..base }));
            }
        }
        for (setting, options) in settings {
            let start = Instant::now();
            let bulk = Bulk::solve(&scene, &options, &|_| ())?;
            let solve = start.elapsed().as_secs_f32();
            let start = Instant::now();
            let view = bulk.render(&cameras[0], 0)?;
            let rendered = start.elapsed().as_secs_f32();
            let e = BulkError::against(&scene, &options, &cameras, &references, f32::INFINITY, &|_| ())?;
            println!(
                "| {setting} | {} | {solve:.1} | {rendered:.2} | {:.0} | {:+.2} | {:.2} | {:.2} | {:.2} | {:.2} | {:.1} |",
                bulk.points(),
                bulk.bytes() as f32 / 1e6,
                100.0 * e.bias,
                100.0 * e.bias_standard_error.hypot(e.bias_noise),
                100.0 * e.rmse,
                100.0 * e.rmse_of_rms,
                100.0 * e.noise,
                e.noise_db
            );
            if setting == "base" && arguments.len() > 3 {
                std::fs::write(
                    format!("{name}-{}", arguments[3]),
                    picture(&references[0][0], &view.lights, &[0, 5, 10, 15]),
                )?;
            }
        }
    }
    Ok(())
}
