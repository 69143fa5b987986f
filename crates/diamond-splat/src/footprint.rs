//! The map from one Gaussian to its footprint on screen, in f64, and its pullback.
use crate::wide::{WIDTH, Wide};
use crate::{Gaussians, LowerFactor};
use diamond_camera::Camera;
use glam::{Vec3, Vec4};

/// How far beyond the image, as a fraction of the half field of view, the linearisation point may lie. Farther out the
/// tangent x/z is clamped, because the linear map there would smear a Gaussian over the whole image.
pub const JACOBIAN_MARGIN: f64 = 0.3;
/// Quaternions of smaller squared norm count as the identity, with zero gradient: their direction is rounding noise.
const MIN_QUATERNION_NORM2: f64 = 1e-24;
/// A camera in f64, with the limits of the linearisation point.
pub(crate) struct View {
    w: [[f64; 3]; 3],
    t: [f64; 3],
    /// Focal lengths and principal point, px.
    pub f: [f64; 2],
    pub c: [f64; 2],
    /// Lower and upper limit of x/z and y/z.
    limits: [[f64; 2]; 2],
    pub size: [u32; 2],
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

impl View {
    /// World points to camera coordinates.
    #[inline(always)]
    pub fn to_camera(&self, [x, y, z]: [Wide; 3]) -> [Wide; 3] {
        let mut p = [x; 3];
        for r in 0..3 {
            p[r] = x * self.w[r][0] + y * self.w[r][1] + z * self.w[r][2] + Wide::of(self.t[r]);
        }
        p
    }

    /// World axes of vectors in camera axes.
    #[inline(always)]
    fn to_world_axes(&self, d: [Wide; 3]) -> [Wide; 3] {
        let mut out = d;
        for c in 0..3 {
            out[c] = d[0] * self.w[0][c] + d[1] * self.w[1][c] + d[2] * self.w[2][c];
        }
        out
    }
}

/// Indices of Gaussians that are worked on together.
pub(crate) type Four = [usize; WIDTH];

/// A component of these Gaussians.
#[inline(always)]
fn gather<T, const N: usize>(of: &[T], four: Four, numbers: impl Fn(&T) -> [f32; N]) -> [Wide; N] {
    let mut out = [Wide::ZERO; N];
    for k in 0..WIDTH {
        let numbers = numbers(&of[four[k]]);
        for c in 0..N {
            out[c].0[k] = numbers[c] as f64;
        }
    }
    out
}

/// The means of these Gaussians.
#[inline(always)]
pub(crate) fn means(g: &Gaussians, four: Four) -> [Wide; 3] {
    gather(&g.means, four, Vec3::to_array)
}

/// The intermediate values of four projections that their pullback needs as well.
pub(crate) struct Linearised {
    /// Mean in camera coordinates.
    pub p: [Wide; 3],
    /// 1/z.
    pub inv_z: Wide,
    /// Clamped x/z, y/z of the linearisation point, and 1 where the clamp was inactive, else 0.
    tangent: [Wide; 2],
    free: [Wide; 2],
    /// Unit quaternion x, y, z, w and 1/norm (0 where it counts as the identity).
    q: [Wide; 4],
    inv_norm: Wide,
    /// Rotation of the Gaussian in camera axes; its lower factor in camera axes where it has one.
    v: [[Wide; 3]; 3],
    /// Standard deviations; ones where it has a lower factor.
    s: [Wide; 3],
    /// A = J · W · R_q · diag(s), or J · W · L, 2 × 3.
    pub a: [[Wide; 3]; 2],
}

impl Linearised {
    /// Of these Gaussians.
    #[inline(always)]
    pub fn of(g: &Gaussians, four: Four, view: &View) -> Self {
        let p = view.to_camera(means(g, four));
        let inv_z = p[2].recip();
        let raw = [p[0] * inv_z, p[1] * inv_z];
        let [x, y] = view.limits;
        let tangent = [raw[0].clamp(x[0], x[1]), raw[1].clamp(y[0], y[1])];
        let free = [tangent[0].equals(raw[0]), tangent[1].equals(raw[1])];
        let (q, inv_norm) = unit_quaternion(gather(&g.rotations, four, |q| q.to_array()));
        let (root, s) = if g.factors.is_empty() {
            (rotation_matrix(q), gather(&g.scales, four, Vec3::to_array))
        } else {
            let [xx, yx, yy, zx, zy, zz] = gather(&g.factors, four, |factor| factor.0);
            let zero = Wide::ZERO;
            ([[xx, zero, zero], [yx, yy, zero], [zx, zy, zz]], [Wide::of(1.0); 3])
        };
        let mut v = root;
        for r in 0..3 {
            for c in 0..3 {
                v[r][c] = root[0][c] * view.w[r][0] + root[1][c] * view.w[r][1] + root[2][c] * view.w[r][2];
            }
        }
        let mut a = [[Wide::ZERO; 3]; 2];
        for axis in 0..2 {
            let k = inv_z * view.f[axis];
            for j in 0..3 {
                a[axis][j] = k * (v[axis][j] - tangent[axis] * v[2][j]) * s[j];
            }
        }
        Self { p, inv_z, tangent, free, q, inv_norm, v, s, a }
    }
}

/// Normalised x, y, z, w and 1/norm; the identity and 0 where it is too short.
#[inline(always)]
fn unit_quaternion([x, y, z, w]: [Wide; 4]) -> ([Wide; 4], Wide) {
    let norm2 = x * x + y * y + z * z + w * w;
    let inv = norm2.sqrt().recip();
    let or = |value: Wide, otherwise: f64| norm2.choose(MIN_QUATERNION_NORM2, value, Wide::of(otherwise));
    ([or(x * inv, 0.0), or(y * inv, 0.0), or(z * inv, 0.0), or(w * inv, 1.0)], or(inv, 0.0))
}

#[inline(always)]
fn rotation_matrix([x, y, z, w]: [Wide; 4]) -> [[Wide; 3]; 3] {
    let one = Wide::of(1.0);
    [
        [one - (y * y + z * z) * 2.0, (x * y - w * z) * 2.0, (x * z + w * y) * 2.0],
        [(x * y + w * z) * 2.0, one - (x * x + z * z) * 2.0, (y * z - w * x) * 2.0],
        [(x * z - w * y) * 2.0, (y * z + w * x) * 2.0, one - (x * x + y * y) * 2.0],
    ]
}

/// Pullback of [`rotation_matrix`] for the four numbers as if they were independent.
#[inline(always)]
fn rotation_matrix_pull([x, y, z, w]: [Wide; 4], d: [[Wide; 3]; 3]) -> [Wide; 4] {
    let (s01, s02, s12) = (d[0][1] + d[1][0], d[0][2] + d[2][0], d[1][2] + d[2][1]);
    let (a21, a02, a10) = (d[2][1] - d[1][2], d[0][2] - d[2][0], d[1][0] - d[0][1]);
    [
        (y * s01 + z * s02 - x * (d[1][1] + d[2][2]) * 2.0 + w * a21) * 2.0,
        (x * s01 + z * s12 - y * (d[0][0] + d[2][2]) * 2.0 + w * a02) * 2.0,
        (x * s02 + y * s12 - z * (d[0][0] + d[1][1]) * 2.0 + w * a10) * 2.0,
        (x * a21 + y * a02 + z * a10) * 2.0,
    ]
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

/// Gradient of the parameters of one Gaussian.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct GaussianGrad {
    pub mean: Vec3,
    pub scale: Vec3,
    pub rotation: Vec4,
    /// Zero for Gaussians without a factor; those with one have zero scale and rotation gradients.
    pub factor: LowerFactor,
}

/// Pullback of the projection of these Gaussians (all but the opacity, which does not move a footprint).
#[inline(always)]
pub(crate) fn project_pull(
    g: &Gaussians,
    four: Four,
    view: &View,
    d: &[FootprintGrad; WIDTH],
) -> [GaussianGrad; WIDTH] {
    let lin = Linearised::of(g, four, view);
    let s = lin.s;
    let inv_z = lin.inv_z;
    let k = [inv_z * view.f[0], inv_z * view.f[1]];
    let (mut d_mean2, mut d_cov, mut d_depth) = ([Wide::ZERO; 2], [Wide::ZERO; 3], Wide::ZERO);
    for lane in 0..WIDTH {
        (0..2).for_each(|c| d_mean2[c].0[lane] = d[lane].mean[c]);
        (0..3).for_each(|c| d_cov[c].0[lane] = d[lane].cov[c]);
        d_depth.0[lane] = d[lane].depth;
    }
    let mut d_p = [Wide::ZERO, Wide::ZERO, d_depth];
    let mut d_v = [[Wide::ZERO; 3]; 3];
    let mut d_s = [Wide::ZERO; 3];
    for axis in 0..2 {
        // d loss / d A = 2 · dΣ · A.
        let (same, cross) = (d_cov[2 * axis], d_cov[1]);
        let (mut d_tangent, mut d_k) = (Wide::ZERO, Wide::ZERO);
        for j in 0..3 {
            let d_a = (same * lin.a[axis][j] + cross * lin.a[1 - axis][j]) * 2.0;
            let ray = lin.v[axis][j] - lin.tangent[axis] * lin.v[2][j];
            let scaled = d_a * k[axis];
            d_v[axis][j] += scaled * s[j];
            d_v[2][j] -= scaled * lin.tangent[axis] * s[j];
            d_s[j] += scaled * ray;
            d_tangent -= scaled * lin.v[2][j] * s[j];
            d_k += d_a * ray * s[j];
        }
        d_p[2] -= d_k * k[axis] * inv_z;
        let d_ratio = d_mean2[axis] * view.f[axis] + lin.free[axis] * d_tangent;
        d_p[axis] += d_ratio * inv_z;
        d_p[2] -= d_ratio * lin.p[axis] * inv_z * inv_z;
    }
    let d_mean = view.to_world_axes(d_p);
    let mut d_root = [[Wide::ZERO; 3]; 3];
    for j in 0..3 {
        let column = view.to_world_axes([d_v[0][j], d_v[1][j], d_v[2][j]]);
        for r in 0..3 {
            d_root[r][j] = column[r];
        }
    }
    let mut out = [GaussianGrad::default(); WIDTH];
    for lane in 0..WIDTH {
        out[lane].mean = Vec3::from_array(Wide::lane(&d_mean, lane).map(finite_f32));
    }
    if !g.factors.is_empty() {
        for lane in 0..WIDTH {
            out[lane].factor = LowerFactor::matrix_pull(d_root.map(|row| Wide::lane(&row, lane)));
        }
        return out;
    }
    let d_unit = rotation_matrix_pull(lin.q, d_root);
    let q = lin.q;
    let along = d_unit[0] * q[0] + d_unit[1] * q[1] + d_unit[2] * q[2] + d_unit[3] * q[3];
    let mut d_q = d_unit;
    for c in 0..4 {
        d_q[c] = (d_unit[c] - along * q[c]) * lin.inv_norm;
    }
    for lane in 0..WIDTH {
        out[lane].scale = Vec3::from_array(Wide::lane(&d_s, lane).map(finite_f32));
        out[lane].rotation = Vec4::from_array(Wide::lane(&d_q, lane).map(finite_f32));
    }
    out
}

/// To f32 without overflow to infinity: a finite cotangent must give a finite gradient.
#[inline(always)]
pub(crate) fn finite_f32(v: f64) -> f32 {
    (v as f32).clamp(f32::MIN, f32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_camera::{Intrinsics, Pose};
    use diamond_testkit::splat::{SplatCamera, SplatRules, project_covariance, project_splat};
    use diamond_testkit::{Dual, Real, adjoint::relative_l2, vjp};
    use glam::Quat;
    use proptest::prelude::*;

    fn unit() -> impl Strategy<Value = f32> {
        -1.0f32..1.0
    }

    /// A camera, the oracle's picture of it, and the rules.
    fn setting() -> (Camera, SplatCamera, SplatRules) {
        let intrinsics = Intrinsics { fx: 31.0, fy: 27.0, cx: 11.0, cy: 20.0, width: 33, height: 29 };
        let pose = Pose::look_at(Vec3::new(0.4, -0.3, -2.0), Vec3::new(0.1, 0.0, 0.0), Vec3::Y);
        let r = pose.rotation.to_cols_array_2d();
        let oracle = SplatCamera {
            rotation: std::array::from_fn(|row| std::array::from_fn(|col| r[col][row] as f64)),
            translation: pose.translation.to_array().map(f64::from),
            focal: [31.0, 27.0],
            centre: [11.0, 20.0],
            size: [33, 29],
        };
        let rules = SplatRules {
            low_pass: 0.3,
            max_alpha: 0.99,
            min_alpha: 1.0 / 255.0,
            min_transmittance: 1e-4,
            near: 0.2,
            smooth: false,
        };
        (Camera { intrinsics, pose }, oracle, rules)
    }

    /// Mean, covariance and z from the oracle's mean, conic and z.
    fn of_conic(m: [Dual; 2], c: [Dual; 3], z: Dual) -> Vec<Dual> {
        let det = c[0] * c[2] - c[1] * c[1];
        vec![m[0], m[1], c[2] / det, -c[1] / det, c[0] / det, z]
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]

        /// [eq:ewa-projection]: mean, covariance and z of one Gaussian; the pullback against dual numbers, inside and
        /// outside the limits of the linearisation point.
        #[test]
        fn the_pullback_agrees_with_dual_numbers(
            mean in [unit(), unit(), unit()],
            scale in [0.001f32..0.5, 0.001f32..0.5, 0.001f32..0.5],
            q in [unit(), unit(), unit(), unit()],
            d in [unit(), unit(), unit(), unit(), unit(), unit()],
        ) {
            prop_assume!(q.iter().map(|v| v * v).sum::<f32>() > 0.01);
            let (camera, oracle, rules) = setting();
            let f = |x: &[Dual]| {
                let mut g = x.to_vec();
                g.push(Dual::of(0.5));
                let (m, c, z) = project_splat(&g, &oracle, &rules).expect("in front of the camera");
                of_conic(m, c, z)
            };
            let x: Vec<f64> = mean.iter().chain(&scale).chain(&q).map(|&v| v as f64).collect();
            let d = d.map(f64::from);
            // The symmetric matrix counts its off-diagonal entry twice.
            let expected = vjp(f, &x, &[d[0], d[1], d[2], 2.0 * d[3], d[4], d[5]]);
            let mut g = Gaussians::default();
            g.push(Vec3::from_array(mean), Vec3::from_array(scale), Quat::from_array(q), 0.5);
            let footprint = FootprintGrad { mean: [d[0], d[1]], cov: [d[2], d[3], d[4]], depth: d[5] };
            let found = project_pull(&g, [0; WIDTH], &View::new(&camera), &[footprint; WIDTH])[2];
            let found: Vec<f64> = (found.mean.to_array().into_iter())
                .chain(found.scale.to_array())
                .chain(found.rotation.to_array())
                .map(f64::from)
                .collect();
            for (range, what) in [(0..3, "mean"), (3..6, "scale"), (6..10, "rotation")] {
                let error = relative_l2(&found[range.clone()], &expected[range], 1e-6);
                prop_assert!(error < 1e-5, "{}: {:.2e}", what, error);
            }
        }

        /// [eq:lower-factor]: the same for Gaussians that are given by a lower factor, against the projection of Σ = L Lᵀ
        /// by dual numbers.
        #[test]
        fn the_pullback_of_a_factor_agrees_with_dual_numbers(
            mean in [unit(), unit(), unit()],
            l in [0.01f32..0.5, -0.5f32..0.5, 0.01f32..0.5, -0.5f32..0.5, -0.5f32..0.5, 0.01f32..0.5],
            d in [unit(), unit(), unit(), unit(), unit(), unit()],
        ) {
            let (camera, oracle, rules) = setting();
            let f = |x: &[Dual]| {
                let zero = Dual::of(0.0);
                let root = [[x[3], zero, zero], [x[4], x[5], zero], [x[6], x[7], x[8]]];
                let sum = |f: &dyn Fn(usize) -> Dual| f(0) + f(1) + f(2);
                let sigma = std::array::from_fn(|r| std::array::from_fn(|c| sum(&|k| root[r][k] * root[c][k])));
                let (m, c, z) =
                    project_covariance(&x[..3], &sigma, &oracle, &rules).expect("in front of the camera");
                of_conic(m, c, z)
            };
            let x: Vec<f64> = mean.iter().chain(&l).map(|&v| v as f64).collect();
            let d = d.map(f64::from);
            let expected = vjp(f, &x, &[d[0], d[1], d[2], 2.0 * d[3], d[4], d[5]]);
            let mut g = Gaussians::default();
            g.push(Vec3::from_array(mean), Vec3::ONE, Quat::IDENTITY, 0.5);
            g.factors.push(LowerFactor(l));
            let footprint = FootprintGrad { mean: [d[0], d[1]], cov: [d[2], d[3], d[4]], depth: d[5] };
            let found = project_pull(&g, [0; WIDTH], &View::new(&camera), &[footprint; WIDTH])[2];
            prop_assert_eq!((found.scale, found.rotation), (Vec3::ZERO, Vec4::ZERO));
            let found: Vec<f64> = found.mean.to_array().into_iter().chain(found.factor.0).map(f64::from).collect();
            for (range, what) in [(0..3, "mean"), (3..9, "factor")] {
                let error = relative_l2(&found[range.clone()], &expected[range], 1e-6);
                prop_assert!(error < 1e-5, "{}: {:.2e}", what, error);
            }
        }
    }
}
