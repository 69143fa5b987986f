//! What can go wrong, who is at fault, and what to do.
use std::path::PathBuf;

/// Errors of this crate.
#[derive(Debug)]
pub enum ReconstructError {
    /// The configuration is wrong.
    Config {
        /// Preset or file.
        origin: String,
        /// What was expected and found.
        detail: String,
    },
    /// The capture cannot be used.
    Capture(diamond_dataset::DatasetError),
    /// The capture is readable but lacks what the run needs.
    Unusable {
        /// What is missing and what to do.
        detail: String,
    },
    /// A file operation failed.
    Io {
        /// The file.
        path: PathBuf,
        /// What was being done.
        action: &'static str,
        /// The operating system's answer.
        source: std::io::Error,
    },
    /// A checkpoint or model file is not what it should be.
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What was expected, what was found, what to do.
        detail: String,
    },
    /// A NaN or infinity appeared; the run stops with the culprit named.
    NonFinite {
        /// Where: an attribute, a loss term, a network.
        what: String,
        /// Step number.
        step: u64,
        /// Index and value of the first offender.
        detail: String,
    },
    /// A device that part of a step runs on failed.
    Device {
        /// What is wrong and what to do.
        detail: String,
    },
    /// A lower crate refused its input: a mistake of ours rather than of the user's.
    Internal {
        /// Which stage.
        stage: &'static str,
        /// Its message.
        detail: String,
    },
}

impl std::fmt::Display for ReconstructError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Config { origin, detail } => write!(f, "configuration {origin}: {detail}"),
            Self::Capture(e) => write!(f, "{e}"),
            Self::Unusable { detail } => write!(f, "{detail}"),
            Self::Io { path, action, source } => {
                write!(f, "{}: could not {action}: {source}{}", path.display(), io_advice(source))
            }
            Self::Checkpoint { path, detail } => write!(f, "{}: {detail}", path.display()),
            Self::NonFinite { what, step, detail } => write!(
                f,
                "step {step}: {what} is not finite ({detail}); the run was stopped, the last checkpoint is intact: \
                 lower the learning rates or report the capture"
            ),
            Self::Device { detail } => write!(f, "{detail}"),
            Self::Internal { stage, detail } => write!(f, "stage {stage}: {detail}"),
        }
    }
}

/// Columns of a quoted line that a message shows.
const MAX_COLUMNS: usize = 200;

/// The message of a parser of text, with long lines that it quotes cut short.
pub(crate) fn brief(error: impl std::fmt::Display) -> String {
    let cut = |line: &str| match line.char_indices().nth(MAX_COLUMNS) {
        Some((end, _)) => format!("{}…", &line[..end]),
        None => line.to_owned(),
    };
    error.to_string().trim_end().lines().map(cut).collect::<Vec<_>>().join("\n")
}

/// What to do about an answer of the operating system, to be appended to a message; empty where there is nothing to say.
pub fn io_advice(source: &std::io::Error) -> &'static str {
    use std::io::ErrorKind;
    match source.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => {
            "; free some space and run the same command again (an interrupted reconstruction with --resume: what was \
             written before is intact)"
        }
        ErrorKind::FileTooLarge => {
            "; raise the limit on the size of files (ulimit -f) or write to another disk, then run the same command \
             again (an interrupted reconstruction with --resume: what was written before is intact)"
        }
        ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem => {
            "; check who may use the file and its folder, or name another place"
        }
        ErrorKind::NotADirectory => "; a part of this path is a file and no folder: name another place",
        _ => "",
    }
}

impl std::error::Error for ReconstructError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Capture(e) => Some(e),
            Self::Io { source, .. } => Some(source),
            _ => None,
        }
    }
}

impl From<diamond_dataset::DatasetError> for ReconstructError {
    fn from(e: diamond_dataset::DatasetError) -> Self {
        Self::Capture(e)
    }
}

/// Turns the error of a lower crate into [`ReconstructError::Internal`] with the stage's name.
pub(crate) fn stage<E: std::fmt::Display>(stage: &'static str) -> impl Fn(E) -> ReconstructError {
    move |e| ReconstructError::Internal { stage, detail: e.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quoted_lines_are_cut_and_advice_is_given() {
        let long = format!("at 1\n{}\nend\n", "ä".repeat(5000));
        assert_eq!(brief(long), format!("at 1\n{}…\nend", "ä".repeat(200)));
        for (kind, word) in [
            (std::io::ErrorKind::StorageFull, "--resume"),
            (std::io::ErrorKind::FileTooLarge, "ulimit"),
            (std::io::ErrorKind::PermissionDenied, "another place"),
            (std::io::ErrorKind::Other, ""),
        ] {
            assert!(io_advice(&kind.into()).contains(word));
        }
    }
}
