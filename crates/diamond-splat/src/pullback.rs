//! Backward blending of one row of tiles: the reverse of [`crate::blend`].
//!
//! With `e_k = Σ_c f_kc·dC_c + z_k·dD + dO` and `B_k` what the light behind splat k is worth,
//! `B_{k−1} = α_k e_k + (1 − α_k) B_k`, the gradient of alpha is `T_k (e_k − B_k)` `[eq:splat-blend-pull]`: no division
//! by `1 − α`, so it stays exact where alpha is near 1.
//!
//! Per block the weights are recomputed front to back, then consumed back to front in groups of four splats. Sums over
//! the 16 pixels are matrix products with a row per pixel, so no horizontal additions are needed; the geometric
//! gradient is carried by the six moments `Σ g·(1, x, y, x², xy, y²)` about the block's centre, which are turned into
//! moments of the whitened offset `Lᵀd` in f64.
use crate::blend::{Scene, block_centre, block_offsets};
use crate::ellipse::{LANES, Prepared};
use crate::lanes::{alpha, any_positive, composite, load, store, with_lanes};
use crate::tiles::{TileLists, entry_slot};
use pulp::{Simd, WithSimd};

/// Splats that go through the matrix products together.
const GROUP: usize = 4;
/// Moments 1, x, y, x², xy, y², padded to the widest vector.
const MOMENTS: usize = 16;

/// Sums of one splat over the pixels of one row of tiles.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Moments {
    /// Σ g, with `g = d loss/d α · (−dα/dσ)`.
    pub one: f64,
    /// Σ g·(u, v), where `(u, v) = κ·Lᵀd`.
    pub first: [f64; 2],
    /// Σ g·(u², uv, v²).
    pub second: [f64; 3],
}

impl Moments {
    /// Adds another part.
    #[inline(always)]
    pub fn add(&mut self, o: &Moments) {
        self.one += o.one;
        for k in 0..2 {
            self.first[k] += o.first[k];
        }
        for k in 0..3 {
            self.second[k] += o.second[k];
        }
    }
}

/// Gives for each of four splats its moments about a block's centre, `1, x, y, x², xy, y²`, as moments of `(u, v)`, which
/// is affine in x and y. In f64, and about the block's centre rather than the tile's, because the terms cancel where the
/// splat is small and lies off that centre.
#[inline(always)]
fn whiten(to: &mut [Moments; GROUP], at: &[Prepared; GROUP], m: &[[f32; 8]; GROUP]) {
    for k in 0..GROUP {
        let (s, x, y) = (m[k][0] as f64, m[k][1] as f64, m[k][2] as f64);
        let (xx, xy, yy) = (m[k][3] as f64, m[k][4] as f64, m[k][5] as f64);
        let (u, v) = (at[k].u as f64, at[k].v as f64);
        let (a, b, c) = (at[k].u_x as f64, at[k].u_y as f64, at[k].v_y as f64);
        let lin = a * x + b * y;
        to[k].one = s;
        to[k].first = [u * s + lin, v * s + c * y];
        to[k].second = [
            u * (u * s + 2.0 * lin) + a * (a * xx + 2.0 * b * xy) + b * b * yy,
            u * (v * s + c * y) + v * lin + c * (a * xy + b * yy),
            v * (v * s + 2.0 * c * y) + c * c * yy,
        ];
    }
}

/// The backward pass of one row of tiles.
pub(crate) struct RowBackward<'a> {
    pub scene: &'a Scene<'a>,
    pub row: usize,
    pub lists: &'a TileLists,
    /// Cotangents of the row's pixels.
    pub d_features: &'a [f32],
    pub d_opacity: &'a [f32],
    pub d_depth: &'a [f32],
}

/// What one row adds to the gradient, by slot.
pub(crate) struct RowGrad {
    /// Slots × stride: features, then depth.
    pub features: Vec<f32>,
    pub moments: Vec<Moments>,
}

impl WithSimd for RowBackward<'_> {
    type Output = RowGrad;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> RowGrad {
        if self.scene.smooth {
            with_lanes!(s: S, backward_row_smooth(self))
        } else {
            with_lanes!(s: S, backward_row_hard(self))
        }
    }
}

#[inline(always)]
fn backward_row_hard<S: Simd, const N: usize>(s: S, row: RowBackward) -> RowGrad {
    backward_row::<S, N, false>(s, row)
}

#[inline(always)]
fn backward_row_smooth<S: Simd, const N: usize>(s: S, row: RowBackward) -> RowGrad {
    backward_row::<S, N, true>(s, row)
}

/// One splat on one block as the forward pass saw it.
#[derive(Clone, Copy)]
struct Pair {
    alpha: [f32; LANES],
    transmittance: [f32; LANES],
    chain: [f32; LANES],
}

const EMPTY: Pair = Pair { alpha: [0.0; LANES], transmittance: [0.0; LANES], chain: [0.0; LANES] };

#[inline(always)]
fn backward_row<S: Simd, const N: usize, const SMOOTH: bool>(s: S, row: RowBackward) -> RowGrad {
    let RowBackward { scene, row, lists, d_features, d_opacity, d_depth } = row;
    let (stride, channels) = (scene.stride, scene.channels);
    let slots = lists.splats.len();
    let mut grad = RowGrad { features: vec![0.0; slots * stride], moments: vec![Moments::default(); slots] };
    let offsets: [_; 4] = std::array::from_fn(block_offsets);
    let basis = moment_basis();
    let mut prepared: Vec<Prepared> = Vec::new();
    let mut pairs: Vec<Pair> = Vec::new();
    let mut sources: Vec<u32> = Vec::new();
    // Cotangents of a block: a row per channel, and a row per pixel.
    let mut by_channel = vec![[0.0f32; LANES]; channels + 1];
    let mut by_pixel = vec![0.0f32; LANES * stride];
    for tile in 0..lists.reach.len() {
        let reach = lists.reach[tile];
        let used = reach.iter().copied().max().unwrap_or(0) as usize;
        if used == 0 {
            continue;
        }
        let entries = &lists.entries[lists.start[tile] as usize..][..used];
        let centre = Scene::centre(tile);
        prepared.clear();
        for &entry in entries {
            prepared.push(lists.splats[entry_slot(entry)].prepare(centre));
        }
        for block in 0..4 {
            if reach[block] == 0 {
                continue;
            }
            let mut d_one = [0.0f32; LANES];
            for lane in 0..LANES {
                let line = &mut by_pixel[lane * stride..][..stride];
                match scene.pixel(tile, row, block, lane) {
                    Some(pixel) => {
                        line[..channels].copy_from_slice(&d_features[pixel * channels..][..channels]);
                        line[channels] = d_depth[pixel];
                        d_one[lane] = d_opacity[pixel];
                    }
                    None => line.fill(0.0),
                }
                (0..=channels).for_each(|c| by_channel[c][lane] = line[c]);
            }
            // Front to back: the weights again.
            let (x, y) = (load::<S, N>(&offsets[block].0), load::<S, N>(&offsets[block].1));
            let mut t = load::<S, N>(&scene.initial_transmittance(tile, row, block));
            let mut n = 0;
            for (k, &entry) in entries[..reach[block] as usize].iter().enumerate() {
                if entry & 1 << block == 0 {
                    continue;
                }
                if pairs.len() <= n {
                    pairs.resize(n + 64, EMPTY);
                    sources.resize(n + 64, 0);
                }
                let before = t;
                let (a, chain) = alpha::<S, N, SMOOTH>(s, &prepared[k], &x, &y, &scene.limits);
                let w = composite::<S, N>(s, &a, &mut t, &scene.limits);
                // Lanes that have stopped carry α = T = 0 from here on, so that all their products vanish.
                let zero = s.splat_f32s(0.0);
                let (mut a, mut t_before) = (a, before);
                for i in 0..N {
                    let counts = s.greater_than_f32s(w[i], zero);
                    a[i] = s.select_f32s(counts, a[i], zero);
                    t_before[i] = s.select_f32s(counts, before[i], zero);
                }
                let pair = &mut pairs[n];
                store::<S, N>(&mut pair.alpha, a);
                store::<S, N>(&mut pair.transmittance, t_before);
                store::<S, N>(&mut pair.chain, chain);
                sources[n] = k as u32;
                n += any_positive::<S, N>(s, &w) as usize;
            }
            // Back to front.
            let d_one = load::<S, N>(&d_one);
            let mut behind = [s.splat_f32s(0.0); N];
            let mut end = n;
            while end > 0 {
                let begin = end.saturating_sub(GROUP);
                // In a short group the last splat stands in for the missing ones; their results are not used.
                let mut slots = [0usize; GROUP];
                let mut rows: [&[f32]; GROUP] = [&[]; GROUP];
                for m in 0..GROUP {
                    slots[m] = entry_slot(entries[sources[(begin + m).min(end - 1)] as usize]);
                    rows[m] = &lists.features[slots[m] * stride..][..channels + 1];
                }
                let mut e = [d_one; GROUP];
                for c in 0..=channels {
                    let d = load::<S, N>(&by_channel[c]);
                    for m in 0..GROUP {
                        let f = s.splat_f32s(rows[m][c]);
                        for i in 0..N {
                            e[m][i] = s.mul_add_e_f32s(f, d[i], e[m][i]);
                        }
                    }
                }
                let mut w = [[0.0f32; LANES]; GROUP];
                let mut g = [[0.0f32; LANES]; GROUP];
                for m in (0..end - begin).rev() {
                    let pair = &pairs[begin + m];
                    let a = load::<S, N>(&pair.alpha);
                    let t = load::<S, N>(&pair.transmittance);
                    let chain = load::<S, N>(&pair.chain);
                    let mut w_m = a;
                    let mut g_m = a;
                    for i in 0..N {
                        let gain = s.sub_f32s(e[m][i], behind[i]);
                        w_m[i] = s.mul_f32s(a[i], t[i]);
                        g_m[i] = s.mul_f32s(s.mul_f32s(t[i], gain), chain[i]);
                        behind[i] = s.mul_add_e_f32s(a[i], gain, behind[i]);
                    }
                    store::<S, N>(&mut w[m], w_m);
                    store::<S, N>(&mut g[m], g_m);
                }
                // Σ over pixels of g·basis and w·dC, a vector of columns at a time.
                let mut about_centre = [[0.0f32; MOMENTS]; GROUP];
                let mut c = 0;
                while c < 8 {
                    let sums = product::<S, 1>(s, &g, &basis.as_flattened()[c..], MOMENTS);
                    for m in 0..GROUP {
                        add::<S>(s, &mut about_centre[m][c..c + S::F32_LANES], sums[m][0]);
                    }
                    c += S::F32_LANES;
                }
                let mut at = [Prepared::default(); GROUP];
                let mut raw = [[0.0f32; 8]; GROUP];
                for m in 0..GROUP {
                    at[m] = prepared[sources[(begin + m).min(end - 1)] as usize].moved(block_centre(block));
                    raw[m].copy_from_slice(&about_centre[m][..8]);
                }
                let mut moments = [Moments::default(); GROUP];
                whiten(&mut moments, &at, &raw);
                for m in 0..end - begin {
                    grad.moments[slots[m]].add(&moments[m]);
                }
                let mut c = 0;
                while c < stride {
                    let two = c + 2 * S::F32_LANES <= stride;
                    let sums = if two {
                        product::<S, 2>(s, &w, &by_pixel[c..], stride)
                    } else {
                        let one = product::<S, 1>(s, &w, &by_pixel[c..], stride);
                        let mut sums = [[s.splat_f32s(0.0); 2]; GROUP];
                        for m in 0..GROUP {
                            sums[m][0] = one[m][0];
                        }
                        sums
                    };
                    for m in 0..end - begin {
                        let to = slots[m] * stride + c;
                        add::<S>(s, &mut grad.features[to..to + S::F32_LANES], sums[m][0]);
                        if two {
                            let to = to + S::F32_LANES;
                            add::<S>(s, &mut grad.features[to..to + S::F32_LANES], sums[m][1]);
                        }
                    }
                    c += if two { 2 } else { 1 } * S::F32_LANES;
                }
                end = begin;
            }
        }
    }
    grad
}

/// `(1, x, y, x², xy, y²)` of every pixel of a block, about the block's centre.
fn moment_basis() -> [[f32; MOMENTS]; LANES] {
    let (xs, ys) = block_offsets(0);
    let centre = block_centre(0);
    std::array::from_fn(|lane| {
        let (x, y) = (xs[lane] - centre.0, ys[lane] - centre.1);
        let mut basis = [0.0; MOMENTS];
        basis[..6].copy_from_slice(&[1.0, x, y, x * x, x * y, y * y]);
        basis
    })
}

#[inline(always)]
fn add<S: Simd>(s: S, to: &mut [f32], v: S::f32s) {
    let (to, _) = S::as_mut_simd_f32s(to);
    to[0] = s.add_f32s(to[0], v);
}

/// `Σ_lane left[m][lane] · right[lane · stride..]` for V vectors of columns.
#[inline(always)]
fn product<S: Simd, const V: usize>(
    s: S,
    left: &[[f32; LANES]; GROUP],
    right: &[f32],
    stride: usize,
) -> [[S::f32s; V]; GROUP] {
    let mut sums = [[s.splat_f32s(0.0); V]; GROUP];
    for lane in 0..LANES {
        let (r, _) = S::as_simd_f32s(&right[lane * stride..][..V * S::F32_LANES]);
        for m in 0..GROUP {
            let l = s.splat_f32s(left[m][lane]);
            for v in 0..V {
                sums[m][v] = s.mul_add_e_f32s(l, r[v], sums[m][v]);
            }
        }
    }
    sums
}
