//! What can be wrong with a comparison of two images.
use diamond_image::{Image, ImageError, Mask};

/// Why a metric has no value. A metric never falls back to another one: its absence carries this reason.
#[derive(Debug, Clone, PartialEq)]
pub enum MetricError {
    /// Two inputs do not have the shapes that the metric needs.
    Shape {
        /// Which input of which metric.
        what: &'static str,
        /// `width×height×channels` that was expected.
        expected: String,
        /// `width×height×channels` that was found.
        found: String,
    },
    /// A value of an input is NaN or infinite.
    NonFinite {
        /// Which input of which metric.
        what: &'static str,
        /// Column of the first such value.
        x: usize,
        /// Row of the first such value.
        y: usize,
        /// Channel of the first such value.
        channel: usize,
    },
    /// The images have no pixels or no channels.
    Empty {
        /// Which metric.
        what: &'static str,
    },
    /// The mask covers nothing (of the pixels that the metric is defined on), so that a mean over it is undefined.
    EmptyMask {
        /// Which metric.
        what: &'static str,
    },
    /// The images are smaller than the window without padding.
    TooSmall {
        /// Which metric.
        what: &'static str,
        /// The least width and height.
        least: usize,
        /// `width×height` that was found.
        found: String,
    },
    /// A parameter is outside its range.
    Parameter {
        /// Which parameter of which metric.
        what: &'static str,
        /// The range that it must lie in.
        expected: &'static str,
        /// The value that was found.
        found: f64,
    },
    /// The reference of HDR-FLIP has no positive luminance: no exposure can be derived from it.
    BlackReference,
}

impl std::fmt::Display for MetricError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            MetricError::Shape { what, expected, found } => {
                write!(f, "{what}: expected {expected}, found {found}; compare images of the same size and channels")
            }
            MetricError::NonFinite { what, x, y, channel } => write!(
                f,
                "{what}: expected finite values, found NaN or infinity at column {x}, row {y}, channel {channel}; \
                 find the stage that produced it, the metric cannot rank it"
            ),
            MetricError::Empty { what } => write!(f, "{what}: expected at least one pixel and channel, found none"),
            MetricError::EmptyMask { what } => {
                write!(
                    f,
                    "{what}: expected a mask that covers something, found none; leave the metric out of the report"
                )
            }
            MetricError::TooSmall { what, least, found } => write!(
                f,
                "{what}: expected at least {least}×{least} pixels for a window without padding, found {found}; \
                 use the zero-padded window or leave the metric out"
            ),
            MetricError::Parameter { what, expected, found } => write!(f, "{what}: expected {expected}, found {found}"),
            MetricError::BlackReference => write!(
                f,
                "HDR-FLIP: expected a reference with positive luminance, found only black; give the exposures explicitly"
            ),
        }
    }
}

impl std::error::Error for MetricError {}

impl From<ImageError> for MetricError {
    fn from(e: ImageError) -> Self {
        let ImageError::Shape { what, expected, found } = e;
        MetricError::Shape { what, expected, found }
    }
}

fn show(shape: (usize, usize, usize)) -> String {
    format!("{}×{}×{}", shape.0, shape.1, shape.2)
}

/// True if no value is NaN or infinite. Written so that the compiler vectorises it: it runs at every training step.
fn all_finite(values: &[f32]) -> bool {
    const EXPONENT: u32 = 0x7f80_0000;
    let mut chunks = values.chunks_exact(64);
    let mut bad = 0u32;
    for chunk in &mut chunks {
        for v in chunk {
            bad |= u32::from(v.to_bits() & EXPONENT == EXPONENT);
        }
    }
    bad == 0 && chunks.remainder().iter().all(|v| v.is_finite())
}

/// `Err` if `image` holds NaN or infinity; `what` names the input.
pub(crate) fn expect_finite(image: &Image, what: &'static str) -> Result<(), MetricError> {
    if all_finite(image.data()) {
        return Ok(());
    }
    let (x, y, channel) = image.first_non_finite().unwrap_or((0, 0, 0));
    Err(MetricError::NonFinite { what, x, y, channel })
}

/// The check at every public entrance: same shape, not empty, all values finite. `names` are the metric, its first
/// and its second input.
pub(crate) fn expect_comparable(a: &Image, b: &Image, names: [&'static str; 3]) -> Result<(), MetricError> {
    if a.shape() != b.shape() {
        return Err(MetricError::Shape { what: names[2], expected: show(a.shape()), found: show(b.shape()) });
    }
    if a.data().is_empty() {
        return Err(MetricError::Empty { what: names[0] });
    }
    expect_finite(a, names[1])?;
    expect_finite(b, names[2])
}

/// `Err` unless `mask` is as large as `image`.
pub(crate) fn expect_mask(image: &Image, mask: &Mask, what: &'static str) -> Result<(), MetricError> {
    if (mask.width(), mask.height()) == (image.width(), image.height()) {
        return Ok(());
    }
    let expected = format!("{}×{}", image.width(), image.height());
    Err(MetricError::Shape { what, expected, found: format!("{}×{}", mask.width(), mask.height()) })
}

/// `Err` unless `image` has three channels.
pub(crate) fn expect_rgb(image: &Image, what: &'static str) -> Result<(), MetricError> {
    if image.channels() == 3 {
        return Ok(());
    }
    let expected = show((image.width(), image.height(), 3));
    Err(MetricError::Shape { what, expected, found: show(image.shape()) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_culprit_is_named() {
        let good = Image::filled(70, 3, 2, 0.5);
        let mut bad = good.clone();
        bad.pixel_mut(68, 2)[1] = f32::NAN;
        let e = expect_comparable(&good, &bad, ["PSNR", "PSNR: first image", "PSNR: second image"]).unwrap_err();
        assert_eq!(e, MetricError::NonFinite { what: "PSNR: second image", x: 68, y: 2, channel: 1 });
        for text in ["column 68", "row 2", "channel 1", "second image"] {
            assert!(e.to_string().contains(text), "{e}");
        }
        bad.pixel_mut(0, 0)[0] = f32::NEG_INFINITY;
        assert!(!all_finite(bad.data()));
        assert!(all_finite(good.data()));
    }
}
