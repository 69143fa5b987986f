//! A capture: views, the shots of each view, and where everything lies.
use crate::cache::ImageCache;
use crate::exclusions::{Exclusions, strip_png};
use crate::frames::{Frame, Frames, Lens};
use crate::{DatasetError, Place, folder};
use diamond_camera::{Camera, Intrinsics};
use diamond_image::Transfer;
use diamond_light::OlatLight;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

/// How the stored values of the PNGs relate to linear radiance (`Srgb` unless the user knows better; the real captures
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
    /// `transforms_test.json`, or `transforms_eval.json` where only that exists.
    #[default]
    Test,
    /// `transforms_eval.json`, or `transforms_test.json` where only that exists.
    Eval,
}

/// How to open a capture.
#[derive(Debug, Clone, PartialEq)]
pub struct OpenOptions {
    /// Stored values → linear radiance.
    pub transfer: TransferChoice,
    /// Whether RGB is already multiplied by alpha.
    pub alpha_premultiplied: AlphaPremultiplied,
    /// Bound of the image cache, bytes of stored samples (4 per pixel of an 8-bit RGBA image). Default 512 MiB.
    pub cache_bytes: usize,
    /// Which file holds the held-out images.
    pub eval_split: EvalSplit,
    /// Images whose header promises more pixels are refused before they are decoded. Default 64 Mi pixels.
    pub max_pixels: u64,
}

impl Default for OpenOptions {
    fn default() -> Self {
        Self {
            transfer: Transfer::Srgb,
            alpha_premultiplied: AlphaPremultiplied::Auto,
            cache_bytes: 512 << 20,
            eval_split: EvalSplit::Test,
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
    /// `points3d.ply` where it exists.
    pub points: Option<PathBuf>,
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
    pub(crate) hash: OnceLock<String>,
}

const TRAIN_JSON: &str = "transforms_train.json";

impl Capture {
    /// Opens a capture: reads and checks its JSON files, and that every image exists; decodes none.
    ///
    /// `path` is the capture's folder, or one of its JSON files. A folder must hold `transforms_train.json` (or, for
    /// captures without held-out images, `transforms.json`); `transforms_test.json` or `transforms_eval.json` is
    /// optional. Any other JSON file is read as the training split alone, with its folder as the capture's.
    /// `exclude_list.txt` in the folder names images to leave out, one per line: a path or a bare name, with or without
    /// extension; `#` begins a comment.
    ///
    /// Frames that list no image are left out with a note. An image may be named once per split; the same image in both
    /// splits is noted, since it makes the evaluation meaningless.
    pub fn open(path: &Path, options: &OpenOptions) -> Result<Capture, DatasetError> {
        let canonical = path.canonicalize().map_err(|e| DatasetError::io(path, "open the capture", e))?;
        let (root, train_json, only_train) = find_train(&canonical)?;
        let mut notes = Vec::new();
        let mut documents = vec![train_json.clone()];
        let excluded = Exclusions::read(&root, &mut documents)?;
        let train = build_split(&root, &train_json, Split::Train, &excluded, options, &mut notes)?;
        let mut test = Vec::new();
        if !only_train {
            let order = match options.eval_split {
                EvalSplit::Test => ["transforms_test.json", "transforms_eval.json"],
                EvalSplit::Eval => ["transforms_eval.json", "transforms_test.json"],
            };
            if let Some(name) = order.iter().find(|name| root.join(name).is_file()) {
                documents.push(root.join(name));
                test = build_split(&root, &root.join(name), Split::Test, &excluded, options, &mut notes)?;
            }
        }
        if test.is_empty() {
            notes.push("no held-out images: the result cannot be evaluated on views or lights it has not seen".into());
        }
        if train.is_empty() {
            return Err(DatasetError::Field {
                place: Place { file: train_json, frame: None, field: Some("frames".into()) }.into(),
                expected: "at least one image".into(),
                found: "none (no frames, no images in them, or all of them excluded)".into(),
                advice: "add a frame with file_paths and light_positions",
            });
        }
        excluded.note_unused(&mut notes);
        let points = Some(root.join("points3d.ply")).filter(|p| p.is_file());
        documents.extend(points.clone());
        let images = all_images(&train, &test, &mut notes);
        Ok(Capture {
            shared: Arc::new(Shared {
                cache: ImageCache::new(options.cache_bytes),
                documents,
                images,
                witnesses: spread(&train, 8),
                premultiplied: OnceLock::new(),
                hash: OnceLock::new(),
            }),
            root,
            train,
            test,
            points,
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

/// The folder, its training file, and whether there is only that file.
fn find_train(path: &Path) -> Result<(PathBuf, PathBuf, bool), DatasetError> {
    if path.is_dir() {
        let candidates = [TRAIN_JSON, "transforms.json"];
        return match candidates.iter().map(|name| path.join(name)).find(|p| p.is_file()) {
            Some(json) => Ok((path.to_path_buf(), json, false)),
            None => Err(DatasetError::io(
                &path.join(TRAIN_JSON),
                "open the training frames",
                std::io::Error::other("no such file in this folder; is this the capture's folder?"),
            )),
        };
    }
    let root = path.parent().unwrap_or(path).to_path_buf();
    let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
    match name {
        TRAIN_JSON => Ok((root, path.to_path_buf(), false)),
        "transforms_test.json" | "transforms_eval.json" => find_train(&root),
        _ => Ok((root, path.to_path_buf(), true)),
    }
}

fn build_split(
    root: &Path,
    json: &Path,
    split: Split,
    excluded: &Exclusions,
    options: &OpenOptions,
    notes: &mut Vec<String>,
) -> Result<Vec<View>, DatasetError> {
    let Frames { frames, notes: remarks } = crate::frames::read_frames(json)?;
    notes.extend(remarks);
    let mut views: Vec<View> = Vec::new();
    let mut first_use: BTreeMap<PathBuf, Place> = BTreeMap::new();
    for frame in frames {
        let mut shots = Vec::new();
        for (light_index, entry) in frame.entries.iter().enumerate() {
            if excluded.contains(&entry.file) {
                continue;
            }
            let path = find_image(root, &entry.file, &entry.place)?;
            if let Some(first) = first_use.insert(path.clone(), entry.place.clone()) {
                return Err(DatasetError::Field {
                    place: entry.place.clone().into(),
                    expected: "an image that no other entry of the file names".into(),
                    found: format!("\"{}\", already named by {first}", entry.file),
                    advice: "an image has one camera and one light: remove one of the two entries",
                });
            }
            shots.push(Shot {
                name: path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default(),
                path,
                light: entry.light,
                provenance: entry.provenance.clone(),
                weight: entry.weight,
                light_index,
                width: 0,
                height: 0,
                named_by: entry.place.clone(),
            });
        }
        if shots.is_empty() {
            continue;
        }
        let camera = Camera { intrinsics: intrinsics(&frame, &shots[0], json, options)?, pose: frame.pose };
        for shot in &mut shots {
            (shot.width, shot.height) = (camera.intrinsics.width, camera.intrinsics.height);
        }
        // In the NeRF layout each image is a frame of its own: frames with the same camera are one view.
        if frame.entries.len() == 1
            && let Some(view) = views.iter_mut().find(|view| view.camera == camera)
        {
            shots.iter_mut().for_each(|shot| shot.light_index = view.shots.len());
            view.shots.append(&mut shots);
            continue;
        }
        let name = view_name(&shots).unwrap_or_else(|| format!("view_{}", frame.index));
        views.push(View { name, camera, shots, split, index: frame.index, geometry: None });
    }
    let folder = match split {
        Split::Train => "train",
        Split::Test => "test",
    };
    for view in &mut views {
        let path = format!("geometry/{folder}_{}.exr", view.name);
        view.geometry = folder::resolve(root, &path, &Place::file(json)).ok();
    }
    make_names_unique(root, &mut views);
    Ok(views)
}

/// The image that an entry names: `.png` is appended; an extension that is already there is tolerated.
fn find_image(root: &Path, written: &str, place: &Place) -> Result<PathBuf, DatasetError> {
    let with_png =
        if strip_png(written).len() < written.len() { written.to_string() } else { format!("{written}.png") };
    folder::resolve(root, &with_png, place)
}

/// Intrinsics of a frame; a missing image size is read from the header of its first image.
fn intrinsics(frame: &Frame, first: &Shot, json: &Path, options: &OpenOptions) -> Result<Intrinsics, DatasetError> {
    let (width, height) = match (frame.width, frame.height) {
        (Some(w), Some(h)) => (w, h),
        _ => crate::stored::read_size(&first.path, &first.named_by)?,
    };
    if u64::from(width) * u64::from(height) > options.max_pixels {
        let max_pixels = options.max_pixels;
        let named_by =
            Place { file: json.to_path_buf(), frame: Some(frame.index), field: Some("width, height".into()) };
        return Err(DatasetError::TooLarge {
            path: first.path.clone(),
            named_by: named_by.into(),
            width,
            height,
            max_pixels,
        });
    }
    let (centre_x, centre_y) = (0.5 * width as f32, 0.5 * height as f32);
    Ok(match frame.lens {
        Lens::FovX { fov_x, cx, cy } => {
            let k = Intrinsics::from_fov_x(fov_x, width, height);
            Intrinsics { cx: cx.unwrap_or(k.cx), cy: cy.unwrap_or(k.cy), ..k }
        }
        Lens::Focal { fx, fy, cx, cy } => {
            Intrinsics { fx, fy, cx: cx.unwrap_or(centre_x), cy: cy.unwrap_or(centre_y), width, height }
        }
    })
}

/// `r_<view>` where all shots are called `r_<view>_l_<light>` with the same view.
fn view_name(shots: &[Shot]) -> Option<String> {
    let mut names = shots.iter().map(|shot| {
        let (view, light) = shot.name.strip_prefix("r_")?.split_once("_l_")?;
        (is_number(view) && is_number(light)).then(|| format!("r_{view}"))
    });
    let first = names.next()??;
    names.all(|name| name.as_deref() == Some(&first)).then_some(first)
}

fn is_number(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit())
}

/// Views and shots whose names collide get the frame's index, or the folder, into their names.
fn make_names_unique(root: &Path, views: &mut [View]) {
    let mut seen = BTreeSet::new();
    for view in views.iter_mut() {
        if !seen.insert(view.name.clone()) {
            view.name = format!("{}_frame_{}", view.name, view.index);
        }
    }
    let mut count: BTreeMap<String, usize> = BTreeMap::new();
    for shot in views.iter().flat_map(|view| &view.shots) {
        *count.entry(shot.name.clone()).or_default() += 1;
    }
    for shot in views.iter_mut().flat_map(|view| &mut view.shots) {
        if count[&shot.name] > 1 {
            let relative = shot.path.strip_prefix(root).unwrap_or(&shot.path).with_extension("");
            shot.name = relative.components().map(|c| c.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("_");
        }
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
