//! Four numbers in f64 that go through the same arithmetic: the footprints of four Gaussians at a time.
//!
//! Plain arrays and loops of fixed length, which compilers turn into vector instructions where a function is compiled for
//! an instruction set that has them. No multiplication is fused with an addition, so bits are the same everywhere.
use std::ops::{Add, AddAssign, Mul, Neg, Sub, SubAssign};

/// Lanes.
pub(crate) const WIDTH: usize = 4;

/// Four numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Wide(pub [f64; WIDTH]);

impl Wide {
    pub const ZERO: Wide = Wide([0.0; WIDTH]);

    /// The same number four times.
    #[inline(always)]
    pub fn of(v: f64) -> Self {
        Self([v; WIDTH])
    }

    #[inline(always)]
    pub fn sqrt(self) -> Self {
        Self(self.0.map(f64::sqrt))
    }

    /// 1/x.
    #[inline(always)]
    pub fn recip(self) -> Self {
        Self(self.0.map(|v| 1.0 / v))
    }

    #[inline(always)]
    pub fn clamp(self, low: f64, high: f64) -> Self {
        Self(self.0.map(|v| v.max(low).min(high)))
    }

    /// 1 where equal, else 0.
    #[inline(always)]
    pub fn equals(self, o: Self) -> Self {
        let mut out = [0.0; WIDTH];
        for k in 0..WIDTH {
            out[k] = if self.0[k] == o.0[k] { 1.0 } else { 0.0 };
        }
        Self(out)
    }

    /// `a` where this is at least `threshold`, else `b`.
    #[inline(always)]
    pub fn choose(self, threshold: f64, a: Self, b: Self) -> Self {
        let mut out = [0.0; WIDTH];
        for k in 0..WIDTH {
            out[k] = if self.0[k] >= threshold { a.0[k] } else { b.0[k] };
        }
        Self(out)
    }

    /// One lane of several.
    #[inline(always)]
    pub fn lane<const N: usize>(values: &[Wide; N], k: usize) -> [f64; N] {
        values.map(|v| v.0[k])
    }
}

macro_rules! operators {
    ($($trait:ident $method:ident $op:tt;)*) => {$(
        impl $trait for Wide {
            type Output = Wide;
            #[inline(always)]
            fn $method(self, o: Wide) -> Wide {
                let mut out = self.0;
                for k in 0..WIDTH {
                    out[k] = self.0[k] $op o.0[k];
                }
                Wide(out)
            }
        }
        impl $trait<f64> for Wide {
            type Output = Wide;
            #[inline(always)]
            fn $method(self, o: f64) -> Wide {
                self $op Wide::of(o)
            }
        }
    )*};
}

operators! {
    Add add +;
    Sub sub -;
    Mul mul *;
}

impl AddAssign for Wide {
    #[inline(always)]
    fn add_assign(&mut self, o: Wide) {
        *self = *self + o;
    }
}

impl SubAssign for Wide {
    #[inline(always)]
    fn sub_assign(&mut self, o: Wide) {
        *self = *self - o;
    }
}

impl Neg for Wide {
    type Output = Wide;
    #[inline(always)]
    fn neg(self) -> Wide {
        Wide(self.0.map(|v| -v))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lanes_are_independent() {
        let (a, b) = (Wide([1.0, 4.0, -9.0, 0.25]), Wide([2.0, 0.5, 3.0, -1.0]));
        assert_eq!((a + b).0, [3.0, 4.5, -6.0, -0.75]);
        assert_eq!((a - b * 2.0).0, [-3.0, 3.0, -15.0, 2.25]);
        assert_eq!((-(a * b)).0, [-2.0, -2.0, 27.0, 0.25]);
        assert_eq!(b.recip().0[1], 2.0);
        assert!(a.sqrt().0[2].is_nan() && a.sqrt().0[1] == 2.0);
        assert_eq!(a.clamp(0.0, 1.0).0, [1.0, 1.0, 0.0, 0.25]);
        assert_eq!(a.equals(a.clamp(0.0, 1.0)).0, [1.0, 0.0, 0.0, 1.0]);
        assert_eq!(a.choose(1.0, b, Wide::ZERO).0, [2.0, 0.5, 0.0, 0.0]);
        assert_eq!(Wide::lane(&[a, b], 2), [-9.0, 3.0]);
    }
}
