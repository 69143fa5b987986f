//! Forward blending of one region.
//!
//! Per block of 16 pixels and per batch of splats two phases alternate: first the weights `w = α·T` front to back, then
//! `Σ w f` for four channels at a time with the sums in registers, which is a small matrix product and as fast as one.
//! Depth is one more channel (the splat's z); opacity is the sum of the weights.
use crate::Features;
use crate::bins::{Bins, COLUMNS, REGION, ROWS, Reached, Scratch, grid};
use crate::ellipse::{BLOCK, LANES, Prepared};
use crate::lanes::{Limits, Offsets, Thresholds, alphas, composite};
use crate::recycle::{ENTRIES, FLOATS, Pool};
use diamond_simd::{Block, Simd, WithSimd, any_positive, load_block, store_block, with_lanes};

/// Entries of a block that are prepared and blended together.
const BATCH: usize = 32;
/// Splats whose alphas are evaluated together.
pub(crate) const TOGETHER: usize = 2;
/// Channels that are accumulated together.
pub(crate) const GROUP: usize = 4;

/// What every region needs to know.
pub(crate) struct Scene<'a> {
    pub bins: &'a Bins,
    /// By Gaussian.
    pub features: &'a Features,
    /// Of a region's own copy of the features; a multiple of [`GROUP`] and of the vector width.
    pub stride: usize,
    /// Without depth.
    pub channels: usize,
    pub limits: Thresholds,
    pub smooth: bool,
    /// Whether weights above 0 are counted.
    pub count: bool,
    /// Whether blocks are kept with their weights.
    pub keep: bool,
    pub width: usize,
    pub height: usize,
}

/// A block of the image, by its first pixel.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Place {
    pub x: usize,
    pub y: usize,
    /// Width and height of the part that is inside the image, pixels.
    pub size: [usize; 2],
}

impl Place {
    /// Centre, px.
    #[inline(always)]
    pub fn centre(&self) -> (f64, f64) {
        let half = 0.5 * BLOCK as f64;
        (self.x as f64 + half, self.y as f64 + half)
    }

    /// 1 for lanes inside the image, else 0: the transmittance to start with.
    #[inline(always)]
    pub fn initial_transmittance(&self) -> [f32; LANES] {
        let mut t = [1.0; LANES];
        if self.size != [BLOCK; 2] {
            for (lane, t) in t.iter_mut().enumerate() {
                *t = (lane % BLOCK < self.size[0] && lane / BLOCK < self.size[1]) as u32 as f32;
            }
        }
        t
    }
}

impl Scene<'_> {
    /// First pixel of a region.
    pub fn corner(&self, region: usize) -> [usize; 2] {
        let [columns, _] = grid([self.width, self.height]);
        [region % columns * REGION[0], region / columns * REGION[1]]
    }

    /// Width and height of the part of a region that is inside the image, pixels.
    pub fn region_size(&self, region: usize) -> [usize; 2] {
        let [x, y] = self.corner(region);
        [(self.width - x).min(REGION[0]), (self.height - y).min(REGION[1])]
    }

    /// A block of a region; `None` outside the image.
    #[inline(always)]
    pub fn place(&self, region: usize, block: usize) -> Option<Place> {
        let [x, y] = self.corner(region);
        let (x, y) = (x + block % COLUMNS * BLOCK, y + block / COLUMNS * BLOCK);
        let size = [self.width.saturating_sub(x).min(BLOCK), self.height.saturating_sub(y).min(BLOCK)];
        (size[0] > 0 && size[1] > 0).then_some(Place { x, y, size })
    }

    /// Groups of channels that hold the features and the depth.
    pub fn groups(&self) -> usize {
        (self.channels + 1).div_ceil(GROUP)
    }
}

/// The forward pass of one region.
pub(crate) struct RegionForward<'a> {
    pub scene: &'a Scene<'a>,
    pub region: usize,
    pub scratch: &'a mut Scratch,
}

/// What a region looks like; empty where nothing is seen.
#[derive(Debug, Clone, Default)]
pub(crate) struct RegionImage {
    /// Pixels × channels, then opacity, then depth, of the region's part of the image.
    pub data: Vec<f32>,
    pub lists: Reached,
    pub work: RegionWork,
    /// Empty unless asked for.
    pub kept: KeptBlocks,
}

/// Blocks of a region with the weights of what is seen in them.
#[derive(Debug, Clone, Default)]
pub(crate) struct KeptBlocks {
    /// By number of the block; those of which something is seen.
    pub blocks: Vec<KeptBlock>,
    /// Gaussians, block by block, nearest first.
    pub gaussians: Vec<u32>,
    /// By pixel of a block, some of them above 0; beside `gaussians`.
    pub weights: Vec<[f32; LANES]>,
}

static WEIGHTS: Pool<[f32; LANES]> = Pool::new();

impl KeptBlocks {
    /// None yet.
    fn new() -> Self {
        Self { blocks: Vec::new(), gaussians: ENTRIES.take(), weights: WEIGHTS.take() }
    }
}

impl Drop for KeptBlocks {
    fn drop(&mut self) {
        ENTRIES.give(std::mem::take(&mut self.gaussians));
        WEIGHTS.give(std::mem::take(&mut self.weights));
    }
}

/// A block with something to see.
#[derive(Debug, Clone)]
pub(crate) struct KeptBlock {
    pub place: Place,
    /// Its entries end here.
    pub end: usize,
    /// Σ w by pixel.
    pub opacity: [f32; LANES],
    /// Σ w z by pixel.
    pub depth: [f32; LANES],
}

/// How much was done.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RegionWork {
    /// (splat, block) pairs.
    pub entries: u64,
    /// (splat, pixel) pairs whose alpha was evaluated.
    pub evaluated: u64,
    /// Those with a weight, if they were counted.
    pub blended: u64,
}

impl WithSimd for RegionForward<'_> {
    type Output = RegionImage;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> RegionImage {
        if self.scene.smooth { with_lanes!(s: S, forward_smooth(self)) } else { with_lanes!(s: S, forward_hard(self)) }
    }
}

#[inline(always)]
fn forward_hard<S: Simd, const N: usize>(s: S, region: RegionForward) -> RegionImage {
    forward::<S, N, false>(s, region)
}

#[inline(always)]
fn forward_smooth<S: Simd, const N: usize>(s: S, region: RegionForward) -> RegionImage {
    forward::<S, N, true>(s, region)
}

#[inline(always)]
fn forward<S: Simd, const N: usize, const SMOOTH: bool>(s: S, region: RegionForward) -> RegionImage {
    let RegionForward { scene, region, scratch } = region;
    scratch.gather(scene.bins, region, scene.features, scene.stride);
    if scratch.slots.is_empty() {
        return RegionImage::default();
    }
    scratch.list();
    let scratch = &*scratch;
    let mut lists = Reached::new();
    let [corner_x, corner_y] = scene.corner(region);
    let [width, height] = scene.region_size(region);
    let channels = scene.channels;
    let mut data = FLOATS.take();
    // Images are not made where blocks are kept.
    let pixels = if scene.keep { 0 } else { width * height };
    data.resize(pixels * (channels + 2), 0.0);
    let (features, rest) = data.split_at_mut(pixels * channels);
    let (opacity, depth) = rest.split_at_mut(pixels);
    let groups = scene.groups();
    let limits = Limits::new(s, &scene.limits);
    let offsets = Offsets::<S, N>::new();
    // Sums by channel.
    let mut acc = vec![[0.0f32; LANES]; groups * GROUP];
    let mut prepared = [Prepared::default(); BATCH];
    // Who is blended, and where the features begin.
    let mut entries = [0u32; BATCH];
    let mut rows = [0usize; BATCH];
    let mut weights = [[0.0f32; LANES]; BATCH];
    let mut kept = if scene.keep { KeptBlocks::new() } else { KeptBlocks::default() };
    let mut work = RegionWork { entries: scratch.entries(), ..Default::default() };
    for block in 0..ROWS * COLUMNS {
        lists.begin();
        let Some(place) = scene.place(region, block) else {
            continue;
        };
        let mut slots = scratch.of(block);
        let mut n = slots.next(&mut entries);
        if n == 0 {
            continue;
        }
        let (x, y) = place.centre();
        let mut t = load_block::<S, N>(&place.initial_transmittance());
        let mut sum = [s.splat_f32s(0.0); N];
        acc.fill([0.0; LANES]);
        while n > 0 {
            for k in 0..n {
                let slot = entries[k];
                rows[k] = slot as usize * scene.stride;
                prepared[k] = scratch.prepare(slot, x, y);
            }
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
                    store_block::<S, N>(&mut weights[m], w);
                }
            }
            // Phase 2: Σ w and Σ w f.
            for m in 0..n {
                let w = load_block::<S, N>(&weights[m]);
                for i in 0..N {
                    sum[i] = s.add_f32s(sum[i], w[i]);
                }
            }
            for group in 0..groups {
                let acc = &mut acc[group * GROUP..][..GROUP];
                let mut sums: [Block<S, N>; GROUP] = [[limits.zero; N]; GROUP];
                for c in 0..GROUP {
                    sums[c] = load_block::<S, N>(&acc[c]);
                }
                for (w, row) in weights[..n].iter().zip(&rows) {
                    let w = load_block::<S, N>(w);
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
                    store_block::<S, N>(&mut acc[c], sums[c]);
                }
            }
            if scene.count {
                let positive = |w: &[f32; LANES]| w.iter().filter(|w| **w > 0.0).count() as u64;
                work.blended += weights[..n].iter().map(positive).sum::<u64>();
            }
            if scene.keep {
                for (w, &slot) in weights[..n].iter().zip(&entries) {
                    if any_positive::<S, N>(s, &load_block::<S, N>(w)) {
                        kept.gaussians.push(scratch.slots[slot as usize].gaussian);
                        kept.weights.push(*w);
                    }
                }
            }
            if any_positive::<S, N>(s, &t) {
                lists.push(&entries[..n]);
                n = slots.next(&mut entries);
                continue;
            }
            // The last that any pixel saw.
            while n > 1 && !any_positive::<S, N>(s, &load_block::<S, N>(&weights[n - 1])) {
                n -= 1;
            }
            lists.push(&entries[..n]);
            break;
        }
        let mut total = [0.0f32; LANES];
        store_block::<S, N>(&mut total, sum);
        if scene.keep {
            let end = kept.gaussians.len();
            if end == kept.blocks.last().map_or(0, |b| b.end) {
                continue;
            }
            kept.blocks.push(KeptBlock { place, end, opacity: total, depth: acc[channels] });
            continue;
        }
        for line in 0..place.size[1] {
            let first = (place.y - corner_y + line) * width + place.x - corner_x;
            let (lanes, pixels) = (line * BLOCK..line * BLOCK + place.size[0], first..first + place.size[0]);
            opacity[pixels.clone()].copy_from_slice(&total[lanes.clone()]);
            depth[pixels.clone()].copy_from_slice(&acc[channels][lanes.clone()]);
            let out = &mut features[pixels.start * channels..pixels.end * channels];
            if channels > 0 {
                for (lane, out) in lanes.zip(out.chunks_exact_mut(channels)) {
                    for (c, v) in out.iter_mut().enumerate() {
                        *v = acc[c][lane];
                    }
                }
            }
        }
    }
    RegionImage { data, lists, work, kept }
}
