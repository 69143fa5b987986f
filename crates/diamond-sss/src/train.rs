//! Training of the relighter from the command line.
use crate::SssError;
use diamond_diffusion::DiffusionError;
use diamond_diffusion::relight::{RelightTraining, RelighterConfig, train_relighter};
use diamond_diffusion::train::TrainSettings;
use std::path::{Path, PathBuf};

/// What can be chosen.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainOptions {
    /// Steps.
    pub steps: u64,
    /// Examples of a step.
    pub batch: usize,
    /// Pixels of a side.
    pub size: usize,
    /// Largest learning rate.
    pub rate: f64,
    /// Seed of every random choice.
    pub seed: u64,
    /// Steps between checkpoints.
    pub save_every: u64,
    /// Examples that the result is measured on…
    pub held_out: usize,
    /// …of these shards, or else of the split `test`.
    pub test_shards: Option<PathBuf>,
    /// Whether to go on from a checkpoint.
    pub resume: bool,
}

/// Trains the small relighter on shards and says where it is and how good; `progress` is given steps done and all.
pub fn train_on_shards(
    shards: &Path,
    output: &Path,
    options: &TrainOptions,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<String, SssError> {
    let wrong = |error: DiffusionError| match error {
        DiffusionError::File { path, problem } | DiffusionError::Weights { origin: path, problem } => {
            SssError::Input { path: path.into(), detail: problem }
        }
        DiffusionError::Setting { .. } => SssError::Usage(error.to_string()),
        other => SssError::Internal(other.to_string()),
    };
    let TrainOptions { steps, batch, size, rate, seed, save_every, held_out, resume, .. } = *options;
    let config = RelighterConfig { size, ..RelighterConfig::shipped() };
    config.validate().map_err(wrong)?;
    let warm_up = (steps / 20).min(100);
    let settings = TrainSettings { seed, steps, warm_up, rate, ..TrainSettings::default() };
    let training =
        RelightTraining { config, settings, batch, save_every, held_out, test_shards: options.test_shards.clone() };
    let mut last = f64::NAN;
    let (model, measured) = train_relighter(shards, output, &training, resume, &mut |report| {
        last = report.loss;
        progress(report.step as usize, steps as usize);
    })
    .map_err(wrong)?;
    let figures = match measured {
        Some(measured) => format!("held out, {measured}"),
        None => "not measured: the shards have no split `test`, or no examples were asked for\n".into(),
    };
    Ok(format!("{figures}written: {} (last loss {last:.4})\n", model.display()))
}
