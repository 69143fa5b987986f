//! Luminance of linear RGB.
use crate::{Image, ImageError};

/// Weights of linear red, green and blue (Rec. 709 and sRGB primaries) in the luminance; they sum to 1.
pub const REC709_LUMINANCE: [f32; 3] = [0.2126, 0.7152, 0.0722];

/// Luminance of linear RGB (not of encoded values): what an eye sees of its brightness.
///
/// ```
/// use diamond_image::luminance;
/// assert!((luminance([1.0, 1.0, 1.0]) - 1.0).abs() < 1e-6);
/// assert!(luminance([0.0, 1.0, 0.0]) > luminance([1.0, 0.0, 0.0]));
/// ```
///
/// `[eq:luminance]`
#[inline]
pub fn luminance(rgb: [f32; 3]) -> f32 {
    REC709_LUMINANCE[0] * rgb[0] + REC709_LUMINANCE[1] * rgb[1] + REC709_LUMINANCE[2] * rgb[2]
}

/// Pullback of [`luminance`], which is linear.
/// `[eq:luminance]`
#[inline]
pub fn luminance_pull(d_luminance: f32) -> [f32; 3] {
    REC709_LUMINANCE.map(|w| w * d_luminance)
}

impl Image {
    /// The luminance of a linear image as one channel: of its first three channels, or the only one of a grey image.
    ///
    /// Errors for images of no or two channels.
    pub fn luminance(&self) -> Result<Image, ImageError> {
        match self.channels() {
            1 => Ok(self.clone()),
            0 | 2 => Err(ImageError::Shape {
                what: "Image::luminance",
                expected: "1 channel (grey) or at least 3 (linear RGB first)".into(),
                found: format!("{} channels", self.channels()),
            }),
            n => {
                let data = self.data().chunks_exact(n).map(|p| luminance([p[0], p[1], p[2]])).collect();
                Image::from_vec(self.width(), self.height(), 1, data)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::{Dual, Real, gradient};

    /// [eq:luminance]: value and gradient.
    #[test]
    fn luminance_and_its_pullback_agree_with_the_oracle() {
        let weights = [0.2126, 0.7152, 0.0722];
        let oracle = |x: &[Dual]| x.iter().zip(weights).fold(Dual::of(0.0), |s, (&x, w): (_, f64)| s + x * Dual::of(w));
        let expected = gradient(oracle, &[0.3, 0.2, 0.9]);
        for (got, expected) in luminance_pull(-2.0).iter().zip(expected) {
            assert!((f64::from(*got) + 2.0 * expected).abs() < 1e-6);
        }
        assert!((luminance([0.3, 0.2, 0.9]) - 0.2718).abs() < 1e-6);
        assert!((REC709_LUMINANCE.iter().sum::<f32>() - 1.0).abs() < 1e-6);
    }

    #[test]
    fn images_by_number_of_channels() {
        let rgba = Image::from_vec(1, 1, 4, vec![1.0, 0.0, 0.0, 0.5]).unwrap();
        assert_eq!(rgba.luminance().unwrap().data(), [0.2126]);
        let grey = Image::filled(2, 1, 1, 0.3);
        assert_eq!(grey.luminance().unwrap(), grey);
        assert!(Image::new(1, 1, 2).luminance().is_err());
        assert!(Image::new(1, 1, 0).luminance().is_err());
    }
}
