//! Bilinear sampling and its pullback.
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

impl Image {
    fn taps(&self, x: f32, y: f32) -> Taps {
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
        Taps { x0, x1, y0, y1, fx, fy, moves_x, moves_y }
    }

    /// Bilinear interpolation at pixel coordinates `(x, y)` (centres at +0.5), written to `out` (one value per
    /// channel). Outside the outermost pixel centres the border value continues. The image must not be empty.
    pub fn sample(&self, x: f32, y: f32, out: &mut [f32]) {
        let t = self.taps(x, y);
        let (a, b) = (self.pixel(t.x0, t.y0), self.pixel(t.x1, t.y0));
        let (c, d) = (self.pixel(t.x0, t.y1), self.pixel(t.x1, t.y1));
        for k in 0..self.channels() {
            let top = a[k] + t.fx * (b[k] - a[k]);
            let bottom = c[k] + t.fx * (d[k] - c[k]);
            out[k] = top + t.fy * (bottom - top);
        }
    }

    /// Pullback of [`Image::sample`]: adds the cotangent `d_out` into `d_image` (same shape as `self`) and returns
    /// `(d_x, d_y)`, which are 0 where the sample is clamped at the border.
    pub fn sample_pull(&self, x: f32, y: f32, d_out: &[f32], d_image: &mut Image) -> (f32, f32) {
        let t = self.taps(x, y);
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
