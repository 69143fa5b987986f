//! From 3D Gaussians to screen-space ellipses (EWA splatting): culling, and what a view knows of its Gaussians.
//!
//! A Gaussian with mean `m`, rotation `R_q` and standard deviations `s` is carried to the screen by the first-order
//! expansion of the perspective map at its centre. With `A = J · W · R_q · diag(s)` (2 × 3) the screen covariance is
//! `A Aᵀ + low_pass · I`, which a pixel at offset `d` from the projected mean sees through
//! `σ(d) = ½ |Lᵀ d|²`, where `L Lᵀ` is the inverse covariance (the conic) and `L` its lower Cholesky factor.
//!
//! Everything here is evaluated in f64, once per Gaussian: the inverse of a long thin ellipse loses as many digits as
//! its condition number has, and 1e-5 of relative error is what gradients are allowed. The determinant is a sum of
//! squares (Cauchy–Binet), never a difference.
use crate::bins::{Bins, Run, grid};
use crate::footprint::{Four, Linearised, View};
use crate::wide::{WIDTH, Wide};
use crate::{Cutoff, Gaussians, RasterConfig, SplatError};
use diamond_camera::Camera;
use diamond_simd::{Level, Simd, WithSimd};
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::ops::Range;

/// Relative slack of the extent, so that f32 rounding in the kernels never meets a block that was culled.
const EXTENT_SLACK: f64 = 1e-4;
/// Gaussians per parallel task.
pub(crate) const CHUNK: usize = 1024;

/// The screen-space picture of one Gaussian.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Footprint {
    /// Projected mean, pixels (pixel centres at +0.5).
    pub mean: Vec2,
    /// Inverse screen covariance `(q_xx, q_xy, q_yy)`, 1/px².
    pub conic: Vec3,
    /// View-space z of the mean, scene units.
    pub depth: f32,
    /// Half the width and height of the box outside which alpha is below the threshold, pixels.
    pub extent: Vec2,
}

/// The screen-space picture of one Gaussian in the precision that it is blended with, for engines that blend elsewhere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ellipse64 {
    /// Projected mean, pixels (pixel centres at +0.5).
    pub mean: [f64; 2],
    /// Lower Cholesky factor `l11, l21, l22` of the inverse screen covariance, 1/px.
    pub chol: [f64; 3],
    /// Opacity.
    pub opacity: f32,
    /// View-space z of the mean, scene units.
    pub depth: f32,
    /// Half the width and height of the box outside which alpha is below the threshold, pixels.
    pub extent: [f32; 2],
}

/// One Gaussian that can contribute, with what the kernels need: a cache line.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Splat {
    /// Projected mean, px.
    pub mean: [f64; 2],
    /// Cholesky factor of the conic: `l11, l21, l22`.
    pub chol: [f64; 3],
    /// Index of the Gaussian.
    pub gaussian: u32,
    /// View-space z.
    pub depth: f32,
    /// Opacity.
    pub opacity: f32,
    /// Its logarithm to base 2.
    pub log2_opacity: f32,
    /// Half extents of the ellipse σ ≤ τ, px.
    pub extent: [f32; 2],
}

/// What else finding the blocks of a splat takes.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Outline {
    /// Twice the largest σ at which alpha still counts, with slack.
    pub two_tau: f32,
    /// y of the rightmost point from the mean, px.
    pub rightmost: f32,
    /// Columns of pixels (first, one past last) whose centres it can touch.
    pub columns: [u32; 2],
    /// Rows of pixels, likewise.
    pub rows: [u32; 2],
}

/// The pixels (first, one past last) whose centres lie within `extent` of `mean`, clamped to `size`.
#[inline(always)]
fn pixel_range(mean: f64, extent: f64, size: u32) -> (u32, u32) {
    // `as` saturates, so that infinite and negative ends are clamped.
    ((mean - extent - 0.5).ceil().max(0.0) as u32, ((mean + extent - 0.5).floor() + 1.0).min(size as f64) as u32)
}

/// All Gaussians that can contribute to a view, and where.
#[derive(Debug, Clone)]
pub struct Projection {
    pub(crate) camera: Camera,
    pub(crate) config: RasterConfig,
    pub(crate) bins: Bins,
    visible: Vec<u32>,
    radii: Vec<f32>,
}

impl Projection {
    /// Indices of the Gaussians that can contribute to some pixel, ascending. A feature row of any other Gaussian is
    /// never read.
    pub fn visible(&self) -> &[u32] {
        &self.visible
    }

    /// Per Gaussian (all N): the larger half extent of its footprint on screen, pixels; 0 where it is culled.
    pub fn radii(&self) -> &[f32] {
        &self.radii
    }

    /// The camera it was made for.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The settings it was made with.
    pub fn config(&self) -> &RasterConfig {
        &self.config
    }

    fn splat(&self, gaussian: usize) -> Option<&Splat> {
        let k = self.visible.binary_search(&u32::try_from(gaussian).ok()?).ok()?;
        let run = self.bins.ranges.partition_point(|range| range.end <= k);
        Some(&self.bins.runs[run].splats[k - self.bins.ranges[run].start])
    }

    /// The ellipse of a Gaussian as it is blended, `None` where it is culled.
    pub fn ellipse(&self, gaussian: usize) -> Option<Ellipse64> {
        let Splat { mean, chol, opacity, depth, extent, .. } = *self.splat(gaussian)?;
        Some(Ellipse64 { mean, chol, opacity, depth, extent })
    }

    /// The footprint of a Gaussian, `None` where it is culled.
    pub fn footprint(&self, gaussian: usize) -> Option<Footprint> {
        let s = self.splat(gaussian)?;
        let [l11, l21, l22] = s.chol;
        Some(Footprint {
            mean: Vec2::new(s.mean[0] as f32, s.mean[1] as f32),
            conic: Vec3::new((l11 * l11) as f32, (l11 * l21) as f32, (l21 * l21 + l22 * l22) as f32),
            depth: s.depth,
            extent: Vec2::from_array(s.extent),
        })
    }
}

/// Projects and culls `[eq:ewa-projection]`.
///
/// Culled are Gaussians with view-space z ≤ `near`, with opacity below `min_alpha`, and those whose ellipse
/// `σ ≤ ln(opacity / min_alpha)` holds no pixel centre of the image (by its box).
///
/// # Errors
/// Arrays of different lengths, values that are not finite, scales below 0, opacities outside [0, 1], settings or
/// camera out of range.
pub fn project(gaussians: &Gaussians, camera: &Camera, config: &RasterConfig) -> Result<Projection, SplatError> {
    config.validate()?;
    gaussians.validate()?;
    validate_camera(camera)?;
    let n = gaussians.len();
    if n > MAX_GAUSSIANS {
        return Err(SplatError::Shape {
            what: "Gaussians",
            expected: format!("at most {MAX_GAUSSIANS}"),
            found: n.to_string(),
        });
    }
    let view = View::new(camera);
    let level = Level::current();
    let runs: Vec<Run> = (0..n.div_ceil(CHUNK))
        .into_par_iter()
        .map(|chunk| {
            let range = chunk * CHUNK..n.min((chunk + 1) * CHUNK);
            level.dispatch(ProjectRun { gaussians, range, view: &view, config })
        })
        .collect();
    let mut radii = vec![0.0; n];
    radii.par_chunks_mut(CHUNK).zip(&runs).enumerate().for_each(|(chunk, (radii, run))| {
        for s in &run.splats {
            radii[s.gaussian as usize - chunk * CHUNK] = s.extent[0].max(s.extent[1]);
        }
    });
    let visible = runs.par_iter().flat_map_iter(|run| run.splats.iter().map(|s| s.gaussian)).collect();
    let [width, height] = grid(view.size.map(|side| side as usize));
    let bins = Bins::new(runs, width * height);
    Ok(Projection { camera: *camera, config: *config, bins, visible, radii })
}

/// The projection of consecutive Gaussians.
struct ProjectRun<'a> {
    gaussians: &'a Gaussians,
    range: Range<usize>,
    view: &'a View,
    config: &'a RasterConfig,
}

impl WithSimd for ProjectRun<'_> {
    type Output = Run;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> Run {
        let ProjectRun { gaussians, range, view, config } = self;
        let mut splats = Vec::with_capacity(range.len());
        let mut outlines = Vec::with_capacity(range.len());
        for first in range.clone().step_by(WIDTH) {
            // The last stands in for those beyond the end; what comes out for them is not used.
            let mut four = [first; WIDTH];
            for k in 0..WIDTH {
                four[k] = (first + k).min(range.end - 1);
            }
            let projected = project_four(gaussians, four, view, config);
            for (splat, outline) in projected.into_iter().take(range.end - first).flatten() {
                splats.push(splat);
                outlines.push(outline);
            }
        }
        Run::new(s, splats, &outlines, view.size.map(|side| side as usize))
    }
}

/// Indices are 32 bits, with room for sentinels.
const MAX_GAUSSIANS: usize = 1 << 28;
/// Largest side of an image, pixels.
const MAX_SIDE: u32 = 1 << 15;

fn validate_camera(camera: &Camera) -> Result<(), SplatError> {
    let k = &camera.intrinsics;
    let pose = &camera.pose;
    if !(pose.rotation.is_finite() && pose.translation.is_finite()) {
        return Err(SplatError::NonFinite { what: "Camera::pose", index: 0 });
    }
    for (what, value) in [("Intrinsics::cx", k.cx), ("Intrinsics::cy", k.cy)] {
        if !value.is_finite() {
            return Err(SplatError::NonFinite { what, index: 0 });
        }
    }
    for (what, found) in [("Intrinsics::fx", k.fx), ("Intrinsics::fy", k.fy)] {
        if !(found > 0.0 && found.is_finite()) {
            return Err(SplatError::Range { what, index: 0, expected: "(0, ∞) pixels", found });
        }
    }
    for (what, side) in [("Intrinsics::width", k.width), ("Intrinsics::height", k.height)] {
        if !(1..=MAX_SIDE).contains(&side) {
            return Err(SplatError::Range { what, index: 0, expected: "[1, 32768] pixels", found: side as f32 });
        }
    }
    Ok(())
}

/// Four Gaussians' splats, `None` where they are culled. To be compiled where the instruction set is known: it has roots
/// and roundings in it.
#[inline(always)]
fn project_four(g: &Gaussians, four: Four, view: &View, config: &RasterConfig) -> [Option<(Splat, Outline)>; WIDTH] {
    let lin = Linearised::of(g, four, view);
    let [r0, r1] = lin.a;
    let dot = |a: &[Wide; 3], b: &[Wide; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let (xx, yy, xy) = (dot(&r0, &r0), dot(&r1, &r1), dot(&r0, &r1));
    let minor = |j: usize, k: usize| r0[j] * r1[k] - r0[k] * r1[j];
    let minors = [minor(0, 1), minor(0, 2), minor(1, 2)];
    let low = config.low_pass as f64;
    let det = dot(&minors, &minors) + (xx + yy + Wide::of(low)) * low;
    let cov = [xx + Wide::of(low), xy, yy + Wide::of(low)];
    let mut mean = [Wide::ZERO; 2];
    for axis in 0..2 {
        mean[axis] = lin.p[axis] * view.f[axis] * lin.inv_z + Wide::of(view.c[axis]);
    }
    let inv_sqrt_yy = cov[2].sqrt().recip();
    let inv_sqrt_det = det.sqrt().recip();
    let chol = [cov[2].sqrt() * inv_sqrt_det, -cov[1] * inv_sqrt_yy * inv_sqrt_det, inv_sqrt_yy];
    let min_alpha_log2 = libm::log2(config.min_alpha as f64);
    let mut log2_opacity = Wide::ZERO;
    for k in 0..WIDTH {
        log2_opacity.0[k] = libm::log2(g.opacities[four[k]] as f64);
    }
    let tau = (log2_opacity - Wide::of(min_alpha_log2)).clamp(0.0, f64::MAX) * std::f64::consts::LN_2;
    let two_tau = tau * (2.0 * (1.0 + EXTENT_SLACK)) + Wide::of(EXTENT_SLACK);
    let (ex, ey) = ((two_tau * cov[0]).sqrt(), (two_tau * cov[2]).sqrt());
    let rightmost = cov[1] * cov[0].recip() * ex;
    let mut out = [None; WIDTH];
    for k in 0..WIDTH {
        let (opacity, z) = (g.opacities[four[k]], lin.p[2].0[k]);
        let (mean, cov, chol) = (Wide::lane(&mean, k), Wide::lane(&cov, k), Wide::lane(&chol, k));
        if opacity < config.min_alpha || opacity <= 0.0 || !(z > config.near as f64 && z < MAX_DEPTH) {
            continue;
        }
        let finite = within(&mean, MAX_MEAN) && within(&cov, MAX_COVARIANCE) && within(&chol, MAX_MEAN);
        let (x0, x1) = pixel_range(mean[0], ex.0[k], view.size[0]);
        let (y0, y1) = pixel_range(mean[1], ey.0[k], view.size[1]);
        if !(finite && det.0[k].is_finite() && x0 < x1 && y0 < y1) {
            continue;
        }
        let splat = Splat {
            mean,
            chol,
            gaussian: four[k] as u32,
            depth: z as f32,
            opacity,
            log2_opacity: log2_opacity.0[k] as f32,
            extent: [ex.0[k] as f32, ey.0[k] as f32],
        };
        let outline = Outline {
            two_tau: two_tau.0[k] as f32,
            rightmost: rightmost.0[k] as f32,
            columns: [x0, x1],
            rows: [y0, y1],
        };
        out[k] = Some((splat, outline));
    }
    out
}

/// Screen means beyond this (px) and covariances beyond this (px²) are culled: their f32 copies would overflow when
/// squared.
const MAX_MEAN: f64 = 1e15;
const MAX_COVARIANCE: f64 = 1e30;

/// Gaussians at this view-space z or farther (scene units) are culled: products with their depth would overflow.
const MAX_DEPTH: f64 = 1e18;

/// Whether all values are numbers of at most that magnitude.
#[inline(always)]
fn within(values: &[f64], largest: f64) -> bool {
    values.iter().all(|v| v.abs() <= largest)
}

/// Whether `config` asks for the C¹ stand-in.
pub(crate) fn is_smooth(config: &RasterConfig) -> bool {
    config.cutoff == Cutoff::Smooth
}
