//! Each formula has a tag, and the tag joins three places: the function, the test, and the row in docs/equations.md.
//!
//! A row reads `| tag | formula | function | test | reading |`. The rule follows the tag from the code to the row and to a
//! test, and from the row back to the code: the function and the test that it names must exist.

use super::Violations;
use super::source::Source;
use super::tree::Tree;
use std::collections::{BTreeMap, BTreeSet};

/// How a tag begins, in two halves so that this file holds no tag.
const OPENING: &str = concat!("[", "eq:");

/// Whether a document holds rows of the table.
fn is_table(source: &Source) -> bool {
    source.path == "docs/equations.md" || (source.path.starts_with("docs/equations.d/") && source.path.ends_with(".md"))
}

/// Tags in a line; `Err` is one that is not lower-case words joined by hyphens.
fn tags(line: &str) -> Vec<Result<&str, &str>> {
    let mut found = Vec::new();
    for (start, _) in line.match_indices(OPENING) {
        let rest = &line[start + OPENING.len()..];
        let name = rest.split(']').next().unwrap_or_default();
        let well_formed = rest.len() > name.len()
            && !name.is_empty()
            && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-');
        // Prose about tags writes an ellipsis.
        if name != "..." && name != "…" {
            found.push(if well_formed { Ok(name) } else { Err(name) });
        }
    }
    found
}

/// Whether `code` defines an item of this name.
fn defines(code: &str, name: &str, keywords: &[&str]) -> bool {
    code.match_indices(name).any(|(start, _)| {
        let after = code[start + name.len()..].chars().next();
        let ends = !after.is_some_and(|c| c.is_alphanumeric() || c == '_');
        ends && keywords
            .iter()
            .any(|keyword| code[..start].strip_suffix(' ').is_some_and(|head| head.ends_with(keyword)))
    })
}

/// What a cell names in backticks.
fn names(cell: &str) -> impl Iterator<Item = &str> {
    cell.split('`').skip(1).step_by(2)
}

/// The last segment of a path such as `diamond_shading::ggx::distribution()`.
fn last_segment(path: &str) -> &str {
    let end = path.find(['(', '<', ' ', '{']).unwrap_or(path.len());
    path[..end].rsplit("::").next().unwrap_or(path)
}

/// Tags go from code to row and test, and rows go back to code.
pub fn equations(tree: &Tree) -> Violations {
    let mut found = Vec::new();
    let mut used: BTreeMap<&str, (&str, usize)> = BTreeMap::new();
    let mut proven: BTreeSet<&str> = BTreeSet::new();
    for source in tree.rust() {
        for line in source.test_text() {
            proven.extend(tags(line).into_iter().flatten());
        }
        if !(source.path.starts_with("crates/") && source.path.contains("/src/")) {
            continue;
        }
        for (i, line) in source.comments.lines().enumerate().filter(|(i, _)| !source.test_lines[*i]) {
            for tag in tags(line) {
                match tag {
                    Ok(tag) => drop(used.entry(tag).or_insert((&source.path, i + 1))),
                    Err(tag) => {
                        let message = format!("`{tag}` is no equation tag: lower-case words joined by hyphens");
                        found.push((source.path.clone(), i + 1, message));
                    }
                }
            }
        }
    }
    let mut rows: BTreeMap<&str, (&str, usize)> = BTreeMap::new();
    for source in tree.sources.iter().filter(|source| is_table(source)) {
        for (i, line) in source.text.lines().enumerate().filter(|(_, line)| line.starts_with('|')) {
            let here = (source.path.as_str(), i + 1);
            let cells: Vec<&str> = line.trim().trim_matches('|').split(" | ").map(str::trim).collect();
            for tag in tags(cells.first().copied().unwrap_or_default()).into_iter().flatten() {
                if let Some(earlier) = rows.insert(tag, here) {
                    let message = format!("`{tag}` has a row already, {}:{}", earlier.0, earlier.1);
                    found.push((source.path.clone(), i + 1, message));
                }
                if !used.contains_key(tag) {
                    found.push((source.path.clone(), i + 1, format!("no function in crates/*/src carries `{tag}`")));
                }
                if cells.len() != 5 {
                    let message =
                        format!("`{tag}`: {} cells, expected tag, formula, function, test, reading", cells.len());
                    found.push((source.path.clone(), i + 1, message));
                    continue;
                }
                for message in missing(tree, cells[2], cells[3]) {
                    found.push((source.path.clone(), i + 1, format!("`{tag}`: {message}")));
                }
            }
        }
    }
    for (tag, (path, line)) in used {
        if !rows.contains_key(tag) {
            found.push((path.into(), line, format!("`{tag}` has no row in docs/equations.md")));
        }
        if !proven.contains(tag) {
            found.push((
                path.into(),
                line,
                format!("no test carries `{tag}`: name it in a comment of the test that proves it"),
            ));
        }
    }
    Ok(found)
}

/// What a row names and nobody defines.
fn missing(tree: &Tree, function_cell: &str, test_cell: &str) -> Vec<String> {
    let mut messages = Vec::new();
    let in_crates = |source: &&Source| source.path.starts_with("crates/");
    let mut functions = names(function_cell).filter(|name| name.contains("::")).peekable();
    if functions.peek().is_none() {
        messages.push("the third cell names no function as `crate::function`".into());
    }
    for path in functions {
        let keywords = ["fn", "struct", "enum", "const", "static", "trait", "type", "mod"];
        if !tree.rust().filter(in_crates).any(|source| defines(&source.code, last_segment(path), &keywords)) {
            messages.push(format!("`{path}` is not defined in crates/"));
        }
    }
    let mut tests = names(test_cell).peekable();
    if tests.peek().is_none() {
        messages.push("the fourth cell names no test in backticks".into());
    }
    for path in tests {
        let name = last_segment(path);
        let file = path.ends_with(".rs") && tree.rust().any(|source| source.path.ends_with(path));
        let function = || {
            let is_test = |source: &&Source| source.test_lines.iter().any(|test| *test);
            tree.rust().filter(is_test).any(|source| defines(&source.code, name, &["fn", "mod"]))
        };
        if !file && !function() {
            messages.push(format!("no test is called `{path}`"));
        }
    }
    messages
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tags_are_read_and_bad_ones_noticed() {
        let line = format!("a `{OPENING}ggx-d]` b {OPENING}Bad_One] {OPENING}...] {OPENING}open");
        assert_eq!(tags(&line), vec![Ok("ggx-d"), Err("Bad_One"), Err("open")]);
    }

    #[test]
    fn an_item_is_defined_only_by_its_whole_name() {
        let code = "pub fn distribution_pull() {}\npub const fn sum(x: f32) {}";
        assert!(!defines(code, "distribution", &["fn"]));
        assert!(defines(code, "distribution_pull", &["fn"]) && defines(code, "sum", &["fn"]));
        assert_eq!(last_segment("a::b::c()"), "c");
    }
}
