//! What a fitted medium predicts of captures, beside their shards: training data of a relighter that corrects such predictions.
use crate::SssError;
use crate::relighter_source::SurfaceView;
use diamond_augment::SourceError;
use diamond_dataset::{Capture, OpenOptions, Regime};
use diamond_diffusion::WeightsHeader;
use diamond_diffusion::relight::{PredictedView, prediction_path, write_predictions};
use diamond_medium::{Medium, MediumPictures, Surface};
use diamond_reconstruct::{Config, ReconstructError, Reconstruction, medium_of, surface_of};
use diamond_synth::{ShardEntry, ShardIndex};
use std::path::{Path, PathBuf};

/// The photographs that a medium is fitted to: every view under one light, where light and shape are known worst.
const REGIME: &str = "full-one";

/// Surface and medium of a capture as a reconstruction finds them before its first step, and the falloff of lights.
fn fitted(capture: &Capture) -> Result<(Surface, Medium, diamond_light::Falloff), SssError> {
    let selected = REGIME.parse::<Regime>().and_then(|regime| regime.apply(capture, 0))?;
    let config = Config::parse("steps = 1", "predictions of shards")?;
    let mut run = Reconstruction::new(selected.clone(), &config)?;
    let model = run.model()?;
    let surface = surface_of(model, &selected)?;
    let medium = medium_of(model, &selected, &surface)?;
    match medium.unfit() {
        Some(detail) => Err(ReconstructError::Unusable { detail }.into()),
        None => Ok((surface, medium, model.scene.falloff(&model.config))),
    }
}

fn unusable(path: &Path) -> impl Fn(SourceError) -> SssError {
    move |e| SssError::Input { path: path.to_owned(), detail: e.to_string() }
}

/// Predictions for the shards of the training views of captures, which [`diamond_synth::export_shards`] has written into `folder` as `index` says. Files that are there
/// are kept. Returns what kept captures out, a line each; `progress` is told how many captures are done, of how many.
///
/// # Errors
/// Captures and shards that cannot be read; the system's.
pub fn export_predictions(
    captures: &[PathBuf],
    index: &ShardIndex,
    folder: &Path,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Vec<String>, SssError> {
    let mut left_out = Vec::new();
    for (done, path) in captures.iter().enumerate() {
        let capture = Capture::open(path, &OpenOptions { cache_bytes: 0, ..OpenOptions::default() })?;
        let name = capture.root.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let entries = index.shards.iter().filter(|shard| shard.capture == name && shard.split == "train");
        let missing: Vec<&ShardEntry> = entries
            .filter(|shard| {
                let header = WeightsHeader::read(&prediction_path(&folder.join(&shard.file)));
                !header.is_ok_and(|header| header.metadata.get("note") == Some(&shard.sha256))
            })
            .collect();
        if !missing.is_empty() {
            match fitted(&capture) {
                Ok((surface, medium, falloff)) => {
                    let pictures = MediumPictures::new(surface, medium, falloff);
                    let mut pictures = pictures.map_err(|e| unusable(path)(e.into()))?;
                    for shard in missing {
                        let views = predicted(&capture, shard, &mut pictures).map_err(unusable(path))?;
                        write_predictions(&folder.join(&shard.file), &views, &shard.sha256)
                            .map_err(|e| unusable(folder)(e.into()))?;
                    }
                }
                Err(e) => left_out.push(format!("{name}: nothing is predicted: {e}")),
            }
        }
        progress(done + 1, captures.len());
    }
    Ok(left_out)
}

/// The views of a shard, as a medium has them.
fn predicted(
    capture: &Capture,
    shard: &ShardEntry,
    pictures: &mut MediumPictures,
) -> Result<Vec<PredictedView>, SourceError> {
    let views = capture.train.iter().skip(shard.first_view).take(shard.shape[0]);
    let view = |view: &diamond_dataset::View| {
        let observation = capture.observation(&view.shots[0])?;
        let seen = SurfaceView::new(pictures.surface(), &view.camera, observation.mask.as_ref());
        pictures.prepare(&view.shots.iter().map(|shot| shot.light).collect::<Vec<_>>())?;
        let images = view.shots.iter().map(|shot| seen.predicted(pictures, &shot.light)).collect::<Result<_, _>>()?;
        let (depth, normals) = seen.shape();
        Ok(PredictedView { depth, normals, pictures: images })
    };
    views.map(view).collect()
}
