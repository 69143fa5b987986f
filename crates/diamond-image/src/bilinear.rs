//! Bilinear sampling and its pullback.
//!
//! An image of values at pixel centres (x + ½, y + ½) becomes a continuous function: linear between neighbouring centres
//! along each axis, constant outside the outermost ones.
//!
//! ```
//! use diamond_image::Image;
//! let image = Image::from_vec(2, 1, 1, vec![1.0, 3.0])?;
//! let mut value = [0.0];
//! image.sample(1.0, 0.5, &mut value); // halfway between the two centres
//! assert_eq!(value, [2.0]);
//! let mut d_image = Image::new(2, 1, 1);
//! let (d_x, _) = image.sample_pull(1.0, 0.5, &[1.0], &mut d_image);
//! assert_eq!((d_x, d_image.data()), (2.0, &[0.5, 0.5][..]));
//! # Ok::<(), diamond_image::ImageError>(())
//! ```
use crate::Image;

/// The four taps of one sample: pixel columns and rows, and the fractions between them.
struct Taps {
    x0: usize,
    x1: usize,
    y0: usize,
    y1: usize,
    fx: f32,
    fy: f32,
    /// 1 where the sample moves with x (y), 0 where it is clamped at the border.
    moves_x: f32,
    moves_y: f32,
}

/// One of the four pixels that a bilinear sample is made of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tap {
    /// Index of the pixel, row · width + column.
    pub index: usize,
    /// Its share of the sample, in [0, 1]; the four add up to 1.
    pub weight: f32,
    /// Derivative of the share along x, 1/pixel; the four add up to 0, and are 0 where the sample is clamped at the border.
    pub d_x: f32,
    /// The same along y.
    pub d_y: f32,
}

impl Image {
    /// The pixels of [`Image::sample`] with their shares, for samples of something other than the stored values: the sample
    /// is Σ weight · value. At the border a pixel may occur twice. `None` for an image without pixels.
    /// `[eq:bilinear]`
    pub fn bilinear_taps(&self, x: f32, y: f32) -> Option<[Tap; 4]> {
        let t = self.taps(x, y)?;
        let tap = |x: usize, y: usize, right: bool, below: bool| {
            let (wx, sx) = if right { (t.fx, t.moves_x) } else { (1.0 - t.fx, -t.moves_x) };
            let (wy, sy) = if below { (t.fy, t.moves_y) } else { (1.0 - t.fy, -t.moves_y) };
            Tap { index: y * self.width() + x, weight: wx * wy, d_x: sx * wy, d_y: wx * sy }
        };
        Some([
            tap(t.x0, t.y0, false, false),
            tap(t.x1, t.y0, true, false),
            tap(t.x0, t.y1, false, true),
            tap(t.x1, t.y1, true, true),
        ])
    }

    /// `None` for an image without pixels. NaN coordinates count as 0.
    fn taps(&self, x: f32, y: f32) -> Option<Taps> {
        if self.pixels() == 0 {
            return None;
        }
        let axis = |v: f32, n: usize| -> (usize, usize, f32, f32) {
            let u = v - 0.5;
            let last = (n - 1) as f32;
            let clamped = if u.is_nan() { 0.0 } else { u.clamp(0.0, last) };
            let i = (clamped.floor() as usize).min(n.saturating_sub(2));
            let moves = if u >= 0.0 && u <= last && n > 1 { 1.0 } else { 0.0 };
            (i, (i + 1).min(n - 1), clamped - i as f32, moves)
        };
        let (x0, x1, fx, moves_x) = axis(x, self.width());
        let (y0, y1, fy, moves_y) = axis(y, self.height());
        Some(Taps { x0, x1, y0, y1, fx, fy, moves_x, moves_y })
    }

    /// Bilinear interpolation at pixel coordinates `(x, y)` (centres at +0.5), written to `out` (one value per
    /// channel, so at least [`Image::channels`] long). Outside the outermost pixel centres the border value continues, as
    /// far as any finite or infinite coordinate; NaN coordinates count as 0. An image without pixels gives 0.
    /// `[eq:bilinear]`
    pub fn sample(&self, x: f32, y: f32, out: &mut [f32]) {
        let Some(t) = self.taps(x, y) else {
            out.fill(0.0);
            return;
        };
        let (a, b) = (self.pixel(t.x0, t.y0), self.pixel(t.x1, t.y0));
        let (c, d) = (self.pixel(t.x0, t.y1), self.pixel(t.x1, t.y1));
        for k in 0..self.channels() {
            let top = a[k] + t.fx * (b[k] - a[k]);
            let bottom = c[k] + t.fx * (d[k] - c[k]);
            out[k] = top + t.fy * (bottom - top);
        }
    }

    /// Pullback of [`Image::sample`]: adds the cotangent `d_out` into `d_image` (same shape as `self`) and returns
    /// `(d_x, d_y)`, which are 0 where the sample is clamped at the border. At a pixel centre, where the derivative jumps,
    /// it is the one toward larger coordinates (at the last centre, toward smaller). An image without pixels gives
    /// `(0, 0)`. `d_out` is at least [`Image::channels`] long.
    /// `[eq:bilinear]`
    pub fn sample_pull(&self, x: f32, y: f32, d_out: &[f32], d_image: &mut Image) -> (f32, f32) {
        debug_assert_eq!(self.shape(), d_image.shape(), "sample_pull: d_image must have the image's shape");
        let Some(t) = self.taps(x, y) else {
            return (0.0, 0.0);
        };
        let (mut d_x, mut d_y) = (0.0, 0.0);
        for k in 0..self.channels() {
            let g = d_out[k];
            let (a, b) = (self.pixel(t.x0, t.y0)[k], self.pixel(t.x1, t.y0)[k]);
            let (c, d) = (self.pixel(t.x0, t.y1)[k], self.pixel(t.x1, t.y1)[k]);
            d_x += g * ((b - a) * (1.0 - t.fy) + (d - c) * t.fy);
            d_y += g * ((c - a) * (1.0 - t.fx) + (d - b) * t.fx);
            d_image.pixel_mut(t.x0, t.y0)[k] += g * (1.0 - t.fx) * (1.0 - t.fy);
            d_image.pixel_mut(t.x1, t.y0)[k] += g * t.fx * (1.0 - t.fy);
            d_image.pixel_mut(t.x0, t.y1)[k] += g * (1.0 - t.fx) * t.fy;
            d_image.pixel_mut(t.x1, t.y1)[k] += g * t.fx * t.fy;
        }
        (d_x * t.moves_x, d_y * t.moves_y)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::adjoint::{adjoint_gap, relative_l2};
    use diamond_testkit::image::bilinear;
    use diamond_testkit::strategies::{extreme, finite, values};
    use diamond_testkit::{Dual, jvp, vjp};
    use proptest::prelude::*;

    /// A small image of any shape, one pixel included.
    fn image() -> impl Strategy<Value = Image> {
        (1usize..5, 1usize..5, 1usize..4).prop_flat_map(|(w, h, c)| {
            values(w * h * c, -1.0..1.0).prop_map(move |data| Image::from_vec(w, h, c, data).unwrap())
        })
    }

    fn wide(v: &[f32]) -> Vec<f64> {
        v.iter().map(|&v| f64::from(v)).collect()
    }

    /// Away from the kinks at pixel centres by this much: dual numbers and code may choose either side of one.
    fn off_kink(v: f32) -> bool {
        let u = (v - 0.5).rem_euclid(1.0);
        (1e-3..0.999).contains(&u)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// [eq:bilinear]: value, gradient and adjoint identity, inside and beyond the border.
        #[test]
        fn sample_and_its_pullback_agree_with_the_oracle(
            image in image(), x in finite(-2.0..7.0), y in finite(-2.0..7.0), d in values(3, -1.0..1.0),
            seed in values(64, -1.0..1.0),
        ) {
            prop_assume!(off_kink(x) && off_kink(y));
            let (w, h, c) = image.shape();
            let d = &d[..c];
            // The oracle's inputs: the image, then x and y.
            let oracle = |v: &[Dual]| bilinear(&v[..w * h * c], w, h, c, v[w * h * c], v[w * h * c + 1]);
            let mut at = wide(image.data());
            at.extend([f64::from(x), f64::from(y)]);

            let mut out = vec![0.0; c];
            image.sample(x, y, &mut out);
            let expected = bilinear(&at[..w * h * c], w, h, c, f64::from(x), f64::from(y));
            prop_assert!(relative_l2(&wide(&out), &expected, 1e-2) <= 1e-4);

            let mut d_image = Image::new(w, h, c);
            let (d_x, d_y) = image.sample_pull(x, y, d, &mut d_image);
            let mut got = wide(d_image.data());
            got.extend([f64::from(d_x), f64::from(d_y)]);
            let expected = vjp(oracle, &at, &wide(d));
            let error = relative_l2(&got, &expected, 1e-2);
            prop_assert!(error <= 1e-4, "{error:e}");
            let taps = image.bilinear_taps(x, y).unwrap();
            for k in 0..c {
                let sum = |share: fn(&Tap) -> f32| -> f64 {
                    taps.iter().map(|t| f64::from(share(t)) * f64::from(image.data()[t.index * c + k])).sum()
                };
                prop_assert!((sum(|t| t.weight) - f64::from(out[k])).abs() <= 1e-6);
                let alone: Vec<f32> = (0..c).map(|i| f32::from(u8::from(i == k))).collect();
                let (d_x, d_y) = image.sample_pull(x, y, &alone, &mut Image::new(w, h, c));
                prop_assert!((sum(|t| t.d_x) - f64::from(d_x)).abs() <= 1e-5);
                prop_assert!((sum(|t| t.d_y) - f64::from(d_y)).abs() <= 1e-5);
            }
            let tangent: Vec<f64> = wide(&seed)[..at.len()].to_vec();
            prop_assert!(adjoint_gap(&wide(d), &jvp(oracle, &at, &tangent), &got, &tangent) <= 1e-4);
        }

        #[test]
        fn any_coordinates_give_a_value_of_the_image(image in image(), x in extreme(), y in extreme()) {
            let (low, high) = image.data().iter().fold((f32::MAX, f32::MIN), |(a, b), &v| (a.min(v), b.max(v)));
            for (x, y) in [(x, y), (f32::NAN, y), (x, f32::INFINITY), (f32::NEG_INFINITY, f32::NAN)] {
                let mut out = vec![0.0; image.channels()];
                image.sample(x, y, &mut out);
                prop_assert!(out.iter().all(|v| *v >= low - 1e-6 && *v <= high + 1e-6));
                let mut d_image = Image::new(image.width(), image.height(), image.channels());
                let d_out = vec![1.0; image.channels()];
                let (d_x, d_y) = image.sample_pull(x, y, &d_out, &mut d_image);
                prop_assert!(d_x.is_finite() && d_y.is_finite());
                // The weights sum to 1 wherever the sample is.
                let sum: f32 = d_image.data().iter().sum();
                prop_assert!((sum - image.channels() as f32).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn images_without_pixels_or_channels_do_not_panic() {
        for (w, h, c) in [(0, 0, 3), (0, 4, 3), (4, 0, 3), (4, 4, 0), (0, 0, 0)] {
            let image = Image::new(w, h, c);
            let mut out = [7.0; 3];
            image.sample(1.0, 1.0, &mut out[..c]);
            assert!(out[..c].iter().all(|v| *v == 0.0));
            let mut d_image = Image::new(w, h, c);
            assert_eq!(image.sample_pull(1.0, 1.0, &out[..c], &mut d_image), (0.0, 0.0));
            assert_eq!(image.first_non_finite(), None);
            assert_eq!(image.channels_range(0..c).shape(), (w, h, c));
        }
    }

    #[test]
    fn one_pixel_is_constant() {
        let image = Image::filled(1, 1, 1, 0.25);
        let mut out = [0.0];
        for x in [-1e30, 0.0, 0.5, 0.9, 1e30] {
            image.sample(x, -x, &mut out);
            assert_eq!(out, [0.25]);
            let mut d_image = Image::new(1, 1, 1);
            assert_eq!(image.sample_pull(x, -x, &[1.0], &mut d_image), (0.0, 0.0));
            assert_eq!(d_image.data(), [1.0]);
        }
    }

    /// The comparison with the oracle notices exchanged fractions and a lost tap.
    #[test]
    fn planted_errors_are_noticed() {
        let image = Image::from_vec(2, 2, 1, vec![0.0, 1.0, 2.0, 5.0]).unwrap();
        let (x, y) = (0.7, 1.2);
        let expected = bilinear(&wide(image.data()), 2, 2, 1, x, y);
        let mut out = [0.0];
        image.sample(x as f32, y as f32, &mut out);
        assert!(relative_l2(&wide(&out), &expected, 1e-2) <= 1e-6);
        image.sample(y as f32, x as f32, &mut out);
        assert!(relative_l2(&wide(&out), &expected, 1e-2) > 1e-2);
        let lost = Image::from_vec(2, 2, 1, vec![0.0, 1.0, 2.0, 0.0]).unwrap();
        lost.sample(x as f32, y as f32, &mut out);
        assert!(relative_l2(&wide(&out), &expected, 1e-2) > 1e-2);
    }
}
