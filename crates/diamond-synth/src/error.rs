//! What can go wrong between a recipe and a capture.
use diamond_dataset::DatasetError;
use diamond_pathtrace::PathtraceError;
use std::fmt;
use std::path::PathBuf;

/// Why a capture could not be made.
#[derive(Debug)]
pub enum SynthError {
    /// A recipe that is no TOML, has unknown or missing fields, or a value out of range.
    Recipe {
        /// The file, or another name of the recipe.
        origin: String,
        /// What was expected and what was found.
        detail: String,
    },
    /// A file that a recipe names cannot be read.
    File {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// The renderer refused the scene.
    Pathtrace(PathtraceError),
    /// The capture could not be written.
    Dataset(DatasetError),
}

impl fmt::Display for SynthError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            SynthError::Recipe { origin, detail } => write!(f, "{origin}: {detail}"),
            SynthError::File { path, source } => write!(f, "{}: cannot be read: {source}", path.display()),
            SynthError::Pathtrace(e) => e.fmt(f),
            SynthError::Dataset(e) => e.fmt(f),
        }
    }
}

impl std::error::Error for SynthError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            SynthError::Recipe { .. } => None,
            SynthError::File { source, .. } => Some(source),
            SynthError::Pathtrace(e) => Some(e),
            SynthError::Dataset(e) => Some(e),
        }
    }
}

impl From<PathtraceError> for SynthError {
    fn from(e: PathtraceError) -> Self {
        SynthError::Pathtrace(e)
    }
}

impl From<DatasetError> for SynthError {
    fn from(e: DatasetError) -> Self {
        SynthError::Dataset(e)
    }
}
