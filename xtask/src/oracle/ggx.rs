//! Not built yet.

use super::OracleReport;
use std::path::Path;

/// Compares with the reference at `path`.
///
/// # Errors
/// Always, until it is built.
pub fn check(path: &Path) -> Result<OracleReport, String> {
    Err(format!("{}: not built yet", path.display()))
}
