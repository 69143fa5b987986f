//! A vector of `f32` with the operators of a number, at the width of an instruction set.
use pulp::Simd;
use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

/// [`Simd::F32_LANES`] numbers.
///
/// `a + b`, `a * 2.0`, `a.mul_add(b, c)` work lane by lane. A number on the right stands for itself in every lane.
#[derive(Debug)]
pub struct Lanes<S: Simd> {
    /// The instruction set.
    pub s: S,
    /// The vector of the instruction set.
    pub v: S::f32s,
}

/// A truth value per lane.
#[derive(Debug)]
pub struct Mask<S: Simd> {
    s: S,
    m: S::m32s,
}

impl<S: Simd> Clone for Lanes<S> {
    #[inline(always)]
    fn clone(&self) -> Self {
        *self
    }
}

impl<S: Simd> Copy for Lanes<S> {}

impl<S: Simd> Clone for Mask<S> {
    #[inline(always)]
    fn clone(&self) -> Self {
        *self
    }
}

impl<S: Simd> Copy for Mask<S> {}

impl<S: Simd> Lanes<S> {
    /// Numbers in a vector.
    pub const COUNT: usize = S::F32_LANES;

    /// A vector of the instruction set.
    #[inline(always)]
    pub fn new(s: S, v: S::f32s) -> Self {
        Self { s, v }
    }

    /// The same number in every lane.
    #[inline(always)]
    pub fn splat(s: S, value: f32) -> Self {
        Self { s, v: s.splat_f32s(value) }
    }

    /// The first numbers of a slice of at least [`Lanes::COUNT`].
    #[inline(always)]
    pub fn load(s: S, from: &[f32]) -> Self {
        Self { s, v: S::as_simd_f32s(&from[..S::F32_LANES]).0[0] }
    }

    /// A slice of at most [`Lanes::COUNT`] numbers, and zeros after it.
    #[inline(always)]
    pub fn load_partial(s: S, from: &[f32]) -> Self {
        Self { s, v: s.partial_load_f32s(from) }
    }

    /// To the beginning of a slice of at least [`Lanes::COUNT`] numbers.
    #[inline(always)]
    pub fn store(self, to: &mut [f32]) {
        S::as_mut_simd_f32s(&mut to[..S::F32_LANES]).0[0] = self.v;
    }

    /// As many as the slice has, at most [`Lanes::COUNT`].
    #[inline(always)]
    pub fn store_partial(self, to: &mut [f32]) {
        self.s.partial_store_f32s(to, self.v);
    }

    /// The same number as `value` in every lane, where an instruction set is at hand.
    #[inline(always)]
    pub fn same(self, value: f32) -> Self {
        Self::splat(self.s, value)
    }

    /// `self·b + c`: one rounding where the instruction set fuses, two with the portable one.
    #[inline(always)]
    pub fn mul_add(self, b: Self, c: Self) -> Self {
        Self { s: self.s, v: self.s.mul_add_e_f32s(self.v, b.v, c.v) }
    }

    /// `c − self·b`, rounded as [`Lanes::mul_add`].
    #[inline(always)]
    pub fn neg_mul_add(self, b: Self, c: Self) -> Self {
        Self { s: self.s, v: self.s.negate_mul_add_e_f32s(self.v, b.v, c.v) }
    }

    /// The smaller of two numbers; which one where one is NaN depends on the instruction set.
    #[inline(always)]
    pub fn min(self, b: Self) -> Self {
        Self { s: self.s, v: self.s.min_f32s(self.v, b.v) }
    }

    /// The larger of two numbers; which one where one is NaN depends on the instruction set.
    #[inline(always)]
    pub fn max(self, b: Self) -> Self {
        Self { s: self.s, v: self.s.max_f32s(self.v, b.v) }
    }

    /// Not below `low` and not above `high`.
    #[inline(always)]
    pub fn clamp(self, low: f32, high: f32) -> Self {
        self.max(self.same(low)).min(self.same(high))
    }

    /// Without its sign.
    #[inline(always)]
    pub fn abs(self) -> Self {
        Self { s: self.s, v: self.s.abs_f32s(self.v) }
    }

    /// The magnitude of `self` with the sign of `sign`.
    #[inline(always)]
    pub fn copysign(self, sign: Self) -> Self {
        let s = self.s;
        let magnitude = s.and_u32s(s.transmute_u32s_f32s(self.v), s.splat_u32s(0x7FFF_FFFF));
        let sign = s.and_u32s(s.transmute_u32s_f32s(sign.v), s.splat_u32s(0x8000_0000));
        Self { s, v: s.transmute_f32s_u32s(s.or_u32s(magnitude, sign)) }
    }

    /// Square root, correctly rounded.
    #[inline(always)]
    pub fn sqrt(self) -> Self {
        Self { s: self.s, v: self.s.sqrt_f32s(self.v) }
    }

    /// 1 / self, correctly rounded.
    #[inline(always)]
    pub fn recip(self) -> Self {
        self.same(1.0) / self
    }

    /// self > b.
    #[inline(always)]
    pub fn gt(self, b: Self) -> Mask<S> {
        Mask { s: self.s, m: self.s.greater_than_f32s(self.v, b.v) }
    }

    /// self ≥ b.
    #[inline(always)]
    pub fn ge(self, b: Self) -> Mask<S> {
        Mask { s: self.s, m: self.s.greater_than_or_equal_f32s(self.v, b.v) }
    }

    /// self < b.
    #[inline(always)]
    pub fn lt(self, b: Self) -> Mask<S> {
        Mask { s: self.s, m: self.s.less_than_f32s(self.v, b.v) }
    }

    /// self ≤ b.
    #[inline(always)]
    pub fn le(self, b: Self) -> Mask<S> {
        Mask { s: self.s, m: self.s.less_than_or_equal_f32s(self.v, b.v) }
    }

    /// `self` where `keep`, else 0.
    #[inline(always)]
    pub fn keep(self, keep: Mask<S>) -> Self {
        keep.select(self, self.same(0.0))
    }

    /// The largest lane; no lane may be NaN.
    #[inline(always)]
    pub fn largest(self) -> f32 {
        self.s.reduce_max_f32s(self.v)
    }
}

impl<S: Simd> Mask<S> {
    /// `a` where true, else `b`.
    #[inline(always)]
    pub fn select(self, a: Lanes<S>, b: Lanes<S>) -> Lanes<S> {
        Lanes { s: self.s, v: self.s.select_f32s(self.m, a.v, b.v) }
    }

    /// Whether any lane is true.
    #[inline(always)]
    pub fn any(self) -> bool {
        self.s.first_true_m32s(self.m) < S::F32_LANES
    }
}

impl<S: Simd> BitAnd for Mask<S> {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, b: Self) -> Self {
        Self { s: self.s, m: self.s.and_m32s(self.m, b.m) }
    }
}

impl<S: Simd> BitOr for Mask<S> {
    type Output = Self;
    #[inline(always)]
    fn bitor(self, b: Self) -> Self {
        Self { s: self.s, m: self.s.or_m32s(self.m, b.m) }
    }
}

impl<S: Simd> Not for Mask<S> {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        Self { s: self.s, m: self.s.not_m32s(self.m) }
    }
}

impl<S: Simd> Neg for Lanes<S> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self { s: self.s, v: self.s.neg_f32s(self.v) }
    }
}

macro_rules! operator {
    ($operator:ident, $method:ident, $vector:ident) => {
        impl<S: Simd> $operator for Lanes<S> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, b: Self) -> Self {
                Self { s: self.s, v: self.s.$vector(self.v, b.v) }
            }
        }

        impl<S: Simd> $operator<f32> for Lanes<S> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, b: f32) -> Self {
                Self { s: self.s, v: self.s.$vector(self.v, self.s.splat_f32s(b)) }
            }
        }
    };
}

operator!(Add, add, add_f32s);
operator!(Sub, sub, sub_f32s);
operator!(Mul, mul, mul_f32s);
operator!(Div, div, div_f32s);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Level, WithSimd};

    /// Each operation on a whole vector and on part of one, against the same on single numbers.
    struct Operations;

    impl WithSimd for Operations {
        type Output = Vec<f32>;
        #[inline(always)]
        fn with_simd<S: Simd>(self, s: S) -> Vec<f32> {
            let a: Vec<f32> = (0..16).map(|i| i as f32 - 7.5).collect();
            let b: Vec<f32> = (0..16).map(|i| 0.25 * i as f32 + 0.5).collect();
            let mut out = vec![0.0; 16 * 13];
            for at in (0..16).step_by(S::F32_LANES) {
                let (x, y) = (Lanes::load(s, &a[at..]), Lanes::load(s, &b[at..]));
                let results = [
                    x + y,
                    x - y,
                    x * y,
                    x / y,
                    -x,
                    x.abs(),
                    x.min(y),
                    x.max(y),
                    x.clamp(-1.0, 1.0),
                    y.copysign(x),
                    y.sqrt(),
                    (x.gt(x.same(0.0)) & y.lt(x.same(3.0)) | x.le(x.same(-7.0))).select(x, y),
                    x.keep(!y.ge(x.same(2.0))),
                ];
                for (i, r) in results.into_iter().enumerate() {
                    r.store(&mut out[16 * i + at..]);
                }
            }
            let part = Lanes::load_partial(s, &a[..S::F32_LANES.min(3)]);
            let mut few = vec![9.0; 3.min(S::F32_LANES)];
            part.store_partial(&mut few);
            assert_eq!(few, a[..few.len()]);
            assert!(part.gt(part.same(-100.0)).any() && !part.gt(part.same(100.0)).any());
            out
        }
    }

    #[test]
    fn operators_do_what_they_say_at_every_width() {
        let expected: Vec<f32> = {
            let pairs: Vec<(f32, f32)> = (0..16).map(|i| (i as f32 - 7.5, 0.25 * i as f32 + 0.5)).collect();
            let functions: [fn(f32, f32) -> f32; 13] = [
                |x, y| x + y,
                |x, y| x - y,
                |x, y| x * y,
                |x, y| x / y,
                |x, _| -x,
                |x, _| x.abs(),
                f32::min,
                f32::max,
                |x, _| x.clamp(-1.0, 1.0),
                |x, y| y.copysign(x),
                |_, y| y.sqrt(),
                |x, y| if (x > 0.0 && y < 3.0) || x <= -7.0 { x } else { y },
                |x, y| if y < 2.0 { x } else { 0.0 },
            ];
            functions.iter().flat_map(|f| pairs.iter().map(move |&(x, y)| f(x, y))).collect()
        };
        for level in Level::testable() {
            assert_eq!(level.dispatch(Operations), expected, "{level:?}");
        }
    }
}
