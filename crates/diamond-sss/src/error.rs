//! What can go wrong, and which exit code tells it to a script.
use diamond_dataset::DatasetError;
use diamond_metrics::MetricError;
use diamond_reconstruct::{ReconstructError, io_advice};
use diamond_splat_files::SplatFileError;
use diamond_synth::SynthError;
use std::path::{Path, PathBuf};

/// Errors of this crate.
#[derive(Debug)]
pub enum SssError {
    /// The command or an option makes no sense.
    Usage(String),
    /// The capture is at fault.
    Capture(DatasetError),
    /// Reconstruction, the configuration, a model or a checkpoint is at fault.
    Reconstruct(ReconstructError),
    /// A file that was given is not what it should be.
    Input {
        /// The file.
        path: PathBuf,
        /// What was expected, what was found, what to do.
        detail: String,
    },
    /// A splat file is at fault.
    Splats(SplatFileError),
    /// A file could not be read or written.
    Io {
        /// The file.
        path: PathBuf,
        /// What was being done.
        action: &'static str,
        /// The operating system's answer.
        source: std::io::Error,
    },
    /// The output folder holds results already.
    Exists(PathBuf),
    /// The run was interrupted after a step; the checkpoint is whole.
    Interrupted {
        /// Steps done.
        step: u64,
        /// The run's folder.
        folder: PathBuf,
    },
    /// A metric refused its input: a mistake of ours rather than of the user's.
    Metric(MetricError),
    /// Anything else that is a mistake of ours.
    Internal(String),
}

impl SssError {
    /// Exit code of the program: 1 the run failed, 2 usage, 3 bad input (capture, configuration, model files), 130
    /// interrupted.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Usage(_) | Self::Exists(_) | Self::Capture(DatasetError::Selection { .. }) => 2,
            Self::Reconstruct(ReconstructError::Capture(DatasetError::Selection { .. })) => 2,
            Self::Capture(DatasetError::Write { .. })
            | Self::Reconstruct(ReconstructError::Capture(DatasetError::Write { .. })) => 1,
            Self::Splats(SplatFileError::Io { action, source, .. }) => reading(action, source),
            Self::Capture(_) | Self::Input { .. } | Self::Splats(_) => 3,
            Self::Reconstruct(e) => match e {
                ReconstructError::Config { .. }
                | ReconstructError::Capture(_)
                | ReconstructError::Unusable { .. }
                | ReconstructError::Checkpoint { .. } => 3,
                ReconstructError::Io { action, source, .. } => reading(action, source),
                ReconstructError::NonFinite { .. }
                | ReconstructError::Device { .. }
                | ReconstructError::Internal { .. } => 1,
            },
            Self::Io { action, source, .. } => reading(action, source),
            Self::Interrupted { .. } => 130,
            Self::Metric(_) | Self::Internal(_) => 1,
        }
    }

    /// For `map_err`: a failed file operation on `path`.
    pub(crate) fn io(path: &Path, action: &'static str) -> impl FnOnce(std::io::Error) -> SssError {
        move |source| SssError::Io { path: path.to_owned(), action, source }
    }
}

/// A file that cannot be read is bad input; one that cannot be written is a failed run.
fn reading(action: &str, source: &std::io::Error) -> u8 {
    let writing = ["write", "create", "sync", "rename", "remove"].iter().any(|verb| action.starts_with(verb));
    match source.kind() {
        std::io::ErrorKind::NotFound if !writing => 3,
        _ if action.starts_with("read") || action.starts_with("open") => 3,
        _ => 1,
    }
}

impl std::fmt::Display for SssError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Usage(detail) | Self::Internal(detail) => write!(f, "{detail}"),
            Self::Capture(e) => write!(f, "{e}"),
            Self::Reconstruct(e) => write!(f, "{e}"),
            Self::Splats(e) => write!(f, "{e}"),
            Self::Metric(e) => write!(f, "evaluation: {e}"),
            Self::Input { path, detail } => write!(f, "{}: {detail}", path.display()),
            Self::Io { path, action, source } => {
                write!(f, "{}: could not {action}: {source}{}", path.display(), io_advice(source))
            }
            Self::Exists(path) => write!(
                f,
                "{}: holds a reconstruction already; continue it with --resume, replace it with --force, or choose \
                 another folder",
                path.display()
            ),
            Self::Interrupted { step, folder } => write!(
                f,
                "interrupted after step {step}; the checkpoint in {} is whole: run the same command with --resume to \
                 continue",
                folder.join("checkpoint").display()
            ),
        }
    }
}

impl std::error::Error for SssError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Capture(e) => Some(e),
            Self::Reconstruct(e) => Some(e),
            Self::Splats(e) => Some(e),
            Self::Metric(e) => Some(e),
            Self::Io { source, .. } => Some(source),
            _ => None,
        }
    }
}

impl From<DatasetError> for SssError {
    fn from(e: DatasetError) -> Self {
        Self::Capture(e)
    }
}

impl From<SynthError> for SssError {
    fn from(e: SynthError) -> Self {
        match e {
            SynthError::Dataset(e) => Self::Capture(e),
            SynthError::File { path, source } => Self::Io { path, action: "read the file", source },
            SynthError::Recipe { origin, detail } => Self::Input { path: origin.into(), detail },
            SynthError::Pathtrace(e) => Self::Input { path: "recipe".into(), detail: e.to_string() },
        }
    }
}

impl From<SplatFileError> for SssError {
    fn from(e: SplatFileError) -> Self {
        Self::Splats(e)
    }
}

impl From<ReconstructError> for SssError {
    fn from(e: ReconstructError) -> Self {
        Self::Reconstruct(e)
    }
}

impl From<MetricError> for SssError {
    fn from(e: MetricError) -> Self {
        Self::Metric(e)
    }
}
