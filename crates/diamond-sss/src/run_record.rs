//! What a run was asked for and what it learned from: `run.json`. Later commands need it to tell seen from unseen
//! lights, and to render without the capture.
use crate::SssError;
use crate::output_file::{parse_json, write_json};
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_dataset::Capture;
use diamond_light::OlatLight;
use glam::{Mat4, Vec3};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Pictures of more pixels are not rendered: 8192 × 8192.
const MAX_PIXELS: u64 = 64 << 20;

/// Name of the file in the run's folder.
pub(crate) const RUN_FILE: &str = "run.json";

/// A camera in the words of the capture format.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StoredCamera {
    /// Name of the view.
    #[serde(default)]
    pub name: String,
    /// Camera to world, OpenGL axes (the camera looks along −z, y up), rows.
    pub transform_matrix: [[f32; 4]; 4],
    /// Focal length along x, pixels.
    pub fl_x: f32,
    /// Focal length along y, pixels.
    pub fl_y: f32,
    /// Principal point x, pixels.
    pub cx: f32,
    /// Principal point y, pixels.
    pub cy: f32,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
}

impl StoredCamera {
    /// From a camera.
    pub fn of(name: &str, camera: &Camera) -> Self {
        let k = &camera.intrinsics;
        Self {
            name: name.to_owned(),
            transform_matrix: camera.pose.to_opengl_camera_to_world().transpose().to_cols_array_2d(),
            fl_x: k.fx,
            fl_y: k.fy,
            cx: k.cx,
            cy: k.cy,
            width: k.width,
            height: k.height,
        }
    }

    /// The camera; `file` is named in errors.
    pub fn camera(&self, file: &Path) -> Result<Camera, SssError> {
        let fail = |detail: String| SssError::Input { path: file.to_owned(), detail };
        let matrix = Mat4::from_cols_array_2d(&self.transform_matrix).transpose();
        let pose = Pose::from_opengl_camera_to_world(matrix).map_err(|e| fail(format!("transform_matrix: {e}")))?;
        let intrinsics = Intrinsics {
            fx: self.fl_x,
            fy: self.fl_y,
            cx: self.cx,
            cy: self.cy,
            width: self.width,
            height: self.height,
        };
        let camera = Camera { intrinsics, pose };
        camera.validate().map_err(|e| fail(e.to_string()))?;
        if u64::from(self.width) * u64::from(self.height) > MAX_PIXELS {
            return Err(fail(format!(
                "width and height: expected at most {MAX_PIXELS} pixels, found {}×{}",
                self.width, self.height
            )));
        }
        Ok(camera)
    }
}

/// A light: exactly one of position and direction.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StoredLight {
    /// Position of a point light, world.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub position: Option<[f32; 3]>,
    /// Unit direction from the scene to a light at infinity.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub direction: Option<[f32; 3]>,
    /// Linear RGB intensity.
    pub intensity: [f32; 3],
}

impl StoredLight {
    /// From a light.
    pub fn of(light: &OlatLight) -> Self {
        match *light {
            OlatLight::Point { position, intensity } => {
                Self { position: Some(position.into()), direction: None, intensity: intensity.into() }
            }
            OlatLight::Directional { direction, irradiance } => {
                Self { position: None, direction: Some(direction.into()), intensity: irradiance.into() }
            }
        }
    }

    /// The light; `file` is named in errors.
    pub fn light(&self, file: &Path) -> Result<OlatLight, SssError> {
        let fail = |detail: String| SssError::Input { path: file.to_owned(), detail };
        let intensity = Vec3::from(self.intensity);
        let light = match (self.position, self.direction) {
            (Some(p), None) => OlatLight::Point { position: Vec3::from(p), intensity },
            (None, Some(d)) => {
                OlatLight::directional(Vec3::from(d), intensity).map_err(|e| fail(format!("light: {e}")))?
            }
            _ => return Err(fail("a light must have either `position` or `direction`".into())),
        };
        light.validate().map_err(|e| fail(format!("light: {e}")))?;
        Ok(light)
    }
}

/// What a run was asked for and what it learned from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// Version of the program.
    pub version: String,
    /// The command line.
    pub command: String,
    /// The capture's folder.
    pub capture: PathBuf,
    /// The capture's hash.
    pub capture_hash: String,
    /// `--views`.
    pub views: String,
    /// `--lights`.
    pub lights: String,
    /// Preset or file.
    pub preset: String,
    /// Length of the run.
    pub steps: u64,
    /// Seed.
    pub seed: u64,
    /// Threads used (they change the speed and nothing else).
    pub threads: usize,
    /// Instruction set of the kernels, which decides last bits; empty in records of earlier versions.
    #[serde(default)]
    pub instruction_set: String,
    /// Images learned from.
    pub training_images: usize,
    /// Unit vector that is upward in most training views, world.
    pub up: [f32; 3],
    /// The training cameras.
    pub cameras: Vec<StoredCamera>,
    /// The different lights of the training images, at most [`RunRecord::MAX_RIG`].
    pub rig: Vec<StoredLight>,
    /// Seconds of all sessions so far; `None` while the first is under way.
    pub seconds: Option<f64>,
    /// Peak memory of all sessions so far, bytes.
    pub peak_bytes: Option<u64>,
}

impl RunRecord {
    /// At most this many lights are kept.
    pub const MAX_RIG: usize = 256;

    /// Upward in most views of a capture, world.
    pub(crate) fn up_of(capture: &Capture) -> Vec3 {
        // Row 1 of the rotation is the camera's y axis, downward in the picture.
        capture
            .train
            .iter()
            .map(|v| -v.camera.pose.rotation.row(1))
            .sum::<Vec3>()
            .try_normalize()
            .map_or(Vec3::Z, snap_to_axis)
    }

    /// The different lights of the training images of a capture, in order of first appearance.
    pub(crate) fn rig_of(capture: &Capture) -> Vec<OlatLight> {
        let mut out: Vec<OlatLight> = Vec::new();
        for shot in capture.train.iter().flat_map(|v| &v.shots) {
            if out.len() < Self::MAX_RIG && !out.contains(&shot.light) {
                out.push(shot.light);
            }
        }
        out
    }

    /// Writes `run.json` in the run's folder.
    pub fn write(&self, folder: &Path) -> Result<(), SssError> {
        write_json(&folder.join(RUN_FILE), self)
    }

    /// Reads `run.json` from the run's folder; `None` where there is none.
    pub fn read(folder: &Path) -> Result<Option<Self>, SssError> {
        let path = folder.join(RUN_FILE);
        if !path.is_file() {
            return Ok(None);
        }
        let bytes = std::fs::read(&path).map_err(SssError::io(&path, "read"))?;
        Self::parse(&path, &bytes).map(Some)
    }

    /// Reads the bytes of a `run.json`; `path` is only named in errors.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self, SssError> {
        parse_json(path, bytes, "what `diamond reconstruct` wrote")
    }
}

/// Directions this near to a world axis are taken to mean the axis: cos 20°.
const NEAR_AXIS: f32 = 0.94;

fn snap_to_axis(up: Vec3) -> Vec3 {
    let axis = [Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z].into_iter().find(|a| a.dot(up) > NEAR_AXIS);
    axis.unwrap_or(up)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_and_lights_survive() {
        let camera = Camera {
            intrinsics: Intrinsics::from_fov_x(0.7, 40, 30),
            pose: Pose::look_at(Vec3::new(2.0, 1.0, 0.5), Vec3::ZERO, Vec3::Z),
        };
        let again = StoredCamera::of("a", &camera).camera(Path::new("x")).unwrap();
        assert!((again.pose.centre() - camera.pose.centre()).length() < 1e-5);
        assert_eq!(again.intrinsics, camera.intrinsics);
        let light = OlatLight::Point { position: Vec3::ONE, intensity: Vec3::ONE };
        assert_eq!(StoredLight::of(&light).light(Path::new("x")).unwrap(), light);
        let none = StoredLight { position: None, direction: None, intensity: [1.0; 3] };
        assert!(none.light(Path::new("run.json")).unwrap_err().to_string().contains("run.json"));
    }
}
