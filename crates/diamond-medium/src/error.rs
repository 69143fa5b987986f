//! What can be wrong with a surface, photographs, or a medium.
use diamond_pathtrace::PathtraceError;
use diamond_shading::ShadingError;
use std::fmt;
use std::path::PathBuf;

/// Why there is no surface, no fit, or no transport.
#[derive(Debug)]
pub enum MediumError {
    /// The surface or what is traced through it was refused.
    Surface(PathtraceError),
    /// Transport was refused its input.
    Transport(ShadingError),
    /// What was given does not determine what is asked for.
    Unusable {
        /// What is missing, and what to do.
        detail: String,
    },
    /// A number is outside the range that has a meaning.
    Value {
        /// Which one.
        what: &'static str,
        /// What it should be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
    /// A file of a medium is not what it should be, or cannot be read or written.
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        detail: String,
    },
}

impl fmt::Display for MediumError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Surface(e) => write!(f, "surface: {e}"),
            Self::Transport(e) => write!(f, "transport: {e}"),
            Self::Unusable { detail } => write!(f, "{detail}"),
            Self::Value { what, expected, found } => write!(f, "{what}: expected {expected}, found {found}"),
            Self::File { path, detail } => write!(f, "{}: {detail}", path.display()),
        }
    }
}

impl std::error::Error for MediumError {}

impl From<PathtraceError> for MediumError {
    fn from(e: PathtraceError) -> Self {
        Self::Surface(e)
    }
}

impl From<ShadingError> for MediumError {
    fn from(e: ShadingError) -> Self {
        Self::Transport(e)
    }
}
