//! Lists of images: `exclude_list.txt`, what is left out, and `held_out_list.txt`, what is held out for evaluation.
use crate::{DatasetError, folder};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// The names in such a list, and which of them were met.
#[derive(Default)]
pub(crate) struct Exclusions {
    /// The file.
    file: &'static str,
    names: BTreeSet<String>,
    used: std::cell::RefCell<BTreeSet<String>>,
}

/// The largest exclude list that is read, bytes.
const MAX_EXCLUDE_BYTES: u64 = 64 << 20;

/// A path with `/` between its parts and without a leading `./` and a trailing extension of an image.
fn plain_name(path: &str) -> String {
    let unified = path.trim().replace('\\', "/");
    let bare = unified.trim_start_matches("./");
    strip_extension(bare).to_string()
}

/// Extensions of the images that can be read.
pub(crate) const EXTENSIONS: [&str; 4] = [".png", ".jpg", ".jpeg", ".exr"];

/// A name without a trailing extension of an image, in whatever case.
pub(crate) fn strip_extension(name: &str) -> &str {
    for extension in EXTENSIONS {
        let cut = name.len().saturating_sub(extension.len());
        if name.is_char_boundary(cut) && name[cut..].eq_ignore_ascii_case(extension) {
            return &name[..cut];
        }
    }
    name
}

impl Exclusions {
    /// Reads the list called `file` in a folder, if there is one, and adds it to the documents.
    pub(crate) fn read(root: &Path, file: &'static str, documents: &mut Vec<PathBuf>) -> Result<Self, DatasetError> {
        let path = root.join(file);
        let mut names = BTreeSet::new();
        if path.is_file() {
            let text = folder::read_text(&path, MAX_EXCLUDE_BYTES, "read the list of images")?;
            names.extend(text.lines().map(|l| plain_name(l.split('#').next().unwrap_or(""))).filter(|n| !n.is_empty()));
            documents.push(path);
        }
        Ok(Self { file, names, used: Default::default() })
    }

    /// Whether there is no such list, or an empty one.
    pub(crate) fn is_empty(&self) -> bool {
        self.names.is_empty()
    }

    /// Whether the list names an image as a frame writes it.
    pub(crate) fn contains(&self, written: &str) -> bool {
        let full = plain_name(written);
        let stem = full.rsplit('/').next().unwrap_or_default().to_string();
        let hit = [full, stem].into_iter().find(|name| self.names.contains(name));
        let found = hit.is_some();
        self.used.borrow_mut().extend(hit);
        found
    }

    /// Notes names that were never met.
    pub(crate) fn note_unused(&self, notes: &mut Vec<String>) {
        let used = self.used.borrow();
        for name in self.names.iter().filter(|name| !used.contains(*name)) {
            notes.push(format!("{}: \"{name}\" names no image of this capture", self.file));
        }
    }
}
