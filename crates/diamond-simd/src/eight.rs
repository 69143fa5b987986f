//! Eight numbers at once whatever the instruction set, without fused operations: the same bits everywhere.
//!
//! For data that comes in groups of eight (the boxes of a node, the triangles of a leaf), where the number of lanes cannot follow the
//! machine. Comparisons give one bit for each number. AVX2 does each operation in one instruction, AVX-512 uses that too; elsewhere the
//! operations are loops that the compiler turns into what there is.
//!
//! ```
//! use diamond_simd::{Eight, Level, Octet, WithEight};
//!
//! struct Below<'a>(&'a [f32; 8], f32);
//! impl WithEight for Below<'_> {
//!     type Output = u32;
//!     #[inline(always)]
//!     fn with_eight<E: Eight>(self, e: E) -> u32 {
//!         (Octet::load(e, self.0) * 2.0).at_most(Octet::splat(e, self.1))
//!     }
//! }
//! let values = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, f32::NAN];
//! assert_eq!(Level::current().dispatch_eight(Below(&values, 4.0)), 0b111);
//! ```
use crate::Level;
use crate::level::Kind;
use std::ops::{Add, Div, Mul, Sub};

/// The instructions for eight numbers.
pub trait Eight: Copy {
    /// Eight numbers.
    type V: Copy;
    /// From memory.
    fn load(self, from: &[f32; 8]) -> Self::V;
    /// To memory.
    fn store(self, v: Self::V) -> [f32; 8];
    /// The same number eight times.
    fn splat(self, value: f32) -> Self::V;
    /// Sums.
    fn add(self, a: Self::V, b: Self::V) -> Self::V;
    /// Differences.
    fn sub(self, a: Self::V, b: Self::V) -> Self::V;
    /// Products.
    fn mul(self, a: Self::V, b: Self::V) -> Self::V;
    /// Quotients.
    fn div(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a` where it is smaller, else (with NaN, too) `b`.
    fn smaller(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a` where it is larger, else (with NaN, too) `b`.
    fn larger(self, a: Self::V, b: Self::V) -> Self::V;
    /// Bit i: whether a ≤ b for number i.
    fn at_most(self, a: Self::V, b: Self::V) -> u32;
    /// Bit i: whether a = b for number i.
    fn equal(self, a: Self::V, b: Self::V) -> u32;
}

/// A kernel for eight numbers.
pub trait WithEight {
    /// What it returns.
    type Output;
    /// The kernel; must be `#[inline(always)]`.
    fn with_eight<E: Eight>(self, e: E) -> Self::Output;
}

/// Loops.
#[derive(Debug, Clone, Copy)]
struct Loops;

#[inline(always)]
fn each(f: impl Fn(usize) -> f32) -> [f32; 8] {
    std::array::from_fn(f)
}

#[inline(always)]
fn bits(test: impl Fn(usize) -> bool) -> u32 {
    (0..8).fold(0, |bits, i| bits | u32::from(test(i)) << i)
}

impl Eight for Loops {
    type V = [f32; 8];
    #[inline(always)]
    fn load(self, from: &[f32; 8]) -> [f32; 8] {
        *from
    }
    #[inline(always)]
    fn store(self, v: [f32; 8]) -> [f32; 8] {
        v
    }
    #[inline(always)]
    fn splat(self, value: f32) -> [f32; 8] {
        [value; 8]
    }
    #[inline(always)]
    fn add(self, a: [f32; 8], b: [f32; 8]) -> [f32; 8] {
        each(|i| a[i] + b[i])
    }
    #[inline(always)]
    fn sub(self, a: [f32; 8], b: [f32; 8]) -> [f32; 8] {
        each(|i| a[i] - b[i])
    }
    #[inline(always)]
    fn mul(self, a: [f32; 8], b: [f32; 8]) -> [f32; 8] {
        each(|i| a[i] * b[i])
    }
    #[inline(always)]
    fn div(self, a: [f32; 8], b: [f32; 8]) -> [f32; 8] {
        each(|i| a[i] / b[i])
    }
    #[inline(always)]
    fn smaller(self, a: [f32; 8], b: [f32; 8]) -> [f32; 8] {
        each(|i| if a[i] < b[i] { a[i] } else { b[i] })
    }
    #[inline(always)]
    fn larger(self, a: [f32; 8], b: [f32; 8]) -> [f32; 8] {
        each(|i| if a[i] > b[i] { a[i] } else { b[i] })
    }
    #[inline(always)]
    fn at_most(self, a: [f32; 8], b: [f32; 8]) -> u32 {
        bits(|i| a[i] <= b[i])
    }
    #[inline(always)]
    fn equal(self, a: [f32; 8], b: [f32; 8]) -> u32 {
        bits(|i| a[i] == b[i])
    }
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use super::{Eight, WithEight};
    use pulp::x86::V3;
    use std::arch::x86_64::{__m256, _CMP_EQ_OQ, _CMP_LE_OQ};

    impl Eight for V3 {
        type V = __m256;
        #[inline(always)]
        fn load(self, from: &[f32; 8]) -> __m256 {
            pulp::cast(*from)
        }
        #[inline(always)]
        fn store(self, v: __m256) -> [f32; 8] {
            pulp::cast(v)
        }
        #[inline(always)]
        fn splat(self, value: f32) -> __m256 {
            self.avx._mm256_set1_ps(value)
        }
        #[inline(always)]
        fn add(self, a: __m256, b: __m256) -> __m256 {
            self.avx._mm256_add_ps(a, b)
        }
        #[inline(always)]
        fn sub(self, a: __m256, b: __m256) -> __m256 {
            self.avx._mm256_sub_ps(a, b)
        }
        #[inline(always)]
        fn mul(self, a: __m256, b: __m256) -> __m256 {
            self.avx._mm256_mul_ps(a, b)
        }
        #[inline(always)]
        fn div(self, a: __m256, b: __m256) -> __m256 {
            self.avx._mm256_div_ps(a, b)
        }
        #[inline(always)]
        fn smaller(self, a: __m256, b: __m256) -> __m256 {
            self.avx._mm256_min_ps(a, b)
        }
        #[inline(always)]
        fn larger(self, a: __m256, b: __m256) -> __m256 {
            self.avx._mm256_max_ps(a, b)
        }
        #[inline(always)]
        fn at_most(self, a: __m256, b: __m256) -> u32 {
            self.avx._mm256_movemask_ps(self.avx._mm256_cmp_ps::<_CMP_LE_OQ>(a, b)) as u32
        }
        #[inline(always)]
        fn equal(self, a: __m256, b: __m256) -> u32 {
            self.avx._mm256_movemask_ps(self.avx._mm256_cmp_ps::<_CMP_EQ_OQ>(a, b)) as u32
        }
    }

    /// A kernel with its instructions.
    pub(super) struct Call<Op>(pub V3, pub Op);

    impl<Op: WithEight> pulp::NullaryFnOnce for Call<Op> {
        type Output = Op::Output;
        #[inline(always)]
        fn call(self) -> Op::Output {
            self.1.with_eight(self.0)
        }
    }
}

impl Level {
    /// Runs a kernel for eight numbers.
    #[inline]
    pub fn dispatch_eight<Op: WithEight>(self, op: Op) -> Op::Output {
        match self.kind() {
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2Fma(simd) => simd.vectorize(avx2::Call(simd, op)),
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512(simd) => simd.vectorize(avx2::Call(*simd, op)),
            _ => op.with_eight(Loops),
        }
    }
}

/// Eight numbers with operators.
#[derive(Debug)]
pub struct Octet<E: Eight> {
    e: E,
    v: E::V,
}

impl<E: Eight> Clone for Octet<E> {
    #[inline(always)]
    fn clone(&self) -> Self {
        *self
    }
}

impl<E: Eight> Copy for Octet<E> {}

impl<E: Eight> Octet<E> {
    /// From memory.
    #[inline(always)]
    pub fn load(e: E, from: &[f32; 8]) -> Self {
        Self { e, v: e.load(from) }
    }

    /// To memory.
    #[inline(always)]
    pub fn store(self) -> [f32; 8] {
        self.e.store(self.v)
    }

    /// The same number eight times.
    #[inline(always)]
    pub fn splat(e: E, value: f32) -> Self {
        Self { e, v: e.splat(value) }
    }

    /// These where they are smaller than the others, else (with NaN, too) the others.
    #[inline(always)]
    pub fn smaller(self, other: Self) -> Self {
        Self { e: self.e, v: self.e.smaller(self.v, other.v) }
    }

    /// These where they are larger than the others, else (with NaN, too) the others.
    #[inline(always)]
    pub fn larger(self, other: Self) -> Self {
        Self { e: self.e, v: self.e.larger(self.v, other.v) }
    }

    /// Bit i: whether number i is at most the other.
    #[inline(always)]
    pub fn at_most(self, other: Self) -> u32 {
        self.e.at_most(self.v, other.v)
    }

    /// Bit i: whether number i equals the other.
    #[inline(always)]
    pub fn equal(self, other: Self) -> u32 {
        self.e.equal(self.v, other.v)
    }
}

macro_rules! operator {
    ($name:ident, $function:ident) => {
        impl<E: Eight> $name for Octet<E> {
            type Output = Self;
            #[inline(always)]
            fn $function(self, other: Self) -> Self {
                Self { e: self.e, v: self.e.$function(self.v, other.v) }
            }
        }
        impl<E: Eight> $name<f32> for Octet<E> {
            type Output = Self;
            #[inline(always)]
            fn $function(self, other: f32) -> Self {
                Self { e: self.e, v: self.e.$function(self.v, self.e.splat(other)) }
            }
        }
    };
}

operator!(Add, add);
operator!(Sub, sub);
operator!(Mul, mul);
operator!(Div, div);

#[cfg(test)]
mod tests {
    use super::*;

    struct All<'a>(&'a [f32; 8], &'a [f32; 8]);

    impl WithEight for All<'_> {
        type Output = (Vec<u32>, [u32; 2]);
        #[inline(always)]
        fn with_eight<E: Eight>(self, e: E) -> Self::Output {
            let (a, b) = (Octet::load(e, self.0), Octet::load(e, self.1));
            let results = [a + b, a - b, a * b, a / b, a.smaller(b), a.larger(b), a * b + 1.0, a - 2.0];
            let numbers = results.into_iter().flat_map(|r| r.store().map(f32::to_bits)).collect();
            (numbers, [a.at_most(b), a.equal(b)])
        }
    }

    #[test]
    fn every_instruction_set_gives_the_bits_of_single_numbers() {
        let a: [f32; 8] = [0.1, -3.7, 1e30, 5.0, -0.0, f32::INFINITY, 1.0000001, 7.5];
        let b: [f32; 8] = [0.3, 1e-3, 1e30, -5.0, 0.0, 2.0, 1.0000002, f32::INFINITY];
        for level in Level::testable() {
            let (numbers, [at_most, equal]) = level.dispatch_eight(All(&a, &b));
            for i in 0..8 {
                let (x, y) = (a[i], b[i]);
                let smaller = if x < y { x } else { y };
                let larger = if x > y { x } else { y };
                let expected = [x + y, x - y, x * y, x / y, smaller, larger, x * y + 1.0, x - 2.0];
                for (k, expected) in expected.into_iter().enumerate() {
                    assert_eq!(numbers[8 * k + i], expected.to_bits(), "{level:?}, operation {k} of {x} and {y}");
                }
                assert_eq!((at_most >> i & 1 == 1, equal >> i & 1 == 1), (x <= y, x == y));
            }
        }
        let nan = [f32::NAN; 8];
        assert!(Level::testable().into_iter().all(|level| level.dispatch_eight(All(&nan, &a)).1 == [0, 0]));
    }
}
