//! Packages used on their own, from outside the workspace: what an importer writes, compiles and waits for.
//!
//! A project is written to a temporary folder with path dependencies, built offline and run.
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the tests lie in the workspace").to_owned()
}

/// Runs cargo in `folder`; its output, or what it said.
fn cargo(folder: &Path, arguments: &[&str]) -> String {
    let output = Command::new(env!("CARGO"))
        .args(arguments)
        .arg("--offline")
        .current_dir(folder)
        .env("CARGO_TARGET_DIR", folder.join("target"))
        .output()
        .expect("cargo starts");
    assert!(output.status.success(), "cargo {arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Builds and runs a program that uses `packages` and glam; prints how long that took and how much it compiled.
fn build_and_run(name: &str, packages: &[&str], main: &str) -> (String, Vec<String>) {
    let folder = std::env::temp_dir().join(format!("diamond-standalone-{name}-{}", std::process::id()));
    std::fs::create_dir_all(folder.join("src")).expect("a temporary folder");
    let root = root();
    let mut manifest = format!(
        "[package]\nname = \"{name}-alone\"\nversion = \"0.1.0\"\nedition = \"2024\"\n\n[workspace]\n\n[dependencies]\nglam = \"0.34\"\n"
    );
    for package in packages {
        manifest += &format!("{package} = {{ path = {:?} }}\n", root.join("crates").join(package));
    }
    std::fs::write(folder.join("Cargo.toml"), manifest).expect("the manifest is written");
    std::fs::write(folder.join("src/main.rs"), main).expect("the program is written");
    // The same versions as the workspace: offline, others may not be at hand.
    std::fs::copy(root.join("Cargo.lock"), folder.join("Cargo.lock")).expect("the lock file is copied");
    let begun = Instant::now();
    cargo(&folder, &["build"]);
    let seconds = begun.elapsed().as_secs_f64();
    let tree = cargo(&folder, &["tree", "-e", "normal,build", "--prefix", "none", "--format", "{p}"]);
    let mut names: Vec<String> = tree.lines().filter_map(|l| l.split_whitespace().next().map(str::to_owned)).collect();
    names.sort();
    names.dedup();
    let output = cargo(&folder, &["run", "--quiet"]);
    println!("{name}: {} packages, built in {seconds:.1} s: {}", names.len(), names.join(" "));
    std::fs::remove_dir_all(&folder).expect("the temporary folder is removed");
    (output, names)
}

/// A sphere under one light, shaded point by point with nothing but the shading package.
const SPHERE: &str = r#"
use diamond_shading::{BrdfModel, Material};
use glam::Vec3;

fn main() {
    let clay = Material { base_color: Vec3::new(0.8, 0.5, 0.3), roughness: 0.4, metalness: 0.0 };
    let light = Vec3::new(1.0, 1.0, 2.0).normalize();
    let mut sum = Vec3::ZERO;
    for y in 0..32 {
        for x in 0..64 {
            let (u, v) = ((x as f32 + 0.5) / 32.0 - 1.0, 1.0 - (y as f32 + 0.5) / 16.0);
            let square = 1.0 - u * u - v * v;
            let radiance = match square > 0.0 {
                true => BrdfModel::default().reflect(&clay, Vec3::new(u, v, square.sqrt()), Vec3::Z, light, Vec3::ONE * 3.0),
                false => Vec3::ZERO,
            };
            sum += radiance;
            print!("{}", b" .:-=+*#%@"[(radiance.x * 12.0).min(9.0) as usize] as char);
        }
        println!();
    }
    println!("mean {:.4}", sum.x / 2048.0);
}
"#;

/// Three Gaussians in front of a camera, rasterised with nothing but the rasteriser's package and cameras.
const SPLATS: &str = r#"
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_splat::{Features, Gaussians, RasterConfig, rasterize};
use glam::{Quat, Vec3};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let camera = Camera {
        intrinsics: Intrinsics::from_fov_x(0.8, 48, 24),
        pose: Pose::look_at(Vec3::new(0.0, -4.0, 0.0), Vec3::ZERO, Vec3::Z),
    };
    let gaussians = Gaussians {
        means: vec![Vec3::ZERO, Vec3::new(0.8, 0.5, 0.2), Vec3::new(-0.8, -0.5, -0.2)],
        scales: vec![Vec3::splat(0.3), Vec3::new(0.4, 0.1, 0.1), Vec3::splat(0.2)],
        rotations: vec![Quat::IDENTITY; 3],
        opacities: vec![0.9; 3],
        ..Default::default()
    };
    let mut features = Features::zeros(3, 1);
    (0..3).for_each(|i| features.row_mut(i)[0] = 1.0);
    let (raster, _pullback) = rasterize(&gaussians, &features, &camera, &RasterConfig::default())?;
    for y in 0..24 {
        println!("{}", (0..48).map(|x| b" .:-=+*#%@"[(raster.features.pixel(x, y)[0] * 9.0) as usize] as char).collect::<String>());
    }
    println!("mean {:.4}", raster.opacity.data().iter().sum::<f32>() / raster.opacity.data().len() as f32);
    Ok(())
}
"#;

fn mean_of(output: &str) -> f32 {
    let last = output.lines().last().and_then(|line| line.strip_prefix("mean ")).expect("the last line is the mean");
    last.parse().expect("a number")
}

#[test]
#[ignore = "compiles a project of its own: a minute"]
fn shading_alone_shades_a_sphere() {
    let (output, names) = build_and_run("shading", &["diamond-shading"], SPHERE);
    println!("{output}");
    assert!((0.01..1.0).contains(&mean_of(&output)), "{output}");
    let unwanted = ["rayon", "image", "exr", "serde", "diamond-splat", "diamond-dataset"];
    assert!(names.iter().all(|name| !unwanted.contains(&name.as_str())), "{names:?}");
}

#[test]
#[ignore = "compiles a project of its own: a minute"]
fn splat_alone_draws_three_gaussians() {
    let (output, names) = build_and_run("splat", &["diamond-splat", "diamond-camera"], SPLATS);
    println!("{output}");
    assert!((0.01..1.0).contains(&mean_of(&output)), "{output}");
    let unwanted = ["image", "exr", "serde", "diamond-shading", "diamond-dataset"];
    assert!(names.iter().all(|name| !unwanted.contains(&name.as_str())), "{names:?}");
}
