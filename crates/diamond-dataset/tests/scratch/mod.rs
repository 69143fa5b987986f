//! Folders and files that the tests of captures make and break.
#![allow(dead_code, reason = "each test binary uses a part")]
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_dataset::*;
use diamond_image::{Image, Mask};
use diamond_light::OlatLight;
use glam::Vec3;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// A folder of a test's own, removed when it is dropped.
pub struct Scratch(pub PathBuf);

impl Scratch {
    pub fn new() -> Self {
        static NEXT: AtomicUsize = AtomicUsize::new(0);
        let name = format!("capture-{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
        std::fs::create_dir_all(&path).unwrap();
        Scratch(path)
    }

    pub fn write(&self, relative: &str, bytes: impl AsRef<[u8]>) {
        let path = self.0.join(relative);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }

    pub fn open(&self) -> Result<Capture, DatasetError> {
        Capture::open(&self.0, &OpenOptions::default())
    }

    /// The message of the error of opening, which must be one.
    pub fn refusal(&self) -> String {
        self.open().expect_err("this capture must be refused").to_string()
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// A PNG of any colour type.
pub fn png(width: u32, height: u32, colour: image::ExtendedColorType, samples: &[u8]) -> Vec<u8> {
    let mut out = std::io::Cursor::new(Vec::new());
    image::write_buffer_with_format(&mut out, samples, width, height, colour, image::ImageFormat::Png).unwrap();
    out.into_inner()
}

/// A 4 × 2 RGBA PNG.
pub fn small_png() -> Vec<u8> {
    let samples: Vec<u8> = (0..8).flat_map(|i| [10 * i, 5, 3, 255]).collect();
    png(4, 2, image::ExtendedColorType::Rgba8, &samples)
}

/// A camera-to-world matrix that looks from +z at the origin.
pub fn matrix() -> Value {
    json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]])
}

/// One frame with two images under two lights.
pub fn frame() -> Value {
    json!({
        "file_paths": ["train/r_0_l_0", "train/r_0_l_1"],
        "light_positions": [[0, 0, 5], [3, 0, 4]],
        "transform_matrix": matrix(), "width": 4, "height": 2,
    })
}

/// A valid capture of one view and two lights, whose JSON `change` may break.
pub fn capture_with(change: impl FnOnce(&mut Value)) -> Scratch {
    let scratch = Scratch::new();
    let mut root = json!({"camera_angle_x": 0.6, "frames": [frame()]});
    change(&mut root);
    scratch.write("transforms_train.json", root.to_string());
    scratch.write("train/r_0_l_0.png", small_png());
    scratch.write("train/r_0_l_1.png", small_png());
    scratch
}

/// A view from `eye` toward the origin with `lights`, images `width` × `height`.
pub fn view(index: usize, eye: Vec3, lights: &[OlatLight], (width, height): (u32, u32)) -> ViewDescription {
    let mut intrinsics = Intrinsics::from_fov_x(0.6, width, height);
    intrinsics.cx += 0.25 * index as f32;
    ViewDescription {
        camera: Camera { intrinsics, pose: Pose::look_at(eye, Vec3::ZERO, Vec3::Z) },
        shots: lights
            .iter()
            .enumerate()
            .map(|(l, &light)| ShotDescription {
                name: format!("r_{index}_l_{l}"),
                light,
                provenance: Provenance::Photograph,
                weight: 1.0,
            })
            .collect(),
    }
}

/// Pixels that depend on view and shot: a ramp of radiance and a disc of coverage.
pub fn pixels(view: usize, shot: usize, (width, height): (u32, u32)) -> Pixels {
    let (w, h) = (width as usize, height as usize);
    let coverage: Vec<f32> = (0..w * h).map(|i| if (i % w + i / w) % 3 == 0 { 0.5 } else { 1.0 }).collect();
    let value = |i: usize| ((i * 7 + view * 31 + shot * 13) % 97) as f32 / 97.0;
    let radiance = (0..w * h * 3).map(|i| value(i) * coverage[i / 3]).collect();
    (Image::from_vec(w, h, 3, radiance).unwrap(), Some(Mask::from_vec(w, h, coverage).unwrap()))
}

/// The example capture that the repository ships.
pub fn spot_small() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/captures/spot-small")
}
