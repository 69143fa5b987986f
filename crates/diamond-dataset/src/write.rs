//! Writing a capture in the SSS-3DGS layout, so that a folder is either whole or not there. Other formats: `write_other.rs`.
use crate::{Capture, DatasetError, OpenOptions, Place, Provenance, Split};
use diamond_camera::Camera;
use diamond_image::{Image, Mask, Transfer};
use diamond_light::OlatLight;
use serde_json::{Map, Value, json};
use std::collections::BTreeSet;
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Bits per sample of written PNGs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum BitDepth {
    /// 8 bits.
    #[default]
    Eight,
    /// 16 bits.
    Sixteen,
}

/// One image to write.
#[derive(Debug, Clone, PartialEq)]
pub struct ShotDescription {
    /// File name without extension, unique within the split; letters, digits, `_`, `-`, `.`, `+`.
    pub name: String,
    /// The light, in world axes.
    pub light: OlatLight,
    /// Where the image comes from.
    pub provenance: Provenance,
    /// Weight in the photometric losses, at least 0.
    pub weight: f32,
}

/// One camera and its images, to write.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewDescription {
    /// Intrinsics and pose.
    pub camera: Camera,
    /// The images.
    pub shots: Vec<ShotDescription>,
}

/// What a capture to be written consists of, except the pixels.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CaptureDescription {
    /// Training views; at least one image.
    pub train: Vec<ViewDescription>,
    /// Held-out views; may be empty, then no `transforms_test.json` is written.
    pub test: Vec<ViewDescription>,
    /// A point cloud to copy to `points3d.ply`.
    pub points: Option<PathBuf>,
    /// How radiance is stored.
    pub transfer: Transfer,
    /// Bits per sample.
    pub depth: BitDepth,
}

/// Pixels of one image: linear RGB over black (multiplied by coverage), and coverage if it is known. With it the PNG is
/// RGBA with premultiplied RGB, without it RGB.
pub type Pixels = (Image, Option<Mask>);

/// Writes a capture to the folder `dir`, which must not exist yet. `pixels` is asked for the image of
/// `(split, view, shot)` in order, so that only one needs to be in memory.
///
/// Everything is written to a hidden folder beside `dir`, synchronised to disk, and renamed: after a crash `dir` is either
/// whole or absent. Radiance outside `[0, 1]` is clamped. The result opens with the given transfer,
/// [`crate::AlphaPremultiplied::Yes`], and otherwise default options.
///
/// Errors: the folder exists, names are unusable or not unique, an image has another size than its camera or is not
/// finite, a light or weight is not finite, no training image, or the system's; what `pixels` returns is passed on.
pub fn write_capture(
    dir: &Path,
    description: &CaptureDescription,
    mut pixels: impl FnMut(Split, usize, usize) -> Result<Pixels, DatasetError>,
) -> Result<(), DatasetError> {
    whole_or_absent(dir, description, |folder| write_into(folder, description, &mut pixels))
}

/// The name of a capture that does not exist yet and has an image.
pub(crate) fn check_new(dir: &Path, description: &CaptureDescription) -> Result<String, DatasetError> {
    let refuse = |reason: &str| DatasetError::Write { path: dir.to_path_buf(), reason: reason.to_string() };
    if dir.symlink_metadata().is_ok() {
        return Err(refuse("the folder exists already; choose another, or remove it"));
    }
    let name = dir.file_name().ok_or_else(|| refuse("the path has no name; name the folder to be written"))?;
    if description.train.iter().all(|view| view.shots.is_empty()) {
        return Err(refuse("there is no training image; describe at least one"));
    }
    Ok(name.to_string_lossy().into_owned())
}

/// Lets `write` fill a hidden folder beside `dir`, and renames it to `dir` when all of it is on disk.
pub(crate) fn whole_or_absent(
    dir: &Path,
    description: &CaptureDescription,
    write: impl FnOnce(&Path) -> Result<(), DatasetError>,
) -> Result<(), DatasetError> {
    let name = check_new(dir, description)?;
    let parent = dir.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::fs::create_dir_all(parent).map_err(|e| DatasetError::io(parent, "create the folder", e))?;
    let temporary = parent.join(format!(".{name}.partial-{}", std::process::id()));
    let cleared = match std::fs::remove_dir_all(&temporary) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(DatasetError::io(&temporary, "clear the folder", e)),
        _ => Ok(()),
    };
    let written = cleared.and_then(|()| write(&temporary)).and_then(|()| {
        std::fs::rename(&temporary, dir).map_err(|e| DatasetError::io(dir, "rename the finished capture", e))?;
        sync_folder(parent)
    });
    if written.is_err() {
        // What remains of a failed attempt is of no use; if it cannot be removed, the first error matters more.
        let _ = std::fs::remove_dir_all(&temporary);
    }
    written
}

fn write_into(
    dir: &Path,
    description: &CaptureDescription,
    pixels: &mut impl FnMut(Split, usize, usize) -> Result<Pixels, DatasetError>,
) -> Result<(), DatasetError> {
    create_folder(dir)?;
    for (split, folder, views) in splits(description) {
        create_folder(&dir.join(folder))?;
        // A name that cannot be used is found before any image is asked for.
        frames(dir, folder, views)?;
        for (v, view) in views.iter().enumerate() {
            for (s, shot) in view.shots.iter().enumerate() {
                let path = image_path(dir, folder, shot);
                let bytes =
                    encode(&path, &view.camera, &pixels(split, v, s)?, description.transfer, description.depth)?;
                write_synced(&path, &bytes)?;
            }
        }
    }
    write_transforms(dir, description)?;
    write_points(dir, description)?;
    sync_folder(dir)
}

/// The splits that have views, with the names of their folders.
pub(crate) fn splits(description: &CaptureDescription) -> impl Iterator<Item = (Split, &str, &[ViewDescription])> {
    let all = [(Split::Train, "train", &description.train), (Split::Test, "test", &description.test)];
    all.into_iter().filter(|(.., views)| !views.is_empty()).map(|(split, folder, views)| (split, folder, &views[..]))
}

/// Where an image of a split's folder is written.
pub(crate) fn image_path(dir: &Path, folder: &str, shot: &ShotDescription) -> PathBuf {
    dir.join(folder).join(format!("{}.png", shot.name))
}

/// The frames of a split, as `transforms_*.json` has them.
pub(crate) fn frames(dir: &Path, folder: &str, views: &[ViewDescription]) -> Result<Vec<Value>, DatasetError> {
    let mut names = BTreeSet::new();
    views.iter().map(|view| frame_json(dir, folder, view, &mut names)).collect()
}

/// Writes `transforms_*.json`, after the images that it names.
pub(crate) fn write_transforms(dir: &Path, description: &CaptureDescription) -> Result<(), DatasetError> {
    for (_, folder, views) in splits(description) {
        let camera = &views[0].camera.intrinsics;
        let fov_x = 2.0 * libm::atan(0.5 * f64::from(camera.width) / f64::from(camera.fx));
        let json = json!({ "camera_angle_x": fov_x, "frames": frames(dir, folder, views)? });
        write_synced(&dir.join(format!("transforms_{folder}.json")), format!("{json:#}\n").as_bytes())?;
        sync_folder(&dir.join(folder))?;
    }
    Ok(())
}

pub(crate) fn create_folder(path: &Path) -> Result<(), DatasetError> {
    std::fs::create_dir_all(path).map_err(|e| DatasetError::io(path, "create the folder", e))
}

/// Copies the point cloud to `points3d.ply`; the points of a COLMAP model become one.
pub(crate) fn write_points(dir: &Path, description: &CaptureDescription) -> Result<(), DatasetError> {
    let Some(points) = &description.points else { return Ok(()) };
    let bytes = if points.extension().is_some_and(|e| e == "bin" || e == "txt") {
        let cloud = crate::read_colmap_points(points)?;
        let mut text = format!("ply\nformat ascii 1.0\nelement vertex {}\n", cloud.positions.len());
        for axis in ["x", "y", "z"] {
            text += &format!("property float {axis}\n");
        }
        for colour in ["red", "green", "blue"] {
            text += &format!("property uchar {colour}\n");
        }
        text += "end_header\n";
        for (p, [r, g, b]) in cloud.positions.iter().zip(&cloud.colours) {
            text += &format!("{} {} {} {r} {g} {b}\n", p.x, p.y, p.z);
        }
        text.into_bytes()
    } else {
        std::fs::read(points).map_err(|e| DatasetError::io(points, "read the point cloud", e))?
    };
    write_synced(&dir.join("points3d.ply"), &bytes)
}

/// Three or four numbers as JSON.
pub(crate) fn numbers(v: &[f32]) -> Value {
    Value::from(v.iter().map(|&x| f64::from(x)).collect::<Vec<_>>())
}

/// The text of a provenance.
pub(crate) fn provenance_text(p: &Provenance) -> String {
    match p {
        Provenance::Photograph => "photograph".to_string(),
        Provenance::Synthetic { method } => format!("synthetic:{method}"),
    }
}

/// Refuses names that no file can have, names that are taken, and lights and weights that are not finite.
pub(crate) fn check_shot(
    folder: &Path,
    shot: &ShotDescription,
    names: &mut BTreeSet<String>,
) -> Result<(), DatasetError> {
    let refuse = |reason: String| DatasetError::Write { path: folder.join(&shot.name), reason };
    let usable = |c: char| c.is_ascii_alphanumeric() || "_-.+".contains(c);
    if shot.name.is_empty() || shot.name.starts_with('.') || !shot.name.chars().all(usable) {
        return Err(refuse(format!("\"{}\" is no usable file name; use letters, digits, _ - . +", shot.name)));
    }
    // Case-insensitive file systems would merge names that differ in case only.
    if !names.insert(shot.name.to_ascii_lowercase()) {
        return Err(refuse("two images of this split have this name; make names unique".into()));
    }
    let (at, intensity) = match shot.light {
        OlatLight::Point { position, intensity } => (position, intensity),
        OlatLight::Directional { direction, irradiance } => (direction, irradiance),
    };
    let finite = at.is_finite() && intensity.is_finite() && intensity.min_element() >= 0.0;
    if !finite || !shot.weight.is_finite() || shot.weight < 0.0 {
        return Err(refuse(format!("light {:?} or weight {} is not finite or negative", shot.light, shot.weight)));
    }
    Ok(())
}

fn frame_json(
    dir: &Path,
    folder: &str,
    view: &ViewDescription,
    names: &mut BTreeSet<String>,
) -> Result<Value, DatasetError> {
    let mut frame = Map::new();
    let directional = view.shots.iter().any(|shot| matches!(shot.light, OlatLight::Directional { .. }));
    let (mut positions, mut directions, mut intensities) = (Vec::new(), Vec::new(), Vec::new());
    for shot in &view.shots {
        check_shot(&dir.join(folder), shot, names)?;
        let (position, direction, intensity) = match shot.light {
            OlatLight::Point { position, intensity } => (numbers(&position.to_array()), Value::Null, intensity),
            OlatLight::Directional { direction, irradiance } => {
                (Value::Null, numbers(&direction.to_array()), irradiance)
            }
        };
        positions.push(position);
        directions.push(direction);
        intensities.push(numbers(&intensity.to_array()));
    }
    let paths: Vec<String> = view.shots.iter().map(|shot| format!("{folder}/{}", shot.name)).collect();
    frame.insert("file_paths".into(), json!(paths));
    frame.insert("light_positions".into(), positions.into());
    if directional {
        frame.insert("light_directions".into(), directions.into());
    }
    if intensities.iter().any(|v| *v != json!([1.0, 1.0, 1.0])) {
        frame.insert("light_intensities".into(), intensities.into());
    }
    if view.shots.iter().any(|shot| shot.weight != 1.0) {
        frame.insert("weights".into(), view.shots.iter().map(|shot| Value::from(f64::from(shot.weight))).collect());
    }
    if view.shots.iter().any(|shot| shot.provenance != Provenance::Photograph) {
        let texts = view.shots.iter().map(|shot| Value::from(provenance_text(&shot.provenance)));
        frame.insert("provenances".into(), texts.collect());
    }
    let matrix = view.camera.pose.to_opengl_camera_to_world().transpose().to_cols_array_2d();
    frame.insert("transform_matrix".into(), matrix.iter().map(|row| numbers(row)).collect());
    let k = &view.camera.intrinsics;
    for (field, v) in [("fl_x", k.fx), ("fl_y", k.fy), ("cx", k.cx), ("cy", k.cy)] {
        frame.insert(field.into(), f64::from(v).into());
    }
    frame.insert("width".into(), k.width.into());
    frame.insert("height".into(), k.height.into());
    Ok(Value::Object(frame))
}

/// An image as a PNG file.
pub(crate) fn encode(
    path: &Path,
    camera: &Camera,
    (radiance, mask): &Pixels,
    transfer: Transfer,
    depth: BitDepth,
) -> Result<Vec<u8>, DatasetError> {
    let refuse = |reason: String| DatasetError::Write { path: path.to_path_buf(), reason };
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    radiance
        .expect_shape((width as usize, height as usize, 3), "the radiance to be written")
        .map_err(|e| refuse(e.to_string()))?;
    if let Some((x, y, c)) = radiance.first_non_finite() {
        return Err(refuse(format!("radiance is not finite at pixel ({x}, {y}), channel {c}; correct the image")));
    }
    if let Some(mask) = mask {
        mask.as_image()
            .expect_shape((width as usize, height as usize, 1), "the mask to be written")
            .map_err(|e| refuse(e.to_string()))?;
    }
    let mut values = Vec::with_capacity(radiance.pixels() * 4);
    for (i, rgb) in radiance.data().chunks_exact(3).enumerate() {
        values.extend(rgb.iter().map(|v| transfer.encode(v.clamp(0.0, 1.0))));
        values.extend(mask.as_ref().map(|m| m.data()[i]));
    }
    let mut bytes = std::io::Cursor::new(Vec::new());
    let samples8 = || values.iter().map(|v| (v * 255.0).round() as u8).collect::<Vec<_>>();
    let samples16 = || values.iter().flat_map(|v| ((v * 65535.0).round() as u16).to_ne_bytes()).collect::<Vec<_>>();
    let (samples, colour) = match (depth, mask.is_some()) {
        (BitDepth::Eight, false) => (samples8(), image::ExtendedColorType::Rgb8),
        (BitDepth::Eight, true) => (samples8(), image::ExtendedColorType::Rgba8),
        (BitDepth::Sixteen, false) => (samples16(), image::ExtendedColorType::Rgb16),
        (BitDepth::Sixteen, true) => (samples16(), image::ExtendedColorType::Rgba16),
    };
    image::write_buffer_with_format(&mut bytes, &samples, width, height, colour, image::ImageFormat::Png)
        .map_err(|e| refuse(format!("cannot encode the PNG: {e}")))?;
    Ok(bytes.into_inner())
}

pub(crate) fn write_synced(path: &Path, bytes: &[u8]) -> Result<(), DatasetError> {
    let io = |e| DatasetError::io(path, "write the file", e);
    let mut file = File::create(path).map_err(io)?;
    file.write_all(bytes).map_err(io)?;
    file.sync_all().map_err(io)
}

/// Makes the names in a folder durable. Only Unix can open a folder for that; elsewhere the rename has to do.
pub(crate) fn sync_folder(dir: &Path) -> Result<(), DatasetError> {
    if cfg!(unix) {
        File::open(dir).and_then(|f| f.sync_all()).map_err(|e| DatasetError::io(dir, "synchronise the folder", e))?;
    }
    Ok(())
}

impl Capture {
    /// A description of this capture (or selection), to be written with [`write_capture`] and [`Capture::pixels_of`]:
    /// a copy with other images left out, added, or in another bit depth.
    pub fn describe(&self) -> CaptureDescription {
        let views = |views: &[crate::View]| {
            let shot = |shot: &crate::Shot| ShotDescription {
                name: shot.name.clone(),
                light: shot.light,
                provenance: shot.provenance.clone(),
                weight: shot.weight,
            };
            let view = |view: &crate::View| ViewDescription {
                camera: view.camera,
                shots: view.shots.iter().map(shot).collect(),
            };
            views.iter().map(view).collect()
        };
        CaptureDescription {
            train: views(&self.train),
            test: views(&self.test),
            points: self.points.clone(),
            transfer: self.options.transfer,
            depth: BitDepth::Eight,
        }
    }

    /// The pixels of the image `(split, view, shot)`, as [`write_capture`] asks for them.
    pub fn pixels_of(&self, split: Split, view: usize, shot: usize) -> Result<Pixels, DatasetError> {
        let found = self.views(split).get(view).and_then(|v| v.shots.get(shot));
        let shot = found.ok_or_else(|| DatasetError::Field {
            place: Place { file: self.root.clone(), frame: Some(view), field: Some(format!("shot {shot}")) }.into(),
            expected: "an image of this capture".into(),
            found: "nothing".into(),
            advice: "describe this capture, not another",
        })?;
        let observation = self.observation(shot)?;
        Ok((observation.radiance.clone(), observation.mask.clone()))
    }
}

impl CaptureDescription {
    /// The options with which a capture written from this description is read back as it was.
    pub fn open_options(&self) -> OpenOptions {
        OpenOptions {
            transfer: self.transfer,
            alpha_premultiplied: crate::AlphaPremultiplied::Yes,
            hold_out_every: 0,
            ..OpenOptions::default()
        }
    }
}
