//! Sixteen pixels at once: the vector primitives of the blend kernels on any instruction set.
//!
//! A block of 4 × 4 pixels is `[S::f32s; N]` with N = 1 (AVX-512), 2 (AVX2), 4 (128-bit) or 16 (scalar). Fused
//! multiply-adds are used where the hardware has them, so last bits differ between instruction sets but never between
//! runs or numbers of threads on one machine.
//!
//! No vector operation may sit in a closure: a closure that is handed to a function of the standard library (such as
//! `std::array::from_fn`) is compiled without the instruction set, and every operation in it becomes a call.
use crate::ellipse::{BLOCK, LANES, Prepared};
use pulp::Simd;

/// A block's worth of values.
pub(crate) type Block<S, const N: usize> = [<S as Simd>::f32s; N];

/// Exponents at or below this give the smallest normal power of two instead of wrapping around.
const MIN_EXPONENT: f32 = -126.0;
/// Adding 1.5 · 2²³ rounds a float to an integer held in its low mantissa bits.
const ROUND_MAGIC: f32 = 12_582_912.0;
/// 2^f on [−½, ½], highest power first: minimax in relative error (Remez), 7.5e-8.
const EXP2: [f32; 6] = [0.001_327_647_2, 0.009_675_541, 0.055_507_133, 0.240_221_2, 0.693_146_97, 1.000_000_1];

/// 2^t for t ≤ 127, relative error about 1e-7. Many vectors at once: each constant is loaded once for all of them.
#[inline(always)]
pub(crate) fn exp2<S: Simd, const N: usize, const M: usize>(s: S, t: [Block<S, N>; M]) -> [Block<S, N>; M] {
    let (lowest, magic) = (s.splat_f32s(MIN_EXPONENT), s.splat_f32s(ROUND_MAGIC));
    let (mut shifted, mut f, mut p) = (t, t, t);
    for m in 0..M {
        for i in 0..N {
            f[m][i] = s.max_f32s(t[m][i], lowest);
        }
    }
    for m in 0..M {
        for i in 0..N {
            shifted[m][i] = s.add_f32s(f[m][i], magic);
            f[m][i] = s.sub_f32s(f[m][i], s.sub_f32s(shifted[m][i], magic));
            p[m][i] = s.splat_f32s(EXP2[0]);
        }
    }
    for c in &EXP2[1..] {
        let c = s.splat_f32s(*c);
        for m in 0..M {
            for i in 0..N {
                p[m][i] = s.mul_add_e_f32s(p[m][i], f[m][i], c);
            }
        }
    }
    for m in 0..M {
        for i in 0..N {
            let exponent = s.wrapping_dyn_shl_u32s(s.transmute_u32s_f32s(shifted[m][i]), s.splat_u32s(23));
            p[m][i] = s.transmute_f32s_u32s(s.add_u32s(s.transmute_u32s_f32s(p[m][i]), exponent));
        }
    }
    p
}

/// Loads sixteen values.
#[inline(always)]
pub(crate) fn load<S: Simd, const N: usize>(from: &[f32; LANES]) -> Block<S, N> {
    let (v, _) = S::as_simd_f32s(from);
    let mut block = [v[0]; N];
    block.copy_from_slice(&v[..N]);
    block
}

/// Stores sixteen values.
#[inline(always)]
pub(crate) fn store<S: Simd, const N: usize>(to: &mut [f32; LANES], values: Block<S, N>) {
    let (v, _) = S::as_mut_simd_f32s(to);
    v[..N].copy_from_slice(&values);
}

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
        Self { x: load::<S, N>(&OFFSETS[0]), y: load::<S, N>(&OFFSETS[1]) }
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
    let mut alphas = exp2(s, exponents);
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

/// Whether any value is above 0.
#[inline(always)]
pub(crate) fn any_positive<S: Simd, const N: usize>(s: S, values: &Block<S, N>) -> bool {
    let zero = s.splat_f32s(0.0);
    let mut any = s.greater_than_f32s(values[0], zero);
    for v in &values[1..] {
        any = s.or_m32s(any, s.greater_than_f32s(*v, zero));
    }
    s.first_true_m32s(any) < S::F32_LANES
}

/// Runs `$body::<S, N>($args)` with the N that belongs to the instruction set.
macro_rules! with_lanes {
    ($s:ident : $S:ident, $body:ident ( $($arg:expr),* )) => {
        match $S::F32_LANES {
            16 => $body::<$S, 1>($s, $($arg),*),
            8 => $body::<$S, 2>($s, $($arg),*),
            4 => $body::<$S, 4>($s, $($arg),*),
            _ => $body::<$S, 16>($s, $($arg),*),
        }
    };
}
pub(crate) use with_lanes;

/// Which instructions the kernels are run with.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Level {
    /// The best that the processor has.
    Native(pulp::Arch),
    /// One lane.
    #[cfg(test)]
    Scalar,
    /// Four lanes without vector instructions, to test the structure.
    #[cfg(test)]
    Four,
    /// Sixteen lanes without vector instructions, to test the structure where there is no AVX-512.
    #[cfg(test)]
    Sixteen,
}

impl Level {
    /// The best that the processor has.
    pub fn native() -> Self {
        Level::Native(pulp::Arch::new())
    }

    pub fn dispatch<Op: pulp::WithSimd>(self, op: Op) -> Op::Output {
        match self {
            Level::Native(arch) => arch.dispatch(op),
            #[cfg(test)]
            Level::Scalar => op.with_simd(pulp::Scalar::new()),
            #[cfg(test)]
            Level::Four => op.with_simd(pulp::Scalar128b),
            #[cfg(test)]
            Level::Sixteen => op.with_simd(pulp::Scalar512b),
        }
    }

    /// Lanes of a vector.
    pub fn width(self) -> usize {
        struct Width;
        impl pulp::WithSimd for Width {
            type Output = usize;
            #[inline(always)]
            fn with_simd<S: Simd>(self, _: S) -> usize {
                S::F32_LANES
            }
        }
        self.dispatch(Width)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp2_is_accurate_to_a_few_parts_in_ten_million() {
        struct Sweep;
        impl pulp::WithSimd for Sweep {
            type Output = f64;
            #[inline(always)]
            fn with_simd<S: Simd>(self, s: S) -> f64 {
                (0..200_000).fold(0.0f64, |worst, k| {
                    let t = -20.0 + k as f32 * 1.05e-4;
                    let mut out = vec![0.0f32; S::F32_LANES];
                    S::as_mut_simd_f32s(&mut out).0[0] = exp2::<S, 1, 1>(s, [[s.splat_f32s(t)]])[0][0];
                    worst.max((out[0] as f64 / (t as f64).exp2() - 1.0).abs())
                })
            }
        }
        let worst = Level::native().dispatch(Sweep).max(Level::Scalar.dispatch(Sweep));
        assert!(worst < 2.5e-7, "relative error {worst:.2e}");
    }
}
