//! Which cameras to render from: a view of a capture, an orbit, or a file.
use crate::{RunRecord, SssError, StoredCamera};
use diamond_camera::{Camera, Trajectory};
use diamond_dataset::Capture;
use glam::Vec3;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Which cameras to render from.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum CameraChoice {
    /// The first training camera.
    #[default]
    First,
    /// A view of a capture: held-out views if there are any, else training views.
    View {
        /// The capture; else the training cameras of the run.
        capture: Option<PathBuf>,
        /// Index of the view.
        index: usize,
    },
    /// So many cameras on a circle round the object that begins at the first training camera.
    Orbit(usize),
    /// Cameras of a JSON file; see [`read_cameras`].
    File(PathBuf),
}

/// Reads cameras: one object, an array, or an object with `frames`. Each camera has `transform_matrix` (camera to world,
/// OpenGL axes) and `width`, `height` and either `fl_x` (`fl_y`, `cx`, `cy` optional) or `camera_angle_x`; what all
/// share may stand beside `frames`.
pub fn read_cameras(path: &Path) -> Result<Vec<Camera>, SssError> {
    parse_cameras(path, &std::fs::read(path).map_err(SssError::io(path, "read"))?)
}

/// Reads the bytes of a file of cameras, see [`read_cameras`]; `path` is only named in errors.
pub fn parse_cameras(path: &Path, bytes: &[u8]) -> Result<Vec<Camera>, SssError> {
    let value: Value = crate::output_file::parse_json(path, bytes, "a camera as JSON")?;
    let (frames, shared) = match &value {
        Value::Array(frames) => (frames.clone(), json!({})),
        Value::Object(map) => match map.get("frames") {
            Some(Value::Array(frames)) => (frames.clone(), value.clone()),
            Some(_) => return Err(bad(path, "`frames` must be an array")),
            None => (vec![value.clone()], json!({})),
        },
        _ => return Err(bad(path, "expected an object or an array of cameras")),
    };
    if frames.is_empty() {
        return Err(bad(path, "it holds no camera"));
    }
    frames.iter().enumerate().map(|(i, frame)| camera_of(path, i, frame, &shared)).collect()
}

fn bad(path: &Path, detail: &str) -> SssError {
    SssError::Input { path: path.to_owned(), detail: detail.to_owned() }
}

fn camera_of(path: &Path, index: usize, frame: &Value, shared: &Value) -> Result<Camera, SssError> {
    let get = |names: &[&str]| -> Option<f64> {
        names.iter().find_map(|n| frame.get(n).or_else(|| shared.get(n))).and_then(Value::as_f64)
    };
    let need = |names: &[&str]| {
        get(names).ok_or_else(|| bad(path, &format!("camera {index}: the number `{}` is missing", names[0])))
    };
    let (width, height) = (need(&["width", "w"])?, need(&["height", "h"])?);
    let focal = match get(&["fl_x"]) {
        Some(f) => f,
        None => 0.5 * width / libm::tan(0.5 * need(&["camera_angle_x", "fl_x"])?),
    };
    let matrix = frame
        .get("transform_matrix")
        .and_then(|m| serde_json::from_value::<Vec<[f32; 4]>>(m.clone()).ok())
        .and_then(|rows| <[[f32; 4]; 4]>::try_from(rows).ok())
        .ok_or_else(|| bad(path, &format!("camera {index}: `transform_matrix` must be four rows of four numbers")))?;
    StoredCamera {
        name: String::new(),
        transform_matrix: matrix,
        fl_x: focal as f32,
        fl_y: get(&["fl_y"]).unwrap_or(focal) as f32,
        cx: get(&["cx"]).unwrap_or(0.5 * width) as f32,
        cy: get(&["cy"]).unwrap_or(0.5 * height) as f32,
        width: width as u32,
        height: height as u32,
    }
    .camera(path)
}

/// The cameras of a choice with their names. `folder` is the run's, `centre` the object's.
pub fn cameras_of(
    choice: &CameraChoice,
    folder: &Path,
    record: Option<&RunRecord>,
    centre: Vec3,
) -> Result<Vec<(String, Camera)>, SssError> {
    let run_file = folder.join(crate::run_record::RUN_FILE);
    let no_record = || {
        bad(&run_file, "is missing, so no camera is known; give one with --camera FILE.json or --capture and --view")
    };
    let training = |index: usize| -> Result<(String, Camera), SssError> {
        let cameras = &record.ok_or_else(no_record)?.cameras;
        let stored = cameras.get(index).ok_or_else(|| no_view(index, cameras.len()))?;
        Ok((stored.name.clone(), stored.camera(&run_file)?))
    };
    match choice {
        CameraChoice::First => Ok(vec![training(0)?]),
        CameraChoice::View { capture: None, index } => Ok(vec![training(*index)?]),
        CameraChoice::View { capture: Some(path), index } => {
            let capture = Capture::open(path, &Default::default())?;
            let views = if capture.test.is_empty() { &capture.train } else { &capture.test };
            let view = views.get(*index).ok_or_else(|| no_view(*index, views.len()))?;
            Ok(vec![(view.name.clone(), view.camera)])
        }
        CameraChoice::Orbit(count) => {
            let (_, first) = training(0)?;
            let up = record.map_or(Vec3::Z, |r| Vec3::from(r.up));
            let path = Trajectory::orbit_from(&first.pose, centre, up).map_err(|e| SssError::Usage(e.to_string()))?;
            let poses = path.poses(*count);
            Ok(poses
                .into_iter()
                .enumerate()
                .map(|(i, pose)| (format!("frame_{i:04}"), Camera { pose, ..first }))
                .collect())
        }
        CameraChoice::File(path) => {
            Ok(read_cameras(path)?.into_iter().enumerate().map(|(i, c)| (format!("frame_{i:04}"), c)).collect())
        }
    }
}

fn no_view(index: usize, count: usize) -> SssError {
    SssError::Usage(format!(
        "view {index} does not exist, there are {count}: choose from 0 to {}",
        count.saturating_sub(1)
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_file_is_read_and_its_mistakes_are_named() {
        let path = std::env::temp_dir().join(format!("diamond-camera-{}.json", std::process::id()));
        let read = |text: &str| {
            std::fs::write(&path, text).unwrap();
            read_cameras(&path)
        };
        let matrix = "[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]";
        let one =
            read(&format!(r#"{{"camera_angle_x":1.0,"w":64,"h":48,"frames":[{{"transform_matrix":{matrix}}}]}}"#))
                .unwrap();
        assert_eq!((one.len(), one[0].intrinsics.width, one[0].pose.centre()), (1, 64, Vec3::new(0.0, 0.0, 4.0)));
        for (text, word) in [
            ("{", "JSON"),
            ("3", "object"),
            (r#"{"frames":[]}"#, "no camera"),
            (r#"{"width":4,"height":4,"fl_x":5}"#, "transform_matrix"),
            (&format!(r#"{{"width":4,"height":4,"transform_matrix":{matrix}}}"#), "camera_angle_x"),
            (&format!(r#"{{"width":0,"height":4,"fl_x":5,"transform_matrix":{matrix}}}"#), "idth"),
        ] {
            let error = read(text).unwrap_err();
            assert!(error.to_string().contains(word), "{text}: {error}");
            assert_eq!(error.exit_code(), 3);
        }
        std::fs::remove_file(path).unwrap();
    }
}
