//! What views and lights say about the shape: consistency of views, photometric stereo.
use serde::{Deserialize, Serialize};

/// What a difference of silhouettes costs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SettingPenalty {
    /// Binary cross-entropy.
    #[default]
    Bce,
    /// Absolute difference.
    L1,
}

/// Which kind of depth is compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SettingDepthKind {
    /// View-space z.
    #[default]
    Z,
    /// Euclidean distance from the camera.
    Distance,
}

/// Which of the two views is a constant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SettingDetach {
    /// Neither.
    #[default]
    None,
    /// The view of the photograph, from which points are taken.
    Source,
    /// The other view, in which they are looked up.
    Target,
}

/// What another view's silhouette is compared with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ConsistencyLabel {
    /// The photograph's mask where it has one, else as `constant`.
    #[default]
    Mask,
    /// The rendered silhouette of the photograph's view, as a constant.
    Constant,
    /// The rendered silhouette of the photograph's view, which is pulled on as well.
    Rendered,
}

/// Agreement of views about shape: which views are compared, when, and how. The weights are in `[loss]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Consistency {
    /// Fraction of the run from which views are compared, but not before the first round of density control…
    pub from: f32,
    /// …and until which.
    pub until: f32,
    /// At every so manyth step, with so many times the weight.
    pub every_steps: u64,
    /// Each view is compared with one of so many nearest by angle, drawn anew each time.
    pub neighbours: usize,
    /// At most so many pixels per pair of views.
    pub pixels: usize,
    /// Size of the other view's picture over that of its photograph, in (0, 1].
    pub target_scale: f32,
    /// What a difference of silhouettes costs.
    pub penalty: SettingPenalty,
    /// Which kind of depth is compared.
    pub depth: SettingDepthKind,
    /// What another view's silhouette is compared with.
    pub label: ConsistencyLabel,
    /// Which of the two views is a constant.
    pub detach: SettingDetach,
    /// A pixel shows the object where the opacity is above this, in [0, 1).
    pub min_opacity: f32,
    /// A point is hidden where depths differ by this share or more.
    pub max_gap: f32,
    /// The depth term leaves out points whose surface, by the photograph's view, faces the other camera with a smaller cosine than this; −1 for
    /// none.
    pub min_facing: f32,
}

impl Default for Consistency {
    fn default() -> Self {
        Self {
            from: 0.0,
            until: 1.0,
            every_steps: 4,
            neighbours: 2,
            pixels: 4096,
            target_scale: 0.5,
            penalty: SettingPenalty::default(),
            depth: SettingDepthKind::default(),
            label: ConsistencyLabel::default(),
            detach: SettingDetach::default(),
            min_opacity: 0.5,
            max_gap: 0.05,
            min_facing: -1.0,
        }
    }
}

/// Photometric stereo of views that have three photographs or more: what its normals and depth are used for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Photometric {
    /// Whether the first normals are turned toward what the views say that see them.
    pub initial: bool,
    /// Weight of the rendered normals' squared distance from the estimated ones; 0 for none.
    pub supervise: f32,
    /// Fraction of the run at which that weight has faded to 0, evenly from the first step.
    pub until: f32,
    /// Whether the estimated depth stands for the photograph's view where views are compared (`[consistency]`).
    pub depth: bool,
}

impl Default for Photometric {
    fn default() -> Self {
        Self { initial: false, supervise: 0.0, until: 0.5, depth: false }
    }
}
