//! The tree that is judged: every text file below the root, sources taken apart, and the table of packages.

use super::floors::Package;
use super::source::Source;
use std::fs;
use std::path::{Path, PathBuf};

/// Folders that hold no sources of ours.
const SKIPPED: &[&str] = &[".git", "target", "out"];

/// Endings of the files that are read; anything else is pictures and numbers.
const TEXT: &[&str] = &["rs", "toml", "md", "sh", "json", "yml", "yaml", "html", "css", "js", "csv", "txt"];

/// All text files of a tree.
pub struct Tree {
    /// Root folder.
    pub root: PathBuf,
    /// Floors and allowed outside crates.
    pub packages: &'static [Package],
    /// Text files, sorted by path.
    pub sources: Vec<Source>,
}

impl Tree {
    /// Reads the tree at `root`.
    ///
    /// # Errors
    /// Names the file or folder that could not be read.
    pub fn read(root: &Path, packages: &'static [Package]) -> Result<Tree, String> {
        let mut sources = Vec::new();
        for path in files_below(root)? {
            let name = path.rsplit('/').next().unwrap_or(&path);
            let ending = name.rsplit_once('.').map_or("", |(_, ending)| ending);
            if !TEXT.contains(&ending) && !path.starts_with(".ci/") {
                continue;
            }
            let bytes = fs::read(root.join(&path)).map_err(|e| format!("{path}: {e}"))?;
            let text = String::from_utf8(bytes).map_err(|_| format!("{path}: not UTF-8"))?;
            sources.push(Source::new(path, text));
        }
        let mut tree = Tree { root: root.to_path_buf(), packages, sources };
        tree.mark_test_files();
        Ok(tree)
    }

    /// Rust files.
    pub fn rust(&self) -> impl Iterator<Item = &Source> {
        self.sources.iter().filter(|source| source.is_rust())
    }

    /// The file at `path`, if it is there.
    pub fn source(&self, path: &str) -> Option<&Source> {
        self.sources.iter().find(|source| source.path == path)
    }

    /// The floor of the package that a path lies in; `None` outside packages.
    pub fn floor_of(&self, path: &str) -> Option<u8> {
        let folder = path.strip_prefix("crates/").unwrap_or(path).split('/').next()?;
        self.packages.iter().find(|package| package.folder() == folder).map(|package| package.floor)
    }

    /// A file declared by `#[cfg(test)] mod name;` is test code as a whole.
    fn mark_test_files(&mut self) {
        let mut whole = Vec::new();
        for source in self.rust() {
            let (folder, file) = source.path.rsplit_once('/').unwrap_or(("", &source.path));
            let stem = file.trim_end_matches(".rs");
            let inside = matches!(stem, "lib" | "main" | "mod");
            let folder = if inside { folder.to_string() } else { format!("{folder}/{stem}") };
            for (line, test) in source.code.lines().zip(&source.test_lines) {
                let declared = line.trim().trim_start_matches("pub ").strip_prefix("mod ");
                if let (true, Some(name)) = (*test, declared.and_then(|rest| rest.strip_suffix(';'))) {
                    whole.push(format!("{folder}/{name}.rs"));
                    whole.push(format!("{folder}/{name}/"));
                }
            }
        }
        for source in &mut self.sources {
            if whole.iter().any(|w| *w == source.path || (w.ends_with('/') && source.path.starts_with(w.as_str()))) {
                source.test_lines.fill(true);
            }
        }
    }
}

/// Paths of all files below `root`, relative, with forward slashes, sorted; build output and `.git` left out.
///
/// # Errors
/// Names the folder that could not be read.
pub fn files_below(root: &Path) -> Result<Vec<String>, String> {
    let mut found = Vec::new();
    let mut waiting = vec![String::new()];
    while let Some(folder) = waiting.pop() {
        let entries = fs::read_dir(root.join(&folder)).map_err(|e| format!("{}: {e}", root.join(&folder).display()))?;
        for entry in entries {
            let entry = entry.map_err(|e| format!("{}: {e}", root.join(&folder).display()))?;
            let name = entry.file_name().to_string_lossy().into_owned();
            let path = if folder.is_empty() { name.clone() } else { format!("{folder}/{name}") };
            let kind = entry.file_type().map_err(|e| format!("{path}: {e}"))?;
            if kind.is_dir() {
                // `out` and `target` are ours to skip at the top and in a package, never inside assets.
                if !SKIPPED.contains(&name.as_str()) || path.starts_with("assets/") {
                    waiting.push(path);
                }
            } else {
                found.push(path);
            }
        }
    }
    found.sort();
    Ok(found)
}
