//! Who is blended where, and in which order: rows, depth order within a row, blocks.
//!
//! A row of the image, two bands of 4 × 4 blocks high, is the unit of work of a thread: it owns a contiguous piece of
//! the image, so rows run in parallel without sharing anything. Runs of consecutive Gaussians are projected and
//! bucketed by row, each run on its own; a row's list is the concatenation of its buckets, so nothing is shared here
//! either. A splat's place in a row's list is its slot. Each row sorts its slots by view-space z, ties by index, which
//! costs less than one large sort, because everything that a row reads then lies close together.
use crate::ellipse::{BANDS, BLOCK, Ellipse, Prepared, RowEllipse, band_spans, block_span};
use crate::projection::{Outline, Splat};
use pulp::Simd;
use std::ops::Range;

/// Bands of a row.
pub(crate) const ROW_BANDS: usize = 2;
/// Height of a row, pixels.
pub(crate) const ROW: usize = ROW_BANDS * BLOCK;

/// A splat in a row: all that the kernels need to know of it, so that a row reads one stretch of memory per run and
/// nothing from elsewhere.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Slot {
    /// Position and shape.
    pub ellipse: RowEllipse,
    /// Index of the Gaussian.
    pub gaussian: u32,
    /// View-space z.
    pub depth: f32,
    /// Per band the blocks (first, one past last) that it meets.
    pub spans: [(u16, u16); ROW_BANDS],
}

/// The splats of consecutive Gaussians, bucketed by row.
#[derive(Debug, Clone, Default)]
pub(crate) struct Run {
    /// In order of Gaussians.
    pub splats: Vec<Splat>,
    /// By row, then splat.
    slots: Vec<Slot>,
    /// Slots of row `r` are `row_start[r]..row_start[r + 1]`.
    row_start: Vec<u32>,
    /// By splat: the rows (first, one past last).
    rows: Vec<(u32, u32)>,
    /// By splat, then row: place in the row's bucket.
    places: Vec<u32>,
}

impl Run {
    /// Buckets the splats of one run in an image of so many rows and blocks per band.
    #[inline(always)]
    pub fn new<S: Simd>(s: S, splats: Vec<Splat>, outlines: &[Outline], rows: usize, blocks: usize) -> Self {
        let mut run = Run { row_start: vec![0; rows + 1], rows: Vec::with_capacity(splats.len()), ..Default::default() };
        let mut by_splat: Vec<Slot> = Vec::with_capacity(4 * splats.len());
        for (splat, outline) in splats.iter().zip(outlines) {
            let ellipse = Ellipse::new(splat);
            let (first, past) = (outline.rows[0] as usize / ROW, (outline.rows[1] as usize).div_ceil(ROW));
            run.rows.push((first as u32, past as u32));
            let mut row = first;
            while row < past {
                let count = (past - row).min(BANDS / ROW_BANDS);
                let (low, high) = band_spans(s, splat, outline, row * ROW_BANDS, count * ROW_BANDS);
                for k in 0..count {
                    let span = |band: usize| {
                        block_span(low[ROW_BANDS * k + band], high[ROW_BANDS * k + band], blocks as f32)
                    };
                    by_splat.push(Slot {
                        ellipse: ellipse.in_row(((row + k) * ROW) as f64 + 0.5 * ROW as f64),
                        gaussian: splat.gaussian,
                        depth: splat.depth,
                        spans: [span(0), span(1)],
                    });
                    run.places.push(run.row_start[row + k + 1]);
                    run.row_start[row + k + 1] += 1;
                }
                row += count;
            }
        }
        for r in 0..rows {
            run.row_start[r + 1] += run.row_start[r];
        }
        run.slots = vec![Slot::default(); by_splat.len()];
        let mut at = 0;
        for &(first, past) in &run.rows {
            for row in first..past {
                run.slots[(run.row_start[row as usize] + run.places[at]) as usize] = by_splat[at];
                at += 1;
            }
        }
        run.splats = splats;
        run
    }

    fn bucket(&self, row: usize) -> &[Slot] {
        &self.slots[self.row_start[row] as usize..self.row_start[row + 1] as usize]
    }
}

/// The runs of a view.
#[derive(Debug, Clone, Default)]
pub(crate) struct Rows {
    pub runs: Vec<Run>,
    /// By run: its splats are these of the whole.
    pub ranges: Vec<Range<usize>>,
    /// By run, then row: the row's slots before this run.
    slot_base: Vec<u32>,
    rows: usize,
}

impl Rows {
    pub fn new(runs: Vec<Run>, rows: usize) -> Self {
        let mut slot_base = Vec::with_capacity(runs.len() * rows);
        let mut ranges = Vec::with_capacity(runs.len());
        let mut total = vec![0u32; rows];
        let mut splats = 0;
        for run in &runs {
            slot_base.extend_from_slice(&total);
            (0..rows).for_each(|r| total[r] += run.row_start[r + 1] - run.row_start[r]);
            ranges.push(splats..splats + run.splats.len());
            splats += run.splats.len();
        }
        Rows { runs, ranges, slot_base, rows }
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.rows
    }

    /// Calls `f(index in the run, row, slot)` for every place of every splat of one run, rows ascending.
    #[inline(always)]
    pub fn for_each_place(&self, run: usize, mut f: impl FnMut(usize, usize, usize)) {
        let (base, run) = (&self.slot_base[run * self.rows..], &self.runs[run]);
        let mut at = 0;
        for (index, &(first, past)) in run.rows.iter().enumerate() {
            for row in first as usize..past as usize {
                f(index, row, (base[row] + run.places[at]) as usize);
                at += 1;
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

/// What a thread needs to work on a row; the buffers are used again for the next row.
#[derive(Debug, Default)]
pub(crate) struct RowScratch {
    /// In order of Gaussians.
    pub slots: Vec<Slot>,
    /// By slot: features, depth, zeros up to the stride.
    pub features: Vec<f32>,
    sorter: Sorter,
    /// By slot, once more: in the order of depth it is read at random.
    spans: Vec<[(u16, u16); ROW_BANDS]>,
    change: Vec<u32>,
    /// Entries of block `b` of band `a` are `start[a][b]..start[a][b + 1]`.
    start: [Vec<u32>; ROW_BANDS],
    /// Slots, per block in depth order.
    entries: Vec<u32>,
}

impl RowScratch {
    /// Copies what the row's slots need to know of their splats: a row's worth fits in the cache.
    #[inline(always)]
    pub fn gather(&mut self, rows: &Rows, row: usize, features: &crate::Features, stride: usize) {
        let channels = features.channels;
        self.slots.clear();
        for run in &rows.runs {
            self.slots.extend_from_slice(run.bucket(row));
        }
        // Touched first, by a loop that does nothing else, so that many cache misses are under way at once.
        let touched = self.slots.iter().fold(0u32, |bits, slot| {
            bits | features.row(slot.gaussian as usize).first().map_or(0, |v| v.to_bits())
        });
        std::hint::black_box(touched);
        self.features.clear();
        self.features.resize(self.slots.len() * stride, 0.0);
        for (line, slot) in self.features.chunks_exact_mut(stride).zip(&self.slots) {
            // A loop of its own: rows are short, and a call for each costs more than the copy.
            for (to, from) in line.iter_mut().zip(features.row(slot.gaussian as usize)) {
                *to = *from;
            }
            line[channels] = slot.depth;
        }
    }

    /// A splat in the block of a band whose centre has this x, px.
    #[inline(always)]
    pub fn prepare(&self, slot: u32, x: f64, band: usize) -> Prepared {
        let y = (band * BLOCK) as f64 + 0.5 * BLOCK as f64 - 0.5 * ROW as f64;
        self.slots[slot as usize].ellipse.prepare(x, y)
    }

    /// Makes the lists of the row that was gathered, of an image of this many blocks per band.
    #[inline(always)]
    pub fn list(&mut self, blocks: usize) {
        // Counts as running sums of where spans begin and end.
        let size = blocks + 1;
        self.change.clear();
        self.change.resize(2 * ROW_BANDS * size, 0);
        let (begins, ends) = self.change.split_at_mut(ROW_BANDS * size);
        self.sorter.from.clear();
        self.spans.clear();
        for (slot, at) in (0..).zip(&self.slots) {
            self.sorter.from.push((at.depth.to_bits(), slot));
            self.spans.push(at.spans);
            for band in 0..ROW_BANDS {
                let (first, past) = at.spans[band];
                begins[band * size + first as usize] += 1;
                ends[band * size + past as usize] += 1;
            }
        }
        let mut total = 0u32;
        for band in 0..ROW_BANDS {
            let mut covering = 0u32;
            let start = &mut self.start[band];
            start.clear();
            start.push(total);
            for block in 0..blocks {
                covering = covering + begins[band * size + block] - ends[band * size + block];
                total += covering;
                start.push(total);
            }
        }
        self.sorter.sort();
        self.entries.resize(total as usize, 0);
        for band in 0..ROW_BANDS {
            self.change.clear();
            self.change.extend_from_slice(&self.start[band]);
            for &(_, slot) in &self.sorter.from {
                let (first, past) = self.spans[slot as usize][band];
                for next in &mut self.change[first as usize..past as usize] {
                    self.entries[*next as usize] = slot;
                    *next += 1;
                }
            }
        }
    }

    /// Number of entries.
    pub fn entries(&self) -> usize {
        self.entries.len()
    }

    /// The entries of a block.
    #[inline(always)]
    pub fn of(&self, band: usize, block: usize) -> &[u32] {
        let start = &self.start[band];
        &self.entries[start[block] as usize..start[block + 1] as usize]
    }
}

/// The entries of a row's blocks that matter: later ones find every pixel saturated. Blocks side by side, each with
/// its bands.
#[derive(Debug, Clone, Default)]
pub(crate) struct Reached {
    /// Slots, per block in depth order.
    entries: Vec<u32>,
    /// Per block: how many entries.
    counts: Vec<u32>,
}

impl Reached {
    /// For so many blocks and entries.
    pub fn with_capacity(blocks: usize, entries: usize) -> Self {
        Self { entries: Vec::with_capacity(entries), counts: Vec::with_capacity(blocks) }
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
    fn block_lists_hold_each_span_in_depth_order() {
        let splat = |depth| Splat { depth, ..Default::default() };
        let slot = |depth, a, b| Slot { depth, spans: [a, b], ..Default::default() };
        let run = Run {
            splats: vec![splat(2.0), splat(9.0), splat(1.0)],
            slots: vec![slot(2.0, (0, 2), (1, 3)), slot(9.0, (0, 0), (2, 3)), slot(1.0, (1, 3), (0, 0))],
            row_start: vec![0, 3],
            rows: vec![(0, 1); 3],
            places: vec![0, 1, 2],
        };
        let rows = Rows::new(vec![run], 1);
        let mut scratch = RowScratch::default();
        let features = crate::Features { channels: 0, data: Vec::new() };
        scratch.gather(&rows, 0, &features, 8);
        scratch.list(3);
        let of = |band| (0..3).map(|b| scratch.of(band, b).to_vec()).collect::<Vec<_>>();
        assert_eq!(of(0), [vec![0], vec![2, 0], vec![2]]);
        assert_eq!(of(1), [vec![], vec![0], vec![0, 1]]);
        let mut places = Vec::new();
        rows.for_each_place(0, |splat, row, slot| places.push((splat, row, slot)));
        assert_eq!(places, [(0, 0, 0), (1, 0, 1), (2, 0, 2)]);
    }
}
