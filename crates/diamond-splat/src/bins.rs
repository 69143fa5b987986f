//! Who is blended where, and in which order: depth order, rows, blocks.
//!
//! A row of the image, two bands of 4 × 4 blocks high, is the unit of work of a thread: it owns a contiguous piece of
//! the image, so rows run in parallel without sharing anything. Splats are sorted by view-space z once (ties by index).
//! Runs of consecutive ranks are then bucketed by row, each run on its own; a row's list is the concatenation of its
//! buckets, so that it is in depth order and nothing is shared here either. A splat's place in a row's list is its slot.
use crate::ellipse::{BANDS, BLOCK, Ellipse, band_spans, block_span};
use crate::lanes::Level;
use crate::projection::{Projection, Splat};
use pulp::{Simd, WithSimd};
use rayon::prelude::*;

/// Bands of a row.
pub(crate) const ROW_BANDS: usize = 2;
/// Height of a row, pixels.
pub(crate) const ROW: usize = ROW_BANDS * BLOCK;
/// Ranks per run.
const RUN: usize = 1024;

/// A splat in a row: its rank, and per band the blocks (first, one past last) that it meets.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Slot {
    pub rank: u32,
    pub spans: [(u16, u16); ROW_BANDS],
}

/// Consecutive ranks, bucketed by row.
#[derive(Debug, Clone, Default)]
struct Run {
    /// By row, then rank.
    slots: Vec<Slot>,
    /// Slots of row `r` are `row_start[r]..row_start[r + 1]`.
    row_start: Vec<u32>,
    /// By rank: the rows (first, one past last).
    rows: Vec<(u32, u32)>,
    /// By rank, then row: place in the row's bucket.
    places: Vec<u32>,
}

/// Splats in depth order and the rows that they meet.
#[derive(Debug, Clone, Default)]
pub(crate) struct Rows {
    /// Rank in depth → index into the projection's splats.
    pub order: Vec<u32>,
    /// By rank.
    pub ellipses: Vec<Ellipse>,
    runs: Vec<Run>,
    /// By run, then row: the row's slots before this run.
    slot_base: Vec<u32>,
    rows: usize,
}

/// Sorts by depth and assigns rows.
pub(crate) fn assign_rows(projection: &Projection, level: Level) -> Rows {
    let splats = &projection.splats;
    let k = &projection.camera.intrinsics;
    let rows = (k.height as usize).div_ceil(ROW);
    let blocks = (k.width as usize).div_ceil(BLOCK) as f32;
    let order = depth_order(splats);
    let mut ellipses = vec![Ellipse::default(); order.len()];
    let runs: Vec<Run> = order
        .par_chunks(RUN)
        .zip(ellipses.par_chunks_mut(RUN))
        .enumerate()
        .map(|(run, (ranks, ellipses))| {
            level.dispatch(Bucket { splats, first: (run * RUN) as u32, ranks, ellipses, rows, blocks })
        })
        .collect();
    let mut slot_base = Vec::with_capacity(runs.len() * rows);
    let mut total = vec![0u32; rows];
    for run in &runs {
        slot_base.extend_from_slice(&total);
        (0..rows).for_each(|r| total[r] += run.row_start[r + 1] - run.row_start[r]);
    }
    Rows { order, ellipses, runs, slot_base, rows }
}

impl Rows {
    /// Number of rows.
    pub fn len(&self) -> usize {
        self.rows
    }

    /// The slots of one row, in depth order.
    pub fn slots(&self, row: usize) -> Vec<Slot> {
        let buckets = || self.runs.iter().map(|run| &run.slots[run.row_start[row] as usize..run.row_start[row + 1] as usize]);
        let mut slots = Vec::with_capacity(buckets().map(<[Slot]>::len).sum());
        buckets().for_each(|bucket| slots.extend_from_slice(bucket));
        slots
    }

    /// Calls `f(rank, its (row, slot) pairs in order of rows)` for every rank of one run.
    pub fn for_each_rank(&self, run: usize, mut f: impl FnMut(usize, &mut dyn Iterator<Item = (usize, usize)>)) {
        let (base, run, first) = (&self.slot_base[run * self.rows..], &self.runs[run], run * RUN);
        let mut at = 0;
        for (k, &(begin, end)) in run.rows.iter().enumerate() {
            let places = &run.places[at..at + (end - begin) as usize];
            at += places.len();
            let mut slots = (begin..end).zip(places).map(|(row, &place)| (row as usize, (base[row as usize] + place) as usize));
            f(first + k, &mut slots);
        }
    }

    /// Ranks per run; the last may have fewer.
    pub const RUN: usize = RUN;
}

/// Order by view-space z, ties by index: a radix sort of the bits of z, which are ordered as z is because z > 0.
fn depth_order(splats: &[Splat]) -> Vec<u32> {
    const BITS: u32 = 11;
    const BUCKETS: usize = 1 << BITS;
    let mut from: Vec<(u32, u32)> = splats.iter().zip(0..).map(|(s, i)| (s.depth.to_bits(), i)).collect();
    let mut to = vec![(0u32, 0u32); from.len()];
    let mut counts = vec![[0u32; 3]; BUCKETS];
    let digit = |key: u32, pass: u32| (key >> (pass * BITS)) as usize & (BUCKETS - 1);
    for &(key, _) in &from {
        (0..3).for_each(|pass| counts[digit(key, pass)][pass as usize] += 1);
    }
    let mut next = [0u32; 3];
    for count in &mut counts {
        for pass in 0..3 {
            next[pass] += std::mem::replace(&mut count[pass], next[pass]);
        }
    }
    for pass in 0..3 {
        // All keys in one bucket: nothing would move.
        let first = from.first().map_or(0, |&(key, _)| digit(key, pass));
        let moves = from.iter().any(|&(key, _)| digit(key, pass) != first);
        if !moves {
            continue;
        }
        for &item in &from {
            let place = &mut counts[digit(item.0, pass)][pass as usize];
            to[*place as usize] = item;
            *place += 1;
        }
        std::mem::swap(&mut from, &mut to);
    }
    from.into_iter().map(|(_, i)| i).collect()
}

struct Bucket<'a> {
    splats: &'a [Splat],
    /// The first of the ranks.
    first: u32,
    /// Rank → splat.
    ranks: &'a [u32],
    /// By rank; to be filled.
    ellipses: &'a mut [Ellipse],
    rows: usize,
    blocks: f32,
}

impl WithSimd for Bucket<'_> {
    type Output = Run;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> Run {
        let Bucket { splats, first: first_rank, ranks, ellipses, rows, blocks } = self;
        let mut run = Run {
            row_start: vec![0; rows + 1],
            rows: Vec::with_capacity(ranks.len()),
            ..Default::default()
        };
        // Gathered first, by a loop that does nothing else, so that many cache misses are under way at once.
        let mut gathered = Vec::with_capacity(ranks.len());
        for &i in ranks {
            gathered.push(splats[i as usize]);
        }
        let mut by_rank: Vec<Slot> = Vec::with_capacity(4 * ranks.len());
        for (rank, splat) in gathered.iter().enumerate() {
            ellipses[rank] = Ellipse::new(splat);
            let (first, past) = (splat.rows[0] as usize / ROW, (splat.rows[1] as usize).div_ceil(ROW));
            run.rows.push((first as u32, past as u32));
            let mut row = first;
            while row < past {
                let count = (past - row).min(BANDS / ROW_BANDS);
                let (low, high) = band_spans(s, splat, row * ROW_BANDS, count * ROW_BANDS);
                for k in 0..count {
                    let span = |band: usize| block_span(low[ROW_BANDS * k + band], high[ROW_BANDS * k + band], blocks);
                    by_rank.push(Slot { rank: first_rank + rank as u32, spans: [span(0), span(1)] });
                    run.places.push(run.row_start[row + k + 1]);
                    run.row_start[row + k + 1] += 1;
                }
                row += count;
            }
        }
        for r in 0..rows {
            run.row_start[r + 1] += run.row_start[r];
        }
        run.slots = vec![Slot::default(); by_rank.len()];
        let mut at = 0;
        for &(first, past) in &run.rows {
            for row in first..past {
                run.slots[(run.row_start[row as usize] + run.places[at]) as usize] = by_rank[at];
                at += 1;
            }
        }
        run
    }
}

/// The lists of the blocks of one row.
#[derive(Debug, Clone, Default)]
pub(crate) struct BlockLists {
    /// Slot → rank.
    pub ranks: Vec<u32>,
    /// Entries of block `b` of band `a` are `start[a][b]..start[a][b + 1]`.
    pub start: [Vec<u32>; ROW_BANDS],
    /// Slots, per block in depth order.
    pub entries: Vec<u32>,
    /// Per block, how many of its entries matter; later ones find every pixel saturated.
    pub reach: [Vec<u32>; ROW_BANDS],
}

impl BlockLists {
    /// The lists of a row of an image of this many blocks per band.
    pub fn new(slots: &[Slot], blocks: usize) -> Self {
        let mut lists = BlockLists { ranks: Vec::with_capacity(slots.len()), ..Default::default() };
        for slot in slots {
            lists.ranks.push(slot.rank);
        }
        // Counts as running sums of where spans begin and end.
        let mut total = 0u32;
        for band in 0..ROW_BANDS {
            let mut change = vec![0u32; blocks + 1];
            for slot in slots {
                let (first, past) = slot.spans[band];
                change[first as usize] = change[first as usize].wrapping_add(1);
                change[past as usize] = change[past as usize].wrapping_sub(1);
            }
            let mut covering = 0u32;
            let mut start = Vec::with_capacity(blocks + 1);
            start.push(total);
            for &change in &change[..blocks] {
                covering = covering.wrapping_add(change);
                total += covering;
                start.push(total);
            }
            lists.start[band] = start;
            lists.reach[band] = vec![0; blocks];
        }
        lists.entries = vec![0; total as usize];
        for band in 0..ROW_BANDS {
            let mut next = lists.start[band].clone();
            for (k, slot) in slots.iter().enumerate() {
                let (first, past) = slot.spans[band];
                for next in &mut next[first as usize..past as usize] {
                    lists.entries[*next as usize] = k as u32;
                    *next += 1;
                }
            }
        }
        lists
    }

    /// The entries of a block.
    #[inline(always)]
    pub fn of(&self, band: usize, block: usize) -> &[u32] {
        let start = &self.start[band];
        &self.entries[start[block] as usize..start[block + 1] as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_order_sorts_and_keeps_ties_by_index() {
        let depths = [3.0f32, 0.5, 1e-30, 3.0, 7e20, 0.5, 0.500_000_06, 1.0];
        let splats: Vec<Splat> = depths.iter().map(|&depth| Splat { depth, ..Default::default() }).collect();
        assert_eq!(depth_order(&splats), [2, 1, 5, 6, 7, 0, 3, 4]);
        assert!(depth_order(&[]).is_empty());
        let same = vec![Splat { depth: 2.0, ..Default::default() }; 5];
        assert_eq!(depth_order(&same), [0, 1, 2, 3, 4]);
    }

    #[test]
    fn block_lists_hold_each_span_in_order() {
        let slot = |rank, a, b| Slot { rank, spans: [a, b] };
        let slots = [slot(7, (0, 2), (1, 3)), slot(9, (0, 0), (2, 3)), slot(11, (1, 3), (0, 0))];
        let lists = BlockLists::new(&slots, 3);
        assert_eq!(lists.ranks, [7, 9, 11]);
        let of = |band| (0..3).map(|b| lists.of(band, b).to_vec()).collect::<Vec<_>>();
        assert_eq!(of(0), [vec![0], vec![0, 2], vec![2]]);
        assert_eq!(of(1), [vec![], vec![0], vec![0, 1]]);
    }
}
