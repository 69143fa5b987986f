//! Structural similarity: value, map and gradient.
//!
//! Per channel and pixel, with means, variances and covariance under an 11×11 Gaussian window of σ 1.5:
//! SSIM = (2 μa μb + C1)(2 σab + C2) / ((μa² + μb² + C1)(σa² + σb² + C2)), C1 = 1e-4, C2 = 9e-4, for values in [0, 1].
//! Variances are biased (the window's weights are the only ones). The mean is over all evaluated values of all channels.
use diamond_image::{Image, Mask};

use crate::MetricError;
use crate::error::{expect_comparable, expect_finite, expect_mask};
use crate::masked::mean_over;
use crate::ssim_rows::{Cotangent, Pair, RADIUS, Rows, TAPS, Wanted, rows};

const NAMES: [&str; 3] = ["SSIM", "SSIM: first image", "SSIM: second image"];

/// What happens to windows that reach over the image's edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SsimWindow {
    /// The image is continued by zeros and every pixel counts: the convention of Gaussian-splatting papers, and the
    /// one to train with. Works for any size. The zeros are part of the statistics, so a constant image has a
    /// variance near its edge.
    #[default]
    ZeroPadded,
    /// Only pixels whose window lies inside count: the 5-pixel border is left out, as in scikit-image with
    /// `gaussian_weights=True`. Needs at least 11×11 pixels.
    Valid,
}

impl SsimWindow {
    /// Width in pixels of the border that is left out.
    pub fn border(self) -> usize {
        match self {
            SsimWindow::ZeroPadded => 0,
            SsimWindow::Valid => RADIUS,
        }
    }
}

/// Structural similarity of two images.
#[derive(Debug, Clone, PartialEq)]
pub struct Ssim {
    /// Mean over all pixels of `map` and all channels, accumulated in f64; in `[−1, 1]`, 1 for identical images.
    pub mean: f64,
    /// SSIM at each pixel and channel: `(width − 2·border) × (height − 2·border) × channels`.
    pub map: Image,
    /// Width in pixels of the border that `map` lacks on every side: 0 or 5.
    pub border: usize,
}

impl Ssim {
    /// Mean inside a mask of the original images' size, weighted by coverage; the part of the mask in the border that
    /// the map lacks does not count. Errors: another size, a mask that covers nothing.
    pub fn mean_over(&self, mask: &Mask) -> Result<f64, MetricError> {
        let expected = (self.map.width() + 2 * self.border, self.map.height() + 2 * self.border);
        if (mask.width(), mask.height()) != expected {
            return Err(MetricError::Shape {
                what: "SSIM: mask",
                expected: format!("{}×{}", expected.0, expected.1),
                found: format!("{}×{}", mask.width(), mask.height()),
            });
        }
        mean_over(&self.map, mask, self.border, "SSIM")
    }
}

/// Gradient with respect to both images, each of the images' shape.
#[derive(Debug, Clone, PartialEq)]
pub struct SsimGrad {
    /// Gradient with respect to the first image.
    pub a: Image,
    /// Gradient with respect to the second image.
    pub b: Image,
}

/// Pulls a cotangent of [`ssim`] back to the images. Holds no maps: it makes one more pass over the borrowed images.
#[derive(Debug, Clone, Copy)]
pub struct SsimPullback<'a> {
    a: &'a Image,
    b: &'a Image,
    window: SsimWindow,
}

fn pair<'a>(a: &'a Image, b: &'a Image, window: SsimWindow) -> Pair<'a> {
    let (width, height, channels) = a.shape();
    Pair { a: a.data(), b: b.data(), width, height, channels, border: window.border() }
}

/// Number of values that the mean is over.
fn count(a: &Image, window: SsimWindow) -> f64 {
    let less = 2 * window.border();
    ((a.width() - less) * (a.height() - less) * a.channels()) as f64
}

fn check(a: &Image, b: &Image, window: SsimWindow) -> Result<(), MetricError> {
    expect_comparable(a, b, NAMES)?;
    if window == SsimWindow::Valid && a.width().min(a.height()) < TAPS {
        let found = format!("{}×{}", a.width(), a.height());
        return Err(MetricError::TooSmall { what: "SSIM", least: TAPS, found });
    }
    Ok(())
}

fn mean_of(rows: &Rows, a: &Image, window: SsimWindow) -> f64 {
    rows.sums.iter().sum::<f64>() / count(a, window)
}

/// The rows and columns of `data` (the shape of `like`) without the border.
fn without_border(data: Vec<f32>, like: &Image, border: usize) -> Result<Image, MetricError> {
    let (width, height, channels) = like.shape();
    if border == 0 {
        return Ok(Image::from_vec(width, height, channels, data)?);
    }
    let mut kept = Vec::with_capacity((width - 2 * border) * (height - 2 * border) * channels);
    for row in data.chunks(width * channels).take(height - border).skip(border) {
        kept.extend_from_slice(&row[border * channels..(width - border) * channels]);
    }
    Ok(Image::from_vec(width - 2 * border, height - 2 * border, channels, kept)?)
}

/// `[eq:ssim]` Structural similarity of two images of equal shape and any number of channels, values nominally in
/// `[0, 1]`, with the pullback. Symmetric in the images; at most 1, and 1 exactly for identical images.
///
/// Errors: unequal shapes, no pixels, NaN or infinity, fewer than 11×11 pixels with [`SsimWindow::Valid`].
///
/// ```
/// # use diamond_image::Image;
/// # use diamond_metrics::{ssim, SsimWindow};
/// let (a, b) = (Image::filled(16, 16, 3, 0.5), Image::filled(16, 16, 3, 0.4));
/// let (similarity, pullback) = ssim(&a, &b, SsimWindow::ZeroPadded)?;
/// let gradient = pullback.pull_mean(1.0);
/// assert!(similarity.mean < 1.0 && gradient.a.shape() == a.shape());
/// # Ok::<(), diamond_metrics::MetricError>(())
/// ```
pub fn ssim<'a>(a: &'a Image, b: &'a Image, window: SsimWindow) -> Result<(Ssim, SsimPullback<'a>), MetricError> {
    check(a, b, window)?;
    let rows = rows(pair(a, b, window), Wanted { map: true, gradient: None, both: false });
    let mean = mean_of(&rows, a, window);
    let map = without_border(rows.map, a, window.border())?;
    Ok((Ssim { mean, map, border: window.border() }, SsimPullback { a, b, window }))
}

impl SsimPullback<'_> {
    fn pull(&self, cotangent: Cotangent<'_>) -> SsimGrad {
        let wanted = Wanted { map: false, gradient: Some(cotangent), both: true };
        let rows = rows(pair(self.a, self.b, self.window), wanted);
        let (mut a, mut b) = (self.a.clone(), self.b.clone());
        a.data_mut().copy_from_slice(&rows.d_a);
        b.data_mut().copy_from_slice(&rows.d_b);
        SsimGrad { a, b }
    }

    /// `d_mean`, the cotangent of [`Ssim::mean`], to gradients of both images.
    pub fn pull_mean(&self, d_mean: f32) -> SsimGrad {
        self.pull(Cotangent::Uniform(d_mean as f64 / count(self.a, self.window)))
    }

    /// `d_map`, the cotangent of [`Ssim::map`] (its shape), to gradients of both images. Errors: another shape, NaN
    /// or infinity.
    pub fn pull_map(&self, d_map: &Image) -> Result<SsimGrad, MetricError> {
        let (width, height, channels) = self.a.shape();
        let border = self.window.border();
        d_map.expect_shape((width - 2 * border, height - 2 * border, channels), "SSIM: cotangent of the map")?;
        expect_finite(d_map, "SSIM: cotangent of the map")?;
        if border == 0 {
            return Ok(self.pull(Cotangent::Map(d_map.data())));
        }
        let mut full = vec![0.0; width * height * channels];
        for (y, row) in d_map.data().chunks(d_map.width() * channels).enumerate() {
            let at = ((y + border) * width + border) * channels;
            full[at..at + row.len()].copy_from_slice(row);
        }
        Ok(self.pull(Cotangent::Map(&full)))
    }
}

/// The mean of [`ssim`] without its map. Errors as [`ssim`].
pub fn ssim_mean(a: &Image, b: &Image, window: SsimWindow) -> Result<f64, MetricError> {
    check(a, b, window)?;
    Ok(mean_of(&rows(pair(a, b, window), Wanted { map: false, gradient: None, both: false }), a, window))
}

/// The mean of [`ssim`] and its gradient with respect to the first image (its shape), in one fused pass that holds a
/// few rows: what a training step calls. Errors as [`ssim`].
pub fn ssim_mean_and_grad(a: &Image, b: &Image, window: SsimWindow) -> Result<(f64, Image), MetricError> {
    check(a, b, window)?;
    let cotangent = Cotangent::Uniform(1.0 / count(a, window));
    let rows = rows(pair(a, b, window), Wanted { map: false, gradient: Some(cotangent), both: false });
    let mean = mean_of(&rows, a, window);
    let (width, height, channels) = a.shape();
    Ok((mean, Image::from_vec(width, height, channels, rows.d_a)?))
}

/// Σ w·SSIM / count over all values of all channels with a weight `weights` for each pixel (one channel), the sum of w over the same count, and the gradient of the
/// first with respect to the first image (its shape): one fused pass, for images of which parts are believed more than others. `count` is the number of
/// values, not the sum of weights, so that what has little weight everywhere counts little. Zero-padded windows. Errors as [`ssim`], and for weights of
/// another size or not finite.
pub fn ssim_weighted_and_grad(a: &Image, b: &Image, weights: &Image) -> Result<(f64, f64, Image), MetricError> {
    let window = SsimWindow::ZeroPadded;
    check(a, b, window)?;
    let (width, height, channels) = a.shape();
    weights.expect_shape((width, height, 1), "SSIM: weights")?;
    expect_finite(weights, "SSIM: weights")?;
    let scale = 1.0 / count(a, window);
    let spread: Vec<f32> =
        weights.data().iter().flat_map(|w| std::iter::repeat_n((f64::from(*w) * scale) as f32, channels)).collect();
    let wanted = Wanted { map: true, gradient: Some(Cotangent::Map(&spread)), both: false };
    let rows = rows(pair(a, b, window), wanted);
    let each = rows.map.chunks_exact(channels.max(1)).zip(weights.data());
    let sum: f64 = each.map(|(s, w)| f64::from(*w) * s.iter().map(|s| f64::from(*s)).sum::<f64>()).sum();
    let whole = weights.data().iter().map(|w| f64::from(*w)).sum::<f64>() * channels as f64;
    Ok((sum * scale, whole * scale, Image::from_vec(width, height, channels, rows.d_a)?))
}

/// Mean of the SSIM map inside a mask (same width and height), weighted by coverage. The windows themselves are not
/// masked: a pixel's neighbours outside the mask take part in its statistics. Errors as [`ssim`], and for a mask of
/// another size or without coverage.
pub fn ssim_masked(a: &Image, b: &Image, mask: &Mask, window: SsimWindow) -> Result<f64, MetricError> {
    check(a, b, window)?;
    expect_mask(a, mask, "SSIM: mask")?;
    ssim(a, b, window)?.0.mean_over(mask)
}
