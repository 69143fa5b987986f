//! `transforms_*.json`: the frames of one split, one camera with many lights each.
//!
//! A frame of the SSS-3DGS layout has arrays `file_paths`, `light_positions` (or `light_directions`) and, if wanted,
//! `light_intensities`, `weights`, `provenances`, all of one length. A frame of the NeRF layout has one `file_path` with
//! one `light_position` (or `light_direction`, `light_intensity`, `weight`, `provenance`). Light positions are in world
//! axes as written; a light direction points from the scene to the light. Intrinsics may stand in the frame or, as a
//! default for all frames, at the top level: `fl_x fl_y cx cy` in pixels, else `camera_angle_x` in radians.
use crate::field::Object;
use crate::{DatasetError, Place, Provenance};
use diamond_camera::Pose;
use diamond_light::OlatLight;
use glam::Vec3;
use serde_json::Value;
use std::path::Path;

/// The largest JSON file that is read, bytes (a hundred times the largest known capture's).
const MAX_JSON_BYTES: u64 = 512 << 20;

/// The parsed content of one `transforms_*.json`.
#[derive(Debug, Default)]
pub(crate) struct Frames {
    pub(crate) frames: Vec<Frame>,
    /// Remarks for the user: what was ignored, and why.
    pub(crate) notes: Vec<String>,
}

/// One camera and its images.
#[derive(Debug)]
pub(crate) struct Frame {
    /// Index in the file.
    pub(crate) index: usize,
    pub(crate) pose: Pose,
    pub(crate) lens: Lens,
    /// Image width, where the file says it.
    pub(crate) width: Option<u32>,
    /// Image height, where the file says it.
    pub(crate) height: Option<u32>,
    pub(crate) entries: Vec<Entry>,
}

/// Intrinsics as written; the image size may still be unknown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Lens {
    /// Horizontal field of view in radians.
    FovX { fov_x: f32, cx: Option<f32>, cy: Option<f32> },
    /// Focal lengths in pixels.
    Focal { fx: f32, fy: f32, cx: Option<f32>, cy: Option<f32> },
}

/// One image of a frame.
#[derive(Debug)]
pub(crate) struct Entry {
    /// The path as written, relative to the capture's folder.
    pub(crate) file: String,
    /// The field that names it.
    pub(crate) place: Place,
    pub(crate) light: OlatLight,
    pub(crate) provenance: Provenance,
    pub(crate) weight: f32,
}

/// Reads and checks one `transforms_*.json`.
pub(crate) fn read_frames(path: &Path) -> Result<Frames, DatasetError> {
    let text = crate::folder::read_text(path, MAX_JSON_BYTES, "read the frames")?;
    parse_frames(path, &text)
}

/// Parses and checks the text of one `transforms_*.json`; `path` is only named in errors.
pub(crate) fn parse_frames(path: &Path, text: &str) -> Result<Frames, DatasetError> {
    let root: Value = serde_json::from_str(text).map_err(|e| DatasetError::Json {
        path: path.to_path_buf(),
        line: e.line(),
        column: e.column(),
        reason: e.to_string(),
    })?;
    let top = Object::new(&root, path, None, "an object with camera_angle_x and frames")?;
    let frames = top.array("frames")?.ok_or_else(|| {
        top.error("frames", "an array of frames", "nothing", "add \"frames\": [..] with one entry per camera")
    })?;
    let mut out = Frames::default();
    for (index, value) in frames.iter().enumerate() {
        let object = Object::new(value, path, Some(index), "an object that describes one camera")?;
        let frame = parse_frame(&top, &object, index)?;
        if frame.entries.is_empty() {
            out.notes.push(format!("{}, frame {index}: no images, so this camera is left out", path.display()));
        }
        out.frames.push(frame);
    }
    for field in ["k1", "k2", "k3", "k4", "p1", "p2"] {
        let distorted = |o: &Object| o.get(field).and_then(Value::as_f64).is_some_and(|v| v != 0.0);
        let in_frame =
            frames.iter().enumerate().any(|(i, v)| Object::new(v, path, Some(i), "").is_ok_and(|o| distorted(&o)));
        if distorted(&top) || in_frame {
            out.notes
                .push(format!("{}: lens distortion {field} is ignored; undistort the images first", path.display()));
        }
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
        width: size(["width", "w"])?,
        height: size(["height", "h"])?,
        entries: parse_entries(frame)?,
    })
}

/// Intrinsics: those of the frame go before those of the top level, focal lengths before angles.
fn parse_lens(top: &Object, frame: &Object) -> Result<Lens, DatasetError> {
    let either = |name: &str| -> Result<Option<f32>, DatasetError> {
        Ok(match frame.number(name)? {
            Some(v) => Some(v as f32),
            None => top.number(name)?.map(|v| v as f32),
        })
    };
    let (cx, cy) = (either("cx")?, either("cy")?);
    let focal = |object: &Object| -> Result<Option<Lens>, DatasetError> {
        let Some(fx) = object.number("fl_x")?.map(|v| v as f32) else { return Ok(None) };
        let fy = object.number("fl_y")?.map_or(fx, |v| v as f32);
        for (name, v) in [("fl_x", fx), ("fl_y", fy)] {
            // Below a thousandth of a pixel nothing can be projected without overflow.
            if v < 1e-3 {
                return Err(object.error(
                    name,
                    "a positive focal length in pixels",
                    v.to_string(),
                    "correct the value",
                ));
            }
        }
        Ok(Some(Lens::Focal { fx, fy, cx, cy }))
    };
    let angle = |object: &Object| -> Result<Option<Lens>, DatasetError> {
        let Some(fov_x) = object.number("camera_angle_x")?.map(|v| v as f32) else { return Ok(None) };
        if !(1e-4..=std::f32::consts::PI - 1e-3).contains(&fov_x) {
            return Err(object.error(
                "camera_angle_x",
                "a horizontal field of view in radians, between 0 and π",
                fov_x.to_string(),
                "convert degrees to radians",
            ));
        }
        Ok(Some(Lens::FovX { fov_x, cx, cy }))
    };
    let lenses = [focal(frame)?, angle(frame)?, focal(top)?, angle(top)?];
    if let Some(lens) = lenses.into_iter().flatten().next() {
        return Ok(lens);
    }
    let advice = "add camera_angle_x (radians) at the top level, or fl_x fl_y cx cy (pixels) to the frame";
    Err(frame.error("camera_angle_x", "a field of view or a focal length", "neither", advice))
}

fn parse_entries(frame: &Object) -> Result<Vec<Entry>, DatasetError> {
    let Some(files) = frame.array("file_paths")? else {
        let Some(file) = frame.get("file_path") else {
            let advice = "list the images of this camera, without extension";
            return Err(frame.error("file_paths", "an array of image paths", "nothing", advice));
        };
        let fields = ["light_position", "light_direction", "light_intensity", "weight", "provenance"].map(|name| {
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
    let names = ["light_positions", "light_directions", "light_intensities", "weights", "provenances"];
    let mut columns = [None; 5];
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

/// One image: its path and, by name, its light position, light direction, light intensity, weight and provenance.
fn parse_entry(
    frame: &Object,
    file_field: String,
    file: &Value,
    fields: [(String, Option<&Value>); 5],
) -> Result<Entry, DatasetError> {
    let text = match file {
        Value::String(text) => text.clone(),
        other => {
            return Err(frame.error(file_field, "a path in quotes", other.to_string(), "write the path as a string"));
        }
    };
    let [(at_position, position), (at_direction, direction), (at_intensity, intensity), weight, provenance] = fields;
    let intensity = intensity.map_or(Ok(Vec3::ONE), |v| frame.as_intensity(v, &at_intensity))?;
    let light = match (position, direction) {
        (Some(p), _) => OlatLight::Point { position: frame.as_vec3(p, &at_position)?, intensity },
        (None, Some(d)) => {
            let v = frame.as_vec3(d, &at_direction)?;
            let direction = v.try_normalize().ok_or_else(|| {
                let advice = "write the direction from the scene to the light";
                frame.error(at_direction.as_str(), "a direction that is not zero", format!("{v}"), advice)
            })?;
            OlatLight::Directional { direction, irradiance: intensity }
        }
        (None, None) => {
            let advice = "one-light-at-a-time captures need the light of each image: add its position in world axes";
            return Err(frame.error(at_position, "a light position (or direction)", "nothing", advice));
        }
    };
    let weight = match weight {
        (_, None) => 1.0,
        (at, Some(v)) => {
            let w = frame.as_number(v, &at)? as f32;
            if w < 0.0 {
                return Err(frame.error(at, "a weight of at least 0", w.to_string(), "correct the value"));
            }
            w
        }
    };
    let provenance = match provenance {
        (_, None) => Provenance::Photograph,
        (at, Some(v)) => match frame.as_text(v, &at)? {
            "photograph" => Provenance::Photograph,
            other => match other.strip_prefix("synthetic:") {
                Some(method) => Provenance::Synthetic { method: method.to_string() },
                None => {
                    let advice = "say how a synthetic image was made after the colon";
                    return Err(frame.error(at, "\"photograph\" or \"synthetic:METHOD\"", other, advice));
                }
            },
        },
    };
    Ok(Entry { file: text, place: frame.place(file_field), light, provenance, weight })
}
