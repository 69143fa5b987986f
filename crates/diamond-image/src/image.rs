//! The image type: row-major interleaved `f32` values, and what can be wrong with its shape.

/// What can be wrong with the shape of an image.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ImageError {
    /// The number of values does not equal width × height × channels.
    Shape {
        /// What was being built or compared.
        what: &'static str,
        /// Number of values (or the shape) that was expected.
        expected: String,
        /// What was found instead.
        found: String,
    },
}

impl std::fmt::Display for ImageError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            ImageError::Shape { what, expected, found } => {
                write!(f, "{what}: expected {expected}, found {found}; check the image's width, height and channels")
            }
        }
    }
}

impl std::error::Error for ImageError {}

/// Row-major interleaved `f32` image of any number of channels.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Image {
    width: usize,
    height: usize,
    channels: usize,
    data: Vec<f32>,
}

/// Number of values of a shape; the largest `usize`, which no buffer reaches, where the product overflows.
fn values(width: usize, height: usize, channels: usize) -> usize {
    width.saturating_mul(height).saturating_mul(channels)
}

impl Image {
    /// An image of zeros, `width` × `height` pixels of `channels` values. Sizes from outside are to be checked before: this
    /// panics like any allocation where memory does not suffice.
    pub fn new(width: usize, height: usize, channels: usize) -> Self {
        Self::filled(width, height, channels, 0.0)
    }

    /// An image whose every value is `value`. See [`Image::new`] about sizes.
    pub fn filled(width: usize, height: usize, channels: usize, value: f32) -> Self {
        Self { width, height, channels, data: vec![value; values(width, height, channels)] }
    }

    /// Wraps `data` (row-major, interleaved, length `width·height·channels`).
    pub fn from_vec(width: usize, height: usize, channels: usize, data: Vec<f32>) -> Result<Self, ImageError> {
        if data.len() != values(width, height, channels) {
            return Err(ImageError::Shape {
                what: "Image::from_vec",
                expected: format!("{width}×{height}×{channels} = {} values", values(width, height, channels)),
                found: format!("{} values", data.len()),
            });
        }
        Ok(Self { width, height, channels, data })
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Values per pixel.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Number of pixels.
    pub fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// `(width, height, channels)`.
    pub fn shape(&self) -> (usize, usize, usize) {
        (self.width, self.height, self.channels)
    }

    /// All values, row-major and interleaved.
    pub fn data(&self) -> &[f32] {
        &self.data
    }

    /// All values, mutable.
    pub fn data_mut(&mut self) -> &mut [f32] {
        &mut self.data
    }

    /// Takes the values out.
    pub fn into_vec(self) -> Vec<f32> {
        self.data
    }

    /// The values of the pixel in column `x`, row `y`. Panics outside the image, like slice indexing.
    #[inline]
    pub fn pixel(&self, x: usize, y: usize) -> &[f32] {
        let i = (y * self.width + x) * self.channels;
        &self.data[i..i + self.channels]
    }

    /// The values of the pixel in column `x`, row `y`, mutable. Panics outside the image, like slice indexing.
    #[inline]
    pub fn pixel_mut(&mut self, x: usize, y: usize) -> &mut [f32] {
        let i = (y * self.width + x) * self.channels;
        &mut self.data[i..i + self.channels]
    }

    /// A new image with `f` applied to every value.
    pub fn map(&self, f: impl Fn(f32) -> f32) -> Self {
        Self { data: self.data.iter().map(|&v| f(v)).collect(), ..*self }
    }

    /// Channels `range` as an image of their own. Panics where the range exceeds the channels, like slice indexing.
    pub fn channels_range(&self, range: std::ops::Range<usize>) -> Self {
        let channels = range.len();
        let mut data = vec![0.0; self.pixels() * channels];
        let from = self.data.chunks_exact(self.channels.max(1));
        // Copies of a length that the compiler knows are an order of magnitude faster.
        match channels {
            0 => {}
            1 => copy_channels::<1>(&mut data, from, range.start),
            3 => copy_channels::<3>(&mut data, from, range.start),
            14 => copy_channels::<14>(&mut data, from, range.start),
            _ => data.chunks_exact_mut(channels).zip(from).for_each(|(to, p)| to.copy_from_slice(&p[range.clone()])),
        }
        Self { width: self.width, height: self.height, channels, data }
    }

    /// `Err` unless `other` has the same width, height and channels.
    pub fn expect_same_shape(&self, other: &Image, what: &'static str) -> Result<(), ImageError> {
        self.expect_shape(other.shape(), what)
    }

    /// `Err` unless this image has the shape `(width, height, channels)`.
    pub fn expect_shape(&self, expected: (usize, usize, usize), what: &'static str) -> Result<(), ImageError> {
        if self.shape() == expected {
            return Ok(());
        }
        let show = |s: (usize, usize, usize)| format!("{}×{}×{}", s.0, s.1, s.2);
        Err(ImageError::Shape { what, expected: show(expected), found: show(self.shape()) })
    }

    /// The mean of all values (summed in f64, in order); 0 for an image without values.
    pub fn mean(&self) -> f32 {
        if self.data.is_empty() {
            return 0.0;
        }
        (self.data.iter().map(|&v| f64::from(v)).sum::<f64>() / self.data.len() as f64) as f32
    }

    /// The position `(x, y, channel)` of the first value that is NaN or infinite.
    pub fn first_non_finite(&self) -> Option<(usize, usize, usize)> {
        let i = self.data.iter().position(|v| !v.is_finite())?;
        let (pixel, c) = (i / self.channels, i % self.channels);
        Some((pixel % self.width, pixel / self.width, c))
    }
}

/// The `N` values from `first` on of each pixel.
fn copy_channels<const N: usize>(to: &mut [f32], from: std::slice::ChunksExact<'_, f32>, first: usize) {
    for (to, pixel) in to.as_chunks_mut::<N>().0.iter_mut().zip(from) {
        to.copy_from_slice(&pixel[first..first + N]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_lengths_are_refused_and_named() {
        let error = Image::from_vec(2, 2, 3, vec![0.0; 11]).unwrap_err().to_string();
        assert!(error.contains("2×2×3 = 12 values") && error.contains("11 values"), "{error}");
        assert!(Image::from_vec(usize::MAX, 2, 1, vec![]).is_err());
        assert!(Image::from_vec(1 << 40, 1 << 40, 3, vec![0.0; 3]).is_err());
        let error = Image::new(2, 3, 1).expect_shape((3, 2, 1), "reference").unwrap_err().to_string();
        assert!(error.contains("reference: expected 3×2×1, found 2×3×1"), "{error}");
        assert!(Image::new(2, 3, 1).expect_same_shape(&Image::new(2, 3, 1), "same").is_ok());
    }

    #[test]
    fn the_first_value_that_is_not_finite_is_found() {
        let mut image = Image::new(3, 2, 2);
        assert_eq!(image.first_non_finite(), None);
        image.pixel_mut(2, 1)[1] = f32::NAN;
        assert_eq!(image.first_non_finite(), Some((2, 1, 1)));
        image.pixel_mut(1, 0)[0] = f32::INFINITY;
        assert_eq!(image.first_non_finite(), Some((1, 0, 0)));
    }

    #[test]
    fn values_are_interleaved_row_by_row() {
        let image = Image::from_vec(2, 2, 2, (0..8).map(|v| v as f32).collect()).unwrap();
        assert_eq!(image.pixel(1, 0), [2.0, 3.0]);
        assert_eq!(image.pixel(0, 1), [4.0, 5.0]);
        assert_eq!(image.channels_range(1..2).data(), [1.0, 3.0, 5.0, 7.0]);
        assert_eq!(image.map(|v| 2.0 * v).into_vec()[7], 14.0);
        assert_eq!(image.mean(), 3.5);
        assert_eq!(Image::new(0, 3, 3).mean(), 0.0);
    }
}
