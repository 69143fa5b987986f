//! Sixteen numbers at once on any instruction set, and the sum of sixteen in an order that does not depend on it.
use pulp::Simd;

/// Numbers of a block; the widest vectors have as many.
pub const BLOCK: usize = 16;

/// A block: `[S::f32s; N]` with N = 1 (AVX-512), 2 (AVX2), 4 (NEON) or 16 (portable); see [`with_lanes!`](crate::with_lanes).
pub type Block<S, const N: usize> = [<S as Simd>::f32s; N];

/// Loads sixteen values.
#[inline(always)]
pub fn load_block<S: Simd, const N: usize>(from: &[f32; BLOCK]) -> Block<S, N> {
    let (v, _) = S::as_simd_f32s(from);
    let mut block = [v[0]; N];
    block.copy_from_slice(&v[..N]);
    block
}

/// Stores sixteen values.
#[inline(always)]
pub fn store_block<S: Simd, const N: usize>(to: &mut [f32; BLOCK], values: Block<S, N>) {
    let (v, _) = S::as_mut_simd_f32s(to);
    v[..N].copy_from_slice(&values);
}

/// The sum of sixteen values: halves are added until one is left, at any width.
#[inline(always)]
pub fn sum_block<S: Simd, const N: usize>(values: Block<S, N>) -> f32 {
    let mut lanes = [0.0; BLOCK];
    store_block::<S, N>(&mut lanes, values);
    tree_sum(lanes)
}

/// The sum of sixteen values: `v[i] + v[i + 8]`, then with `i + 4`, `i + 2`, `i + 1`.
#[inline(always)]
pub fn tree_sum(mut v: [f32; BLOCK]) -> f32 {
    let mut half = BLOCK / 2;
    while half > 0 {
        for i in 0..half {
            v[i] += v[i + half];
        }
        half /= 2;
    }
    v[0]
}

/// Whether any value is above 0.
#[inline(always)]
pub fn any_positive<S: Simd, const N: usize>(s: S, values: &Block<S, N>) -> bool {
    let mut largest = values[0];
    for v in &values[1..] {
        largest = s.max_f32s(largest, *v);
    }
    s.reduce_max_f32s(largest) > 0.0
}

/// Runs `$body::<S, N>(s, $args)` with the N that belongs to the instruction set: 16 / lanes.
#[macro_export]
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Level, WithSimd};

    #[inline(always)]
    fn sum<S: Simd, const N: usize>(s: S, values: &[f32; BLOCK]) -> (f32, bool) {
        let block = load_block::<S, N>(values);
        (sum_block::<S, N>(block), any_positive(s, &block))
    }

    struct Sum<'a>(&'a [f32; BLOCK]);

    impl WithSimd for Sum<'_> {
        type Output = (f32, bool);
        #[inline(always)]
        fn with_simd<S: Simd>(self, s: S) -> (f32, bool) {
            with_lanes!(s: S, sum(self.0))
        }
    }

    #[test]
    fn a_sum_has_the_same_bits_at_every_width() {
        let values: [f32; BLOCK] = std::array::from_fn(|i| (i as f32 * 1.7).sin() * 10f32.powi(i as i32 % 7 - 3));
        let expected = tree_sum(values);
        let exact: f64 = values.iter().map(|&v| f64::from(v)).sum();
        assert!((f64::from(expected) - exact).abs() < 1e-3);
        for level in Level::testable() {
            assert_eq!(level.dispatch(Sum(&values)), (expected, true), "{level:?}");
            assert!(!level.dispatch(Sum(&[-1.0; BLOCK])).1, "{level:?}");
        }
    }
}
