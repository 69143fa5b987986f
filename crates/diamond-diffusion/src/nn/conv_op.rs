//! Two-dimensional convolution on the CPU: tiles of patches, and a matrix product for each, forward and backward.
//!
//! A tile is a few rows of the output; its patches are gathered into a matrix of (channels · kernel) × pixels (im2col) that fits
//! the cache. Every sum is made by one thread in a fixed order, so results do not depend on the number of threads.
use super::cpu::{Matrix, Real, by_type, matmul, slice, with_slices};
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;
use std::ops::Range;

/// Pixels of a tile, about: the patches of 64 channels under a 3 × 3 kernel are then 1.2 MB.
const TILE_PIXELS: usize = 512;

/// Rows of patches (channels · kernel) that one task of a backward pass treats, about.
const BLOCK_ROWS: usize = 144;

/// Sizes of a convolution.
#[derive(Debug, Clone, Copy)]
struct Geometry {
    batch: usize,
    c_in: usize,
    height: usize,
    width: usize,
    c_out: usize,
    kernel: (usize, usize),
    stride: usize,
    padding: usize,
    out_height: usize,
    out_width: usize,
}

impl Geometry {
    fn new(x: &[usize], weight: &[usize], stride: usize, padding: usize) -> Result<Self> {
        let (&[batch, c_in, height, width], &[c_out, c_weight, kernel_y, kernel_x]) = (x, weight) else {
            bail!(
                "convolution: expected (batch, channels, height, width) and (out, in, y, x), found {x:?} and {weight:?}"
            );
        };
        if c_in != c_weight {
            bail!("convolution: the weight takes {c_weight} channels, the picture has {c_in}");
        }
        let out = |size: usize, kernel: usize| (size + 2 * padding).checked_sub(kernel).map(|room| room / stride + 1);
        let (Some(out_height), Some(out_width)) = (out(height, kernel_y), out(width, kernel_x)) else {
            bail!("convolution: a picture of {width}×{height} with padding {padding} is smaller than the kernel");
        };
        let kernel = (kernel_y, kernel_x);
        Ok(Self { batch, c_in, height, width, c_out, kernel, stride, padding, out_height, out_width })
    }

    fn taps(&self) -> usize {
        self.kernel.0 * self.kernel.1
    }

    fn pixels_in(&self) -> usize {
        self.height * self.width
    }

    fn pixels_out(&self) -> usize {
        self.out_height * self.out_width
    }

    /// Whether the patches are the picture itself.
    fn is_pointwise(&self) -> bool {
        self.kernel == (1, 1) && self.stride == 1 && self.padding == 0
    }

    /// Ranges of output rows.
    fn tiles(&self) -> Vec<Range<usize>> {
        let rows = (TILE_PIXELS / self.out_width.max(1)).max(1);
        (0..self.out_height).step_by(rows).map(|from| from..(from + rows).min(self.out_height)).collect()
    }

    /// Channels of one block of a backward pass.
    fn block(&self) -> usize {
        (BLOCK_ROWS / self.taps()).clamp(1, self.c_in.max(1))
    }

    /// Input columns that output columns read at kernel column `kernel_x` with stride 1: (first output, past the last).
    fn columns(&self, kernel_x: usize) -> (usize, usize) {
        let from = self.padding.saturating_sub(kernel_x).min(self.out_width);
        let to = (self.width + self.padding).saturating_sub(kernel_x).min(self.out_width);
        (from, to.max(from))
    }

    /// The row of the picture under output row `y` and kernel row `kernel_y`.
    fn row(&self, y: usize, kernel_y: usize) -> Option<usize> {
        (y * self.stride + kernel_y).checked_sub(self.padding).filter(|row| *row < self.height)
    }

    /// Patches of some channels of one picture under some output rows: rows channel · kernel, columns pixels.
    fn gather<T: Real>(&self, picture: &[T], channels: Range<usize>, rows: Range<usize>, patches: &mut [T]) {
        let zero = T::from_f64(0.0);
        let pixels = rows.len() * self.out_width;
        let lines = channels.flat_map(|c| (0..self.taps()).map(move |tap| (c, tap)));
        for (line, (c, tap)) in patches.chunks_exact_mut(pixels).zip(lines) {
            let (kernel_y, kernel_x) = (tap / self.kernel.1, tap % self.kernel.1);
            for (out, y) in line.chunks_exact_mut(self.out_width).zip(rows.clone()) {
                let Some(row) = self.row(y, kernel_y) else {
                    out.fill(zero);
                    continue;
                };
                let source = &picture[(c * self.height + row) * self.width..][..self.width];
                if self.stride == 1 {
                    let (from, to) = self.columns(kernel_x);
                    out[..from].fill(zero);
                    if to > from {
                        let start = from + kernel_x - self.padding;
                        out[from..to].copy_from_slice(&source[start..start + to - from]);
                    }
                    out[to..].fill(zero);
                } else {
                    for (x, out) in out.iter_mut().enumerate() {
                        let column = (x * self.stride + kernel_x).checked_sub(self.padding);
                        *out = column.and_then(|column| source.get(column)).copied().unwrap_or(zero);
                    }
                }
            }
        }
    }

    /// The reverse of [`Geometry::gather`]: adds patches to the channels that they were taken from, which begin at `picture[0]`.
    fn scatter<T: Real>(&self, patches: &[T], rows: Range<usize>, picture: &mut [T]) {
        let pixels = rows.len() * self.out_width;
        for (i, line) in patches.chunks_exact(pixels).enumerate() {
            let (c, tap) = (i / self.taps(), i % self.taps());
            let (kernel_y, kernel_x) = (tap / self.kernel.1, tap % self.kernel.1);
            for (from_row, y) in line.chunks_exact(self.out_width).zip(rows.clone()) {
                let Some(row) = self.row(y, kernel_y) else { continue };
                let target = &mut picture[(c * self.height + row) * self.width..][..self.width];
                if self.stride == 1 {
                    let (from, to) = self.columns(kernel_x);
                    if to > from {
                        let start = from + kernel_x - self.padding;
                        for (t, v) in target[start..start + to - from].iter_mut().zip(&from_row[from..to]) {
                            *t += *v;
                        }
                    }
                } else {
                    for (x, v) in from_row.iter().enumerate() {
                        let column = (x * self.stride + kernel_x).checked_sub(self.padding);
                        if let Some(t) = column.and_then(|column| target.get_mut(column)) {
                            *t += *v;
                        }
                    }
                }
            }
        }
    }
}

fn forward<T: Real>(g: &Geometry, x: &[T], weight: &[T]) -> Result<Vec<T>> {
    let zero = T::from_f64(0.0);
    let (k, pixels_out) = (g.c_in * g.taps(), g.pixels_out());
    let tiles = g.tiles();
    let mut out = vec![zero; g.batch * g.c_out * pixels_out];
    let tasks: Vec<(usize, Range<usize>)> =
        (0..g.batch).flat_map(|b| tiles.iter().map(move |tile| (b, tile.clone()))).collect();
    let parts: Vec<Vec<T>> = tasks
        .par_iter()
        .map(|(b, rows)| {
            let picture = &x[b * g.c_in * g.pixels_in()..][..g.c_in * g.pixels_in()];
            let n = rows.len() * g.out_width;
            let mut part = vec![zero; g.c_out * n];
            if g.is_pointwise() {
                let from = &picture[rows.start * g.width..];
                let patches = Matrix { values: from, row_stride: g.pixels_in(), column_stride: 1 };
                matmul((g.c_out, k, n), Matrix::rows(weight, k), patches, &mut part, n, false);
            } else {
                let mut patches = vec![zero; k * n];
                g.gather(picture, 0..g.c_in, rows.clone(), &mut patches);
                matmul((g.c_out, k, n), Matrix::rows(weight, k), Matrix::rows(&patches, n), &mut part, n, false);
            }
            part
        })
        .collect();
    for ((b, rows), part) in tasks.iter().zip(&parts) {
        let n = rows.len() * g.out_width;
        for (c, line) in part.chunks_exact(n).enumerate() {
            let start = (b * g.c_out + c) * pixels_out + rows.start * g.out_width;
            out[start..start + n].copy_from_slice(line);
        }
    }
    Ok(out)
}

fn input_gradient<T: Real>(g: &Geometry, d_out: &[T], weight: &[T]) -> Result<Vec<T>> {
    let zero = T::from_f64(0.0);
    let (k, pixels_out, block) = (g.c_in * g.taps(), g.pixels_out(), g.block());
    let tiles = g.tiles();
    let mut d_x = vec![zero; g.batch * g.c_in * g.pixels_in()];
    let pictures = d_x.chunks_mut((g.c_in * g.pixels_in()).max(1)).enumerate();
    let tasks: Vec<(usize, usize, &mut [T])> = pictures
        .flat_map(|(b, picture)| {
            picture.chunks_mut((block * g.pixels_in()).max(1)).enumerate().map(move |(i, d_x)| (b, i * block, d_x))
        })
        .collect();
    tasks.into_par_iter().for_each(|(b, first, d_x)| {
        let lines = d_x.len() / g.pixels_in() * g.taps();
        let weights = Matrix { values: &weight[first * g.taps()..], row_stride: k, column_stride: 1 };
        let mut patches = Vec::new();
        for rows in &tiles {
            let n = rows.len() * g.out_width;
            let from = &d_out[b * g.c_out * pixels_out + rows.start * g.out_width..];
            let d_tile = Matrix { values: from, row_stride: pixels_out, column_stride: 1 };
            patches.clear();
            patches.resize(lines * n, zero);
            matmul((lines, g.c_out, n), weights.t(), d_tile, &mut patches, n, false);
            g.scatter(&patches, rows.clone(), d_x);
        }
    });
    Ok(d_x)
}

fn weight_gradient<T: Real>(g: &Geometry, d_out: &[T], x: &[T]) -> Result<Vec<T>> {
    let zero = T::from_f64(0.0);
    let (k, pixels_out, block) = (g.c_in * g.taps(), g.pixels_out(), g.block());
    let tiles = g.tiles();
    let blocks: Vec<Range<usize>> = (0..g.c_in).step_by(block).map(|c| c..(c + block).min(g.c_in)).collect();
    let parts: Vec<Vec<T>> = blocks
        .par_iter()
        .map(|channels| {
            let lines = channels.len() * g.taps();
            let mut part = vec![zero; g.c_out * lines];
            let mut patches = Vec::new();
            for b in 0..g.batch {
                let picture = &x[b * g.c_in * g.pixels_in()..][..g.c_in * g.pixels_in()];
                for rows in &tiles {
                    let n = rows.len() * g.out_width;
                    let from = &d_out[b * g.c_out * pixels_out + rows.start * g.out_width..];
                    let d_tile = Matrix { values: from, row_stride: pixels_out, column_stride: 1 };
                    patches.clear();
                    patches.resize(lines * n, zero);
                    g.gather(picture, channels.clone(), rows.clone(), &mut patches);
                    matmul((g.c_out, n, lines), d_tile, Matrix::rows(&patches, n).t(), &mut part, lines, true);
                }
            }
            part
        })
        .collect();
    let mut d_weight = vec![zero; g.c_out * k];
    for (channels, part) in blocks.iter().zip(&parts) {
        let lines = channels.len() * g.taps();
        for (c_out, line) in part.chunks_exact(lines).enumerate() {
            d_weight[c_out * k + channels.start * g.taps()..][..lines].copy_from_slice(line);
        }
    }
    Ok(d_weight)
}

/// The operation as candle's graph knows it.
struct Convolution {
    stride: usize,
    padding: usize,
}

fn run<T: Real>(g: &Geometry, x: (&CpuStorage, &Layout), weight: (&CpuStorage, &Layout)) -> Result<CpuStorage> {
    Ok(T::to_cpu_storage_owned(forward::<T>(g, slice(x.0, x.1)?, slice(weight.0, weight.1)?)?))
}

fn pull<T: Real>(
    g: &Geometry,
    x: &Tensor,
    weight: &Tensor,
    d_out: &Tensor,
) -> Result<(Option<Tensor>, Option<Tensor>)> {
    with_slices::<T, _, 3>([x, weight, d_out], |[x_values, weights, d_out]| {
        let d_x = match x.track_op() {
            true => Some(Tensor::from_vec(input_gradient(g, d_out, weights)?, x.shape(), x.device())?),
            false => None,
        };
        let d_weight = match weight.track_op() {
            true => Some(Tensor::from_vec(weight_gradient(g, d_out, x_values)?, weight.shape(), x.device())?),
            false => None,
        };
        Ok((d_x, d_weight))
    })
}

impl CustomOp2 for Convolution {
    fn name(&self) -> &'static str {
        "convolution"
    }

    fn cpu_fwd(&self, x: &CpuStorage, lx: &Layout, w: &CpuStorage, lw: &Layout) -> Result<(CpuStorage, Shape)> {
        use candle_core::backend::BackendStorage;
        let g = Geometry::new(lx.dims(), lw.dims(), self.stride, self.padding)?;
        let out = by_type!(x.dtype(), run(&g, (x, lx), (w, lw)))?;
        Ok((out, Shape::from((g.batch, g.c_out, g.out_height, g.out_width))))
    }

    fn bwd(&self, x: &Tensor, w: &Tensor, _: &Tensor, d_out: &Tensor) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let g = Geometry::new(x.dims(), w.dims(), self.stride, self.padding)?;
        let d_out = d_out.contiguous()?;
        by_type!(x.dtype(), pull(&g, x, w, &d_out))
    }
}

/// Convolution (cross-correlation) of pictures (batch, in, height, width) with a weight (out, in, y, x), zeros around the picture.
/// `[eq:convolution]`
///
/// On the CPU it is the operation of this crate, for `f32` and `f64`; elsewhere candle's own.
pub fn conv2d(x: &Tensor, weight: &Tensor, stride: usize, padding: usize) -> Result<Tensor> {
    if stride == 0 {
        bail!("convolution: expected a stride of at least 1, found 0");
    }
    if x.device().is_cpu() {
        x.contiguous()?.apply_op2(&weight.contiguous()?, Convolution { stride, padding })
    } else {
        x.conv2d(weight, padding, stride, 1, 1)
    }
}
