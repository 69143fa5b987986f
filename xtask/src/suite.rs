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
    let mut passed = timed("cargo test --workspace", || cargo(root, &["test", "--workspace", "--no-fail-fast"]))?;
    if full {
        // Not --include-ignored on the first run: it would compile documentation examples that are marked `ignore`.
        let arguments = ["test", "--workspace", "--no-fail-fast", "--lib", "--bins", "--tests", "--", "--ignored"];
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

/// Which cases property tests draw, see proptest's configuration.
const PROPERTY_SEED: &str = "PROPTEST_RNG_SEED";
/// Fixed, so that a failure is the change's and not the draw's. Another draw: `PROPTEST_RNG_SEED=$RANDOM cargo xtask test`.
const DEFAULT_SEED: &str = "20261123";

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
    let mut command = Command::new(program);
    command.args(arguments).current_dir(root);
    // Cargo and its tests see what the caller set; else the cases of property tests are the same on every run.
    if std::env::var_os(PROPERTY_SEED).is_none() {
        command.env(PROPERTY_SEED, DEFAULT_SEED);
    }
    let status = command.status();
    status.map(|status| status.success()).map_err(|e| format!("cargo {}: {e}", arguments.join(" ")))
}
