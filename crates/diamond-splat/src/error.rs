//! What can go wrong in this crate: one enum that says what was expected, what was found, and what to do.
use std::path::PathBuf;

/// Errors of `diamond-splat`.
#[derive(Debug, Clone, PartialEq)]
pub enum SplatError {
    /// Two things that belong together differ in length or shape.
    Shape {
        /// What was being checked.
        what: &'static str,
        /// The shape that was expected.
        expected: String,
        /// The shape that was found.
        found: String,
    },
    /// A value is NaN or infinite.
    NonFinite {
        /// Which array or parameter.
        what: &'static str,
        /// Index of the Gaussian (or of the value, for images and settings).
        index: usize,
    },
    /// A finite value lies outside its range.
    Range {
        /// Which array or parameter.
        what: &'static str,
        /// Index of the Gaussian (0 for settings).
        index: usize,
        /// The range, as text.
        expected: &'static str,
        /// The value.
        found: f32,
    },
    /// A file cannot be read, written or understood.
    File {
        /// The file.
        path: PathBuf,
        /// Line number (from 1) where there is one.
        line: Option<usize>,
        /// What was expected, what was found, and what to do.
        problem: String,
    },
}

impl std::fmt::Display for SplatError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            SplatError::Shape { what, expected, found } => {
                write!(f, "{what}: expected {expected}, found {found}; every array must describe the same Gaussians")
            }
            SplatError::NonFinite { what, index } => write!(
                f,
                "{what}[{index}]: expected a finite number, found NaN or infinity; look for a diverged optimiser step or a damaged file"
            ),
            SplatError::Range { what, index, expected, found } => {
                write!(f, "{what}[{index}]: expected a value in {expected}, found {found}; apply the activation first")
            }
            SplatError::File { path, line: Some(line), problem } => {
                write!(f, "{}:{line}: {problem}", path.display())
            }
            SplatError::File { path, line: None, problem } => write!(f, "{}: {problem}", path.display()),
        }
    }
}

impl std::error::Error for SplatError {}
