//! A prior on base colour: an enhanced version of the photograph, in which highlights and shadows are pushed apart.
use diamond_image::{Image, Mask};

use crate::average::{Average, coverage, finite, subgradient};
use crate::error::{expect_image, expect_mask};
use crate::{ImageLoss, LossError};

/// `[eq:enhancement-target]` What one pixel g of the photograph asks of the base colour:
/// `T = w·g² + (1 − w)·(1 − (1 − g)²)` per channel, `w = σ(5·(max_c g − ½))`. Bright pixels (w → 1) are darkened by a
/// square, dark ones are lifted. g is clamped to `[0, 1]`, since the lift falls again above 1.
pub fn enhanced(g: [f32; 3]) -> [f32; 3] {
    let g = g.map(|v| if v > 0.0 { v.min(1.0) } else { 0.0 });
    let brightest = g[0].max(g[1]).max(g[2]);
    let w = 1.0 / (1.0 + libm::expf(-5.0 * (brightest - 0.5)));
    g.map(|g| w * g * g + (1.0 - w) * (1.0 - (1.0 - g) * (1.0 - g)))
}

/// `[eq:enhancement]` Mean absolute difference `mean|T − base|` of the rendered base colour and the enhanced photograph
/// (both `width × height × 3`, linear RGB), with the gradient with respect to the base colour. The photograph is a
/// constant. With a mask the mean is inside it, by `average`; an empty mask gives 0. The gradient of |·| at 0 is 0.
///
/// Errors: other shapes, NaN or infinity.
pub fn enhancement(
    base_color: &Image,
    photograph: &Image,
    mask: Option<&Mask>,
    average: Average,
) -> Result<ImageLoss, LossError> {
    let size = (base_color.width(), base_color.height());
    expect_image(base_color, size, 3, "enhancement: base colour")?;
    expect_image(photograph, size, 3, "enhancement: photograph")?;
    if let Some(mask) = mask {
        expect_mask(mask, size, "enhancement: mask")?;
    }
    let scale = average.scale(mask, base_color.pixels(), 3);
    let mut grad = Image::new(size.0, size.1, 3);
    let mut sum = 0.0f64;
    let pixels = base_color.data().chunks_exact(3).zip(photograph.data().chunks_exact(3));
    for (i, (g, (base, photo))) in grad.data_mut().chunks_exact_mut(3).zip(pixels).enumerate() {
        let m = f64::from(coverage(mask, i));
        if m == 0.0 {
            continue;
        }
        let target = enhanced([photo[0], photo[1], photo[2]]);
        for c in 0..3 {
            let d = f64::from(base[c]) - f64::from(target[c]);
            sum += m * d.abs();
            g[c] = (m * scale) as f32 * subgradient(d as f32);
        }
    }
    Ok(ImageLoss { value: finite(sum * scale), grad })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// [eq:enhancement-target] ends stay, the middle of a grey pixel stays, values above 1 count as 1.
    #[test]
    fn the_target_has_fixed_points() {
        assert_eq!(enhanced([0.0; 3]), [0.0; 3]);
        assert_eq!(enhanced([1.0; 3]), [1.0; 3]);
        assert_eq!(enhanced([9.0; 3]), [1.0; 3]);
        assert!((enhanced([0.5; 3])[0] - 0.5).abs() < 1e-7);
        assert!(enhanced([0.2; 3])[0] > 0.2 && enhanced([0.8; 3])[0] < 0.8);
    }
}
