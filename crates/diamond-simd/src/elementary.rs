//! Exponential, logarithm, roots, sine and cosine on vectors: polynomials after an exact reduction of the argument.
//!
//! The coefficients are near-minimax (Chebyshev expansions computed with 40 digits). Errors are stated in units in the last
//! place (ulp) against the true value and are checked by tests that sweep the range at every width; each function is defined
//! for every finite argument.
use crate::Lanes;
use pulp::Simd;
use std::f32::consts::LOG2_E;

/// Exponents at or below this give the smallest normal power of two instead of wrapping around.
const MIN_EXPONENT: f32 = -126.0;
/// Exponents at or above this give 2¹²⁷.
const MAX_EXPONENT: f32 = 127.0;
/// Adding 1.5 · 2²³ rounds a float to an integer held in its low mantissa bits.
const ROUND_MAGIC: f32 = 12_582_912.0;
/// 2^f on [−½, ½], highest power first: minimax in relative error (Remez), 7.5e-8.
const EXP2: [f32; 6] = [0.001_327_647_2, 0.009_675_541, 0.055_507_133, 0.240_221_2, 0.693_146_97, 1.000_000_1];
/// (e^r − 1 − r)/r² on ±ln 2/2, highest power first; 8e-9 of e^r.
const EXP: [f32; 5] = [0.001_392_617_6, 0.008_363_173, 0.041_666_555, 0.166_665_77, 0.5];
/// (ln((1+s)/(1−s)) − 2s)/s³ in powers of s² up to (3 − 2√2)², highest power first; 1e-9.
const LN: [f32; 4] = [0.233_304_67, 0.285_508_2, 0.400_001_2, 0.666_666_7];
/// (sin πr − πr)/r³ in powers of r² on [−¼, ¼], highest power first; 9e-10.
const SIN: [f32; 4] = [0.081_229_575, -0.599_228_8, 2.550_163_5, -5.167_712_7];
/// (cos πr − 1)/r² in powers of r² on [−¼, ¼], highest power first; 3e-9.
const COS: [f32; 4] = [0.232_125_41, -1.335_137_8, 4.058_710_6, -4.934_802];
/// ln 2 rounded to 11 bits, so that products with exponents are exact, and the rest.
const LN_2_HIGH: f32 = 0.693_359_4;
const LN_2_LOW: f32 = -2.121_944_4e-4;
/// Bits of √½, where mantissas begin.
const SQRT_HALF_BITS: u32 = 0x3F35_04F3;
/// Bits of 1.
const ONE_BITS: u32 = 0x3F80_0000;

#[inline(always)]
fn polynomial<S: Simd>(x: Lanes<S>, coefficients: &[f32]) -> Lanes<S> {
    let mut p = x.same(coefficients[0]);
    for c in &coefficients[1..] {
        p = p.mul_add(x, x.same(*c));
    }
    p
}

/// `p · 2^n` for the integer n that the low bits of `shifted` hold.
#[inline(always)]
fn scale_by_power<S: Simd>(s: S, p: S::f32s, shifted: S::f32s) -> S::f32s {
    let exponent = s.wrapping_dyn_shl_u32s(s.transmute_u32s_f32s(shifted), s.splat_u32s(23));
    s.transmute_f32s_u32s(s.add_u32s(s.transmute_u32s_f32s(p), exponent))
}

/// 2^t for t ≤ 127 on a bare vector, relative error 2.5e-7; at or below −126 the smallest normal number.
#[inline(always)]
pub fn exp2_of<S: Simd>(s: S, t: S::f32s) -> S::f32s {
    exp2_of_all(s, [[t]])[0][0]
}

/// [`exp2_of`] of many vectors at once: each constant is loaded once for all of them.
#[inline(always)]
pub fn exp2_of_all<S: Simd, const N: usize, const M: usize>(s: S, t: [[S::f32s; N]; M]) -> [[S::f32s; N]; M] {
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
            p[m][i] = scale_by_power(s, p[m][i], shifted[m][i]);
        }
    }
    p
}

/// 2^t, relative error 2.5e-7; t is cut to [−126, 127].
#[inline(always)]
pub fn exp2<S: Simd>(t: Lanes<S>) -> Lanes<S> {
    Lanes::new(t.s, exp2_of(t.s, t.min(t.same(MAX_EXPONENT)).v))
}

/// e^x to 2 ulp; x is cut so that the result lies in [1.2e-38, 1.7e38].
#[inline(always)]
pub fn exp<S: Simd>(x: Lanes<S>) -> Lanes<S> {
    let x = x.clamp(-87.33, 88.02);
    let magic = x.same(ROUND_MAGIC);
    let shifted = x * LOG2_E + magic;
    let n = shifted - magic;
    let r = n.neg_mul_add(x.same(LN_2_HIGH), x);
    let r = n.neg_mul_add(x.same(LN_2_LOW), r);
    let p = polynomial(r, &EXP).mul_add(r * r, r) + 1.0;
    Lanes::new(x.s, scale_by_power(x.s, p.v, shifted.v))
}

/// x = m·2^e with m in [√½, √2) → (e, m − 1) for normal x; smaller ones, and what is not positive, count as 1.2e-38.
#[inline(always)]
fn split<S: Simd>(x: Lanes<S>) -> (Lanes<S>, Lanes<S>) {
    let s = x.s;
    let x = x.clamp(f32::MIN_POSITIVE, f32::MAX);
    let bits = s.add_u32s(s.transmute_u32s_f32s(x.v), s.splat_u32s(ONE_BITS - SQRT_HALF_BITS));
    // An integer below 2²³ or-ed into the bits of 2²³ is that integer plus 2²³.
    let exponent = s.or_u32s(s.wrapping_dyn_shr_u32s(bits, s.splat_u32s(23)), s.splat_u32s(0x4B00_0000));
    let e = Lanes::new(s, s.transmute_f32s_u32s(exponent)) - (8_388_608.0 + 127.0);
    let mantissa = s.add_u32s(s.and_u32s(bits, s.splat_u32s(0x007F_FFFF)), s.splat_u32s(SQRT_HALF_BITS));
    (e, Lanes::new(s, s.transmute_f32s_u32s(mantissa)) - 1.0)
}

/// ln(1 + f) for f in [√½ − 1, √2 − 1), in two parts: f itself, and the rest.
///
/// With s = f/(2 + f): ln(1 + f) = 2s + s³·P(s²) = f − s·(f − s²·P(s²)), because 2s = f − s·f.
#[inline(always)]
fn ln_1p_rest<S: Simd>(f: Lanes<S>) -> Lanes<S> {
    let s = f / (f + 2.0);
    let square = s * s;
    -(s * (f - square * polynomial(square, &LN)))
}

/// ln x for x > 0 to 2 ulp (3e-7 absolute near 1 at worst, where the result passes 0); what is below 1.2e-38 counts as that.
#[inline(always)]
pub fn ln<S: Simd>(x: Lanes<S>) -> Lanes<S> {
    let (e, f) = split(x);
    let low = e.mul_add(x.same(LN_2_LOW), ln_1p_rest(f));
    e.mul_add(x.same(LN_2_HIGH), f + low)
}

/// log₂ x for x > 0, absolute error 2e-7 of 1 + |log₂ x|; what is below 1.2e-38 counts as that.
#[inline(always)]
pub fn log2<S: Simd>(x: Lanes<S>) -> Lanes<S> {
    let (e, f) = split(x);
    (f + ln_1p_rest(f)).mul_add(x.same(LOG2_E), e)
}

/// x^(p/q) for x ≥ 0, p < q: the exponent's part is split off exactly.
#[inline(always)]
fn root<S: Simd>(x: Lanes<S>, p: f32, q: f32) -> Lanes<S> {
    let (e, f) = split(x);
    let magic = x.same(ROUND_MAGIC);
    let shifted = e * (p / q) + magic;
    let n = shifted - magic;
    let fraction = (e * p - n * q) * (1.0 / q);
    let t = (f + ln_1p_rest(f)).mul_add(x.same(LOG2_E * p / q), fraction);
    let y = Lanes::new(x.s, scale_by_power(x.s, exp2_of(x.s, t.v), shifted.v));
    y.keep(x.gt(x.same(0.0)))
}

/// x^(1/2.4), the power of the sRGB curve, relative error 4e-7; 0 for x ≤ 0.
#[inline(always)]
pub fn root_2_4<S: Simd>(x: Lanes<S>) -> Lanes<S> {
    root(x, 5.0, 12.0)
}

/// x^(1/2.2), relative error 4e-7; 0 for x ≤ 0.
#[inline(always)]
pub fn root_2_2<S: Simd>(x: Lanes<S>) -> Lanes<S> {
    root(x, 5.0, 11.0)
}

/// 1/(1 + e^−x) to 4 ulp; never 0 and never above 1.
#[inline(always)]
pub fn sigmoid<S: Simd>(x: Lanes<S>) -> Lanes<S> {
    (exp(-x) + 1.0).recip()
}

/// ln(1 + e^x), smooth and positive, relative error 1e-6 for x ≥ −15 and absolute 1e-7 below.
#[inline(always)]
pub fn ln_1p_exp<S: Simd>(x: Lanes<S>) -> Lanes<S> {
    let small = exp(-x.abs());
    // ln(1 + y) = ln(w)·y/(w − 1) with w = 1 + y rounded: the rounding cancels.
    let w = small + 1.0;
    let d = w - 1.0;
    let exact = d.gt(x.same(0.0));
    let rest = exact.select(ln(w) * (small / exact.select(d, x.same(1.0))), small);
    x.max(x.same(0.0)) + rest
}

/// sin(π·x) and cos(π·x), absolute error 1.5e-7, for |x| < 2²¹ (beyond, some value in [−1, 1]).
#[inline(always)]
pub fn sin_cos_pi<S: Simd>(x: Lanes<S>) -> (Lanes<S>, Lanes<S>) {
    let s = x.s;
    let x = x.clamp(-2_097_152.0, 2_097_152.0);
    let magic = x.same(ROUND_MAGIC);
    let shifted = x + x + magic;
    let r = (shifted - magic).neg_mul_add(x.same(0.5), x);
    let square = r * r;
    let sin = r * polynomial(square, &SIN).mul_add(square, x.same(std::f32::consts::PI));
    let cos = polynomial(square, &COS).mul_add(square, x.same(1.0));
    // The quadrant: odd ones exchange sine and cosine; the second and third have a negative sine, the first and second a
    // negative cosine.
    let quadrant = s.transmute_u32s_f32s(shifted.v);
    let (one, two, thirty) = (s.splat_u32s(1), s.splat_u32s(2), s.splat_u32s(30));
    let odd = s.equal_u32s(s.and_u32s(quadrant, one), one);
    let sin_sign = s.wrapping_dyn_shl_u32s(s.and_u32s(quadrant, two), thirty);
    let cos_sign = s.wrapping_dyn_shl_u32s(s.and_u32s(s.add_u32s(quadrant, one), two), thirty);
    let a = s.transmute_u32s_f32s(s.select_f32s(odd, cos.v, sin.v));
    let b = s.transmute_u32s_f32s(s.select_f32s(odd, sin.v, cos.v));
    let signed = (s.transmute_f32s_u32s(s.xor_u32s(a, sin_sign)), s.transmute_f32s_u32s(s.xor_u32s(b, cos_sign)));
    (Lanes::new(s, signed.0), Lanes::new(s, signed.1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Level, WithSimd};

    #[derive(Clone, Copy, Debug, PartialEq)]
    enum Function {
        Exp2,
        Exp,
        Ln,
        Log2,
        Root24,
        Root22,
        Sigmoid,
        Softplus,
        Sin,
        Cos,
    }

    struct Apply<'a>(Function, &'a [f32], &'a mut [f32]);

    impl WithSimd for Apply<'_> {
        type Output = ();
        #[inline(always)]
        fn with_simd<S: Simd>(self, s: S) {
            for (x, y) in self.1.chunks(S::F32_LANES).zip(self.2.chunks_mut(S::F32_LANES)) {
                let x = Lanes::load_partial(s, x);
                let result = match self.0 {
                    Function::Exp2 => exp2(x),
                    Function::Exp => exp(x),
                    Function::Ln => ln(x),
                    Function::Log2 => log2(x),
                    Function::Root24 => root_2_4(x),
                    Function::Root22 => root_2_2(x),
                    Function::Sigmoid => sigmoid(x),
                    Function::Softplus => ln_1p_exp(x),
                    Function::Sin => sin_cos_pi(x).0,
                    Function::Cos => sin_cos_pi(x).1,
                };
                result.store_partial(y);
            }
        }
    }

    /// (function, points, truth, size of the allowed error at a true value, allowed error in that unit)
    type Exact = fn(f64) -> f64;

    fn cases() -> Vec<(Function, Vec<f32>, Exact, Exact, f64)> {
        let even = |from: f32, to: f32| -> Vec<f32> {
            (0..40_001).map(|i| from + (to - from) * (i as f32 / 40_000.0)).collect()
        };
        let log = |from: f32, to: f32| -> Vec<f32> { even(from, to).iter().map(|x| x.exp2()).collect() };
        let ulp: fn(f64) -> f64 = |y| 2f64.powi(y.abs().max(1e-300).log2().floor() as i32 - 23);
        let relative: fn(f64) -> f64 = f64::abs;
        let root = |p: fn(f64) -> f64| p;
        vec![
            (Function::Exp2, even(-125.5, 127.0), f64::exp2, relative, 2.5e-7),
            (Function::Exp, even(-87.3, 88.0), f64::exp, ulp, 2.0),
            (Function::Ln, log(-126.0, 127.9), f64::ln, ulp, 2.0),
            (Function::Ln, even(0.5, 2.0), f64::ln, ulp, 2.0),
            (Function::Log2, log(-126.0, 127.9), f64::log2, |y| 1.0 + y.abs(), 2e-7),
            (Function::Root24, log(-126.0, 127.9), root(|x| x.powf(1.0 / 2.4)), relative, 4e-7),
            (Function::Root24, even(0.0031, 1.0), root(|x| x.powf(1.0 / 2.4)), relative, 4e-7),
            (Function::Root22, log(-126.0, 127.9), root(|x| x.powf(1.0 / 2.2)), relative, 4e-7),
            (Function::Sigmoid, even(-87.0, 87.0), |x| 1.0 / (1.0 + (-x).exp()), ulp, 4.0),
            (Function::Softplus, even(-15.0, 88.0), |x| x.exp().ln_1p(), relative, 1e-6),
            (Function::Softplus, even(-80.0, -15.0), |x| x.exp().ln_1p(), |_| 1.0, 1e-7),
            (Function::Sin, even(-9.0, 9.0), |x| (std::f64::consts::PI * x).sin(), |_| 1.0, 1.5e-7),
            (Function::Cos, even(-9.0, 9.0), |x| (std::f64::consts::PI * x).cos(), |_| 1.0, 1.5e-7),
        ]
    }

    #[test]
    fn errors_are_as_stated_at_every_width_and_widths_agree() {
        for (function, points, truth, unit, allowed) in cases() {
            let mut fused: Option<Vec<f32>> = None;
            let mut worst_of_all = (0.0f64, 0.0f32);
            for level in Level::testable() {
                let mut found = vec![f32::NAN; points.len()];
                level.dispatch(Apply(function, &points, &mut found));
                for (&x, &y) in points.iter().zip(&found) {
                    let expected = truth(f64::from(x));
                    let error = (f64::from(y) - expected).abs() / unit(expected).max(1e-300);
                    if error > worst_of_all.0 || error.is_nan() {
                        worst_of_all = (error, x);
                    }
                }
                if level.is_fused() {
                    let first = fused.get_or_insert_with(|| found.clone());
                    assert!(
                        first.iter().zip(&found).all(|(a, b)| a.to_bits() == b.to_bits()),
                        "{function:?} {level:?}"
                    );
                }
            }
            println!("{function:?}: worst error {:.3e} at {} (allowed {allowed:e})", worst_of_all.0, worst_of_all.1);
            assert!(worst_of_all.0 <= allowed, "{function:?}: {:.3e} at {}", worst_of_all.0, worst_of_all.1);
        }
    }

    #[test]
    fn extreme_arguments_stay_finite() {
        let points = [0.0, -0.0, 1e-45, -1e-45, 1e-38, -1.0, 1e30, -1e30, f32::MAX, f32::MIN, 3e6, -5e9];
        for (function, ..) in cases() {
            for level in Level::testable() {
                let mut found = [f32::NAN; 12];
                level.dispatch(Apply(function, &points, &mut found));
                assert!(found.iter().all(|y| y.is_finite()), "{function:?} {level:?} {found:?}");
            }
        }
    }
}
