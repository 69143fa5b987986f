//! A picture to draw on: rectangles, lines, discs, text, other pictures. Colours are display sRGB in `[0, 1]`.
use super::font::{GLYPH_HEIGHT, GLYPH_WIDTH, glyph};
use diamond_image::Image;

/// A display colour.
pub(super) type Colour = [f32; 3];

/// A picture being drawn. What lies outside is clipped.
pub(super) struct Canvas {
    image: Image,
}

/// Dots of the font are this many pixels wide.
pub(super) const TEXT_SCALE: usize = 2;
/// Advance from one character to the next, pixels.
pub(super) const CHAR_WIDTH: usize = (GLYPH_WIDTH + 1) * TEXT_SCALE;
/// Height of a line of text, pixels.
pub(super) const TEXT_HEIGHT: usize = GLYPH_HEIGHT * TEXT_SCALE;

impl Canvas {
    pub(super) fn new(width: usize, height: usize, background: Colour) -> Self {
        let mut canvas = Self { image: Image::new(width, height, 3) };
        canvas.fill(0, 0, width, height, background);
        canvas
    }

    pub(super) fn into_image(self) -> Image {
        self.image
    }

    /// Mixes a colour into a pixel; `alpha` 1 replaces it.
    fn blend(&mut self, x: i64, y: i64, colour: Colour, alpha: f32) {
        let (w, h) = (self.image.width() as i64, self.image.height() as i64);
        if x >= 0 && y >= 0 && x < w && y < h {
            for (v, c) in self.image.pixel_mut(x as usize, y as usize).iter_mut().zip(colour) {
                *v += alpha * (c - *v);
            }
        }
    }

    /// A filled rectangle with its upper left corner at `(x, y)`.
    pub(super) fn fill(&mut self, x: usize, y: usize, width: usize, height: usize, colour: Colour) {
        for j in 0..height {
            for i in 0..width {
                self.blend((x + i) as i64, (y + j) as i64, colour, 1.0);
            }
        }
    }

    /// Draws the set of points whose signed distance to a shape is negative, with a soft edge of one pixel, inside the
    /// square of half side `reach` round `(cx, cy)`.
    fn shape(&mut self, cx: f32, cy: f32, reach: f32, colour: Colour, distance: impl Fn(f32, f32) -> f32) {
        if !(cx.is_finite() && cy.is_finite() && reach.is_finite()) {
            return;
        }
        let (w, h) = (self.image.width() as f32, self.image.height() as f32);
        let range = |c: f32, n: f32| ((c - reach - 1.0).clamp(0.0, n) as i64, (c + reach + 2.0).clamp(0.0, n) as i64);
        let ((x0, x1), (y0, y1)) = (range(cx, w), range(cy, h));
        for y in y0..y1 {
            for x in x0..x1 {
                let coverage = (0.5 - distance(x as f32 + 0.5, y as f32 + 0.5)).clamp(0.0, 1.0);
                self.blend(x, y, colour, coverage);
            }
        }
    }

    /// A filled disc.
    pub(super) fn disc(&mut self, x: f32, y: f32, radius: f32, colour: Colour) {
        self.shape(x, y, radius, colour, |px, py| (px - x).hypot(py - y) - radius);
    }

    /// A circle's line, `thickness` pixels wide.
    pub(super) fn ring(&mut self, x: f32, y: f32, radius: f32, thickness: f32, colour: Colour) {
        let half = 0.5 * thickness;
        self.shape(x, y, radius + half, colour, |px, py| ((px - x).hypot(py - y) - radius).abs() - half);
    }

    /// A straight line, `thickness` pixels wide.
    pub(super) fn line(&mut self, from: (f32, f32), to: (f32, f32), thickness: f32, colour: Colour) {
        let (dx, dy) = (to.0 - from.0, to.1 - from.1);
        let length2 = (dx * dx + dy * dy).max(1e-6);
        let reach = 0.5 * (dx.abs().max(dy.abs()) + thickness);
        self.shape(0.5 * (from.0 + to.0), 0.5 * (from.1 + to.1), reach, colour, |px, py| {
            let t = (((px - from.0) * dx + (py - from.1) * dy) / length2).clamp(0.0, 1.0);
            (px - from.0 - t * dx).hypot(py - from.1 - t * dy) - 0.5 * thickness
        });
    }

    /// One line of text with its upper left corner at `(x, y)`; what is longer than `max_width` pixels ends in `..`.
    pub(super) fn text(&mut self, x: usize, y: usize, text: &str, max_width: usize, colour: Colour) {
        let fits = max_width / CHAR_WIDTH;
        let mut shown: Vec<char> = text.chars().collect();
        if shown.len() > fits {
            shown.truncate(fits);
            let end = shown.len();
            shown[end.saturating_sub(2)..].fill('.');
        }
        for (k, c) in shown.into_iter().enumerate() {
            for (row, bits) in glyph(c).into_iter().enumerate() {
                for column in (0..GLYPH_WIDTH).filter(|column| bits >> (GLYPH_WIDTH - 1 - column) & 1 == 1) {
                    let (px, py) = (x + k * CHAR_WIDTH + column * TEXT_SCALE, y + row * TEXT_SCALE);
                    self.fill(px, py, TEXT_SCALE, TEXT_SCALE, colour);
                }
            }
        }
    }

    /// A picture of 8-bit RGB, scaled to fit into a square of `side` pixels at `(x, y)`; each target pixel is the mean
    /// of what it covers.
    pub(super) fn thumbnail(&mut self, x: usize, y: usize, side: usize, rgb: &[u8], width: usize, height: usize) {
        let longest = width.max(height).max(1);
        let (w, h) = ((width * side / longest).max(1), (height * side / longest).max(1));
        let (left, top) = (x + (side - w.min(side)) / 2, y + (side - h.min(side)) / 2);
        for j in 0..h {
            let (y0, y1) = (j * height / h, ((j + 1) * height).div_ceil(h).min(height));
            for i in 0..w {
                let (x0, x1) = (i * width / w, ((i + 1) * width).div_ceil(w).min(width));
                let mut sum = [0u64; 3];
                for sy in y0..y1 {
                    for sx in x0..x1 {
                        for (total, c) in sum.iter_mut().zip(0..) {
                            *total += u64::from(rgb.get((sy * width + sx) * 3 + c).copied().unwrap_or(0));
                        }
                    }
                }
                let count = ((y1 - y0) * (x1 - x0)).max(1) as f32 * 255.0;
                self.blend((left + i) as i64, (top + j) as i64, sum.map(|v| v as f32 / count), 1.0);
            }
        }
    }
}
