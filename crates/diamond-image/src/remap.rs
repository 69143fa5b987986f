//! Resampling a picture through a map from its pixels to another's.
//!
//! ```
//! use diamond_image::Image;
//! let image = Image::from_vec(2, 1, 1, vec![2.0, 4.0])?;
//! // Half a pixel to the right; what would come from outside is empty and counts as not covered.
//! let (shifted, covered) = image.remap(2, 1, |x, y| Some([x + 0.75, y]))?;
//! assert_eq!((shifted.data(), covered.data()), (&[3.5, 0.0][..], &[1.0, 0.0][..]));
//! # Ok::<(), diamond_image::ImageError>(())
//! ```
use crate::{Image, ImageError, Mask};

impl Image {
    /// The picture of `width` × `height` pixels whose value at the pixel centre (x, y) is this picture's at `source(x, y)`
    /// (pixel coordinates, centres at +0.5), by bilinear interpolation; and which of its pixels have a source: 1 where the
    /// source is a point of this picture, else 0, and the value is 0 too. Each pixel is one sample: a map that shrinks
    /// strongly aliases.
    ///
    /// Colours must be linear and, where there is alpha, premultiplied. Errors where a shape does not add up.
    pub fn remap(
        &self,
        width: usize,
        height: usize,
        source: impl Fn(f32, f32) -> Option<[f32; 2]>,
    ) -> Result<(Self, Mask), ImageError> {
        let channels = self.channels();
        let mut out = Image::new(width, height, channels);
        let mut covered = vec![0.0f32; width * height];
        let (right, bottom) = (self.width() as f32, self.height() as f32);
        for y in 0..height {
            for x in 0..width {
                let Some([u, v]) = source(x as f32 + 0.5, y as f32 + 0.5) else { continue };
                if (0.0..=right).contains(&u) && (0.0..=bottom).contains(&v) && self.pixels() > 0 {
                    self.sample(u, v, out.pixel_mut(x, y));
                    covered[y * width + x] = 1.0;
                }
            }
        }
        Ok((out, Mask::from_vec(width, height, covered)?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_identity_is_the_identity_and_outside_is_empty() {
        let image = Image::from_vec(3, 2, 2, (0..12).map(|v| v as f32).collect()).unwrap();
        let (same, covered) = image.remap(3, 2, |x, y| Some([x, y])).unwrap();
        assert_eq!((same, covered.area()), (image.clone(), 6.0));
        for bad in [[-0.1, 0.5], [3.1, 0.5], [0.5, 2.1], [f32::NAN, 0.5], [f32::INFINITY, 0.5]] {
            let (out, covered) = image.remap(1, 1, |_, _| Some(bad)).unwrap();
            assert_eq!((out.data(), covered.area()), (&[0.0, 0.0][..], 0.0));
        }
        let (out, covered) = image.remap(2, 2, |_, _| None).unwrap();
        assert_eq!((out, covered.area()), (Image::new(2, 2, 2), 0.0));
        assert_eq!(Image::new(0, 0, 3).remap(1, 1, |_, _| Some([0.0, 0.0])).unwrap().1.area(), 0.0);
    }
}
