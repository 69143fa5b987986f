//! A training run of the relighter on shards, in a folder: checkpoint, curve, model, held-out figures.
use super::examples::RelightExamples;
use super::held_out::{HeldOut, held_out};
use super::note::ModelNote;
use super::relighter::{RelightOptions, Relighter, RelighterConfig};
use crate::error::{DiffusionError, Result};
use crate::nn::{Source, VariablesBuilder};
use crate::train::{StepReport, TrainSettings, Trainer};
use crate::weights::{NumberType, write_weights};
use std::path::{Path, PathBuf};

/// Files of a run.
const CHECKPOINT: &str = "checkpoint.safetensors";
const CURVE: &str = "curve.csv";
const MODEL: &str = "model.safetensors";

/// First line of the curve.
const CURVE_HEAD: &str = "step,loss,gradient,rate";

/// A run.
#[derive(Debug, Clone, PartialEq)]
pub struct RelightTraining {
    /// The network.
    pub config: RelighterConfig,
    /// Steps, rates, seed.
    pub settings: TrainSettings,
    /// Examples of a step.
    pub batch: usize,
    /// Steps between checkpoints.
    pub save_every: u64,
    /// Examples that the result is measured on: of the split `train` of [`RelightTraining::test_shards`], or else of the split `test`…
    pub held_out: usize,
    /// …of the shards themselves, which has other views and lights of the same objects. Other objects are a folder of their own.
    pub test_shards: Option<PathBuf>,
}

fn file_error(path: &Path, e: std::io::Error) -> DiffusionError {
    DiffusionError::File { path: path.display().to_string(), problem: format!("cannot be written: {e}") }
}

/// Trains on the split `train` of shards in `folder` and writes `checkpoint.safetensors`, `curve.csv` and, at the end, the averaged
/// weights as half floats in `model.safetensors`. With `resume` it goes on from the checkpoint, to the same bits. The result is measured on
/// examples of other objects or of the split `test`, where there are some.
pub fn train_relighter(
    shards: &Path,
    folder: &Path,
    training: &RelightTraining,
    resume: bool,
    progress: &mut dyn FnMut(&StepReport),
) -> Result<(PathBuf, Option<HeldOut>)> {
    let RelightTraining { config, settings, batch, save_every, .. } = training;
    if *batch == 0 || *save_every == 0 {
        return Err(DiffusionError::setting("batch and steps between checkpoints", "at least 1", 0));
    }
    let examples = RelightExamples::open(shards, "train", config.size)?;
    let builder = VariablesBuilder::new(Source::Seed(settings.seed));
    let relighter = Relighter::new(&builder.root(), config)?;
    let variables = builder.finish().0;
    std::fs::create_dir_all(folder).map_err(|e| file_error(folder, e))?;
    let (checkpoint, curve) = (folder.join(CHECKPOINT), folder.join(CURVE));
    if checkpoint.exists() && !resume {
        let problem = "a run was begun here: go on with it (--resume) or take another folder".into();
        return Err(DiffusionError::File { path: checkpoint.display().to_string(), problem });
    }
    let mut trainer = match resume && checkpoint.exists() {
        true => Trainer::resume(variables, *settings, &checkpoint)?,
        false => Trainer::new(variables, *settings)?,
    };
    // Lines behind the checkpoint are those of steps that will be made again.
    let mut lines: Vec<String> =
        std::fs::read_to_string(&curve).unwrap_or_default().lines().map(str::to_owned).collect();
    lines.retain(|line| {
        line.split(',').next().and_then(|s| s.parse().ok()).is_some_and(|s: u64| s <= trainer.step_number())
    });
    if trainer.step_number() == 0 {
        lines.clear();
    }
    while trainer.step_number() < settings.steps {
        let report = trainer.step(|step| {
            let batch = examples.batch(settings.seed, step, *batch)?;
            relighter.loss(&batch, settings.seed, step)
        })?;
        lines.push(format!("{},{:.6},{:.6},{:.3e}", report.step, report.loss, report.gradient, report.rate));
        progress(&report);
        if report.step % save_every == 0 || report.step == settings.steps {
            trainer.save(&checkpoint)?;
            std::fs::write(&curve, format!("{CURVE_HEAD}\n{}\n", lines.join("\n")))
                .map_err(|e| file_error(&curve, e))?;
        }
    }
    let model = folder.join(MODEL);
    let write = |errors: Option<[Option<f32>; 2]>| {
        let note = ModelNote { sizes: config.clone(), errors }.to_text(&model)?;
        write_weights(&model, trainer.averages(), NumberType::F16, &note)
    };
    write(None)?;
    let test = match &training.test_shards {
        Some(folder) => Some(RelightExamples::open(folder, "train", config.size)?),
        None => RelightExamples::open(shards, "test", config.size).ok(),
    };
    let Some(examples) = test.filter(|_| training.held_out > 0) else { return Ok((model, None)) };
    let (trained, options) = (Relighter::load(&model)?, RelightOptions::default());
    let measured = held_out(&trained, &examples, training.held_out, &options, &mut |_, _, _| ())?;
    write(Some([Some(measured.relit.display_rmse()), measured.relit_with_medium.map(|e| e.display_rmse())]))?;
    Ok((model, Some(measured)))
}
