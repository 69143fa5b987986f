//! A selection written down, so that another run, or another program, learns from the same images and is measured on the
//! same images.
use crate::folder::read_bytes;
use crate::{Capture, DatasetError, Shot, Split, View};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// The images of a selection, by name.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SelectionManifest {
    /// Version of this format: 1.
    pub format: u32,
    /// How the selection was made, in words: a regime and what was held out.
    pub selection: String,
    /// Seed of the selection.
    pub seed: u64,
    /// Hash of the capture that it was made from, see [`Capture::hash`].
    pub capture: String,
    /// Images to learn from, by view.
    pub train: Vec<ManifestView>,
    /// Images held out, by view.
    pub test: Vec<ManifestView>,
}

/// The images of a view.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ManifestView {
    /// Name of the view, for readers.
    pub view: String,
    /// Paths of the images below the capture's folder, with `/` between their parts.
    pub images: Vec<String>,
}

/// The version that is written and read.
const FORMAT: u32 = 1;
/// The largest manifest that is read, bytes.
const MAX_BYTES: u64 = 64 << 20;

impl SelectionManifest {
    /// Reads a manifest.
    ///
    /// Errors: no such file, no JSON, other fields, another version.
    pub fn read(path: &Path) -> Result<Self, DatasetError> {
        let bytes = read_bytes(path, MAX_BYTES, "read the selection")?;
        Self::parse(path, &bytes)
    }

    /// [`SelectionManifest::read`] of bytes; `path` names the file in errors.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self, DatasetError> {
        let manifest: Self = serde_json::from_slice(bytes).map_err(|e| DatasetError::Json {
            path: path.to_path_buf(),
            line: e.line(),
            column: e.column(),
            reason: e.to_string().chars().take(200).collect(),
        })?;
        if manifest.format != FORMAT {
            return Err(DatasetError::Selection {
                what: "selection",
                reason: format!("{}: expected format {FORMAT}, found {}", path.display(), manifest.format),
            });
        }
        Ok(manifest)
    }

    /// The manifest as JSON.
    pub fn to_json(&self) -> Result<String, DatasetError> {
        serde_json::to_string_pretty(self)
            .map(|text| text + "\n")
            .map_err(|e| DatasetError::Write { path: "selection".into(), reason: e.to_string() })
    }
}

fn name_of(root: &Path, shot: &Shot) -> String {
    let relative = shot.path.strip_prefix(root).unwrap_or(&shot.path);
    relative.components().map(|c| c.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("/")
}

impl Capture {
    /// The images of this capture as it is selected and divided. Hashes the capture, if it has not been.
    pub fn manifest(&self, selection: &str, seed: u64) -> Result<SelectionManifest, DatasetError> {
        let part = |views: &[View]| {
            let images = |v: &View| v.shots.iter().map(|s| name_of(&self.root, s)).collect();
            views.iter().map(|v| ManifestView { view: v.name.clone(), images: images(v) }).collect()
        };
        Ok(SelectionManifest {
            format: FORMAT,
            selection: selection.to_owned(),
            seed,
            capture: self.hash()?,
            train: part(&self.train),
            test: part(&self.test),
        })
    }

    /// This capture with the images that a manifest names, to learn from and held out. Call it on the capture as opened.
    ///
    /// Errors: a manifest of another capture, an image that is not here or named twice, and nothing to learn from.
    pub fn with_manifest(&self, manifest: &SelectionManifest) -> Result<Capture, DatasetError> {
        let fail = |reason: String| DatasetError::Selection { what: "selection", reason };
        let hash = self.hash()?;
        if hash != manifest.capture {
            let short = |h: &str| h.chars().take(16).collect::<String>();
            return Err(fail(format!(
                "it was made from a capture with the hash {}…, this one has {}…; use that capture, or select anew",
                short(&manifest.capture),
                short(&hash)
            )));
        }
        // An image may be listed in both splits of a capture; the split that it is wanted for is looked into first.
        let pool = |views: &[View]| -> BTreeMap<String, (View, Shot)> {
            let of_view = |v: &View| {
                let bare = View { shots: Vec::new(), ..v.clone() };
                v.shots.iter().map(|s| (name_of(&self.root, s), (bare.clone(), s.clone()))).collect::<Vec<_>>()
            };
            views.iter().flat_map(of_view).collect()
        };
        let pools = [pool(&self.train), pool(&self.test)];
        let part = |views: &[ManifestView], split: Split| -> Result<Vec<View>, DatasetError> {
            let mut out: Vec<View> = Vec::new();
            let mut seen = std::collections::BTreeSet::new();
            for listed in views {
                let mut view: Option<View> = None;
                for name in &listed.images {
                    let order = if split == Split::Train { [0, 1] } else { [1, 0] };
                    let found = order.iter().find_map(|&k| pools[k].get(name));
                    let (bare, shot) = found.ok_or_else(|| {
                        fail(format!("\"{name:.200}\" (view {:.80}) is not in the capture", listed.view))
                    })?;
                    if !seen.insert(name) {
                        return Err(fail(format!("\"{name:.200}\" is named twice")));
                    }
                    let view = view.get_or_insert_with(|| View { split, ..bare.clone() });
                    if view.camera != bare.camera {
                        return Err(fail(format!("\"{name:.200}\" does not belong to view {:.80}", listed.view)));
                    }
                    view.shots.push(shot.clone());
                }
                out.extend(view);
            }
            Ok(out)
        };
        let train = part(&manifest.train, Split::Train)?;
        let test = part(&manifest.test, Split::Test)?;
        if train.is_empty() {
            return Err(fail("it names no image to learn from".into()));
        }
        Ok(Capture { train, test, ..self.clone() })
    }
}
