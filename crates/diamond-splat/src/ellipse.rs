//! The ellipse of one splat in the units of the blend kernels, and which blocks of pixels it meets.
//!
//! Kernels evaluate alpha as a power of two: `α = 2^(log2 o − u² − v²)` with `(u, v) = κ·Lᵀd`, `κ² = ½·log2 e`. The
//! pair `(u, v)` at a block's centre is computed in f64, and inside a block it is affine in small exact offsets, so its
//! error in f32 stays near 1e-7 even on long thin ellipses, where the usual `½(A dx² + C dy²) + B dx dy` loses four
//! digits by cancellation.
use crate::projection::{Outline, Splat};
use diamond_simd::Simd;

/// Side of a block, pixels. Blocks are what splats are binned to: on a processor, work that no pixel needs costs more
/// than longer lists do.
pub(crate) const BLOCK: usize = 4;
/// Pixels of a block: the lanes that kernels work on.
pub(crate) const LANES: usize = BLOCK * BLOCK;

/// κ² = ½·log2 e.
pub(crate) const KAPPA2: f64 = 0.5 * std::f64::consts::LOG2_E;

/// Widening of the x-interval of a band: absolute in px and relative to the ellipse's width. Covers f32 rounding.
const INTERVAL_SLACK: (f32, f32) = (1e-3, 1e-6);

/// A splat in kernel units.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Ellipse {
    mean: [f64; 2],
    /// κ·L: `l11, l21, l22`.
    chol: [f64; 3],
    log2_opacity: f32,
}

/// `(u, v)` at a block's centre and its derivatives: what a kernel needs to know of one splat in one block.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Prepared {
    pub u: f32,
    pub v: f32,
    pub u_x: f32,
    pub u_y: f32,
    pub v_y: f32,
    pub log2_opacity: f32,
}

impl Prepared {
    /// A splat that is nowhere to be seen.
    pub const NOTHING: Prepared =
        Prepared { u: 0.0, v: 0.0, u_x: 0.0, u_y: 0.0, v_y: 0.0, log2_opacity: f32::NEG_INFINITY };
}

impl Ellipse {
    #[inline(always)]
    pub fn new(s: &Splat) -> Self {
        let kappa = KAPPA2.sqrt();
        Self { mean: s.mean, chol: s.chol.map(|v| v * kappa), log2_opacity: s.log2_opacity }
    }

    /// The values for the block whose centre is at `(x, y)` (px).
    #[inline(always)]
    pub fn prepare(&self, x: f64, y: f64) -> Prepared {
        let (dx, dy) = (x - self.mean[0], y - self.mean[1]);
        let [l11, l21, l22] = self.chol;
        Prepared {
            u: (l11 * dx + l21 * dy) as f32,
            v: (l22 * dy) as f32,
            u_x: l11 as f32,
            u_y: l21 as f32,
            v_y: l22 as f32,
            log2_opacity: self.log2_opacity,
        }
    }
}

/// Bands whose spans are computed in one call of [`band_spans`], which returns room for [`LANES`].
pub(crate) const BANDS: usize = 8;
/// At least one vector's worth.
const STEPS: [f32; LANES] = {
    let mut steps = [0.0; LANES];
    let mut k = 0;
    while k < LANES {
        steps[k] = (k * BLOCK) as f32;
        k += 1;
    }
    steps
};

/// The x-intervals (px) of the ellipse in [`BANDS`] consecutive bands of [`BLOCK`] rows of pixels, the first of which is `first`. Exact, between the outer pixel centres of a band; empty
/// (low > high) where the ellipse does not meet the band. `[eq:ellipse-band]`
#[inline(always)]
pub(crate) fn band_spans<S: Simd>(
    s: S,
    splat: &Splat,
    outline: &Outline,
    first: usize,
) -> ([f32; LANES], [f32; LANES]) {
    let [l11, l21, l22] = splat.chol;
    let [ex, ey] = splat.extent;
    let set = |v: f32| s.splat_f32s(v);
    // The ellipse σ ≤ τ relative to the mean: y of the rightmost point, x of the centre line per unit of y, half the
    // width of a row per unit of √(2τ − w₂²), w₂ = y/√cov_yy.
    let rightmost = outline.rightmost;
    let (rightmost, leftmost) = (set(rightmost), set(-rightmost));
    let (slope, half_width, inv_sqrt) = (set((-l21 / l11) as f32), set((1.0 / l11) as f32), set(l22 as f32));
    let (two_tau, zero) = (set(outline.two_tau), set(0.0));
    let slack = INTERVAL_SLACK.0 + INTERVAL_SLACK.1 * ex;
    let (x_low, x_high) = (set(splat.mean[0] as f32 - slack), set(splat.mean[0] as f32 + slack));
    let top = set(((first * BLOCK) as f64 + 0.5 - splat.mean[1]) as f32);
    let (top_limit, bottom_limit, height) = (set(-ey), set(ey), set((BLOCK - 1) as f32));
    let (never_low, never_high) = (set(f32::MAX), set(f32::MIN));
    let (mut low, mut high) = ([0.0f32; LANES], [0.0f32; LANES]);
    let (steps, _) = S::as_simd_f32s(&STEPS);
    let (lows, _) = S::as_mut_simd_f32s(&mut low);
    let (highs, _) = S::as_mut_simd_f32s(&mut high);
    for k in 0..BANDS.div_ceil(S::F32_LANES) {
        let y = s.add_f32s(top, steps[k]);
        let y0 = s.max_f32s(y, top_limit);
        let y1 = s.min_f32s(s.add_f32s(y, height), bottom_limit);
        // The rightmost and the leftmost point of an ellipse's part in a band lie at the band's y nearest to theirs.
        let right_y = s.min_f32s(s.max_f32s(rightmost, y0), y1);
        let left_y = s.min_f32s(s.max_f32s(leftmost, y0), y1);
        let (right_w, left_w) = (s.mul_f32s(right_y, inv_sqrt), s.mul_f32s(left_y, inv_sqrt));
        let right_root = s.sqrt_f32s(s.max_f32s(s.sub_f32s(two_tau, s.mul_f32s(right_w, right_w)), zero));
        let left_root = s.sqrt_f32s(s.max_f32s(s.sub_f32s(two_tau, s.mul_f32s(left_w, left_w)), zero));
        let right = s.mul_add_e_f32s(half_width, right_root, s.mul_add_e_f32s(slope, right_y, x_high));
        let left = s.sub_f32s(s.mul_add_e_f32s(slope, left_y, x_low), s.mul_f32s(half_width, left_root));
        let meets = s.less_than_or_equal_f32s(y0, y1);
        lows[k] = s.select_f32s(meets, left, never_low);
        highs[k] = s.select_f32s(meets, right, never_high);
    }
    (low, high)
}

/// The blocks (first, one past last) of `blocks` that have a pixel centre between `low` and `high` (px); empty
/// (0, 0) where there is none. A block's outer pixel centres are at 4b + 0.5 and 4b + 3.5.
#[inline(always)]
pub(crate) fn block_span(low: f32, high: f32, blocks: f32) -> (u16, u16) {
    // Conversion to integers rounds toward zero.
    let first = ((low + 0.5) * 0.25).max(0.0).min(blocks) as i32 as u16;
    let past = ((high + 3.5) * 0.25).max(0.0).min(blocks) as i32 as u16;
    if first < past { (first, past) } else { (0, 0) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_simd::Level;

    struct Band(Splat, Outline);

    impl diamond_simd::WithSimd for Band {
        type Output = ([f32; LANES], [f32; LANES]);
        #[inline(always)]
        fn with_simd<S: Simd>(self, s: S) -> Self::Output {
            band_spans(s, &self.0, &self.1, 0)
        }
    }

    /// [eq:ellipse-band]: against a brute-force walk along the ellipse's boundary.
    #[test]
    fn band_is_the_tight_interval_of_the_ellipse_in_the_band() {
        for case in 0..200u32 {
            let r = |k: u32| ((case * 7 + k) as f64 * 0.754_877_666).fract();
            let (a, c) = (0.5 + 90.0 * r(1), 0.5 + 40.0 * r(2));
            let b = (a * c).sqrt() * (1.98 * r(3) - 0.99);
            let det: f64 = a * c - b * b;
            let splat = Splat {
                mean: [64.0 * r(4), 64.0 * r(5)],
                chol: [(c / det).sqrt(), -b / (c * det).sqrt(), 1.0 / c.sqrt()],
                extent: [(11.0 * r(6) * a).sqrt() as f32, (11.0 * r(6) * c).sqrt() as f32],
                opacity: 0.5,
                ..Default::default()
            };
            let y0 = splat.mean[1] + 12.0 * (r(7) - 0.7);
            let y1 = y0 + 3.0;
            // Bands begin at multiples of the block: the splat is moved instead of the band.
            let shift = 0.5 - y0;
            let moved = Splat { mean: [splat.mean[0], splat.mean[1] + shift], ..splat };
            let two_tau = 11.0 * r(6);
            let rightmost = (b / a) as f32 * splat.extent[0];
            let outline = Outline { two_tau: two_tau as f32, rightmost, ..Default::default() };
            let (low, high) = Level::current().dispatch(Band(moved, outline));
            let (lo, hi) = (low[0], high[0]);
            let (mut seen_lo, mut seen_hi) = (f64::MAX, f64::MIN);
            for k in 0..=3000 {
                let dy = y0 + (y1 - y0) * k as f64 / 3000.0 - splat.mean[1];
                let inside = two_tau - dy * dy / c;
                if inside >= 0.0 {
                    let half = (det / c * inside).sqrt();
                    seen_lo = seen_lo.min(splat.mean[0] + b / c * dy - half);
                    seen_hi = seen_hi.max(splat.mean[0] + b / c * dy + half);
                }
            }
            if seen_lo > seen_hi {
                assert!(lo > hi || hi - lo < 3.0, "case {case}: {lo} {hi}");
                continue;
            }
            assert!(lo as f64 <= seen_lo && seen_hi <= hi as f64, "case {case}: not conservative");
            assert!(seen_lo - (lo as f64) < 0.02 && (hi as f64) - seen_hi < 0.02, "case {case}: not tight");
        }
    }
}
