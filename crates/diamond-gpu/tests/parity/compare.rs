//! What the two sides of a stage may differ in.
use diamond_gpu::twin::{tile_columns, tile_rows};
use diamond_gpu::{Column, Coverage, GaussianGrad, HostState, STAGES, Side, Splat, Stage, StageRow, TILE};

/// Where a comparison failed.
#[derive(Debug, Clone, PartialEq)]
pub struct Difference {
    pub stage: &'static str,
    pub what: String,
}

/// ‖a − b‖ / ‖b‖; infinite where a is not a number. Both zero: 0.
pub fn relative_l2(a: &[f32], b: &[f32]) -> f64 {
    if a.len() != b.len() || a.iter().any(|v| !v.is_finite()) {
        return f64::INFINITY;
    }
    let square = |v: f64| v * v;
    let error: f64 = a.iter().zip(b).map(|(x, y)| square(f64::from(*x) - f64::from(*y))).sum();
    let norm: f64 = b.iter().map(|y| square(f64::from(*y))).sum();
    if error == 0.0 { 0.0 } else { (error / norm.max(1e-30)).sqrt() }
}

/// Every k-th of groups of `width`.
fn column<T: Copy>(data: &[T], width: usize, k: usize) -> Vec<T> {
    data.iter().skip(k).step_by(width).copied().collect()
}

/// Runs each stage on both sides from the twins' results and compares; the first stage that differs, or the worst error of each.
pub fn stages(state: &HostState, gpu: Side<'_>) -> Result<Vec<(&'static str, f64)>, Difference> {
    let mut cpu = state.clone();
    let mut worst = Vec::new();
    for row in STAGES {
        let failed = |what: String| Difference { stage: row.name, what };
        let mut other = cpu.clone();
        other.run(row.stage, gpu).map_err(|error| failed(error.to_string()))?;
        cpu.run(row.stage, Side::Cpu).map_err(|error| failed(error.to_string()))?;
        worst.push((row.name, stage(row, &cpu, &other).map_err(failed)?));
    }
    Ok(worst)
}

fn stage(row: &StageRow, cpu: &HostState, gpu: &HostState) -> Result<f64, String> {
    let n = cpu.scene.gaussians.len();
    let entries = cpu.get(Column::Counts)[1] as usize;
    let equal = |column: Column, words: usize| -> Result<f64, String> {
        let (a, b) = (gpu.get(column), cpu.get(column));
        match (0..words).find(|&i| a[i] != b[i]) {
            Some(i) => Err(format!("{column:?}[{i}]: expected {}, found {}", b[i], a[i])),
            None => Ok(0.0),
        }
    };
    let close = |what: &str, a: &[f32], b: &[f32]| -> Result<f64, String> {
        let error = relative_l2(a, b);
        if error <= row.tolerance { Ok(error) } else { Err(format!("{what}: relative error {error:.2e}")) }
    };
    match row.stage {
        Stage::Projection => projection(row, cpu, gpu),
        Stage::DepthSort => equal(Column::DepthKeys, n).and(equal(Column::DepthOrder, n)),
        Stage::TileOffsets => equal(Column::Offsets, n + 1).and(equal(Column::Counts, 4)),
        Stage::TileEntries => equal(Column::Owners, entries).and(tiles(cpu, gpu)),
        Stage::TileSort => {
            let (keys, values) = cpu.shape.sorted();
            equal(keys, entries).and(equal(values, entries))
        }
        Stage::TileRanges => {
            let words = cpu.shape.words(Column::Ranges) as usize;
            equal(Column::Ranges, words).and(equal(Column::Pairs, 2 * entries))
        }
        Stage::Blend => {
            let of = |state: &HostState| -> Vec<Coverage> { state.get_as(Column::Coverage) };
            let (a, b) = (of(gpu), of(cpu));
            let part = |what: &str, f: fn(&Coverage) -> f32| {
                close(what, &a.iter().map(f).collect::<Vec<_>>(), &b.iter().map(f).collect::<Vec<_>>())
            };
            let worst = close("channels", &gpu.picture(), &cpu.picture())?
                .max(part("opacity", |c| c.opacity)?)
                .max(part("depth", |c| c.depth)?)
                .max(part("transmittance", |c| c.transmittance)?);
            match a.iter().zip(&b).position(|(a, b)| a.reach != b.reach) {
                Some(i) => Err(format!("reach of pixel {i}: expected {}, found {}", b[i].reach, a[i].reach)),
                None => Ok(worst),
            }
        }
        Stage::BlendPull => {
            let width = 8 + 4 * cpu.shape.quads;
            let (a, b): (Vec<f32>, Vec<f32>) = (gpu.get_as(Column::Rows), cpu.get_as(Column::Rows));
            columns(width, |k| close(&format!("column {k}"), &column(&a, width, k), &column(&b, width, k)))
        }
        Stage::SplatSum => {
            let (a, b): (Vec<f32>, Vec<f32>) = (gpu.get_as(Column::Moments), cpu.get_as(Column::Moments));
            let worst = columns(8, |k| close(&format!("moment {k}"), &column(&a, 8, k), &column(&b, 8, k)))?;
            Ok(worst.max(close("features", &gpu.d_features(), &cpu.d_features())?))
        }
        Stage::ProjectionPull => {
            let of = |state: &HostState| -> Vec<GaussianGrad> { state.get_as(Column::Gradient) };
            let (a, b) = (of(gpu), of(cpu));
            let part = |what: &str, f: fn(&GaussianGrad) -> Vec<f32>| {
                close(what, &a.iter().flat_map(f).collect::<Vec<_>>(), &b.iter().flat_map(f).collect::<Vec<_>>())
            };
            Ok(part("means", |g| g.mean[..3].to_vec())?
                .max(part("opacities", |g| vec![g.mean[3]])?)
                .max(part("rotations or factors", |g| g.form_a.to_vec())?)
                .max(part("standard deviations or factors", |g| g.form_b.to_vec())?)
                .max(part("screen positions", |g| g.screen.to_vec())?))
        }
    }
}

fn columns(width: usize, f: impl Fn(usize) -> Result<f64, String>) -> Result<f64, String> {
    (0..width).try_fold(0.0f64, |worst, k| Ok(worst.max(f(k)?)))
}

fn projection(row: &StageRow, cpu: &HostState, gpu: &HostState) -> Result<f64, String> {
    let (a, b): (Vec<Splat>, Vec<Splat>) = (gpu.get_as(Column::Splats), cpu.get_as(Column::Splats));
    let (out_a, out_b): (Vec<[f32; 4]>, Vec<[f32; 4]>) = (gpu.get_as(Column::Outlines), cpu.get_as(Column::Outlines));
    let (key_a, key_b) = (gpu.get(Column::DepthKeys), cpu.get(Column::DepthKeys));
    let counts = gpu.get(Column::TileCounts);
    let whole = |high: f32, low: f32| f64::from(high) + f64::from(low);
    let mut worst = 0.0f64;
    for i in 0..cpu.scene.gaussians.len() {
        if key_a[i] != key_b[i] {
            return Err(format!("Gaussian {i}: expected the depth {:#x}, found {:#x}", key_b[i], key_a[i]));
        }
        if key_b[i] == u32::MAX {
            if counts[i] != 0 || a[i].rest[2] != 0.0 {
                return Err(format!("Gaussian {i} is culled but has {} tiles", counts[i]));
            }
            continue;
        }
        let pairs = |s: &Splat| {
            [
                whole(s.mean[0], s.mean[1]),
                whole(s.mean[2], s.mean[3]),
                whole(s.chol[0], s.chol[1]),
                whole(s.chol[2], s.chol[3]),
                whole(s.rest[0], s.rest[1]),
            ]
        };
        let (p, q) = (pairs(&a[i]), pairs(&b[i]));
        // A mean is needed to a fraction of a pixel's fraction, L relative to itself.
        let scale = [1.0f64.max(q[0].abs() * 1e-3), 1.0f64.max(q[1].abs() * 1e-3)];
        let l = q[2].hypot(q[3]);
        let mut error = 0.0f64;
        for (k, size) in [scale[0], scale[1], l, l, q[4]].into_iter().enumerate() {
            error = error.max((p[k] - q[k]).abs() / size);
        }
        for k in 0..4 {
            let size = [out_b[i][0], out_b[i][1], out_b[i][2], out_b[i][0]][k];
            // The logarithm of opacities and roots of f32: ten times as much.
            error = error.max(0.1 * f64::from((out_a[i][k] - out_b[i][k]).abs() / size));
        }
        if error.is_nan() || error > row.tolerance || a[i].rest[2..] != b[i].rest[2..] {
            return Err(format!("Gaussian {i}: error {error:.2e}, expected {:?}, found {:?}", b[i], a[i]));
        }
        let (least, most) = bounds(cpu, &b[i], &out_b[i]);
        if (counts[i] as usize) < least.len() || counts[i] as usize > most {
            return Err(format!("Gaussian {i}: expected {} to {most} tiles, found {}", least.len(), counts[i]));
        }
        worst = worst.max(error);
    }
    if gpu.get(Column::Counts)[3] != cpu.get(Column::Counts)[3] {
        return Err("the number of visible Gaussians differs".into());
    }
    Ok(worst)
}

/// Tiles that hold a pixel where alpha counts, and how many an ellipse a little larger meets.
fn bounds(state: &HostState, splat: &Splat, outline: &[f32; 4]) -> (Vec<u32>, usize) {
    let [width, height] = state.frame.size;
    let tiles = state.frame.tiles;
    let mut least = Vec::new();
    let whole = |high: f32, low: f32| f64::from(high) + f64::from(low);
    let wide = [outline[0] + 0.01, outline[1] + 0.01, outline[2] * 1.001 + 1e-3, outline[3]];
    let mut most = 0;
    for row in 0..tiles[1] {
        let rows = tile_rows(splat, &wide, tiles);
        if rows.contains(&row) {
            // The columns of its neighbours, too, where a band begins within rounding.
            most += tile_columns(splat, &wide, tiles, row).len() + 2;
        }
        for tile in 0..tiles[0] {
            let seen = (0..TILE * TILE).any(|k| {
                let (x, y) = (tile * TILE + k % TILE, row * TILE + k / TILE);
                let d_x = f64::from(x) + 0.5 - whole(splat.mean[0], splat.mean[1]);
                let d_y = f64::from(y) + 0.5 - whole(splat.mean[2], splat.mean[3]);
                let u = whole(splat.chol[0], splat.chol[1]) * d_x + whole(splat.chol[2], splat.chol[3]) * d_y;
                let v = whole(splat.rest[0], splat.rest[1]) * d_y;
                let alpha = f64::from(splat.rest[2]) * libm::exp2(-(u * u + v * v));
                x < width && y < height && alpha >= f64::from(state.frame.min_alpha)
            });
            if seen {
                least.push(row * tiles[0] + tile);
            }
        }
    }
    (least, most)
}

/// Every Gaussian's entries name each tile in which it is seen, none twice, and none that is far from it.
fn tiles(cpu: &HostState, gpu: &HostState) -> Result<f64, String> {
    let (splats, outlines): (Vec<Splat>, Vec<[f32; 4]>) = (cpu.get_as(Column::Splats), cpu.get_as(Column::Outlines));
    let (order, offsets) = (cpu.get(Column::DepthOrder), cpu.get(Column::Offsets));
    let (keys, expected) = (gpu.get(Column::TileKeys), cpu.get(Column::TileKeys));
    let none = cpu.frame.tiles[0] * cpu.frame.tiles[1];
    let mut moved = 0;
    for rank in 0..cpu.scene.gaussians.len() {
        let range = offsets[rank] as usize..offsets[rank + 1] as usize;
        if range.is_empty() {
            continue;
        }
        let i = order[rank] as usize;
        let mut mine: Vec<u32> = keys[range.clone()].iter().copied().filter(|key| *key != none).collect();
        moved += (keys[range.clone()] != expected[range]) as usize;
        mine.sort_unstable();
        let distinct = mine.len();
        mine.dedup();
        if mine.len() != distinct || mine.last().is_some_and(|key| *key > none) {
            return Err(format!("Gaussian {i}: a tile twice, or one that is not there: {mine:?}"));
        }
        let (least, _) = bounds(cpu, &splats[i], &outlines[i]);
        if let Some(tile) = least.iter().find(|tile| !mine.contains(tile)) {
            return Err(format!("Gaussian {i}: seen in tile {tile}, entered in {mine:?}"));
        }
    }
    // Rounding may move an interval's end across a tile's edge, but not often.
    if moved * 100 > cpu.scene.gaussians.len() + 100 {
        return Err(format!("{moved} Gaussians have other tiles than on the CPU"));
    }
    Ok(0.0)
}
