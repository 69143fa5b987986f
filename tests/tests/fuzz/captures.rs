//! Readers of captures: frames, COLMAP models, lights, images, and whole folders with one bad file.
use super::harness::{Answer, Target};
use super::random::Random;
use super::{asset, folder_in, law, small_config_text};
use crate::captures::tiny_capture;
use diamond_dataset::{
    Capture, ColmapEncoding, OpenOptions, Selection, decode_image, parse_colmap_cameras, parse_colmap_images,
    parse_colmap_points, parse_lights, parse_transforms,
};
use diamond_reconstruct::{Config, Reconstruction};
use std::path::{Path, PathBuf};

/// All of them.
/// Folders are made in `dir`.
pub fn targets(dir: &Path) -> Vec<Target> {
    let mut out = vec![transforms(dir), lights(), images()];
    out.extend(colmap());
    out.push(folder(dir, "folder_transforms", "transforms_train.json", false));
    out.push(folder(dir, "folder_exclusions", "exclude_list.txt", false));
    out.push(folder(dir, "folder_lights", "lights.json", false));
    out.push(folder(dir, "folder_image", "train/r_0_l_0.png", false));
    out.push(folder(dir, "folder_points", "points3d.ply", false));
    out.push(folder(dir, "first_step", "transforms_train.json", true));
    out
}

fn name() -> &'static Path {
    Path::new("input")
}

fn transforms(dir: &Path) -> Target {
    let blender = br#"{"camera_angle_x": 0.69, "frames": [{"file_path": "./train/r_0", "rotation": 0.01,
        "light_position": [1.0, 2.0, 3.0], "transform_matrix": [[1,0,0,0.5],[0,1,0,0],[0,0,1,4],[0,0,0,1]]}]}"#;
    let seed = dir.join("seed");
    tiny_capture(&seed, 2, 2);
    let ours = std::fs::read(seed.join("transforms_train.json")).unwrap();
    let seeds = vec![ours, blender.to_vec(), asset("fixtures/foreign-captures/nerfstudio/transforms.json")];
    let check = |bytes: &[u8]| match parse_transforms(name(), bytes) {
        Err(e) => Answer::refused(e),
        Ok(frames) => {
            for frame in &frames.frames {
                law("pose", frame.pose.validate())?;
                law("distortion", frame.distortion.validate())?;
                for entry in &frame.entries {
                    entry.light.map_or(Ok(()), |l| law("light", l.validate()))?;
                    if !(entry.weight.is_finite() && entry.weight >= 0.0) {
                        return Err(format!("weight {}", entry.weight));
                    }
                }
            }
            Ok(Answer::Parsed)
        }
    };
    Target { cases: 1000, ..Target::new("transforms", seeds, check).text() }
}

fn lights() -> Target {
    let full = br#"{"frame": "camera", "default": {"position": [0, 0, 2], "intensity": [1, 1, 1]}, "images": {
        "a_*": {"direction": [0, 0, 1], "weight": 0.5}, "b.png": [{"image": "b_0.png", "position": [1, 2, 3]},
        {"image": "b_1.png", "position": [1, 2, 4], "provenance": "synthetic:relit"}]}}"#;
    let seeds = vec![
        full.to_vec(),
        asset("fixtures/foreign-captures/nerfstudio/lights.json"),
        asset("fixtures/foreign-captures/pycolmap-text/lights.json"),
    ];
    let check = |bytes: &[u8]| match parse_lights(name(), bytes) {
        Err(e) => Answer::refused(e),
        Ok(lights) => {
            for entry in lights.default.iter().chain(lights.rules.iter().flat_map(|(_, entries)| entries)) {
                law("light", entry.light.validate())?;
                if entry.weight.is_some_and(|w| !(w.is_finite() && w >= 0.0)) {
                    return Err(format!("weight {:?}", entry.weight));
                }
            }
            Ok(Answer::Parsed)
        }
    };
    Target { cases: 1000, ..Target::new("lights", seeds, check).text() }
}

fn colmap() -> Vec<Target> {
    let seed =
        |kind: &str, file: &str| vec![asset(&format!("fixtures/foreign-captures/pycolmap-{kind}/sparse/0/{file}"))];
    let cameras = |encoding| {
        move |bytes: &[u8]| match parse_colmap_cameras(name(), bytes, encoding) {
            Err(e) => Answer::refused(e),
            Ok(cameras) => {
                for camera in &cameras {
                    law("intrinsics", camera.intrinsics.validate())?;
                    law("distortion", camera.distortion.validate())?;
                }
                Ok(Answer::Parsed)
            }
        }
    };
    let images = |encoding| {
        move |bytes: &[u8]| match parse_colmap_images(name(), bytes, encoding) {
            Err(e) => Answer::refused(e),
            Ok(images) => {
                images.iter().try_for_each(|image| law("pose", image.pose.validate()))?;
                Ok(Answer::Parsed)
            }
        }
    };
    let points = |encoding| {
        move |bytes: &[u8]| match parse_colmap_points(name(), bytes, encoding) {
            Err(e) => Answer::refused(e),
            Ok(points) if points.positions.len() != points.colours.len() => Err("a point without a colour".into()),
            Ok(points) if points.positions.iter().any(|p| !p.length_squared().is_finite()) => {
                Err("a point far out".into())
            }
            Ok(_) => Ok(Answer::Parsed),
        }
    };
    let (text, binary) = (ColmapEncoding::Text, ColmapEncoding::Binary);
    vec![
        Target::new("colmap_cameras_text", seed("text", "cameras.txt"), cameras(text)).text(),
        Target::new("colmap_images_text", seed("text", "images.txt"), images(text)).text(),
        Target::new("colmap_points_text", seed("text", "points3D.txt"), points(text)).text(),
        Target::new("colmap_cameras_binary", seed("binary", "cameras.bin"), cameras(binary)),
        Target::new("colmap_images_binary", seed("binary", "images.bin"), images(binary)),
        Target::new("colmap_points_binary", seed("binary", "points3D.bin"), points(binary)),
    ]
}

/// Larger images are refused by the reader.
const MAX_PIXELS: u64 = 1 << 20;

fn images() -> Target {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../assets/fixtures/foreign-captures/images/images");
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    files.sort();
    let seeds = files.iter().map(|file| std::fs::read(file).unwrap()).collect();
    let check = |bytes: &[u8]| match decode_image(name(), bytes, MAX_PIXELS) {
        Err(e) => Answer::refused(e),
        Ok((width, height, channels)) => {
            let fits = u64::from(width) * u64::from(height) <= MAX_PIXELS && (1..=4).contains(&channels);
            if fits { Ok(Answer::Parsed) } else { Err(format!("{width}×{height}×{channels}")) }
        }
    };
    Target { wrap: with_checksums, cases: 600, ..Target::new("image", seeds, check) }
}

/// Half of the time, corrects the checksums of a PNG's chunks, so that what is in them is looked at.
fn with_checksums(mut bytes: Vec<u8>, random: &mut Random) -> Vec<u8> {
    if !bytes.starts_with(b"\x89PNG") || random.one_in(2) {
        return bytes;
    }
    let mut at = 8;
    while let Some(length) = bytes.get(at..at + 4) {
        let length = u32::from_be_bytes([length[0], length[1], length[2], length[3]]) as usize;
        let Some(end) = (at + 8).checked_add(length).filter(|end| end + 4 <= bytes.len()) else { break };
        let sum = !bytes[at + 4..end].iter().fold(!0u32, |sum, b| {
            (0..8).fold(sum ^ u32::from(*b), |s, _| if s & 1 == 1 { (s >> 1) ^ 0xEDB8_8320 } else { s >> 1 })
        });
        bytes[end..end + 4].copy_from_slice(&sum.to_be_bytes());
        at = end + 4;
    }
    bytes
}

/// A tiny capture in which one file is bad. With `train`, what can be opened is also trained on for a step.
fn folder(dir: &Path, target: &'static str, file: &'static str, train: bool) -> Target {
    let capture = folder_in(dir, target).join("capture");
    tiny_capture(&capture, 2, 2);
    let seed = match file {
        "exclude_list.txt" => b"# not these\nr_0_l_1\ntrain/r_1_l_0.png\n".to_vec(),
        "lights.json" => br#"{"default": {"position": [1, 2, 3], "intensity": [2, 2, 2]}}"#.to_vec(),
        "points3d.ply" => {
            b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
            property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n0 0 0 9 9 9\n0.1 0.2 0.3 1 2 3\n\
            0.3 0.1 0.2 255 0 7\n"
                .to_vec()
        }
        _ => std::fs::read(capture.join(file)).unwrap(),
    };
    let config = Config::parse(&small_config_text(), "small").unwrap();
    let check = move |bytes: &[u8]| {
        std::fs::write(capture.join(file), bytes).map_err(|e| e.to_string())?;
        let options = OpenOptions { max_pixels: 1 << 14, ..OpenOptions::default() };
        let opened = match Capture::open(&capture, &options) {
            Err(e) => return Answer::refused(e),
            Ok(opened) => opened,
        };
        let root = capture.canonicalize().map_err(|e| e.to_string())?;
        for view in opened.train.iter().chain(&opened.test) {
            law("camera", view.camera.validate())?;
            for shot in &view.shots {
                law("light", shot.light.validate())?;
                if !shot.path.starts_with(&root) {
                    return Err(format!("{} lies outside", shot.path.display()));
                }
                match opened.observation(shot) {
                    Err(e) => return Answer::refused(e),
                    Ok(seen) if seen.radiance.data().iter().any(|v| !v.is_finite()) => return Err("radiance".into()),
                    Ok(_) => {}
                }
            }
        }
        let _ = diamond_sss::inspect_text(&opened);
        let _ = opened.select(&Selection::Count(1), &Selection::Count(1));
        if !train {
            return Ok(Answer::Parsed);
        }
        let mut run = match Reconstruction::new(opened, &config) {
            Err(e) => return Answer::refused(e),
            Ok(run) => run,
        };
        match run.step() {
            Err(e) => Answer::refused(e),
            Ok(report) if !report.objective.is_finite() => Err(format!("objective {}", report.objective)),
            Ok(_) => Ok(Answer::Parsed),
        }
    };
    let out = Target::new(target, vec![seed], check);
    let text = !file.ends_with("png");
    Target { text, cases: if train { 24 } else { 100 }, ..out }
}
