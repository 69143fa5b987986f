//! A medium as a handful of numbers, its file, and how it is edited.
//!
//! The file is TOML and meant to be read and changed by people:
//!
//! ```
//! use diamond_medium::Medium;
//! let medium = Medium::parse(r#"
//!     unit = 1.0
//!     [transport]
//!     kind = "profile"
//!     widths = [0.1, 0.4]
//!     weights = [[0.5, 0.4, 0.3], [0.3, 0.1, 0.0]]
//!     local = [0.0, 0.1, 0.2]
//!     [coat]
//!     roughness = 0.3
//!     scale = 1.0
//! "#)?;
//! assert!((medium.reflectance().x - 0.8).abs() < 1e-6);
//! let softer = medium.edited("mean_free_path = *2, reflectance = 0.9 0.5 0.5")?;
//! assert!(softer.mean_radius().x > 1.9 * medium.mean_radius().x && (softer.reflectance().x - 0.9).abs() < 1e-6);
//! # Ok::<(), diamond_medium::MediumError>(())
//! ```
use crate::MediumError;
use diamond_shading::RadialProfile;
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// How light gets from where it enters to where it leaves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Transport {
    /// By a radial profile over straight distances: a mixture of Gaussians.
    Profile {
        /// Standard deviations, scene units, ascending.
        widths: Vec<f32>,
        /// Linear RGB ≥ 0, for each width.
        weights: Vec<[f32; 3]>,
        /// Part that leaves where it enters, linear RGB ≥ 0.
        local: [f32; 3],
    },
    /// By random walks in a homogeneous medium inside the surface.
    Walk {
        /// Extinction per scene unit, linear RGB, > 0.
        sigma_t: [f32; 3],
        /// Single-scattering albedo, linear RGB, 0 … 1.
        albedo: [f32; 3],
        /// Mean cosine of scattering, −1 … 1.
        g: f32,
        /// Index of refraction; 1 for a boundary that light does not notice.
        ior: f32,
        /// What photographs show of the light that leaves, linear RGB > 0: 1 where their exposure is known.
        gain: [f32; 3],
    },
}

/// The glossy coat that was fitted with the medium.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Coat {
    /// Perceptual roughness, 0 … 1.
    pub roughness: f32,
    /// Factor on the reflection of a dielectric with a reflectance of 0.04 at normal incidence, ≥ 0.
    pub scale: f32,
}

/// A fitted medium.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Medium {
    /// Irradiance of a light of intensity 1 that reflectances refer to (the scene's light scale).
    pub unit: f32,
    /// Transport under the surface.
    pub transport: Transport,
    /// On the surface.
    pub coat: Coat,
    /// How well it explains the photographs that it was fitted to, where it was.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quality: Option<Quality>,
    /// The two numbers per channel that describe the same profile most nearly, where they were fitted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub described: Option<Described>,
}

/// How well a medium explains photographs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Quality {
    /// Images that it was fitted to.
    pub images: usize,
    /// Root mean square of the difference over root mean square of the photographs' pixels of the object, display values.
    pub relative_error: f32,
    /// PSNR of those pixels, display values, dB.
    pub psnr: f32,
    /// What part of the difference, squared, is the same under all lights of a view: texture and shape rather than transport; 0 … 1.
    pub constant_part: f32,
}

/// Normalised diffusion (Christensen and Burley 2015) fitted to the same photographs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Described {
    /// Reflectance of a flat half space, linear RGB.
    pub reflectance: [f32; 3],
    /// Transport mean free path, scene units, linear RGB.
    pub mean_free_path: [f32; 3],
}

/// A fit whose difference exceeds this part of the photographs' values is none.
const BAD_FIT: f32 = 0.3;
/// More of the difference than this under all lights alike is texture.
const TEXTURED: f32 = 0.5;
/// A profile whose mean distance is beyond this part of that of its widest Gaussian would be wider still.
const CROSSES: f32 = 0.9;
/// Media below this reflectance return hardly any light.
const DARK: f32 = 0.02;

fn check(
    what: &'static str,
    values: &[f32],
    expected: &'static str,
    accept: impl Fn(f32) -> bool,
) -> Result<(), MediumError> {
    match values.iter().find(|v| !(v.is_finite() && accept(**v))) {
        None => Ok(()),
        Some(v) => Err(MediumError::Value { what, expected, found: v.to_string() }),
    }
}

impl Medium {
    /// From the text of a file.
    pub fn parse(text: &str) -> Result<Self, MediumError> {
        let medium: Self = toml::from_str(text)
            .map_err(|e| MediumError::Unusable { detail: format!("medium: {}", e.to_string().trim()) })?;
        medium.validate()?;
        Ok(medium)
    }

    /// From a file.
    pub fn read(path: &Path) -> Result<Self, MediumError> {
        let fail = |detail: String| MediumError::File { path: path.to_owned(), detail };
        let text = std::fs::read_to_string(path).map_err(|e| fail(format!("could not be read: {e}")))?;
        Self::parse(&text).map_err(|e| fail(e.to_string()))
    }

    /// The text of a file.
    pub fn to_toml(&self) -> Result<String, MediumError> {
        toml::to_string_pretty(self).map_err(|e| MediumError::Unusable { detail: format!("medium: {e}") })
    }

    /// `Err` where a number has no meaning.
    pub fn validate(&self) -> Result<(), MediumError> {
        check("unit of a medium", &[self.unit], "a number > 0", |v| v > 0.0)?;
        check("roughness of a coat", &[self.coat.roughness], "0 … 1", |v| (0.0..=1.0).contains(&v))?;
        check("scale of a coat", &[self.coat.scale], "a number ≥ 0", |v| v >= 0.0)?;
        match &self.transport {
            Transport::Profile { local, .. } => {
                self.profile()?;
                check("local part of a medium", local, "numbers ≥ 0", |v| v >= 0.0)
            }
            Transport::Walk { sigma_t, albedo, g, ior, gain } => {
                check("sigma_t of a medium", sigma_t, "numbers > 0", |v| v > 0.0)?;
                check("albedo of a medium", albedo, "0 … 1", |v| (0.0..=1.0).contains(&v))?;
                check("g of a medium", &[*g], "−0.99 … 0.99", |v| v.abs() <= 0.99)?;
                check("index of refraction of a medium", &[*ior], "1 … 3", |v| (1.0..=3.0).contains(&v))?;
                check("gain of a medium", gain, "numbers > 0", |v| v > 0.0)
            }
        }
    }

    /// `profile` or `walks`.
    pub fn kind(&self) -> &'static str {
        match self.transport {
            Transport::Profile { .. } => "profile",
            Transport::Walk { .. } => "walks",
        }
    }

    /// What a user should know of a fit: where a homogeneous medium is not what the photographs show. `spacing` is the width of a surfel.
    pub fn remarks(&self, spacing: f32) -> Vec<String> {
        let mut out = Vec::new();
        if let Some(q) = &self.quality {
            if q.relative_error > BAD_FIT {
                out.push(format!(
                    "medium: explains the photographs badly (difference {:.0} % of their values, {:.1} dB): the object may be clear like glass, of \
                     several materials, or its shape is not known well enough; the residual has to carry it",
                    100.0 * q.relative_error, q.psnr
                ));
            }
            if q.constant_part > TEXTURED && q.relative_error > 0.5 * BAD_FIT {
                out.push(format!(
                    "medium: {:.0} % of the difference is the same under all lights of a view: texture or several materials, which tints take up",
                    100.0 * q.constant_part
                ));
            }
        }
        let (reflectance, radius) = (self.reflectance(), self.mean_radius());
        if reflectance.max_element() < DARK {
            out.push(format!(
                "medium: hardly any light comes out of it (reflectance {:.3}): clear, black or metal",
                reflectance.max_element()
            ));
        } else if radius.max_element() < 1.5 * spacing {
            out.push(
                "medium: opaque; light leaves where it enters, as far as surfels can tell: what is fitted is a matt surface, not a medium".into(),
            );
        }
        out
    }

    /// Why a fit should not stand for the light in an object, where it should not: the profile has gone to the widest Gaussian that it was offered, in every
    /// channel. Then light crosses the object with hardly any scattering, and how much leaves a place depends on what lies behind it, which no
    /// profile knows. (A network alone is then 1 to 2 dB better; docs/results.md has the numbers.)
    pub fn unfit(&self) -> Option<String> {
        let Transport::Profile { widths, .. } = &self.transport else { return None };
        let widest = widths.iter().copied().fold(0.0f32, f32::max);
        // The mean distance from the middle of a Gaussian in the plane.
        let most = (0.5 * std::f32::consts::PI).sqrt() * widest;
        let least = self.mean_radius().min_element();
        (most > 0.0 && least > CROSSES * most && self.reflectance().min_element() > DARK).then(|| {
            let badly = self.quality.map_or(String::new(), |q| format!(" (difference {:.0} % of the photographs)", 100.0 * q.relative_error));
            format!("light crosses the object with hardly any scattering, which no radial profile explains{badly}: the network learns it without a medium")
        })
    }

    /// The profile without its local part; errors for media that have none.
    pub fn profile(&self) -> Result<RadialProfile, MediumError> {
        match &self.transport {
            Transport::Profile { widths, weights, .. } => {
                Ok(RadialProfile::new(widths.clone(), weights.iter().map(|w| Vec3::from(*w)).collect())?)
            }
            Transport::Walk { .. } => {
                Err(MediumError::Unusable { detail: "a medium of walks has no radial profile".into() })
            }
        }
    }

    /// Part of what enters a flat half space that leaves again, for the profile; the single-scattering albedo's similarity estimate (1−s)(1−0.139·s)/(1+1.17·s) with
    /// s = √((1−α)/(1−α·g)) (van de Hulst 1980) for walks. Linear RGB.
    pub fn reflectance(&self) -> Vec3 {
        match &self.transport {
            Transport::Profile { weights, local, .. } => {
                weights.iter().map(|w| Vec3::from(*w)).sum::<Vec3>() + Vec3::from(*local)
            }
            Transport::Walk { albedo, g, gain, .. } => Vec3::from(std::array::from_fn(|c| {
                let s = ((1.0 - albedo[c]) / (1.0 - albedo[c] * g).max(1e-6)).max(0.0).sqrt();
                gain[c] * (1.0 - s) * (1.0 - 0.139 * s) / (1.0 + 1.17 * s)
            })),
        }
    }

    /// Mean distance, scene units, between entry and exit on a flat half space; for walks 1/(σ_t·(1−αg))·1/√(3(1−α')) bounded by it, the diffusion length. Linear RGB.
    pub fn mean_radius(&self) -> Vec3 {
        match &self.transport {
            Transport::Profile { .. } => self.profile().map_or(Vec3::ZERO, |p| p.mean_radius()),
            Transport::Walk { sigma_t, albedo, g, .. } => Vec3::from(std::array::from_fn(|c| {
                let reduced = sigma_t[c] * (1.0 - albedo[c] * g);
                let absorbed = sigma_t[c] * (1.0 - albedo[c]);
                1.0 / (3.0 * absorbed.max(1e-4 * reduced) * reduced).max(f32::MIN_POSITIVE).sqrt()
            })),
        }
    }

    /// With changes: `KEY = VALUE` with commas between. Keys: `mean_free_path` (all distances; profile and walks), `reflectance` (profile), `sigma_t`, `albedo`, `g`, `gain`
    /// (walks). The coat is not edited here: in a model it belongs to the Gaussians' materials. A value is one number for all channels or three; `*2` multiplies what is there.
    pub fn edited(&self, changes: &str) -> Result<Self, MediumError> {
        let mut out = self.clone();
        for change in changes.split(',').map(str::trim).filter(|c| !c.is_empty()) {
            out.edit(change)?;
        }
        out.validate()?;
        Ok(out)
    }

    fn edit(&mut self, change: &str) -> Result<(), MediumError> {
        let fail = |detail: String| MediumError::Unusable { detail };
        let (key, text) = change
            .split_once('=')
            .map(|(k, v)| (k.trim(), v.trim()))
            .ok_or_else(|| fail(format!("`{change}`: write KEY=VALUE, such as `mean_free_path=*2`")))?;
        let (factor, numbers) = text.strip_prefix('*').map_or((false, text), |rest| (true, rest));
        let parsed: Vec<f32> = numbers
            .split_whitespace()
            .map(|n| n.parse().map_err(|_| fail(format!("`{change}`: `{n}` is no number"))))
            .collect::<Result<_, _>>()?;
        let value = match parsed.as_slice() {
            [one] => Vec3::splat(*one),
            [r, g, b] => Vec3::new(*r, *g, *b),
            _ => return Err(fail(format!("`{change}`: one number or three"))),
        };
        let set = |now: Vec3| if factor { now * value } else { value };
        let reflectance = self.reflectance();
        match (key, &mut self.transport) {
            ("mean_free_path", Transport::Profile { widths, .. }) => {
                if !factor || value.x != value.y || value.y != value.z {
                    return Err(fail(format!(
                        "`{change}`: a profile's distances are multiplied, all channels alike: `mean_free_path=*2`"
                    )));
                }
                widths.iter_mut().for_each(|w| *w *= value.x);
            }
            ("mean_free_path", Transport::Walk { sigma_t, .. }) => {
                let now = Vec3::from(*sigma_t);
                *sigma_t = if factor { now / value } else { value.recip() }.to_array();
            }
            ("reflectance", Transport::Profile { weights, local, .. }) => {
                let to = set(reflectance) / reflectance.max(Vec3::splat(1e-6));
                weights.iter_mut().chain(std::iter::once(local)).for_each(|w| *w = (Vec3::from(*w) * to).to_array());
            }
            ("sigma_t", Transport::Walk { sigma_t, .. }) => *sigma_t = set(Vec3::from(*sigma_t)).to_array(),
            ("albedo", Transport::Walk { albedo, .. }) => *albedo = set(Vec3::from(*albedo)).to_array(),
            ("gain", Transport::Walk { gain, .. }) => *gain = set(Vec3::from(*gain)).to_array(),
            ("g", Transport::Walk { g, .. }) => *g = set(Vec3::splat(*g)).x,
            (_, Transport::Profile { .. }) => {
                return Err(fail(format!("`{key}`: a profile has `mean_free_path` and `reflectance`")));
            }
            (_, Transport::Walk { .. }) => {
                return Err(fail(format!(
                    "`{key}`: a medium of walks has `sigma_t`, `albedo`, `g`, `gain` and `mean_free_path`"
                )));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn walk() -> Medium {
        Medium {
            unit: 1.0,
            transport: Transport::Walk {
                sigma_t: [10.0, 20.0, 30.0],
                albedo: [0.9; 3],
                g: 0.0,
                ior: 1.3,
                gain: [1.0; 3],
            },
            coat: Coat { roughness: 0.3, scale: 1.0 },
            quality: None,
            described: None,
        }
    }

    #[test]
    fn files_round_trip_and_edits_say_what_is_wrong() {
        let medium = walk();
        assert_eq!(Medium::parse(&medium.to_toml().unwrap()).unwrap(), medium);
        let edited = medium.edited("mean_free_path=*2, albedo=0.5 0.6 0.7").unwrap();
        assert_eq!(
            edited.transport,
            Transport::Walk { sigma_t: [5.0, 10.0, 15.0], albedo: [0.5, 0.6, 0.7], g: 0.0, ior: 1.3, gain: [1.0; 3] }
        );
        assert!(edited.mean_radius().x > 0.0 && edited.reflectance().z > edited.reflectance().x);
        for (bad, word) in [
            ("albedo", "KEY=VALUE"),
            ("albedo=2", "0 … 1"),
            ("albedo=x", "no number"),
            ("albedo=1 2", "one number or three"),
            ("reflectance=1", "sigma_t"),
            ("sigma_t=-1", "numbers > 0"),
            ("sigma_t=NaN", "numbers > 0"),
            ("coat=0", "sigma_t"),
        ] {
            let text = medium.edited(bad).unwrap_err().to_string();
            assert!(text.contains(word), "{bad}: {text}");
        }
        assert!(Medium::parse("unit = 1").is_err());
    }
}
