//! Small captures that this repository renders itself: made again from their recipes, they have the same bytes.
//!
//! `assets/captures/captures.toml` lists them: a recipe of `assets/recipes` and what is changed in it. Read-me files are not rendered and
//! are left alone. Bits are those of x86-64; elsewhere a last bit may differ.

use crate::fixtures::Difference;
use crate::tidy::files_below;
use diamond_synth::{Recipe, synthesize};
use serde_json::Value;
use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

/// The list, from the root.
pub const LIST: &str = "assets/captures/captures.toml";

/// Files of a capture's folder that are written by hand.
const BY_HAND: &str = "README.md";

/// A capture of the list.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rendered {
    /// Its folder beside the list.
    pub name: String,
    /// The recipe's file in `assets/recipes`.
    pub recipe: String,
    /// Changes to it.
    pub changes: Vec<String>,
}

/// The captures of the list.
///
/// # Errors
/// The list cannot be read or has another form.
pub fn listed(root: &Path) -> Result<Vec<Rendered>, String> {
    let text = fs::read_to_string(root.join(LIST)).map_err(|e| format!("{LIST}: {e}"))?;
    parse(&text)
}

fn parse(text: &str) -> Result<Vec<Rendered>, String> {
    let table: toml::Table = toml::from_str(text).map_err(|e| format!("{LIST}: {e}"))?;
    let value = serde_json::to_value(table).map_err(|e| format!("{LIST}: {e}"))?;
    let entries =
        value["capture"].as_array().ok_or_else(|| format!("{LIST}: expected [[capture]] entries, found none"))?;
    let of = |entry: &Value| {
        let text = |key: &str| entry[key].as_str().map(str::to_string);
        let changes = entry["changes"].as_array()?.iter().map(|c| c.as_str().map(str::to_string));
        Some(Rendered { name: text("name")?, recipe: text("recipe")?, changes: changes.collect::<Option<_>>()? })
    };
    let missing = |i: usize| format!("{LIST}: capture {i}: expected name, recipe and changes");
    entries.iter().enumerate().map(|(i, entry)| of(entry).ok_or_else(|| missing(i))).collect()
}

/// Those of the list that are named, or all.
///
/// # Errors
/// A name that is not in the list.
pub fn chosen(root: &Path, names: &[String]) -> Result<Vec<Rendered>, String> {
    let all = listed(root)?;
    let known = || all.iter().map(|r| r.name.as_str()).collect::<Vec<_>>().join(", ");
    if let Some(name) = names.iter().find(|name| all.iter().all(|r| r.name != **name)) {
        return Err(format!("{LIST}: expected one of {}, found {name}", known()));
    }
    Ok(all.into_iter().filter(|r| names.is_empty() || names.contains(&r.name)).collect())
}

impl Rendered {
    /// Renders the capture into `folder`, which must not exist.
    ///
    /// # Errors
    /// The recipe or the folder.
    pub fn render(&self, root: &Path, folder: &Path) -> Result<(), String> {
        let recipes = root.join("assets/recipes");
        let path = recipes.join(&self.recipe);
        let text = fs::read_to_string(&path).map_err(|e| format!("{}: {e}", path.display()))?;
        let recipe = Recipe::parse_changed(&text, &self.recipe, &self.changes).map_err(|e| e.to_string())?;
        synthesize(&recipe, &recipes, folder, &|_, _| ()).map(drop).map_err(|e| e.to_string())
    }

    /// How the capture differs from one that is rendered again; the latter in a temporary folder.
    ///
    /// # Errors
    /// The recipe, or files that cannot be read.
    pub fn check(&self, root: &Path) -> Result<(usize, Vec<Difference>), String> {
        self.with_rendered(root, |fresh| compare(&root.join("assets/captures").join(&self.name), fresh))
    }

    /// Replaces the capture by one that is rendered again; returns its number of files.
    ///
    /// # Errors
    /// The recipe, or files that cannot be read or written.
    pub fn update(&self, root: &Path) -> Result<usize, String> {
        let to = root.join("assets/captures").join(&self.name);
        self.with_rendered(root, |fresh| {
            let fail = |path: &Path| {
                let path = path.display().to_string();
                move |e: std::io::Error| format!("{path}: {e}")
            };
            fs::create_dir_all(&to).map_err(fail(&to))?;
            for file in files_below(&to)?.iter().filter(|f| *f != BY_HAND) {
                fs::remove_file(to.join(file)).map_err(fail(&to.join(file)))?;
            }
            let files = files_below(fresh)?;
            for file in &files {
                let target = to.join(file);
                if let Some(parent) = target.parent() {
                    fs::create_dir_all(parent).map_err(fail(parent))?;
                }
                fs::copy(fresh.join(file), &target).map_err(fail(&target))?;
            }
            Ok(files.len())
        })
    }

    fn with_rendered<T>(&self, root: &Path, then: impl FnOnce(&Path) -> Result<T, String>) -> Result<T, String> {
        let parent = std::env::temp_dir().join(format!("diamond-captures-{}-{}", self.name, std::process::id()));
        let _ = fs::remove_dir_all(&parent);
        let fresh = parent.join(&self.name);
        let result = self.render(root, &fresh).and_then(|()| then(&fresh));
        let _ = fs::remove_dir_all(&parent);
        result
    }
}

/// How the files of `there` differ from those of `fresh`; how many there are.
fn compare(there: &Path, fresh: &Path) -> Result<(usize, Vec<Difference>), String> {
    let files = |folder: &Path| -> Result<BTreeSet<String>, String> {
        Ok(files_below(folder)?.into_iter().filter(|f| f != BY_HAND).collect())
    };
    if !there.is_dir() {
        return Err(format!("{}: is not there; --update makes it", there.display()));
    }
    let (old, new) = (files(there)?, files(fresh)?);
    let mut differences = Vec::new();
    for file in old.union(&new) {
        let path = there.join(file);
        let shown = path.display().to_string();
        if !new.contains(file) {
            differences.push(Difference::Unlisted(shown));
        } else if !old.contains(file) {
            differences.push(Difference::Missing(shown));
        } else if fs::read(&path).ok() != fs::read(fresh.join(file)).ok() {
            differences.push(Difference::Changed(shown));
        }
    }
    Ok((new.len(), differences))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tidy::workspace_root;

    #[test]
    fn the_list_is_read_and_mistakes_are_named() {
        let root = workspace_root();
        assert!(listed(root).expect("the list").len() >= 3);
        assert!(chosen(root, &["nothing".into()]).expect_err("no such capture").contains("candle-small"));
        assert!(parse("[[capture]]\nname = \"x\"\n").expect_err("incomplete").contains("capture 0"));
    }

    /// A capture in which one file was changed, one is missing and one was added.
    #[test]
    fn each_way_to_differ_is_noticed() {
        let parent = std::env::temp_dir().join(format!("diamond-captures-compare-{}", std::process::id()));
        let (there, fresh) = (parent.join("a"), parent.join("b"));
        for (folder, files) in [(&there, ["1", "2", "README.md"]), (&fresh, ["1", "3", "4"])] {
            fs::create_dir_all(folder).expect("a folder");
            for file in files {
                fs::write(folder.join(file), file).expect("a file");
            }
        }
        fs::write(there.join("4"), "other").expect("a file");
        let (count, found) = compare(&there, &fresh).expect("compared");
        let at = |file: &str| there.join(file).display().to_string();
        let expected = [Difference::Unlisted(at("2")), Difference::Missing(at("3")), Difference::Changed(at("4"))];
        assert_eq!((count, found.as_slice()), (3, expected.as_slice()));
        let _ = fs::remove_dir_all(&parent);
    }
}
