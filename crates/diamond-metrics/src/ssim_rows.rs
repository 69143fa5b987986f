//! The row pipeline behind SSIM: one pass down the image that holds eleven rows at a time instead of whole maps.
//!
//! Everything is written in the sum s = a + b and the difference d = a − b of the two images, which needs four blurred
//! maps (s, d, s², d²) instead of five and keeps 1 − SSIM exact for images that hardly differ. Blurring is separable:
//! each row is blurred along x once and kept in a ring of eleven; a blurred value is a weighted sum down the ring. The
//! gradient is the same pipeline once more on the partial derivatives, eleven rows later. Sums are in f64, because the
//! variance E[s²] − E[s]² of a flat bright image would lose all its digits in f32. No fused multiply-add is used, so
//! that all instruction sets give the same bits, the portable one included.
use diamond_simd::{Level, Simd, WithSimd};

/// Pixels on either side of the centre of the window.
pub(crate) const RADIUS: usize = 5;
/// Width of the window.
pub(crate) const TAPS: usize = 2 * RADIUS + 1;
/// Standard deviation of the window in pixels.
const SIGMA: f64 = 1.5;
/// Stabiliser of the luminance ratio, (0.01·peak)² with peak 1.
const C1: f64 = 1e-4;
/// Stabiliser of the contrast-structure ratio, (0.03·peak)² with peak 1.
const C2: f64 = 9e-4;

/// Half of the symmetric window, edge to centre, normalised so that the eleven taps sum to 1.
fn half_window() -> [f64; RADIUS + 1] {
    let tap = |k: usize| libm::exp(-((RADIUS - k) as f64).powi(2) / (2.0 * SIGMA * SIGMA));
    let sum: f64 = (0..RADIUS).map(|k| 2.0 * tap(k)).sum::<f64>() + tap(RADIUS);
    std::array::from_fn(|k| tap(k) / sum)
}

/// What each SSIM value counts in the scalar whose gradient is wanted.
#[derive(Clone, Copy)]
pub(crate) enum Cotangent<'a> {
    /// The same for every value.
    Uniform(f64),
    /// One per value of the images.
    Map(&'a [f32]),
}

/// Two images of equal shape, and the pixels at which SSIM is evaluated: those at least `border` from every edge.
#[derive(Clone, Copy)]
pub(crate) struct Pair<'a> {
    pub a: &'a [f32],
    pub b: &'a [f32],
    pub width: usize,
    pub height: usize,
    pub channels: usize,
    pub border: usize,
}

/// What to compute besides the sums.
#[derive(Clone, Copy)]
pub(crate) struct Wanted<'a> {
    /// The SSIM of each value.
    pub map: bool,
    /// The gradient with respect to `a`, for this cotangent.
    pub gradient: Option<Cotangent<'a>>,
    /// The gradient with respect to `b` too.
    pub both: bool,
}

/// Results for the rows of one band, row-major; empty where not wanted.
#[derive(Default)]
pub(crate) struct Rows {
    /// Σ of SSIM over each row.
    pub sums: Vec<f64>,
    /// SSIM, 0 within the border.
    pub map: Vec<f32>,
    pub d_a: Vec<f32>,
    pub d_b: Vec<f32>,
}

/// `out = Σ_k w_k·rows_k`, the taps paired from the edge inward.
#[inline(always)]
fn weigh(rows: [&[f64]; TAPS], w: &[f64; RADIUS + 1], out: &mut [f64]) {
    let n = out.len();
    let [r0, r1, r2, r3, r4, r5, r6, r7, r8, r9, r10] = rows.map(|r| &r[..n]);
    for i in 0..n {
        let edge = w[0] * (r0[i] + r10[i]) + w[1] * (r1[i] + r9[i]);
        let middle = w[2] * (r2[i] + r8[i]) + w[3] * (r3[i] + r7[i]);
        out[i] = edge + middle + (w[4] * (r4[i] + r6[i]) + w[5] * r5[i]);
    }
}

/// The last eleven rows of up to four maps, each blurred along x.
struct Ring {
    /// Blurred rows, slot `y % 11`, of each map.
    slots: [Vec<f64>; 4],
    /// One unblurred row of each map between five pixels of zeros on either side.
    padded: [Vec<f64>; 4],
    zero: Vec<f64>,
    /// Values per row, and values per pixel.
    n: usize,
    channels: usize,
    /// Distance of two slots.
    stride: usize,
}

impl Ring {
    fn new(n: usize, channels: usize) -> Self {
        // Five cache lines past a multiple of 4096 bytes: rows at the same column never share a cache set.
        let stride = n.div_ceil(512) * 512 + 40;
        Self {
            slots: std::array::from_fn(|_| vec![0.0; TAPS * stride]),
            padded: std::array::from_fn(|_| vec![0.0; n + 2 * RADIUS * channels]),
            zero: vec![0.0; n],
            n,
            stride,
            channels,
        }
    }

    /// Blurs row `y` of the first `maps` maps, which lies in `padded`, along x into its slot.
    #[inline(always)]
    fn push(&mut self, y: usize, w: &[f64; RADIUS + 1], maps: usize) {
        let (n, at) = (self.n, (y % TAPS) * self.stride);
        for m in 0..maps {
            let source = &self.padded[m];
            let shifted = std::array::from_fn(|k| &source[k * self.channels..k * self.channels + n]);
            weigh(shifted, w, &mut self.slots[m][at..at + n]);
        }
    }

    /// Blurs map `m` down the ring at row `y`; rows outside `0..height` are zero.
    #[inline(always)]
    fn blur(&self, m: usize, y: usize, height: usize, w: &[f64; RADIUS + 1], out: &mut [f64]) {
        let rows = std::array::from_fn(|k| match (y + k).checked_sub(RADIUS) {
            Some(r) if r < height => &self.slots[m][(r % TAPS) * self.stride..][..self.n],
            _ => &self.zero[..],
        });
        weigh(rows, w, out);
    }
}

/// Blurred s, d, s², d² of one row → its SSIM values in `value`; with `GRADIENT` also the derivatives with respect to
/// the four blurred values, in their place.
#[inline(always)]
fn compare_row<const GRADIENT: bool>(blurred: &mut [Vec<f64>; 4], value: &mut [f64]) {
    let n = value.len();
    let [mean_s, mean_d, square_s, square_d] = blurred.each_mut().map(|r| &mut r[..n]);
    for i in 0..n {
        let (ms, md) = (mean_s[i], mean_d[i]);
        let (p, q) = (ms * ms, md * md);
        let (raw_s, raw_d) = (square_s[i] - p, square_d[i] - q);
        // Variances are not negative; rounding may say so, and then they and their derivatives are 0.
        let (var_s, var_d) = (if raw_s > 0.0 { raw_s } else { 0.0 }, if raw_d > 0.0 { raw_d } else { 0.0 });
        let inverse_1 = 1.0 / (0.5 * (p + q) + C1);
        let inverse_2 = 1.0 / (0.5 * (var_s + var_d) + C2);
        // 1 − q/B1 and 1 − var_d/B2: the complements come first, so that nothing cancels for equal images.
        let luminance = 1.0 - q * inverse_1;
        let structure = 1.0 - var_d * inverse_2;
        value[i] = luminance * structure;
        if GRADIENT {
            let d_var_s = 0.5 * luminance * (1.0 - structure) * inverse_2;
            let d_var_d = -0.5 * luminance * (1.0 + structure) * inverse_2;
            let d_var_s = if raw_s > 0.0 { d_var_s } else { 0.0 };
            let d_var_d = if raw_d > 0.0 { d_var_d } else { 0.0 };
            let d_p = 0.5 * structure * (1.0 - luminance) * inverse_1;
            let d_q = -0.5 * structure * (1.0 + luminance) * inverse_1;
            mean_s[i] = 2.0 * ms * (d_p - d_var_s);
            mean_d[i] = 2.0 * md * (d_q - d_var_d);
            square_s[i] = d_var_s;
            square_d[i] = d_var_d;
        }
    }
}

/// Order of the maps of partial derivatives; the last one only if the second image's gradient is wanted.
const TO_A: usize = 0;
const TO_SQUARE_S: usize = 1;
const TO_SQUARE_D: usize = 2;
const TO_B: usize = 3;

/// Scales the derivatives `blurred` (toward mean s, mean d, s², d²) of one row by the cotangent `g` and sorts them.
#[inline(always)]
fn scale_row(g: Cotangent<'_>, blurred: &[Vec<f64>; 4], targets: [&mut [f64]; 4], span: std::ops::Range<usize>) {
    let [mean_s, mean_d, square_s, square_d] = blurred.each_ref().map(|r| &r[span.clone()]);
    let [to_a, to_square_s, to_square_d, to_b] = targets.map(|r| &mut r[span.clone()]);
    let n = span.len();
    let mut put = |i: usize, g: f64| {
        to_a[i] = g * (mean_s[i] + mean_d[i]);
        to_square_s[i] = g * square_s[i];
        to_square_d[i] = g * square_d[i];
        to_b[i] = g * (mean_s[i] - mean_d[i]);
    };
    match g {
        Cotangent::Uniform(g) => (0..n).for_each(|i| put(i, g)),
        Cotangent::Map(g) => {
            let g = &g[span];
            (0..n).for_each(|i| put(i, g[i] as f64));
        }
    }
}

/// One row of the gradient: what reaches the image through its mean, and through s² and d² (`sign` is ∂d/∂image).
#[inline(always)]
fn assemble_row(rows: (&[f32], &[f32]), mean: &[f64], squares: [&Vec<f64>; 2], sign: f64, out: &mut [f32]) {
    let n = out.len();
    let (a, b, mean) = (&rows.0[..n], &rows.1[..n], &mean[..n]);
    let [square_s, square_d] = squares.map(|r| &r[..n]);
    for i in 0..n {
        let (x, y) = (a[i] as f64, b[i] as f64);
        out[i] = (mean[i] + 2.0 * ((x + y) * square_s[i] + sign * (x - y) * square_d[i])) as f32;
    }
}

/// SSIM of the rows `band` of `pair`: the whole pipeline. Each row depends on the images only, not on the band.
#[inline(always)]
fn run(pair: Pair<'_>, wanted: Wanted<'_>, band: std::ops::Range<usize>) -> Rows {
    let Pair { a, b, width, height, channels, border } = pair;
    let n = width * channels;
    let w = half_window();
    let interior = border * channels..(n - border * channels).max(border * channels);
    let edge = RADIUS * channels..RADIUS * channels + n;
    let gradient = wanted.gradient.is_some();

    let mut images = Ring::new(n, channels);
    let mut blurred: [Vec<f64>; 4] = std::array::from_fn(|_| vec![0.0; n]);
    let mut value = vec![0.0; n];
    let mut out = Rows::default();
    if gradient {
        out.d_a = vec![0.0; band.len() * n];
        out.d_b = vec![0.0; if wanted.both { band.len() * n } else { 0 }];
    }
    let maps = if wanted.both { 4 } else { 3 };
    let partial_width = if gradient { n } else { 0 };
    let mut partials = Ring::new(partial_width, channels);
    let mut spread: [Vec<f64>; 4] = std::array::from_fn(|_| vec![0.0; partial_width]);

    let halo = if gradient { RADIUS } else { 0 };
    let compared = band.start.saturating_sub(halo)..(band.end + halo).min(height);
    let first = compared.start.saturating_sub(RADIUS);
    for t in first..compared.end + RADIUS + halo {
        if t < height {
            let [s, d, ss, dd] = images.padded.each_mut().map(|r| &mut r[edge.clone()]);
            let (row_a, row_b) = (&a[t * n..(t + 1) * n], &b[t * n..(t + 1) * n]);
            for i in 0..n {
                let (x, y) = (row_a[i] as f64, row_b[i] as f64);
                s[i] = x + y;
                d[i] = x - y;
                ss[i] = (x + y) * (x + y);
                dd[i] = (x - y) * (x - y);
            }
            images.push(t, &w, 4);
        }
        let Some(y) = t.checked_sub(RADIUS) else { continue };
        if compared.contains(&y) {
            let counts = y >= border && y + border < height;
            if counts {
                for m in 0..4 {
                    images.blur(m, y, height, &w, &mut blurred[m]);
                }
                if gradient {
                    compare_row::<true>(&mut blurred, &mut value);
                } else {
                    compare_row::<false>(&mut blurred, &mut value);
                }
            }
            if band.contains(&y) {
                out.sums.push(if counts { value[interior.clone()].iter().sum() } else { 0.0 });
                if wanted.map {
                    let at = out.map.len();
                    out.map.resize(at + n, 0.0);
                    if counts {
                        for i in interior.clone() {
                            out.map[at + i] = value[i] as f32;
                        }
                    }
                }
            }
            if let Some(cotangent) = wanted.gradient {
                let targets = partials.padded.each_mut().map(|r| &mut r[edge.clone()]);
                if counts {
                    let row = match cotangent {
                        Cotangent::Uniform(_) => cotangent,
                        Cotangent::Map(g) => Cotangent::Map(&g[y * n..(y + 1) * n]),
                    };
                    scale_row(row, &blurred, targets, interior.clone());
                } else {
                    targets.into_iter().for_each(|r| r.fill(0.0));
                }
                partials.push(y, &w, maps);
            }
        }
        if !gradient {
            continue;
        }
        let Some(y) = y.checked_sub(RADIUS) else { continue };
        if band.contains(&y) {
            for m in 0..maps {
                partials.blur(m, y, height, &w, &mut spread[m]);
            }
            let rows = (&a[y * n..(y + 1) * n], &b[y * n..(y + 1) * n]);
            let at = (y - band.start) * n;
            assemble_row(
                rows,
                &spread[TO_A],
                [&spread[TO_SQUARE_S], &spread[TO_SQUARE_D]],
                1.0,
                &mut out.d_a[at..at + n],
            );
            if wanted.both {
                let spread_d = [&spread[TO_SQUARE_S], &spread[TO_SQUARE_D]];
                assemble_row(rows, &spread[TO_B], spread_d, -1.0, &mut out.d_b[at..at + n]);
            }
        }
    }
    out
}

/// [`run`], compiled for each instruction set. Same bits.
struct Run<'a>(Pair<'a>, Wanted<'a>, std::ops::Range<usize>);

impl WithSimd for Run<'_> {
    type Output = Rows;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Rows {
        run(self.0, self.1, self.2)
    }
}

fn run_fastest(pair: Pair<'_>, wanted: Wanted<'_>, band: std::ops::Range<usize>) -> Rows {
    Level::current().dispatch(Run(pair, wanted, band))
}

/// All rows of `pair`.
#[cfg(not(feature = "parallel"))]
pub(crate) fn rows(pair: Pair<'_>, wanted: Wanted<'_>) -> Rows {
    run_fastest(pair, wanted, 0..pair.height)
}

/// All rows of `pair`, in bands on several threads. A band repeats up to ten rows of its neighbours' work on either
/// side, hence bands of 64 rows.
#[cfg(feature = "parallel")]
pub(crate) fn rows(pair: Pair<'_>, wanted: Wanted<'_>) -> Rows {
    use rayon::prelude::*;
    const BAND: usize = 64;
    let bands: Vec<Rows> = (0..pair.height.div_ceil(BAND))
        .into_par_iter()
        .map(|i| run_fastest(pair, wanted, i * BAND..((i + 1) * BAND).min(pair.height)))
        .collect();
    let mut all = Rows::default();
    for band in bands {
        all.sums.extend(band.sums);
        all.map.extend(band.map);
        all.d_a.extend(band.d_a);
        all.d_b.extend(band.d_b);
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(seed: u64, n: usize) -> Vec<f32> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 40) as f32 / (1u64 << 24) as f32
        };
        (0..n).map(|_| next()).collect()
    }

    /// Bands and instruction sets change nothing, to the last bit.
    #[test]
    fn bands_and_instruction_sets_agree_in_every_bit() {
        let (width, height, channels) = (37, 45, 3);
        let n = width * height * channels;
        let (a, b) = (noise(1, n), noise(2, n));
        for border in [0, RADIUS] {
            let pair = Pair { a: &a, b: &b, width, height, channels, border };
            let wanted = Wanted { map: true, gradient: Some(Cotangent::Uniform(0.3)), both: true };
            let whole = run(pair, wanted, 0..height);
            for level in Level::testable() {
                let fast = level.dispatch(Run(pair, wanted, 0..height));
                assert_eq!((&whole.sums, &whole.map), (&fast.sums, &fast.map), "{level:?}");
                assert_eq!((&whole.d_a, &whole.d_b), (&fast.d_a, &fast.d_b), "{level:?}");
            }
            let mut start = 0;
            for length in [1, 3, 20, 14, 7] {
                let part = run(pair, wanted, start..start + length);
                let (i, j) = (start * width * channels, (start + length) * width * channels);
                assert_eq!(part.sums, whole.sums[start..start + length]);
                assert_eq!(part.map, whole.map[i..j]);
                assert_eq!(part.d_a, whole.d_a[i..j]);
                assert_eq!(part.d_b, whole.d_b[i..j]);
                start += length;
            }
            assert_eq!(start, height);
        }
    }

    #[test]
    fn the_window_sums_to_one() {
        let w = half_window();
        assert!((2.0 * w[..RADIUS].iter().sum::<f64>() + w[RADIUS] - 1.0).abs() < 1e-15);
    }
}
