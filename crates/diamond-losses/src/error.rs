//! What can be wrong with the inputs of a loss.
use diamond_image::{Image, ImageError, Mask};
use diamond_metrics::MetricError;

/// Why a loss has no value.
#[derive(Debug, Clone, PartialEq)]
pub enum LossError {
    /// An input does not have the shape or length that the loss needs.
    Shape {
        /// Which input of which loss.
        what: &'static str,
        /// The shape (`width×height×channels`) or length that was expected.
        expected: String,
        /// What was found.
        found: String,
    },
    /// A value of an input is NaN or infinite.
    NonFinite {
        /// Which input of which loss.
        what: &'static str,
        /// The first such value: pixel and channel of an image, index of a slice.
        at: String,
    },
    /// A parameter is outside its range.
    Parameter {
        /// Which parameter of which loss.
        what: &'static str,
        /// The range that it must lie in.
        expected: &'static str,
        /// The value that was found.
        found: f32,
    },
    /// The metric behind a loss refused its inputs.
    Metric(MetricError),
}

impl std::fmt::Display for LossError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            LossError::Shape { what, expected, found } => {
                write!(f, "{what}: expected {expected}, found {found}; render and ground truth must be of one size")
            }
            LossError::NonFinite { what, at } => write!(
                f,
                "{what}: expected finite values, found NaN or infinity at {at}; find the stage that produced it"
            ),
            LossError::Parameter { what, expected, found } => write!(f, "{what}: expected {expected}, found {found}"),
            LossError::Metric(e) => e.fmt(f),
        }
    }
}

impl std::error::Error for LossError {}

impl From<MetricError> for LossError {
    fn from(e: MetricError) -> Self {
        LossError::Metric(e)
    }
}

impl From<ImageError> for LossError {
    fn from(e: ImageError) -> Self {
        let ImageError::Shape { what, expected, found } = e;
        LossError::Shape { what, expected, found }
    }
}

/// `Err` if `image` holds NaN or infinity.
pub(crate) fn expect_finite(image: &Image, what: &'static str) -> Result<(), LossError> {
    match image.first_non_finite() {
        None => Ok(()),
        Some((x, y, c)) => Err(LossError::NonFinite { what, at: format!("column {x}, row {y}, channel {c}") }),
    }
}

/// `Err` unless `image` has `like`'s width and height and `channels` channels, all values finite.
pub(crate) fn expect_image(
    image: &Image,
    like: (usize, usize),
    channels: usize,
    what: &'static str,
) -> Result<(), LossError> {
    image.expect_shape((like.0, like.1, channels), what)?;
    expect_finite(image, what)
}

/// `Err` unless `mask` covers `size` (width, height).
pub(crate) fn expect_mask(mask: &Mask, size: (usize, usize), what: &'static str) -> Result<(), LossError> {
    if (mask.width(), mask.height()) == size {
        return Ok(());
    }
    let expected = format!("{}×{}", size.0, size.1);
    Err(LossError::Shape { what, expected, found: format!("{}×{}", mask.width(), mask.height()) })
}

/// `Err` unless `values` has `length` values, all finite.
pub(crate) fn expect_slice(values: &[f32], length: usize, what: &'static str) -> Result<(), LossError> {
    expect_length(values.len(), length, what)?;
    match values.iter().position(|v| !v.is_finite()) {
        None => Ok(()),
        Some(i) => Err(LossError::NonFinite { what, at: format!("index {i}") }),
    }
}

/// `Err` unless `values` has `length` vectors, all finite.
pub(crate) fn expect_vectors(values: &[[f32; 3]], length: usize, what: &'static str) -> Result<(), LossError> {
    expect_length(values.len(), length, what)?;
    match values.iter().position(|v| v.iter().any(|c| !c.is_finite())) {
        None => Ok(()),
        Some(i) => Err(LossError::NonFinite { what, at: format!("index {i}") }),
    }
}

fn expect_length(found: usize, expected: usize, what: &'static str) -> Result<(), LossError> {
    if found == expected {
        return Ok(());
    }
    Err(LossError::Shape { what, expected: format!("{expected} values"), found: format!("{found} values") })
}
