//! Comparing our crates with tables and pictures that somebody else computed.
//!
//! An oracle is a file or a folder of reference values. A check evaluates our own code on the same inputs and keeps,
//! for each column of the reference, the worst error it met and where. A column is never averaged away: one bad row
//! fails it. A column that was never compared fails too, and so does one whose worst error is not a number.

pub mod analytic;
pub mod ggx;
pub mod metrics;
pub mod mitsuba;
pub mod picture;
pub mod splat;

use std::fmt;
use std::path::{Path, PathBuf};

/// Which family of reference values a path holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum OracleKind {
    /// A CSV table of microfacet terms (distribution, masking, Fresnel, products).
    Ggx,
    /// Splat scenes (`NAME.bin`) with their pictures and gradients (`NAME.npz`).
    Splat,
    /// Picture pairs (`NAME.ref.npy`, `NAME.test.npy`) with `metrics.csv` and `flip_hdr.csv`.
    Metrics,
    /// A CSV table of analytic values of light transport.
    Analytic,
    /// Pictures of another path tracer (`refs.json`, `NAME.npy`, `NAME.se.npy`).
    Mitsuba,
}

/// The worst disagreement of one reference column.
#[derive(Debug, Clone, PartialEq)]
pub struct Column {
    /// Column of the reference, with the scene in front where there are several (`big_300/image`).
    pub name: String,
    /// Worst error met, in the measure that the tolerance uses (absolute, relative, or relative L2). NaN fails.
    pub worst: f64,
    /// The largest error that passes; equality passes.
    pub tolerance: f64,
    /// Where the worst error is: row, pixel, or scene.
    pub at: String,
    /// How many values were compared; zero fails.
    pub count: usize,
}

impl Column {
    /// A column with nothing compared yet.
    pub fn new(name: impl Into<String>, tolerance: f64) -> Self {
        Column { name: name.into(), worst: 0.0, tolerance, at: String::new(), count: 0 }
    }

    /// Takes one error into account; `at` is only called when it is the worst so far. A NaN sticks.
    pub fn observe(&mut self, error: f64, at: impl FnOnce() -> String) {
        let first = self.count == 0;
        self.count += 1;
        if self.worst.is_nan() {
            return;
        }
        if first || error.is_nan() || error > self.worst {
            self.worst = error;
            self.at = at();
        }
    }

    /// Whether something was compared and the worst error is a number within the tolerance.
    pub fn passed(&self) -> bool {
        self.count > 0 && self.worst <= self.tolerance
    }
}

/// All columns of one comparison.
#[derive(Debug, Clone, PartialEq)]
pub struct OracleReport {
    /// What was compared, for the heading.
    pub title: String,
    /// One entry for each column of the reference.
    pub columns: Vec<Column>,
}

impl OracleReport {
    /// Whether there is at least one column and every column passed.
    pub fn passed(&self) -> bool {
        !self.columns.is_empty() && self.columns.iter().all(Column::passed)
    }

    /// The columns that failed.
    pub fn failures(&self) -> impl Iterator<Item = &Column> {
        self.columns.iter().filter(|column| !column.passed())
    }
}

impl fmt::Display for OracleReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let width = self.columns.iter().map(|column| column.name.chars().count()).max().unwrap_or(0).max(6);
        writeln!(f, "{}", self.title)?;
        writeln!(
            f,
            "  {:<width$}  {:>11}  {:>9}  {:>9}  {:<4}  at",
            "column", "worst error", "tolerance", "compared", ""
        )?;
        for column in &self.columns {
            let verdict = if column.passed() { "ok" } else { "FAIL" };
            writeln!(
                f,
                "  {:<width$}  {:>11.3e}  {:>9.1e}  {:>9}  {:<4}  {}",
                column.name, column.worst, column.tolerance, column.count, verdict, column.at
            )?;
        }
        let failed = self.failures().count();
        match (self.columns.len(), failed) {
            (0, _) => write!(f, "  nothing was compared: FAIL"),
            (all, 0) => write!(f, "  all {all} columns within tolerance"),
            (all, _) => write!(f, "  {failed} of {all} columns out of tolerance: FAIL"),
        }
    }
}

/// The file of this kind in a folder, if there is one and only one: tables that were renamed.
fn only_file(folder: &Path, extension: &str) -> Option<PathBuf> {
    let all = std::fs::read_dir(folder).ok()?.filter_map(|entry| Some(entry.ok()?.path()));
    let mut those = all.filter(|path| path.extension().is_some_and(|e| e == extension));
    let first = those.next()?;
    those.next().is_none().then_some(first)
}

/// Compares our implementation with the reference at `path`, a file or a folder.
///
/// # Errors
/// A message that names the file and what was expected of it, when the reference cannot be read. A disagreement is not
/// an error: it is in the report.
pub fn run(kind: OracleKind, path: impl AsRef<Path>) -> Result<OracleReport, String> {
    let path = path.as_ref();
    if !path.exists() {
        return Err(format!("{}: no such file or folder; give the reference's path", path.display()));
    }
    match kind {
        OracleKind::Ggx => ggx::check(path),
        OracleKind::Splat => splat::check(path),
        OracleKind::Metrics => metrics::check(path),
        OracleKind::Analytic => analytic::check(path),
        OracleKind::Mitsuba => mitsuba::check(path),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn column(worst: f64, count: usize) -> Column {
        Column { name: "D".into(), worst, tolerance: 1e-5, at: "row 3".into(), count }
    }

    #[test]
    fn equality_passes_and_anything_above_nan_or_uncompared_fails() {
        assert!(column(1e-5, 1).passed());
        assert!(!column(1.1e-5, 1).passed());
        assert!(!column(f64::NAN, 1).passed());
        assert!(!column(f64::INFINITY, 1).passed());
        assert!(!column(0.0, 0).passed());
        assert!(!OracleReport { title: "empty".into(), columns: vec![] }.passed());
    }

    #[test]
    fn the_worst_error_keeps_its_place_and_nan_sticks() {
        let mut seen = Column::new("G", 1.0);
        for (row, error) in [0.1, 0.5, 0.2].into_iter().enumerate() {
            seen.observe(error, || format!("row {row}"));
        }
        assert_eq!((seen.worst, seen.at.as_str(), seen.count), (0.5, "row 1", 3));
        seen.observe(f64::NAN, || "row 3".into());
        seen.observe(0.0, || "row 4".into());
        assert!(seen.worst.is_nan() && !seen.passed());
        assert_eq!((seen.at.as_str(), seen.count), ("row 3", 5));
    }

    #[test]
    fn the_table_says_which_column_failed_and_where() {
        let report = OracleReport { title: "t".into(), columns: vec![column(1e-6, 4), column(1e-2, 4)] };
        let text = report.to_string();
        assert_eq!(text.matches("FAIL").count(), 2, "{text}");
        assert!(text.contains("1 of 2") && text.contains("row 3") && !report.passed());
    }

    #[test]
    fn a_missing_path_is_an_error_and_not_a_pass() {
        assert!(run(OracleKind::Ggx, "no/such/path.csv").unwrap_err().contains("no/such/path.csv"));
    }
}
