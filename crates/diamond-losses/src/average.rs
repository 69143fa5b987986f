//! What a mean over an image is taken over.
use diamond_image::Mask;

/// The denominator of a masked mean. In both cases only pixels inside the mask contribute, weighted by coverage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Average {
    /// Divide by the mask's area: the same weight per pixel of the object however it is framed. An empty mask gives 0.
    #[default]
    Inside,
    /// Divide by the number of pixels of the image: the loss fades as the object becomes small in the image.
    AllPixels,
}

impl Average {
    /// One over the denominator for values of `channels` channels; 0 where there is nothing to average.
    pub(crate) fn scale(self, mask: Option<&Mask>, pixels: usize, channels: usize) -> f64 {
        let area = match (self, mask) {
            (Average::Inside, Some(mask)) => mask.data().iter().map(|&v| f64::from(v)).sum(),
            _ => pixels as f64,
        };
        let count = area * channels as f64;
        // Coverage below one part in 10⁻³⁰ is as good as none, and its reciprocal would overflow f32.
        if count > 1e-30 { 1.0 / count } else { 0.0 }
    }
}

/// Coverage of pixel `i`, 1 without a mask.
#[inline]
pub(crate) fn coverage(mask: Option<&Mask>, i: usize) -> f32 {
    mask.map_or(1.0, |mask| mask.data()[i])
}

/// The sign of `v`, 0 at 0 and at NaN: the subgradient of |v| that leaves an optimum alone.
#[inline]
pub(crate) fn subgradient(v: f32) -> f32 {
    if v > 0.0 {
        1.0
    } else if v < 0.0 {
        -1.0
    } else {
        0.0
    }
}

/// `v` in f32, cut to its finite range.
#[inline]
pub(crate) fn finite(v: f64) -> f32 {
    v.clamp(f64::from(f32::MIN), f64::from(f32::MAX)) as f32
}
