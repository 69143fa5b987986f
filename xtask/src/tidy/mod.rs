//! The house rules, each with its reason, checked on every run of the tests.
//!
//! A rule is a row of [`RULES`]: a name, why it exists, and a function from the tree to its violations. `cargo xtask
//! tidy --rules` prints the table. A line rule can be lifted where it is wrong, by a comment that gives the reason; a
//! permission that lifts nothing is itself a violation, so that permissions do not outlive their reason.

mod equations;
mod floors;
mod house;
#[cfg(test)]
mod planted;
mod source;
mod tree;

pub use floors::{PACKAGES, Package};
pub use source::Source;
pub use tree::{Tree, files_below};

use std::fmt;
use std::path::Path;

/// One violation.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Finding {
    /// Path from the root.
    pub path: String,
    /// Line from 1; 0 for the file as a whole.
    pub line: usize,
    /// Name of the rule.
    pub rule: &'static str,
    /// What is wrong and what to do.
    pub message: String,
    /// Only a hint: printed, and does not fail.
    pub warning: bool,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.path)?;
        if self.line > 0 {
            write!(f, ":{}", self.line)?;
        }
        let weight = if self.warning { "hint" } else { "error" };
        write!(f, ": {weight} [{}] {}", self.rule, self.message)
    }
}

/// What a rule hands back: (path, line or 0, message).
pub(crate) type Violations = Result<Vec<(String, usize, String)>, String>;

/// One house rule.
pub struct Rule {
    /// Short name, shown with each violation.
    pub name: &'static str,
    /// Why it exists.
    pub reason: &'static str,
    /// Whether a violation only warns.
    pub warning: bool,
    /// Finds the violations.
    check: fn(&Tree) -> Violations,
}

const fn rule(name: &'static str, reason: &'static str, check: fn(&Tree) -> Violations) -> Rule {
    Rule { name, reason, warning: false, check }
}

/// Every rule.
pub const RULES: &[Rule] = &[
    rule(
        "floors",
        "a package uses only packages of lower floors, so that each can be read, tested and imported without what is above it",
        floors::floors,
    ),
    rule(
        "outside",
        "outside crates are listed per package, so that a new one is a decision and not an accident",
        floors::outside,
    ),
    rule(
        "import-alone",
        "who imports only images, cameras, lights, shading, metrics or losses compiles floor 0 and glam and nothing else",
        floors::import_alone,
    ),
    rule(
        "testkit",
        "the judge shares no code with what it judges: testkit uses none of our crates and is only a dev-dependency",
        floors::testkit,
    ),
    rule(
        "workspace-lints",
        "every package inherits the workspace's lints, missing_docs among them, so public items are documented everywhere",
        house::workspace_lints,
    ),
    rule("file-head", "a file says first what concept it holds", house::file_head),
    rule("file-name", "a file is named after its concept; a drawer for leftovers has none", house::file_name),
    rule(
        "no-panic",
        "input data must never bring a program down: library code returns an error that says what to do",
        house::no_panic,
    ),
    rule("no-print", "only the program prints or exits; a library that does cannot be embedded", house::no_print),
    rule(
        "same-bits",
        "the standard library's exponentials and angles have the platform's last bits; libm's are the same everywhere",
        house::same_bits,
    ),
    rule(
        "stands-alone",
        "the repository works from any clone: it names no folder of anybody's machine",
        house::stands_alone,
    ),
    rule(
        "equations",
        "a formula in the code is in docs/equations.md with the reading chosen, and a test proves it; a row there has code",
        equations::equations,
    ),
    rule("fixture-readme", "a reference without its origin proves nothing", house::fixture_readme),
    rule("allow-reason", "a permission says why", house::allow_reason),
    Rule {
        name: "file-length",
        reason: "beyond 600 lines a second concept is usually hiding in the file",
        warning: true,
        check: house::file_length,
    },
];

/// Name of the rule about permissions that lift nothing; it runs after all others.
const STALE: &str = "allow-unused";

/// Checks the tree at `root` against every rule.
///
/// # Errors
/// When the tree cannot be read or cargo cannot be asked; violations are not errors, they are returned.
pub fn run(root: &Path) -> Result<Vec<Finding>, String> {
    run_with(root, PACKAGES)
}

/// As [`run`], with another table of packages: for trees that are broken on purpose.
///
/// # Errors
/// As [`run`].
pub fn run_with(root: &Path, packages: &'static [Package]) -> Result<Vec<Finding>, String> {
    let tree = Tree::read(root, packages)?;
    let mut findings = Vec::new();
    for rule in RULES {
        for (path, line, message) in (rule.check)(&tree)? {
            if let Some(allow) = tree.source(&path).and_then(|source| source.allow_at(line)) {
                allow.used.set(true);
                if !allow.reason.is_empty() {
                    continue;
                }
            }
            findings.push(Finding { path, line, rule: rule.name, message, warning: rule.warning });
        }
    }
    for source in tree.rust() {
        for allow in source.allows.iter().filter(|allow| !allow.used.get()) {
            let message = format!("nothing on line {} needs this permission: remove it", allow.line);
            findings.push(Finding {
                path: source.path.clone(),
                line: allow.written_at,
                rule: STALE,
                message,
                warning: false,
            });
        }
    }
    findings.sort();
    findings.dedup();
    Ok(findings)
}

/// The workspace's root folder, as known when this was compiled.
pub fn workspace_root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new("."))
}
