//! FLIP: the difference that an observer sees when alternating between two displayed images.
//!
//! After "FLIP: A Difference Evaluator for Alternating Images" (Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström,
//! Fairchild 2020). Colour pipeline: blur each opponent channel by the eye's contrast sensitivity at the given
//! distance, compare in Hunt-adjusted L*a*b* by the HyAB distance, compress. Feature pipeline: compare the strength of
//! edges and points in the achromatic channel. Combine: ΔE = ΔE_colour^(1 − ΔE_feature), in `[0, 1]`. Sums in f64.
use diamond_image::{Image, Mask};

use crate::MetricError;
use crate::error::{expect_comparable, expect_mask, expect_rgb};
use crate::flip_colour::{Primaries, Triple, achromatic, hyab, srgb_decode};
use crate::masked::mean_over;

/// Pixels per degree of visual angle at 0.7 m from a display 0.7 m wide with 3840 columns: 3840·π/180.
pub const FLIP_PIXELS_PER_DEGREE: f64 = 3840.0 * std::f64::consts::PI / 180.0;

/// Exponent that compresses colour distances.
const COLOUR_EXPONENT: f64 = 0.7;
/// Below this part of the largest colour distance the error is linear; above, it saturates …
const KNEE: f64 = 0.4;
/// … from this error on.
const KNEE_ERROR: f64 = 0.95;
/// Width of the feature detectors in degrees.
const FEATURE_DEGREES: f64 = 0.082;
/// Exponent that lifts small feature differences.
const FEATURE_EXPONENT: f64 = 0.5;
/// Contrast sensitivity of each opponent channel: a sum of Gaussians a·√(π/b)·exp(−π²·x²/b), x in degrees, as (a, b).
/// Y and Cx have one; Cz has two.
const SENSITIVITY: [&[(f64, f64)]; 3] = [&[(1.0, 0.0047)], &[(1.0, 0.0053)], &[(34.1, 0.04), (13.5, 0.025)]];
/// The widest b, from which all channels take their radius of three standard deviations.
const WIDEST: f64 = 0.04;

/// How the values of the two images relate to light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum FlipInput {
    /// sRGB-encoded, as stored in an 8-bit picture.
    #[default]
    Srgb,
    /// Linear RGB with sRGB primaries.
    Linear,
}

/// The viewing condition and the encoding.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlipOptions {
    /// Pixels per degree of visual angle, in `[1, 1000]`; default [`FLIP_PIXELS_PER_DEGREE`].
    pub pixels_per_degree: f64,
    /// What the values are.
    pub input: FlipInput,
}

impl Default for FlipOptions {
    fn default() -> Self {
        Self { pixels_per_degree: FLIP_PIXELS_PER_DEGREE, input: FlipInput::Srgb }
    }
}

/// A visible difference.
#[derive(Debug, Clone, PartialEq)]
pub struct Flip {
    /// Mean over all pixels, in `[0, 1]`; 0 for identical images.
    pub mean: f64,
    /// The difference at each pixel, in `[0, 1]`: `width × height × 1`.
    pub map: Image,
}

impl Flip {
    pub(crate) fn from_map(width: usize, height: usize, map: &[f64]) -> Result<Self, MetricError> {
        let mean = map.iter().sum::<f64>() / map.len() as f64;
        let map = Image::from_vec(width, height, 1, map.iter().map(|&v| v as f32).collect())?;
        Ok(Self { mean, map })
    }

    /// Mean inside a mask of the same width and height, weighted by coverage. Errors: another size, no coverage.
    pub fn mean_over(&self, mask: &Mask) -> Result<f64, MetricError> {
        expect_mask(&self.map, mask, "FLIP: mask")?;
        mean_over(&self.map, mask, 0, "FLIP")
    }
}

/// One channel, row-major.
type Plane = Vec<f64>;

/// Everything about a viewing condition that does not depend on the images.
pub(crate) struct Viewer {
    primaries: Primaries,
    /// Per opponent channel, the separable terms (weight, one-sided taps from the centre outward).
    sensitivity: [Vec<(f64, Vec<f64>)>; 3],
    /// Smoothing across, and first and second derivative along, a feature; from −radius to radius.
    smooth: Vec<f64>,
    edge: Vec<f64>,
    point: Vec<f64>,
    /// The largest compressed colour distance, that of green and blue.
    largest: f64,
}

impl Viewer {
    /// Errors: pixels per degree outside `[1, 1000]`.
    pub fn new(pixels_per_degree: f64) -> Result<Self, MetricError> {
        if !(1.0..=1000.0).contains(&pixels_per_degree) {
            let what = "FLIP: pixels per degree";
            return Err(MetricError::Parameter { what, expected: "a number from 1 to 1000", found: pixels_per_degree });
        }
        let pi2 = std::f64::consts::PI * std::f64::consts::PI;
        let radius = (3.0 * (WIDEST / (2.0 * pi2)).sqrt() * pixels_per_degree).ceil() as usize;
        let sensitivity = SENSITIVITY.map(|gaussians| {
            let terms: Vec<(f64, Vec<f64>)> = gaussians
                .iter()
                .map(|&(a, b)| {
                    let tap = |i: usize| libm::exp(-pi2 * (i as f64 / pixels_per_degree).powi(2) / b);
                    (a * (std::f64::consts::PI / b).sqrt(), (0..=radius).map(tap).collect())
                })
                .collect();
            let line = |taps: &[f64]| 2.0 * taps[1..].iter().sum::<f64>() + taps[0];
            let total: f64 = terms.iter().map(|(w, taps)| w * line(taps).powi(2)).sum();
            terms.into_iter().map(|(w, taps)| (w / total, taps)).collect()
        });

        let sigma = 0.5 * FEATURE_DEGREES * pixels_per_degree;
        let radius = (3.0 * sigma).ceil() as i64;
        let gaussian = |x: i64| libm::exp(-((x * x) as f64) / (2.0 * sigma * sigma));
        let smooth_sum: f64 = (-radius..=radius).map(gaussian).sum();
        // A derivative's positive taps sum to 1 and its negative ones to −1.
        let balance = |taps: Vec<f64>| {
            let positive: f64 = taps.iter().filter(|v| **v > 0.0).sum();
            let negative: f64 = -taps.iter().filter(|v| **v < 0.0).sum::<f64>();
            taps.into_iter().map(|v| if v > 0.0 { v / positive } else { v / negative }).collect()
        };
        let primaries = Primaries::srgb();
        let extremes = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|rgb| primaries.hunt_lab(rgb));
        let largest = libm::pow(hyab(extremes[0], extremes[1]), COLOUR_EXPONENT);
        Ok(Self {
            primaries,
            sensitivity,
            smooth: (-radius..=radius).map(|x| gaussian(x) / smooth_sum).collect(),
            edge: balance((-radius..=radius).map(|x| -(x as f64) * gaussian(x)).collect()),
            point: balance(
                (-radius..=radius).map(|x| ((x * x) as f64 / (sigma * sigma) - 1.0) * gaussian(x)).collect(),
            ),
            largest,
        })
    }

    /// `[eq:flip]` The difference at each pixel of two images of linear RGB in `[0, 1]`.
    pub fn compare(&self, reference: &[Triple], test: &[Triple], width: usize, height: usize) -> Vec<f64> {
        let (seen_a, luma_a) = self.see(reference, width, height);
        let (seen_b, luma_b) = self.see(test, width, height);
        let (edge_a, point_a) = self.features(&luma_a, width, height);
        let (edge_b, point_b) = self.features(&luma_b, width, height);
        (0..width * height)
            .map(|i| {
                let colour = self.compress(hyab(seen_a[i], seen_b[i]));
                let feature = (edge_a[i] - edge_b[i]).abs().max((point_a[i] - point_b[i]).abs());
                let feature = libm::pow(feature / std::f64::consts::SQRT_2, FEATURE_EXPONENT);
                libm::pow(colour, 1.0 - feature.min(1.0))
            })
            .collect()
    }

    /// The colours as the eye resolves them, in Hunt-adjusted L*a*b*, and the unblurred achromatic channel.
    fn see(&self, rgb: &[Triple], width: usize, height: usize) -> (Vec<Triple>, Plane) {
        let opponent: Vec<Triple> = rgb.iter().map(|&c| self.primaries.opponent(c)).collect();
        let blurred: [Plane; 3] = std::array::from_fn(|c| {
            let plane: Plane = opponent.iter().map(|t| t[c]).collect();
            let mut sum = vec![0.0; plane.len()];
            for (weight, half) in &self.sensitivity[c] {
                let taps: Vec<f64> = half[1..].iter().rev().chain(half).copied().collect();
                let term = filter(&filter(&plane, width, height, &taps, Axis::X), width, height, &taps, Axis::Y);
                sum.iter_mut().zip(term).for_each(|(s, t)| *s += weight * t);
            }
            sum
        });
        let seen = (0..rgb.len())
            .map(|i| {
                let rgb = self.primaries.rgb_of_opponent([blurred[0][i], blurred[1][i], blurred[2][i]]);
                self.primaries.hunt_lab(rgb.map(|v| v.clamp(0.0, 1.0)))
            })
            .collect();
        (seen, opponent.iter().map(|t| achromatic(t[0])).collect())
    }

    /// Magnitude of the edges and of the points.
    fn features(&self, luma: &Plane, width: usize, height: usize) -> (Plane, Plane) {
        let smooth_y = filter(luma, width, height, &self.smooth, Axis::Y);
        let smooth_x = filter(luma, width, height, &self.smooth, Axis::X);
        let magnitude = |taps: &[f64]| -> Plane {
            let x = filter(&smooth_y, width, height, taps, Axis::X);
            let y = filter(&smooth_x, width, height, taps, Axis::Y);
            x.iter().zip(y).map(|(x, y)| libm::hypot(*x, y)).collect()
        };
        (magnitude(&self.edge), magnitude(&self.point))
    }

    /// HyAB distance → `[0, 1]`: a power, then linear to the knee and linear above it.
    fn compress(&self, distance: f64) -> f64 {
        let v = libm::pow(distance, COLOUR_EXPONENT);
        let knee = KNEE * self.largest;
        let error = if v < knee {
            KNEE_ERROR / knee * v
        } else {
            KNEE_ERROR + (v - knee) / (self.largest - knee) * (1.0 - KNEE_ERROR)
        };
        error.min(1.0)
    }
}

/// Direction of a one-dimensional filter.
#[derive(Clone, Copy)]
enum Axis {
    X,
    Y,
}

/// Correlation with an odd number of `taps`; outside the image the border value continues.
fn filter(plane: &Plane, width: usize, height: usize, taps: &[f64], axis: Axis) -> Plane {
    let radius = taps.len() / 2;
    let mut out = vec![0.0; plane.len()];
    match axis {
        Axis::X => {
            let mut padded = vec![0.0; width + 2 * radius];
            for (row, target) in plane.chunks(width).zip(out.chunks_mut(width)) {
                padded[..radius].fill(row[0]);
                padded[radius..radius + width].copy_from_slice(row);
                padded[radius + width..].fill(row[width - 1]);
                for (k, tap) in taps.iter().enumerate() {
                    target.iter_mut().zip(&padded[k..]).for_each(|(t, v)| *t += tap * v);
                }
            }
        }
        Axis::Y => {
            for (y, target) in out.chunks_mut(width).enumerate() {
                for (k, tap) in taps.iter().enumerate() {
                    let source = (y + k).saturating_sub(radius).min(height - 1);
                    let row = &plane[source * width..(source + 1) * width];
                    target.iter_mut().zip(row).for_each(|(t, v)| *t += tap * v);
                }
            }
        }
    }
    out
}

/// `[eq:flip]` FLIP of two displayed images (`width × height × 3`, the same shape): the mean and the map. Values are
/// clamped to `[0, 1]`, since a display shows nothing else. Symmetric in the images.
///
/// Errors: unequal shapes, not three channels, no pixels, NaN or infinity, pixels per degree outside `[1, 1000]`.
pub fn flip_ldr(reference: &Image, test: &Image, options: FlipOptions) -> Result<Flip, MetricError> {
    expect_comparable(reference, test, ["FLIP", "FLIP: reference", "FLIP: test"])?;
    expect_rgb(reference, "FLIP: reference")?;
    let viewer = Viewer::new(options.pixels_per_degree)?;
    let linear = |image: &Image| -> Vec<Triple> {
        let displayed = |v: f32| {
            let v = f64::from(v).clamp(0.0, 1.0);
            if options.input == FlipInput::Srgb { srgb_decode(v) } else { v }
        };
        image.data().chunks_exact(3).map(|p| [displayed(p[0]), displayed(p[1]), displayed(p[2])]).collect()
    };
    let (width, height) = (reference.width(), reference.height());
    Flip::from_map(width, height, &viewer.compare(&linear(reference), &linear(test), width, height))
}

/// The mean of [`flip_ldr`] inside a mask. Errors as [`flip_ldr`], and for a mask of another size or without coverage.
pub fn flip_ldr_masked(reference: &Image, test: &Image, mask: &Mask, options: FlipOptions) -> Result<f64, MetricError> {
    flip_ldr(reference, test, options)?.mean_over(mask)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn filters_keep_constants_or_remove_them() {
        let viewer = Viewer::new(FLIP_PIXELS_PER_DEGREE).unwrap();
        let plane = vec![0.7; 4 * 3];
        for axis in [Axis::X, Axis::Y] {
            assert!(filter(&plane, 4, 3, &viewer.smooth, axis).iter().all(|v| (v - 0.7).abs() < 1e-12));
            assert!(filter(&plane, 4, 3, &viewer.edge, axis).iter().all(|v| v.abs() < 1e-12));
            assert!(filter(&plane, 4, 3, &viewer.point, axis).iter().all(|v| v.abs() < 1e-12));
        }
        for channel in &viewer.sensitivity {
            let total: f64 =
                channel.iter().map(|(w, half)| w * (2.0 * half[1..].iter().sum::<f64>() + half[0]).powi(2)).sum();
            assert!((total - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn the_largest_distance_compresses_to_one() {
        let viewer = Viewer::new(FLIP_PIXELS_PER_DEGREE).unwrap();
        assert!((viewer.compress(viewer.largest.powf(1.0 / COLOUR_EXPONENT)) - 1.0).abs() < 1e-12);
        assert_eq!(viewer.compress(0.0), 0.0);
        assert_eq!(viewer.compress(1e9), 1.0);
    }

    #[test]
    fn parameters_are_checked() {
        let image = Image::new(2, 2, 3);
        for pixels_per_degree in [0.0, f64::NAN, 1e9] {
            let options = FlipOptions { pixels_per_degree, ..Default::default() };
            assert!(matches!(flip_ldr(&image, &image, options), Err(MetricError::Parameter { .. })));
        }
        let grey = Image::new(2, 2, 1);
        assert!(matches!(flip_ldr(&grey, &grey, FlipOptions::default()), Err(MetricError::Shape { .. })));
    }
}
