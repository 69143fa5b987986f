//! From 3D Gaussians to screen-space ellipses (EWA splatting), and back.
//!
//! A Gaussian with mean `m`, rotation `R_q` and standard deviations `s` is carried to the screen by the first-order
//! expansion of the perspective map at its centre. With `A = J · W · R_q · diag(s)` (2 × 3) the screen covariance is
//! `A Aᵀ + low_pass · I`, which a pixel at offset `d` from the projected mean sees through
//! `σ(d) = ½ |Lᵀ d|²`, where `L Lᵀ` is the inverse covariance (the conic) and `L` its lower Cholesky factor.
//!
//! Everything here is evaluated in f64, once per Gaussian: the inverse of a long thin ellipse loses as many digits as
//! its condition number has, and 1e-5 of relative error is what gradients are allowed. The determinant is a sum of
//! squares (Cauchy–Binet), never a difference.
use crate::{Cutoff, Gaussians, RasterConfig, SplatError};
use diamond_camera::Camera;
use glam::{Quat, Vec2, Vec3, Vec4};
use rayon::prelude::*;

/// How far beyond the image, as a fraction of the half field of view, the linearisation point may lie. Farther out the
/// tangent x/z is clamped, because the linear map there would smear a Gaussian over the whole image.
const JACOBIAN_MARGIN: f64 = 0.3;
/// Quaternions of smaller squared norm count as the identity, with zero gradient: their direction is rounding noise.
const MIN_QUATERNION_NORM2: f64 = 1e-24;
/// Relative slack of the extent, so that f32 rounding in the kernels never meets a block that was culled.
const EXTENT_SLACK: f64 = 1e-4;
/// Gaussians per parallel task.
const CHUNK: usize = 1024;

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

/// One Gaussian that can contribute, with what the kernels need.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Splat {
    /// Index of the Gaussian.
    pub gaussian: u32,
    /// View-space z.
    pub depth: f32,
    /// Opacity.
    pub opacity: f32,
    /// Projected mean, px.
    pub mean: [f64; 2],
    /// Screen covariance with low-pass: xx, xy, yy.
    pub cov: [f64; 3],
    /// Cholesky factor of the conic: `l11, l21, l22`.
    pub chol: [f64; 3],
    /// Twice the largest σ at which alpha still counts, with slack.
    pub two_tau: f64,
}

impl Splat {
    /// Half extents of the ellipse σ ≤ τ, px.
    pub fn extent(&self) -> [f64; 2] {
        [(self.two_tau * self.cov[0]).sqrt(), (self.two_tau * self.cov[2]).sqrt()]
    }

    /// The pixels (first, one past last) whose centres lie within the ellipse's box, clamped to `size`.
    fn pixel_range(mean: f64, extent: f64, size: u32) -> (u32, u32) {
        // `as` saturates, so that infinite and negative ends are clamped.
        ((mean - extent - 0.5).ceil().max(0.0) as u32, ((mean + extent - 0.5).floor() + 1.0).min(size as f64) as u32)
    }

    /// Rows of pixels (first, one past last) that it can touch in an image of that height.
    pub fn pixel_rows(&self, height: u32) -> (u32, u32) {
        Self::pixel_range(self.mean[1], self.extent()[1], height)
    }
}

/// All Gaussians that can contribute to a view, and where.
#[derive(Debug, Clone)]
pub struct Projection {
    pub(crate) camera: Camera,
    pub(crate) config: RasterConfig,
    pub(crate) splats: Vec<Splat>,
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

    /// The footprint of a Gaussian, `None` where it is culled.
    pub fn footprint(&self, gaussian: usize) -> Option<Footprint> {
        let k = self.visible.binary_search(&u32::try_from(gaussian).ok()?).ok()?;
        let s = &self.splats[k];
        let [l11, l21, l22] = s.chol;
        let [x, y] = s.extent();
        Some(Footprint {
            mean: Vec2::new(s.mean[0] as f32, s.mean[1] as f32),
            conic: Vec3::new((l11 * l11) as f32, (l11 * l21) as f32, (l21 * l21 + l22 * l22) as f32),
            depth: s.depth,
            extent: Vec2::new(x as f32, y as f32),
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
    let chunks: Vec<Vec<Splat>> = (0..n.div_ceil(CHUNK))
        .into_par_iter()
        .map(|chunk| {
            let range = chunk * CHUNK..n.min((chunk + 1) * CHUNK);
            let mut splats = Vec::with_capacity(range.len());
            splats.extend(range.filter_map(|i| project_one(gaussians, i, &view, config)));
            splats
        })
        .collect();
    let mut splats = Vec::with_capacity(chunks.iter().map(Vec::len).sum());
    chunks.iter().for_each(|c| splats.extend_from_slice(c));
    let mut radii = vec![0.0; n];
    for s in &splats {
        let [x, y] = s.extent();
        radii[s.gaussian as usize] = x.max(y) as f32;
    }
    let visible = splats.iter().map(|s| s.gaussian).collect();
    Ok(Projection { camera: *camera, config: *config, splats, visible, radii })
}

/// Entries of tile lists hold 28 bits of index.
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

/// A camera in f64, with the limits of the linearisation point.
pub(crate) struct View {
    w: [[f64; 3]; 3],
    t: [f64; 3],
    f: [f64; 2],
    c: [f64; 2],
    /// Lower and upper limit of x/z and y/z.
    limits: [[f64; 2]; 2],
    size: [u32; 2],
}

impl View {
    pub fn new(camera: &Camera) -> Self {
        let k = &camera.intrinsics;
        let r = camera.pose.rotation.to_cols_array_2d();
        let (f, c) = ([k.fx as f64, k.fy as f64], [k.cx as f64, k.cy as f64]);
        let limits = std::array::from_fn(|a| {
            let side = [k.width, k.height][a] as f64;
            let margin = JACOBIAN_MARGIN * 0.5 * side / f[a];
            [-c[a] / f[a] - margin, (side - c[a]) / f[a] + margin]
        });
        Self {
            w: std::array::from_fn(|row| std::array::from_fn(|col| r[col][row] as f64)),
            t: camera.pose.translation.to_array().map(f64::from),
            f,
            c,
            limits,
            size: [k.width, k.height],
        }
    }
}

/// The intermediate values of one projection that its pullback needs as well.
struct Linearised {
    /// Mean in camera coordinates.
    p: [f64; 3],
    /// Clamped x/z, y/z of the linearisation point, and whether the clamp was inactive.
    tangent: [f64; 2],
    free: [bool; 2],
    /// Unit quaternion x, y, z, w and 1/norm (0 where it counts as the identity).
    q: [f64; 4],
    inv_norm: f64,
    /// Rotation of the Gaussian in camera axes.
    v: [[f64; 3]; 3],
    /// A = J · W · R_q · diag(s), 2 × 3.
    a: [[f64; 3]; 2],
}

impl Linearised {
    fn new(mean: Vec3, scale: Vec3, rotation: Quat, view: &View) -> Self {
        let m = mean.to_array().map(f64::from);
        let p: [f64; 3] =
            std::array::from_fn(|r| view.w[r][0] * m[0] + view.w[r][1] * m[1] + view.w[r][2] * m[2] + view.t[r]);
        let raw = [p[0] / p[2], p[1] / p[2]];
        let tangent: [f64; 2] = std::array::from_fn(|a| raw[a].max(view.limits[a][0]).min(view.limits[a][1]));
        let free = [tangent[0] == raw[0], tangent[1] == raw[1]];
        let q = rotation.to_array().map(f64::from);
        let norm2: f64 = q.iter().map(|v| v * v).sum();
        let (q, inv_norm) = if norm2 < MIN_QUATERNION_NORM2 {
            ([0.0, 0.0, 0.0, 1.0], 0.0)
        } else {
            let inv = 1.0 / norm2.sqrt();
            (q.map(|v| v * inv), inv)
        };
        let rotation = rotation_matrix(q);
        let v: [[f64; 3]; 3] = std::array::from_fn(|r| {
            std::array::from_fn(|c| (0..3).map(|k| view.w[r][k] * rotation[k][c]).sum::<f64>())
        });
        let s = scale.to_array().map(f64::from);
        let a = std::array::from_fn(|axis| {
            let k = view.f[axis] / p[2];
            std::array::from_fn(|j| k * (v[axis][j] - tangent[axis] * v[2][j]) * s[j])
        });
        Self { p, tangent, free, q, inv_norm, v, a }
    }
}

fn rotation_matrix([x, y, z, w]: [f64; 4]) -> [[f64; 3]; 3] {
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// Pullback of [`rotation_matrix`] for the four numbers as if they were independent.
fn rotation_matrix_pull([x, y, z, w]: [f64; 4], d: [[f64; 3]; 3]) -> [f64; 4] {
    let (s01, s02, s12) = (d[0][1] + d[1][0], d[0][2] + d[2][0], d[1][2] + d[2][1]);
    let (a21, a02, a10) = (d[2][1] - d[1][2], d[0][2] - d[2][0], d[1][0] - d[0][1]);
    [
        2.0 * (y * s01 + z * s02 - 2.0 * x * (d[1][1] + d[2][2]) + w * a21),
        2.0 * (x * s01 + z * s12 - 2.0 * y * (d[0][0] + d[2][2]) + w * a02),
        2.0 * (x * s02 + y * s12 - 2.0 * z * (d[0][0] + d[1][1]) + w * a10),
        2.0 * (x * a21 + y * a02 + z * a10),
    ]
}

/// One Gaussian's splat, `None` where it is culled.
fn project_one(g: &Gaussians, i: usize, view: &View, config: &RasterConfig) -> Option<Splat> {
    let opacity = g.opacities[i];
    if opacity < config.min_alpha || opacity <= 0.0 {
        return None;
    }
    let m = g.means[i].to_array().map(f64::from);
    let z = view.w[2][0] * m[0] + view.w[2][1] * m[1] + view.w[2][2] * m[2] + view.t[2];
    if !(z > config.near as f64 && z < MAX_DEPTH) {
        return None;
    }
    let lin = Linearised::new(g.means[i], g.scales[i], g.rotations[i], view);
    let [r0, r1] = lin.a;
    let xx: f64 = r0.iter().map(|v| v * v).sum();
    let yy: f64 = r1.iter().map(|v| v * v).sum();
    let xy: f64 = (0..3).map(|j| r0[j] * r1[j]).sum();
    let minor = |j: usize, k: usize| r0[j] * r1[k] - r0[k] * r1[j];
    let low = config.low_pass as f64;
    let det = minor(0, 1).powi(2) + minor(0, 2).powi(2) + minor(1, 2).powi(2) + low * (xx + yy + low);
    let cov = [xx + low, xy, yy + low];
    let mean = [view.f[0] * lin.p[0] / z + view.c[0], view.f[1] * lin.p[1] / z + view.c[1]];
    let chol = [(cov[2] / det).sqrt(), -cov[1] / (cov[2] * det).sqrt(), 1.0 / cov[2].sqrt()];
    let tau = (opacity as f64 / config.min_alpha as f64).ln().max(0.0);
    let two_tau = 2.0 * tau * (1.0 + EXTENT_SLACK) + EXTENT_SLACK;
    let splat = Splat { gaussian: i as u32, depth: z as f32, opacity, mean, cov, chol, two_tau };
    let finite = within(&mean, MAX_MEAN) && within(&cov, MAX_COVARIANCE) && within(&chol, MAX_MEAN) && det.is_finite();
    let [ex, ey] = splat.extent();
    let (x0, x1) = Splat::pixel_range(mean[0], ex, view.size[0]);
    let (y0, y1) = Splat::pixel_range(mean[1], ey, view.size[1]);
    (finite && x0 < x1 && y0 < y1).then_some(splat)
}

/// Screen means beyond this (px) and covariances beyond this (px²) are culled: their f32 copies would overflow when
/// squared.
const MAX_MEAN: f64 = 1e15;
const MAX_COVARIANCE: f64 = 1e30;

/// Gaussians at this view-space z or farther (scene units) are culled: products with their depth would overflow.
const MAX_DEPTH: f64 = 1e18;

/// Whether all values are numbers of at most that magnitude.
fn within(values: &[f64], largest: f64) -> bool {
    values.iter().all(|v| v.abs() <= largest)
}

/// Cotangent of one footprint.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct FootprintGrad {
    /// d loss / d mean, per px.
    pub mean: [f64; 2],
    /// d loss / d covariance as the symmetric matrix xx, xy, yy (the xy entry counts twice in an inner product).
    pub cov: [f64; 3],
    /// d loss / d view-space z through depth alone.
    pub depth: f64,
}

/// Gradient of the four parameters of one Gaussian, in f64.
pub(crate) struct GaussianGrad {
    pub mean: Vec3,
    pub scale: Vec3,
    pub rotation: Vec4,
}

/// Pullback of the projection of Gaussian `i` (all but the opacity, which does not move a footprint).
pub(crate) fn project_pull(g: &Gaussians, i: usize, view: &View, d: &FootprintGrad) -> GaussianGrad {
    let lin = Linearised::new(g.means[i], g.scales[i], g.rotations[i], view);
    let s = g.scales[i].to_array().map(f64::from);
    let inv_z = 1.0 / lin.p[2];
    let k = [view.f[0] * inv_z, view.f[1] * inv_z];
    let mut d_p = [0.0, 0.0, d.depth];
    let mut d_v = [[0.0; 3]; 3];
    let mut d_s = [0.0; 3];
    for axis in 0..2 {
        // d loss / d A = 2 · dΣ · A.
        let (same, cross) = (d.cov[2 * axis], d.cov[1]);
        let (mut d_tangent, mut d_k) = (0.0, 0.0);
        for j in 0..3 {
            let d_a = 2.0 * (same * lin.a[axis][j] + cross * lin.a[1 - axis][j]);
            let ray = lin.v[axis][j] - lin.tangent[axis] * lin.v[2][j];
            d_v[axis][j] += d_a * k[axis] * s[j];
            d_v[2][j] -= d_a * k[axis] * lin.tangent[axis] * s[j];
            d_s[j] += d_a * k[axis] * ray;
            d_tangent -= d_a * k[axis] * lin.v[2][j] * s[j];
            d_k += d_a * ray * s[j];
        }
        d_p[2] -= d_k * k[axis] * inv_z;
        let mut d_ratio = d.mean[axis] * view.f[axis];
        if lin.free[axis] {
            d_ratio += d_tangent;
        }
        d_p[axis] += d_ratio * inv_z;
        d_p[2] -= d_ratio * lin.p[axis] * inv_z * inv_z;
    }
    let back = |d: [f64; 3]| -> [f64; 3] { std::array::from_fn(|c| (0..3).map(|r| view.w[r][c] * d[r]).sum()) };
    let d_mean = back(d_p);
    let mut d_rotation = [[0.0; 3]; 3];
    for j in 0..3 {
        let column = back([d_v[0][j], d_v[1][j], d_v[2][j]]);
        (0..3).for_each(|r| d_rotation[r][j] = column[r]);
    }
    let d_unit = rotation_matrix_pull(lin.q, d_rotation);
    let along: f64 = (0..4).map(|c| d_unit[c] * lin.q[c]).sum();
    let d_q: [f64; 4] = std::array::from_fn(|c| (d_unit[c] - along * lin.q[c]) * lin.inv_norm);
    GaussianGrad {
        mean: Vec3::from_array(d_mean.map(finite_f32)),
        scale: Vec3::from_array(d_s.map(finite_f32)),
        rotation: Vec4::from_array(d_q.map(finite_f32)),
    }
}

/// To f32 without overflow to infinity: a finite cotangent must give a finite gradient.
pub(crate) fn finite_f32(v: f64) -> f32 {
    (v as f32).clamp(f32::MIN, f32::MAX)
}

/// Whether `config` asks for the C¹ stand-in.
pub(crate) fn is_smooth(config: &RasterConfig) -> bool {
    config.cutoff == Cutoff::Smooth
}
