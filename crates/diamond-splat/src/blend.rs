//! Forward blending of one row of blocks.
//!
//! Per block of 16 pixels and per batch of splats two phases alternate: first the weights `w = α·T` front to back, then
//! `Σ w f` for four channels at a time with the sums in registers, which is a small matrix product and as fast as one.
//! Depth is one more channel (the splat's z); opacity is the sum of the weights.
use crate::bins::{ROW, ROW_BANDS, Reached, RowScratch, Rows};
use crate::ellipse::{BLOCK, LANES, Prepared};
use crate::Features;
use crate::lanes::{Block, Limits, Offsets, Thresholds, alphas, any_positive, composite, load, store, with_lanes};
use pulp::{Simd, WithSimd};

/// Entries of a block that are prepared and blended together.
const BATCH: usize = 32;
/// Splats whose alphas are evaluated together.
pub(crate) const TOGETHER: usize = 2;
/// Channels that are accumulated together.
pub(crate) const GROUP: usize = 4;

/// What every row needs to know.
pub(crate) struct Scene<'a> {
    pub rows: &'a Rows,
    /// By Gaussian.
    pub features: &'a Features,
    /// Of a row's own copy of the features; a multiple of [`GROUP`] and of the vector width.
    pub stride: usize,
    /// Without depth.
    pub channels: usize,
    pub limits: Thresholds,
    pub smooth: bool,
    /// Whether weights above 0 are counted.
    pub count: bool,
    pub width: usize,
    pub height: usize,
}

/// A block within a row.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Place {
    pub row: usize,
    pub band: usize,
    pub block: usize,
}

impl Scene<'_> {
    /// Blocks side by side.
    pub fn blocks(&self) -> usize {
        self.width.div_ceil(BLOCK)
    }

    /// Bands of row `row`: the last row of an image may have fewer than the others.
    pub fn bands(&self, row: usize) -> usize {
        (self.height - row * ROW).div_ceil(BLOCK).min(ROW_BANDS)
    }

    /// x of a block's centre, px.
    #[inline(always)]
    pub fn centre(&self, at: Place) -> f64 {
        (at.block * BLOCK) as f64 + 0.5 * BLOCK as f64
    }

    /// Width and height of the part of a block that is inside the image, pixels.
    #[inline(always)]
    pub fn size(&self, at: Place) -> (usize, usize) {
        let (x, y) = (at.block * BLOCK, at.row * ROW + at.band * BLOCK);
        ((self.width - x).min(BLOCK), (self.height - y).min(BLOCK))
    }

    /// Index within the row of the first pixel of line `y` of a block.
    #[inline(always)]
    pub fn pixel(&self, at: Place, y: usize) -> usize {
        (at.band * BLOCK + y) * self.width + at.block * BLOCK
    }

    /// 1 for lanes inside the image, else 0: the transmittance to start with.
    #[inline(always)]
    pub fn initial_transmittance(&self, at: Place) -> [f32; LANES] {
        let (width, height) = self.size(at);
        let mut t = [1.0; LANES];
        if width < BLOCK || height < BLOCK {
            for (lane, t) in t.iter_mut().enumerate() {
                *t = (lane % BLOCK < width && lane / BLOCK < height) as u32 as f32;
            }
        }
        t
    }

    /// Groups of channels that hold the features and the depth.
    pub fn groups(&self) -> usize {
        (self.channels + 1).div_ceil(GROUP)
    }
}

/// The forward pass of one row.
pub(crate) struct RowForward<'a> {
    pub scene: &'a Scene<'a>,
    pub row: usize,
    pub scratch: &'a mut RowScratch,
    /// The row's pixels × channels.
    pub features: &'a mut [f32],
    /// The row's pixels.
    pub opacity: &'a mut [f32],
    /// The row's pixels.
    pub depth: &'a mut [f32],
}

/// How much was done.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RowWork {
    /// (splat, block) pairs.
    pub entries: u64,
    /// (splat, pixel) pairs whose alpha was evaluated.
    pub evaluated: u64,
    /// Those with a weight, if they were counted.
    pub blended: u64,
}

impl WithSimd for RowForward<'_> {
    type Output = (Reached, RowWork);

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> (Reached, RowWork) {
        if self.scene.smooth {
            with_lanes!(s: S, forward_row_smooth(self))
        } else {
            with_lanes!(s: S, forward_row_hard(self))
        }
    }
}

#[inline(always)]
fn forward_row_hard<S: Simd, const N: usize>(s: S, row: RowForward) -> (Reached, RowWork) {
    forward_row::<S, N, false>(s, row)
}

#[inline(always)]
fn forward_row_smooth<S: Simd, const N: usize>(s: S, row: RowForward) -> (Reached, RowWork) {
    forward_row::<S, N, true>(s, row)
}

#[inline(always)]
fn forward_row<S: Simd, const N: usize, const SMOOTH: bool>(s: S, work: RowForward) -> (Reached, RowWork) {
    let RowForward { scene, row, scratch, features, opacity, depth } = work;
    scratch.gather(scene.rows, row, scene.features, scene.stride);
    scratch.list(scene.blocks());
    let scratch = &*scratch;
    let mut lists = Reached::with_capacity(scene.blocks() * ROW_BANDS, scratch.entries());
    let groups = scene.groups();
    let limits = Limits::new(s, &scene.limits);
    let offsets = Offsets::<S, N>::new();
    // Sums by channel.
    let mut acc = vec![[0.0f32; LANES]; groups * GROUP];
    let mut prepared = [Prepared::default(); BATCH];
    // Where a splat's features begin.
    let mut rows = [0usize; BATCH];
    let mut weights = [[0.0f32; LANES]; BATCH];
    let mut work = RowWork { entries: scratch.entries() as u64, ..Default::default() };
    for block in 0..scene.blocks() {
        for band in 0..scene.bands(row) {
            let all = scratch.of(band, block);
            if all.is_empty() {
                lists.push(&[]);
                continue;
            }
            let place = Place { row, band, block };
            let x = scene.centre(place);
            let mut t = load::<S, N>(&scene.initial_transmittance(place));
            let mut sum = [s.splat_f32s(0.0); N];
            acc.fill([0.0; LANES]);
            let mut reach = 0;
            for (batch, entries) in all.chunks(BATCH).enumerate() {
                for (k, &slot) in entries.iter().enumerate() {
                    rows[k] = slot as usize * scene.stride;
                    prepared[k] = scratch.prepare(slot, x, band);
                }
                let n = entries.len();
                work.evaluated += (n * LANES) as u64;
                if let Some(beyond) = prepared.get_mut(n) {
                    *beyond = Prepared::NOTHING;
                }
                // Phase 1: weights, front to back.
                let pairs = prepared.as_chunks::<TOGETHER>().0.iter().zip(weights.as_chunks_mut::<TOGETHER>().0);
                for (splats, weights) in pairs.take(n.div_ceil(TOGETHER)) {
                    let (a, _) = alphas::<S, N, TOGETHER, SMOOTH>(s, splats, &offsets, &limits);
                    for m in 0..TOGETHER {
                        let w = composite::<S, N>(s, &a[m], &mut t, &limits);
                        store::<S, N>(&mut weights[m], w);
                    }
                }
                // Phase 2: Σ w and Σ w f.
                for m in 0..n {
                    let w = load::<S, N>(&weights[m]);
                    for i in 0..N {
                        sum[i] = s.add_f32s(sum[i], w[i]);
                    }
                }
                for group in 0..groups {
                    let acc = &mut acc[group * GROUP..][..GROUP];
                    let mut sums: [Block<S, N>; GROUP] = [[limits.zero; N]; GROUP];
                    for c in 0..GROUP {
                        sums[c] = load::<S, N>(&acc[c]);
                    }
                    for (w, row) in weights[..n].iter().zip(&rows) {
                        let w = load::<S, N>(w);
                        let at = row + group * GROUP;
                        let f = &scratch.features[at..at + GROUP];
                        for c in 0..GROUP {
                            let f = s.splat_f32s(f[c]);
                            for i in 0..N {
                                sums[c][i] = s.mul_add_e_f32s(w[i], f, sums[c][i]);
                            }
                        }
                    }
                    for c in 0..GROUP {
                        store::<S, N>(&mut acc[c], sums[c]);
                    }
                }
                if scene.count {
                    let positive = |w: &[f32; LANES]| w.iter().filter(|w| **w > 0.0).count() as u64;
                    work.blended += weights[..n].iter().map(positive).sum::<u64>();
                }
                reach = batch * BATCH + n;
                if !any_positive::<S, N>(s, &t) {
                    // The last that any pixel saw.
                    while n > 0 && weights[reach - batch * BATCH - 1] == [0.0; LANES] && reach > batch * BATCH + 1 {
                        reach -= 1;
                    }
                    break;
                }
            }
            lists.push(&all[..reach]);
            if reach == 0 {
                continue;
            }
            let mut total = [0.0f32; LANES];
            store::<S, N>(&mut total, sum);
            let (width, height) = scene.size(place);
            for y in 0..height {
                let (first, lane) = (scene.pixel(place, y), y * BLOCK);
                opacity[first..first + width].copy_from_slice(&total[lane..lane + width]);
                depth[first..first + width].copy_from_slice(&acc[scene.channels][lane..lane + width]);
                let out = &mut features[first * scene.channels..(first + width) * scene.channels];
                if scene.channels > 0 {
                    for (x, out) in out.chunks_exact_mut(scene.channels).enumerate() {
                        for (c, v) in out.iter_mut().enumerate() {
                            *v = acc[c][lane + x];
                        }
                    }
                }
            }
        }
    }
    lists.shrink();
    (lists, work)
}
