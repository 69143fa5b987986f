//! All tests in one go: `cargo test` over the workspace, output passed through, then the house rules.

use crate::tidy;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

/// Runs the tests; `full` adds those marked `#[ignore]` for their length. Returns whether everything passed.
///
/// # Errors
/// When cargo cannot be started or the tree cannot be read.
pub fn run(root: &Path, full: bool) -> Result<bool, String> {
    let start = Instant::now();
    let mut passed = timed("cargo test --workspace", || cargo(root, &["test", "--workspace"]))?;
    if full {
        // Not --include-ignored on the first run: it would compile documentation examples that are marked `ignore`.
        let arguments = ["test", "--workspace", "--lib", "--bins", "--tests", "--", "--ignored"];
        passed &= timed("long tests", || cargo(root, &arguments))?;
    }
    passed &= timed("tidy", || {
        let findings = tidy::run(root)?;
        findings.iter().for_each(|finding| println!("{finding}"));
        Ok(findings.iter().all(|finding| finding.warning))
    })?;
    let verdict = if passed { "all passed" } else { "FAILED" };
    println!("xtask test: {verdict} in {:.0} s", start.elapsed().as_secs_f64());
    Ok(passed)
}

fn timed(what: &str, action: impl FnOnce() -> Result<bool, String>) -> Result<bool, String> {
    let start = Instant::now();
    println!("xtask test: {what}");
    let passed = action()?;
    let verdict = if passed { "passed" } else { "FAILED" };
    println!("xtask test: {what} {verdict} after {:.0} s", start.elapsed().as_secs_f64());
    Ok(passed)
}

/// Runs cargo in `root` with its output passed through; whether it succeeded.
///
/// # Errors
/// When it cannot be started.
pub fn cargo(root: &Path, arguments: &[&str]) -> Result<bool, String> {
    let program = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let status = Command::new(program).args(arguments).current_dir(root).status();
    status.map(|status| status.success()).map_err(|e| format!("cargo {}: {e}", arguments.join(" ")))
}
