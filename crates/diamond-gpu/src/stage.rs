//! The stages of a picture and its gradient: one table, and what each one hands to the device.
use crate::kernels::{Kernel, Module};
use crate::shape::{BLOCK, Column, Shape};

/// A stage: it has the same name here, in `wgsl/`, in [`twin`](crate::twin) and in the parity table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    /// Gaussians to ellipses.
    Projection,
    /// Gaussians in the order of depth.
    DepthSort,
    /// Where each Gaussian's entries begin.
    TileOffsets,
    /// An entry per Gaussian and tile.
    TileEntries,
    /// Entries in the order of tiles, then depth.
    TileSort,
    /// Where each tile's entries begin and end.
    TileRanges,
    /// Weights, channels, opacity, depth.
    Blend,
    /// Cotangents of pictures to those of entries.
    BlendPull,
    /// Sums of a Gaussian's entries.
    SplatSum,
    /// Cotangents of ellipses to those of Gaussians.
    ProjectionPull,
}

/// What a stage is and how exact it has to be.
#[derive(Debug)]
pub struct StageRow {
    /// Which one.
    pub stage: Stage,
    /// Its name: the file `wgsl/NAME.wgsl` and the function `twin::NAME`.
    pub name: &'static str,
    /// Whether it belongs to the forward or to the backward pass.
    pub backward: bool,
    /// Arrays that it writes and that are compared.
    pub outputs: &'static [Column],
    /// Largest relative error (L2 over an array) against its twin; 0: equal.
    pub tolerance: f64,
    /// What is compared.
    pub compared: &'static str,
}

/// Every stage, in the order in which they run.
pub const STAGES: &[StageRow] = &[
    StageRow {
        stage: Stage::Projection,
        name: "projection",
        backward: false,
        outputs: &[Column::Splats, Column::Outlines, Column::DepthKeys, Column::TileCounts],
        tolerance: 1e-6,
        compared: "ellipses to 1e-6, culling and order of depth, every tile with a visible pixel",
    },
    StageRow {
        stage: Stage::DepthSort,
        name: "depth_sort",
        backward: false,
        outputs: &[Column::DepthKeys, Column::DepthOrder],
        tolerance: 0.0,
        compared: "equal",
    },
    StageRow {
        stage: Stage::TileOffsets,
        name: "tile_offsets",
        backward: false,
        outputs: &[Column::Offsets, Column::Counts],
        tolerance: 0.0,
        compared: "equal",
    },
    StageRow {
        stage: Stage::TileEntries,
        name: "tile_entries",
        backward: false,
        outputs: &[Column::TileKeys, Column::Owners],
        tolerance: 0.0,
        compared: "owners equal; every tile with a visible pixel, none twice",
    },
    StageRow {
        stage: Stage::TileSort,
        name: "tile_sort",
        backward: false,
        outputs: &[Column::TileKeys, Column::Entries, Column::TileKeysAlt, Column::EntriesAlt],
        tolerance: 0.0,
        compared: "equal",
    },
    StageRow {
        stage: Stage::TileRanges,
        name: "tile_ranges",
        backward: false,
        outputs: &[Column::Ranges, Column::Pairs],
        tolerance: 0.0,
        compared: "equal",
    },
    StageRow {
        stage: Stage::Blend,
        name: "blend",
        backward: false,
        outputs: &[Column::Picture, Column::Coverage],
        tolerance: 1e-5,
        compared: "relative L2 of channels, opacity, depth, transmittance",
    },
    StageRow {
        stage: Stage::BlendPull,
        name: "blend_pull",
        backward: true,
        outputs: &[Column::Rows],
        tolerance: 1e-5,
        compared: "relative L2 of each column of the rows",
    },
    StageRow {
        stage: Stage::SplatSum,
        name: "splat_sum",
        backward: true,
        outputs: &[Column::DFeatures, Column::Moments],
        tolerance: 1e-6,
        compared: "relative L2 of features and of each moment",
    },
    StageRow {
        stage: Stage::ProjectionPull,
        name: "projection_pull",
        backward: true,
        outputs: &[Column::Gradient],
        tolerance: 1e-5,
        compared: "relative L2 of means, forms, opacities, screen positions",
    },
];

/// A part of the training step: what is compared, and how exact it has to be.
#[derive(Debug)]
pub struct ComponentRow {
    /// Its name, and that of its function in this crate.
    pub name: &'static str,
    /// Its file: `wgsl/FILE.wgsl`.
    pub file: &'static str,
    /// The CPU function that it is compared with.
    pub twin: &'static str,
    /// Whether it belongs to the forward or to the backward pass.
    pub backward: bool,
    /// Largest relative error (L2 over an array) against its twin.
    pub tolerance: f64,
}

/// Parts that can also be called by themselves, with arrays of the host.
pub const COMPONENTS: &[ComponentRow] = &[
    ComponentRow {
        name: "mlp_forward",
        file: "product",
        twin: "diamond_shading::Mlp::forward",
        backward: false,
        tolerance: 1e-5,
    },
    ComponentRow {
        name: "mlp_pull",
        file: "product",
        twin: "diamond_shading::MlpPullback::pull",
        backward: true,
        tolerance: 1e-5,
    },
    ComponentRow { name: "shade", file: "shade", twin: "diamond_shading::shade", backward: false, tolerance: 1e-5 },
    ComponentRow {
        name: "shade_pull",
        file: "shade_pull",
        twin: "diamond_shading::ShadePullback::pull",
        backward: true,
        tolerance: 1e-4,
    },
    ComponentRow {
        name: "photometric",
        file: "photometric",
        twin: "diamond_losses::photometric",
        backward: true,
        tolerance: 1e-5,
    },
    ComponentRow {
        name: "mask_bce",
        file: "mask_bce",
        twin: "diamond_losses::mask_bce",
        backward: true,
        tolerance: 1e-5,
    },
    ComponentRow {
        name: "adam_step",
        file: "adam",
        twin: "diamond_reconstruct::adam::adam_step",
        backward: true,
        tolerance: 1e-6,
    },
    ComponentRow {
        name: "record_view",
        file: "density_stats",
        twin: "diamond_splat::density::DensityStats::record",
        backward: true,
        tolerance: 1e-6,
    },
];

/// Parts that exist within a step only, in the order in which they run.
pub const STEP_PARTS: &[ComponentRow] = &[
    ComponentRow {
        name: "activate",
        file: "activate",
        twin: "diamond_reconstruct::GaussianParameters::activate",
        backward: false,
        tolerance: 1e-5,
    },
    ComponentRow {
        name: "residual_inputs",
        file: "residual_inputs",
        twin: "diamond_shading::ResidualInputs::assemble",
        backward: false,
        tolerance: 1e-5,
    },
    ComponentRow {
        name: "residual_outputs",
        file: "residual_outputs",
        twin: "diamond_shading::transfer_radiance",
        backward: false,
        tolerance: 1e-5,
    },
    ComponentRow {
        name: "medium_rows",
        file: "medium_rows",
        twin: "diamond_reconstruct::MediumTerm",
        backward: false,
        tolerance: 1e-5,
    },
    ComponentRow {
        name: "visibility_fit",
        file: "visibility_fit",
        twin: "diamond_shading::sh_visibility::visibilities",
        backward: false,
        tolerance: 1e-5,
    },
    ComponentRow {
        name: "image_terms",
        file: "image_terms",
        twin: "diamond_losses::{mask_bce, normal_consistency, smoothness, enhancement, incident_light}",
        backward: true,
        tolerance: 1e-5,
    },
    ComponentRow {
        name: "medium_pull",
        file: "medium_pull",
        twin: "diamond_reconstruct::MediumTerm",
        backward: true,
        tolerance: 1e-4,
    },
    ComponentRow {
        name: "residual_gather",
        file: "residual_gather",
        twin: "diamond_shading::TransferPullback::pull",
        backward: true,
        tolerance: 1e-4,
    },
    ComponentRow {
        name: "residual_scatter",
        file: "residual_scatter",
        twin: "diamond_shading::ResidualInputsPullback::pull",
        backward: true,
        tolerance: 1e-4,
    },
    ComponentRow {
        name: "activate_pull",
        file: "activate_pull",
        twin: "diamond_reconstruct::GaussianParameters::pull",
        backward: true,
        tolerance: 1e-4,
    },
    ComponentRow {
        name: "visibility_term",
        file: "visibility_term",
        twin: "diamond_losses::visibility",
        backward: true,
        tolerance: 1e-4,
    },
    ComponentRow {
        name: "transfer_smoothness",
        file: "transfer_smoothness",
        twin: "diamond_reconstruct: transfer_smoothness",
        backward: true,
        tolerance: 1e-4,
    },
    ComponentRow {
        name: "sampled_inputs",
        file: "sampled_inputs",
        twin: "diamond_shading::ResidualInputs::assemble",
        backward: false,
        tolerance: 1e-5,
    },
    ComponentRow {
        name: "sampled_pull",
        file: "sampled_pull",
        twin: "diamond_reconstruct: pull_to_nothing",
        backward: true,
        tolerance: 1e-4,
    },
    ComponentRow {
        name: "clamp_scales",
        file: "clamp_scales",
        twin: "diamond_reconstruct::GaussianParameters::clamp_covariances",
        backward: true,
        tolerance: 1e-6,
    },
    ComponentRow { name: "reduce", file: "reduce", twin: "sums in f64", backward: false, tolerance: 1e-5 },
];

/// Something that the device does.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Step {
    /// Sets an array to 0.
    Clear(Column),
    /// Runs a kernel.
    Dispatch {
        kernel: Kernel,
        /// Array, first word, words: bindings 1 and on.
        bindings: Vec<(Column, u64, u64)>,
        /// Workgroups.
        grid: [u32; 2],
    },
}

/// Workgroups along one dimension, at most: a limit of WebGPU.
const MAX_GRID: u64 = 65_535;

/// A grid of so many workgroups.
pub(crate) fn grid(workgroups: u64) -> [u32; 2] {
    if workgroups <= MAX_GRID {
        return [workgroups as u32, 1];
    }
    [MAX_GRID as u32, workgroups.div_ceil(MAX_GRID) as u32]
}

/// A grid with a thread for each of so many.
fn threads(n: u64) -> [u32; 2] {
    grid(n.div_ceil(256))
}

/// Collects what a stage does.
struct Plan<'a> {
    shape: &'a Shape,
    steps: Vec<Step>,
}

impl Plan<'_> {
    fn whole(&self, column: Column) -> (Column, u64, u64) {
        (column, 0, self.shape.words(column))
    }

    fn piece(&self, column: Column, piece: usize) -> (Column, u64, u64) {
        (column, self.shape.first(column, piece), self.shape.piece(column))
    }

    fn run(
        &mut self,
        module: Module,
        entry: &'static str,
        constants: &[(&'static str, u32)],
        bindings: Vec<(Column, u64, u64)>,
        grid: [u32; 2],
    ) {
        if grid[0] == 0 || grid[1] == 0 {
            return;
        }
        let kernel = Kernel { module, entry, constants: constants.to_vec() };
        self.steps.push(Step::Dispatch { kernel, bindings, grid });
    }

    fn over(&mut self, module: Module, entry: &'static str, columns: &[Column], n: u64) {
        let bindings = columns.iter().map(|column| self.whole(*column)).collect();
        self.run(module, entry, &[], bindings, threads(n));
    }

    /// Prefix sums of the first `n` words of an array.
    fn scan(&mut self, column: Column, n: u64) {
        let mut levels = vec![(column, n)];
        for next in [Column::ScanBlocks, Column::ScanBlocks2, Column::ScanBlocks3] {
            let (from, n) = levels[levels.len() - 1];
            let blocks = Shape::blocks(n);
            self.run(Module::Scan, "scan_blocks", &[], vec![(from, 0, n), (next, 0, blocks)], grid(blocks));
            if blocks == 1 {
                break;
            }
            levels.push((next, blocks));
        }
        for pair in levels.windows(2).rev() {
            let [(to, n), (sums, blocks)] = [pair[0], pair[1]];
            self.run(Module::Scan, "scan_add", &[], vec![(to, 0, n), (sums, 0, blocks)], grid(blocks));
        }
    }

    /// Sorts keys and values by the lowest `digits` digits. `counts` says how many there are, at most `n`.
    fn sort(&mut self, digits: u32, n: u64, count: u32, mut from: [Column; 2], mut to: [Column; 2]) {
        let blocks = Shape::blocks(n);
        for digit in 0..digits {
            let constants = [("SHIFT", 8 * digit), ("COUNT", count), ("FIRST", (digit == 0).into())];
            let bindings = vec![
                self.whole(from[0]),
                self.whole(from[1]),
                self.whole(to[0]),
                self.whole(to[1]),
                (Column::Histogram, 0, 256 * blocks),
                self.whole(Column::Counts),
            ];
            self.run(Module::Sort, "sort_count", &constants, bindings.clone(), grid(blocks));
            self.scan(Column::Histogram, 256 * blocks);
            self.run(Module::Sort, "sort_place", &constants, bindings, grid(blocks));
            std::mem::swap(&mut from, &mut to);
        }
    }
}

/// What a stage does to a picture of this shape.
pub(crate) fn steps(stage: Stage, shape: &Shape) -> Vec<Step> {
    let mut plan = Plan { shape, steps: Vec::new() };
    let n = shape.gaussians;
    let [tiles_x, tiles_y] = shape.tiles().map(|n| n as u32);
    let quads = shape.quads as u32;
    match stage {
        Stage::Projection => {
            let columns = [
                Column::Means,
                Column::FormA,
                Column::FormB,
                Column::Splats,
                Column::Outlines,
                Column::DepthKeys,
                Column::TileCounts,
                Column::Counts,
            ];
            plan.over(Module::Projection, "project", &columns, n);
        }
        Stage::DepthSort => {
            let (from, to) = ([Column::DepthKeys, Column::DepthOrder], [Column::DepthKeysAlt, Column::DepthOrderAlt]);
            plan.sort(4, n, 0, from, to);
        }
        Stage::TileOffsets => {
            let columns = [Column::DepthOrder, Column::TileCounts, Column::Offsets, Column::Counts];
            plan.over(Module::TileOffsets, "order_counts", &columns, n + 1);
            plan.scan(Column::Offsets, n + 1);
            plan.over(Module::TileOffsets, "total", &columns, 1);
        }
        Stage::TileEntries => {
            let columns = [
                Column::Splats,
                Column::Outlines,
                Column::DepthOrder,
                Column::Offsets,
                Column::TileKeys,
                Column::Owners,
            ];
            plan.over(Module::TileEntries, "enter_tiles", &columns, n);
        }
        Stage::TileSort => {
            let (from, to) = ([Column::TileKeys, Column::Entries], [Column::TileKeysAlt, Column::EntriesAlt]);
            plan.sort(shape.tile_digits(), shape.capacity, 1, from, to);
        }
        Stage::TileRanges => {
            plan.steps.push(Step::Clear(Column::Ranges));
            let (keys, entries) = shape.sorted();
            let columns = [keys, entries, Column::Owners, Column::Counts, Column::Ranges, Column::Pairs];
            plan.over(Module::TileRanges, "find_ranges", &columns, shape.capacity);
        }
        Stage::Blend => {
            for piece in 0..shape.pieces {
                let bindings = vec![
                    plan.whole(Column::Splats),
                    plan.whole(Column::Ranges),
                    plan.whole(Column::Pairs),
                    plan.piece(Column::Features, piece),
                    plan.piece(Column::Picture, piece),
                    plan.whole(Column::Coverage),
                ];
                plan.run(Module::Blend, "blend", &[("QUADS", quads)], bindings, [tiles_x, tiles_y]);
            }
        }
        Stage::BlendPull => {
            plan.steps.push(Step::Clear(Column::Rows));
            (0..shape.pieces).for_each(|piece| blend_pull(&mut plan, piece));
        }
        Stage::SplatSum => {
            (0..shape.pieces).for_each(|piece| sum_features(&mut plan, piece));
            sum_moments(&mut plan);
        }
        Stage::ProjectionPull => {
            let columns =
                [Column::Means, Column::FormA, Column::FormB, Column::Splats, Column::Moments, Column::Gradient];
            plan.over(Module::ProjectionPull, "pull", &columns, n);
        }
    }
    plan.steps
}

/// The backward pass down to the sums per Gaussian: rows have room for one piece of channels, so pieces take turns.
pub(crate) fn blend_pull_and_sum(shape: &Shape) -> Vec<Step> {
    let mut plan = Plan { shape, steps: vec![Step::Clear(Column::Rows)] };
    for piece in 0..shape.pieces {
        blend_pull(&mut plan, piece);
        sum_features(&mut plan, piece);
    }
    sum_moments(&mut plan);
    plan.steps
}

fn blend_pull(plan: &mut Plan, piece: usize) {
    let bindings = vec![
        plan.whole(Column::Splats),
        plan.whole(Column::Ranges),
        plan.whole(Column::Pairs),
        plan.piece(Column::Features, piece),
        plan.whole(Column::Coverage),
        plan.piece(Column::DPicture, piece),
        plan.whole(Column::DCoverage),
        plan.whole(Column::Rows),
    ];
    let constants = [("QUADS", plan.shape.quads as u32), ("FIRST", (piece == 0).into())];
    plan.run(Module::BlendPull, "blend_pull", &constants, bindings, plan.shape.tiles().map(|n| n as u32));
}

fn sum_rows(plan: &mut Plan, from: u32, take: u32, to: (Column, u64, u64)) {
    let bindings = vec![plan.whole(Column::DepthOrder), plan.whole(Column::Offsets), plan.whole(Column::Rows), to];
    let constants = [("ROW", (plan.shape.row_words() / 4) as u32), ("FROM", from), ("TAKE", take)];
    let n = plan.shape.gaussians * u64::from(take);
    plan.run(Module::SplatSum, "sum_rows", &constants, bindings, threads(n));
}

fn sum_features(plan: &mut Plan, piece: usize) {
    let to = plan.piece(Column::DFeatures, piece);
    sum_rows(plan, 2, plan.shape.quads as u32, to);
}

fn sum_moments(plan: &mut Plan) {
    let to = plan.whole(Column::Moments);
    sum_rows(plan, 0, 2, to);
}

const _: () = assert!(BLOCK == 8 * 256, "kernels take eight items per thread");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_stage_is_in_the_table_under_the_name_of_its_file() {
        let shape = Shape::new(5000, [100, 80], 20, 70_000, 1 << 27).unwrap();
        for row in STAGES {
            assert!(!steps(row.stage, &shape).is_empty(), "{}", row.name);
            assert!(row.tolerance <= if row.backward { 1e-4 } else { 1e-5 }, "{}", row.name);
        }
        let names: Vec<&str> = STAGES.iter().map(|row| row.name).collect();
        for module in Module::ALL {
            let file = module.files().last().unwrap().trim_end_matches(".wgsl");
            let component = COMPONENTS.iter().chain(STEP_PARTS).any(|row| row.file == file);
            // These are parts of others, or compared with the whole step.
            let others = ["scan", "sort", "radiance", "finite", "sampled_scatter", "pack_transport", "join_transport"];
            assert!(names.contains(&file) || component || others.contains(&file), "{file}");
        }
    }

    /// Every dispatch binds as many arrays as its module has, none longer than it is, and none both read and written.
    #[test]
    fn dispatches_fit_their_modules() {
        for (gaussians, size, channels, capacity) in
            [(0, [1, 1], 0, 0), (1, [1, 1], 1, 1), (300_000, [1000, 700], 33, 5_000_000)]
        {
            let shape = Shape::new(gaussians, size, channels, capacity, 1 << 30).unwrap();
            let all = STAGES.iter().flat_map(|row| steps(row.stage, &shape)).chain(blend_pull_and_sum(&shape));
            for step in all {
                let Step::Dispatch { kernel, bindings, grid } = step else {
                    continue;
                };
                let access = kernel.module.access();
                assert_eq!(bindings.len(), access.len(), "{kernel:?}");
                assert!(grid.iter().all(|side| (1..=65_535).contains(side)), "{kernel:?} {grid:?}");
                for (k, &(column, first, words)) in bindings.iter().enumerate() {
                    assert!(words > 0 && first % 64 == 0, "{kernel:?} {column:?}");
                    assert!(first + words <= shape.words(column), "{kernel:?} {column:?}");
                    let written = access.as_bytes()[k] == b'w';
                    let others = bindings.iter().enumerate().filter(|(j, other)| *j != k && other.0 == column);
                    for (j, other) in others {
                        let apart = other.1 + other.2 <= first || first + words <= other.1;
                        assert!(apart || !(written || access.as_bytes()[j] == b'w'), "{kernel:?} {column:?}");
                    }
                }
            }
        }
    }
}
