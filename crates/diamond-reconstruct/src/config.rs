//! The configuration of a run: every number of the method, with presets, read from TOML.
//!
//! A file may name a `base` preset and say only what differs. Unknown keys are errors, so that a typing mistake never
//! silently leaves a default in place. Step numbers are fractions of the run's length unless the name says `steps`.
use crate::error::brief;
use crate::{AugmentationSettings, ByteSize, InstructionChoice, ReconstructError};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Names of the built-in presets, the default first.
pub const PRESETS: [&str; 3] = ["resolved", "sss-3dgs", "paper"];

/// Everything that a run needs to know.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Name of the preset (or file) that this came from; for reports only.
    pub name: String,
    /// Length of the run in steps.
    pub steps: u64,
    /// Seed of every random choice.
    pub seed: u64,
    /// (view, light) pairs whose gradients are averaged in one step.
    pub accumulate: u32,
    /// Steps between checkpoints.
    pub checkpoint_steps: u64,
    /// Instruction set of the kernels: `auto` (the fastest), `portable` (the same bits on every machine), `avx2`, `avx512`
    /// or `neon` (the same bits as each other).
    #[serde(default)]
    pub instruction_set: InstructionChoice,
    /// What the whole process may take at its peak, such as `"512 MiB"`; without it nothing is limited. What can be lowered
    /// without changing the result is lowered first, then `density.max_gaussians`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub memory_limit: Option<ByteSize>,
    /// How images are read.
    pub input: Input,
    /// How the Gaussians begin.
    pub initial: Initial,
    /// What a Gaussian is made of.
    pub model: ModelForm,
    /// The rasteriser's constants.
    pub splat: Splat,
    /// How Adam goes about it.
    #[serde(default)]
    pub adam: Adam,
    /// Adam's learning rates.
    pub rates: Rates,
    /// Gains between rendered radiance and photographs.
    pub exposure: ExposureSettings,
    /// Surface shading.
    pub shading: Shading,
    /// Subsurface residual.
    pub residual: Residual,
    /// Light through the object.
    #[serde(default)]
    pub subsurface: Subsurface,
    /// Ray-traced visibility.
    pub visibility: Visibility,
    /// Weights of the objective.
    pub loss: Loss,
    /// Agreement of views about shape.
    #[serde(default)]
    pub consistency: Consistency,
    /// Photometric stereo of single views.
    #[serde(default)]
    pub photometric: Photometric,
    /// Pictures that nobody took.
    #[serde(default)]
    pub augmentation: AugmentationSettings,
    /// Density control.
    pub density: Density,
}

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

impl Residual {
    /// Transfer values per Gaussian: three colours times (degree + 1)² harmonics, or none.
    pub fn transfer_width(&self) -> usize {
        let side = self.transfer_degree as usize + 1;
        if self.transfer { 3 * side * side } else { 0 }
    }
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

/// The rasteriser's constants.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Splat {
    /// Variance added to every projected Gaussian, px².
    pub low_pass: f32,
    /// Opacity of one Gaussian at one pixel never exceeds this.
    pub max_alpha: f32,
    /// Contributions below this are skipped.
    pub min_alpha: f32,
    /// A pixel is finished when its transmittance falls below this.
    pub min_transmittance: f32,
    /// Near plane as a fraction of the smallest distance from a camera to the scene's centre.
    pub near: f32,
    /// Smallest standard deviation of a Gaussian as a fraction of the scene's extent: below about 1e-6 it is a point
    /// whose conic loses all digits. With `max_scale` it bounds the eigenvalues of the covariance in either form.
    pub min_scale: f32,
    /// Largest standard deviation of a Gaussian as a fraction of the scene's extent.
    pub max_scale: f32,
}

/// How Adam goes about it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Adam {
    /// Leave attributes of Gaussians alone whose gradient is 0 in a step, moments included: less memory is moved, and what
    /// is not seen stays where it is. Without, the first moment carries them on for some steps.
    pub sparse: bool,
}

/// Adam's learning rates, per attribute.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rates {
    /// Mean at the start, × scene extent.
    pub mean: f32,
    /// Mean at the end of its decay, × scene extent.
    pub mean_final: f32,
    /// Fraction of the run over which the mean's rate falls log-linearly.
    pub mean_decay: f32,
    /// Log-scale.
    pub scale: f32,
    /// Rotation.
    pub rotation: f32,
    /// What lies below the diagonal of a lower factor, over the factor's size.
    pub shear: f32,
    /// Opacity logit.
    pub opacity: f32,
    /// Normal.
    pub normal: f32,
    /// Base colour, roughness, metalness, subsurfaceness logits.
    pub material: f32,
    /// SH visibility.
    pub visibility_sh: f32,
    /// Transfer vectors.
    pub transfer: f32,
    /// Latent codes.
    pub codes: f32,
    /// Networks at the start.
    pub network: f32,
    /// Networks at the end of the run (log-linear in between).
    pub network_final: f32,
    /// All Gaussian attributes but the mean fall log-linearly to this fraction of their rate at the end of the run.
    pub attribute_final: f32,
}

/// What has a gain of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ExposureMode {
    /// Nothing: photographs are radiance.
    Fixed,
    /// All photographs together; renderings have the gain.
    Global,
    /// Each view; the gains' geometric mean is 1, and renderings have gain 1.
    PerView,
    /// Each photograph; the gains' geometric mean is 1, and renderings have gain 1.
    PerImage,
}

/// How the unit of light is first chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FirstExposure {
    /// All but the brightest per cent of the photographs' foreground is at most white under the light.
    Highlights,
    /// The first renderings have the mean of the photographs.
    Mean,
}

/// Gains between rendered radiance and photographs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExposureSettings {
    /// What has a gain of its own.
    pub mode: ExposureMode,
    /// Whether red, green and blue have gains of their own.
    pub per_channel: bool,
    /// Share of the way to the gain that fits best, per visit of a photograph; falls as the rates of the Gaussians'
    /// attributes do. Below 1 the model has time to imitate a gain before it is found.
    pub rate: f32,
    /// Gains stay as they are before this fraction of the run…
    #[serde(default = "gains_from")]
    pub from: f32,
    /// …and after this one.
    #[serde(default = "gains_until")]
    pub until: f32,
    /// Shrinks the logarithm of a gain: it goes to 1/(1 + this) of the one that fits best.
    pub prior: f32,
    /// How the unit of light is first chosen.
    pub first: FirstExposure,
}

fn gains_from() -> f32 {
    0.1
}

fn gains_until() -> f32 {
    0.4
}

/// Masking–shadowing variant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MaskingVariant {
    /// Schlick's form with k = (r+1)²/8.
    SchlickRoughness,
    /// Exact Smith, separable.
    SmithSeparable,
    /// Exact Smith, height-correlated.
    SmithCorrelated,
    /// Schlick's form with k = α/2.
    SchlickHalfAlpha,
}

/// Fresnel variant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FresnelVariant {
    /// Schlick's fifth power.
    Schlick,
    /// The spherical-Gaussian fit.
    SphericalGaussian,
}

/// Diffuse variant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DiffuseVariant {
    /// (1−m)·c/π.
    Lambert,
    /// (1−F)·0.96·(1−m)·c/π.
    FresnelWeighted,
}

/// What lights the surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum IncidentVariant {
    /// The network's incident head times the light's intensity.
    Learned,
    /// Inverse-square falloff about `incident_reference`.
    InverseSquare,
    /// The intensity, without falloff.
    None,
}

/// How surface and residual are combined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CombineVariant {
    /// (1−s)·surface + s·residual.
    Lerp,
    /// surface + s·residual.
    Additive,
}

/// Whether the surface may be metal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MetalVariant {
    /// Learned, since photographs do not say; left out of renders of a model in which nothing turned out to be metal.
    Auto,
    /// Learned.
    Yes,
    /// A dielectric: metalness is 0, neither learned nor rasterised.
    No,
}

/// Surface shading.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shading {
    /// Metal.
    pub metal: MetalVariant,
    /// Masking–shadowing.
    pub masking: MaskingVariant,
    /// Fresnel.
    pub fresnel: FresnelVariant,
    /// Diffuse.
    pub diffuse: DiffuseVariant,
    /// Incident light.
    pub incident: IncidentVariant,
    /// Distance at which irradiance equals intensity, scene units; 0 means the mean light distance of the capture.
    pub incident_reference: f32,
    /// Height of the warm-up offset on learned incident light (4 in the predecessor).
    pub incident_warm_up: f32,
    /// Fraction of the run over which the offset rises (it falls over the next such fraction).
    pub incident_warm_up_fraction: f32,
    /// Whether the offset falls back to 0 at once, as in the predecessor.
    pub incident_warm_up_drop: bool,
    /// How surface and residual are combined.
    pub combine: CombineVariant,
    /// Divide the G-buffer by opacity before shading.
    pub normalise: bool,
    /// Multiply the surface term by visibility.
    pub surface_visibility: bool,
    /// Light that leaks below the horizon.
    pub horizon_leak: f32,
    /// Roughness is the constant 0.5 until this fraction of the run.
    pub roughness_unfreeze: f32,
}

/// Subsurface residual.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Residual {
    /// Whether the network is used.
    pub network: bool,
    /// Hidden widths of the trunk.
    pub hidden: Vec<usize>,
    /// Leak of the hidden activations; 0 for ReLU.
    pub leak: f32,
    /// Added to the incident head's first bias: with ReLU and 0 half of all starts are dark everywhere.
    pub incident_bias: f32,
    /// Whether the incident head passes its gradient on.
    pub incident_gradient: bool,
    /// Whether the network's gradient reaches the normals that it reads.
    pub normal_gradient: bool,
    /// Multiply the residual by the light's intensity (and falloff, where physical), which keeps it linear in light.
    pub scale_by_light: bool,
    /// Learned latent values per Gaussian that the network reads.
    pub codes: usize,
    /// Whether every Gaussian has transfer vectors: SH coefficients of a residual that is linear in the light.
    pub transfer: bool,
    /// Degree of the transfer vectors, at most 3.
    pub transfer_degree: u32,
    /// L2 shrinkage of the transfer vectors of degree l, × l².
    pub transfer_smoothness: f32,
}

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
    /// A mesh (PLY or OBJ, in the capture's frame) that takes the place of the surface of the model.
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
    /// Factor on the learning rates of materials, tints among them, once there is a medium.
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
            seed_width: 0.45,
            shape_rate: 0.3,
            normal_rate: 0.1,
            material_rate: 0.1,
            residual_weight: 3.0,
        }
    }
}

/// Ray-traced visibility.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Visibility {
    /// Whether rays are traced at all (else the SH fit alone is used).
    pub traced: bool,
    /// A light's visibility is traced again when it is older than this many steps.
    pub every_steps: u64,
    /// … and some Gaussians have moved, grown or turned by this share of their size, or changed in opacity by as much,
    /// since the last trace; 0 to trace whenever it is old.
    pub moved: f32,
    /// Random Gaussians per step on which the SH fit is compared.
    pub samples: usize,
}

/// Weights of the objective.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Loss {
    /// Space in which radiance is compared.
    pub space: StoredTransfer,
    /// λ of 1−SSIM; L1 has 1−λ.
    pub ssim: f32,
    /// Squared error in the same space.
    pub l2: f32,
    /// Mask cross-entropy.
    pub mask: f32,
    /// Normal against pseudo-normal.
    pub normal: f32,
    /// Smoothness of base colour.
    pub smooth_base_color: f32,
    /// Smoothness of metalness.
    pub smooth_metalness: f32,
    /// Smoothness of roughness.
    pub smooth_roughness: f32,
    /// Smoothness of subsurfaceness.
    pub smooth_subsurfaceness: f32,
    /// Base colour toward the enhanced photograph.
    pub enhancement: f32,
    /// Incident light against visibility.
    pub incident: f32,
    /// SH visibility against traced visibility.
    pub visibility: f32,
    /// LPIPS (0 without weights).
    pub lpips: f32,
    /// Silhouettes of different views against each other; how, says `[consistency]`.
    #[serde(default)]
    pub silhouette_consistency: f32,
    /// Depths of different views against each other.
    #[serde(default)]
    pub depth_consistency: f32,
}

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

/// How Gaussians are added, removed and moved.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DensityStrategy {
    /// Clone, split and prune by screen-space gradient, size and opacity; reset opacities.
    Adaptive,
    /// Relocate transparent Gaussians onto opaque ones, grow by a share per round, add noise to the means.
    Mcmc,
    /// The first Gaussians are the last.
    None,
}

/// Density control.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Density {
    /// Which kind.
    pub strategy: DensityStrategy,
    /// Steps between two rounds.
    pub every_steps: u64,
    /// First round, fraction of the run.
    pub from: f32,
    /// Last round, fraction of the run.
    pub until: f32,
    /// Mean screen-space positional gradient (NDC) at which a Gaussian is cloned or split.
    pub gradient_threshold: f32,
    /// Largest scale (× extent) that is cloned rather than split.
    pub percent_dense: f32,
    /// The two children of a split have their parent's scale divided by this.
    pub split_divisor: f32,
    /// Opacity below which a Gaussian is pruned, or relocated.
    pub prune_opacity: f32,
    /// Gaussians whose footprint had a larger radius than this (px) since the last round are pruned; 0 for never.
    pub max_screen_radius: f32,
    /// Gaussians with a larger standard deviation than this (× extent) are pruned unless a split helps; 0 for never.
    pub max_world_scale: f32,
    /// Fraction of the run from which too large Gaussians are pruned.
    pub large_from: f32,
    /// Opacity is reset every this fraction of the run; 0 for never.
    pub reset_every: f32,
    /// Opacity after a reset.
    pub reset_opacity: f32,
    /// Never more Gaussians than this, the first ones included. Where room is short the largest gradients win.
    pub max_gaussians: usize,
    /// From this fraction of the run the number of Gaussians stays what it is: nothing is cloned, split, pruned, added or
    /// reset; relocation goes on. 0 for the whole run, 1 for never.
    pub freeze_count: f32,
    /// What relocation needs to know.
    pub mcmc: Mcmc,
}

/// Relocation, noise and pressure of the `mcmc` strategy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mcmc {
    /// Share of the Gaussians that is added in each round, until `max_gaussians`.
    pub growth: f32,
    /// Noise on the means, over the learning rate and × Σ/extent².
    pub noise: f32,
    /// Steepness of the gate that spares opaque Gaussians from noise.
    pub noise_sharpness: f32,
    /// Opacity at which the gate is half open.
    pub noise_opacity: f32,
    /// Weight of the mean opacity in the objective.
    pub opacity_weight: f32,
    /// Weight of the mean sum of standard deviations over extent in the objective.
    pub scale_weight: f32,
}

fn preset_text(name: &str) -> Option<&'static str> {
    match name {
        "resolved" => Some(include_str!("../presets/resolved.toml")),
        "sss-3dgs" => Some(include_str!("../presets/sss-3dgs.toml")),
        "paper" => Some(include_str!("../presets/paper.toml")),
        _ => None,
    }
}

/// Lays `over` onto `base`, table by table.
fn merge(base: &mut toml::Table, over: toml::Table) {
    for (key, value) in over {
        match (base.get_mut(&key), value) {
            (Some(toml::Value::Table(inner)), toml::Value::Table(value)) => merge(inner, value),
            (_, value) => {
                base.insert(key, value);
            }
        }
    }
}

/// The key of a number that is infinite or none, or would be as the `f32` that most settings are.
fn first_non_finite(table: &toml::Table) -> Option<String> {
    table.iter().find_map(|(key, value)| match value {
        toml::Value::Float(v) if !(*v as f32).is_finite() => Some(key.clone()),
        toml::Value::Table(inner) => first_non_finite(inner).map(|rest| format!("{key}.{rest}")),
        _ => None,
    })
}

fn table_of(text: &str, origin: &str) -> Result<toml::Table, ReconstructError> {
    let fail = |detail: String| ReconstructError::Config { origin: origin.to_owned(), detail };
    let mut table: toml::Table = text.parse().map_err(|e: toml::de::Error| fail(brief(e)))?;
    let Some(base) = table.remove("base") else { return Ok(table) };
    let name = base.as_str().ok_or_else(|| fail(format!("`base` must be the name of a preset, found {base}")))?;
    let text = preset_text(name)
        .ok_or_else(|| fail(format!("`base = \"{name}\"` is not a preset; expected one of {}", PRESETS.join(", "))))?;
    let mut merged = table_of(text, name)?;
    merge(&mut merged, table);
    Ok(merged)
}

impl Config {
    /// A built-in preset, one of [`PRESETS`].
    pub fn preset(name: &str) -> Result<Self, ReconstructError> {
        let text = preset_text(name).ok_or_else(|| ReconstructError::Config {
            origin: name.to_owned(),
            detail: format!("no such preset; expected one of {} or a file ending in .toml", PRESETS.join(", ")),
        })?;
        Self::parse(text, name)
    }

    /// A preset by name, or a TOML file by path (anything that ends in `.toml`).
    pub fn load(preset_or_path: &str) -> Result<Self, ReconstructError> {
        if !preset_or_path.ends_with(".toml") {
            return Self::preset(preset_or_path);
        }
        let path = Path::new(preset_or_path);
        let text = std::fs::read_to_string(path).map_err(|e| ReconstructError::Io {
            path: path.to_owned(),
            action: "read the configuration",
            source: e,
        })?;
        Self::parse(&text, preset_or_path)
    }

    /// Parses TOML text; `origin` names it in errors. A file without `base` starts from `resolved`.
    pub fn parse(text: &str, origin: &str) -> Result<Self, ReconstructError> {
        let mut table = table_of(text, origin)?;
        if preset_text(origin).is_none() && !text.lines().any(|l| l.trim_start().starts_with("base")) {
            let mut merged = table_of(include_str!("../presets/resolved.toml"), "resolved")?;
            merge(&mut merged, table);
            table = merged;
        }
        if let Some(key) = first_non_finite(&table) {
            let detail = format!("`{key}` must be a finite number");
            return Err(ReconstructError::Config { origin: origin.into(), detail });
        }
        let mut config: Config = toml::Value::Table(table)
            .try_into()
            .map_err(|e: toml::de::Error| ReconstructError::Config { origin: origin.into(), detail: brief(e) })?;
        if !config.subsurface.model.has_residual() {
            config.residual.network = false;
            config.residual.transfer = false;
        }
        config.validate(origin)?;
        Ok(config)
    }

    /// At most this many Gaussians at the start: `initial.count`, but never more than `density.max_gaussians`.
    pub fn initial_count(&self) -> usize {
        self.initial.count.min(self.density.max_gaussians)
    }

    /// The configuration without what only decides time and memory: two runs with the same have the same result.
    pub fn deciding(&self) -> Self {
        let input = Input { cache_bytes: 0, ..self.input.clone() };
        Self { memory_limit: None, input, ..self.clone() }
    }

    /// The configuration as TOML text, complete.
    pub fn to_toml(&self) -> Result<String, ReconstructError> {
        toml::to_string_pretty(self)
            .map_err(|e| ReconstructError::Config { origin: self.name.clone(), detail: e.to_string() })
    }

    /// Checks ranges; `origin` names the file in errors.
    pub fn validate(&self, origin: &str) -> Result<(), ReconstructError> {
        let fail = |detail: String| Err(ReconstructError::Config { origin: origin.to_owned(), detail });
        self.augmentation.validate(origin)?;
        let medium = &self.subsurface;
        if medium.model.has_medium() {
            if self.shading.incident == IncidentVariant::Learned || !self.residual.scale_by_light {
                return fail(
                    "subsurface.model names a medium, whose light is physical; expected shading.incident = \"inverse-square\" or \
                     \"none\" and residual.scale_by_light = true"
                        .into(),
                );
            }
            let fits = std::iter::once(&medium.from).chain(&medium.refit);
            if !fits.clone().is_sorted() || !fits.clone().all(|f| (0.0..1.0).contains(f)) {
                return fail(
                    "subsurface.from and subsurface.refit: expected ascending fractions of the run, 0 to 1".into(),
                );
            }
            if !(8..=512).contains(&medium.resolution) || medium.surfels < 100 || !(2..=32).contains(&medium.widths) {
                return fail("subsurface: expected resolution 8 to 512, at least 100 surfels, widths 2 to 32".into());
            }
        }
        let positive = [
            ("steps", self.steps as f32),
            ("accumulate", self.accumulate as f32),
            ("checkpoint_steps", self.checkpoint_steps as f32),
            ("initial.count", self.initial.count as f32),
            ("splat.min_scale", self.splat.min_scale),
            ("splat.max_scale", self.splat.max_scale),
            ("density.every_steps", self.density.every_steps as f32),
            ("density.split_divisor", self.density.split_divisor),
            ("density.max_gaussians", self.density.max_gaussians as f32),
            ("visibility.every_steps", self.visibility.every_steps as f32),
            ("consistency.every_steps", self.consistency.every_steps as f32),
            ("consistency.neighbours", self.consistency.neighbours as f32),
            ("consistency.pixels", self.consistency.pixels as f32),
            ("consistency.target_scale", self.consistency.target_scale),
            ("consistency.max_gap", self.consistency.max_gap),
        ];
        for (key, value) in positive {
            if value.is_nan() || value <= 0.0 {
                return fail(format!("`{key}` must be greater than 0, found {value}"));
            }
        }
        if self.splat.min_scale > self.splat.max_scale {
            return fail(format!(
                "`splat.min_scale` must not exceed `splat.max_scale`, found {} and {}",
                self.splat.min_scale, self.splat.max_scale
            ));
        }
        let unit = [
            ("initial.opacity", self.initial.opacity),
            ("initial.flatness", self.initial.flatness),
            ("splat.max_alpha", self.splat.max_alpha),
            ("density.prune_opacity", self.density.prune_opacity),
            ("exposure.rate", self.exposure.rate),
            ("exposure.from", self.exposure.from),
            ("exposure.until", self.exposure.until),
            ("density.from", self.density.from),
            ("density.until", self.density.until),
            ("density.reset_every", self.density.reset_every),
            ("density.reset_opacity", self.density.reset_opacity),
            ("density.large_from", self.density.large_from),
            ("density.freeze_count", self.density.freeze_count),
            ("density.mcmc.growth", self.density.mcmc.growth),
            ("density.mcmc.noise_opacity", self.density.mcmc.noise_opacity),
            ("shading.roughness_unfreeze", self.shading.roughness_unfreeze),
            ("rates.mean_decay", self.rates.mean_decay),
            ("visibility.moved", self.visibility.moved),
            ("loss.ssim", self.loss.ssim),
            ("photometric.until", self.photometric.until),
            ("consistency.from", self.consistency.from),
            ("consistency.until", self.consistency.until),
            ("consistency.target_scale", self.consistency.target_scale),
            ("consistency.min_opacity", self.consistency.min_opacity),
        ];
        for (key, value) in unit {
            if !(0.0..=1.0).contains(&value) {
                return fail(format!("`{key}` must lie in [0, 1], found {value}"));
            }
        }
        if self.initial.opacity <= 0.0 || self.initial.opacity >= 1.0 {
            return fail(format!(
                "`initial.opacity` must lie strictly between 0 and 1, found {}",
                self.initial.opacity
            ));
        }
        if !(-1.0..1.0).contains(&self.consistency.min_facing) {
            let found = self.consistency.min_facing;
            return fail(format!("`consistency.min_facing` must lie in [-1, 1), found {found}"));
        }
        if self.consistency.min_opacity >= 1.0 {
            return fail("`consistency.min_opacity` must lie below 1: nothing is more opaque".into());
        }
        if self.residual.transfer_degree > 3 {
            let found = self.residual.transfer_degree;
            return fail(format!("`residual.transfer_degree` must be at most 3, found {found}"));
        }
        let d = &self.density;
        let not_negative = [
            ("photometric.supervise", self.photometric.supervise),
            ("exposure.prior", self.exposure.prior),
            ("density.gradient_threshold", d.gradient_threshold),
            ("density.percent_dense", d.percent_dense),
            ("density.max_screen_radius", d.max_screen_radius),
            ("density.max_world_scale", d.max_world_scale),
            ("density.mcmc.noise", d.mcmc.noise),
            ("density.mcmc.noise_sharpness", d.mcmc.noise_sharpness),
            ("density.mcmc.opacity_weight", d.mcmc.opacity_weight),
            ("density.mcmc.scale_weight", d.mcmc.scale_weight),
        ];
        for (key, value) in not_negative {
            if !value.is_finite() || value < 0.0 {
                return fail(format!("`{key}` must be finite and not negative, found {value}"));
            }
        }
        let losses = [
            ("l2", self.loss.l2),
            ("mask", self.loss.mask),
            ("normal", self.loss.normal),
            ("smooth_base_color", self.loss.smooth_base_color),
            ("smooth_metalness", self.loss.smooth_metalness),
            ("smooth_roughness", self.loss.smooth_roughness),
            ("smooth_subsurfaceness", self.loss.smooth_subsurfaceness),
            ("enhancement", self.loss.enhancement),
            ("incident", self.loss.incident),
            ("visibility", self.loss.visibility),
            ("lpips", self.loss.lpips),
            ("silhouette_consistency", self.loss.silhouette_consistency),
            ("depth_consistency", self.loss.depth_consistency),
        ];
        let r = &self.rates;
        let rates = [
            ("mean", r.mean),
            ("mean_final", r.mean_final),
            ("scale", r.scale),
            ("rotation", r.rotation),
            ("shear", r.shear),
            ("opacity", r.opacity),
            ("normal", r.normal),
            ("material", r.material),
            ("visibility_sh", r.visibility_sh),
            ("transfer", r.transfer),
            ("codes", r.codes),
            ("network", r.network),
            ("network_final", r.network_final),
            ("attribute_final", r.attribute_final),
        ];
        for (key, value) in rates {
            if !value.is_finite() || value < 0.0 {
                return fail(format!("`rates.{key}` must be finite and not negative, found {value}"));
            }
        }
        for (key, value) in losses {
            if !value.is_finite() || value < 0.0 {
                return fail(format!("`loss.{key}` must be finite and not negative, found {value}"));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_parse_and_survive_a_round_trip() {
        for name in PRESETS {
            let config = Config::preset(name).unwrap();
            assert_eq!(config.name, name);
            let again = Config::parse(&config.to_toml().unwrap(), "round trip").unwrap();
            assert_eq!(config, again);
        }
    }

    #[test]
    fn a_file_says_only_what_differs() {
        let config = Config::parse("base = \"paper\"\nsteps = 7\n[loss]\nmask = 0.25\n", "mine.toml").unwrap();
        let paper = Config::preset("paper").unwrap();
        assert_eq!((config.steps, config.loss.mask, config.loss.ssim), (7, 0.25, paper.loss.ssim));
    }

    #[test]
    fn mistakes_are_named() {
        let error = |text: &str| Config::parse(text, "mine.toml").unwrap_err().to_string();
        assert!(error("[loss]\nmaks = 1.0").contains("maks"), "{}", error("[loss]\nmaks = 1.0"));
        assert!(error("steps = 0").contains("steps"));
        assert!(error("base = \"nope\"").contains("nope"));
        assert!(error("[loss]\nmask = -1.0").contains("loss.mask"));
        assert!(error("[initial]\nopacity = 1.0").contains("initial.opacity"));
        assert!(error("[consistency]\nmin_facing = 1.0").contains("consistency.min_facing"));
        assert!(error("steps = \"many\"").contains("mine.toml"));
        assert!(error("memory_limit = \"much\"").contains("512 MiB"), "{}", error("memory_limit = \"much\""));
    }

    #[test]
    fn a_memory_limit_is_text_or_bytes_and_decides_nothing_by_itself() {
        let plain = Config::preset("resolved").unwrap();
        assert!(!plain.to_toml().unwrap().contains("memory_limit"));
        for text in ["memory_limit = \"2 GiB\"", "memory_limit = 2147483648"] {
            let config = Config::parse(text, "mine.toml").unwrap();
            assert_eq!(config.memory_limit, Some(ByteSize(2 << 30)));
            let again = Config::parse(&config.to_toml().unwrap(), "round trip").unwrap();
            assert_eq!(again, config);
            assert_eq!(config.deciding(), plain.deciding());
        }
    }
}
