//! Adam and the statistics of density control on a device.
use crate::frame::Frame;
use crate::job::{Job, words};
use crate::kernels::Module;
use crate::scene_arrays::d_screen;
use crate::{Device, GpuError};
use bytemuck::{Pod, Zeroable};
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_reconstruct::adam::{Moments, Rows};
use diamond_splat::density::DensityStats;
use diamond_splat::{RasterConfig, SplatError};
use glam::Vec2;

/// `Update` of `adam.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct Update {
    /// rate / (1 − β₁ᵗ).
    pub step: f32,
    /// 1/√(1 − β₂ᵗ).
    pub scale: f32,
    /// Numbers in a row.
    pub width: u32,
    /// 1: only rows whose gradient is not all 0.
    pub seen: u32,
}

impl Update {
    pub fn new(rate: f32, t: u64, rows: Rows) -> Self {
        // β₁ and β₂, as on the CPU.
        let correction = |beta: f32| 1.0 - libm::pow(f64::from(beta), t as f64);
        let (width, seen) = match rows {
            Rows::All => (1, 0),
            Rows::Seen { width } => (width.max(1) as u32, 1),
        };
        Self {
            step: (f64::from(rate) / correction(0.9)) as f32,
            scale: (1.0 / correction(0.999).sqrt()) as f32,
            width,
            seen,
        }
    }
}

/// A frame for kernels that see no picture.
pub(crate) fn no_frame(gaussians: u32, size: [u32; 2]) -> Frame {
    let intrinsics = Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, width: size[0], height: size[1] };
    Frame::new(&Camera { intrinsics, pose: Pose::IDENTITY }, &RasterConfig::default(), gaussians, false, 0)
}

/// One update of `values` along `gradient`, as [`diamond_reconstruct::adam::adam_step`] does `[eq:adam]`; `t` counts updates
/// from 1. Squares of gradients below 1e-19 may vanish on the device, which keeps no subnormal numbers.
///
/// # Errors
/// Slices of different lengths; arrays beyond the device's limits or memory; a lost device.
pub fn adam_step(
    device: &Device,
    values: &mut [f32],
    moments: &mut Moments,
    gradient: &[f32],
    rate: f32,
    t: u64,
    rows: Rows,
) -> Result<(), GpuError> {
    let n = values.len();
    for (what, found) in [
        ("Moments::first", moments.first.len()),
        ("Moments::second", moments.second.len()),
        ("adam_step, gradient", gradient.len()),
    ] {
        if found != n {
            let (expected, found) = (format!("{n} (one per value)"), found.to_string());
            return Err(SplatError::Shape { what, expected, found }.into());
        }
    }
    if n == 0 {
        return Ok(());
    }
    let mut job = Job::new(device, &no_frame(0, [1, 1]))?;
    let update = job.input("update", bytemuck::cast_slice(bytemuck::bytes_of(&Update::new(rate, t, rows))))?;
    let d = job.input("gradient", words(gradient))?;
    let x = job.input("values", words(values))?;
    let first = job.input("first moments", words(&moments.first))?;
    let second = job.input("second moments", words(&moments.second))?;
    let count = job.input("count", &[n as u32])?;
    job.over(Module::Adam, "adam", &[update, d, x, first, second, count], n as u64)?;
    let read = job.finish(&[(x, n as u64), (first, n as u64), (second, n as u64)])?;
    values.copy_from_slice(&read[0]);
    moments.first.copy_from_slice(&read[1]);
    moments.second.copy_from_slice(&read[2]);
    Ok(())
}

/// Adds one view of `width` × `height` pixels, as [`DensityStats::record`] does `[eq:density-gradient]`.
///
/// # Errors
/// Slices of another length than the statistics; arrays beyond the device's limits or memory; a lost device.
pub fn record_view(
    device: &Device,
    stats: &mut DensityStats,
    d_mean2d: &[Vec2],
    radii: &[f32],
    width: u32,
    height: u32,
) -> Result<(), GpuError> {
    let n = stats.len();
    for (what, found) in [("record_view, d_mean2d", d_mean2d.len()), ("record_view, radii", radii.len())] {
        if found != n {
            let (expected, found) = (n.to_string(), found.to_string());
            return Err(SplatError::Shape { what, expected, found }.into());
        }
    }
    if n == 0 {
        return Ok(());
    }
    let mut job = Job::new(device, &no_frame(n as u32, [width, height]))?;
    let gradient = job.input("gradient of the Gaussians", &d_screen(d_mean2d))?;
    let outlines: Vec<f32> = radii.iter().flat_map(|radius| [*radius, 0.0, 0.0, 0.0]).collect();
    let outlines = job.input("outlines", words(&outlines))?;
    // Counts are far below 2²⁴, so f32 holds them exactly.
    let before: Vec<f32> =
        (0..n).flat_map(|i| [stats.gradient_sum[i], stats.views[i] as f32, stats.max_radius[i], 0.0]).collect();
    let all = job.input("statistics", words(&before))?;
    job.over(Module::DensityStats, "record_view", &[gradient, outlines, all], n as u64)?;
    let read = job.finish(&[(all, 4 * n as u64)])?.swap_remove(0);
    for (i, from) in read.chunks_exact(4).enumerate() {
        stats.gradient_sum[i] = from[0];
        stats.views[i] = from[1] as u32;
        stats.max_radius[i] = from[2];
    }
    Ok(())
}
