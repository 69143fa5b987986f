//! A capture: views, the shots of each view, and where everything lies.
use crate::cache::ImageCache;
use crate::develop::Undistortion;
use crate::exclusions::{Exclusions, strip_extension};
use crate::format::{CaptureFormat, Found, Source};
use crate::frames::{Frame, Frames};
use crate::hash::Identity;
use crate::lights::{Lights, parse_lights};
use crate::views::Context;
use crate::{DatasetError, Place, folder};
use diamond_camera::Camera;
use diamond_image::Transfer;
use diamond_light::OlatLight;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

/// How the stored values of PNG and JPEG files relate to linear radiance (`Srgb` unless the user knows better; the real captures
/// of the SSS-3DGS data set are `Gamma22`). Chunks in the PNG that speak of colour are ignored.
pub type TransferChoice = Transfer;

/// Whether RGB is already multiplied by alpha.
///
/// *Premultiplied* means that the stored RGB is the object over black: decoding it to linear gives radiance × coverage,
/// as a renderer accumulates it. *Straight* means that RGB is the object's own colour and must still be multiplied.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum AlphaPremultiplied {
    /// Decide from the images of the capture; see [`Capture::alpha_premultiplied`].
    #[default]
    Auto,
    /// RGB is already multiplied by alpha.
    Yes,
    /// RGB is straight.
    No,
}

/// Which file holds the held-out images.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum EvalSplit {
    /// `transforms_test.json`, else `transforms_eval.json`, else `transforms_val.json`.
    #[default]
    Test,
    /// `transforms_eval.json`, else `transforms_val.json`, else `transforms_test.json`.
    Eval,
}

/// How to open a capture.
#[derive(Debug, Clone, PartialEq)]
pub struct OpenOptions {
    /// The format, or `None` to take what the folder holds: `transforms_train.json` before `transforms.json` before a
    /// COLMAP model.
    pub format: Option<CaptureFormat>,
    /// Stored values of PNG and JPEG files → linear radiance.
    pub transfer: TransferChoice,
    /// Stored values of EXR files → linear radiance; linear, unless a program wrote something else.
    pub exr_transfer: Transfer,
    /// Whether RGB is already multiplied by alpha.
    pub alpha_premultiplied: AlphaPremultiplied,
    /// Bound of the image cache, bytes of stored samples (4 per pixel of an 8-bit RGBA image). Default 512 MiB.
    pub cache_bytes: usize,
    /// Which file holds the held-out images.
    pub eval_split: EvalSplit,
    /// Of a nerfstudio or COLMAP capture that holds nothing out itself, every view with an index of `n − 1` modulo `n` is
    /// held out; 0 keeps all for training. Default 8.
    pub hold_out_every: usize,
    /// Images whose header promises more pixels are refused before they are decoded. Default 64 Mi pixels.
    pub max_pixels: u64,
}

impl Default for OpenOptions {
    fn default() -> Self {
        Self {
            format: None,
            transfer: Transfer::Srgb,
            exr_transfer: Transfer::Linear,
            alpha_premultiplied: AlphaPremultiplied::Auto,
            cache_bytes: 512 << 20,
            eval_split: EvalSplit::Test,
            hold_out_every: 8,
            max_pixels: 64 << 20,
        }
    }
}

/// Which part of a capture a view belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Split {
    /// Images to reconstruct from.
    Train,
    /// Images held out for evaluation.
    Test,
}

/// Where an image comes from.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Default)]
pub enum Provenance {
    /// Taken by a camera (or by the renderer that stands in for one).
    #[default]
    Photograph,
    /// Made by a model; it supports the reconstruction but is no evidence.
    Synthetic {
        /// How it was made.
        method: String,
    },
}

/// What says which pixels of an image show the object.
///
/// In this order: the file that the capture names (`mask_path`), a mask file beside the image, the image's alpha, a
/// photograph of the background. Where a mask file is there, the image's own alpha is not looked at; a background is only
/// where there is no alpha.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum MaskSource {
    /// The image's alpha; without one nothing says it.
    #[default]
    Alpha,
    /// A mask file: white (and opaque) on the object.
    File(PathBuf),
    /// The alpha where there is one, else the difference from this photograph of the background.
    Background(PathBuf),
}

/// One image: a view under one light.
#[derive(Debug, Clone, PartialEq)]
pub struct Shot {
    /// The image file, canonical, inside the capture's folder.
    pub path: PathBuf,
    /// The file's stem, unique within the split (`r_3_l_12`).
    pub name: String,
    /// The light, in world axes; its intensity is 1 where the capture does not say.
    pub light: OlatLight,
    /// Where the image comes from.
    pub provenance: Provenance,
    /// Weight in the photometric losses, at least 0; 1 where the capture does not say.
    pub weight: f32,
    /// Index of this image in its frame as written (before exclusions and selections).
    pub light_index: usize,
    /// Width of the image, pixels.
    pub width: u32,
    /// Height of the image, pixels.
    pub height: u32,
    /// What says which pixels show the object.
    pub mask: MaskSource,
    /// The lens to take out on loading; `None` for a pinhole.
    pub undistortion: Option<Arc<Undistortion>>,
    /// The field that names the image, for error messages.
    pub named_by: Place,
}

/// One camera and the shots taken with it.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// `r_<view>` where the file names follow the synthetic scheme, else `view_<frame>`.
    pub name: String,
    /// Intrinsics and pose.
    pub camera: Camera,
    /// The images, in the order of the file; at least one.
    pub shots: Vec<Shot>,
    /// Training or held out.
    pub split: Split,
    /// Index of the (first) frame in its file, before exclusions and selections.
    pub index: usize,
    /// `geometry/<split>_<name>.exr` where it exists.
    pub(crate) geometry: Option<PathBuf>,
}

/// An opened capture. Cheap to clone and to select from: images are loaded on demand through one shared, bounded cache.
#[derive(Debug, Clone)]
pub struct Capture {
    /// The folder, canonical.
    pub root: PathBuf,
    /// Views to reconstruct from; at least one.
    pub train: Vec<View>,
    /// Held-out views; may be empty.
    pub test: Vec<View>,
    /// The file of the initial points, where there is one: `points3d.ply`, the `ply_file_path` of nerfstudio, or COLMAP's
    /// `points3D.bin` or `.txt` (see [`crate::read_colmap_points`]).
    pub points: Option<PathBuf>,
    /// How the capture is written down.
    pub format: CaptureFormat,
    /// Remarks for the user: what was ignored or is missing, one sentence each.
    pub notes: Vec<String>,
    /// The options it was opened with.
    pub options: OpenOptions,
    pub(crate) shared: Arc<Shared>,
}

/// What all selections of one capture share.
#[derive(Debug)]
pub(crate) struct Shared {
    pub(crate) cache: ImageCache,
    /// Files that make up the capture besides the images.
    pub(crate) documents: Vec<PathBuf>,
    /// Every image of the capture as opened, sorted.
    pub(crate) images: Vec<PathBuf>,
    /// Images that are asked whether RGB is premultiplied, spread evenly over the capture as opened.
    pub(crate) witnesses: Vec<Shot>,
    pub(crate) premultiplied: OnceLock<bool>,
    /// Every light of the training images as opened, each once, in the order in which they first appear.
    pub(crate) rig: Vec<OlatLight>,
    /// What the files had in them when the capture was hashed.
    pub(crate) identity: OnceLock<Identity>,
}

impl Capture {
    /// Opens a capture: reads and checks the files that describe it, and that every image exists; decodes none.
    ///
    /// `path` is the capture's folder, or one of its files. What the folder holds decides how it is read (unless
    /// [`OpenOptions::format`] does): `transforms_train.json` with `transforms_test.json`, `_eval` or `_val` for held-out
    /// images; else `transforms.json`; else a COLMAP model. Any other JSON file is read as the training split alone, with
    /// its folder as the capture's. What was read and why is the first of [`Capture::notes`] where it is not
    /// `transforms_train.json` alone.
    ///
    /// `lights.json` in the folder gives lights to images whose format has none (see docs/formats.md).
    /// `held_out_list.txt` names the images of a nerfstudio or COLMAP capture to hold out, `exclude_list.txt` names images to leave out, one per line: a
    /// path or a bare name, with or without extension; `#` begins a comment.
    ///
    /// Frames that list no image are left out with a note. An image may be named once per split; the same image in both
    /// splits is noted, since it makes the evaluation meaningless.
    pub fn open(path: &Path, options: &OpenOptions) -> Result<Capture, DatasetError> {
        let canonical = path.canonicalize().map_err(|e| DatasetError::io(path, "open the capture", e))?;
        let found = crate::format::find(&canonical, options.format, options.eval_split)?;
        let root = &found.root;
        let mut documents = Vec::new();
        let mut notes = Vec::new();
        if found.format != CaptureFormat::Blender || found.why.contains("goes before") {
            notes.push(found.why.clone());
        }
        let (file, train_frames, test_frames) = read_source(&found, &mut documents)?;
        let excluded = Exclusions::read(root, "exclude_list.txt", &mut documents)?;
        if let Source::Transforms { test, .. } = &found.source {
            documents.extend(test.clone());
        }
        let lights = read_lights(root, &mut documents)?;
        let held_out = match found.may_hold_out {
            true => Exclusions::read(root, "held_out_list.txt", &mut documents)?,
            false => Exclusions::default(),
        };
        let image_folders: &[&str] = match found.format {
            CaptureFormat::Colmap => &["images", "image", "input", "."],
            CaptureFormat::Blender | CaptureFormat::Nerfstudio => &["."],
        };
        let lights = lights.as_ref();
        let context = Context { root, file: &file, image_folders, excluded: &excluded, lights, options };
        let (mut train, mut test) =
            split(&context, &found, &train_frames, test_frames.as_ref(), &held_out, &mut notes)?;
        context.find_geometry(&mut train);
        context.find_geometry(&mut test);
        if test.is_empty() {
            notes.push("no held-out images: the result cannot be evaluated on views or lights it has not seen".into());
        }
        if train.is_empty() {
            return Err(DatasetError::Field {
                place: Place { file, frame: None, field: Some("frames".into()) }.into(),
                expected: "at least one image".into(),
                found: "none (no frames, no images in them, or all of them excluded)".into(),
                advice: "add a frame with file_paths and light_positions",
            });
        }
        excluded.note_unused(&mut notes);
        lights.iter().for_each(|lights| lights.note_unused(&mut notes));
        note_lenses_and_masks(&train, &test, &mut notes);
        let points = find_points(&found, &train_frames, &mut notes)?;
        documents.extend(points.clone().filter(|p| !documents.contains(p)));
        let images = all_images(&train, &test, &mut notes);
        let beside: BTreeSet<PathBuf> =
            train.iter().chain(&test).flat_map(|v| &v.shots).filter_map(mask_file).collect();
        documents.extend(beside);
        Ok(Capture {
            shared: Arc::new(Shared {
                cache: ImageCache::new(options.cache_bytes),
                documents,
                images,
                witnesses: spread(&train, 8),
                premultiplied: OnceLock::new(),
                rig: crate::select::different_lights(&train),
                identity: OnceLock::new(),
            }),
            root: found.root,
            train,
            test,
            points,
            format: found.format,
            notes,
            options: options.clone(),
        })
    }

    /// The views of a split.
    pub fn views(&self, split: Split) -> &[View] {
        match split {
            Split::Train => &self.train,
            Split::Test => &self.test,
        }
    }
}

/// The file that describes the training images, its frames, and those of the held-out images where a file has them.
fn read_source(found: &Found, documents: &mut Vec<PathBuf>) -> Result<(PathBuf, Frames, Option<Frames>), DatasetError> {
    match &found.source {
        Source::Transforms { train, test } => {
            documents.push(train.clone());
            let frames = crate::frames::read_frames(train)?;
            let held_out = test.as_ref().map(|path| crate::frames::read_frames(path)).transpose()?;
            Ok((train.clone(), frames, held_out))
        }
        Source::Colmap(model) => {
            documents.extend([model.cameras.clone(), model.images.clone()]);
            Ok((model.images.clone(), model.read()?, None))
        }
    }
}

/// The largest `lights.json` that is read, bytes.
const MAX_LIGHTS_BYTES: u64 = 64 << 20;

fn read_lights(root: &Path, documents: &mut Vec<PathBuf>) -> Result<Option<Lights>, DatasetError> {
    let path = root.join("lights.json");
    if !path.is_file() {
        return Ok(None);
    }
    let bytes = folder::read_bytes(&path, MAX_LIGHTS_BYTES, "read the lights")?;
    let lights = parse_lights(&path, &bytes)?;
    documents.push(path);
    Ok(Some(lights))
}

/// Training and held-out views: as files or lists of the capture say, else every so many views.
fn split(
    context: &Context,
    found: &Found,
    frames: &Frames,
    held_out: Option<&Frames>,
    listed: &Exclusions,
    notes: &mut Vec<String>,
) -> Result<(Vec<View>, Vec<View>), DatasetError> {
    notes.extend(frames.notes.iter().cloned());
    notes.extend(held_out.iter().flat_map(|f| &f.notes).cloned());
    if let Some(held_out) = held_out {
        let train = context.build(frames, Split::Train, &|_| true)?;
        return Ok((train, context.build(held_out, Split::Test, &|_| true)?));
    }
    if !listed.is_empty() {
        let is_test = |frame: &Frame| frame.entries.iter().any(|e| listed.contains(&e.file));
        let test = context.build(frames, Split::Test, &is_test)?;
        let train = context.build(frames, Split::Train, &|frame| !is_test(frame))?;
        listed.note_unused(notes);
        notes.push(format!("held-out images are those of held_out_list.txt: {} views", test.len()));
        return Ok((train, test));
    }
    if let Some(test_files) = frames.test_files.as_ref().filter(|_| found.may_hold_out) {
        let named = |list: &[String], frame: &Frame| {
            let is = |a: &str, b: &str| {
                strip_extension(a.trim_start_matches("./")) == strip_extension(b.trim_start_matches("./"))
            };
            frame.entries.iter().any(|e| list.iter().any(|f| is(f, &e.file)))
        };
        let is_test = |frame: &Frame| named(test_files, frame);
        let is_train = |frame: &Frame| match &frames.train_files {
            Some(list) => named(list, frame),
            None => !is_test(frame),
        };
        let test = context.build(frames, Split::Test, &is_test)?;
        notes.push(format!("held-out images are those that the file itself lists: {} views", test.len()));
        return Ok((context.build(frames, Split::Train, &is_train)?, test));
    }
    let all = context.build(frames, Split::Train, &|_| true)?;
    let every = context.options.hold_out_every;
    if !found.may_hold_out || every < 2 || all.len() < every {
        return Ok((all, vec![]));
    }
    let (mut train, mut test) = (Vec::new(), Vec::new());
    for (i, mut view) in all.into_iter().enumerate() {
        if i % every == every - 1 {
            view.split = Split::Test;
            test.push(view);
        } else {
            train.push(view);
        }
    }
    notes.push(format!(
        "the capture holds no images out, so each {every}th view is ({} of {}): see OpenOptions::hold_out_every",
        test.len(),
        test.len() + train.len()
    ));
    Ok((train, test))
}

/// The file of the initial points.
fn find_points(found: &Found, frames: &Frames, notes: &mut Vec<String>) -> Result<Option<PathBuf>, DatasetError> {
    let ply = found.root.join("points3d.ply");
    if ply.is_file() {
        return Ok(Some(ply));
    }
    match &found.source {
        Source::Colmap(model) => {
            let Some(path) = &model.points else { return Ok(None) };
            let none = crate::read_colmap_points(path)?.positions.is_empty();
            if none {
                notes.push(format!("{} holds no points: no initial points", path.display()));
            }
            Ok((!none).then(|| path.clone()))
        }
        Source::Transforms { train, .. } => {
            let Some(named) = &frames.points else { return Ok(None) };
            let place = Place { file: train.clone(), frame: None, field: Some("ply_file_path".into()) };
            match folder::resolve(&found.root, named, &place) {
                Ok(path) => Ok(Some(path)),
                Err(e @ DatasetError::Outside { .. }) => Err(e),
                Err(_) => {
                    notes.push(format!("ply_file_path names \"{named}\", which is not there: no initial points"));
                    Ok(None)
                }
            }
        }
    }
}

/// The file that a shot's mask comes from, if it is not the image.
fn mask_file(shot: &Shot) -> Option<PathBuf> {
    match &shot.mask {
        MaskSource::Alpha => None,
        MaskSource::File(path) | MaskSource::Background(path) => Some(path.clone()),
    }
}

/// Says what is undistorted and where masks come from, unless all of it is alpha.
fn note_lenses_and_masks(train: &[View], test: &[View], notes: &mut Vec<String>) {
    let shots = || train.iter().chain(test).flat_map(|v| &v.shots);
    let count = |f: &dyn Fn(&Shot) -> bool| shots().filter(|s| f(s)).count();
    let all = count(&|_| true);
    let bent = count(&|s| s.undistortion.is_some());
    if bent > 0 {
        notes.push(format!(
            "{bent} of {all} images are undistorted on loading: same size, focal lengths and principal point, so what \
             the lens saw beyond that pinhole's field of view is cut off"
        ));
    }
    let files = count(&|s| matches!(s.mask, MaskSource::File(_)));
    if files > 0 {
        notes.push(format!("masks: of {files} of {all} images from files (an alpha of theirs is not looked at)"));
    }
    let backgrounds = count(&|s| matches!(s.mask, MaskSource::Background(_)));
    if backgrounds > 0 {
        notes.push(format!(
            "masks: of {backgrounds} of {all} images from the alpha or, where there is none, by comparison with a \
             photograph of the background; look at them before you rely on them"
        ));
    }
}

/// Every image, sorted; notes images that are in both splits.
fn all_images(train: &[View], test: &[View], notes: &mut Vec<String>) -> Vec<PathBuf> {
    let paths = |views: &[View]| -> BTreeSet<PathBuf> {
        views.iter().flat_map(|view| &view.shots).map(|shot| shot.path.clone()).collect()
    };
    let (train, test) = (paths(train), paths(test));
    let both = train.intersection(&test).count();
    if both > 0 {
        notes.push(format!(
            "{both} images are in both the training and the held-out split: figures on them say nothing about new \
             views or lights"
        ));
    }
    train.union(&test).cloned().collect()
}

/// At most `count` shots, spread evenly over the views.
fn spread(views: &[View], count: usize) -> Vec<Shot> {
    let shots: Vec<&Shot> = views.iter().flat_map(|view| &view.shots).collect();
    let n = count.min(shots.len());
    (0..n).map(|i| shots[i * shots.len() / n].clone()).collect()
}
