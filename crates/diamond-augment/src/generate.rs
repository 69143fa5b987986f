//! Pictures for all targets: made in batches or found on disk, looked at, let in or refused.
use crate::frame::{Packed, Pixels};
use crate::hull::{Hull, overlap};
use crate::{AugmentError, Frame, Source, Target, cache};
use diamond_dataset::{Capture, Provenance};
use diamond_image::Mask;
use std::path::PathBuf;
use std::sync::Arc;

/// How pictures are made and judged.
#[derive(Debug, Clone, PartialEq)]
pub struct GenerateOptions {
    /// Folder in which pictures are kept, and from which frames are read when they are loaded; without one they stay in memory.
    pub folder: Option<PathBuf>,
    /// Seed of sources that draw random numbers; part of a kept picture's name.
    pub seed: u64,
    /// Targets that a source is asked for at a time.
    pub batch: usize,
    /// Least overlap over union of a picture's mask and the mask of the photographs of its view.
    pub min_overlap: f32,
    /// Largest share of a picture's mask, from where nobody photographed, that lies where the photographs' masks leave no room.
    pub max_outside: f32,
}

impl Default for GenerateOptions {
    fn default() -> Self {
        Self { folder: None, seed: 0, batch: 16, min_overlap: 0.9, max_outside: 0.05 }
    }
}

/// A picture that was refused.
#[derive(Debug, Clone, PartialEq)]
pub struct Refused {
    /// What was asked for.
    pub target: Target,
    /// Why it is not used.
    pub reason: String,
}

/// What a source has made of the targets.
#[derive(Debug, Clone, Default)]
pub struct Augmentation {
    /// Pictures that were let in, in the order of the targets.
    pub frames: Vec<Frame>,
    /// Pictures that were not.
    pub refused: Vec<Refused>,
    /// Pictures that were found on disk.
    pub found: usize,
}

impl Augmentation {
    /// Mean confidence of the frames, 0 … 1; 0 where there are none.
    pub fn mean_confidence(&self) -> f32 {
        self.frames.iter().map(|f| f.confidence).sum::<f32>() / self.frames.len().max(1) as f32
    }
}

/// Confidence below half a step of a byte in every pixel is none.
const NO_CONFIDENCE: f32 = 0.5 / 255.0;

/// Pictures of `targets` by `source`. `progress` is told how many are done, of how many.
///
/// A picture is refused where it contradicts the photographs: its mask overlaps that of its view too little, or, from where nobody photographed, covers
/// what the hull of the photographs' masks leaves empty; and where nothing of it is believed.
///
/// # Errors
/// The source's; pictures of another size, or with values that are none; photographs that cannot be read; a folder that cannot be written to.
pub fn generate(
    capture: &Capture,
    targets: &[Target],
    source: &mut dyn Source,
    options: &GenerateOptions,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Augmentation, AugmentError> {
    let mut out = Augmentation::default();
    let masks = masks(capture)?;
    let mut hull: Option<Hull> = None;
    let provenance = Provenance::Synthetic { method: source.method() };
    for (n, batch) in targets.chunks(options.batch.max(1)).enumerate() {
        for (target, (packed, file)) in batch.iter().zip(made(capture, batch, source, options, &mut out.found)?) {
            if target.view.is_none() && hull.is_none() {
                hull = Some(hull_of(capture, &masks));
            }
            match judge(target, &packed, &masks, hull.as_ref(), options)? {
                Some(reason) => out.refused.push(Refused { target: *target, reason }),
                None => out.frames.push(Frame {
                    target: *target,
                    provenance: provenance.clone(),
                    confidence: packed.mean_confidence(),
                    pixels: file.map_or_else(|| Pixels::Memory(Arc::new(packed)), Pixels::File),
                }),
            }
        }
        progress((n * options.batch.max(1) + batch.len()).min(targets.len()), targets.len());
    }
    Ok(out)
}

/// The pictures of a batch, and their files where they have some.
fn made(
    capture: &Capture,
    batch: &[Target],
    source: &mut dyn Source,
    options: &GenerateOptions,
    found: &mut usize,
) -> Result<Vec<(Packed, Option<PathBuf>)>, AugmentError> {
    let keys: Vec<String> = match &options.folder {
        Some(_) => batch.iter().map(|t| cache::key(capture, source, t, options.seed)).collect::<Result<_, _>>()?,
        None => vec![String::new(); batch.len()],
    };
    let mut all: Vec<Option<(Packed, Option<PathBuf>)>> = keys
        .iter()
        .map(|key| {
            let folder = options.folder.as_ref()?;
            Some((cache::find(folder, key)?, Some(cache::path(folder, key))))
        })
        .collect();
    *found += all.iter().filter(|p| p.is_some()).count();
    let missing: Vec<usize> = (0..batch.len()).filter(|i| all[*i].is_none()).collect();
    if !missing.is_empty() {
        let wanted: Vec<Target> = missing.iter().map(|i| batch[*i]).collect();
        let asked = source.pictures(capture, &wanted);
        let pictures = asked.map_err(|e| AugmentError::Source { method: source.method(), source: e })?;
        let wrong_count = format!("expected {} pictures, found {}", wanted.len(), pictures.len());
        let wrong = |detail: String| AugmentError::Picture { method: source.method(), detail };
        if pictures.len() != wanted.len() {
            return Err(wrong(wrong_count));
        }
        for (i, picture) in missing.into_iter().zip(&pictures) {
            let k = &batch[i].camera.intrinsics;
            let packed = Packed::new(picture, k.width as usize, k.height as usize).map_err(wrong)?;
            let file = match &options.folder {
                Some(folder) => Some(cache::keep(folder, &keys[i], &packed)?),
                None => None,
            };
            all[i] = Some((packed, file));
        }
    }
    Ok(all.into_iter().flatten().collect())
}

/// The mask of the first photograph of each training view.
fn masks(capture: &Capture) -> Result<Vec<Option<Mask>>, AugmentError> {
    let of = |view: &diamond_dataset::View| match view.shots.first() {
        Some(shot) => Ok(capture.observation(shot)?.mask.clone()),
        None => Ok(None),
    };
    capture.train.iter().map(of).collect()
}

fn hull_of(capture: &Capture, masks: &[Option<Mask>]) -> Hull {
    let scene = capture.scene();
    let known = capture.train.iter().zip(masks).filter_map(|(v, m)| Some((v.camera, m.clone()?)));
    Hull { masks: known.collect(), centre: scene.centre, radius: scene.framed_radius }
}

/// Why a picture is refused, if it is.
fn judge(
    target: &Target,
    packed: &Packed,
    masks: &[Option<Mask>],
    hull: Option<&Hull>,
    options: &GenerateOptions,
) -> Result<Option<String>, AugmentError> {
    let wrong = |detail: String| AugmentError::Picture { method: "a source".into(), detail };
    let loaded = packed.unpack().map_err(wrong)?;
    if loaded.confidence.data().iter().all(|c| *c < NO_CONFIDENCE) {
        return Ok(Some("nothing of it is believed: the confidence is 0 everywhere".into()));
    }
    let Some(mask) = &loaded.mask else { return Ok(None) };
    let photographed = target.view.and_then(|v| masks.get(v)).and_then(Option::as_ref);
    if let Some(photographed) = photographed {
        let found = overlap(mask, photographed);
        let least = options.min_overlap;
        return Ok((found < least).then(|| {
            format!("its silhouette overlaps that of its view's photographs by {found:.2} of their union, expected at least {least}")
        }));
    }
    let Some(hull) = hull.filter(|h| target.view.is_none() && !h.masks.is_empty()) else { return Ok(None) };
    let (found, most) = (hull.outside(&target.camera, mask), options.max_outside);
    Ok((found > most).then(|| {
        format!(
            "{:.0} % of its silhouette lies outside of the photographs' hull, expected at most {:.0} %",
            100.0 * found,
            100.0 * most
        )
    }))
}
