//! Pictures larger and smaller, by reshaping and by matrices: candle's resizing loses or overwrites gradients.
use crate::error::{DiffusionError, Result};
use candle_core::{DType, Device, Tensor};

/// Each pixel of (batch, channels, height, width) becomes `factor` × `factor` pixels.
pub fn upsample_nearest(x: &Tensor, factor: usize) -> Result<Tensor> {
    let (batch, channels, height, width) = x.dims4()?;
    let wide = x.reshape((batch, channels, height, 1, width, 1))?;
    let wide = wide.broadcast_as((batch, channels, height, factor, width, factor))?.contiguous()?;
    Ok(wide.reshape((batch, channels, height * factor, width * factor))?)
}

/// Blocks of `n` × `n` pixels become channels: (batch, c, h, w) → (batch, c·n², h/n, w/n), channel c·n² + y·n + x.
pub fn space_to_depth(x: &Tensor, n: usize) -> Result<Tensor> {
    let (batch, channels, height, width) = x.dims4()?;
    if n == 0 || !height.is_multiple_of(n) || !width.is_multiple_of(n) {
        let expected = format!("sides that are multiples of {n}");
        return Err(DiffusionError::shape("picture for blocks of pixels", expected, x.dims()));
    }
    let blocks = x.reshape(vec![batch, channels, height / n, n, width / n, n])?.permute(vec![0, 1, 3, 5, 2, 4])?;
    Ok(blocks.contiguous()?.reshape((batch, channels * n * n, height / n, width / n))?)
}

/// The inverse of [`space_to_depth`].
pub fn depth_to_space(x: &Tensor, n: usize) -> Result<Tensor> {
    let (batch, channels, height, width) = x.dims4()?;
    if n == 0 || !channels.is_multiple_of(n * n) {
        let expected = format!("a multiple of {} channels", n * n);
        return Err(DiffusionError::shape("blocks of pixels", expected, x.dims()));
    }
    let c = channels / (n * n);
    let blocks = x.reshape(vec![batch, c, n, n, height, width])?.permute(vec![0, 1, 4, 2, 5, 3])?;
    Ok(blocks.contiguous()?.reshape((batch, c, height * n, width * n))?)
}

/// Weights of `from` samples in each of `to` samples, row-major (to, from).
///
/// With aligned corners the first and last samples coincide; without, the samples are centres of intervals that cover the same
/// length, and what lies outside the first and last centre takes their value.
fn interpolation(from: usize, to: usize, align_corners: bool) -> Vec<f64> {
    let mut weights = vec![0.0; from * to];
    for i in 0..to {
        let position = if align_corners {
            if to > 1 { i as f64 * (from - 1) as f64 / (to - 1) as f64 } else { 0.0 }
        } else {
            ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).clamp(0.0, (from - 1) as f64)
        };
        let low = (position as usize).min(from - 1);
        let high = (low + 1).min(from - 1);
        let fraction = position - low as f64;
        weights[i * from + low] += 1.0 - fraction;
        weights[i * from + high] += fraction;
    }
    weights
}

/// (batch, channels, height, width) to another size, bilinear, without a filter where it gets smaller (as PyTorch's
/// `interpolate`).
/// `[eq:bilinear-resize]`
pub fn resize_bilinear(x: &Tensor, height: usize, width: usize, align_corners: bool) -> Result<Tensor> {
    let (batch, channels, from_height, from_width) = x.dims4()?;
    if [height, width, from_height, from_width].contains(&0) {
        return Err(DiffusionError::shape("resized picture", "sides of at least 1", [height, width]));
    }
    if (height, width) == (from_height, from_width) {
        return Ok(x.clone());
    }
    let matrix = |from: usize, to: usize| -> Result<Tensor> {
        let weights = Tensor::from_vec(interpolation(from, to, align_corners), (to, from), &Device::Cpu)?;
        Ok(weights.to_dtype(if x.dtype() == DType::F64 { DType::F64 } else { DType::F32 })?.to_device(x.device())?)
    };
    let rows = x.contiguous()?.reshape((batch * channels * from_height, from_width))?;
    let wide = rows.matmul(&matrix(from_width, width)?.t()?)?;
    let columns = wide.reshape((batch * channels, from_height, width))?.transpose(1, 2)?.contiguous()?;
    let columns = columns.reshape((batch * channels * width, from_height))?;
    let tall = columns.matmul(&matrix(from_height, height)?.t()?)?.reshape((batch * channels, width, height))?;
    Ok(tall.transpose(1, 2)?.contiguous()?.reshape((batch, channels, height, width))?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradient_check::{check, variable};

    fn values(x: &Tensor) -> Vec<f64> {
        x.flatten_all().unwrap().to_vec1().unwrap()
    }

    #[test]
    fn gradients() {
        let x = variable("x", &[2, 4, 4, 6]);
        check("nearest", &[&x], || Ok(upsample_nearest(&x, 2).unwrap()));
        // A picture that is used twice: candle's own loses one of the two gradients.
        let twice = || upsample_nearest(&x, 2).unwrap().sum_all()?.broadcast_mul(x.as_tensor());
        check("nearest and more", &[&x], twice);
        check("to depth", &[&x], || Ok(space_to_depth(&x, 2).unwrap()));
        check("to space", &[&x], || Ok(depth_to_space(&x, 2).unwrap()));
        for align_corners in [false, true] {
            check("bilinear", &[&x], || Ok(resize_bilinear(&x, 7, 5, align_corners).unwrap()));
        }
    }

    #[test]
    fn blocks_go_there_and_back() {
        let x = variable("x", &[2, 3, 4, 6]);
        let there = space_to_depth(&x, 2).unwrap();
        assert_eq!(there.dims(), [2, 12, 2, 3]);
        assert_eq!(values(&depth_to_space(&there, 2).unwrap()), values(&x));
        // Channel 1, row 1 of its block, column 0: pixel (2·x, 2·y + 1) of channel 1.
        let (a, b) = (there.to_vec3_at(0), x.to_vec3_at(0));
        assert_eq!(a[4 + 2][1][2], b[1][3][4]);
        assert!(space_to_depth(&x, 4).is_err() && depth_to_space(&x, 2).is_err());
    }

    trait At {
        fn to_vec3_at(&self, batch: usize) -> Vec<Vec<Vec<f64>>>;
    }

    impl At for Tensor {
        fn to_vec3_at(&self, batch: usize) -> Vec<Vec<Vec<f64>>> {
            self.get(batch).unwrap().to_vec3().unwrap()
        }
    }

    /// [eq:bilinear-resize]: a ramp stays a ramp; values by hand at both kinds of corner.
    #[test]
    fn resizing_has_the_values_by_hand() {
        let x = Tensor::new(&[[[[0.0f64, 1.0, 2.0], [3.0, 4.0, 5.0]]]], &Device::Cpu).unwrap();
        let aligned = values(&resize_bilinear(&x, 3, 5, true).unwrap());
        let by_hand: Vec<f64> = (0..15).map(|i| (i % 5) as f64 * 0.5 + (i / 5) as f64 * 1.5).collect();
        assert!(aligned.iter().zip(&by_hand).all(|(a, b)| (a - b).abs() < 1e-12), "{aligned:?}");
        let centred = values(&resize_bilinear(&x, 2, 6, false).unwrap());
        assert_eq!(centred[..6], [0.0, 0.25, 0.75, 1.25, 1.75, 2.0]);
        assert_eq!(values(&upsample_nearest(&x, 2).unwrap())[..6], [0.0, 0.0, 1.0, 1.0, 2.0, 2.0]);
    }
}
