//! What can be wrong with a scene, a mesh, or a file that holds one.
use std::fmt;
use std::path::PathBuf;

/// What can be wrong with what is to be traced.
#[derive(Debug, Clone, PartialEq)]
pub enum PathtraceError {
    /// A number is NaN, infinite, or outside the range that has a meaning.
    Value {
        /// Which number of what.
        what: String,
        /// What it should be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
    /// A list has the wrong length, or an index points outside it.
    Shape {
        /// Which list.
        what: &'static str,
        /// What its length or index should be.
        expected: String,
        /// What it is.
        found: String,
    },
    /// A mesh bounds no volume, and no repair that is certain would make it do so.
    Mesh {
        /// What is wrong with it, with counts.
        problem: String,
        /// What to do about it.
        advice: &'static str,
    },
    /// A light cannot reach the camera through this boundary by any path that is found with a probability above zero.
    Unreachable {
        /// Index of the light in the scene.
        light: usize,
        /// Why, and what to use instead.
        reason: &'static str,
    },
    /// A file cannot be read as what its name says.
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong, and where in it.
        problem: String,
    },
}

impl fmt::Display for PathtraceError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            PathtraceError::Value { what, expected, found } => {
                write!(f, "{what}: expected {expected}, found {found}; correct it where it was written down")
            }
            PathtraceError::Shape { what, expected, found } => write!(f, "{what}: expected {expected}, found {found}"),
            PathtraceError::Mesh { problem, advice } => write!(f, "mesh: {problem}; {advice}"),
            PathtraceError::Unreachable { light, reason } => write!(f, "light {light}: {reason}"),
            PathtraceError::File { path, problem } => write!(f, "{}: {problem}", path.display()),
        }
    }
}

impl std::error::Error for PathtraceError {}

/// `Ok` where `accept` holds for the number.
pub(crate) fn check(
    what: impl Into<String>,
    value: f32,
    expected: &'static str,
    accept: impl Fn(f32) -> bool,
) -> Result<(), PathtraceError> {
    if value.is_finite() && accept(value) {
        return Ok(());
    }
    Err(PathtraceError::Value { what: what.into(), expected, found: format!("{value}") })
}

/// `Ok` where `accept` holds for each component.
pub(crate) fn check_rgb(
    what: &str,
    value: glam::Vec3,
    expected: &'static str,
    accept: impl Fn(f32) -> bool,
) -> Result<(), PathtraceError> {
    for (channel, v) in ["red", "green", "blue"].iter().zip(value.to_array()) {
        check(format!("{what}, {channel}"), v, expected, &accept)?;
    }
    Ok(())
}
