//! How a capture is read and how the Gaussians begin.
use serde::{Deserialize, Serialize};

/// Transfer of the stored images.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StoredTransfer {
    /// sRGB.
    Srgb,
    /// Power law, exponent 2.2.
    Gamma22,
    /// Linear.
    Linear,
}

impl StoredTransfer {
    /// The transfer function it names.
    pub fn transfer(self) -> diamond_image::Transfer {
        match self {
            StoredTransfer::Srgb => diamond_image::Transfer::Srgb,
            StoredTransfer::Gamma22 => diamond_image::Transfer::Gamma22,
            StoredTransfer::Linear => diamond_image::Transfer::Linear,
        }
    }
}

/// How a capture is written down.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum InputFormat {
    /// What the folder holds.
    #[default]
    Auto,
    /// `transforms_train.json`.
    Blender,
    /// `transforms.json`.
    Nerfstudio,
    /// A COLMAP model.
    Colmap,
}

impl InputFormat {
    /// The format that was asked for, if one was.
    pub fn format(self) -> Option<diamond_dataset::CaptureFormat> {
        match self {
            InputFormat::Auto => None,
            InputFormat::Blender => Some(diamond_dataset::CaptureFormat::Blender),
            InputFormat::Nerfstudio => Some(diamond_dataset::CaptureFormat::Nerfstudio),
            InputFormat::Colmap => Some(diamond_dataset::CaptureFormat::Colmap),
        }
    }
}

/// How images are read.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Input {
    /// Format of the capture.
    #[serde(default)]
    pub format: InputFormat,
    /// Transfer of EXR images.
    #[serde(default = "linear")]
    pub exr_transfer: StoredTransfer,
    /// Every so manyth view of a nerfstudio or COLMAP capture is held out if the capture holds none out; 0 holds none out.
    #[serde(default = "eighth")]
    pub hold_out_every: usize,
    /// Transfer of the stored PNG and JPEG images.
    pub transfer: StoredTransfer,
    /// Bytes that decoded images may occupy at a time.
    pub cache_bytes: usize,
}

fn linear() -> StoredTransfer {
    StoredTransfer::Linear
}

fn eighth() -> usize {
    8
}

/// Where the first Gaussians come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum InitialSource {
    /// Point cloud if the capture has one, else the visual hull of the masks, else uniform in the scene's bounds.
    Auto,
    /// The capture's point cloud; an error if there is none.
    Points,
    /// Visual hull of the masks; an error if no view has a mask.
    Hull,
    /// Uniform in the scene's bounds.
    Uniform,
}

/// Where the first normals come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum InitialNormals {
    /// From the neighbourhood of each point, pointing outward.
    Outward,
    /// Uniform on the sphere.
    Random,
}

/// How the Gaussians begin.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Initial {
    /// Where the positions come from.
    pub source: InitialSource,
    /// At most this many Gaussians at the start.
    pub count: usize,
    /// Voxels along the longest side of the visual hull.
    pub hull_resolution: usize,
    /// Where the normals come from.
    pub normals: InitialNormals,
    /// Opacity, in (0, 1).
    pub opacity: f32,
    /// Thickness along the normal as a fraction of the width: 1 for round, less for flat Gaussians.
    pub flatness: f32,
}

/// Form in which covariances are optimised.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Covariance {
    /// Three standard deviations and a quaternion.
    #[default]
    RotationScale,
    /// A lower triangular factor: Σ = L Lᵀ, six numbers.
    Cholesky,
}

/// What a Gaussian is made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelForm {
    /// Form of the covariance.
    pub covariance: Covariance,
}
