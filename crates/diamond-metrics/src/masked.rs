//! The mean of an error map inside a mask, since a black background flatters every mean over all pixels.
use diamond_image::{Image, Mask};

use crate::MetricError;
use crate::error::expect_mask;

/// `Σ M·map / (channels·Σ M)` in f64. `offset` is the column and row of `mask` that the map's first pixel belongs to
/// (a map without its border is smaller than the images it came from); the mask's remaining pixels do not count.
pub(crate) fn mean_over(map: &Image, mask: &Mask, offset: usize, what: &'static str) -> Result<f64, MetricError> {
    let (mut sum, mut weight) = (0.0, 0.0);
    for y in 0..map.height() {
        for x in 0..map.width() {
            let w = mask.coverage(x + offset, y + offset) as f64;
            weight += w;
            sum += w * map.pixel(x, y).iter().map(|&v| v as f64).sum::<f64>();
        }
    }
    if weight <= 0.0 {
        return Err(MetricError::EmptyMask { what });
    }
    Ok(sum / (weight * map.channels() as f64))
}

/// Mean of `map` (any channels) inside `mask` (same width and height), weighted by coverage: `Σ M·map/(channels·Σ M)`.
/// Errors: another size, a mask that covers nothing.
pub fn masked_mean(map: &Image, mask: &Mask) -> Result<f64, MetricError> {
    expect_mask(map, mask, "masked mean: mask")?;
    mean_over(map, mask, 0, "masked mean")
}
