//! Colour transfer between stored values and linear radiance.
//!
//! Files store a curve of the radiance so that few bits suffice; all arithmetic here is on linear radiance. Transfer
//! applies to colour, never to alpha, depth or masks.
//!
//! ```
//! use diamond_image::Transfer;
//! assert!((Transfer::Srgb.decode(0.5) - 0.21404).abs() < 1e-5);
//! assert!((Transfer::Srgb.encode(0.21404) - 0.5).abs() < 1e-5);
//! ```

use crate::Image;

/// How stored values relate to linear radiance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Transfer {
    /// Stored values are linear radiance.
    Linear,
    /// IEC 61966-2-1 (sRGB).
    #[default]
    Srgb,
    /// A pure power law of exponent 2.2.
    Gamma22,
}

/// The slope of encoding γ 2.2 is infinite at 0; it is taken at this radiance below it, where it is about 850. A 16-bit
/// file's smallest step is at 2·10⁻¹¹, an 8-bit file's at 5·10⁻⁶.
const GAMMA_SLOPE_FLOOR: f32 = 1e-6;

impl Transfer {
    /// Stored value → linear radiance. Odd-symmetric below 0, and cut to the largest `f32`, so that any finite input
    /// gives finite output.
    /// `[eq:transfer]`
    pub fn decode(self, stored: f32) -> f32 {
        let v = stored.abs();
        let linear = match self {
            Transfer::Linear => v,
            Transfer::Srgb if v <= 0.04045 => v / 12.92,
            Transfer::Srgb => libm::powf((v + 0.055) / 1.055, 2.4),
            Transfer::Gamma22 => libm::powf(v, 2.2),
        };
        // `min` would turn NaN into a number.
        if linear > f32::MAX { f32::MAX.copysign(stored) } else { linear.copysign(stored) }
    }

    /// Pullback of [`Transfer::decode`]: `d_linear` times the slope at `stored`, which is never negative.
    /// `[eq:transfer]`
    pub fn decode_pull(self, stored: f32, d_linear: f32) -> f32 {
        let v = stored.abs();
        let slope = match self {
            Transfer::Linear => 1.0,
            Transfer::Srgb if v <= 0.04045 => 1.0 / 12.92,
            Transfer::Srgb => 2.4 / 1.055 * libm::powf((v + 0.055) / 1.055, 1.4),
            Transfer::Gamma22 => 2.2 * libm::powf(v, 1.2),
        };
        finite_product(d_linear, slope)
    }

    /// Linear radiance → stored value; the inverse of [`Transfer::decode`].
    /// `[eq:transfer]`
    pub fn encode(self, linear: f32) -> f32 {
        let v = linear.abs();
        let stored = match self {
            Transfer::Linear => v,
            Transfer::Srgb if v <= 0.003_130_8 => v * 12.92,
            Transfer::Srgb => 1.055 * libm::powf(v, 1.0 / 2.4) - 0.055,
            Transfer::Gamma22 => libm::powf(v, 1.0 / 2.2),
        };
        stored.copysign(linear)
    }

    /// Pullback of [`Transfer::encode`]: `d_stored` times the slope at `linear`, which is never negative. The slope of
    /// γ 2.2, infinite at 0, is that at 10⁻⁶ below it.
    /// `[eq:transfer]`
    pub fn encode_pull(self, linear: f32, d_stored: f32) -> f32 {
        let v = linear.abs();
        let slope = match self {
            Transfer::Linear => 1.0,
            Transfer::Srgb if v <= 0.003_130_8 => 12.92,
            Transfer::Srgb => 1.055 / 2.4 * libm::powf(v, 1.0 / 2.4 - 1.0),
            Transfer::Gamma22 => libm::powf(v.max(GAMMA_SLOPE_FLOOR), 1.0 / 2.2 - 1.0) / 2.2,
        };
        finite_product(d_stored, slope)
    }

    /// [`Transfer::decode`] of every value.
    pub fn decode_image(self, stored: &Image) -> Image {
        stored.map(|v| self.decode(v))
    }

    /// [`Transfer::encode`] of every value.
    pub fn encode_image(self, linear: &Image) -> Image {
        linear.map(|v| self.encode(v))
    }
}

/// `d` times a slope, cut to the range of finite `f32` (0 times an overflowed slope is 0); NaN stays NaN.
fn finite_product(d: f32, slope: f32) -> f32 {
    let slope = if slope > f32::MAX { f32::MAX } else { slope };
    (f64::from(d) * f64::from(slope)).clamp(f64::from(f32::MIN), f64::from(f32::MAX)) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::adjoint::relative_error;
    use diamond_testkit::image::{srgb_decode, srgb_encode};
    use diamond_testkit::strategies::{extreme, finite};
    use diamond_testkit::{Dual, Real, gradient};
    use proptest::prelude::*;

    const ALL: [Transfer; 3] = [Transfer::Linear, Transfer::Srgb, Transfer::Gamma22];

    fn oracle_decode<R: Real>(t: Transfer, v: R) -> R {
        match t {
            Transfer::Linear => v,
            Transfer::Srgb => srgb_decode(v),
            Transfer::Gamma22 => v.powf(2.2),
        }
    }

    fn oracle_encode<R: Real>(t: Transfer, v: R) -> R {
        match t {
            Transfer::Linear => v,
            Transfer::Srgb => srgb_encode(v),
            Transfer::Gamma22 => v.powf(1.0 / 2.2),
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// [eq:transfer]: values and slopes against dual numbers, both signs.
        #[test]
        fn transfer_and_its_pullback_agree_with_the_oracle(v in finite(1e-5..2.0), d in finite(-2.0..2.0), negative: bool) {
            // The two pieces of sRGB meet within rounding of the constants; either slope may be meant there.
            prop_assume!((v - 0.04045).abs() > 1e-6 && (v - 0.003_130_8).abs() > 1e-7);
            let signed = if negative { -v } else { v };
            let (x, d64) = (f64::from(v), f64::from(d));
            for t in ALL {
                let sign = f64::from(1f32.copysign(signed));
                let value = relative_error(f64::from(t.decode(signed)), sign * oracle_decode(t, x), 1e-6);
                prop_assert!(value <= 1e-5, "{t:?} decode: {value:e}");
                let value = relative_error(f64::from(t.encode(signed)), sign * oracle_encode(t, x), 1e-6);
                prop_assert!(value <= 1e-5, "{t:?} encode: {value:e}");
                let slope = gradient(|x: &[Dual]| oracle_decode(t, x[0]), &[x])[0];
                let error = relative_error(f64::from(t.decode_pull(signed, d)), d64 * slope, 1e-6);
                prop_assert!(error <= 1e-5, "{t:?} decode_pull: {error:e}");
                let slope = gradient(|x: &[Dual]| oracle_encode(t, x[0]), &[x])[0];
                let error = relative_error(f64::from(t.encode_pull(signed, d)), d64 * slope, 1e-6);
                prop_assert!(error <= 1e-5, "{t:?} encode_pull: {error:e}");
            }
        }

        #[test]
        fn any_finite_value_gives_finite_results(v in extreme(), d in extreme()) {
            for t in ALL {
                prop_assert!(t.decode(v).is_finite() && t.encode(v).is_finite());
                prop_assert!(t.decode_pull(v, d).is_finite() && t.encode_pull(v, d).is_finite());
            }
        }
    }

    #[test]
    fn nan_stays_visible() {
        for t in ALL {
            assert!(t.decode(f32::NAN).is_nan() && t.encode(f32::NAN).is_nan());
            assert!(t.decode_pull(0.5, f32::NAN).is_nan() && t.encode_pull(0.5, f32::NAN).is_nan());
        }
    }

    #[test]
    fn ends_are_exact_and_every_byte_survives() {
        for t in ALL {
            assert_eq!((t.decode(0.0), t.decode(1.0)), (0.0, 1.0));
            assert_eq!(t.encode(0.0), 0.0);
            assert!((t.encode(1.0) - 1.0).abs() < 1e-6);
            for byte in 0..=255u8 {
                let back = t.encode(t.decode(f32::from(byte) / 255.0)) * 255.0;
                assert_eq!(back.round() as u8, byte, "{t:?}");
            }
        }
        let image = Image::filled(2, 1, 3, 0.5);
        assert_eq!(Transfer::Srgb.decode_image(&image).data()[0], Transfer::Srgb.decode(0.5));
        assert_eq!(Transfer::Srgb.encode_image(&image).data()[0], Transfer::Srgb.encode(0.5));
    }
}
