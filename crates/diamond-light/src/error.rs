//! What can be wrong with a light.
use std::fmt;

/// What can be wrong with a light or a rig of lights.
#[derive(Debug, Clone, PartialEq)]
pub enum LightError {
    /// A number is NaN or infinite, or outside the range that has a meaning.
    Value {
        /// Which number of what.
        what: &'static str,
        /// What it should be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
}

impl fmt::Display for LightError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            LightError::Value { what, expected, found } => {
                write!(f, "{what}: expected {expected}, found {found}; correct the light where it was written down")
            }
        }
    }
}

impl std::error::Error for LightError {}
