//! Forward blending of one row of tiles.
//!
//! Per block of 16 pixels and per batch of splats two phases alternate: first the weights `w = α·T` front to back, then
//! `Σ w f` for four channels at a time with the sums in registers, which is a small matrix product and as fast as one.
//! Depth is one more channel (the splat's z); opacity is the sum of the weights.
use crate::Features;
use crate::ellipse::{BLOCK, Ellipse, LANES, Prepared, TILE};
use crate::lanes::{Block, Thresholds, alpha, any_positive, composite, load, store, with_lanes};
use crate::tiles::{TileLists, entry_slot, tile_lists};
use pulp::{Simd, WithSimd};

/// Entries of a tile that are prepared and blended together.
const BATCH: usize = 32;
/// Channels that are accumulated together.
pub(crate) const GROUP: usize = 4;

/// What every row of tiles needs to know.
pub(crate) struct Scene<'a> {
    /// By rank.
    pub ellipses: &'a [Ellipse],
    /// By rank: index of the Gaussian and depth.
    pub sources: &'a [(u32, f32)],
    /// By Gaussian.
    pub features: &'a Features,
    /// Of a row's own copy of the features; a multiple of [`GROUP`] and of the vector width.
    pub stride: usize,
    /// Without depth.
    pub channels: usize,
    pub limits: Thresholds,
    pub smooth: bool,
    pub width: usize,
    pub height: usize,
}

/// Offsets of the pixel centres of a block from the tile's centre: all x, then all y.
pub(crate) fn block_offsets(block: usize) -> ([f32; LANES], [f32; LANES]) {
    let corner = |b: usize| (b * BLOCK) as f32 + 0.5 - 0.5 * TILE as f32;
    (
        std::array::from_fn(|lane| corner(block % 2) + (lane % BLOCK) as f32),
        std::array::from_fn(|lane| corner(block / 2) + (lane / BLOCK) as f32),
    )
}

/// Offset of a block's centre from the tile's centre.
#[inline(always)]
pub(crate) fn block_centre(block: usize) -> (f32, f32) {
    let half = 0.5 * BLOCK as f32;
    (if block.is_multiple_of(2) { -half } else { half }, if block / 2 == 0 { -half } else { half })
}

impl Scene<'_> {
    /// x of a tile's centre, px.
    pub fn centre(tile: usize) -> f64 {
        (tile * TILE) as f64 + 0.5 * TILE as f64
    }

    /// Index of a lane's pixel within the row of tiles, `None` outside the image.
    #[inline(always)]
    pub fn pixel(&self, tile: usize, row: usize, block: usize, lane: usize) -> Option<usize> {
        let x = tile * TILE + block % 2 * BLOCK + lane % BLOCK;
        let y = block / 2 * BLOCK + lane / BLOCK;
        (x < self.width && row * TILE + y < self.height).then(|| y * self.width + x)
    }

    /// 1 for lanes inside the image, else 0: the transmittance to start with.
    #[inline(always)]
    pub fn initial_transmittance(&self, tile: usize, row: usize, block: usize) -> [f32; LANES] {
        std::array::from_fn(|lane| if self.pixel(tile, row, block, lane).is_some() { 1.0 } else { 0.0 })
    }

    /// Groups of channels that hold the features and the depth.
    pub fn groups(&self) -> usize {
        (self.channels + 1).div_ceil(GROUP)
    }
}

/// The forward pass of one row of tiles.
pub(crate) struct RowForward<'a> {
    pub scene: &'a Scene<'a>,
    pub row: usize,
    /// Slot → rank.
    pub ranks: &'a [u32],
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
    /// (splat, pixel) pairs whose alpha was evaluated.
    pub evaluated: u64,
    /// Those with a weight.
    pub blended: u64,
}

impl WithSimd for RowForward<'_> {
    type Output = (TileLists, RowWork);

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> (TileLists, RowWork) {
        if self.scene.smooth {
            with_lanes!(s: S, forward_row_smooth(self))
        } else {
            with_lanes!(s: S, forward_row_hard(self))
        }
    }
}

#[inline(always)]
fn forward_row_hard<S: Simd, const N: usize>(s: S, row: RowForward) -> (TileLists, RowWork) {
    forward_row::<S, N, false>(s, row)
}

#[inline(always)]
fn forward_row_smooth<S: Simd, const N: usize>(s: S, row: RowForward) -> (TileLists, RowWork) {
    forward_row::<S, N, true>(s, row)
}

#[inline(always)]
fn forward_row<S: Simd, const N: usize, const SMOOTH: bool>(s: S, row: RowForward) -> (TileLists, RowWork) {
    let RowForward { scene, row, ranks, features, opacity, depth } = row;
    let mut lists = tile_lists(scene.ellipses, ranks, row, scene.width, scene.height);
    lists.features = vec![0.0; ranks.len() * scene.stride];
    for (to, &rank) in lists.features.chunks_exact_mut(scene.stride).zip(ranks) {
        let (gaussian, depth) = scene.sources[rank as usize];
        to[..scene.channels].copy_from_slice(scene.features.row(gaussian as usize));
        to[scene.channels] = depth;
    }
    let groups = scene.groups();
    let offsets: [_; 4] = std::array::from_fn(block_offsets);
    // Per block: transmittance, opacity, count of blended pairs, sums by channel.
    let mut t = [[0.0f32; LANES]; 4];
    let mut acc = vec![[0.0f32; LANES]; 4 * groups * GROUP];
    let mut prepared = [Prepared::default(); BATCH];
    // Where a splat's features begin.
    let mut batch_rows = [0usize; BATCH];
    let mut weights = [[0.0f32; LANES]; BATCH];
    let mut sources = [0u32; BATCH];
    let mut work = RowWork::default();
    for tile in 0..lists.reach.len() {
        let entries = &lists.entries[lists.start[tile] as usize..lists.start[tile + 1] as usize];
        let centre = Scene::centre(tile);
        let reach = &mut lists.reach[tile];
        for block in 0..4 {
            t[block] = scene.initial_transmittance(tile, row, block);
        }
        let mut sum = [[0.0f32; LANES]; 4];
        let mut blended = [0u32; LANES];
        acc.fill([0.0; LANES]);
        // Which blocks still let light through, as entry bits.
        let mut open: u32 = (0..4).map(|b| ((t[b] != [0.0; LANES]) as u32) << b).sum();
        for (batch, entries) in entries.chunks(BATCH).enumerate() {
            if open == 0 {
                break;
            }
            for (k, &entry) in entries.iter().enumerate() {
                let slot = entry_slot(entry);
                batch_rows[k] = slot * scene.stride;
                prepared[k] = lists.splats[slot].prepare(centre);
            }
            for block in 0..4 {
                if open & 1 << block == 0 {
                    continue;
                }
                // Phase 1: weights, front to back.
                let (x, y) = (load::<S, N>(&offsets[block].0), load::<S, N>(&offsets[block].1));
                let mut t_block = load::<S, N>(&t[block]);
                let mut sum_block = load::<S, N>(&sum[block]);
                let mut n = 0;
                for (k, &entry) in entries.iter().enumerate() {
                    if entry & 1 << block == 0 {
                        continue;
                    }
                    work.evaluated += LANES as u64;
                    let (a, _) = alpha::<S, N, SMOOTH>(s, &prepared[k], &x, &y, &scene.limits);
                    let w = composite::<S, N>(s, &a, &mut t_block, &scene.limits);
                    for i in 0..N {
                        sum_block[i] = s.add_f32s(sum_block[i], w[i]);
                    }
                    store::<S, N>(&mut weights[n], w);
                    sources[n] = k as u32;
                    n += any_positive::<S, N>(s, &w) as usize;
                }
                store::<S, N>(&mut t[block], t_block);
                store::<S, N>(&mut sum[block], sum_block);
                open &= !(((!any_positive::<S, N>(s, &t_block)) as u32) << block);
                if n == 0 {
                    continue;
                }
                reach[block] = (batch * BATCH) as u32 + sources[n - 1] + 1;
                // Phase 2: Σ w f.
                for group in 0..groups {
                    let acc = &mut acc[(block * groups + group) * GROUP..][..GROUP];
                    let mut sums: [Block<S, N>; GROUP] = [[s.splat_f32s(0.0); N]; GROUP];
                    for c in 0..GROUP {
                        sums[c] = load::<S, N>(&acc[c]);
                    }
                    for m in 0..n {
                        let w = load::<S, N>(&weights[m]);
                        let at = batch_rows[sources[m] as usize] + group * GROUP;
                        let f = &lists.features[at..at + GROUP];
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
                for w in &weights[..n] {
                    for lane in 0..LANES {
                        blended[lane] += (w[lane] > 0.0) as u32;
                    }
                }
            }
        }
        for count in blended {
            work.blended += count as u64;
        }
        for block in 0..4 {
            for lane in 0..LANES {
                if let Some(pixel) = scene.pixel(tile, row, block, lane) {
                    let of = |c: usize| acc[block * groups * GROUP + c][lane];
                    opacity[pixel] = sum[block][lane];
                    depth[pixel] = of(scene.channels);
                    let out = &mut features[pixel * scene.channels..][..scene.channels];
                    out.iter_mut().enumerate().for_each(|(c, v)| *v = of(c));
                }
            }
        }
    }
    (lists, work)
}
