//! What can be wrong with models, their files, and what is given to them.
use std::fmt;

/// Why a diffusion model cannot be built, loaded, run or trained.
#[derive(Debug)]
pub enum DiffusionError {
    /// A tensor or picture has another shape than the model needs.
    Shape {
        /// Which one.
        what: String,
        /// The shape that was expected.
        expected: String,
        /// The shape that was found.
        found: String,
    },
    /// A setting is outside its range.
    Setting {
        /// Which setting.
        what: &'static str,
        /// The range that it must lie in.
        expected: String,
        /// What was found.
        found: String,
    },
    /// The weights are not those of this model.
    Weights {
        /// Where they came from.
        origin: String,
        /// What does not fit and what to do.
        problem: String,
    },
    /// A file cannot be read or written.
    File {
        /// Its path.
        path: String,
        /// What went wrong.
        problem: String,
    },
    /// A value is NaN or infinite.
    NonFinite {
        /// Where it is.
        what: String,
    },
    /// Candle refused an operation.
    Tensor(candle_core::Error),
}

/// Results of this crate.
pub type Result<T> = std::result::Result<T, DiffusionError>;

impl DiffusionError {
    /// A shape that does not fit.
    pub(crate) fn shape(what: impl Into<String>, expected: impl fmt::Debug, found: impl fmt::Debug) -> Self {
        Self::Shape { what: what.into(), expected: format!("{expected:?}"), found: format!("{found:?}") }
    }

    /// A setting outside its range.
    pub(crate) fn setting(what: &'static str, expected: impl Into<String>, found: impl fmt::Display) -> Self {
        Self::Setting { what, expected: expected.into(), found: found.to_string() }
    }
}

impl fmt::Display for DiffusionError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Shape { what, expected, found } => write!(f, "{what}: expected shape {expected}, found {found}"),
            Self::Setting { what, expected, found } => write!(f, "{what}: expected {expected}, found {found}"),
            Self::Weights { origin, problem } => write!(f, "{origin}: {problem}"),
            Self::File { path, problem } => write!(f, "{path}: {problem}"),
            Self::NonFinite { what } => {
                write!(f, "{what}: expected finite values, found NaN or infinity; check what came before it")
            }
            Self::Tensor(e) => write!(f, "tensor operation: {e}"),
        }
    }
}

impl std::error::Error for DiffusionError {}

impl From<candle_core::Error> for DiffusionError {
    fn from(e: candle_core::Error) -> Self {
        Self::Tensor(e)
    }
}
