//! The ellipse of one splat in the units of the blend kernels, and which blocks of pixels it meets.
//!
//! Kernels evaluate alpha as a power of two: `α = 2^(log2 o − u² − v²)` with `(u, v) = κ·Lᵀd`, `κ² = ½·log2 e`. The
//! pair `(u, v)` at a tile's centre is computed in f64, and inside a tile it is affine in small exact offsets, so its
//! error in f32 stays near 1e-7 even on long thin ellipses, where the usual `½(A dx² + C dy²) + B dx dy` loses four
//! digits by cancellation.
use crate::projection::Splat;

/// Side of a tile, pixels.
pub(crate) const TILE: usize = 8;
/// Side of a block, pixels; a tile has four blocks, numbered row by row.
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
    chol_f32: [f32; 3],
    log2_opacity: f32,
    // The ellipse σ ≤ τ, relative to the mean.
    two_tau: f32,
    extent: [f32; 2],
    /// y offset of the rightmost point.
    y_of_rightmost: f32,
    /// x of the centre line per unit of y.
    slope: f32,
    /// Half width of a row per unit of √(2τ − w₂²).
    half_width: f32,
    inv_sqrt_cov_yy: f32,
}

/// `(u, v)` at a tile's centre and its derivatives: what a kernel needs to know of one splat in one tile.
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
    /// The same with the point of reference moved by that many pixels.
    #[inline(always)]
    pub fn moved(&self, (x, y): (f32, f32)) -> Prepared {
        Prepared { u: self.u + self.u_x * x + self.u_y * y, v: self.v + self.v_y * y, ..*self }
    }
}

/// A splat as one row of tiles needs it: small, because a row's worth of them should stay in the cache.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RowSplat {
    /// u at the row's centre line is `u_base + u_slope · x`, x in px. In f64, since the two terms cancel.
    u_base: f64,
    u_slope: f64,
    v: f32,
    u_x: f32,
    u_y: f32,
    v_y: f32,
    log2_opacity: f32,
}

impl RowSplat {
    /// The values at the tile whose centre has this x (px).
    #[inline(always)]
    pub fn prepare(&self, x: f64) -> Prepared {
        Prepared {
            u: (self.u_base + self.u_slope * x) as f32,
            v: self.v,
            u_x: self.u_x,
            u_y: self.u_y,
            v_y: self.v_y,
            log2_opacity: self.log2_opacity,
        }
    }
}

impl Ellipse {
    pub fn new(s: &Splat) -> Self {
        let kappa = KAPPA2.sqrt();
        let chol = s.chol.map(|v| v * kappa);
        let [l11, l21, l22] = s.chol;
        let ex = (s.two_tau * s.cov[0]).sqrt();
        Self {
            mean: s.mean,
            chol,
            chol_f32: chol.map(|v| v as f32),
            log2_opacity: (s.opacity as f64).log2() as f32,
            two_tau: s.two_tau as f32,
            extent: s.extent,
            y_of_rightmost: (s.cov[1] / s.cov[0] * ex) as f32,
            slope: (-l21 / l11) as f32,
            half_width: (1.0 / l11) as f32,
            inv_sqrt_cov_yy: l22 as f32,
        }
    }

    /// The values for a row of tiles whose centre line is at `y` (px).
    #[inline(always)]
    pub fn in_row(&self, y: f64) -> RowSplat {
        let dy = y - self.mean[1];
        let [l11, l21, l22] = self.chol;
        let [u_x, u_y, v_y] = self.chol_f32;
        RowSplat {
            u_base: l21 * dy - l11 * self.mean[0],
            u_slope: l11,
            v: (l22 * dy) as f32,
            u_x,
            u_y,
            v_y,
            log2_opacity: self.log2_opacity,
        }
    }

    /// The exact x-interval (px) of the part of the ellipse between the lines `y0` and `y1` (px); empty (first > last)
    /// where it does not meet the band. `[eq:ellipse-band]`
    #[inline(always)]
    pub fn band(&self, y0: f64, y1: f64) -> (f32, f32) {
        let [ex, ey] = self.extent;
        let low = ((y0 - self.mean[1]) as f32).max(-ey);
        let high = ((y1 - self.mean[1]) as f32).min(ey);
        // The rightmost and the leftmost point of an ellipse's part in a band lie at the band's y nearest to theirs.
        let right_y = self.y_of_rightmost.max(low).min(high);
        let left_y = (-self.y_of_rightmost).max(low).min(high);
        let (right_w, left_w) = (right_y * self.inv_sqrt_cov_yy, left_y * self.inv_sqrt_cov_yy);
        let right = self.slope * right_y + self.half_width * (self.two_tau - right_w * right_w).max(0.0).sqrt();
        let left = self.slope * left_y - self.half_width * (self.two_tau - left_w * left_w).max(0.0).sqrt();
        let slack = INTERVAL_SLACK.0 + INTERVAL_SLACK.1 * ex;
        let x = self.mean[0] as f32;
        if low > high { (1.0, 0.0) } else { (x + left - slack, x + right + slack) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
                cov: [a, b, c],
                chol: [(c / det).sqrt(), -b / (c * det).sqrt(), 1.0 / c.sqrt()],
                two_tau: 11.0 * r(6),
                extent: [(11.0 * r(6) * a).sqrt() as f32, (11.0 * r(6) * c).sqrt() as f32],
                opacity: 0.5,
                ..Default::default()
            };
            let y0 = splat.mean[1] + 12.0 * (r(7) - 0.7);
            let y1 = y0 + 3.0;
            let (lo, hi) = Ellipse::new(&splat).band(y0, y1);
            let (mut seen_lo, mut seen_hi) = (f64::MAX, f64::MIN);
            for k in 0..=3000 {
                let dy = y0 + (y1 - y0) * k as f64 / 3000.0 - splat.mean[1];
                let inside = splat.two_tau - dy * dy / c;
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
