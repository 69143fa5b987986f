//! `transforms*.json`: cameras with their images.
//!
//! A frame of the SSS-3DGS layout has arrays `file_paths`, `light_positions` (or `light_directions`) and, if wanted,
//! `light_intensities`, `weights`, `provenances`, all of one length. A frame of the NeRF and nerfstudio layouts has one
//! `file_path` with, if wanted, one `light_position` (or `light_direction`, `light_intensity`, `weight`, `provenance`) and
//! a `mask_path`. Light positions are in world axes as written; a light direction points from the scene to the light.
//! Lights that a frame does not give come from `lights.json`. Intrinsics: `lens.rs`.
use crate::field::Object;
use crate::lens::{Lens, parse_distortion, parse_lens};
use crate::{DatasetError, Place, Provenance};
use diamond_camera::{Distortion, Pose};
use diamond_light::OlatLight;
use glam::{Mat4, Vec3};
use serde_json::Value;
use std::path::Path;

/// The largest JSON file that is read, bytes (a hundred times the largest known capture's).
pub(crate) const MAX_JSON_BYTES: u64 = 512 << 20;

/// The parsed content of one `transforms*.json`, or of a COLMAP model.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Frames {
    /// The cameras.
    pub frames: Vec<Frame>,
    /// Remarks for the user: what was ignored, and why.
    pub notes: Vec<String>,
    /// Path of the point cloud (`ply_file_path`), relative to the file.
    pub points: Option<String>,
    /// `applied_transform`: from the world of the program that found the cameras to the world of this file.
    pub applied_transform: Option<Mat4>,
    /// `train_filenames`, as written.
    pub train_files: Option<Vec<String>>,
    /// `test_filenames`, else `val_filenames`, as written.
    pub test_files: Option<Vec<String>>,
}

/// One camera and its images.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Index in the file.
    pub index: usize,
    /// World to camera.
    pub pose: Pose,
    /// Intrinsics, of the images as stored.
    pub lens: Lens,
    /// Lens distortion of the images as stored.
    pub distortion: Distortion,
    /// Image width, pixels, where the file says it.
    pub width: Option<u32>,
    /// Image height, pixels, where the file says it.
    pub height: Option<u32>,
    /// The images.
    pub entries: Vec<Entry>,
}

/// One image of a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// The path as written, relative to the capture's folder.
    pub file: String,
    /// The field that names it.
    pub place: Place,
    /// The light, where the frame gives it.
    pub light: Option<OlatLight>,
    /// The field in which a light is looked for, for error messages.
    pub light_field: String,
    /// Where the image comes from.
    pub provenance: Provenance,
    /// Weight in the photometric losses, at least 0.
    pub weight: f32,
    /// The path of its mask as written.
    pub mask: Option<String>,
}

/// Reads and checks one `transforms*.json`.
pub(crate) fn read_frames(path: &Path) -> Result<Frames, DatasetError> {
    let text = crate::folder::read_text(path, MAX_JSON_BYTES, "read the frames")?;
    parse_frames(path, &text)
}

/// Parses and checks the bytes of one `transforms*.json`; `path` is only named in errors.
pub fn parse_transforms(path: &Path, bytes: &[u8]) -> Result<Frames, DatasetError> {
    parse_frames(path, crate::folder::as_text(path, bytes)?)
}

fn parse_frames(path: &Path, text: &str) -> Result<Frames, DatasetError> {
    let root = crate::field::parse_json(path, text)?;
    let top = Object::new(&root, path, None, "an object with camera_angle_x and frames")?;
    let frames = top.array("frames")?.ok_or_else(|| {
        top.error("frames", "an array of frames", "nothing", "add \"frames\": [..] with one entry per camera")
    })?;
    let names = |field: &str| -> Result<Option<Vec<String>>, DatasetError> {
        let Some(items) = top.array(field)? else { return Ok(None) };
        items.iter().map(|v| top.as_text(v, field).map(str::to_string)).collect::<Result<_, _>>().map(Some)
    };
    let test_files = names("test_filenames")?.filter(|list| !list.is_empty());
    let mut out = Frames {
        points: top.get("ply_file_path").map(|v| top.as_text(v, "ply_file_path")).transpose()?.map(str::to_string),
        applied_transform: top.get("applied_transform").map(|_| top.matrix("applied_transform")).transpose()?,
        train_files: names("train_filenames")?,
        test_files: if test_files.is_some() { test_files } else { names("val_filenames")? },
        ..Frames::default()
    };
    for (index, value) in frames.iter().enumerate() {
        let object = Object::new(value, path, Some(index), "an object that describes one camera")?;
        let frame = parse_frame(&top, &object, index)?;
        if frame.entries.is_empty() {
            out.notes.push(format!("{}, frame {index}: no images, so this camera is left out", path.display()));
        }
        out.frames.push(frame);
    }
    Ok(out)
}

fn parse_frame(top: &Object, frame: &Object, index: usize) -> Result<Frame, DatasetError> {
    const MATRIX: &str = "transform_matrix";
    let pose = Pose::from_opengl_camera_to_world(frame.matrix(MATRIX)?).map_err(|e| {
        let advice = "write the camera-to-world matrix: rotation, translation, no mirroring; or leave the frame out";
        frame.error(MATRIX, "a finite rotation and translation", e.to_string(), advice)
    })?;
    let size = |names: [&str; 2]| -> Result<Option<u32>, DatasetError> {
        for object in [frame, top] {
            for name in names {
                if let Some(v) = object.size(name)? {
                    return Ok(Some(v));
                }
            }
        }
        Ok(None)
    };
    Ok(Frame {
        index,
        pose,
        lens: parse_lens(top, frame)?,
        distortion: parse_distortion(top, frame)?,
        width: size(["width", "w"])?,
        height: size(["height", "h"])?,
        entries: parse_entries(frame)?,
    })
}

fn parse_entries(frame: &Object) -> Result<Vec<Entry>, DatasetError> {
    let Some(files) = frame.array("file_paths")? else {
        let Some(file) = frame.get("file_path") else {
            let advice = "list the images of this camera, without extension";
            return Err(frame.error("file_paths", "an array of image paths", "nothing", advice));
        };
        let fields =
            ["light_position", "light_direction", "light_intensity", "weight", "provenance", "mask_path"].map(|name| {
                let value = frame.get(name);
                (name.to_string(), value)
            });
        return Ok(vec![parse_entry(frame, "file_path".to_string(), file, fields)?]);
    };
    let column = |name: &str| -> Result<Option<&[Value]>, DatasetError> {
        let items = frame.array(name)?;
        if let Some(items) = items
            && items.len() != files.len()
        {
            return Err(frame.error(
                name,
                format!("{} entries, one per entry of file_paths", files.len()),
                format!("{}", items.len()),
                "give each image its own entry, in the same order",
            ));
        }
        Ok(items)
    };
    let names = ["light_positions", "light_directions", "light_intensities", "weights", "provenances", "mask_paths"];
    let mut columns = [None; 6];
    for (slot, name) in columns.iter_mut().zip(names) {
        *slot = column(name)?;
    }
    let mut entries = Vec::with_capacity(files.len());
    for (k, file) in files.iter().enumerate() {
        let mut slot = 0;
        let fields = columns.map(|items| {
            let name = format!("{}[{k}]", names[slot]);
            slot += 1;
            (name, items.and_then(|items| items.get(k)).filter(|v| !v.is_null()))
        });
        entries.push(parse_entry(frame, format!("file_paths[{k}]"), file, fields)?);
    }
    Ok(entries)
}

/// One image: its path and, by name, its light position, light direction, light intensity, weight, provenance and mask.
fn parse_entry(
    frame: &Object,
    file_field: String,
    file: &Value,
    fields: [(String, Option<&Value>); 6],
) -> Result<Entry, DatasetError> {
    let text = match file {
        Value::String(text) => text.clone(),
        other => {
            return Err(frame.error(file_field, "a path in quotes", other.to_string(), "write the path as a string"));
        }
    };
    let [position, direction, intensity, weight, provenance, mask] = fields;
    let light_field = position.0.clone();
    Ok(Entry {
        file: text,
        place: frame.place(file_field),
        light: parse_light(frame, position, direction, intensity)?,
        light_field,
        provenance: parse_provenance(frame, provenance)?,
        weight: parse_weight(frame, weight)?,
        mask: mask.1.map(|v| frame.as_text(v, &mask.0).map(str::to_string)).transpose()?,
    })
}

/// A light from its position or else direction, and its intensity (1 where there is none).
pub(crate) fn parse_light(
    object: &Object,
    (at_position, position): (String, Option<&Value>),
    (at_direction, direction): (String, Option<&Value>),
    (at_intensity, intensity): (String, Option<&Value>),
) -> Result<Option<OlatLight>, DatasetError> {
    let intensity = intensity.map_or(Ok(Vec3::ONE), |v| object.as_intensity(v, &at_intensity))?;
    Ok(match (position, direction) {
        (Some(p), _) => Some(OlatLight::Point { position: object.as_vec3(p, &at_position)?, intensity }),
        (None, Some(d)) => {
            let v = object.as_vec3(d, &at_direction)?;
            let direction = v.try_normalize().ok_or_else(|| {
                let advice = "write the direction from the scene to the light";
                object.error(at_direction.as_str(), "a direction that is not zero", format!("{v}"), advice)
            })?;
            Some(OlatLight::Directional { direction, irradiance: intensity })
        }
        (None, None) => None,
    })
}

/// A weight, at least 0; 1 where there is none.
pub(crate) fn parse_weight(object: &Object, (at, value): (String, Option<&Value>)) -> Result<f32, DatasetError> {
    let Some(value) = value else { return Ok(1.0) };
    let w = object.as_number(value, &at)? as f32;
    if w < 0.0 {
        return Err(object.error(at, "a weight of at least 0", w.to_string(), "correct the value"));
    }
    Ok(w)
}

/// Where an image comes from; a photograph where nothing is said.
pub(crate) fn parse_provenance(
    object: &Object,
    (at, value): (String, Option<&Value>),
) -> Result<Provenance, DatasetError> {
    let Some(value) = value else { return Ok(Provenance::Photograph) };
    match object.as_text(value, &at)? {
        "photograph" => Ok(Provenance::Photograph),
        other => match other.strip_prefix("synthetic:") {
            Some(method) => Ok(Provenance::Synthetic { method: method.to_string() }),
            None => {
                let advice = "say how a synthetic image was made after the colon";
                Err(object.error(at, "\"photograph\" or \"synthetic:METHOD\"", other, advice))
            }
        },
    }
}
