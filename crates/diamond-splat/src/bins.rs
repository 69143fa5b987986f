//! Who is blended where, and in which order: regions, depth order within a region, blocks.
//!
//! A region of 64 × 32 pixels is the unit of work of a thread: all that it reads and writes fits in the second cache,
//! and few splats meet more than two. Runs of consecutive Gaussians are projected and bucketed by region, each run on
//! its own; a region's list is the concatenation of its buckets, so that nothing is shared. A splat's place in a
//! region's list is its slot. Each region sorts its slots by view-space z, ties by index, which costs less than one
//! large sort, because everything that is read then lies close together.
use crate::ellipse::{BANDS, BLOCK, Ellipse, Prepared, band_spans, block_span};
use crate::projection::{Outline, Splat};
use crate::recycle::{ENTRIES, Pool};
use diamond_simd::Simd;
use std::ops::Range;

/// Blocks of a region side by side. At most 16: a span is two numbers of four bits.
pub(crate) const COLUMNS: usize = 16;
/// Blocks of a region one below the other.
pub(crate) const ROWS: usize = BANDS;
/// Width and height of a region, pixels.
pub(crate) const REGION: [usize; 2] = [COLUMNS * BLOCK, ROWS * BLOCK];

/// The blocks of a region in one band that a splat meets: first and last in four bits each; none if first > last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Span(u8);

impl Span {
    const NONE: Span = Span(0x10);

    /// The part of the blocks `first..past` of the image's band that is in the region's columns `start..`.
    #[inline(always)]
    fn new((first, past): (u16, u16), start: usize) -> Span {
        let first = (first as usize).max(start) - start;
        let past = (past as usize).min(start + COLUMNS);
        if first + start < past { Span(((past - 1 - start) | first << 4) as u8) } else { Span::NONE }
    }

    /// A bit per block.
    #[inline(always)]
    fn mask(self) -> u16 {
        MASKS[self.0 as usize]
    }
}

/// [`Span::mask`] by the span's number.
const MASKS: [u16; 256] = {
    let mut masks = [0; 256];
    let mut k = 0;
    while k < 256 {
        let (first, last) = (k >> 4, k & 15);
        if first <= last {
            masks[k] = (((2u32 << last) - 1) & !((1u32 << first) - 1)) as u16;
        }
        k += 1;
    }
    masks
};

/// A splat in a region: all that the kernels need to know of it, so that a region reads one stretch of memory per run
/// and nothing from elsewhere. A cache line.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Slot {
    /// Position and shape.
    pub ellipse: Ellipse,
    /// Index of the Gaussian.
    pub gaussian: u32,
    /// View-space z.
    pub depth: f32,
    /// By band.
    pub spans: [Span; ROWS],
}

/// The splats of consecutive Gaussians, bucketed by region.
#[derive(Debug, Clone, Default)]
pub(crate) struct Run {
    /// In order of Gaussians.
    pub splats: Vec<Splat>,
    /// By region, then splat.
    slots: Vec<Slot>,
    /// Slots of region `r` are `region_start[r]..region_start[r + 1]`.
    region_start: Vec<u32>,
    /// Places of splat `i` are `place_start[i]..place_start[i + 1]`.
    place_start: Vec<u32>,
    /// Region, and place in the region's bucket.
    places: Vec<(u32, u32)>,
}

static SLOTS: Pool<Slot> = Pool::new();

impl Drop for Run {
    fn drop(&mut self) {
        SLOTS.give(std::mem::take(&mut self.slots));
    }
}

impl Run {
    /// Buckets the splats of one run in an image of this size, pixels.
    #[inline(always)]
    pub fn new<S: Simd>(s: S, splats: Vec<Splat>, outlines: &[Outline], size: [usize; 2]) -> Self {
        let grid = grid(size);
        let blocks = size[0].div_ceil(BLOCK) as f32;
        let mut run = Run::default();
        run.region_start.resize(grid[0] * grid[1] + 1, 0);
        run.place_start.reserve(splats.len() + 1);
        run.places.reserve(3 * splats.len());
        let mut by_splat = SLOTS.take();
        for (splat, outline) in splats.iter().zip(outlines) {
            run.place_start.push(run.places.len() as u32);
            let mut slot = Slot {
                ellipse: Ellipse::new(splat),
                gaussian: splat.gaussian,
                depth: splat.depth,
                spans: [Span::NONE; ROWS],
            };
            let of = |pixels: [u32; 2], side: usize| pixels[0] as usize / side..(pixels[1] as usize).div_ceil(side);
            let columns = of(outline.columns, REGION[0]);
            for y in of(outline.rows, REGION[1]) {
                let mut spans = [(0, 0); ROWS];
                // The bands that it meets.
                let first = (outline.rows[0] as usize / BLOCK).saturating_sub(y * ROWS);
                let past = ((outline.rows[1] as usize).div_ceil(BLOCK) - y * ROWS).min(ROWS);
                let (low, high) = band_spans(s, splat, outline, y * ROWS);
                for band in first..past {
                    spans[band] = block_span(low[band], high[band], blocks);
                }
                for x in columns.clone() {
                    slot.spans = [Span::NONE; ROWS];
                    for band in first..past {
                        slot.spans[band] = Span::new(spans[band], x * COLUMNS);
                    }
                    if slot.spans == [Span::NONE; ROWS] {
                        continue;
                    }
                    let region = y * grid[0] + x;
                    by_splat.push(slot);
                    let count = &mut run.region_start[region + 1];
                    run.places.push((region as u32, *count));
                    *count += 1;
                }
            }
        }
        run.place_start.push(run.places.len() as u32);
        let mut total = 0;
        for start in &mut run.region_start {
            total += *start;
            *start = total;
        }
        let nothing = Slot { ellipse: Ellipse::default(), gaussian: 0, depth: 0.0, spans: [Span::NONE; ROWS] };
        run.slots = SLOTS.take();
        run.slots.resize(by_splat.len(), nothing);
        for (slot, &(region, place)) in by_splat.iter().zip(&run.places) {
            run.slots[(run.region_start[region as usize] + place) as usize] = *slot;
        }
        SLOTS.give(by_splat);
        run.splats = splats;
        run
    }

    fn bucket(&self, region: usize) -> &[Slot] {
        &self.slots[self.region_start[region] as usize..self.region_start[region + 1] as usize]
    }
}

/// Regions side by side and one below the other in an image of this size, pixels.
pub(crate) fn grid(size: [usize; 2]) -> [usize; 2] {
    [size[0].div_ceil(REGION[0]), size[1].div_ceil(REGION[1])]
}

/// The runs of a view.
#[derive(Debug, Clone, Default)]
pub(crate) struct Bins {
    pub runs: Vec<Run>,
    /// By run: its splats are these of the whole.
    pub ranges: Vec<Range<usize>>,
    /// By run, then region: the region's slots before this run.
    slot_base: Vec<u32>,
    /// Number of regions.
    pub regions: usize,
}

impl Bins {
    pub fn new(runs: Vec<Run>, regions: usize) -> Self {
        let mut slot_base = Vec::with_capacity(runs.len() * regions);
        let mut ranges = Vec::with_capacity(runs.len());
        let mut total = vec![0u32; regions];
        let mut splats = 0;
        for run in &runs {
            slot_base.extend_from_slice(&total);
            (0..regions).for_each(|r| total[r] += run.region_start[r + 1] - run.region_start[r]);
            ranges.push(splats..splats + run.splats.len());
            splats += run.splats.len();
        }
        Bins { runs, ranges, slot_base, regions }
    }

    /// Calls `f(index in the run, region, slot)` for every place of every splat of one run, regions ascending.
    #[inline(always)]
    pub fn for_each_place(&self, run: usize, mut f: impl FnMut(usize, usize, usize)) {
        let (base, run) = (&self.slot_base[run * self.regions..], &self.runs[run]);
        for (index, places) in run.place_start.windows(2).enumerate() {
            for &(region, place) in &run.places[places[0] as usize..places[1] as usize] {
                f(index, region as usize, (base[region as usize] + place) as usize);
            }
        }
    }
}

/// Buffers of a sort that are used again and again.
#[derive(Debug, Default)]
struct Sorter {
    /// Bits of z, which are ordered as z is because z > 0, and the slot.
    from: Vec<(u32, u32)>,
    to: Vec<(u32, u32)>,
}

impl Sorter {
    /// Sorts `from` by key; equal keys stay in order. A radix sort: 11 bits at a time, lowest first.
    fn sort(&mut self) {
        const BITS: u32 = 11;
        const BUCKETS: usize = 1 << BITS;
        let digit = |key: u32, pass: u32| (key >> (pass * BITS)) as usize & (BUCKETS - 1);
        if self.from.len() < 256 {
            self.from.sort_unstable();
            return;
        }
        let mut counts = [[0u32; BUCKETS]; 3];
        for &(key, _) in &self.from {
            (0..3).for_each(|pass| counts[pass as usize][digit(key, pass)] += 1);
        }
        self.to.clear();
        self.to.resize(self.from.len(), (0, 0));
        for pass in 0..3 {
            let next = &mut counts[pass as usize];
            let first = digit(self.from[0].0, pass);
            if next[first] as usize == self.from.len() {
                // All keys have this digit: nothing would move.
                continue;
            }
            let mut sum = 0;
            next.iter_mut().for_each(|n| sum += std::mem::replace(n, sum));
            for &item in &self.from {
                let place = &mut next[digit(item.0, pass)];
                self.to[*place as usize] = item;
                *place += 1;
            }
            std::mem::swap(&mut self.from, &mut self.to);
        }
    }
}

/// What a thread needs to work on a region; the buffers are used again for the next one.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    /// In order of Gaussians.
    pub slots: Vec<Slot>,
    /// By slot: features, depth, zeros up to the stride.
    pub features: Vec<f32>,
    sorter: Sorter,
    /// Who meets which block: a bit per slot, in order of depth, [`WORD`] of them in a number; by number, band, column.
    bits: Vec<[[u64; COLUMNS]; ROWS]>,
}

/// Slots per number of [`Scratch::bits`].
const WORD: usize = 64;

/// The transpose of a matrix of 8 × 8 bits, a row per byte.
#[inline(always)]
fn transpose_bits(mut x: u64) -> u64 {
    // Swaps the off-diagonal quarters of ever larger blocks: of 2 × 2 bits, then 4 × 4, then 8 × 8.
    for (shift, mask) in [(7, 0x00AA_00AA_00AA_00AA), (14, 0x0000_CCCC_0000_CCCC), (28, 0x0000_0000_F0F0_F0F0)] {
        let t = (x ^ (x >> shift)) & mask;
        x ^= t ^ (t << shift);
    }
    x
}

/// For each of the sixteen columns of a band, which of these slots meet it.
#[inline(always)]
fn columns_of(masks: &[u16; WORD]) -> [u64; COLUMNS] {
    let mut columns = [[0u8; 8]; COLUMNS];
    for (group, masks) in masks.as_chunks::<8>().0.iter().enumerate() {
        for half in 0..2 {
            let mut rows = [0u8; 8];
            for k in 0..8 {
                rows[k] = (masks[k] >> (8 * half)) as u8;
            }
            let transposed = transpose_bits(u64::from_le_bytes(rows)).to_le_bytes();
            for k in 0..8 {
                columns[8 * half + k][group] = transposed[k];
            }
        }
    }
    columns.map(u64::from_le_bytes)
}

impl Scratch {
    /// Copies what the region's slots need to know of their splats.
    #[inline(always)]
    pub fn gather(&mut self, bins: &Bins, region: usize, features: &crate::Features, stride: usize) {
        let channels = features.channels;
        self.slots.clear();
        for run in &bins.runs {
            self.slots.extend_from_slice(run.bucket(region));
        }
        // Touched first, by a loop that does nothing else, so that many cache misses are under way at once.
        let touched = self
            .slots
            .iter()
            .fold(0u32, |bits, slot| bits | features.row(slot.gaussian as usize).first().map_or(0, |v| v.to_bits()));
        std::hint::black_box(touched);
        self.features.clear();
        self.features.resize(self.slots.len() * stride, 0.0);
        for (line, slot) in self.features.chunks_exact_mut(stride).zip(&self.slots) {
            // A loop of its own: lines are short, and a call for each costs more than the copy.
            for (to, from) in line.iter_mut().zip(features.row(slot.gaussian as usize)) {
                *to = *from;
            }
            line[channels] = slot.depth;
        }
    }

    /// Finds the order of depth and who meets which block of the region that was gathered.
    #[inline(always)]
    pub fn list(&mut self) {
        self.sorter.from.clear();
        for (slot, at) in (0..).zip(&self.slots) {
            self.sorter.from.push((at.depth.to_bits(), slot));
        }
        self.sorter.sort();
        self.bits.clear();
        for slots in self.sorter.from.chunks(WORD) {
            let mut masks = [[0u16; WORD]; ROWS];
            for (k, &(_, slot)) in slots.iter().enumerate() {
                let spans = &self.slots[slot as usize].spans;
                for band in 0..ROWS {
                    masks[band][k] = spans[band].mask();
                }
            }
            let mut bits = [[0; COLUMNS]; ROWS];
            for band in 0..ROWS {
                bits[band] = columns_of(&masks[band]);
            }
            self.bits.push(bits);
        }
    }

    /// A splat in the block whose centre is at `(x, y)`, px.
    #[inline(always)]
    pub fn prepare(&self, slot: u32, x: f64, y: f64) -> Prepared {
        self.slots[slot as usize].ellipse.prepare(x, y)
    }

    /// Number of (slot, block) pairs.
    pub fn entries(&self) -> u64 {
        self.bits.as_flattened().as_flattened().iter().map(|bits| bits.count_ones() as u64).sum()
    }

    /// The slots that meet a block, nearest first.
    #[inline(always)]
    pub fn of(&self, block: usize) -> BlockSlots<'_> {
        BlockSlots { scratch: self, band: block / COLUMNS, column: block % COLUMNS, word: 0, bits: 0 }
    }
}

/// See [`Scratch::of`]. Slots are looked up only when they are asked for: pixels are often saturated long before the end.
pub(crate) struct BlockSlots<'a> {
    scratch: &'a Scratch,
    band: usize,
    column: usize,
    word: usize,
    bits: u64,
}

impl BlockSlots<'_> {
    /// Fills `to` with the next slots and returns how many there were.
    #[inline(always)]
    pub fn next(&mut self, to: &mut [u32]) -> usize {
        let order = &self.scratch.sorter.from;
        let mut n = 0;
        while n < to.len() {
            if self.bits == 0 {
                let Some(bits) = self.scratch.bits.get(self.word) else { break };
                self.bits = bits[self.band][self.column];
                self.word += 1;
                continue;
            }
            let k = (self.word - 1) * WORD + self.bits.trailing_zeros() as usize;
            self.bits &= self.bits - 1;
            to[n] = order[k].1;
            n += 1;
        }
        n
    }
}

/// The entries of a region's blocks that matter: later ones find every pixel saturated.
#[derive(Debug, Clone, Default)]
pub(crate) struct Reached {
    /// Slots, per block in depth order.
    entries: Vec<u32>,
    /// Per block: how many entries.
    counts: Vec<u32>,
}

impl Drop for Reached {
    fn drop(&mut self) {
        ENTRIES.give(std::mem::take(&mut self.entries));
        ENTRIES.give(std::mem::take(&mut self.counts));
    }
}

impl Reached {
    /// Of no block yet.
    pub fn new() -> Self {
        let mut counts = ENTRIES.take();
        counts.reserve(ROWS * COLUMNS);
        Self { entries: ENTRIES.take(), counts }
    }

    /// Begins the next block.
    #[inline(always)]
    pub fn begin(&mut self) {
        self.counts.push(0);
    }

    /// Appends entries to the block.
    #[inline(always)]
    pub fn push(&mut self, entries: &[u32]) {
        self.entries.extend_from_slice(entries);
        if let Some(count) = self.counts.last_mut() {
            *count += entries.len() as u32;
        }
    }

    /// The blocks' entries in the order in which they were pushed.
    #[inline(always)]
    pub fn iter(&self) -> impl Iterator<Item = &[u32]> {
        let mut at = 0;
        self.counts.iter().map(move |&count| {
            let begin = at;
            at += count as usize;
            &self.entries[begin..at]
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sorting_keeps_ties_by_index() {
        let depths = [3.0f32, 0.5, 1e-30, 3.0, 7e20, 0.5, 0.500_000_06, 1.0];
        for n in [0, 5, 8, 300, 5000] {
            let from = (0..n).map(|i| (depths[i as usize * 5 % 8].to_bits(), i)).collect();
            let mut sorter = Sorter { from, ..Default::default() };
            let mut expected = sorter.from.clone();
            expected.sort();
            sorter.sort();
            assert_eq!(sorter.from, expected);
        }
        let mut same = Sorter { from: (0..400).map(|i| (7, i)).collect(), ..Default::default() };
        same.sort();
        assert!(same.from.iter().map(|v| v.1).eq(0..400));
    }

    #[test]
    fn spans_are_cut_at_the_region() {
        assert_eq!(Span::new((0, 0), 0), Span::NONE);
        assert_eq!(Span::NONE.mask(), 0);
        assert_eq!(Span::new((3, 40), 0).mask(), 0xFFF8);
        assert_eq!(Span::new((3, 40), 16).mask(), 0xFFFF);
        assert_eq!(Span::new((3, 40), 32).mask(), 0x00FF);
        assert_eq!(Span::new((3, 40), 48), Span::NONE);
        assert_eq!(Span::new((20, 21), 0), Span::NONE);
        assert_eq!(Span::new((31, 32), 16).mask(), 0x8000);
    }

    #[test]
    fn columns_are_the_transpose_of_masks() {
        let masks: [u16; WORD] = std::array::from_fn(|k| (k as u32 * 40_503 + 977) as u16);
        for (c, column) in columns_of(&masks).into_iter().enumerate() {
            for (k, mask) in masks.iter().enumerate() {
                assert_eq!(column >> k & 1, (mask >> c & 1) as u64, "column {c}, slot {k}");
            }
        }
    }

    #[test]
    fn block_lists_hold_each_span_in_depth_order() {
        let splat = |depth| Splat { depth, ..Default::default() };
        let slot = |depth, a: Range<u16>, b: Range<u16>| {
            let mut spans = [Span::NONE; ROWS];
            (spans[0], spans[7]) = (Span::new((a.start, a.end), 0), Span::new((b.start, b.end), 0));
            Slot { ellipse: Ellipse::default(), gaussian: 0, depth, spans }
        };
        let run = Run {
            splats: vec![splat(2.0), splat(9.0), splat(1.0)],
            slots: vec![slot(2.0, 0..2, 1..16), slot(9.0, 0..0, 2..3), slot(1.0, 1..3, 0..0)],
            region_start: vec![0, 3],
            place_start: vec![0, 1, 2, 3],
            places: vec![(0, 0), (0, 1), (0, 2)],
        };
        let bins = Bins::new(vec![run], 1);
        let mut scratch = Scratch::default();
        scratch.gather(&bins, 0, &crate::Features { channels: 0, data: Vec::new() }, 8);
        scratch.list();
        let all = |block: usize| {
            let (mut slots, mut of) = (vec![0; 5], scratch.of(block));
            let n = of.next(&mut slots);
            slots.truncate(n);
            slots
        };
        let of = |band: usize| (0..3).map(|b| all(COLUMNS * band + b)).collect::<Vec<_>>();
        assert_eq!(scratch.entries(), 20);
        assert_eq!(of(0), [vec![0], vec![2, 0], vec![2]]);
        assert_eq!(of(7), [vec![], vec![0], vec![0, 1]]);
        assert_eq!(all(127), [0]);
        let mut places = Vec::new();
        bins.for_each_place(0, |splat, region, slot| places.push((splat, region, slot)));
        assert_eq!(places, [(0, 0, 0), (1, 0, 1), (2, 0, 2)]);
    }
}
