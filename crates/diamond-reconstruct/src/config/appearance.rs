//! How surface and residual are shaded.
use serde::{Deserialize, Serialize};

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

impl Residual {
    /// Transfer values per Gaussian: three colours times (degree + 1)² harmonics, or none.
    pub fn transfer_width(&self) -> usize {
        let side = self.transfer_degree as usize + 1;
        if self.transfer { 3 * side * side } else { 0 }
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
