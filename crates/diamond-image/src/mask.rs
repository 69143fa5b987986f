//! Coverage masks.
//!
//! ```
//! use diamond_image::Mask;
//! let mask = Mask::from_vec(3, 1, vec![0.0, 1.0, 0.5])?;
//! assert_eq!(mask.area(), 1.5);
//! assert_eq!(mask.bounding_box(0.25), Some((1, 0, 3, 1)));
//! # Ok::<(), diamond_image::ImageError>(())
//! ```
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

    /// Channel `channel` of an image as a mask (alpha of RGBA is channel 3), clamped as in [`Mask::from_vec`].
    ///
    /// Errors where the image has no such channel.
    pub fn from_channel(image: &Image, channel: usize) -> Result<Self, ImageError> {
        if channel >= image.channels() {
            return Err(ImageError::Shape {
                what: "Mask::from_channel",
                expected: format!("at least {} channels", channel.saturating_add(1)),
                found: format!("{} channels", image.channels()),
            });
        }
        let coverage = image.data().iter().skip(channel).step_by(image.channels()).copied().collect();
        Self::from_vec(image.width(), image.height(), coverage)
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

    /// 1 − coverage.
    pub fn complement(&self) -> Self {
        Self { image: self.image.map(|v| 1.0 - v) }
    }

    /// The smallest box `(x0, y0, x1, y1)` of pixel columns and rows, `x1` and `y1` excluded, around all pixels whose
    /// coverage exceeds `threshold`; `None` where there are none.
    pub fn bounding_box(&self, threshold: f32) -> Option<(usize, usize, usize, usize)> {
        let mut bounds: Option<(usize, usize, usize, usize)> = None;
        for (i, _) in self.data().iter().enumerate().filter(|(_, v)| **v > threshold) {
            let (x, y) = (i % self.width(), i / self.width());
            bounds = Some(match bounds {
                None => (x, y, x + 1, y + 1),
                Some((x0, y0, x1, y1)) => (x0.min(x), y0.min(y), x1.max(x + 1), y1.max(y + 1)),
            });
        }
        bounds
    }

    /// The mask at another size, by area; see [`Image::resize_area`].
    pub fn resize_area(&self, width: usize, height: usize) -> Result<Self, ImageError> {
        Ok(Self { image: self.image.resize_area(width, height)? })
    }

    /// The part of `width` × `height` pixels that starts at column `x`, row `y`; see [`Image::crop`].
    pub fn crop(&self, x: usize, y: usize, width: usize, height: usize) -> Result<Self, ImageError> {
        Ok(Self { image: self.image.crop(x, y, width, height)? })
    }
}
