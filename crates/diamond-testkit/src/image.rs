//! Oracles of image sampling, resizing and colour transfer.
use crate::Real;

/// Bilinear sample of a row-major interleaved image at `(x, y)` (pixel centres at +0.5, border clamped), as the sum
/// over all pixels of their value times a tent of width 1 around their centre.
pub fn bilinear<R: Real>(image: &[R], width: usize, height: usize, channels: usize, x: R, y: R) -> Vec<R> {
    let half = R::of(0.5);
    let x = (x - half).max(R::of(0.0)).min(R::of((width - 1) as f64));
    let y = (y - half).max(R::of(0.0)).min(R::of((height - 1) as f64));
    let tent = |at: R, i: usize| (R::of(1.0) - (at - R::of(i as f64)).abs()).max(R::of(0.0));
    let mut out = vec![R::of(0.0); channels];
    for j in 0..height {
        for i in 0..width {
            for (c, out) in out.iter_mut().enumerate() {
                *out += tent(x, i) * tent(y, j) * image[(j * width + i) * channels + c];
            }
        }
    }
    out
}

/// sRGB (IEC 61966-2-1) stored value in `[0, ∞)` → linear.
pub fn srgb_decode<R: Real>(stored: R) -> R {
    if stored.value() <= 0.04045 { stored / R::of(12.92) } else { ((stored + R::of(0.055)) / R::of(1.055)).powf(2.4) }
}

/// Linear value in `[0, ∞)` → sRGB stored value.
pub fn srgb_encode<R: Real>(linear: R) -> R {
    if linear.value() <= 0.003_130_8 {
        linear * R::of(12.92)
    } else {
        R::of(1.055) * linear.powf(1.0 / 2.4) - R::of(0.055)
    }
}

/// One-channel area resize by brute force: each output pixel is the mean over a `n × n` grid of points inside it,
/// each point with the value of the input pixel it falls in. Exact where `n·width_out` is a multiple of the input's.
pub fn resize_area(image: &[f64], width: usize, height: usize, to: (usize, usize), n: usize) -> Vec<f64> {
    let mut out = Vec::with_capacity(to.0 * to.1);
    for y in 0..to.1 {
        for x in 0..to.0 {
            let mut sum = 0.0;
            for k in 0..n * n {
                let column = ((x * n + k % n) * 2 + 1) * width / (2 * n * to.0);
                let row = ((y * n + k / n) * 2 + 1) * height / (2 * n * to.1);
                sum += image[row * width + column];
            }
            out.push(sum / (n * n) as f64);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bilinear_worked_by_hand() {
        let image = [0.0, 1.0, 2.0, 4.0];
        assert_eq!(bilinear(&image, 2, 2, 1, 1.0, 1.0), vec![1.75]);
        assert_eq!(bilinear(&image, 2, 2, 1, -3.0, 9.0), vec![2.0]);
        assert_eq!(bilinear(&image, 2, 2, 1, 1.5, 0.5), vec![1.0]);
    }

    #[test]
    fn srgb_middle_grey() {
        assert!((srgb_decode(0.5) - 0.214_041_140_482_232_6).abs() < 1e-12);
        assert!((srgb_encode(0.18) - 0.461_356_129_500_441_64).abs() < 1e-12);
    }

    #[test]
    fn area_resize_worked_by_hand() {
        // Three columns to two: ⅔ of the first with ⅓ of the second.
        let out = resize_area(&[3.0, 6.0, 9.0], 3, 1, (2, 1), 6);
        assert_eq!(out, vec![4.0, 8.0]);
    }
}
