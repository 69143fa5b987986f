//! What carries light through the object.
use serde::{Deserialize, Serialize};

/// What carries light through the object.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub enum SubsurfaceModel {
    /// The network and the transfer vectors of `[residual]` alone.
    #[default]
    #[serde(rename = "mlp")]
    Mlp,
    /// A homogeneous medium by a radial profile.
    #[serde(rename = "profile")]
    Profile,
    /// A homogeneous medium by random walks.
    #[serde(rename = "walk")]
    Walk,
    /// A profile, and `[residual]` for what it leaves.
    #[serde(rename = "profile+mlp")]
    ProfileMlp,
    /// Random walks, and `[residual]` for what they leave.
    #[serde(rename = "walk+mlp")]
    WalkMlp,
}

impl SubsurfaceModel {
    /// Whether a medium is fitted.
    pub fn has_medium(self) -> bool {
        self != SubsurfaceModel::Mlp
    }

    /// Whether light is carried by random walks.
    pub fn walks(self) -> bool {
        matches!(self, SubsurfaceModel::Walk | SubsurfaceModel::WalkMlp)
    }

    /// Whether `[residual]` adds to it.
    pub fn has_residual(self) -> bool {
        !matches!(self, SubsurfaceModel::Profile | SubsurfaceModel::Walk)
    }
}

/// Light through the object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Subsurface {
    /// What carries it.
    pub model: SubsurfaceModel,
    /// Fraction of the run after which surface and medium are first fitted.
    pub from: f32,
    /// Fractions of the run after which they are fitted again, ascending.
    pub refit: Vec<f32>,
    /// A mesh (PLY or OBJ, in the capture's frame) that takes the place of the surface of the model; relative to the capture's folder, or
    /// if it is not there to where the program was started.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub surface: Option<std::path::PathBuf>,
    /// Cells of the surface along the longest side of the object.
    pub resolution: u32,
    /// Standard deviation of a point's weight in the surface, cells.
    pub smoothing: f32,
    /// Surfels between which light is carried, about.
    pub surfels: usize,
    /// Gaussians of a profile.
    pub widths: usize,
    /// When the first medium comes in, replace the Gaussians by about so many on the surface; 0 keeps them.
    pub seeds: usize,
    /// Factor on the learning rates of shape (means, covariances, opacities) once there is a medium.
    pub shape_rate: f32,
    /// Factor on the learning rate of normals once there is a medium.
    pub normal_rate: f32,
    /// How far the first Gaussians lie under the surface, their standard deviations.
    pub inset: f32,
    /// Their standard deviation along the surface, widths of the piece that each stands for.
    pub seed_width: f32,
    /// Factor on the learning rates of materials, tints among them, once there is a medium, for 400 photographs or more; n < 400 have √(n / 400) of it.
    pub material_rate: f32,
    /// Pull of what the residual adds toward nothing, over the number of training views.
    pub residual_weight: f32,
}

impl Default for Subsurface {
    fn default() -> Self {
        Self {
            model: SubsurfaceModel::Mlp,
            from: 0.0,
            refit: Vec::new(),
            surface: None,
            resolution: 80,
            smoothing: 1.0,
            surfels: 6000,
            widths: 12,
            seeds: 6000,
            inset: 1.5,
            seed_width: 0.55,
            shape_rate: 0.3,
            normal_rate: 0.1,
            material_rate: 0.1,
            residual_weight: 3.0,
        }
    }
}
