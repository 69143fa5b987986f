//! Run time against error: one view of a bumpy ball under eight lights, in bulk with one setting varied at a time, and by the reference.
//!
//! The error is the root mean square over covered pixels, channels and lights, over the mean; against a reference whose own noise is taken
//! off. It is noise at first and then what the model cannot express, where a curve becomes flat.
use crate::plot::{Curve, Panel};
use crate::seconds;
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::Image;
use diamond_light::LightRig;
use diamond_pathtrace::{
    Bulk, BulkOptions, Geometry, Light, Material, Medium, Mesh, ReferenceImage, ReferenceOptions, Scene,
    render_reference,
};
use glam::Vec3;
use std::path::Path;
use xtask::bench::Table;

/// Side of the pictures.
const SIDE: u32 = 40;
/// Paths per pixel of what everything is compared with.
const TRUTH: u32 = 2048;

fn scene() -> Result<Scene, String> {
    let mut mesh = Mesh::icosphere(Vec3::ZERO, 1.0, 4);
    for p in &mut mesh.positions {
        let bump = (3.1 * p.x + 0.4).sin() * (2.7 * p.y - 0.3).sin() + 0.6 * (4.3 * p.z + p.x).sin();
        *p *= 0.78 + 0.16 * bump;
    }
    mesh.normals = None;
    let rig = LightRig::dome(8, Vec3::ZERO, Vec3::Y, 4.5, -0.6, Vec3::ONE).map_err(|e| e.to_string())?;
    let medium =
        Medium { sigma_t: Vec3::new(8.0, 12.0, 18.0), albedo: Vec3::new(0.99, 0.95, 0.8), g: 0.4, veins: None };
    Ok(Scene {
        geometry: Geometry::from_mesh(mesh.with_smooth_normals()).map_err(|e| e.to_string())?,
        material: Material::index_matched(medium),
        lights: rig.lights.iter().map(|light| Light::from(light.scaled(Vec3::splat(60.0)))).collect(),
    })
}

/// In per cent; `noise` says whether the standard errors of `truth` are to be taken off.
fn error(pictures: &[&Image], truth: &ReferenceImage) -> f64 {
    let (mut squares, mut own, mut sum, mut n) = (0.0, 0.0, 0.0, 0usize);
    for (picture, light) in pictures.iter().zip(&truth.lights) {
        for (i, covered) in truth.coverage.data().iter().enumerate() {
            if *covered <= 0.0 {
                continue;
            }
            for k in 3 * i..3 * i + 3 {
                let (x, r) = (f64::from(picture.data()[k]), f64::from(light.mean.data()[k]));
                squares += (x - r) * (x - r);
                own += f64::from(light.standard_error.data()[k]).powi(2);
                sum += r;
                n += 1;
            }
        }
    }
    100.0 * ((squares - own).max(0.0) * n.max(1) as f64).sqrt() / sum
}

/// Measures, and writes the tables and, where wanted, the picture.
pub fn run(out: &Path, plots: Option<&Path>) -> Result<(), String> {
    let scene = scene()?;
    let camera = Camera {
        intrinsics: Intrinsics::from_fov_x(0.5, SIDE, SIDE),
        pose: Pose::look_at(Vec3::new(0.0, 0.8, 3.9), Vec3::ZERO, Vec3::Y),
    };
    let reference = |samples: u32, seed: u64| {
        let start = seconds();
        render_reference(&scene, &camera, &ReferenceOptions { samples, seed, ..Default::default() })
            .map(|image| (image, seconds() - start))
            .map_err(|e| e.to_string())
    };
    let (truth, time) = reference(TRUTH, 77)?;
    println!("reference of {TRUTH} paths per pixel: {time:.0} s");
    let columns = ["varied", "value", "seconds", "solve", "view", "error %"];
    let context = [("side", SIDE.to_string()), ("lights", scene.lights.len().to_string())];
    let mut table = Table::new("transport-sweep", &columns, &context);
    let base = BulkOptions { points: 1000, walks: 256, ..Default::default() };
    let mut bulk = |name: &str, value: f64, options: BulkOptions| -> Result<(f64, f64), String> {
        let start = seconds();
        let solved = Bulk::solve(&scene, &options, &|_| ()).map_err(|e| e.to_string())?;
        let solve = seconds() - start;
        let view = solved.render(&camera, 0).map_err(|e| e.to_string())?;
        let all = seconds() - start;
        let error = error(&view.lights.iter().collect::<Vec<_>>(), &truth);
        let numbers = [all, solve, all - solve, error].map(|v| format!("{v:.3}"));
        table.push([vec![name.into(), format!("{value}")], numbers.to_vec()].concat());
        Ok((all, error))
    };
    let mut curves = Vec::new();
    let mut vary = |name: &str, values: &[f64], set: &dyn Fn(f64) -> BulkOptions| -> Result<(), String> {
        let points = values.iter().map(|v| bulk(name, *v, set(*v))).collect::<Result<Vec<_>, _>>()?;
        let labels = values.iter().map(f64::to_string).collect();
        curves.push(Curve { name: name.into(), points, labels });
        Ok(())
    };
    vary("points", &[125.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0], &|v| BulkOptions { points: v as u32, ..base })?;
    vary("walks per point", &[16.0, 32.0, 64.0, 128.0, 256.0, 512.0, 1024.0], &|v| BulkOptions {
        walks: v as u32,
        ..base
    })?;
    vary("light maps", &[0.0, 16.0, 32.0, 64.0, 128.0, 256.0], &|v| BulkOptions { visibility: v as u32, ..base })?;
    vary("bulk", &[1.0, 2.0, 4.0, 8.0, 16.0, 32.0], &|v| BulkOptions {
        points: (500.0 * f64::sqrt(v)) as u32,
        walks: (64.0 * v) as u32,
        ..base
    })?;
    let mut points = Vec::new();
    let samples = [2, 4, 8, 16, 32, 64, 128, 256, 512];
    for n in samples {
        let (image, time) = reference(n, u64::from(n))?;
        let error = error(&image.lights.iter().map(|light| &light.mean).collect::<Vec<_>>(), &truth);
        let numbers = [time, 0.0, time, error].map(|v| format!("{v:.3}"));
        table.push([vec!["samples (reference)".into(), n.to_string()], numbers.to_vec()].concat());
        points.push((time, error));
    }
    let labels = samples.iter().map(u32::to_string).collect();
    curves.push(Curve { name: "reference, samples".into(), points, labels });
    let files = table.write(out)?;
    let mut rest = curves.into_iter();
    let mut next = |title: &str, n: usize| Panel { title: title.into(), curves: rest.by_ref().take(n).collect() };
    let panels = [
        next("points of the bulk solution", 1),
        next("walks per point", 1),
        next("width of light maps", 1),
        next("bulk (points and walks together) and reference", 2),
    ];
    let picture = crate::plot::panels(&panels, "processor seconds, one thread", "RMSE, % of the mean");
    let write = |path: &Path, bytes: &[u8]| std::fs::write(path, bytes).map_err(|e| format!("{}: {e}", path.display()));
    write(&out.join("transport-sweep.svg"), picture.as_bytes())?;
    if let Some(folder) = plots {
        std::fs::create_dir_all(folder).map_err(|e| format!("{}: {e}", folder.display()))?;
        write(&folder.join("transport.svg"), picture.as_bytes())?;
        let csv = std::fs::read(&files[0]).map_err(|e| e.to_string())?;
        write(&folder.join("transport.csv"), &csv)?;
    }
    Ok(())
}
