//! What a reconstruction will do before it does it: facts of the capture, what is computed and what is left out and why,
//! when things change during the run, and what it takes. `diamond plan` prints it; a run stores it as `needs.json`.
use crate::{MemoryPlan, SssError, open_capture};
use diamond_augment::Lack;
use diamond_dataset::Selection;
use diamond_reconstruct::{ByteSize, CaptureFacts, Config, Needs, StepPlan};
use serde::Serialize;
use std::fmt;
use std::path::PathBuf;

/// What to plan.
#[derive(Debug, Clone, PartialEq)]
pub struct PlanOptions {
    /// The capture.
    pub capture: PathBuf,
    /// Preset, or path of a TOML file.
    pub preset: String,
    /// Settings laid over it, `key=value` with a dotted key of the configuration.
    pub settings: Vec<String>,
    /// Training views.
    pub views: Selection,
    /// Training lights.
    pub lights: Selection,
    /// Memory limit; the configuration's where absent.
    pub memory_limit: Option<ByteSize>,
}

/// Something that changes during a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Milestone {
    /// Steps done when it happens first.
    pub from: u64,
    /// Steps done when it happens last; equal to `from` for a single event.
    pub until: u64,
    /// What happens.
    pub what: String,
}

/// Estimates of work per step, multiplications.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Estimate {
    /// Channels that are rasterised while roughness is a constant, and after.
    pub channels: (usize, usize),
    /// Times each training image is seen.
    pub epochs: f64,
    /// Multiplications of the network per step for as many Gaussians as at the start, forward and backward.
    pub network_multiplications: u64,
}

/// Views whose missing lights are told one by one.
const SHOWN_VIEWS: usize = 8;

/// A planned run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Plan {
    /// Name of the configuration.
    pub preset: String,
    /// Steps.
    pub steps: u64,
    /// The capture.
    pub capture: CaptureFacts,
    /// What it lacks, where that is known.
    pub lack: Option<Lack>,
    /// What is computed, and why.
    pub needs: Needs,
    /// What changes, in order.
    pub schedule: Vec<Milestone>,
    /// What it takes in work.
    pub estimate: Estimate,
    /// What it takes in memory.
    pub memory: MemoryPlan,
}

/// The configuration with `settings` laid over it.
fn configured(preset: &str, settings: &[String]) -> Result<Config, SssError> {
    let config = Config::load(preset)?;
    if settings.is_empty() {
        return Ok(config);
    }
    let usage = |text: String| SssError::Usage(text);
    let mut table: toml::Table = config.to_toml()?.parse().map_err(|e: toml::de::Error| usage(e.to_string()))?;
    for setting in settings {
        let (key, value) = setting
            .split_once('=')
            .ok_or_else(|| usage(format!("`{setting}`: expected key=value, such as loss.mask=0")))?;
        let parsed = format!("x = {value}").parse::<toml::Table>().ok().and_then(|mut t| t.remove("x"));
        let value = parsed.unwrap_or_else(|| toml::Value::String(value.to_owned()));
        let mut path: Vec<&str> = key.trim().split('.').collect();
        let last = path.pop().unwrap_or_default();
        let mut inner = &mut table;
        for part in path {
            inner = match inner.get_mut(part) {
                Some(toml::Value::Table(t)) => t,
                _ => return Err(usage(format!("`{key}`: there is no table `{part}`; see `diamond presets {preset}`"))),
            };
        }
        // A whole number where a fraction is expected is meant as one.
        let value = match (inner.get(last), value) {
            (Some(toml::Value::Float(_)), toml::Value::Integer(i)) => toml::Value::Float(i as f64),
            (_, value) => value,
        };
        inner.insert(last.to_owned(), value);
    }
    Ok(Config::parse(&table.to_string(), "command line")?)
}

/// Plans a run on a capture. Decodes at most eight images and computes nothing.
pub fn plan_capture(options: &PlanOptions) -> Result<Plan, SssError> {
    let mut config = configured(&options.preset, &options.settings)?;
    config.memory_limit = options.memory_limit.or(config.memory_limit);
    let capture = open_capture(&options.capture, &config)?.select(&options.views, &options.lights)?;
    let facts = CaptureFacts::of(&capture)?;
    let needs = Needs::decide(&config, &facts);
    Ok(Plan::new(&config, facts, needs)?.with_lack(Lack::of(&capture, &config.augmentation.wanted())))
}

/// The steps of which `f` holds, as the number of steps done at the end of the first and the last of them, and how many.
fn steps_where(config: &Config, f: impl Fn(&StepPlan) -> bool) -> Option<(u64, u64, usize)> {
    let mut steps = (0..config.steps).filter(|&s| f(&StepPlan::new(config, s)));
    let first = steps.next()?;
    let (last, more) = steps.fold((first, 0), |(_, n), s| (s, n + 1));
    Some((first + 1, last + 1, more + 1))
}

fn schedule(config: &Config) -> Vec<Milestone> {
    let mut out = Vec::new();
    let mut add = |range: Option<(u64, u64, usize)>, what: &dyn Fn(usize) -> String| {
        if let Some((from, until, count)) = range {
            out.push(Milestone { from, until, what: what(count) });
        }
    };
    add(steps_where(config, |p| p.roughness_frozen), &|_| "roughness is the constant ½".into());
    add(steps_where(config, |p| p.incident_offset != 0.0), &|_| "warm-up of the incident light".into());
    add(steps_where(config, |p| p.collect_density), &|_| "density statistics".into());
    add(steps_where(config, |p| p.densify), &|n| format!("{n} rounds of density control"));
    add(steps_where(config, |p| p.reset_opacity), &|n| format!("{n} resets of opacity"));
    if config.loss.silhouette_consistency > 0.0 || config.loss.depth_consistency > 0.0 {
        add(steps_where(config, |p| p.consistency > 0.0), &|n| format!("{n} comparisons of views"));
    }
    let decay = (f64::from(config.rates.mean_decay) * config.steps as f64).round() as u64;
    add(Some((1, decay.max(1), 0)), &|_| "learning rate of the means falls".into());
    out.sort_by_key(|m| (m.from, m.until));
    out
}

fn estimate(config: &Config, facts: &CaptureFacts, needs: &Needs) -> Estimate {
    let residual = &config.residual;
    let inputs = 42 + residual.codes;
    let mut widths = vec![inputs];
    widths.extend(&residual.hidden);
    widths.push(3);
    let products: usize = if residual.network { widths.windows(2).map(|w| w[0] * w[1]).sum() } else { 0 };
    let last = StepPlan::new(config, config.steps.saturating_sub(1));
    let first = StepPlan::new(config, 0);
    let channels = (needs.at(&first).layout.count(), needs.at(&last).layout.count());
    Estimate {
        channels,
        epochs: config.steps as f64 * f64::from(config.accumulate) / facts.images.max(1) as f64,
        // Once forward, and backward once more forward and twice back.
        network_multiplications: (4 * products * config.initial.count) as u64 * u64::from(config.accumulate),
    }
}

impl Plan {
    /// Of a configuration, with what is known of the capture and was decided. Refused where the run does not fit the
    /// configuration's memory limit.
    pub fn new(config: &Config, capture: CaptureFacts, needs: Needs) -> Result<Self, SssError> {
        let memory =
            MemoryPlan::new(config, &capture, &needs).map_err(|refused| SssError::Usage(refused.to_string()))?;
        Ok(Self {
            memory,
            preset: config.name.clone(),
            steps: config.steps,
            schedule: schedule(config),
            estimate: estimate(config, &capture, &needs),
            lack: None,
            capture,
            needs,
        })
    }

    /// With what the capture lacks of its rig.
    pub fn with_lack(self, lack: Lack) -> Self {
        Self { lack: Some(lack), ..self }
    }

    /// The plan as JSON.
    pub fn to_json(&self) -> Result<serde_json::Value, SssError> {
        serde_json::to_value(self).map_err(|e| SssError::Internal(e.to_string()))
    }

    /// One line for the beginning of a run.
    pub fn summary(&self) -> String {
        let names: Vec<&str> = self.needs.skipped().map(|row| row.name).collect();
        format!("not computed, since not needed (reasons: `diamond plan`, needs.json): {}", names.join(", "))
    }
}

fn span((low, high): (u32, u32)) -> String {
    if low == high { low.to_string() } else { format!("{low}–{high}") }
}

impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (c, e) = (&self.capture, &self.estimate);
        writeln!(f, "capture:")?;
        writeln!(f, "  {} views, {} images of {}×{} pixels", c.views, c.images, span(c.width), span(c.height))?;
        let rig = if c.shared_rig { "the same for every view" } else { "not the same for every view" };
        writeln!(f, "  {} lights ({rig}), {} of them at infinity", c.lights, c.directional_lights)?;
        writeln!(f, "  held out: {} views, {} images", c.test_views, c.test_images)?;
        writeln!(f, "  point cloud: {}", if c.points { "yes" } else { "no" })?;
        writeln!(f, "  masks: {} of {} images looked at", c.masks, c.looked_at)?;
        if let Some(content) = c.content {
            writeln!(f, "  rectangle that is not empty: {:.0} % of the picture", 100.0 * content)?;
        }
        if let Some(lack) = &self.lack {
            writeln!(f, "lights that were not photographed:")?;
            writeln!(f, "  {lack}")?;
            let made = &self.needs.made_pictures;
            let whether = if made.needed { "they are made" } else { "they are not made" };
            writeln!(f, "  {whether}: {}", made.reason)?;
            for view in lack.views.iter().take(SHOWN_VIEWS) {
                let (name, has, missing, chosen) = (&view.name, view.photographed, view.missing, view.chosen);
                writeln!(f, "  {name}: {has} photographed, {missing} missing, {chosen} chosen")?;
            }
            if lack.views.len() > SHOWN_VIEWS {
                writeln!(f, "  … and {} views more", lack.views.len() - SHOWN_VIEWS)?;
            }
        }
        write!(f, "{}", self.needs)?;
        writeln!(f, "schedule of {} steps ({}):", self.steps, self.preset)?;
        for m in &self.schedule {
            writeln!(f, "  {:>6} – {:<6}  {}", m.from, m.until, m.what)?;
        }
        writeln!(f, "estimates:")?;
        writeln!(f, "  each image is seen {:.1} times", e.epochs)?;
        writeln!(f, "  {} of 14 channels rasterised, {} at the end", e.channels.0, e.channels.1)?;
        writeln!(f, "  {:.2e} multiplications of the network per step at the start", e.network_multiplications as f64)?;
        write!(f, "{}", self.memory)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_are_laid_over_a_preset() {
        let settings = ["loss.mask=0", "steps=500", "shading.metal=no", "residual.hidden=[8, 8]"].map(String::from);
        let config = configured("resolved", &settings).unwrap();
        assert_eq!((config.loss.mask, config.steps), (0.0, 500));
        assert_eq!(config.residual.hidden, [8, 8]);
        assert_eq!(config.shading.metal, diamond_reconstruct::MetalVariant::No);
        for (wrong, text) in [("loss.maks=0", "maks"), ("nothing.x=1", "nothing"), ("steps", "key=value")] {
            let error = configured("resolved", &[wrong.to_owned()]).unwrap_err().to_string();
            assert!(error.contains(text), "{error}");
        }
    }

    #[test]
    fn the_plan_names_reasons_and_milestones() {
        let config = configured("resolved", &["loss.normal=0".to_owned()]).unwrap();
        let facts = CaptureFacts { images: 10, width: (64, 64), height: (48, 48), ..Default::default() };
        let needs = Needs::decide(&config, &facts);
        let plan = Plan::new(&config, facts, needs).unwrap();
        let text = plan.to_string();
        for expected in ["loss.normal = 0", "rounds of density control", "64×48", "12 of 14 channels", "MiB"] {
            assert!(text.contains(expected), "{expected} in {text}");
        }
        assert!(plan.summary().contains("normal") && plan.to_json().unwrap()["needs"]["normal"]["needed"] == false);
        let rounds = plan.schedule.iter().find(|m| m.what.contains("rounds")).unwrap();
        assert!(rounds.from > 500 && rounds.until == 5000, "{rounds:?}");
    }
}
