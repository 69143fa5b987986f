//! What can be wrong with the inputs of a consistency loss.
use diamond_camera::CameraError;
use diamond_image::Image;
use std::fmt;

/// Why two views cannot be compared, or a depth map not be aligned.
#[derive(Debug, Clone, PartialEq)]
pub enum ConsistencyError {
    /// An input does not have the size of its camera, or another shape than the function needs.
    Shape {
        /// Which input.
        what: &'static str,
        /// The shape (`width×height×channels`) or length that was expected.
        expected: String,
        /// What was found.
        found: String,
    },
    /// A value is NaN or infinite.
    NonFinite {
        /// Which input.
        what: &'static str,
        /// The first such value.
        at: String,
    },
    /// A setting is outside its range.
    Setting {
        /// Which setting.
        what: &'static str,
        /// The range that it must lie in.
        expected: &'static str,
        /// The value that was found.
        found: f32,
    },
    /// Both depths are estimated from single pictures.
    BothEstimated,
    /// A depth map cannot be aligned.
    Alignment {
        /// Why.
        reason: String,
    },
    /// A camera is unusable.
    Camera(CameraError),
}

impl fmt::Display for ConsistencyError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Shape { what, expected, found } => {
                write!(f, "{what}: expected {expected}, found {found}; each map has the size of its own view's camera")
            }
            Self::NonFinite { what, at } => write!(
                f,
                "{what}: expected finite values, found NaN or infinity at {at}; find the stage that produced it, or \
                 write 0 into a given depth where it is unknown"
            ),
            Self::Setting { what, expected, found } => write!(f, "{what}: expected {expected}, found {found}"),
            Self::BothEstimated => write!(
                f,
                "the depths of both views are estimated: there is nothing that a gradient could reach, and two guesses \
                 that agree prove nothing; render one of them, or give it as measured"
            ),
            Self::Alignment { reason } => write!(f, "aligning the estimated depth: {reason}"),
            Self::Camera(e) => e.fmt(f),
        }
    }
}

impl std::error::Error for ConsistencyError {}

impl From<CameraError> for ConsistencyError {
    fn from(e: CameraError) -> Self {
        Self::Camera(e)
    }
}

/// `Err` unless `image` is `width` × `height` with one channel.
pub(crate) fn expect_map(image: &Image, size: (usize, usize), what: &'static str) -> Result<(), ConsistencyError> {
    if image.shape() == (size.0, size.1, 1) {
        return Ok(());
    }
    let (w, h, c) = image.shape();
    Err(ConsistencyError::Shape {
        what, expected: format!("{}×{}×1", size.0, size.1), found: format!("{w}×{h}×{c}")
    })
}

/// `Err` if `image` holds NaN or infinity.
pub(crate) fn expect_finite(image: &Image, what: &'static str) -> Result<(), ConsistencyError> {
    match image.first_non_finite() {
        None => Ok(()),
        Some((x, y, _)) => Err(ConsistencyError::NonFinite { what, at: format!("column {x}, row {y}") }),
    }
}
