//! Sixteen pixels at once: the vector primitives of the blend kernels on any instruction set.
//!
//! A block of 4 × 4 pixels is `[S::f32s; N]` with N = 1 (AVX-512), 2 (AVX2), 4 (128-bit) or 16 (scalar). What is
//! computed per pixel is the same expression at any width and sums over pixels are in order of pixels, so all instruction
//! sets with fused multiply-add give the same bits.
//!
//! No vector operation may sit in a closure: a closure that is handed to a function of the standard library (such as
//! `std::array::from_fn`) is compiled without the instruction set, and every operation in it becomes a call.
use crate::ellipse::{BLOCK, LANES, Prepared};
use diamond_simd::{Block, Simd, exp2_of_all, load_block};

/// [`Thresholds`] in every lane.
#[derive(Clone, Copy)]
pub(crate) struct Limits<S: Simd> {
    /// 0, hidden from the compiler: it would turn a choice between a value and a known zero, which is one instruction,
    /// into two.
    pub zero: S::f32s,
    pub min_alpha: S::f32s,
    inv_min_alpha: S::f32s,
    pub max_alpha: S::f32s,
    pub min_transmittance: S::f32s,
}

impl<S: Simd> Limits<S> {
    #[inline(always)]
    pub fn new(s: S, t: &Thresholds) -> Self {
        Self {
            zero: s.splat_f32s(std::hint::black_box(0.0)),
            min_alpha: s.splat_f32s(t.min_alpha),
            inv_min_alpha: s.splat_f32s(1.0 / t.min_alpha),
            max_alpha: s.splat_f32s(t.max_alpha),
            min_transmittance: s.splat_f32s(t.min_transmittance),
        }
    }
}

/// The thresholds of the compositing rule.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Thresholds {
    pub min_alpha: f32,
    pub max_alpha: f32,
    /// Negative: pixels never stop.
    pub min_transmittance: f32,
}

/// Offsets of the pixel centres of a block from its centre, px.
#[derive(Clone, Copy)]
pub(crate) struct Offsets<S: Simd, const N: usize> {
    pub x: Block<S, N>,
    pub y: Block<S, N>,
}

/// x of every lane from the block's centre, then y.
pub(crate) const OFFSETS: [[f32; LANES]; 2] = {
    let mut offsets = [[0.0; LANES]; 2];
    let mut lane = 0;
    while lane < LANES {
        offsets[0][lane] = (lane % BLOCK) as f32 + 0.5 - 0.5 * BLOCK as f32;
        offsets[1][lane] = (lane / BLOCK) as f32 + 0.5 - 0.5 * BLOCK as f32;
        lane += 1;
    }
    offsets
};

impl<S: Simd, const N: usize> Offsets<S, N> {
    #[inline(always)]
    pub fn new() -> Self {
        Self { x: load_block::<S, N>(&OFFSETS[0]), y: load_block::<S, N>(&OFFSETS[1]) }
    }
}

/// Alphas of some splats on a block `[eq:splat-alpha]`, and `−dα/dσ`, which is also `opacity · dα/d opacity`.
///
/// Hard: `a = o·e^−σ`, `α = min(a, max_alpha)` where `a ≥ min_alpha`, else 0. Smooth: times the smoothstep of
/// `(a − min_alpha)/min_alpha`, which is 0 at the threshold and 1 from twice the threshold on.
#[inline(always)]
pub(crate) fn alphas<S: Simd, const N: usize, const M: usize, const SMOOTH: bool>(
    s: S,
    splats: &[Prepared; M],
    at: &Offsets<S, N>,
    limits: &Limits<S>,
) -> ([Block<S, N>; M], [Block<S, N>; M]) {
    let mut exponents = [at.x; M];
    for m in 0..M {
        let p = &splats[m];
        let (u0, v0, u_x) = (s.splat_f32s(p.u), s.splat_f32s(p.v), s.splat_f32s(p.u_x));
        let (u_y, v_y, log2_opacity) = (s.splat_f32s(p.u_y), s.splat_f32s(p.v_y), s.splat_f32s(p.log2_opacity));
        // Whole rows of a block in a vector: all vectors have the same x.
        let shared = s.mul_add_e_f32s(u_x, at.x[0], u0);
        for i in 0..N {
            let along_x = if S::F32_LANES.is_multiple_of(BLOCK) { shared } else { s.mul_add_e_f32s(u_x, at.x[i], u0) };
            let u = s.mul_add_e_f32s(u_y, at.y[i], along_x);
            let v = s.mul_add_e_f32s(v_y, at.y[i], v0);
            exponents[m][i] = s.negate_mul_add_e_f32s(u, u, s.negate_mul_add_e_f32s(v, v, log2_opacity));
        }
    }
    let mut alphas = exp2_of_all(s, exponents);
    let mut chains = alphas;
    let (zero, min, max) = (limits.zero, limits.min_alpha, limits.max_alpha);
    for m in 0..M {
        for i in 0..N {
            let a = alphas[m][i];
            let keep = s.greater_than_or_equal_f32s(a, min);
            let clamped = s.min_f32s(a, max);
            let free = s.less_than_or_equal_f32s(a, max);
            if SMOOTH {
                let one = s.splat_f32s(1.0);
                let t = s.mul_f32s(s.sub_f32s(a, min), limits.inv_min_alpha);
                let t = s.min_f32s(s.max_f32s(t, zero), one);
                let step = s.mul_f32s(s.mul_f32s(t, t), s.sub_f32s(s.splat_f32s(3.0), s.add_f32s(t, t)));
                let slope =
                    s.mul_f32s(s.mul_f32s(s.splat_f32s(6.0), limits.inv_min_alpha), s.mul_f32s(t, s.sub_f32s(one, t)));
                alphas[m][i] = s.mul_f32s(clamped, step);
                let chain = s.mul_f32s(a, s.mul_add_e_f32s(a, slope, step));
                chains[m][i] = s.select_f32s(free, chain, zero);
            } else {
                alphas[m][i] = s.select_f32s(keep, clamped, zero);
                chains[m][i] = s.select_f32s(free, alphas[m][i], zero);
            }
        }
    }
    (alphas, chains)
}

/// One step of front-to-back compositing `[eq:splat-blend]`: the weight `α·T`, and the transmittance after it; both 0
/// once a pixel has stopped, which it does before the splat that would bring T to `min_transmittance` or below.
#[inline(always)]
pub(crate) fn composite<S: Simd, const N: usize>(
    s: S,
    alpha: &Block<S, N>,
    t: &mut Block<S, N>,
    limits: &Limits<S>,
) -> Block<S, N> {
    let mut weights = *alpha;
    for i in 0..N {
        let next = s.negate_mul_add_e_f32s(t[i], alpha[i], t[i]);
        let weight = s.mul_f32s(t[i], alpha[i]);
        let go = s.greater_than_f32s(next, limits.min_transmittance);
        t[i] = s.select_f32s(go, next, limits.zero);
        weights[i] = s.select_f32s(go, weight, limits.zero);
    }
    weights
}
