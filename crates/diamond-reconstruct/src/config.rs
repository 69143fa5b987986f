//! The configuration of a run: every number of the method, with presets, read from TOML.
//!
//! A file may name a `base` preset and say only what differs. Unknown keys are errors, so that a typing mistake never
//! silently leaves a default in place. Step numbers are fractions of the run's length unless the name says `steps`.
use crate::error::brief;
use crate::{AugmentationSettings, ByteSize, InstructionChoice, ReconstructError};
use serde::{Deserialize, Serialize};
use std::path::Path;

mod agreement;
mod appearance;
mod density;
mod input;
mod subsurface;

pub use agreement::*;
pub use appearance::*;
pub use density::*;
pub use input::*;
pub use subsurface::*;

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
                     \"none\" and residual.scale_by_light = true, or subsurface.model = \"mlp\""
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
        let learned = error("[shading]\nincident = \"learned\"");
        assert!(learned.contains("subsurface.model = \"mlp\""), "{learned}");
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
