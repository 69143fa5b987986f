//! Coverage masks.
use crate::{Image, ImageError};

/// Coverage of each pixel, in `[0, 1]`: 1 on the object, 0 off it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Mask {
    image: Image,
}

impl Mask {
    /// Wraps `coverage` (row-major, length `width·height`); values are clamped to `[0, 1]`, NaN becomes 0.
    pub fn from_vec(width: usize, height: usize, mut coverage: Vec<f32>) -> Result<Self, ImageError> {
        for v in &mut coverage {
            *v = if v.is_nan() { 0.0 } else { v.clamp(0.0, 1.0) };
        }
        Ok(Self { image: Image::from_vec(width, height, 1, coverage)? })
    }

    /// A mask that covers every pixel.
    pub fn full(width: usize, height: usize) -> Self {
        Self { image: Image::filled(width, height, 1, 1.0) }
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.image.width()
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.image.height()
    }

    /// Coverage of the pixel in column `x`, row `y`.
    #[inline]
    pub fn coverage(&self, x: usize, y: usize) -> f32 {
        self.image.pixel(x, y)[0]
    }

    /// All coverages, row-major.
    pub fn data(&self) -> &[f32] {
        self.image.data()
    }

    /// The mask as a one-channel image.
    pub fn as_image(&self) -> &Image {
        &self.image
    }

    /// Sum of the coverage: the object's area in pixels.
    pub fn area(&self) -> f32 {
        self.data().iter().map(|&v| v as f64).sum::<f64>() as f32
    }
}
