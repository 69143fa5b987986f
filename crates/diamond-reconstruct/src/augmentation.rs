//! Pictures that nobody took, in a run: who makes them, of what, and which comes next.
use crate::guided::{Guidance, GuidedSource};
use crate::medium_fit::{prior_of, surface_and_medium};
use crate::pairs::PairOrder;
use crate::random::Purpose;
use crate::region::Region;
use crate::{AugmentationSource, Config, Model, ReconstructError, TensorFile, error, stored_medium};
use diamond_augment::{AugmentError, Augmentation, Frame, GenerateOptions, Lack, Loaded, Source, generate};
use diamond_dataset::Capture;
use diamond_medium::{Medium, Prior, Surface};
use std::path::{Path, PathBuf};

/// Name of the prior's surface and medium in a checkpoint.
const PRIOR: &str = "prior";
/// Key of a checkpoint under which stands whether there was a prior when pictures were made.
const MADE_BY: &str = "made_pictures";

/// The pictures of a run, and what makes them.
#[derive(Default)]
pub(crate) struct MadePictures {
    /// Sources beside the prior, in the order in which they are asked.
    pub sources: Vec<Box<dyn Source>>,
    /// Makes the source that works on the prior's surface.
    pub relighter: Option<Box<dyn GuidedSource>>,
    /// Where pictures are kept.
    pub folder: Option<PathBuf>,
    prior: PriorState,
    frames: Option<Frames>,
}

/// What is known of the prior.
#[derive(Default)]
enum PriorState {
    /// Nothing yet.
    #[default]
    Open,
    /// There is none: nobody asked, or it could not be fitted.
    Absent,
    /// Its surface and medium.
    Fitted(Box<(Surface, Medium)>),
}

struct Frames {
    all: Vec<Frame>,
    order: PairOrder,
    /// What of each is not empty, once it was looked at.
    contents: Vec<Option<Option<Region>>>,
}

/// A picture that is learned from.
pub(crate) struct MadePicture {
    pub frame: Frame,
    pub pixels: Loaded,
    pub content: Option<Region>,
}

fn failure(e: AugmentError) -> ReconstructError {
    match e {
        AugmentError::Capture(e) => ReconstructError::Capture(e),
        AugmentError::File { path, detail } => ReconstructError::Checkpoint { path, detail },
        other => ReconstructError::Unusable { detail: other.to_string() },
    }
}

impl MadePictures {
    /// Whether anybody makes pictures.
    pub fn wanted(&self, config: &Config) -> bool {
        let settings = &config.augmentation;
        settings.off_because().is_none()
            && (settings.asks_prior(config.subsurface.model) || settings.asks_relighter() || !self.sources.is_empty())
    }

    /// Whether pictures have been made.
    pub fn are_made(&self) -> bool {
        self.frames.is_some()
    }

    /// Number of pictures to learn from.
    pub fn count(&self) -> usize {
        self.frames.as_ref().map_or(0, |f| f.all.len())
    }

    /// The pictures to learn from.
    pub fn frames(&self) -> &[Frame] {
        self.frames.as_ref().map_or(&[], |f| &f.all)
    }

    /// Makes them, or finds them on disk. Returns what a user wants to know, a line each.
    pub fn make(
        &mut self,
        model: &Model,
        capture: &Capture,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<Vec<String>, ReconstructError> {
        let settings = &model.config.augmentation;
        let lack = Lack::of(capture, &settings.wanted());
        let mut notes = Vec::new();
        let options = GenerateOptions {
            folder: self.folder.clone(),
            seed: model.config.seed,
            min_overlap: settings.min_overlap,
            max_outside: settings.max_outside,
            ..GenerateOptions::default()
        };
        let mut all = Vec::new();
        let asks = settings.asks_prior(model.config.subsurface.model) && !lack.targets.is_empty();
        if asks && let Some(mut prior) = self.prior(model, capture, &mut notes)? {
            let made = generate(capture, &lack.targets, &mut prior, &options, progress).map_err(failure)?;
            let error = prior.mean_error();
            notes.push(describe(
                &made,
                &prior.method(),
                &format!("; its mean error on photographs is {error:.3} (display values)"),
            ));
            all.extend(made.frames);
        }
        if settings.asks_relighter() && !lack.targets.is_empty() {
            let prior = self.prior(model, capture, &mut notes)?;
            let relighter = self.relighter.as_ref().ok_or_else(|| ReconstructError::Unusable {
                detail:
                    "augmentation.source asks for a relighter, and there is none: see `Reconstruction::with_relighter`"
                        .into(),
            })?;
            if let Some(prior) = prior {
                let guidance = Guidance {
                    surface: prior.surface(),
                    medium: prior.medium(),
                    falloff: model.scene.falloff(&model.config),
                    half_error: settings.half_error,
                    state: &prior.state(),
                };
                let unusable = |source| failure(AugmentError::Source { method: "relighter".into(), source });
                let mut source = relighter.source(guidance).map_err(unusable)?;
                let made = generate(capture, &lack.targets, source.as_mut(), &options, progress).map_err(failure)?;
                notes.push(describe(&made, &source.method(), ""));
                all.extend(made.frames);
            }
        }
        for source in &mut self.sources {
            let made = generate(capture, &lack.targets, source.as_mut(), &options, progress).map_err(failure)?;
            notes.push(describe(&made, &source.method(), ""));
            all.extend(made.frames);
        }
        if !notes.is_empty() {
            notes.insert(0, format!("pictures that nobody took: {lack}"));
        }
        let order = PairOrder::of(model.config.seed, Purpose::Made, all.len());
        self.frames = Some(Frames { contents: vec![None; all.len()], all, order });
        Ok(notes)
    }

    /// The prior: the one of a checkpoint, the model's own medium, or a new fit.
    fn prior(
        &mut self,
        model: &Model,
        capture: &Capture,
        notes: &mut Vec<String>,
    ) -> Result<Option<Prior>, ReconstructError> {
        if let PriorState::Open = self.prior {
            let fitted = match &model.medium {
                Some(term) => Ok((term.surface().clone(), term.medium().clone())),
                None if !matches!(
                    model.config.augmentation.source,
                    AugmentationSource::Auto | AugmentationSource::None
                ) =>
                {
                    surface_and_medium(model, capture)
                }
                None => {
                    self.prior = PriorState::Absent;
                    return Ok(None);
                }
            };
            self.prior = match fitted {
                Ok((surface, medium)) => {
                    if model.medium.is_none() {
                        notes.extend(medium.remarks(surface.spacing()));
                    }
                    PriorState::Fitted(Box::new((surface, medium)))
                }
                Err(ReconstructError::Unusable { detail }) => {
                    notes.push(format!("the prior makes no pictures: {detail}"));
                    PriorState::Absent
                }
                Err(other) => return Err(other),
            };
        }
        match &self.prior {
            PriorState::Fitted(fitted) => prior_of(model, capture, fitted.0.clone(), fitted.1.clone()).map(Some),
            _ => Ok(None),
        }
    }

    /// The picture whose turn is the `n`th of their kind.
    pub fn at(&mut self, n: u64) -> Result<MadePicture, ReconstructError> {
        let none = || error::stage("pictures that nobody took")("none was made");
        let frames = self.frames.as_mut().ok_or_else(none)?;
        let i = frames.order.at(n);
        let frame = frames.all.get(i).ok_or_else(none)?.clone();
        let pixels = frame.load().map_err(failure)?;
        let look = || Region::of_photograph(&pixels.radiance, pixels.mask.as_ref());
        let content = *frames.contents[i].get_or_insert_with(look);
        Ok(MadePicture { frame, pixels, content })
    }

    /// Writes what made the pictures, if they were made, into a checkpoint.
    pub fn store(&self, file: &mut TensorFile) -> Result<(), ReconstructError> {
        if !self.are_made() {
            return Ok(());
        }
        let by = match &self.prior {
            PriorState::Fitted(fitted) => {
                stored_medium::store(file, PRIOR, &fitted.0, &fitted.1)?;
                "prior"
            }
            _ => "others",
        };
        file.metadata.insert(MADE_BY.into(), by.into());
        Ok(())
    }

    /// Takes back what [`MadePictures::store`] wrote; the pictures are then made again from it, to the same bits.
    pub fn restore(&mut self, path: &Path, file: &mut TensorFile, surfels: usize) -> Result<(), ReconstructError> {
        if !file.metadata.contains_key(MADE_BY) {
            return Ok(());
        }
        self.prior = match stored_medium::restore(path, file, PRIOR, surfels)? {
            Some(fitted) => PriorState::Fitted(Box::new(fitted)),
            None => PriorState::Absent,
        };
        Ok(())
    }
}

/// What came of a source, in a line.
fn describe(made: &Augmentation, method: &str, more: &str) -> String {
    let (frames, found) = (made.frames.len(), made.found);
    let mut line =
        format!("{frames} pictures by {method}, believed to {:.2} in the mean{more}", made.mean_confidence());
    if found > 0 {
        line += &format!("; {found} were kept from before");
    }
    if let Some(first) = made.refused.first() {
        line += &format!("; {} refused, the first since {}", made.refused.len(), first.reason);
    }
    line
}
