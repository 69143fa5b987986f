//! Twins of the backward stages.
use super::{kappa, no_gradient, pixels, walk, whole};
use crate::HostState;
use crate::frame::{GaussianGrad, Splat};
use crate::shape::Column;

/// Rows of entries: Σ g·(1, u, v, u², uv, v²), Σ w·d depth, 0, Σ w·d features of the last piece of channels.
pub fn blend_pull(state: &mut HostState) {
    let shape = state.shape;
    let splats: Vec<Splat> = state.get_as(Column::Splats);
    let (ranges, pairs): (Vec<[u32; 2]>, Vec<[u32; 2]>) = (state.get_as(Column::Ranges), state.get_as(Column::Pairs));
    let (features, d_picture): (Vec<f32>, Vec<f32>) = (state.get_as(Column::Features), state.get_as(Column::DPicture));
    let d_coverage: Vec<[f32; 2]> = state.get_as(Column::DCoverage);
    let stride = shape.row_words() as usize;
    let mut rows = vec![0.0f64; shape.words(Column::Rows) as usize];
    let width = 4 * shape.quads;
    for (i, pixel, tile) in pixels(state) {
        let mut met = Vec::new();
        walk(state, &splats, &pairs, ranges[tile], pixel, |m| {
            met.push((m.place, m.gaussian, m.uv, m.alpha, m.free, m.transmittance));
        });
        let mut behind = 0.0f64;
        for &(place, gaussian, [u, v], alpha, free, t) in met.iter().rev() {
            let [d_opacity, d_depth] = d_coverage[i].map(f64::from);
            let mut e = d_opacity + d_depth * f64::from(splats[gaussian].rest[3]);
            for piece in 0..shape.pieces {
                let f = shape.first(Column::Features, piece) as usize + gaussian * width;
                let d = shape.first(Column::DPicture, piece) as usize + i * width;
                e += (0..width).map(|k| f64::from(features[f + k]) * f64::from(d_picture[d + k])).sum::<f64>();
            }
            let gain = e - behind;
            let g = if free { t * gain * alpha } else { 0.0 };
            let w = t * alpha;
            behind += alpha * gain;
            let row = &mut rows[pairs[place][1] as usize * stride..][..stride];
            for (to, basis) in row.iter_mut().zip([1.0, u, v, u * u, u * v, v * v]) {
                *to += g * basis;
            }
            row[6] += w * d_depth;
            let d = shape.first(Column::DPicture, shape.pieces - 1) as usize + i * width;
            for k in 0..width {
                row[8 + k] += w * f64::from(d_picture[d + k]);
            }
        }
    }
    state.set(Column::Rows, rows.iter().map(|v| *v as f32).collect::<Vec<f32>>());
}

/// Sums of rows per Gaussian; of the features the last piece of channels.
pub fn splat_sum(state: &mut HostState) {
    let shape = state.shape;
    let (order, offsets) = (state.get(Column::DepthOrder), state.get(Column::Offsets));
    let rows: Vec<f32> = state.get_as(Column::Rows);
    let (stride, width) = (shape.row_words() as usize, 4 * shape.quads);
    let mut moments: Vec<f32> = state.get_as(Column::Moments);
    let mut d_features: Vec<f32> = state.get_as(Column::DFeatures);
    let first = shape.first(Column::DFeatures, shape.pieces - 1) as usize;
    for rank in 0..state.scene.gaussians.len() {
        let mut sum = vec![0.0f64; stride];
        for entry in offsets[rank]..offsets[rank + 1] {
            let row = &rows[entry as usize * stride..][..stride];
            sum.iter_mut().zip(row).for_each(|(a, b)| *a += f64::from(*b));
        }
        let i = order[rank] as usize;
        for (k, sum) in sum.iter().enumerate() {
            if k < 8 {
                moments[8 * i + k] = *sum as f32;
            } else {
                d_features[first + i * width + k - 8] = *sum as f32;
            }
        }
    }
    state.set(Column::Moments, moments);
    state.set(Column::DFeatures, d_features);
}

type Matrix = [[f64; 3]; 3];

/// Gradients of Gaussians, in f64, by the chain of matrices as it stands in the books.
pub fn projection_pull(state: &mut HostState) {
    let splats: Vec<Splat> = state.get_as(Column::Splats);
    let moments: Vec<[f32; 8]> = state.get_as(Column::Moments);
    let n = state.scene.gaussians.len();
    let mut out = vec![no_gradient(); n.max(1)];
    for i in 0..n {
        if splats[i].rest[2] > 0.0 {
            out[i] = pull_one(state, i, &splats[i], moments[i].map(f64::from));
        }
    }
    state.set(Column::Gradient, out);
}

fn pull_one(state: &HostState, i: usize, splat: &Splat, m: [f64; 8]) -> GaussianGrad {
    let (scene, frame) = (&state.scene, &state.frame);
    let kappa = kappa();
    let l = [
        whole(splat.chol[0], splat.chol[1]) / kappa,
        whole(splat.chol[2], splat.chol[3]) / kappa,
        whole(splat.rest[0], splat.rest[1]) / kappa,
    ];
    let (u, v) = (m[1] / kappa, m[2] / kappa);
    let d_mean2 = [l[0] * u, l[1] * u + l[2] * v];
    // Half of L M Lᵀ.
    let [uu, uv, vv] = [m[3], m[4], m[5]].map(|m| 0.5 * m / (kappa * kappa));
    let d_cov = [
        [l[0] * l[0] * uu, l[0] * (l[1] * uu + l[2] * uv)],
        [l[0] * (l[1] * uu + l[2] * uv), l[1] * l[1] * uu + 2.0 * l[1] * l[2] * uv + l[2] * l[2] * vv],
    ];
    let w: Matrix = [frame.row_x, frame.row_y, frame.row_z].map(|r| [r[0], r[1], r[2]].map(f64::from));
    let t = [frame.row_x[3], frame.row_y[3], frame.row_z[3]].map(f64::from);
    let mean = scene.gaussians.means[i].to_array().map(f64::from);
    let p: [f64; 3] = std::array::from_fn(|r| (0..3).map(|c| w[r][c] * mean[c]).sum::<f64>() + t[r]);
    let (inv_z, focal) = (1.0 / p[2], frame.focal.map(f64::from));
    let raw = [p[0] * inv_z, p[1] * inv_z];
    let tangent: [f64; 2] =
        std::array::from_fn(|a| raw[a].max(f64::from(frame.tangent_low[a])).min(f64::from(frame.tangent_high[a])));
    // R diag(s) or L, and what it is made of.
    let (root, q, inv_norm, s) = match scene.gaussians.factors.get(i) {
        Some(factor) => {
            let [xx, yx, yy, zx, zy, zz] = factor.0.map(f64::from);
            ([[xx, 0.0, 0.0], [yx, yy, 0.0], [zx, zy, zz]], [0.0; 4], 0.0, [1.0; 3])
        }
        None => {
            let raw = scene.gaussians.rotations[i].to_array().map(f64::from);
            let norm2: f64 = raw.iter().map(|v| v * v).sum();
            let (q, inv) = if norm2 < 1e-24 {
                ([0.0, 0.0, 0.0, 1.0], 0.0)
            } else {
                (raw.map(|v| v / norm2.sqrt()), 1.0 / norm2.sqrt())
            };
            (rotation(q), q, inv, scene.gaussians.scales[i].to_array().map(f64::from))
        }
    };
    let v: Matrix = std::array::from_fn(|r| std::array::from_fn(|c| (0..3).map(|k| w[r][k] * root[k][c]).sum::<f64>()));
    let ray = |a: usize, j: usize| v[a][j] - tangent[a] * v[2][j];
    let k = [focal[0] * inv_z, focal[1] * inv_z];
    let a: [[f64; 3]; 2] = std::array::from_fn(|axis| std::array::from_fn(|j| k[axis] * ray(axis, j) * s[j]));
    let (mut d_p, mut d_v, mut d_s) = ([0.0, 0.0, m[6]], [[0.0f64; 3]; 3], [0.0f64; 3]);
    for axis in 0..2 {
        let (mut d_tangent, mut d_k) = (0.0, 0.0);
        for j in 0..3 {
            let d_a = 2.0 * (d_cov[axis][0] * a[0][j] + d_cov[axis][1] * a[1][j]);
            d_v[axis][j] += d_a * k[axis] * s[j];
            d_v[2][j] -= d_a * k[axis] * tangent[axis] * s[j];
            d_s[j] += d_a * k[axis] * ray(axis, j);
            d_tangent -= d_a * k[axis] * v[2][j] * s[j];
            d_k += d_a * ray(axis, j) * s[j];
        }
        d_p[2] -= d_k * k[axis] * inv_z;
        let free = if tangent[axis] == raw[axis] { 1.0 } else { 0.0 };
        let d_ratio = d_mean2[axis] * focal[axis] + free * d_tangent;
        d_p[axis] += d_ratio * inv_z;
        d_p[2] -= d_ratio * p[axis] * inv_z * inv_z;
    }
    let world = |d: [f64; 3]| -> [f64; 3] { std::array::from_fn(|c| (0..3).map(|r| w[r][c] * d[r]).sum::<f64>()) };
    let columns: Matrix = std::array::from_fn(|j| world([d_v[0][j], d_v[1][j], d_v[2][j]]));
    let [x, y, z] = world(d_p).map(|v| v as f32);
    let mut out = GaussianGrad {
        mean: [x, y, z, (m[0] / f64::from(splat.rest[2])) as f32],
        screen: [d_mean2[0] as f32, d_mean2[1] as f32, 0.0, 0.0],
        ..no_gradient()
    };
    let at = |row: usize, column: usize| columns[column][row] as f32;
    if scene.gaussians.factors.is_empty() {
        let d_q = rotation_pull(q, &columns);
        let along: f64 = d_q.iter().zip(&q).map(|(a, b)| a * b).sum();
        out.form_a = std::array::from_fn(|c| ((d_q[c] - along * q[c]) * inv_norm) as f32);
        out.form_b = [d_s[0] as f32, d_s[1] as f32, d_s[2] as f32, 0.0];
    } else {
        out.form_a = [at(0, 0), at(1, 0), at(1, 1), at(2, 0)];
        out.form_b = [at(2, 1), at(2, 2), 0.0, 0.0];
    }
    out
}

fn rotation([x, y, z, w]: [f64; 4]) -> Matrix {
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// `columns[c][r]` is the cotangent of the element in row r and column c.
fn rotation_pull([x, y, z, w]: [f64; 4], columns: &Matrix) -> [f64; 4] {
    let d = |r: usize, c: usize| columns[c][r];
    let (s01, s02, s12) = (d(0, 1) + d(1, 0), d(0, 2) + d(2, 0), d(1, 2) + d(2, 1));
    let (a21, a02, a10) = (d(2, 1) - d(1, 2), d(0, 2) - d(2, 0), d(1, 0) - d(0, 1));
    [
        2.0 * (y * s01 + z * s02 - 2.0 * x * (d(1, 1) + d(2, 2)) + w * a21),
        2.0 * (x * s01 + z * s12 - 2.0 * y * (d(0, 0) + d(2, 2)) + w * a02),
        2.0 * (x * s02 + y * s12 - 2.0 * z * (d(0, 0) + d(1, 1)) + w * a10),
        2.0 * (x * a21 + y * a02 + z * a10),
    ]
}
