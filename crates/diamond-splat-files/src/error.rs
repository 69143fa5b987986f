//! What can go wrong: one enum that says which file, which field, what was expected, what was found, and what to do.
use diamond_splat::SplatError;
use std::path::{Path, PathBuf};

/// Errors of `diamond-splat-files`.
#[derive(Debug)]
pub enum SplatFileError {
    /// A file is not what it should be, or a cloud cannot be written.
    Malformed {
        /// The file; empty for bytes that came from no file.
        path: PathBuf,
        /// Name of the format.
        format: &'static str,
        /// Which part.
        field: Box<str>,
        /// What should be there.
        expected: Box<str>,
        /// What is there.
        found: Box<str>,
        /// What to do.
        advice: &'static str,
    },
    /// A PLY file is broken; the message has everything.
    Ply(SplatError),
    /// The operating system refused.
    Io {
        /// The file.
        path: PathBuf,
        /// What was being done.
        action: &'static str,
        /// Its answer.
        source: std::io::Error,
    },
}

impl SplatFileError {
    /// Says which file it was, where that is not known yet.
    pub(crate) fn in_file(self, file: &Path) -> Self {
        match self {
            Self::Malformed { path, format, field, expected, found, advice } if path.as_os_str().is_empty() => {
                Self::Malformed { path: file.to_owned(), format, field, expected, found, advice }
            }
            Self::Ply(SplatError::File { path, line, problem }) if !path.exists() => {
                Self::Ply(SplatError::File { path: file.to_owned(), line, problem })
            }
            other => other,
        }
    }
}

/// Bytes of `format` whose `field` is wrong.
pub(crate) fn malformed(
    format: &'static str,
    field: impl Into<String>,
    expected: impl Into<String>,
    found: impl Into<String>,
    advice: &'static str,
) -> SplatFileError {
    SplatFileError::Malformed {
        path: PathBuf::new(),
        format,
        field: field.into().into_boxed_str(),
        expected: expected.into().into_boxed_str(),
        found: found.into().into_boxed_str(),
        advice,
    }
}

/// The usual advice about a file that ends early.
pub(crate) const TRUNCATED: &str = "the file is truncated or damaged: copy or export it again";

/// The usual advice about a file that another program wrote wrongly.
pub(crate) const EXPORT_AGAIN: &str = "export the file again, or report it to the program that wrote it";

impl std::fmt::Display for SplatFileError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Malformed { path, format, field, expected, found, advice } => {
                if !path.as_os_str().is_empty() {
                    write!(f, "{}: ", path.display())?;
                }
                write!(f, "{format}, {field}: expected {expected}, found {found}; {advice}")
            }
            Self::Ply(e) => write!(f, "{e}"),
            Self::Io { path, action, source } => write!(f, "{}: could not {action}: {source}", path.display()),
        }
    }
}

impl std::error::Error for SplatFileError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Ply(e) => Some(e),
            Self::Io { source, .. } => Some(source),
            Self::Malformed { .. } => None,
        }
    }
}

impl From<SplatError> for SplatFileError {
    fn from(e: SplatError) -> Self {
        Self::Ply(e)
    }
}
