//! The weights of a view, kept: any number of channels can be blended with them later, block by block.
//!
//! [`rasterize`](crate::rasterize()) finds who is seen in a pixel and how much, and blends features with it. Where the same
//! view is wanted with many sets of features, such as under many lights, finding the weights is most of the work and the
//! same for all. [`BlendWeights`] finds them once. A block of 4 × 4 pixels is blended into sixteen numbers per channel,
//! which fit in the first cache, so that a caller can make pixels of them at once instead of writing images of channels.
use crate::blend::{KeptBlock, KeptBlocks, RegionForward};
use crate::ellipse::{BLOCK, LANES};
use crate::rasterize::{check_same, scene, with_scratch};
use crate::recycle::FLOATS;
use crate::{Features, Gaussians, Projection, SplatError};
use diamond_simd::{Block, Level, Simd, WithSimd, load_block, store_block, with_lanes};
use rayon::prelude::*;

/// What is listed although nothing comes of it; both are for comparisons.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct KeepAll {
    /// Rows of features for Gaussians that are [`visible`](Projection::visible) but behind others.
    pub hidden_rows: bool,
    /// Blocks in which nothing is seen.
    pub empty_blocks: bool,
}

/// Who is seen in which pixels of a view, and how much.
///
/// Weights are those of [`Raster`](crate::Raster), and what is blended with them has the bits of
/// [`rasterize`](crate::rasterize()). Memory: 68 bytes per Gaussian and block of 4 × 4 pixels in which it is seen.
#[derive(Debug, Clone)]
pub struct BlendWeights {
    size: [usize; 2],
    /// Gaussians with a row of features, ascending.
    rows: Vec<u32>,
    regions: Vec<KeptBlocks>,
    /// Top to bottom, then left to right.
    blocks: Vec<Listed>,
    /// Blocks of line `y` are `lines[y]..lines[y + 1]`.
    lines: Vec<usize>,
}

/// A block by the place of its first pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Listed {
    y: u32,
    x: u32,
    /// Region and number in it; nothing is seen in the block if there is no such region.
    kept: (u32, u32),
}

/// Sixteen pixels of a view, row by row from the left, and who is seen in them.
#[derive(Debug, Clone, Copy)]
pub struct BlendBlock<'a> {
    /// Column and row of the first pixel.
    pub at: [usize; 2],
    /// Columns and rows inside the image; pixels beyond have weights of 0.
    pub size: [usize; 2],
    /// Σ w by pixel.
    pub opacity: &'a [f32; LANES],
    /// Σ w z by pixel, scene units.
    pub depth: &'a [f32; LANES],
    /// Rows of features, nearest first.
    rows: &'a [u32],
    weights: &'a [[f32; LANES]],
}

impl BlendWeights {
    /// Side of a block, pixels.
    pub const BLOCK: usize = BLOCK;

    /// Of a view. Features have a row for each Gaussian that is seen in any pixel, and blocks are those in which any is,
    /// but for what `keep` says.
    ///
    /// # Errors
    /// [`SplatError::Shape`] if the projection is one of other Gaussians.
    pub fn new(projection: &Projection, gaussians: &Gaussians, keep: &KeepAll) -> Result<Self, SplatError> {
        check_same(projection, gaussians.len())?;
        let level = Level::current();
        let features = Features::zeros(gaussians.len(), 0);
        let mut scene = scene(projection, &features, level);
        scene.keep = true;
        let mut regions: Vec<KeptBlocks> = (0..projection.bins.regions)
            .into_par_iter()
            .map(|region| {
                let image = with_scratch(|scratch| level.dispatch(RegionForward { scene: &scene, region, scratch }));
                FLOATS.give(image.data);
                image.kept
            })
            .collect();
        let rows = if keep.hidden_rows { projection.visible().to_vec() } else { seen(&regions, gaussians.len()) };
        let mut row_of = vec![0u32; gaussians.len()];
        (0..).zip(&rows).for_each(|(row, &i)| row_of[i as usize] = row);
        regions.par_iter_mut().for_each(|region| {
            region.gaussians.iter_mut().for_each(|i| *i = row_of[*i as usize]);
        });
        let size = [scene.width, scene.height];
        let mut blocks: Vec<Listed> = Vec::new();
        for (r, region) in (0..).zip(&regions) {
            let listed = |(k, block): (u32, &KeptBlock)| Listed {
                y: block.place.y as u32,
                x: block.place.x as u32,
                kept: (r, k),
            };
            blocks.extend((0..).zip(&region.blocks).map(listed));
        }
        if keep.empty_blocks {
            let all = (0..size[1]).step_by(BLOCK).flat_map(|y| (0..size[0]).step_by(BLOCK).map(move |x| (y, x)));
            let none = (u32::MAX, 0);
            blocks.extend(all.map(|(y, x)| Listed { y: y as u32, x: x as u32, kept: none }));
        }
        // Those in which something is seen come before their empty twins.
        blocks.sort_unstable();
        blocks.dedup_by_key(|b| (b.y, b.x));
        let starts = (0..size[1].div_ceil(BLOCK)).map(|y| blocks.partition_point(|b| (b.y as usize) < y * BLOCK));
        let lines = starts.chain([blocks.len()]).collect();
        Ok(Self { size, rows, regions, lines, blocks })
    }

    /// Width and height of the view, pixels.
    pub fn size(&self) -> [usize; 2] {
        self.size
    }

    /// The Gaussian of each row of features, ascending.
    pub fn rows(&self) -> &[u32] {
        &self.rows
    }

    /// Number of blocks in which anything is seen.
    pub fn blocks(&self) -> usize {
        self.blocks.len()
    }

    /// Lines of blocks, one below the other.
    pub fn lines(&self) -> usize {
        self.lines.len() - 1
    }

    /// Number of the first block of a line among all of the view.
    pub fn line_start(&self, line: usize) -> usize {
        self.lines[line]
    }

    /// The blocks of a line in which anything is seen, left to right.
    ///
    /// # Panics
    /// If there is no such line.
    pub fn line(&self, line: usize) -> impl Iterator<Item = BlendBlock<'_>> {
        self.blocks[self.lines[line]..self.lines[line + 1]].iter().map(|listed| {
            let at = [listed.x as usize, listed.y as usize];
            let size = [(self.size[0] - at[0]).min(BLOCK), (self.size[1] - at[1]).min(BLOCK)];
            let (region, k) = (listed.kept.0 as usize, listed.kept.1 as usize);
            let Some(region) = self.regions.get(region) else {
                return BlendBlock { at, size, opacity: &NOTHING, depth: &NOTHING, rows: &[], weights: &[] };
            };
            let KeptBlock { end, opacity, depth, .. } = &region.blocks[k];
            let entries = if k == 0 { 0..*end } else { region.blocks[k - 1].end..*end };
            let (rows, weights) = (&region.gaussians[entries.clone()], &region.weights[entries]);
            BlendBlock { at, size, opacity, depth, rows, weights }
        })
    }
}

/// Sums of an empty block.
const NOTHING: [f32; LANES] = [0.0; LANES];

/// Gaussians that have a weight anywhere, ascending.
fn seen(regions: &[KeptBlocks], count: usize) -> Vec<u32> {
    let mut seen = vec![false; count];
    regions.iter().flat_map(|region| &region.gaussians).for_each(|&i| seen[i as usize] = true);
    (0..).zip(seen).filter_map(|(i, seen)| seen.then_some(i)).collect()
}

impl BlendBlock<'_> {
    /// Number of Gaussians that are seen in the block.
    pub fn entries(&self) -> usize {
        self.rows.len()
    }

    /// Columns and rows of the pixels' centres, px.
    pub fn centres(&self) -> [[f32; LANES]; 2] {
        let mut centres = [[0.0; LANES]; 2];
        for lane in 0..LANES {
            centres[0][lane] = (self.at[0] + lane % BLOCK) as f32 + 0.5;
            centres[1][lane] = (self.at[1] + lane / BLOCK) as f32 + 0.5;
        }
        centres
    }
}

/// Blends channels of one block after the other; keeps its memory.
#[derive(Debug, Clone)]
pub struct BlockBlender {
    level: Level,
    /// Some channels of a block's rows, one after the other.
    gathered: Vec<[f32; GATHERED]>,
}

impl Default for BlockBlender {
    fn default() -> Self {
        Self { level: Level::current(), gathered: Vec::new() }
    }
}

impl BlockBlender {
    /// On the instruction set of the process.
    pub fn new() -> Self {
        Self::default()
    }

    /// Σ w f of a block: as many channels as `out` is long. `features` holds a row of so many values for each of
    /// [`BlendWeights::rows`]; they must be finite.
    ///
    /// # Panics
    /// If `features` has fewer rows.
    pub fn blend(&mut self, block: &BlendBlock<'_>, features: &[f32], out: &mut [[f32; LANES]]) {
        self.level.dispatch(BlendChannels { block, features, gathered: &mut self.gathered, out });
    }
}

/// Channels that are accumulated together where there are many: two vectors of each, one of a weight's two and a feature fill
/// the registers.
const TOGETHER: usize = 6;
/// Channels that are accumulated together where there are few.
const FEW: usize = 4;
/// Channels that are gathered together. The rows of a block lie far apart, often in the same few sets of the first cache,
/// and each is read once per [`TOGETHER`] channels.
const GATHERED: usize = 48;

struct BlendChannels<'a> {
    block: &'a BlendBlock<'a>,
    features: &'a [f32],
    gathered: &'a mut Vec<[f32; GATHERED]>,
    out: &'a mut [[f32; LANES]],
}

impl WithSimd for BlendChannels<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        with_lanes!(s: S, blend(self));
    }
}

#[inline(always)]
fn blend<S: Simd, const N: usize>(s: S, k: BlendChannels<'_>) {
    let (rows, weights, channels) = (k.block.rows, k.block.weights, k.out.len());
    let (many, rest) = k.out.as_chunks_mut::<GATHERED>();
    let mut first = 0;
    for out in many {
        if k.gathered.len() < rows.len() {
            k.gathered.resize(rows.len(), [0.0; GATHERED]);
        }
        for (row, to) in rows.iter().zip(k.gathered.iter_mut()) {
            to.copy_from_slice(&k.features[*row as usize * channels + first..][..GATHERED]);
        }
        for (g, out) in out.as_chunks_mut::<TOGETHER>().0.iter_mut().enumerate() {
            let mut sums: [Block<S, N>; TOGETHER] = [[s.splat_f32s(0.0); N]; TOGETHER];
            for (values, w) in k.gathered.iter().zip(weights) {
                add::<S, N, TOGETHER>(s, &values.as_chunks::<TOGETHER>().0[g], w, &mut sums);
            }
            for c in 0..TOGETHER {
                store_block::<S, N>(&mut out[c], sums[c]);
            }
        }
        first += GATHERED;
    }
    let (some, rest) = rest.as_chunks_mut::<FEW>();
    for out in some {
        blend_some::<S, N, FEW>(s, k.block, k.features, (channels, first), out);
        first += FEW;
    }
    for out in rest.as_chunks_mut::<1>().0 {
        blend_some::<S, N, 1>(s, k.block, k.features, (channels, first), out);
        first += 1;
    }
}

/// Adds w f of some channels of one row.
#[inline(always)]
fn add<S: Simd, const N: usize, const C: usize>(s: S, f: &[f32; C], w: &[f32; LANES], sums: &mut [Block<S, N>; C]) {
    let w = load_block::<S, N>(w);
    for c in 0..C {
        let f = s.splat_f32s(f[c]);
        for i in 0..N {
            sums[c][i] = s.mul_add_e_f32s(w[i], f, sums[c][i]);
        }
    }
}

/// Channels `first..` of rows that are `stride` values apart.
#[inline(always)]
fn blend_some<S: Simd, const N: usize, const C: usize>(
    s: S,
    block: &BlendBlock<'_>,
    features: &[f32],
    (stride, first): (usize, usize),
    out: &mut [[f32; LANES]; C],
) {
    let mut sums: [Block<S, N>; C] = [[s.splat_f32s(0.0); N]; C];
    for (row, w) in block.rows.iter().zip(block.weights) {
        let mut f = [0.0; C];
        f.copy_from_slice(&features[*row as usize * stride + first..][..C]);
        add::<S, N, C>(s, &f, w, &mut sums);
    }
    for c in 0..C {
        store_block::<S, N>(&mut out[c], sums[c]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RasterConfig, project, rasterize_projected};
    use diamond_camera::{Camera, Intrinsics, Pose};
    use glam::{Quat, Vec3};

    /// [eq:splat-blend] Blended block by block with kept weights: the bits of the rasteriser's images, on an image that ends
    /// inside blocks and regions, with channels that do and do not fill a group.
    #[test]
    fn kept_weights_blend_as_the_rasteriser_does() {
        let mut state = 5u32;
        let mut uniform = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / 16_777_216.0
        };
        let mut gaussians = Gaussians::default();
        for _ in 0..700 {
            let mean = Vec3::new(uniform() - 0.5, uniform() - 0.5, 1.5 + uniform());
            let scale = Vec3::new(0.01 + 0.1 * uniform(), 0.02, 0.01 + 0.05 * uniform());
            let rotation = Quat::from_xyzw(uniform(), uniform(), uniform(), 1.0).normalize();
            gaussians.push(mean, scale, rotation, uniform());
        }
        // One behind others that let nothing through.
        for (mean, scale) in
            [(Vec3::new(-1.2, 0.0, 5.0), 0.3); 4].into_iter().chain([(Vec3::new(-1.92, 0.0, 8.0), 0.02)])
        {
            gaussians.push(mean, Vec3::splat(scale), Quat::IDENTITY, 0.99);
        }
        let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.9, 139, 71), pose: Pose::IDENTITY };
        let projection = project(&gaussians, &camera, &RasterConfig::default()).unwrap();
        for (channels, all) in [(0, false), (3, false), (4, true), (13, false), (75, false)] {
            let keep = KeepAll { hidden_rows: all, empty_blocks: all };
            let values: Vec<f32> = (0..gaussians.len() * channels).map(|_| uniform() - 0.5).collect();
            let features = Features { channels, data: values };
            let (raster, pullback) = rasterize_projected(&projection, &gaussians, &features).unwrap();
            let weights = BlendWeights::new(&projection, &gaussians, &keep).unwrap();
            assert_eq!((weights.size(), weights.lines()), ([139, 71], 18));
            let mut d = crate::RasterGrad::zeros(139, 71, channels);
            d.features.data_mut().fill(1.0);
            let pulled = pullback.pull(&d).unwrap();
            let passes = |&&i: &&u32| pulled.features[i as usize * channels] > 0.0;
            let visible = projection.visible();
            if channels > 0 && !all {
                assert_eq!(weights.rows(), visible.iter().filter(passes).copied().collect::<Vec<_>>());
                assert!(weights.rows().len() < visible.len());
            } else if all {
                assert_eq!(weights.blocks(), 35 * 18);
                assert_eq!(weights.rows(), visible);
            }
            let rows: Vec<f32> = weights.rows().iter().flat_map(|&i| features.row(i as usize).to_vec()).collect();
            let mut covered = vec![false; 139 * 71];
            let mut count = 0;
            for line in 0..weights.lines() {
                assert_eq!(weights.line_start(line), count);
                for block in weights.line(line) {
                    let mut out = vec![[f32::NAN; LANES]; channels];
                    BlockBlender::new().blend(&block, &rows, &mut out);
                    assert!((all || block.entries() > 0) && block.at[1] == line * BLOCK);
                    count += 1;
                    for lane in (0..LANES).filter(|l| l % BLOCK < block.size[0] && l / BLOCK < block.size[1]) {
                        let (x, y) = (block.at[0] + lane % BLOCK, block.at[1] + lane / BLOCK);
                        covered[y * 139 + x] = true;
                        let found: Vec<f32> = out.iter().map(|c| c[lane]).collect();
                        assert_eq!(raster.features.pixel(x, y), found);
                        assert_eq!(raster.opacity.pixel(x, y), [block.opacity[lane]]);
                        assert_eq!(raster.depth.pixel(x, y), [block.depth[lane]]);
                    }
                }
            }
            assert_eq!(count, weights.blocks());
            for (i, covered) in covered.into_iter().enumerate() {
                assert!(covered || raster.opacity.data()[i] == 0.0);
            }
        }
        assert!(BlendWeights::new(&projection, &Gaussians::default(), &KeepAll::default()).is_err());
    }
}
