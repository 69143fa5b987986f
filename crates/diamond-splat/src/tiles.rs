//! Who is blended where, and in which order: depth order, rows of tiles, tiles, blocks.
//!
//! A row of 8 × 8 tiles is the unit of work of a thread: it owns a contiguous piece of the image, so rows run in
//! parallel without sharing anything. Splats are sorted by view-space z once (ties by index); each row keeps its
//! splats in that order, and each tile of the row keeps the slots of the splats whose ellipse meets it, with four bits
//! that say which of its 4 × 4 blocks.
use crate::ellipse::{BLOCK, Ellipse, RowSplat, TILE};
use crate::projection::Projection;
use rayon::prelude::*;

/// Below this many keys one thread sorts faster than a pool.
const PARALLEL_SORT: usize = 1 << 15;

/// Splats in depth order and the rows of tiles they meet.
#[derive(Debug, Clone)]
pub(crate) struct Rows {
    /// Rank in depth → index into the projection's splats.
    pub order: Vec<u32>,
    /// By rank.
    pub ellipses: Vec<Ellipse>,
    /// By rank: index of the Gaussian and view-space z.
    pub sources: Vec<(u32, f32)>,
    /// Slots of row `r` are `row_start[r]..row_start[r + 1]`.
    pub row_start: Vec<usize>,
    /// Slot → rank.
    pub slot_rank: Vec<u32>,
    /// By rank: the rows (first, one past last).
    pub spans: Vec<(u32, u32)>,
    /// The slots of a rank are `rank_slots[rank_start[rank]..rank_start[rank + 1]]`, in order of rows.
    pub rank_start: Vec<usize>,
    /// See `rank_start`.
    pub rank_slots: Vec<u32>,
}

/// Sorts by depth and assigns rows.
pub(crate) fn assign_rows(projection: &Projection) -> Rows {
    let splats = &projection.splats;
    let height = projection.camera.intrinsics.height;
    let mut keys: Vec<u64> =
        splats.iter().enumerate().map(|(i, s)| ((s.depth.to_bits() as u64) << 32) | i as u64).collect();
    if keys.len() < PARALLEL_SORT {
        keys.sort_unstable()
    } else {
        keys.par_sort_unstable()
    }
    let order: Vec<u32> = keys.iter().map(|&k| k as u32).collect();
    let (ellipses, spans): (Vec<Ellipse>, Vec<(u32, u32)>) = order
        .par_iter()
        .with_min_len(1024)
        .map(|&i| {
            let s = &splats[i as usize];
            (Ellipse::new(s), (s.rows[0] / TILE as u32, s.rows[1].div_ceil(TILE as u32)))
        })
        .unzip();
    let sources = order.iter().map(|&i| (splats[i as usize].gaussian, splats[i as usize].depth)).collect();
    let rows = (height as usize).div_ceil(TILE);
    let mut row_start = vec![0usize; rows + 1];
    let mut rank_start = Vec::with_capacity(spans.len() + 1);
    let mut total = 0;
    for &(a, b) in &spans {
        rank_start.push(total);
        total += (b - a) as usize;
        (a..b).for_each(|r| row_start[r as usize + 1] += 1);
    }
    rank_start.push(total);
    (0..rows).for_each(|r| row_start[r + 1] += row_start[r]);
    let mut next = row_start.clone();
    let mut slot_rank = vec![0u32; total];
    let mut rank_slots = Vec::with_capacity(total);
    for (rank, &(a, b)) in spans.iter().enumerate() {
        for r in a as usize..b as usize {
            slot_rank[next[r]] = rank as u32;
            rank_slots.push(next[r] as u32);
            next[r] += 1;
        }
    }
    Rows { order, ellipses, sources, row_start, slot_rank, spans, rank_start, rank_slots }
}

/// The lists of the tiles of one row.
#[derive(Debug, Clone, Default)]
pub(crate) struct TileLists {
    /// By slot.
    pub splats: Vec<RowSplat>,
    /// By slot: the features, the depth, zeros up to the scene's stride. A copy of one's own for every row, because a
    /// row's worth fits in the cache and the features of all splats do not.
    pub features: Vec<f32>,
    /// Entries of tile `t` are `start[t]..start[t + 1]`.
    pub start: Vec<u32>,
    /// `slot within the row << 4 | block bits`, in depth order.
    pub entries: Vec<u32>,
    /// Per tile and block: how many of the tile's entries matter; later ones find every pixel saturated.
    pub reach: Vec<[u32; 4]>,
}

/// Slot of an entry.
#[inline(always)]
pub(crate) fn entry_slot(entry: u32) -> usize {
    (entry >> 4) as usize
}

/// Builds the lists of row `row` for its splats `ranks`. To be called where the vector instruction set is enabled: it
/// has roots and roundings in it.
#[inline(always)]
pub(crate) fn tile_lists(ellipses: &[Ellipse], ranks: &[u32], row: usize, width: usize, height: usize) -> TileLists {
    let tiles = width.div_ceil(TILE);
    let blocks = width.div_ceil(BLOCK) as f32;
    let top = row * TILE;
    let middle = top + BLOCK;
    let bottom = (top + TILE).min(height);
    // The bands' pixel centres.
    let upper = (top as f64 + 0.5, middle.min(height) as f64 - 0.5);
    let lower = (middle as f64 + 0.5, bottom as f64 - 0.5);
    let mut lists = TileLists { reach: vec![[0; 4]; tiles], ..Default::default() };
    let mut counts = vec![0u32; tiles + 1];
    // Blocks (first, one past last) of the upper and the lower band.
    let mut spans: Vec<[u16; 4]> = Vec::with_capacity(ranks.len());
    lists.splats.reserve(ranks.len());
    // Gathered first, by a loop that does nothing else, so that many cache misses are under way at once.
    let mut gathered = Vec::with_capacity(ranks.len());
    for &rank in ranks {
        gathered.push(ellipses[rank as usize]);
    }
    for ellipse in &gathered {
        lists.splats.push(ellipse.in_row(middle as f64));
        let a = block_span(ellipse.band(upper.0, upper.1), blocks);
        let b = if middle < bottom { block_span(ellipse.band(lower.0, lower.1), blocks) } else { (0, 0) };
        let span = [a.0, a.1, b.0, b.1];
        for_each_tile(span, |tile, _| counts[tile + 1] += 1);
        spans.push(span);
    }
    for t in 0..tiles {
        counts[t + 1] += counts[t];
    }
    let mut next = counts.clone();
    lists.entries = vec![0; counts[tiles] as usize];
    for (slot, &span) in spans.iter().enumerate() {
        for_each_tile(span, |tile, mask| {
            lists.entries[next[tile] as usize] = (slot as u32) << 4 | mask;
            next[tile] += 1;
        });
    }
    lists.start = counts;
    lists
}

/// The blocks (first, one past last) that have a pixel centre between `low` and `high` (px). A block's outer pixel
/// centres are at 4b + 0.5 and 4b + 3.5; conversion to integers rounds toward zero.
#[inline(always)]
fn block_span((low, high): (f32, f32), blocks: f32) -> (u16, u16) {
    let first = ((low + 0.5) * 0.25).max(0.0).min(blocks) as i32;
    let past = ((high + 3.5) * 0.25).max(0.0).min(blocks) as i32;
    if low > high { (0, 0) } else { (first as u16, past as u16) }
}

/// Calls `f(tile, block bits)` for every tile that has a block in one of the two spans.
#[inline(always)]
fn for_each_tile(span: [u16; 4], mut f: impl FnMut(usize, u32)) {
    let [a0, a1, b0, b1] = span.map(u32::from);
    let (first, past) = match (a0 < a1, b0 < b1) {
        (true, true) => (a0.min(b0), a1.max(b1)),
        (true, false) => (a0, a1),
        (false, true) => (b0, b1),
        (false, false) => return,
    };
    let within = |block: u32, lo: u32, hi: u32| (lo <= block && block < hi) as u32;
    for tile in first / 2..past.div_ceil(2) {
        let (left, right) = (2 * tile, 2 * tile + 1);
        let mask =
            within(left, a0, a1) | within(right, a0, a1) << 1 | within(left, b0, b1) << 2 | within(right, b0, b1) << 3;
        if mask != 0 {
            f(tile as usize, mask);
        }
    }
}
