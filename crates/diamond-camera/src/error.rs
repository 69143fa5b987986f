//! What can be wrong with a camera.
use std::fmt;

/// What can be wrong with a camera.
#[derive(Debug, Clone, PartialEq)]
pub enum CameraError {
    /// A matrix has NaN, infinity, or is no rotation plus translation (up to uniform scale).
    NotRigid {
        /// Which matrix.
        what: &'static str,
        /// What was found.
        found: String,
    },
    /// A pinhole number is NaN, infinite, or outside the range that has a meaning.
    Intrinsics {
        /// Which field of [`crate::Intrinsics`].
        field: &'static str,
        /// What it should be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
    /// A number that describes a rig or a trajectory is out of range.
    Value {
        /// Which number of what.
        what: &'static str,
        /// What it should be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
}

impl fmt::Display for CameraError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            CameraError::NotRigid { what, found } => {
                write!(f, "{what}: expected a finite rigid transform (rotation and translation), found {found}")
            }
            CameraError::Intrinsics { field, expected, found } => write!(
                f,
                "camera intrinsics, {field}: expected {expected}, found {found}; correct it where the camera was \
                 written down, or leave it out where the format can do without"
            ),
            CameraError::Value { what, expected, found } => write!(f, "{what}: expected {expected}, found {found}"),
        }
    }
}

impl std::error::Error for CameraError {}
