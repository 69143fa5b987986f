//! COLMAP models: `cameras`, `images` and `points3D`, as text or binary.
//!
//! COLMAP's axes are ours: world to camera, x right, y down, z ahead, pixel centres at +0.5. What is read: cameras with
//! their lens, poses and names of the images, and positions and colours of the points. What is skipped: features, tracks,
//! reprojection errors, rigs and frames.
mod binary;
mod text;

use crate::frames::{Entry, Frame, Frames};
use crate::lens::{Lens, UNDISTORT};
use crate::{DatasetError, Place, Provenance};
use diamond_camera::{Distortion, Intrinsics, Pose};
use glam::{DQuat, DVec3, Vec3};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// How a model's file is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColmapEncoding {
    /// `.txt`
    Text,
    /// `.bin`
    Binary,
}

/// A camera of a model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ColmapCamera {
    /// Its number in the model.
    pub id: u32,
    /// Intrinsics of the images as stored.
    pub intrinsics: Intrinsics,
    /// Lens distortion.
    pub distortion: Distortion,
}

/// An image of a model.
#[derive(Debug, Clone, PartialEq)]
pub struct ColmapImage {
    /// Its number in the model.
    pub id: u32,
    /// File name, relative to the folder of images.
    pub name: String,
    /// World to camera.
    pub pose: Pose,
    /// Number of its camera.
    pub camera: u32,
}

/// The points of a model.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ColmapPoints {
    /// Positions, world, scene units.
    pub positions: Vec<Vec3>,
    /// Colours, sRGB.
    pub colours: Vec<[u8; 3]>,
}

/// The largest file of a model that is read, bytes.
const MAX_MODEL_BYTES: u64 = 4 << 30;

/// The largest coordinate that is accepted, scene units: squared lengths must stay finite in `f32`.
const MAX_COORDINATE: f64 = 1e15;

/// COLMAP's camera models in the order of their numbers, with the number of their parameters.
const MODELS: [(&str, usize); 12] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
];

/// Parses the bytes of `cameras.txt` or `cameras.bin`; `path` is only named in errors.
pub fn parse_colmap_cameras(
    path: &Path,
    bytes: &[u8],
    encoding: ColmapEncoding,
) -> Result<Vec<ColmapCamera>, DatasetError> {
    match encoding {
        ColmapEncoding::Text => text::cameras(path, bytes),
        ColmapEncoding::Binary => binary::cameras(path, bytes),
    }
}

/// Parses the bytes of `images.txt` or `images.bin`; `path` is only named in errors.
pub fn parse_colmap_images(
    path: &Path,
    bytes: &[u8],
    encoding: ColmapEncoding,
) -> Result<Vec<ColmapImage>, DatasetError> {
    match encoding {
        ColmapEncoding::Text => text::images(path, bytes),
        ColmapEncoding::Binary => binary::images(path, bytes),
    }
}

/// Parses the bytes of `points3D.txt` or `points3D.bin`; `path` is only named in errors.
pub fn parse_colmap_points(path: &Path, bytes: &[u8], encoding: ColmapEncoding) -> Result<ColmapPoints, DatasetError> {
    match encoding {
        ColmapEncoding::Text => text::points(path, bytes),
        ColmapEncoding::Binary => binary::points(path, bytes),
    }
}

/// Reads a file `points3D.txt` or `points3D.bin`, told apart by the extension.
pub fn read_colmap_points(path: &Path) -> Result<ColmapPoints, DatasetError> {
    let bytes = crate::folder::read_bytes(path, MAX_MODEL_BYTES, "read the points of the model")?;
    let binary = path.extension().is_some_and(|e| e == "bin");
    parse_colmap_points(path, &bytes, if binary { ColmapEncoding::Binary } else { ColmapEncoding::Text })
}

/// An error at a place inside a file of a model.
fn error(
    path: &Path,
    at: impl Into<String>,
    expected: impl Into<String>,
    found: impl Into<String>,
    advice: &'static str,
) -> DatasetError {
    DatasetError::Field {
        place: Place { file: path.to_path_buf(), frame: None, field: Some(at.into()) }.into(),
        expected: expected.into(),
        found: found.into(),
        advice,
    }
}

/// What to do about a damaged model.
const EXPORT: &str = "export the model again (colmap model_converter)";

/// A camera from its parameters in the order of its model; `at` says where it stands.
fn camera(
    path: &Path,
    at: &str,
    id: u32,
    model: &str,
    (width, height): (u64, u64),
    p: &[f64],
) -> Result<ColmapCamera, DatasetError> {
    let known = MODELS.iter().find(|(name, _)| *name == model);
    let brown = |k1, k2, p1, p2| Distortion::Brown { k1, k2, k3: 0.0, p1, p2 };
    let fisheye = |k1, k2, k3, k4| Distortion::Fisheye { k1, k2, k3, k4 };
    let (fx, fy, cx, cy, distortion) = match (model, p) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => (f, f, cx, cy, Distortion::None),
        ("PINHOLE", &[fx, fy, cx, cy]) => (fx, fy, cx, cy, Distortion::None),
        ("SIMPLE_RADIAL", &[f, cx, cy, k1]) => (f, f, cx, cy, brown(k1, 0.0, 0.0, 0.0)),
        ("RADIAL", &[f, cx, cy, k1, k2]) => (f, f, cx, cy, brown(k1, k2, 0.0, 0.0)),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => (fx, fy, cx, cy, brown(k1, k2, p1, p2)),
        ("OPENCV_FISHEYE", &[fx, fy, cx, cy, k1, k2, k3, k4]) => (fx, fy, cx, cy, fisheye(k1, k2, k3, k4)),
        ("SIMPLE_RADIAL_FISHEYE", &[f, cx, cy, k1]) => (f, f, cx, cy, fisheye(k1, 0.0, 0.0, 0.0)),
        ("RADIAL_FISHEYE", &[f, cx, cy, k1, k2]) => (f, f, cx, cy, fisheye(k1, k2, 0.0, 0.0)),
        _ => match known {
            Some((_, n)) if *n != p.len() => {
                return Err(error(path, at, format!("{n} parameters of {model}"), format!("{}", p.len()), EXPORT));
            }
            _ => {
                let expected = "a camera model of SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, \
                                OPENCV_FISHEYE, SIMPLE_RADIAL_FISHEYE or RADIAL_FISHEYE";
                return Err(error(path, at, expected, model, UNDISTORT));
            }
        },
    };
    let distortion = if distortion.is_none() { Distortion::None } else { distortion };
    let size = |v: u64| u32::try_from(v).unwrap_or(0);
    let intrinsics = Intrinsics {
        fx: fx as f32,
        fy: fy as f32,
        cx: cx as f32,
        cy: cy as f32,
        width: size(width),
        height: size(height),
    };
    let usable = intrinsics.validate().and_then(|()| distortion.validate());
    if let Err(e) = usable {
        return Err(error(path, at, "intrinsics of a camera", e.to_string(), EXPORT));
    }
    if intrinsics.fx < 1e-3 || intrinsics.fy < 1e-3 {
        return Err(error(path, at, "a focal length of at least 0.001 pixels", format!("{fx}, {fy}"), EXPORT));
    }
    Ok(ColmapCamera { id, intrinsics, distortion })
}

/// A pose from `qw qx qy qz tx ty tz`.
fn pose(path: &Path, at: &str, v: [f64; 7]) -> Result<Pose, DatasetError> {
    let bad = |found: String| {
        let expected = "a world-to-camera quaternion qw qx qy qz and translation tx ty tz";
        let advice = "export the model again, or take the image out of it";
        error(path, at, expected, found, advice)
    };
    let q = DQuat::from_xyzw(v[1], v[2], v[3], v[0]);
    let t = DVec3::new(v[4], v[5], v[6]);
    let length = q.length();
    if !(length.is_finite() && length > 1e-8 && t.is_finite() && t.abs().max_element() <= MAX_COORDINATE) {
        return Err(bad(format!("{} {} {} {} | {} {} {}", v[0], v[1], v[2], v[3], v[4], v[5], v[6])));
    }
    let rotation = glam::DMat3::from_quat(q / length).as_mat3();
    Pose::new(rotation, t.as_vec3()).map_err(|e| bad(e.to_string()))
}

/// A point's position.
fn position(path: &Path, at: &str, v: [f64; 3]) -> Result<Vec3, DatasetError> {
    if v.iter().all(|x| x.abs() <= MAX_COORDINATE) {
        return Ok(Vec3::new(v[0] as f32, v[1] as f32, v[2] as f32));
    }
    Err(error(path, at, "three finite coordinates", format!("{} {} {}", v[0], v[1], v[2]), EXPORT))
}

/// A model on disk: its folder and how it is written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Model {
    pub(crate) cameras: PathBuf,
    pub(crate) images: PathBuf,
    pub(crate) points: Option<PathBuf>,
    encoding: ColmapEncoding,
}

impl Model {
    /// The model in a folder, binary before text; `None` where cameras and images are not both there.
    pub(crate) fn find(folder: &Path) -> Option<Model> {
        for (extension, encoding) in [("bin", ColmapEncoding::Binary), ("txt", ColmapEncoding::Text)] {
            let file = |name: &str| Some(folder.join(format!("{name}.{extension}"))).filter(|p| p.is_file());
            if let (Some(cameras), Some(images)) = (file("cameras"), file("images")) {
                return Some(Model { cameras, images, points: file("points3D"), encoding });
            }
        }
        None
    }

    /// The folder.
    pub(crate) fn folder(&self) -> &Path {
        self.cameras.parent().unwrap_or(&self.cameras)
    }

    /// Cameras and images as frames, one image each, in the order of their names.
    pub(crate) fn read(&self) -> Result<Frames, DatasetError> {
        let bytes = crate::folder::read_bytes(&self.cameras, MAX_MODEL_BYTES, "read the cameras of the model")?;
        let cameras = parse_colmap_cameras(&self.cameras, &bytes, self.encoding)?;
        let bytes = crate::folder::read_bytes(&self.images, MAX_MODEL_BYTES, "read the images of the model")?;
        let mut images = parse_colmap_images(&self.images, &bytes, self.encoding)?;
        drop(bytes);
        images.sort_by(|a, b| a.name.cmp(&b.name));
        let cameras: BTreeMap<u32, ColmapCamera> = cameras.into_iter().map(|c| (c.id, c)).collect();
        let mut out = Frames::default();
        for (index, image) in images.into_iter().enumerate() {
            let at = format!("image {} (\"{}\")", image.id, image.name);
            let camera = cameras.get(&image.camera).ok_or_else(|| {
                error(
                    &self.images,
                    at.as_str(),
                    format!("the number of a camera in {}", self.cameras.display()),
                    image.camera.to_string(),
                    "use cameras and images of the same model",
                )
            })?;
            let k = camera.intrinsics;
            out.frames.push(Frame {
                index,
                pose: image.pose,
                lens: Lens::Focal { fx: k.fx, fy: k.fy, cx: Some(k.cx), cy: Some(k.cy) },
                distortion: camera.distortion,
                width: Some(k.width),
                height: Some(k.height),
                entries: vec![Entry {
                    file: image.name,
                    place: Place { file: self.images.clone(), frame: None, field: Some(at.clone()) },
                    light: None,
                    light_field: at,
                    provenance: Provenance::Photograph,
                    weight: 1.0,
                    mask: None,
                }],
            });
        }
        Ok(out)
    }
}
