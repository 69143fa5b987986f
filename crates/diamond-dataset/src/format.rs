//! Which format a folder holds, and which of its files are to be read.
use crate::colmap::Model;
use crate::{DatasetError, EvalSplit};
use std::path::{Path, PathBuf};

/// How a capture is written down.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum CaptureFormat {
    /// `transforms_train.json` and its companions: the layouts of NeRF (one image per frame) and SSS-3DGS (many).
    Blender,
    /// One `transforms.json`, as nerfstudio writes it.
    Nerfstudio,
    /// A COLMAP model in `sparse/0`, `sparse`, `colmap/sparse/0`, or the folder itself.
    Colmap,
}

impl std::fmt::Display for CaptureFormat {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            CaptureFormat::Blender => "blender",
            CaptureFormat::Nerfstudio => "nerfstudio",
            CaptureFormat::Colmap => "colmap",
        })
    }
}

impl std::str::FromStr for CaptureFormat {
    type Err = DatasetError;

    fn from_str(text: &str) -> Result<Self, DatasetError> {
        match text {
            "blender" => Ok(CaptureFormat::Blender),
            "nerfstudio" => Ok(CaptureFormat::Nerfstudio),
            "colmap" => Ok(CaptureFormat::Colmap),
            other => Err(DatasetError::Selection {
                what: "capture format",
                reason: format!("\"{other}\" is none; choose blender, nerfstudio or colmap"),
            }),
        }
    }
}

/// Where the cameras are.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Source {
    /// `transforms*.json`: training, and held out.
    Transforms { train: PathBuf, test: Option<PathBuf> },
    /// A COLMAP model.
    Colmap(Model),
}

/// What was found in a folder.
#[derive(Debug)]
pub(crate) struct Found {
    /// The capture's folder.
    pub(crate) root: PathBuf,
    pub(crate) format: CaptureFormat,
    pub(crate) source: Source,
    /// What was read and why, one sentence.
    pub(crate) why: String,
    /// Whether views may be held out where the capture itself holds none out.
    pub(crate) may_hold_out: bool,
}

const TRAIN: &str = "transforms_train.json";
const SINGLE: &str = "transforms.json";

/// Where a COLMAP model is looked for, below the capture's folder.
const MODEL_FOLDERS: [&str; 4] = ["sparse/0", "sparse", "colmap/sparse/0", "."];

/// Looks for a capture at a canonical path: a folder or one of its files.
pub(crate) fn find(path: &Path, wanted: Option<CaptureFormat>, eval: EvalSplit) -> Result<Found, DatasetError> {
    if path.is_dir() {
        return find_in(path, wanted, eval);
    }
    let root = path.parent().unwrap_or(path);
    let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
    match name {
        TRAIN | "transforms_test.json" | "transforms_eval.json" | "transforms_val.json" => {
            find_in(root, Some(wanted.unwrap_or(CaptureFormat::Blender)), eval)
        }
        SINGLE => find_in(root, Some(CaptureFormat::Nerfstudio), eval),
        "cameras.bin" | "cameras.txt" | "images.bin" | "images.txt" => {
            // The folder of the images is above that of the model.
            let above = |n: usize| root.ancestors().nth(n).unwrap_or(root);
            let up = match root.file_name().and_then(|n| n.to_str()) {
                Some("0") => 2,
                Some("sparse") => 1,
                _ => 0,
            };
            find_in(above(up), Some(CaptureFormat::Colmap), eval)
        }
        _ => Ok(Found {
            root: root.to_path_buf(),
            format: CaptureFormat::Blender,
            source: Source::Transforms { train: path.to_path_buf(), test: None },
            why: format!("read {name} alone, as training images, because it was named"),
            may_hold_out: false,
        }),
    }
}

fn find_in(root: &Path, wanted: Option<CaptureFormat>, eval: EvalSplit) -> Result<Found, DatasetError> {
    let file = |name: &str| Some(root.join(name)).filter(|p| p.is_file());
    let held_out = || {
        let order = match eval {
            EvalSplit::Test => ["transforms_test.json", "transforms_eval.json", "transforms_val.json"],
            EvalSplit::Eval => ["transforms_eval.json", "transforms_val.json", "transforms_test.json"],
        };
        order.into_iter().find_map(file)
    };
    let model = || MODEL_FOLDERS.iter().find_map(|folder| Model::find(&root.join(folder)));
    let is = |format: CaptureFormat| wanted.is_none_or(|w| w == format);
    let because = |others: &[(&str, bool)]| {
        let there: Vec<&str> = others.iter().filter(|(_, there)| *there).map(|(name, _)| *name).collect();
        match (wanted, there.is_empty()) {
            (Some(format), _) => format!(", because the format {format} was asked for"),
            (None, true) => String::new(),
            (None, false) => format!(", which goes before {}", there.join(" and ")),
        }
    };
    if is(CaptureFormat::Blender)
        && let Some(train) = file(TRAIN)
    {
        let why = because(&[(SINGLE, file(SINGLE).is_some()), ("a COLMAP model", model().is_some())]);
        return Ok(Found {
            root: root.to_path_buf(),
            format: CaptureFormat::Blender,
            source: Source::Transforms { train, test: held_out() },
            why: format!("read as split transforms files: the folder holds {TRAIN}{why}"),
            may_hold_out: false,
        });
    }
    if is(CaptureFormat::Nerfstudio)
        && let Some(train) = file(SINGLE)
    {
        let why = because(&[("a COLMAP model", model().is_some())]);
        let test = held_out();
        return Ok(Found {
            root: root.to_path_buf(),
            format: CaptureFormat::Nerfstudio,
            may_hold_out: test.is_none(),
            source: Source::Transforms { train, test },
            why: format!("read as nerfstudio capture: the folder holds {SINGLE}{why}"),
        });
    }
    if is(CaptureFormat::Colmap)
        && let Some(model) = model()
    {
        let folder = model.folder().strip_prefix(root).unwrap_or(model.folder()).display().to_string();
        let place = if folder.is_empty() { "the folder itself".to_string() } else { folder };
        let name = model.cameras.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        return Ok(Found {
            root: root.to_path_buf(),
            format: CaptureFormat::Colmap,
            source: Source::Colmap(model),
            why: format!("read as COLMAP model: {place} holds {name}{}", because(&[])),
            may_hold_out: true,
        });
    }
    let reason = match wanted {
        None => format!(
            "no {TRAIN} and no {SINGLE} in this folder, and no COLMAP model (cameras.bin and images.bin, or .txt) in it, \
             in sparse, sparse/0 or colmap/sparse/0; is this the capture's folder?"
        ),
        Some(CaptureFormat::Blender) => format!("the format blender was asked for, but the folder holds no {TRAIN}"),
        Some(CaptureFormat::Nerfstudio) => {
            format!("the format nerfstudio was asked for, but the folder holds no {SINGLE}")
        }
        Some(CaptureFormat::Colmap) => {
            "the format colmap was asked for, but neither the folder nor its sparse, sparse/0 \
                                        and colmap/sparse/0 hold cameras and images, both .bin or both .txt"
                .to_string()
        }
    };
    Err(DatasetError::io(root, "open the capture", std::io::Error::other(reason)))
}
