//! A training run of the relighter on shards, in a folder: checkpoint, curve, model, held-out figures.
use super::examples::RelightExamples;
use super::relighter::{RelightOptions, Relighter, RelighterConfig};
use crate::error::{DiffusionError, Result};
use crate::nn::{Source, VariablesBuilder};
use crate::train::{StepReport, TrainSettings, Trainer};
use crate::weights::{NumberType, WeightsHeader, read_weights, write_weights};
use diamond_image::{Image, Transfer};
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
    /// Examples of the split `test` that the result is measured on.
    pub held_out: usize,
}

/// The averaged network on views that were not trained on: mean PSNR in dB of encoded sRGB where the object is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeldOut {
    /// Examples.
    pub examples: usize,
    /// Of relit pictures.
    pub relit: f64,
    /// Of source pictures taken as they are.
    pub copied: f64,
}

impl Relighter {
    /// A relighter from a file that training wrote; the file says which sizes it has.
    pub fn load(path: &Path) -> Result<Self> {
        let header = WeightsHeader::read(path)?;
        let note = header.metadata.get("note").map(String::as_str).unwrap_or_default();
        let config: RelighterConfig = serde_json::from_str(note).map_err(|e| DiffusionError::Weights {
            origin: path.display().to_string(),
            problem: format!("no relighter of `diamond train` (its note does not state the sizes: {e})"),
        })?;
        let builder = VariablesBuilder::new(Source::Tensors(read_weights(path)?)).frozen();
        let relighter = Self::new(&builder.root(), &config)?;
        builder.finish().1.into_result(&path.display().to_string())?;
        Ok(relighter)
    }
}

fn file_error(path: &Path, e: std::io::Error) -> DiffusionError {
    DiffusionError::File { path: path.display().to_string(), problem: format!("cannot be written: {e}") }
}

/// PSNR of encoded pictures where `coverage` is at least a half; none where nothing is.
fn psnr_inside(a: &Image, b: &Image, coverage: &Image) -> Option<f64> {
    let (mut sum, mut count) = (0.0, 0usize);
    let pixels = a.data().chunks_exact(3).zip(b.data().chunks_exact(3)).zip(coverage.data());
    for ((a, b), _) in pixels.filter(|(_, coverage)| **coverage >= 0.5) {
        for (a, b) in a.iter().zip(b) {
            let difference = Transfer::Srgb.encode(a.clamp(0.0, 1.0)) - Transfer::Srgb.encode(b.clamp(0.0, 1.0));
            sum += f64::from(difference * difference);
            count += 1;
        }
    }
    // A perfect picture is capped at 100 dB.
    (count > 0).then(|| -10.0 * libm::log10((sum / count as f64).max(1e-10)))
}

/// Measures a relighter on examples of a fixed order.
pub fn held_out(relighter: &Relighter, examples: &RelightExamples, count: usize) -> Result<HeldOut> {
    let (mut relit, mut copied, mut measured) = (0.0, 0.0, 0);
    for i in 0..count as u64 {
        let (view, target, light) = examples.example(0, i);
        let made = relighter.relight(&view, &[light], &RelightOptions::default())?;
        let of = |image: &Image| psnr_inside(image, target, &view.coverage);
        if let (Some(ours), Some(theirs)) = (of(&made[0].image), of(&view.source)) {
            (relit, copied, measured) = (relit + ours, copied + theirs, measured + 1);
        }
    }
    if measured == 0 {
        return Err(DiffusionError::setting("held-out examples", "at least one with an object in it", count));
    }
    let n = measured as f64;
    Ok(HeldOut { examples: measured, relit: relit / n, copied: copied / n })
}

/// Trains on the split `train` of shards in `folder` and writes `checkpoint.safetensors`, `curve.csv` and, at the end, the averaged
/// weights as half floats in `model.safetensors`. With `resume` it goes on from the checkpoint, to the same bits. The result is measured on
/// the split `test`, where there is one.
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
    let note = serde_json::to_string(config).map_err(|e| DiffusionError::File {
        path: model.display().to_string(),
        problem: format!("its sizes cannot be written: {e}"),
    })?;
    write_weights(&model, trainer.averages(), NumberType::F16, &note)?;
    let measured = match RelightExamples::open(shards, "test", config.size) {
        Ok(examples) if training.held_out > 0 => {
            Some(held_out(&Relighter::load(&model)?, &examples, training.held_out)?)
        }
        _ => None,
    };
    Ok((model, measured))
}
