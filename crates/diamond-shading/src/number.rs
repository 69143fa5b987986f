//! What the shading formulas compute with: single numbers, or one number per pixel of a vector.
//!
//! Every formula of this crate that is evaluated per pixel is written once, over a [`Number`]. With `f32` it is the public
//! function; with [`Lanes`] it shades as many pixels at once as the instruction set has lanes. Nothing here fuses a
//! multiplication with an addition, so both give the same bits; [`Number::exp`] alone does, where the instruction set can.
//! Instead of branches there are masks. Everything is inlined, because a vector operation outside of the dispatched function
//! would be compiled without the instruction set.
use diamond_simd::{Lanes, Mask, Scalar, Simd};
use std::ops::{Add, BitAnd, Div, Mul, Neg, Not, Sub};

/// Lanes of the widest vectors.
const WIDEST: usize = diamond_simd::BLOCK;

/// One `f32`, or one per lane.
pub(crate) trait Number:
    Copy
    + Neg<Output = Self>
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Add<f32, Output = Self>
    + Sub<f32, Output = Self>
    + Mul<f32, Output = Self>
    + Div<f32, Output = Self>
{
    /// A truth value per lane.
    type Mask: Copy + BitAnd<Output = Self::Mask> + Not<Output = Self::Mask>;

    /// `value` in every lane.
    fn same(self, value: f32) -> Self;
    /// Square root, correctly rounded.
    fn root(self) -> Self;
    /// Without its sign.
    fn magnitude(self) -> Self;
    /// The larger of two finite numbers.
    fn larger(self, b: Self) -> Self;
    /// The smaller of two finite numbers.
    fn smaller(self, b: Self) -> Self;
    /// self ≥ b; false where one is NaN.
    fn reaches(self, b: f32) -> Self::Mask;
    /// self < b; false where one is NaN.
    fn under(self, b: f32) -> Self::Mask;
    /// `self` where the mask is true, else `other`.
    fn or_where_not(self, mask: Self::Mask, other: Self) -> Self;
    /// Whether the mask is true in every lane.
    fn everywhere(mask: Self::Mask) -> bool;
    /// e^self to 2 ulp.
    fn exp(self) -> Self;
    /// A scalar formula without branches on each lane: for what is done in `f64`. Its loop over the lanes becomes vector
    /// instructions too.
    fn per_lane<const I: usize, const O: usize, F: PerLane<I, O>>(f: &F, inputs: [Self; I]) -> [Self; O];

    /// Not below `low`.
    #[inline(always)]
    fn at_least(self, low: f32) -> Self {
        self.larger(self.same(low))
    }
    /// Not above `high`.
    #[inline(always)]
    fn at_most(self, high: f32) -> Self {
        self.smaller(self.same(high))
    }
    /// `self` where the mask is true, else 0.
    #[inline(always)]
    fn only_where(self, mask: Self::Mask) -> Self {
        self.or_where_not(mask, self.same(0.0))
    }
    /// 1 − self.
    #[inline(always)]
    fn complement(self) -> Self {
        self.same(1.0) - self
    }
    /// 1 / self, correctly rounded.
    #[inline(always)]
    fn inverse(self) -> Self {
        self.same(1.0) / self
    }
}

/// A formula of `I` numbers with `O` results.
pub(crate) trait PerLane<const I: usize, const O: usize> {
    /// The formula; `#[inline(always)]`, without branches.
    fn at(&self, x: [f32; I]) -> [f32; O];
}

impl Number for f32 {
    type Mask = bool;
    #[inline(always)]
    fn same(self, value: f32) -> f32 {
        value
    }
    #[inline(always)]
    fn root(self) -> f32 {
        self.sqrt()
    }
    #[inline(always)]
    fn magnitude(self) -> f32 {
        self.abs()
    }
    #[inline(always)]
    fn larger(self, b: f32) -> f32 {
        self.max(b)
    }
    #[inline(always)]
    fn smaller(self, b: f32) -> f32 {
        self.min(b)
    }
    #[inline(always)]
    fn reaches(self, b: f32) -> bool {
        self >= b
    }
    #[inline(always)]
    fn under(self, b: f32) -> bool {
        self < b
    }
    #[inline(always)]
    fn or_where_not(self, mask: bool, other: f32) -> f32 {
        if mask { self } else { other }
    }
    #[inline(always)]
    fn everywhere(mask: bool) -> bool {
        mask
    }
    #[inline(always)]
    fn exp(self) -> f32 {
        diamond_simd::exp(Lanes::new(Scalar::new(), self)).v
    }
    #[inline(always)]
    fn per_lane<const I: usize, const O: usize, F: PerLane<I, O>>(f: &F, inputs: [f32; I]) -> [f32; O] {
        f.at(inputs)
    }
}

impl<S: Simd> Number for Lanes<S> {
    type Mask = Mask<S>;
    #[inline(always)]
    fn same(self, value: f32) -> Self {
        Lanes::same(self, value)
    }
    #[inline(always)]
    fn root(self) -> Self {
        self.sqrt()
    }
    #[inline(always)]
    fn magnitude(self) -> Self {
        self.abs()
    }
    #[inline(always)]
    fn larger(self, b: Self) -> Self {
        self.max(b)
    }
    #[inline(always)]
    fn smaller(self, b: Self) -> Self {
        self.min(b)
    }
    #[inline(always)]
    fn reaches(self, b: f32) -> Mask<S> {
        self.ge(Lanes::same(self, b))
    }
    #[inline(always)]
    fn under(self, b: f32) -> Mask<S> {
        self.lt(Lanes::same(self, b))
    }
    #[inline(always)]
    fn or_where_not(self, mask: Mask<S>, other: Self) -> Self {
        mask.select(self, other)
    }
    #[inline(always)]
    fn everywhere(mask: Mask<S>) -> bool {
        !(!mask).any()
    }
    #[inline(always)]
    fn exp(self) -> Self {
        diamond_simd::exp(self)
    }
    #[inline(always)]
    fn per_lane<const I: usize, const O: usize, F: PerLane<I, O>>(f: &F, inputs: [Self; I]) -> [Self; O] {
        let (mut x, mut y) = ([[0.0; WIDEST]; I], [[0.0; WIDEST]; O]);
        for i in 0..I {
            inputs[i].store(&mut x[i]);
        }
        for lane in 0..S::F32_LANES {
            let mut one = [0.0; I];
            for i in 0..I {
                one[i] = x[i][lane];
            }
            let result = f.at(one);
            for o in 0..O {
                y[o][lane] = result[o];
            }
        }
        let mut out = [inputs[0]; O];
        for o in 0..O {
            out[o] = Lanes::load(inputs[0].s, &y[o]);
        }
        out
    }
}
