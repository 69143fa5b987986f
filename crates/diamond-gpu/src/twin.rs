//! The twin of each stage on the CPU: the same arrays in and out, by the shortest code that can be trusted, in f64 where kernels
//! have to be careful in f32. Slow, and meant to be.
//!
//! The projection and the gradients' formulas are those of `diamond-splat`; what the stages make of a scene together is
//! compared with its rasteriser as a whole.
use crate::frame::{Coverage, GaussianGrad, Splat, TILE};
use crate::shape::Column;
use crate::{GpuError, HostState, Stage};

mod backward;

pub use backward::{blend_pull, projection_pull, splat_sum};

/// κ, κ² = ½ log2 e.
pub(crate) fn kappa() -> f64 {
    (0.5 * std::f64::consts::LOG2_E).sqrt()
}

/// Runs the twin of a stage.
///
/// # Errors
/// What the CPU's rasteriser refuses.
pub fn run(stage: Stage, state: &mut HostState) -> Result<(), GpuError> {
    match stage {
        Stage::Projection => return projection(state),
        Stage::DepthSort => depth_sort(state),
        Stage::TileOffsets => tile_offsets(state),
        Stage::TileEntries => tile_entries(state),
        Stage::TileSort => tile_sort(state),
        Stage::TileRanges => tile_ranges(state),
        Stage::Blend => blend(state),
        Stage::BlendPull => blend_pull(state),
        Stage::SplatSum => splat_sum(state),
        Stage::ProjectionPull => projection_pull(state),
    }
    Ok(())
}

/// As (high, low).
fn pair(v: f64) -> [f32; 2] {
    let high = v as f32;
    [high, (v - f64::from(high)) as f32]
}

/// The sum of (high, low).
pub(crate) fn whole(high: f32, low: f32) -> f64 {
    f64::from(high) + f64::from(low)
}

/// Ellipses, outlines, keys of depth, tiles per Gaussian: from the CPU's projection.
///
/// # Errors
/// What [`diamond_splat::project`] refuses.
pub fn projection(state: &mut HostState) -> Result<(), GpuError> {
    let scene = &state.scene;
    let projection = diamond_splat::project(&scene.gaussians, &scene.camera, &scene.config)?;
    let n = scene.gaussians.len();
    let mut splats = vec![Splat::default(); n.max(1)];
    let mut outlines = vec![[0.0f32; 4]; n.max(1)];
    let mut keys = vec![u32::MAX; n.max(1)];
    let mut counts = vec![0u32; n.max(1)];
    for i in 0..n {
        let Some(e) = projection.ellipse(i) else {
            continue;
        };
        let [x, y] = e.mean.map(pair);
        let [l11, l21, l22] = e.chol.map(|l| pair(l * kappa()));
        splats[i] = Splat {
            mean: [x[0], x[1], y[0], y[1]],
            chol: [l11[0], l11[1], l21[0], l21[1]],
            rest: [l22[0], l22[1], e.opacity, e.depth],
        };
        // The covariance again, from L Lᵀ being its inverse.
        let [a, b, c] = e.chol;
        let cov_yy = 1.0 / (c * c);
        let cov_xy = -b / a * cov_yy;
        let cov_xx = 1.0 / (a * a) + cov_xy * cov_xy / cov_yy;
        let two_tau = f64::from(e.extent[0]).powi(2) / cov_xx;
        let rightmost = cov_xy / cov_xx * f64::from(e.extent[0]);
        outlines[i] = [e.extent[0], e.extent[1], two_tau as f32, rightmost as f32];
        keys[i] = e.depth.to_bits();
        let tiles = state.frame.tiles;
        counts[i] = tile_rows(&splats[i], &outlines[i], tiles)
            .map(|row| tile_columns(&splats[i], &outlines[i], tiles, row).len() as u32)
            .sum();
    }
    let visible = projection.visible().len() as u32;
    state.set(Column::Splats, splats);
    state.set(Column::Outlines, outlines);
    state.set(Column::DepthKeys, keys);
    state.set(Column::TileCounts, counts);
    state.set(Column::Counts, vec![n as u32, 0, 0, visible]);
    Ok(())
}

/// Widening of an interval, px; relative to the ellipse's width.
const SLACK: f32 = 1e-3;
const RELATIVE_SLACK: f32 = 1e-6;

/// Rows of tiles that an ellipse may meet.
pub fn tile_rows(splat: &Splat, outline: &[f32; 4], tiles: [u32; 2]) -> std::ops::Range<u32> {
    let reach = outline[1] + SLACK;
    let side = TILE as f32;
    let cut = |v: f32| v.clamp(0.0, tiles[1] as f32) as u32;
    cut(((splat.mean[2] - reach) / side).floor())..cut(((splat.mean[2] + reach) / side).floor() + 1.0)
}

/// Columns of tiles in a row of tiles that an ellipse may meet.
pub fn tile_columns(splat: &Splat, outline: &[f32; 4], tiles: [u32; 2], row: u32) -> std::ops::Range<u32> {
    let [ex, ey, two_tau, rightmost] = *outline;
    let top = ((row * TILE) as f32 + 0.5 - splat.mean[2]) - splat.mean[3];
    let (y0, y1) = (top.max(-ey), (top + (TILE - 1) as f32).min(ey));
    if y0 > y1 + SLACK {
        return 0..0;
    }
    let (right_y, left_y) = (rightmost.max(y0).min(y1), (-rightmost).max(y0).min(y1));
    let kappa = kappa() as f32;
    let (inv_sqrt, slope, half_width) = (splat.rest[0] / kappa, -splat.chol[2] / splat.chol[0], kappa / splat.chol[0]);
    let root = |y: f32| (two_tau - (y * inv_sqrt) * (y * inv_sqrt)).max(0.0).sqrt();
    let slack = SLACK + RELATIVE_SLACK * ex;
    let low = splat.mean[0] - slack + slope * left_y - half_width * root(left_y);
    let high = splat.mean[0] + slack + slope * right_y + half_width * root(right_y);
    let cut = |v: f32| v.clamp(0.0, tiles[0] as f32) as u32;
    let side = TILE as f32;
    let (first, past) = (cut(((low + 0.5) / side).floor()), cut(((high - 0.5) / side).floor() + 1.0));
    first..past.max(first)
}

/// Gaussians by key of depth, ties by index.
pub fn depth_sort(state: &mut HostState) {
    let n = state.scene.gaussians.len();
    let mut keys = state.get(Column::DepthKeys);
    let mut order: Vec<u32> = (0..n as u32).collect();
    order.sort_by_key(|&i| keys[i as usize]);
    let sorted: Vec<u32> = order.iter().map(|&i| keys[i as usize]).collect();
    keys[..n].copy_from_slice(&sorted);
    state.set(Column::DepthKeys, keys);
    state.set(Column::DepthOrder, order);
}

/// Where entries begin, in the order of depth.
pub fn tile_offsets(state: &mut HostState) {
    let n = state.scene.gaussians.len();
    let (order, tiles) = (state.get(Column::DepthOrder), state.get(Column::TileCounts));
    let mut offsets = vec![0u32; n + 1];
    for rank in 0..n {
        offsets[rank + 1] = offsets[rank] + tiles[order[rank] as usize];
    }
    let mut counts = state.get(Column::Counts);
    counts[1] = offsets[n].min(state.frame.capacity);
    counts[2] = offsets[n];
    state.set(Column::Offsets, offsets);
    state.set(Column::Counts, counts);
}

/// An entry per Gaussian and tile.
pub fn tile_entries(state: &mut HostState) {
    let (splats, outlines): (Vec<Splat>, Vec<[f32; 4]>) =
        (state.get_as(Column::Splats), state.get_as(Column::Outlines));
    let (order, offsets) = (state.get(Column::DepthOrder), state.get(Column::Offsets));
    let (mut keys, mut owners) = (state.get(Column::TileKeys), state.get(Column::Owners));
    let tiles = state.frame.tiles;
    for rank in 0..state.scene.gaussians.len() {
        let (mut at, end) = (offsets[rank] as usize, offsets[rank + 1] as usize);
        if at == end {
            continue;
        }
        let i = order[rank] as usize;
        for row in tile_rows(&splats[i], &outlines[i], tiles) {
            for column in tile_columns(&splats[i], &outlines[i], tiles, row) {
                if at < end {
                    (keys[at], owners[at]) = (row * tiles[0] + column, i as u32);
                    at += 1;
                }
            }
        }
        for at in at..end {
            (keys[at], owners[at]) = (tiles[0] * tiles[1], i as u32);
        }
    }
    state.set(Column::TileKeys, keys);
    state.set(Column::Owners, owners);
}

/// Entries by tile; within a tile they stay in order.
pub fn tile_sort(state: &mut HostState) {
    let n = state.get(Column::Counts)[1] as usize;
    let mut keys = state.get(Column::TileKeys);
    let mut entries: Vec<u32> = (0..n as u32).collect();
    entries.sort_by_key(|&e| keys[e as usize]);
    let sorted: Vec<u32> = entries.iter().map(|&e| keys[e as usize]).collect();
    keys[..n].copy_from_slice(&sorted);
    let (to_keys, to_entries) = state.shape.sorted();
    state.set(to_keys, keys);
    state.set(to_entries, entries);
}

/// Where each tile's entries begin and end.
pub fn tile_ranges(state: &mut HostState) {
    let n = state.get(Column::Counts)[1] as usize;
    let (keys, entries) = state.shape.sorted();
    let (keys, entries, owners) = (state.get(keys), state.get(entries), state.get(Column::Owners));
    let tiles = state.frame.tiles[0] * state.frame.tiles[1];
    let mut ranges = vec![[0u32; 2]; tiles as usize];
    let mut pairs: Vec<[u32; 2]> = state.get_as(Column::Pairs);
    for i in 0..n {
        pairs[i] = [owners[entries[i] as usize], entries[i]];
        if keys[i] >= tiles {
            continue;
        }
        let range = &mut ranges[keys[i] as usize];
        if range[1] == 0 {
            range[0] = i as u32;
        }
        range[1] = i as u32 + 1;
    }
    state.set(Column::Ranges, ranges);
    state.set(Column::Pairs, pairs);
}

/// Who a pixel meets, nearest first, in f64.
pub(crate) struct Meeting {
    /// Place in the sorted list.
    pub place: usize,
    /// The Gaussian.
    pub gaussian: usize,
    /// κ Lᵀ (pixel − mean).
    pub uv: [f64; 2],
    /// α after its limits; above 0.
    pub alpha: f64,
    /// Whether α is below its upper limit.
    pub free: bool,
    /// In front of it.
    pub transmittance: f64,
}

/// Walks along a pixel's list until it stops; returns the transmittance behind the last.
pub(crate) fn walk(
    state: &HostState,
    splats: &[Splat],
    pairs: &[[u32; 2]],
    range: [u32; 2],
    pixel: [u32; 2],
    mut visit: impl FnMut(&Meeting),
) -> f64 {
    let frame = &state.frame;
    let mut t = 1.0f64;
    for place in range[0]..range[1] {
        let gaussian = pairs[place as usize][0] as usize;
        let s = &splats[gaussian];
        let d_x = f64::from(pixel[0]) + 0.5 - whole(s.mean[0], s.mean[1]);
        let d_y = f64::from(pixel[1]) + 0.5 - whole(s.mean[2], s.mean[3]);
        let u = whole(s.chol[0], s.chol[1]) * d_x + whole(s.chol[2], s.chol[3]) * d_y;
        let v = whole(s.rest[0], s.rest[1]) * d_y;
        let raw = f64::from(s.rest[2]) * libm::exp2(-(u * u + v * v));
        if raw < f64::from(frame.min_alpha) {
            continue;
        }
        let (alpha, free) = (raw.min(f64::from(frame.max_alpha)), raw <= f64::from(frame.max_alpha));
        let next = t * (1.0 - alpha);
        if next <= f64::from(frame.min_transmittance) {
            break;
        }
        visit(&Meeting { place: place as usize, gaussian, uv: [u, v], alpha, free, transmittance: t });
        t = next;
    }
    t
}

/// Every pixel with its number and its tile.
pub(crate) fn pixels(state: &HostState) -> impl Iterator<Item = (usize, [u32; 2], usize)> + use<> {
    let ([width, height], tiles) = (state.frame.size, state.frame.tiles);
    (0..height).flat_map(move |y| {
        (0..width).map(move |x| ((y * width + x) as usize, [x, y], (y / TILE * tiles[0] + x / TILE) as usize))
    })
}

/// Channels, opacity, depth.
pub fn blend(state: &mut HostState) {
    let shape = state.shape;
    let splats: Vec<Splat> = state.get_as(Column::Splats);
    let (ranges, pairs): (Vec<[u32; 2]>, Vec<[u32; 2]>) = (state.get_as(Column::Ranges), state.get_as(Column::Pairs));
    let features: Vec<f32> = state.get_as(Column::Features);
    let mut picture: Vec<f32> = state.get_as(Column::Picture);
    let mut coverage: Vec<Coverage> = state.get_as(Column::Coverage);
    let width = 4 * shape.quads;
    for (i, pixel, tile) in pixels(state) {
        let mut sums = vec![0.0f64; width * shape.pieces];
        let (mut opacity, mut depth, mut reach) = (0.0, 0.0, 0);
        let t = walk(state, &splats, &pairs, ranges[tile], pixel, |m| {
            let w = m.transmittance * m.alpha;
            opacity += w;
            depth += w * f64::from(splats[m.gaussian].rest[3]);
            reach = m.place as u32 + 1 - ranges[tile][0];
            for (k, sum) in sums.iter_mut().enumerate() {
                let row = shape.first(Column::Features, k / width) as usize + m.gaussian * width;
                *sum += w * f64::from(features[row + k % width]);
            }
        });
        for (k, sum) in sums.iter().enumerate() {
            picture[shape.first(Column::Picture, k / width) as usize + i * width + k % width] = *sum as f32;
        }
        coverage[i] = Coverage { opacity: opacity as f32, depth: depth as f32, transmittance: t as f32, reach };
    }
    state.set(Column::Picture, picture);
    state.set(Column::Coverage, coverage);
}

/// A gradient of zeros.
fn no_gradient() -> GaussianGrad {
    GaussianGrad::default()
}
