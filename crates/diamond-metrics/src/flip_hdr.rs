//! FLIP of high-dynamic-range images: the worst of FLIP over a stack of exposures.
//!
//! After "Visualizing Errors in Rendered High Dynamic Range Images" (Andersson, Nilsson, Shirley, Akenine-Möller 2021).
//! Both images are multiplied by 2^c, tone-mapped and compared as displayed images, for exposures c from where the
//! reference's brightest pixel is nearly white to where its median pixel is; each pixel keeps its largest difference.
use diamond_image::{Image, Mask};

use crate::error::{expect_comparable, expect_rgb};
use crate::flip_colour::Triple;
use crate::{Flip, FlipOptions, MetricError};

/// Luminance of linear RGB with sRGB primaries, as rounded in the standard.
const LUMINANCE: Triple = [0.2126, 0.7152, 0.0722];
/// The tone-mapped value that counts as nearly white.
const NEARLY_WHITE: f64 = 0.85;
/// The least median luminance that the last exposure is derived from; a black background would ask for infinity.
const LEAST_MEDIAN: f64 = f32::EPSILON as f64;

/// A tone-mapping curve, from linear to displayed linear values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum FlipToneMapper {
    /// Rational fit of the ACES filmic curve (Narkowicz), its input scaled by 0.6, per channel.
    #[default]
    Aces,
    /// Hable's filmic curve, white at 11.2, its input doubled (his exposure bias), per channel.
    Hable,
    /// Reinhard's 1/(1 + luminance), applied to all channels alike.
    Reinhard,
}

impl FlipToneMapper {
    /// Numerator and denominator (x², x, 1) of the curve; for Reinhard that of luminance.
    fn coefficients(self) -> [f64; 6] {
        match self {
            FlipToneMapper::Aces => [0.36 * 2.51, 0.6 * 0.03, 0.0, 0.36 * 2.43, 0.6 * 0.59, 0.14],
            FlipToneMapper::Hable => {
                // Shoulder A, linear B and C, toe D, E, F: f(x) = (x(Ax + CB) + DE)/(x(Ax + B) + DF) − E/F.
                let (a, b, c, d, e, f) = (0.15, 0.50, 0.10, 0.20, 0.02, 0.30);
                let curve = |x: f64| (x * (a * x + c * b) + d * e) / (x * (a * x + b) + d * f) - e / f;
                let white = curve(11.2);
                // One fraction over the common denominator, divided by the value of white, at twice the input.
                let [p, q] = [a - a * e / f, c * b - b * e / f].map(|v| v / white);
                [4.0 * p, 2.0 * q, 0.0, 4.0 * a, 2.0 * b, d * f]
            }
            FlipToneMapper::Reinhard => [0.0, 1.0, 0.0, 0.0, 1.0, 1.0],
        }
    }

    /// `numerator / denominator` at `x`; with both divided by x² where x is large, so that nothing overflows.
    fn curve(self, x: f64) -> f64 {
        let [a, b, c, d, e, f] = self.coefficients();
        if x > 1.0 {
            let y = 1.0 / x;
            (a + (b + c * y) * y) / (d + (e + f * y) * y)
        } else {
            ((a * x + b) * x + c) / ((d * x + e) * x + f)
        }
    }

    /// The displayed value of a linear RGB colour, clamped to `[0, 1]`.
    fn display(self, rgb: Triple) -> Triple {
        let mapped = match self {
            FlipToneMapper::Aces | FlipToneMapper::Hable => rgb.map(|v| self.curve(v)),
            FlipToneMapper::Reinhard => {
                let y = luminance(rgb);
                rgb.map(|v| v / (1.0 + y))
            }
        };
        mapped.map(|v| v.clamp(0.0, 1.0))
    }

    /// The input whose tone-mapped value is [`NEARLY_WHITE`].
    fn nearly_white(self) -> f64 {
        let [a, b, c, d, e, f] = self.coefficients();
        let t = NEARLY_WHITE;
        let (a, b, c) = (a - t * d, b - t * e, c - t * f);
        if a == 0.0 {
            return -c / b;
        }
        let root = (b * b - 4.0 * a * c).sqrt();
        ((-b + root) / (2.0 * a)).max((-b - root) / (2.0 * a))
    }
}

/// The exposures of the stack, in stops.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlipExposures {
    /// First exposure; at most `stop`.
    pub start: f64,
    /// Last exposure.
    pub stop: f64,
    /// Number of exposures, evenly spaced with both ends; at least 1 (1 means `start` only), at most 1000.
    pub count: usize,
}

/// How HDR images are compared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlipHdrOptions {
    /// Pixels per degree of visual angle, in `[1, 1000]`.
    pub pixels_per_degree: f64,
    /// The tone mapper.
    pub tone_mapper: FlipToneMapper,
    /// The exposures; `None` derives them from the reference by [`flip_exposures`].
    pub exposures: Option<FlipExposures>,
}

impl Default for FlipHdrOptions {
    fn default() -> Self {
        let FlipOptions { pixels_per_degree, .. } = FlipOptions::default();
        Self { pixels_per_degree, tone_mapper: FlipToneMapper::Aces, exposures: None }
    }
}

/// The result of [`flip_hdr`].
#[derive(Debug, Clone, PartialEq)]
pub struct FlipHdr {
    /// The largest difference of each pixel, and its mean.
    pub flip: Flip,
    /// The exposures that were used; report them beside the number.
    pub exposures: FlipExposures,
}

fn luminance(rgb: Triple) -> f64 {
    LUMINANCE[0] * rgb[0] + LUMINANCE[1] * rgb[1] + LUMINANCE[2] * rgb[2]
}

fn linear(image: &Image) -> Vec<Triple> {
    image.data().chunks_exact(3).map(|p| [p[0], p[1], p[2]].map(|v| f64::from(v).max(0.0))).collect()
}

/// `[eq:flip-exposures]` The exposures of a reference image (linear RGB, `width × height × 3`): from log2(w / largest
/// luminance) to log2(w / median luminance), where the tone mapper takes w to 0.85; max(2, ⌈stop − start⌉) of them.
/// The median of an even number of pixels is the upper one, and at least 2⁻²³ (though never above the largest).
///
/// Errors: not three channels, no pixels, NaN or infinity, no positive luminance.
pub fn flip_exposures(reference: &Image, tone_mapper: FlipToneMapper) -> Result<FlipExposures, MetricError> {
    expect_comparable(reference, reference, ["HDR-FLIP", "HDR-FLIP: reference", "HDR-FLIP: reference"])?;
    expect_rgb(reference, "HDR-FLIP: reference")?;
    let mut luminances: Vec<f64> = linear(reference).into_iter().map(luminance).collect();
    luminances.sort_unstable_by(f64::total_cmp);
    let largest = luminances[luminances.len() - 1];
    if largest <= 0.0 {
        return Err(MetricError::BlackReference);
    }
    let median = luminances[luminances.len() / 2].max(LEAST_MEDIAN).min(largest);
    let start = libm::log2(tone_mapper.nearly_white() / largest);
    // From the ratio itself, so that a whole number of stops stays whole under the ceiling.
    let span = libm::log2(largest / median);
    Ok(FlipExposures { start, stop: start + span, count: (span.ceil() as usize).max(2) })
}

/// `[eq:flip-hdr]` HDR-FLIP of two images of linear RGB (`width × height × 3`, the same shape), unbounded above;
/// negative values count as 0. Not symmetric: the exposures come from the reference unless they are given.
///
/// Errors: as [`crate::flip_ldr`]; a black reference without explicit exposures; exposures that are not finite, not
/// in order, outside ±200 stops, or not 1 to 1000 in number.
pub fn flip_hdr(reference: &Image, test: &Image, options: FlipHdrOptions) -> Result<FlipHdr, MetricError> {
    expect_comparable(reference, test, ["HDR-FLIP", "HDR-FLIP: reference", "HDR-FLIP: test"])?;
    expect_rgb(reference, "HDR-FLIP: reference")?;
    let viewer = crate::flip::Viewer::new(options.pixels_per_degree)?;
    let exposures = match options.exposures {
        Some(given) => given,
        None => flip_exposures(reference, options.tone_mapper)?,
    };
    let FlipExposures { start, stop, count } = exposures;
    let bad = |what, expected, found| Err(MetricError::Parameter { what, expected, found });
    if !(-200.0..=200.0).contains(&start) {
        return bad("HDR-FLIP: start exposure", "a number from −200 to 200", start);
    }
    if !(start..=200.0).contains(&stop) {
        return bad("HDR-FLIP: stop exposure", "a number from the start exposure to 200", stop);
    }
    if !(1..=1000).contains(&count) {
        return bad("HDR-FLIP: number of exposures", "1 to 1000", count as f64);
    }
    let (width, height) = (reference.width(), reference.height());
    let (a, b) = (linear(reference), linear(test));
    let mut worst = vec![0.0; width * height];
    for i in 0..count {
        let exposure = start + (stop - start) * i as f64 / (count - 1).max(1) as f64;
        let display = |v: &[Triple]| -> Vec<Triple> {
            v.iter().map(|c| options.tone_mapper.display(c.map(|v| v * libm::exp2(exposure)))).collect()
        };
        let map = viewer.compare(&display(&a), &display(&b), width, height);
        worst.iter_mut().zip(map).for_each(|(w, v)| *w = v.max(*w));
    }
    Ok(FlipHdr { flip: Flip::from_map(width, height, &worst)?, exposures })
}

/// The mean of [`flip_hdr`] inside a mask (the exposures still come from the whole reference). Errors as
/// [`flip_hdr`], and for a mask of another size or without coverage.
pub fn flip_hdr_masked(
    reference: &Image,
    test: &Image,
    mask: &Mask,
    options: FlipHdrOptions,
) -> Result<f64, MetricError> {
    flip_hdr(reference, test, options)?.flip.mean_over(mask)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_reach_nearly_white_where_they_say() {
        for tone_mapper in [FlipToneMapper::Aces, FlipToneMapper::Hable, FlipToneMapper::Reinhard] {
            assert!((tone_mapper.curve(tone_mapper.nearly_white()) - NEARLY_WHITE).abs() < 1e-12);
            assert!(tone_mapper.curve(0.0).abs() < 1e-15);
            assert!((tone_mapper.curve(1.0 + 1e-12) - tone_mapper.curve(1.0)).abs() < 1e-9);
            let white = tone_mapper.display([1e300; 3]);
            assert!(white.iter().all(|v| *v > 0.99), "{tone_mapper:?} {white:?}");
        }
    }

    /// [eq:flip-exposures]
    #[test]
    fn exposures_of_simple_images() {
        let flat = Image::filled(3, 3, 3, 1.0);
        let e = flip_exposures(&flat, FlipToneMapper::Aces).unwrap();
        assert!((e.start - 1.083_297_2).abs() < 1e-6 && e.start == e.stop && e.count == 2);
        // Mostly black: the median is 2^-23, hence exactly 23 stops.
        let mut spot = Image::new(5, 1, 3);
        spot.pixel_mut(2, 0).fill(1.0);
        let e = flip_exposures(&spot, FlipToneMapper::Aces).unwrap();
        assert_eq!(e.count, 23);
        assert!((e.stop - 24.083_297).abs() < 1e-5);
        assert_eq!(flip_exposures(&Image::new(2, 2, 3), FlipToneMapper::Aces), Err(MetricError::BlackReference));
    }

    #[test]
    fn exposures_are_checked() {
        let image = Image::filled(2, 2, 3, 1.0);
        for (start, stop, count) in [(1.0, 0.0, 2), (f64::NAN, 0.0, 2), (0.0, f64::INFINITY, 2), (0.0, 1.0, 0)] {
            let exposures = Some(FlipExposures { start, stop, count });
            let options = FlipHdrOptions { exposures, ..Default::default() };
            assert!(matches!(flip_hdr(&image, &image, options), Err(MetricError::Parameter { .. })));
        }
    }
}
