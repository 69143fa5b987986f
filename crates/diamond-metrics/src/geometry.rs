//! How well a shape is met in one view: the silhouettes' overlap and the mean difference of depths.
use diamond_image::{Image, Mask};

use crate::MetricError;
use crate::error::{expect_comparable, expect_mask};

/// Coverage above this shows the object.
const SHOWN: f32 = 0.5;

/// `[eq:silhouette-iou]` Intersection over union of two silhouettes, in [0, 1], 1 is best: of the pixels whose coverage exceeds ½ in either, the
/// share of those where it does in both. Symmetric.
///
/// Errors: unequal sizes; nothing is covered in either, where it is undefined.
pub fn silhouette_iou(a: &Mask, b: &Mask) -> Result<f64, MetricError> {
    expect_mask(a.as_image(), b, "silhouette IoU: second mask")?;
    let (mut both, mut either) = (0u64, 0u64);
    for (a, b) in a.data().iter().zip(b.data()) {
        both += u64::from(*a > SHOWN && *b > SHOWN);
        either += u64::from(*a > SHOWN || *b > SHOWN);
    }
    if either == 0 {
        return Err(MetricError::EmptyMask { what: "silhouette IoU" });
    }
    Ok(both as f64 / either as f64)
}

/// `[eq:depth-error]` Mean of |d − d'| over the pixels where both depth maps know something, that is hold a number above 0; in their
/// unit. What one shows and the other does not is the business of [`silhouette_iou`]. Symmetric.
///
/// Errors: unequal shapes, NaN or infinity, and no pixel known in both, where it is undefined.
pub fn depth_error(a: &Image, b: &Image) -> Result<f64, MetricError> {
    expect_comparable(a, b, ["depth error", "depth error: first map", "depth error: second map"])?;
    let (mut sum, mut count) = (0.0, 0u64);
    for (a, b) in a.data().iter().zip(b.data()).filter(|(a, b)| **a > 0.0 && **b > 0.0) {
        sum += (f64::from(*a) - f64::from(*b)).abs();
        count += 1;
    }
    if count == 0 {
        return Err(MetricError::EmptyMask { what: "depth error" });
    }
    Ok(sum / count as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square of 10 × 10 in a picture of 32 × 32, with soft borders that do not count.
    fn square(x: usize) -> Mask {
        let mut coverage = vec![0.0; 32 * 32];
        for i in 0..32 * 32 {
            let (column, row) = (i % 32, i / 32);
            let inside = (x..x + 10).contains(&column) && (8..18).contains(&row);
            let beside = (x..x + 11).contains(&column) && (8..19).contains(&row);
            coverage[i] = if inside {
                0.9
            } else if beside {
                0.5
            } else {
                0.0
            };
        }
        Mask::from_vec(32, 32, coverage).unwrap()
    }

    /// [eq:silhouette-iou] Exact for equal silhouettes, and worse by the pixels that a shift uncovers.
    #[test]
    fn overlap_falls_with_a_shift() {
        assert_eq!(silhouette_iou(&square(4), &square(4)).unwrap(), 1.0);
        for shift in 1..10 {
            let found = silhouette_iou(&square(4), &square(4 + shift)).unwrap();
            assert_eq!(found, (10 - shift) as f64 / (10 + shift) as f64, "{shift}");
        }
        assert_eq!(silhouette_iou(&square(4), &square(16)).unwrap(), 0.0);
        let nothing = Mask::from_vec(32, 32, vec![0.5; 32 * 32]).unwrap();
        assert_eq!(silhouette_iou(&square(4), &nothing).unwrap(), 0.0);
        assert!(matches!(silhouette_iou(&nothing, &nothing), Err(MetricError::EmptyMask { .. })));
        assert!(matches!(silhouette_iou(&nothing, &Mask::full(32, 31)), Err(MetricError::Shape { .. })));
    }

    /// [eq:depth-error] Exact for equal depths, and equal to a planted shift where both are known.
    #[test]
    fn depths_differ_by_a_shift() {
        let mut truth = Image::filled(8, 8, 1, 3.0);
        truth.data_mut()[..16].fill(0.0);
        assert_eq!(depth_error(&truth, &truth).unwrap(), 0.0);
        for shift in [0.25, -0.5, 1.0] {
            let mut shifted = truth.map(|z| z + shift);
            shifted.data_mut()[60..].fill(0.0);
            assert_eq!(depth_error(&truth, &shifted).unwrap(), f64::from(shift.abs()));
        }
        let none = Image::new(8, 8, 1);
        assert!(matches!(depth_error(&truth, &none), Err(MetricError::EmptyMask { .. })));
        truth.data_mut()[3] = f32::NAN;
        assert!(matches!(depth_error(&truth, &none), Err(MetricError::NonFinite { .. })));
    }
}
