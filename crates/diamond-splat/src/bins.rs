//! Who is blended where, and in which order: regions, depth order within a region, blocks.
//!
//! A region of 64 × 32 pixels is the unit of work of a thread: all that it reads and writes fits in the second cache,
//! and few splats meet more than two. Runs of consecutive Gaussians are projected and bucketed by region, each run on
//! its own; a region's list is the concatenation of its buckets, so that nothing is shared. A splat's place in a
//! region's list is its slot. Each region sorts its slots by view-space z, ties by index, which costs less than one
//! large sort, because everything that is read then lies close together.
use crate::ellipse::{BANDS, BLOCK, Ellipse, Prepared, band_spans, block_span};
use crate::projection::{Outline, Splat};
use pulp::Simd;
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

    /// First and one past last.
    #[inline(always)]
    fn range(self) -> Range<usize> {
        let last = (self.0 & 15) as usize;
        (self.0 >> 4) as usize..last + 1
    }
}

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

impl Run {
    /// Buckets the splats of one run in an image of this size, pixels.
    #[inline(always)]
    pub fn new<S: Simd>(s: S, splats: Vec<Splat>, outlines: &[Outline], size: [usize; 2]) -> Self {
        let grid = grid(size);
        let blocks = size[0].div_ceil(BLOCK) as f32;
        let mut run = Run {
            region_start: vec![0; grid[0] * grid[1] + 1],
            place_start: Vec::with_capacity(splats.len() + 1),
            places: Vec::with_capacity(3 * splats.len()),
            ..Default::default()
        };
        let mut by_splat: Vec<Slot> = Vec::with_capacity(3 * splats.len());
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
        run.slots = vec![nothing; by_splat.len()];
        for (slot, &(region, place)) in by_splat.iter().zip(&run.places) {
            run.slots[(run.region_start[region as usize] + place) as usize] = *slot;
        }
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
    /// By slot, once more: in the order of depth it is read at random.
    spans: Vec<[Span; ROWS]>,
    /// Entries of block `b` are `start[b]..start[b + 1]`, blocks row by row.
    start: Vec<u32>,
    next: Vec<u32>,
    /// Slots, per block in depth order.
    entries: Vec<u32>,
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

    /// Makes the lists of the region that was gathered.
    #[inline(always)]
    pub fn list(&mut self) {
        // Counts as running sums of where spans begin and end.
        const SIZE: usize = COLUMNS + 1;
        let (mut begins, mut ends) = ([[0u32; SIZE]; ROWS], [[0u32; SIZE]; ROWS]);
        self.sorter.from.clear();
        self.spans.clear();
        for (slot, at) in (0..).zip(&self.slots) {
            self.sorter.from.push((at.depth.to_bits(), slot));
            self.spans.push(at.spans);
            for band in 0..ROWS {
                let span = at.spans[band].range();
                begins[band][span.start] += 1;
                ends[band][span.end] += 1;
            }
        }
        self.start.clear();
        let mut total = 0u32;
        for band in 0..ROWS {
            let mut covering = 0u32;
            for block in 0..COLUMNS {
                self.start.push(total);
                // An empty span ends where it begins.
                covering = covering + begins[band][block] - ends[band][block];
                total += covering;
            }
        }
        self.start.push(total);
        self.sorter.sort();
        self.entries.resize(total as usize, 0);
        self.next.clear();
        self.next.extend_from_slice(&self.start);
        for &(_, slot) in &self.sorter.from {
            let spans = &self.spans[slot as usize];
            for (span, next) in spans.iter().zip(self.next.chunks_exact_mut(COLUMNS)) {
                for next in &mut next[span.range()] {
                    self.entries[*next as usize] = slot;
                    *next += 1;
                }
            }
        }
    }

    /// A splat in the block whose centre is at `(x, y)`, px.
    #[inline(always)]
    pub fn prepare(&self, slot: u32, x: f64, y: f64) -> Prepared {
        self.slots[slot as usize].ellipse.prepare(x, y)
    }

    /// Number of entries.
    pub fn entries(&self) -> usize {
        self.entries.len()
    }

    /// The entries of a block.
    #[inline(always)]
    pub fn of(&self, block: usize) -> &[u32] {
        &self.entries[self.start[block] as usize..self.start[block + 1] as usize]
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

impl Reached {
    /// For so many entries.
    pub fn with_capacity(entries: usize) -> Self {
        Self { entries: Vec::with_capacity(entries), counts: Vec::with_capacity(ROWS * COLUMNS) }
    }

    /// Appends the entries of the next block.
    #[inline(always)]
    pub fn push(&mut self, entries: &[u32]) {
        self.entries.extend_from_slice(entries);
        self.counts.push(entries.len() as u32);
    }

    /// Gives back what was reserved too much.
    pub fn shrink(&mut self) {
        self.entries.shrink_to_fit();
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
            let mut sorter = Sorter::default();
            sorter.from = (0..n).map(|i| (depths[i as usize * 5 % 8].to_bits(), i)).collect();
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
        assert!(Span::NONE.range().is_empty());
        assert_eq!(Span::new((3, 40), 0).range(), 3..16);
        assert_eq!(Span::new((3, 40), 16).range(), 0..16);
        assert_eq!(Span::new((3, 40), 32).range(), 0..8);
        assert_eq!(Span::new((3, 40), 48), Span::NONE);
        assert_eq!(Span::new((20, 21), 0), Span::NONE);
        assert_eq!(Span::new((31, 32), 16).range(), 15..16);
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
        let of = |band: usize| (0..3).map(|b| scratch.of(COLUMNS * band + b).to_vec()).collect::<Vec<_>>();
        assert_eq!(of(0), [vec![0], vec![2, 0], vec![2]]);
        assert_eq!(of(7), [vec![], vec![0], vec![0, 1]]);
        assert_eq!(scratch.of(127), [0]);
        let mut places = Vec::new();
        bins.for_each_place(0, |splat, region, slot| places.push((splat, region, slot)));
        assert_eq!(places, [(0, 0, 0), (1, 0, 1), (2, 0, 2)]);
    }
}
