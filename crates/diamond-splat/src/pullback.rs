//! Backward blending of one region: the reverse of [`crate::blend`].
//!
//! With `e_k = Σ_c f_kc·dC_c + z_k·dD + dO` and `B_k` what the light behind splat k is worth,
//! `B_{k−1} = α_k e_k + (1 − α_k) B_k`, the gradient of alpha is `T_k (e_k − B_k)` `[eq:splat-blend-pull]`: no division
//! by `1 − α`, so it stays exact where alpha is near 1.
//!
//! Per block the weights are recomputed front to back, then consumed back to front in groups of four splats. Sums over
//! the 16 pixels are matrix products with a row per pixel, so no horizontal additions are needed; the geometric
//! gradient is carried by the six moments `Σ g·(1, x, y, x², xy, y²)` about the block's centre, which are turned into
//! moments of the whitened offset `Lᵀd` before they are added up: there a long thin splat's do not cancel.
use crate::RasterGrad;
use crate::bins::{Reached, Scratch};
use crate::blend::{Scene, TOGETHER};
use crate::ellipse::{BLOCK, LANES, Prepared};
use crate::lanes::{Limits, OFFSETS, Offsets, alphas, composite};
use crate::recycle::FLOATS;
use diamond_simd::{Simd, WithSimd, load_block, store_block, with_lanes};
use glam::{Mat4, Vec4};

/// Splats that go through the matrix products together.
const GROUP: usize = 4;
/// Moments 1, x, y, x², xy, y², padded to the widest vector.
const MOMENTS: usize = 16;
/// Values of a slot's line before the features: `Σ g·(1, u, v, u², uv, v²)` with `g = d loss/d α · (−dα/dσ)` and
/// `(u, v) = κ·Lᵀd`, and two of padding.
pub(crate) const GEOMETRY: usize = 8;

/// Gives for each of four splats its moments about a block's centre, `1, x, y, x², xy, y²`, as moments of `(u, v)`, which
/// is affine in x and y. Four splats at a time: a vector per quantity.
#[inline(always)]
fn whiten(at: &[Prepared; GROUP], m: &[[f32; MOMENTS]; GROUP]) -> [[f32; GEOMETRY]; GROUP] {
    let four = |k: usize, first: usize| Vec4::from_slice(&m[k][first..first + 4]);
    let low = Mat4::from_cols(four(0, 0), four(1, 0), four(2, 0), four(3, 0)).transpose();
    let high = Mat4::from_cols(four(0, 4), four(1, 4), four(2, 4), four(3, 4)).transpose();
    let (s, x, y, xx, xy, yy) = (low.x_axis, low.y_axis, low.z_axis, low.w_axis, high.x_axis, high.y_axis);
    let affine = |p: &Prepared| Vec4::new(p.u, p.v, p.u_x, p.u_y);
    let affine = Mat4::from_cols(affine(&at[0]), affine(&at[1]), affine(&at[2]), affine(&at[3])).transpose();
    let (u, v, a, b) = (affine.x_axis, affine.y_axis, affine.z_axis, affine.w_axis);
    let c = Vec4::new(at[0].v_y, at[1].v_y, at[2].v_y, at[3].v_y);
    let along_u = a * x + b * y;
    let (of_u, of_v) = (u * s + along_u, v * s + c * y);
    let uu = u * (of_u + along_u) + a * (a * xx + 2.0 * b * xy) + b * b * yy;
    let uv = u * of_v + v * along_u + c * (a * xy + b * yy);
    let vv = v * (of_v + c * y) + c * c * yy;
    let low = Mat4::from_cols(s, of_u, of_v, uu).transpose().to_cols_array_2d();
    let high = Mat4::from_cols(uv, vv, Vec4::ZERO, Vec4::ZERO).transpose().to_cols_array_2d();
    let mut to = [[0.0; GEOMETRY]; GROUP];
    for k in 0..GROUP {
        to[k][..4].copy_from_slice(&low[k]);
        to[k][4..].copy_from_slice(&high[k]);
    }
    to
}

/// The backward pass of one region.
pub(crate) struct RegionBackward<'a> {
    pub scene: &'a Scene<'a>,
    pub region: usize,
    pub lists: &'a Reached,
    pub scratch: &'a mut Scratch,
    /// Cotangents of the whole image.
    pub d: &'a RasterGrad,
}

impl WithSimd for RegionBackward<'_> {
    /// Slots × ([`GEOMETRY`] + stride): sums of each splat over the pixels of the region.
    type Output = Vec<f32>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> Vec<f32> {
        if self.scene.smooth {
            with_lanes!(s: S, backward_smooth(self))
        } else {
            with_lanes!(s: S, backward_hard(self))
        }
    }
}

#[inline(always)]
fn backward_hard<S: Simd, const N: usize>(s: S, region: RegionBackward) -> Vec<f32> {
    backward::<S, N, false>(s, region)
}

#[inline(always)]
fn backward_smooth<S: Simd, const N: usize>(s: S, region: RegionBackward) -> Vec<f32> {
    backward::<S, N, true>(s, region)
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
fn backward<S: Simd, const N: usize, const SMOOTH: bool>(s: S, region: RegionBackward) -> Vec<f32> {
    let RegionBackward { scene, region, lists, scratch, d } = region;
    let (d_features, d_opacity, d_depth) = (d.features.data(), d.opacity.data(), d.depth.data());
    let (stride, channels) = (scene.stride, scene.channels);
    let line = GEOMETRY + stride;
    scratch.gather(scene.bins, region, scene.features, stride);
    let scratch = &*scratch;
    let mut grad = FLOATS.take();
    grad.resize(scratch.slots.len() * line, 0.0);
    let offsets = Offsets::<S, N>::new();
    // Hidden from the compiler, which would make constants of it and four long chains of additions.
    let basis = std::hint::black_box(moment_basis());
    let limits = Limits::new(s, &scene.limits);
    let zero = limits.zero;
    let mut prepared: Vec<Prepared> = Vec::new();
    let mut pairs: Vec<Pair> = Vec::new();
    // Cotangents of a block: a row per channel, and a row per pixel.
    let mut by_channel = vec![[0.0f32; LANES]; channels + 1];
    let mut by_pixel = vec![0.0f32; LANES * stride];
    for (block, entries) in lists.iter().enumerate() {
        let reach = entries.len();
        let Some(place) = scene.place(region, block).filter(|_| reach > 0) else {
            continue;
        };
        let (x, y) = place.centre();
        prepared.clear();
        for &slot in entries {
            prepared.push(scratch.prepare(slot, x, y));
        }
        let [width, height] = place.size;
        let mut d_one = [0.0f32; LANES];
        if place.size != [BLOCK; 2] {
            by_pixel.fill(0.0);
        }
        for y in 0..height {
            for x in 0..width {
                let (pixel, lane) = ((place.y + y) * scene.width + place.x + x, y * BLOCK + x);
                let to = &mut by_pixel[lane * stride..][..channels + 1];
                for (to, from) in to.iter_mut().zip(&d_features[pixel * channels..][..channels]) {
                    *to = *from;
                }
                to[channels] = d_depth[pixel];
                d_one[lane] = d_opacity[pixel];
            }
        }
        for lane in 0..LANES {
            for c in 0..=channels {
                by_channel[c][lane] = by_pixel[lane * stride + c];
            }
        }
        // Front to back: the weights again.
        let mut t = load_block::<S, N>(&place.initial_transmittance());
        let n = reach;
        prepared.resize(n.next_multiple_of(TOGETHER), Prepared::NOTHING);
        if pairs.len() < prepared.len() {
            pairs.resize(prepared.len(), EMPTY);
        }
        let groups = prepared.as_chunks::<TOGETHER>().0.iter().zip(pairs.as_chunks_mut::<TOGETHER>().0);
        for (splats, pairs) in groups {
            let (a, chains) = alphas::<S, N, TOGETHER, SMOOTH>(s, splats, &offsets, &limits);
            for m in 0..TOGETHER {
                let before = t;
                let w = composite::<S, N>(s, &a[m], &mut t, &limits);
                // Lanes that have stopped carry α = T = 0 from here on, so that all their products vanish.
                let (mut a, mut t_before) = (a[m], before);
                for i in 0..N {
                    let counts = s.greater_than_f32s(w[i], zero);
                    a[i] = s.select_f32s(counts, a[i], zero);
                    t_before[i] = s.select_f32s(counts, before[i], zero);
                }
                store_block::<S, N>(&mut pairs[m].alpha, a);
                store_block::<S, N>(&mut pairs[m].transmittance, t_before);
                store_block::<S, N>(&mut pairs[m].chain, chains[m]);
            }
        }
        // Back to front.
        let d_one = load_block::<S, N>(&d_one);
        let mut behind = [zero; N];
        let mut end = n;
        while end > 0 {
            let begin = end.saturating_sub(GROUP);
            // In a short group the last splat stands in for the missing ones, with weights of 0.
            let mut slots = [0usize; GROUP];
            let mut rows = [0usize; GROUP];
            let mut at = [Prepared::default(); GROUP];
            for m in 0..GROUP {
                let source = (begin + m).min(end - 1);
                slots[m] = entries[source] as usize;
                rows[m] = slots[m] * stride;
                at[m] = prepared[source];
            }
            let mut e = [d_one; GROUP];
            for c in 0..=channels {
                let d = load_block::<S, N>(&by_channel[c]);
                for m in 0..GROUP {
                    let f = s.splat_f32s(scratch.features[rows[m] + c]);
                    for i in 0..N {
                        e[m][i] = s.mul_add_e_f32s(f, d[i], e[m][i]);
                    }
                }
            }
            let mut w = [[0.0f32; LANES]; GROUP];
            let mut g = [[0.0f32; LANES]; GROUP];
            for m in (0..end - begin).rev() {
                let pair = &pairs[begin + m];
                let a = load_block::<S, N>(&pair.alpha);
                let t = load_block::<S, N>(&pair.transmittance);
                let chain = load_block::<S, N>(&pair.chain);
                let mut w_m = a;
                let mut g_m = a;
                for i in 0..N {
                    let gain = s.sub_f32s(e[m][i], behind[i]);
                    w_m[i] = s.mul_f32s(a[i], t[i]);
                    g_m[i] = s.mul_f32s(s.mul_f32s(t[i], gain), chain[i]);
                    behind[i] = s.mul_add_e_f32s(a[i], gain, behind[i]);
                }
                store_block::<S, N>(&mut w[m], w_m);
                store_block::<S, N>(&mut g[m], g_m);
            }
            // Σ over pixels of g·basis and w·dC, a vector of columns at a time.
            let mut about_centre = [[0.0f32; MOMENTS]; GROUP];
            let mut c = 0;
            // The stride is a multiple of both.
            while c < GEOMETRY.max(S::F32_LANES) {
                let right = [&basis.as_flattened()[c..], &by_pixel[c..]];
                let [sums, features] = products::<S>(s, [&g, &w], right, [MOMENTS, stride]);
                for m in 0..GROUP {
                    let (to, _) = S::as_mut_simd_f32s(&mut about_centre[m][c..c + S::F32_LANES]);
                    to[0] = sums[m];
                    let to = slots[m] * line + GEOMETRY + c;
                    add::<S>(s, &mut grad[to..to + S::F32_LANES], features[m]);
                }
                c += S::F32_LANES;
            }
            let moments = whiten(&at, &about_centre);
            for m in 0..GROUP {
                let to = &mut grad[slots[m] * line..][..GEOMETRY];
                for k in 0..GEOMETRY {
                    to[k] += moments[m][k];
                }
            }
            while c < stride {
                let two = c + 2 * S::F32_LANES <= stride;
                let sums = if two {
                    product::<S, 2>(s, &w, &by_pixel[c..], stride)
                } else {
                    let one = product::<S, 1>(s, &w, &by_pixel[c..], stride);
                    let mut sums = [[zero; 2]; GROUP];
                    for m in 0..GROUP {
                        sums[m][0] = one[m][0];
                    }
                    sums
                };
                for m in 0..GROUP {
                    let to = slots[m] * line + GEOMETRY + c;
                    add::<S>(s, &mut grad[to..to + S::F32_LANES], sums[m][0]);
                    if two {
                        let to = to + S::F32_LANES;
                        add::<S>(s, &mut grad[to..to + S::F32_LANES], sums[m][1]);
                    }
                }
                c += if two { 2 } else { 1 } * S::F32_LANES;
            }
            end = begin;
        }
    }
    grad
}

/// `(1, x, y, x², xy, y²)` of every pixel of a block, about the block's centre.
fn moment_basis() -> [[f32; MOMENTS]; LANES] {
    std::array::from_fn(|lane| {
        let (x, y) = (OFFSETS[0][lane], OFFSETS[1][lane]);
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

/// `Σ_lane left[m][lane] · right[lane · stride..]` for two pairs of factors at once and one vector of columns: so many
/// sums that none waits for itself.
#[inline(always)]
fn products<S: Simd>(
    s: S,
    left: [&[[f32; LANES]; GROUP]; 2],
    right: [&[f32]; 2],
    stride: [usize; 2],
) -> [[S::f32s; GROUP]; 2] {
    let mut sums = [[s.splat_f32s(0.0); GROUP]; 2];
    for lane in 0..LANES {
        for side in 0..2 {
            let (r, _) = S::as_simd_f32s(&right[side][lane * stride[side]..][..S::F32_LANES]);
            for m in 0..GROUP {
                sums[side][m] = s.mul_add_e_f32s(s.splat_f32s(left[side][m][lane]), r[0], sums[side][m]);
            }
        }
    }
    sums
}
