//! Area resizing and cropping.
//!
//! An output pixel is the mean of the input over the rectangle that it covers, with input pixels that lie partly inside
//! counted by the part: light is neither lost nor made, and nothing aliases. Colours must be linear and, where there is
//! an alpha channel, premultiplied; a mean of encoded or straight colours is not the colour of the mean.
//!
//! ```
//! use diamond_image::Image;
//! let image = Image::from_vec(3, 1, 1, vec![3.0, 6.0, 9.0])?;
//! assert_eq!(image.resize_area(1, 1)?.data(), [6.0]);
//! assert_eq!(image.resize_area(2, 1)?.data(), [4.0, 8.0]); // ⅔·3 + ⅓·6, ⅓·6 + ⅔·9
//! assert_eq!(image.crop(1, 0, 2, 1)?.data(), [6.0, 9.0]);
//! # Ok::<(), diamond_image::ImageError>(())
//! ```
use crate::{Image, ImageError};

/// What one axis of the resize reads: for each output index, the first input index and the weights from there on.
fn axis(from: usize, to: usize) -> Vec<(usize, Vec<f64>)> {
    // In units of 1/(from·to) of the axis, input i covers [i·to, (i+1)·to) and output o covers [o·from, (o+1)·from), so
    // that overlaps are exact integers.
    (0..to)
        .map(|o| {
            let (start, end) = (o * from, (o + 1) * from);
            let first = start / to;
            let last = (end - 1) / to;
            let weights =
                (first..=last).map(|i| (((i + 1) * to).min(end) - (i * to).max(start)) as f64 / from as f64).collect();
            (first, weights)
        })
        .collect()
}

impl Image {
    /// The image at `width` × `height` pixels, each the mean over the area that it covers. Enlarging repeats pixels, with
    /// blends where borders do not align; the same size is the identity, to the bit.
    ///
    /// Errors where an image without pixels is to have some.
    /// `[eq:area-resize]`
    pub fn resize_area(&self, width: usize, height: usize) -> Result<Self, ImageError> {
        if width == 0 || height == 0 {
            return Ok(Image::new(width, height, self.channels()));
        }
        if self.pixels() == 0 {
            return Err(ImageError::Shape {
                what: "Image::resize_area",
                expected: "an image of at least one pixel".into(),
                found: format!("{}×{}", self.width(), self.height()),
            });
        }
        let (columns, rows) = (axis(self.width(), width), axis(self.height(), height));
        let channels = self.channels();
        let mut out = Image::new(width, height, channels);
        let mut line = vec![0.0f64; self.width() * channels];
        for (y, (first_row, row_weights)) in rows.iter().enumerate() {
            line.fill(0.0);
            for (k, weight) in row_weights.iter().enumerate() {
                let start = (first_row + k) * self.width() * channels;
                for (sum, v) in line.iter_mut().zip(&self.data()[start..]) {
                    *sum += weight * f64::from(*v);
                }
            }
            for (x, (first, weights)) in columns.iter().enumerate() {
                for (c, value) in out.pixel_mut(x, y).iter_mut().enumerate() {
                    let sum: f64 = weights.iter().enumerate().map(|(k, w)| w * line[(first + k) * channels + c]).sum();
                    *value = sum as f32;
                }
            }
        }
        Ok(out)
    }

    /// The part of `width` × `height` pixels that starts at column `x`, row `y`.
    ///
    /// Errors where it is not inside the image.
    pub fn crop(&self, x: usize, y: usize, width: usize, height: usize) -> Result<Self, ImageError> {
        let inside =
            |start: usize, length: usize, size: usize| start.checked_add(length).is_some_and(|end| end <= size);
        if !inside(x, width, self.width()) || !inside(y, height, self.height()) {
            return Err(ImageError::Shape {
                what: "Image::crop",
                expected: format!("a part of the image's {}×{} pixels", self.width(), self.height()),
                found: format!("{width}×{height} from column {x}, row {y}"),
            });
        }
        let mut data = Vec::with_capacity(width * height * self.channels());
        for row in y..y + height {
            let start = (row * self.width() + x) * self.channels();
            data.extend_from_slice(&self.data()[start..start + width * self.channels()]);
        }
        Image::from_vec(width, height, self.channels(), data)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::adjoint::relative_l2;
    use diamond_testkit::strategies::values;
    use proptest::prelude::*;

    fn wide(v: &[f32]) -> Vec<f64> {
        v.iter().map(|&v| f64::from(v)).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]

        /// [eq:area-resize] against brute force, down and up, at ratios of every kind.
        #[test]
        fn resize_agrees_with_the_oracle(
            w in 1usize..7, h in 1usize..7, to_w in 1usize..7, to_h in 1usize..7, seed in values(36, 0.0..1.0),
        ) {
            let image = Image::from_vec(w, h, 1, seed[..w * h].to_vec()).unwrap();
            let got = image.resize_area(to_w, to_h).unwrap();
            // 60 points per axis are divided evenly by every size from 1 to 6.
            let expected = diamond_testkit::image::resize_area(&wide(image.data()), w, h, (to_w, to_h), 60);
            prop_assert!(relative_l2(&wide(got.data()), &expected, 1e-3) <= 1e-6);
        }
    }

    #[test]
    fn channels_are_kept_apart() {
        let image = Image::from_vec(2, 2, 2, vec![1.0, 10.0, 2.0, 20.0, 3.0, 30.0, 4.0, 40.0]).unwrap();
        assert_eq!(image.resize_area(1, 1).unwrap().data(), [2.5, 25.0]);
        assert_eq!(image.resize_area(1, 2).unwrap().data(), [1.5, 15.0, 3.5, 35.0]);
        assert_eq!(image.crop(1, 0, 1, 2).unwrap().data(), [2.0, 20.0, 4.0, 40.0]);
    }

    #[test]
    fn sizes_of_zero_and_parts_outside() {
        assert_eq!(Image::new(3, 3, 2).resize_area(0, 5).unwrap().shape(), (0, 5, 2));
        assert!(Image::new(0, 3, 2).resize_area(1, 1).is_err());
        assert_eq!(Image::new(3, 3, 0).resize_area(2, 2).unwrap().shape(), (2, 2, 0));
        let image = Image::new(4, 2, 3);
        assert_eq!(image.crop(4, 2, 0, 0).unwrap().shape(), (0, 0, 3));
        assert_eq!(image.crop(0, 0, 4, 2).unwrap(), image);
        for (x, y, w, h) in [(0, 0, 5, 1), (3, 0, 2, 1), (0, 2, 1, 1), (usize::MAX, 0, 2, 1)] {
            assert!(image.crop(x, y, w, h).unwrap_err().to_string().contains("4×2 pixels"));
        }
    }
}
