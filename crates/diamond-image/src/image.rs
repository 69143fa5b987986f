//! The image type: row-major interleaved `f32` values.

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

impl Image {
    /// An image of zeros, `width` × `height` pixels of `channels` values.
    pub fn new(width: usize, height: usize, channels: usize) -> Self {
        Self { width, height, channels, data: vec![0.0; width * height * channels] }
    }

    /// An image whose every value is `value`.
    pub fn filled(width: usize, height: usize, channels: usize, value: f32) -> Self {
        Self { width, height, channels, data: vec![value; width * height * channels] }
    }

    /// Wraps `data` (row-major, interleaved, length `width·height·channels`).
    pub fn from_vec(width: usize, height: usize, channels: usize, data: Vec<f32>) -> Result<Self, ImageError> {
        if data.len() != width * height * channels {
            return Err(ImageError::Shape {
                what: "Image::from_vec",
                expected: format!("{width}×{height}×{channels} = {} values", width * height * channels),
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

    /// Channels `range` as an image of their own.
    pub fn channels_range(&self, range: std::ops::Range<usize>) -> Self {
        let channels = range.len();
        let mut data = Vec::with_capacity(self.pixels() * channels);
        for pixel in self.data.chunks_exact(self.channels.max(1)) {
            data.extend_from_slice(&pixel[range.clone()]);
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

    /// The position `(x, y, channel)` of the first value that is NaN or infinite.
    pub fn first_non_finite(&self) -> Option<(usize, usize, usize)> {
        let i = self.data.iter().position(|v| !v.is_finite())?;
        let (pixel, c) = (i / self.channels, i % self.channels);
        Some((pixel % self.width, pixel / self.width, c))
    }
}
