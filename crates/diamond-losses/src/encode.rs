//! Display encoding of whole images on vectors, and what it costs a picture to be off there.
//!
//! The same curves as [`Transfer::encode`], with the power by polynomial: 4e-7 relative, three times as fast as the
//! standard library's. What is encoded here and what is encoded there may differ in last bits.
use diamond_image::{Image, Transfer};
use diamond_simd::{Lanes, Level, Simd, WithSimd, root_2_2, root_2_4};

/// Linear radiance below which sRGB is straight.
const SRGB_STRAIGHT: f32 = 0.003_130_8;
/// γ 2.2 is infinitely steep at 0; below this its slope is that at this radiance, as in [`Transfer::encode_pull`].
const GAMMA_SLOPE_FLOOR: f32 = 1e-6;
/// 1e-6^(1/2.2 − 1)/2.2.
const GAMMA_STEEPEST: f32 = 851.7352;

/// Stored values of linear ones `[eq:transfer]`.
#[inline(always)]
pub(crate) fn encode<S: Simd>(space: Transfer, linear: Lanes<S>) -> Lanes<S> {
    let v = linear.abs();
    match space {
        Transfer::Linear => linear,
        Transfer::Srgb => {
            let curved = root_2_4(v).mul_add(v.same(1.055), v.same(-0.055));
            v.le(v.same(SRGB_STRAIGHT)).select(v * 12.92, curved).copysign(linear)
        }
        Transfer::Gamma22 => root_2_2(v).copysign(linear),
    }
}

/// Pullback of [`encode`] where the stored value is at hand, which saves the power: the slope of a power law with exponent
/// 1/γ is (stored + offset)/(γ·linear). Cut to the range of finite numbers. `[eq:transfer]`
#[inline(always)]
pub(crate) fn encode_pull<S: Simd>(
    space: Transfer,
    linear: Lanes<S>,
    stored: Lanes<S>,
    d_stored: Lanes<S>,
) -> Lanes<S> {
    let (v, stored) = (linear.abs(), stored.abs());
    let slope = match space {
        Transfer::Linear => return d_stored,
        Transfer::Srgb => {
            let curved = (stored + 0.055) / (v.max(v.same(SRGB_STRAIGHT)) * 2.4);
            v.le(v.same(SRGB_STRAIGHT)).select(v.same(12.92), curved)
        }
        Transfer::Gamma22 => {
            let curved = stored / (v.max(v.same(GAMMA_SLOPE_FLOOR)) * 2.2);
            v.lt(v.same(GAMMA_SLOPE_FLOOR)).select(v.same(GAMMA_STEEPEST), curved)
        }
    };
    // Where the divisor overflows the slope is 0 to any precision.
    (d_stored * slope).clamp(f32::MIN, f32::MAX)
}

struct Encode<'a> {
    space: Transfer,
    linear: &'a [f32],
    stored: &'a mut [f32],
}

impl WithSimd for Encode<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let mut from = self.linear.chunks_exact(S::F32_LANES);
        let mut to = self.stored.chunks_exact_mut(S::F32_LANES);
        for (from, to) in (&mut from).zip(&mut to) {
            encode(self.space, Lanes::load(s, from)).store(to);
        }
        encode(self.space, Lanes::load_partial(s, from.remainder())).store_partial(to.into_remainder());
    }
}

/// Linear radiance → stored values, as [`Transfer::encode_image`] to 4e-7.
pub fn encode_image(space: Transfer, linear: &Image) -> Image {
    let mut stored = linear.clone();
    if space != Transfer::Linear {
        Level::current().dispatch(Encode { space, linear: linear.data(), stored: stored.data_mut() });
    }
    stored
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::{Dual, Real};

    struct Both<'a>(Transfer, &'a [f32], &'a mut [f32], &'a mut [f32]);

    impl WithSimd for Both<'_> {
        type Output = ();
        #[inline(always)]
        fn with_simd<S: Simd>(self, s: S) {
            for ((x, y), d) in
                self.1.chunks(S::F32_LANES).zip(self.2.chunks_mut(S::F32_LANES)).zip(self.3.chunks_mut(S::F32_LANES))
            {
                let x = Lanes::load_partial(s, x);
                let stored = encode(self.0, x);
                stored.store_partial(y);
                encode_pull(self.0, x, stored, x.same(1.5)).store_partial(d);
            }
        }
    }

    fn oracle(space: Transfer, v: Dual) -> Dual {
        match space {
            Transfer::Linear => v,
            Transfer::Srgb => diamond_testkit::image::srgb_encode(v),
            Transfer::Gamma22 => v.powf(1.0 / 2.2),
        }
    }

    /// `[eq:transfer]`: value and slope against dual numbers, at every width.
    #[test]
    fn encoding_and_its_slope_agree_with_dual_numbers_at_every_width() {
        let points: Vec<f32> = (0..20_000).map(|i| (i as f32 / 20_000.0 * 27.0 - 20.0).exp2()).collect();
        for space in [Transfer::Linear, Transfer::Srgb, Transfer::Gamma22] {
            let mut fused: Option<(Vec<f32>, Vec<f32>)> = None;
            for level in Level::testable() {
                let (mut y, mut d) = (vec![0.0; points.len()], vec![0.0; points.len()]);
                level.dispatch(Both(space, &points, &mut y, &mut d));
                for ((&x, &y), &d) in points.iter().zip(&y).zip(&d) {
                    // On the bend of sRGB the two branches meet to five digits only.
                    let bend = space == Transfer::Srgb && (x - SRGB_STRAIGHT).abs() < 1e-6;
                    let tolerance = if bend { 1e-3 } else { 5e-7 };
                    let expected = oracle(space, Dual::new(f64::from(x), 1.0));
                    let error = (f64::from(y) - expected.v).abs() / expected.v;
                    assert!(error < tolerance, "{space:?} {x}: {y} {}", expected.v);
                    let error = (f64::from(d) / 1.5 - expected.d).abs() / expected.d;
                    assert!(bend || error < 1e-6 || x < GAMMA_SLOPE_FLOOR, "{space:?} {x}: {d} {}", expected.d);
                }
                if level.is_fused() {
                    let first = fused.get_or_insert_with(|| (y.clone(), d.clone()));
                    assert!(*first == (y, d), "{space:?} {level:?}");
                }
            }
        }
    }

    #[test]
    fn odd_extreme_and_the_same_as_single_numbers() {
        let values = [0.0, -0.0, 1e-9, -0.003, 0.0039, 0.0041, -0.3, 0.5, 1.0, 80.0, -1e30, f32::MAX, f32::MIN];
        let linear = Image::from_vec(13, 1, 1, values.to_vec()).unwrap();
        for space in [Transfer::Linear, Transfer::Srgb, Transfer::Gamma22] {
            let stored = encode_image(space, &linear);
            for (&v, &s) in values.iter().zip(stored.data()) {
                let expected = space.encode(v);
                assert!(
                    s.is_finite() && (s - expected).abs() <= 2e-6 * expected.abs(),
                    "{space:?} {v}: {s} {expected}"
                );
                assert!((Transfer::Gamma22.encode_pull(0.0, 1.0) - GAMMA_STEEPEST).abs() < 0.01);
            }
        }
    }
}
