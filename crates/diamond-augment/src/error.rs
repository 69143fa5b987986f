//! What can go wrong between a capture, a source and the disk.
use crate::SourceError;
use diamond_dataset::DatasetError;
use std::fmt;
use std::path::PathBuf;

/// Why there are no pictures.
#[derive(Debug)]
pub enum AugmentError {
    /// A photograph could not be read.
    Capture(DatasetError),
    /// The source could not make a picture.
    Source {
        /// Which one.
        method: String,
        /// Its reason.
        source: SourceError,
    },
    /// A source gave something else than it was asked for.
    Picture {
        /// Which one.
        method: String,
        /// What is wrong.
        detail: String,
    },
    /// A kept picture could not be written or read.
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong, and what to do.
        detail: String,
    },
}

impl fmt::Display for AugmentError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Capture(e) => write!(f, "{e}"),
            Self::Source { method, source } => write!(f, "pictures by {method}: {source}"),
            Self::Picture { method, detail } => write!(f, "pictures by {method}: {detail}"),
            Self::File { path, detail } => write!(f, "{}: {detail}", path.display()),
        }
    }
}

impl std::error::Error for AugmentError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Capture(e) => Some(e),
            Self::Source { source, .. } => Some(source.as_ref()),
            _ => None,
        }
    }
}

impl From<DatasetError> for AugmentError {
    fn from(e: DatasetError) -> Self {
        Self::Capture(e)
    }
}
