//! Pictures of the path tracer against pictures that Mitsuba 3 has rendered.
//!
//! A folder holds `refs.json` (the scenes), and for each `NAME.npy` (mean radiance, height × width × 3, `f32` or `f64`) with `NAME.se.npy`
//! (standard error of each value). A scene is a shape (`unit sphere at origin`, or a mesh file relative to the folder), a boundary
//! (`["null"]`, `["rough", eta, alpha]` or `["smooth", eta]`), `sigma_t` and `albedo` (a number or three), `g`, a light
//! (`light_travel_direction_unnormalised` with `irradiance`, or `light_position` with `intensity`) and a pinhole camera.
//!
//! The rule: the mean over the film within 4 standard errors in each channel, and 99 % of the values within
//! 4·√(se² + ours²).

use super::{Column, OracleReport, picture};
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_pathtrace::{
    Boundary, Geometry, Light, LightImage, Material, Medium, ReferenceOptions, Scene, read_ply, render_reference,
};
use glam::{DVec3, Vec3};
use serde_json::Value;
use std::path::Path;

/// Largest difference of film means in standard errors, and the distance that a value may have.
const SIGMAS: f64 = 4.0;
/// Fraction of values that may be farther off.
const OUTSIDE: f64 = 0.01;
/// Paths per pixel.
const SAMPLES: u32 = 1024;
/// Behind a boundary so many times more: what a facet refracts towards a lamp without extent is rare and bright, and with few paths
/// the spread of a pixel's paths says less than its error.
const MORE_BEHIND_BOUNDARIES: u32 = 8;

/// Compares our pictures with those in the folder `path`, with 1024 paths per pixel (8192 behind a boundary).
///
/// # Errors
/// A message that names the file and the field when a scene or a picture cannot be read.
pub fn check(path: &Path) -> Result<OracleReport, String> {
    compare(path, SAMPLES, |_| {})
}

fn field<'a>(scene: &'a Value, name: &str) -> Result<&'a Value, String> {
    scene.get(name).ok_or_else(|| format!("no field {name}"))
}

fn number(value: &Value, name: &str) -> Result<f32, String> {
    value.as_f64().map(|v| v as f32).ok_or_else(|| format!("{name}: expected a number, found {value}"))
}

/// Three numbers, or one for all three.
fn three(value: &Value, name: &str) -> Result<Vec3, String> {
    let Some(list) = value.as_array() else { return number(value, name).map(Vec3::splat) };
    let numbers: Vec<f32> = list.iter().map(|v| number(v, name)).collect::<Result<_, _>>()?;
    let array: [f32; 3] = numbers.try_into().map_err(|_| format!("{name}: expected three numbers, found {value}"))?;
    Ok(array.into())
}

/// The scene and the camera that an entry of `refs.json` in `folder` describes.
///
/// # Errors
/// The field, and what was expected.
pub fn read_scene(folder: &Path, json: &Value) -> Result<(Scene, Camera), String> {
    let shape = field(json, "shape")?.as_str().ok_or("shape: expected text")?;
    let geometry = if shape.starts_with("unit sphere") {
        Geometry::Sphere { centre: Vec3::ZERO, radius: 1.0 }
    } else {
        let mesh = read_ply(&folder.join(shape)).map_err(|e| e.to_string())?;
        Geometry::from_mesh(mesh).map_err(|e| e.to_string())?
    };
    let parts = field(json, "boundary")?.as_array().cloned().unwrap_or_default();
    let part = |i: usize| parts.get(i).ok_or("boundary: too short".to_string()).and_then(|v| number(v, "boundary"));
    let boundary = match parts.first().and_then(Value::as_str) {
        Some("null") => Boundary::IndexMatched,
        Some("rough") => Boundary::Rough { eta: part(1)?, alpha: part(2)? },
        Some("smooth") => Boundary::Smooth { eta: part(1)? },
        _ => return Err(format!("boundary: expected null, rough or smooth, found {}", json["boundary"])),
    };
    let medium = Medium {
        sigma_t: three(field(json, "sigma_t")?, "sigma_t")?,
        albedo: three(field(json, "albedo")?, "albedo")?,
        g: number(field(json, "g")?, "g")?,
        veins: None,
    };
    let light = if let Some(travel) = json.get("light_travel_direction_unnormalised") {
        let direction = -three(travel, "light_travel_direction_unnormalised")?.normalize();
        Light::directional(direction, three(field(json, "irradiance")?, "irradiance")?)
    } else {
        let position = three(field(json, "light_position")?, "light_position")?;
        Light::point(position, three(field(json, "intensity")?, "intensity")?)
    };
    let camera = field(json, "camera")?;
    let [origin, target, up] = ["origin", "target", "up"].map(|name| field(camera, name).and_then(|v| three(v, name)));
    let size = number(field(camera, "res")?, "res")? as u32;
    let fov = number(field(camera, "fov_x_deg")?, "fov_x_deg")?.to_radians();
    let camera =
        Camera { intrinsics: Intrinsics::from_fov_x(fov, size, size), pose: Pose::look_at(origin?, target?, up?) };
    Ok((Scene { geometry, material: Material { medium, boundary, coat: None }, lights: vec![light] }, camera))
}

/// [`check`] with `samples` paths per pixel; `disturb` changes each scene before it is rendered.
pub fn compare(folder: &Path, samples: u32, disturb: impl Fn(&mut Scene)) -> Result<OracleReport, String> {
    // The list itself, the folder that holds it, or a folder that holds one under another name.
    let listed = folder.join("refs.json");
    let (folder, file) = match (folder.is_file(), listed.exists()) {
        (true, _) => (folder.parent().unwrap_or(Path::new("")), folder.to_path_buf()),
        (false, true) => (folder, listed),
        (false, false) => (folder, super::only_file(folder, "json").unwrap_or(listed)),
    };
    let text = std::fs::read_to_string(&file).map_err(|e| format!("{}: {e}; expected the scenes", file.display()))?;
    let json: Value = serde_json::from_str(&text).map_err(|e| format!("{}: {e}", file.display()))?;
    let scenes = json.as_object().ok_or_else(|| format!("{}: expected an object of scenes", file.display()))?;
    let mut columns = Vec::new();
    for (name, json) in scenes {
        let here = |e: String| format!("{}: {name}: {e}", file.display());
        let (mut scene, camera) = read_scene(folder, json).map_err(here)?;
        disturb(&mut scene);
        let theirs = LightImage {
            mean: picture::read(&folder.join(format!("{name}.npy")))?,
            standard_error: picture::read(&folder.join(format!("{name}.se.npy")))?,
        };
        let times = if boundary_is_none(&scene) { 1 } else { MORE_BEHIND_BOUNDARIES };
        let options =
            ReferenceOptions { samples: samples.saturating_mul(times), seed: 1, ..ReferenceOptions::default() };
        let ours = render_reference(&scene, &camera, &options).map_err(|e| here(e.to_string()))?;
        let ours = &ours.lights[0];
        if ours.mean.shape() != theirs.mean.shape() || ours.mean.shape() != theirs.standard_error.shape() {
            return Err(here(format!("expected {:?}, found {:?}", ours.mean.shape(), theirs.mean.shape())));
        }
        columns.extend(judge(name, ours, &theirs));
    }
    Ok(OracleReport {
        title: format!("pictures of Mitsuba, {}, {samples} paths per pixel or more", folder.display()),
        columns,
    })
}

fn boundary_is_none(scene: &Scene) -> bool {
    scene.material.boundary.effective() == Boundary::IndexMatched
}

fn judge(name: &str, ours: &LightImage, theirs: &LightImage) -> [Column; 2] {
    let mut means = Column::new(format!("{name}/film mean (s.e.)"), SIGMAS);
    let ((a, ea), (b, eb)) = (ours.film_mean(), theirs.film_mean());
    for channel in 0..3 {
        let error = (ea[channel].powi(2) + eb[channel].powi(2)).sqrt();
        // Values of f32 pictures.
        let sigmas = (a[channel] - b[channel]).abs() / error.max(1e-9);
        let relative = (a - b) / b.max(DVec3::splat(1e-12));
        means.observe(sigmas, || {
            format!(
                "{}: ours {:.3} % off, both ± {:.3} %",
                ["red", "green", "blue"][channel],
                100.0 * relative[channel],
                100.0 * error / b[channel]
            )
        });
    }
    let (mut outside, mut worst, mut at) = (0usize, 0.0f64, 0usize);
    let count = ours.mean.data().len();
    for i in 0..count {
        let value = |image: &diamond_image::Image| f64::from(image.data()[i]);
        let (x, y) = (value(&ours.mean), value(&theirs.mean));
        let error = (value(&ours.standard_error).powi(2) + value(&theirs.standard_error).powi(2)).sqrt();
        let sigmas = if x == y { 0.0 } else { (x - y).abs() / error.max(1e-9) };
        outside += usize::from(sigmas.is_nan() || sigmas > SIGMAS);
        if sigmas > worst {
            (worst, at) = (sigmas, i);
        }
    }
    let width = ours.mean.width();
    let mut pixels = Column::new(format!("{name}/pixels outside"), OUTSIDE);
    pixels.observe(outside as f64 / count as f64, || {
        format!("{outside} of {count} values; worst {worst:.1} s.e. at ({}, {})", at / 3 % width, at / 3 / width)
    });
    pixels.count = count;
    [means, pixels]
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::PathBuf;

    fn fixtures() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../assets/fixtures/transport/mitsuba")
    }

    /// `[eq:rough-dielectric]` `[eq:transmittance]` on spheres and a mesh, with and without a boundary.
    #[test]
    fn our_pictures_agree_with_mitsuba() {
        let report = compare(&fixtures(), 768, |_| {}).expect("the pictures");
        println!("{report}");
        assert_eq!(report.columns.len(), 8);
        assert!(report.passed(), "{report}");
    }

    /// A list under another name works; missing, truncated and broken files are errors that name the file.
    #[test]
    fn renamed_lists_work_and_broken_files_are_named() {
        let folder = std::env::temp_dir().join(format!("mitsuba-oracle-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir_all(&folder).expect("a folder");
        assert!(check(&folder).expect_err("empty").contains("refs.json"));
        let text = std::fs::read_to_string(fixtures().join("refs.json")).expect("the list");
        let json: Value = serde_json::from_str(&text).expect("json");
        let all = json.as_object().expect("scenes");
        // Quick to render, and without a mesh beside the list.
        let plain = |s: &Value| s["boundary"][0] == "null" && s["shape"].as_str().is_some_and(|s| s.contains("sphere"));
        let (name, scene) = all.iter().find(|(_, s)| plain(s)).expect("a sphere without boundary");
        let list = serde_json::json!({ "other": scene });
        std::fs::write(folder.join("more.json"), list.to_string()).expect("write");
        let [mean, error] = ["npy", "se.npy"].map(|end| folder.join(format!("other.{end}")));
        std::fs::copy(fixtures().join(format!("{name}.npy")), &mean).expect("copy");
        assert!(compare(&folder, 2, |_| {}).expect_err("no errors").contains("other.se.npy"));
        std::fs::copy(fixtures().join(format!("{name}.se.npy")), &error).expect("copy");
        assert_eq!(compare(&folder, 2, |_| {}).expect("renamed").columns.len(), 2);
        assert_eq!(compare(&folder.join("more.json"), 2, |_| {}).expect("by its name").columns.len(), 2);
        let bytes = std::fs::read(&mean).expect("a picture");
        for cut in [0, 5, 100, bytes.len() - 7] {
            std::fs::write(&mean, &bytes[..cut]).expect("write");
            assert!(compare(&folder, 2, |_| {}).expect_err("cut").contains("other.npy"), "{cut}");
        }
        for broken in
            [&list.to_string()[..60], "[1, 2]", "{\"other\": {}}", "{\"other\": {\"shape\": \"unit sphere\"}}"]
        {
            std::fs::write(folder.join("more.json"), broken).expect("write");
            assert!(compare(&folder, 2, |_| {}).expect_err("broken").contains("more.json"), "{broken}");
        }
        std::fs::remove_dir_all(&folder).expect("clean up");
    }

    /// A medium that is a quarter denser is noticed, and so is a light that comes from the other side.
    #[test]
    fn wrong_scenes_are_noticed() {
        let denser = compare(&fixtures(), 192, |scene| scene.material.medium.sigma_t *= 1.25).expect("the pictures");
        assert!(denser.columns.iter().step_by(2).filter(|column| !column.passed()).count() >= 3, "{denser}");
        let mirrored =
            |scene: &mut Scene| scene.lights[0] = Light::directional(Vec3::new(-1.0, 1.0, 1.0).normalize(), Vec3::ONE);
        let report = compare(&fixtures(), 32, mirrored).expect("the pictures");
        assert!(report.columns.iter().skip(1).step_by(2).all(|column| !column.passed()), "{report}");
    }
}
