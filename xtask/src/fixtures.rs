//! The manifest of hashes: reference numbers and captures are what they were when they were judged good.
//!
//! `assets/MANIFEST.sha256` has one line per file under `assets/fixtures` and `assets/captures`, in the form of
//! `sha256sum`, so that `sha256sum --check assets/MANIFEST.sha256` from the root says the same without this program.

use crate::tidy::files_below;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fmt::{self, Write as _};
use std::fs;
use std::path::Path;

/// Where the manifest lies, from the root.
pub const MANIFEST: &str = "assets/MANIFEST.sha256";

/// Folders that it covers, from the root.
const COVERED: &[&str] = &["assets/fixtures", "assets/captures"];

/// How a file differs from the manifest.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Difference {
    /// Listed and not there.
    Missing(String),
    /// There with other bytes.
    Changed(String),
    /// There and not listed.
    Unlisted(String),
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Difference::Missing(path) => write!(f, "{path}: expected and not there"),
            Difference::Changed(path) => write!(f, "{path}: its bytes are not those that are expected"),
            Difference::Unlisted(path) => {
                write!(f, "{path}: not expected; if it belongs there, run `cargo xtask fixtures --update`")
            }
        }
    }
}

/// Hashes of all covered files, by path from `root` with forward slashes.
fn hashes(root: &Path) -> Result<BTreeMap<String, String>, String> {
    let mut found = BTreeMap::new();
    for folder in COVERED.iter().filter(|folder| root.join(folder).is_dir()) {
        for path in files_below(&root.join(folder))? {
            let path = format!("{folder}/{path}");
            let bytes = fs::read(root.join(&path)).map_err(|e| format!("{path}: {e}"))?;
            let mut hex = String::with_capacity(64);
            for byte in Sha256::digest(&bytes).iter() {
                // Writing to a String cannot fail.
                let _ = write!(hex, "{byte:02x}");
            }
            found.insert(path, hex);
        }
    }
    Ok(found)
}

/// Compares the files with the manifest; returns how many were compared and what differs, sorted by path.
///
/// # Errors
/// When a file or the manifest cannot be read, or a line of the manifest has another form.
pub fn check(root: &Path) -> Result<(usize, Vec<Difference>), String> {
    let text = fs::read_to_string(root.join(MANIFEST)).map_err(|e| format!("{MANIFEST}: {e}"))?;
    let mut listed = BTreeMap::new();
    for (i, line) in text.lines().enumerate() {
        let entry = line.split_once("  ").filter(|(hex, path)| hex.len() == 64 && !path.is_empty());
        let Some((hex, path)) = entry else {
            return Err(format!("{MANIFEST}:{}: expected 64 hex digits, two spaces, a path; found {line:?}", i + 1));
        };
        listed.insert(path.to_string(), hex.to_string());
    }
    let there = hashes(root)?;
    let mut differences = Vec::new();
    for path in there.keys().chain(listed.keys()).collect::<std::collections::BTreeSet<_>>() {
        match (there.get(path), listed.get(path)) {
            (Some(_), None) => differences.push(Difference::Unlisted(path.clone())),
            (None, _) => differences.push(Difference::Missing(path.clone())),
            (Some(now), Some(then)) if now != then => differences.push(Difference::Changed(path.clone())),
            _ => {}
        }
    }
    Ok((there.len(), differences))
}

/// Rewrites the manifest from what is there; returns the number of files.
///
/// # Errors
/// When a file cannot be read or the manifest cannot be written.
pub fn update(root: &Path) -> Result<usize, String> {
    let there = hashes(root)?;
    let text: String = there.iter().map(|(path, hex)| format!("{hex}  {path}\n")).collect();
    fs::write(root.join(MANIFEST), text).map_err(|e| format!("{MANIFEST}: {e}"))?;
    Ok(there.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_way_to_differ_is_noticed() {
        let root = std::env::temp_dir().join(format!("diamond-fixtures-{}", std::process::id()));
        let _ = fs::remove_dir_all(&root);
        let write = |path: &str, text: &str| {
            let path = root.join(path);
            fs::create_dir_all(path.parent().expect("a parent")).expect("a folder");
            fs::write(path, text).expect("a file");
        };
        write("assets/fixtures/a/1.csv", "one");
        write("assets/fixtures/a/2.csv", "two");
        write("assets/captures/b/3.png", "three");
        assert!(check(&root).is_err(), "no manifest is an error");
        assert_eq!(update(&root), Ok(3));
        assert_eq!(check(&root), Ok((3, vec![])));
        // The hash of "one" by another program.
        let manifest = fs::read_to_string(root.join(MANIFEST)).expect("the manifest");
        assert!(
            manifest
                .contains("7692c3ad3540bb803c020b3aee66cd8887123234ea0c6e7143c0add73ff431ed  assets/fixtures/a/1.csv")
        );

        write("assets/fixtures/a/1.csv", "eno");
        write("assets/fixtures/a/4.csv", "four");
        fs::remove_file(root.join("assets/captures/b/3.png")).expect("removed");
        let expected = vec![
            Difference::Missing("assets/captures/b/3.png".into()),
            Difference::Changed("assets/fixtures/a/1.csv".into()),
            Difference::Unlisted("assets/fixtures/a/4.csv".into()),
        ];
        assert_eq!(check(&root), Ok((3, expected)));
        write(MANIFEST, "nonsense\n");
        assert!(check(&root).expect_err("malformed").contains(":1:"));
        let _ = fs::remove_dir_all(&root);
    }
}
