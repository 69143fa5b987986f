//! The G-buffer: what a rasteriser of feature channels hands to the shader, pixel by pixel.
//!
//! A splat rasteriser blends: each feature arrives as Σ w·f over the splats of a pixel, together with the opacity
//! O = Σ w and the depth Σ w·z. Shading wants the features of the surface, not of its coverage, so they are divided by O
//! first, and the shaded colour is multiplied by O at the end.
use crate::ShadingError;
use crate::error::check_image;
use crate::number::Number;
use diamond_camera::Camera;
use diamond_image::Image;

/// Which feature lies in which channel.
pub mod channel {
    use std::ops::Range;

    /// Base colour, linear RGB in `[0, 1]`.
    pub const BASE_COLOR: Range<usize> = 0..3;
    /// Perceptual roughness in `[0, 1]`.
    pub const ROUGHNESS: usize = 3;
    /// Metalness in `[0, 1]`.
    pub const METALNESS: usize = 4;
    /// Subsurfaceness in `[0, 1]`: the share of the residual.
    pub const SUBSURFACENESS: usize = 5;
    /// Normal in world axes; any length.
    pub const NORMAL: Range<usize> = 6..9;
    /// Subsurface residual, linear RGB. Depends on the light.
    pub const RESIDUAL: Range<usize> = 9..12;
    /// Learned incident light, a factor of the light's intensity. Depends on the light.
    pub const INCIDENT: usize = 12;
    /// Visibility of the light, in `[0, 1]`. Depends on the light.
    pub const VISIBILITY: usize = 13;
    /// Number of channels.
    pub const COUNT: usize = 14;
    /// The channels that do not depend on the light: one rasterisation serves all lights of a view.
    pub const GEOMETRY: Range<usize> = 0..9;
    /// The channels that depend on the light.
    pub const TRANSPORT: Range<usize> = 9..14;
}

/// Pixels of less opacity than this are empty: they are not shaded, which leaves out at most this share of a pixel's
/// colour, and nothing is ever divided by less.
pub const MIN_OPACITY: f32 = 1e-5;

/// Blended feature channels of one view.
#[derive(Debug, Clone, Copy)]
pub struct GBuffer<'a> {
    /// Σ w·f, [`channel::COUNT`] channels (see [`channel`]).
    pub features: &'a Image,
    /// O = Σ w in `[0, 1]`, one channel.
    pub opacity: &'a Image,
    /// Σ w·z of view-space z, scene units, one channel.
    pub depth: &'a Image,
}

/// Gradient of a scalar with respect to a [`GBuffer`], same shapes.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct GBufferGrad {
    /// With respect to Σ w·f.
    pub features: Image,
    /// With respect to O.
    pub opacity: Image,
    /// With respect to Σ w·z.
    pub depth: Image,
}

/// One pixel or many, divided by their opacity.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Blended<T: Number, const N: usize> {
    /// Features of the surface; 0 where it is empty.
    pub features: [T; N],
    /// O; 1 where it is empty.
    pub opacity: T,
    /// View-space z of the surface, scene units; 0 where it is empty.
    pub depth: T,
    /// What the features were multiplied by: 1/O, or 1 where they are not divided.
    pub weight: T,
    /// Where the pixel is not empty.
    pub covered: T::Mask,
}

impl<T: Number, const N: usize> Blended<T, N> {
    /// Divides a pixel's sums by its opacity. The depth is always divided, the features if `normalise`.
    /// `[eq:gbuffer-normalise]`
    #[inline(always)]
    pub fn new(sums: &[T; N], opacity: T, depth: T, normalise: bool) -> Self {
        let covered = opacity.reaches(MIN_OPACITY);
        let opacity = opacity.or_where_not(covered, opacity.same(1.0));
        let weight = if normalise { opacity.inverse() } else { opacity.same(1.0) };
        let mut features = *sums;
        for f in &mut features {
            *f = (*f * weight).only_where(covered);
        }
        Self { features, opacity, depth: (depth / opacity).only_where(covered), weight, covered }
    }

    /// Pullback of [`Blended::new`]: `(d_sums, d_opacity, d_depth)` of the sums, where `d_opacity` on entry is the
    /// cotangent of the opacity from its other uses. Zero where the pixel is empty.
    /// `[eq:gbuffer-normalise]`
    #[inline(always)]
    pub fn pull(&self, d_features: &[T; N], d_opacity: T, d_depth: T, normalise: bool) -> ([T; N], T, T) {
        let mut d_inverse_opacity = d_depth * self.depth;
        let mut d_sums = *d_features;
        for i in 0..N {
            if normalise {
                d_inverse_opacity = d_inverse_opacity + d_features[i] * self.features[i];
            }
            d_sums[i] = (d_features[i] * self.weight).only_where(self.covered);
        }
        let inverse = self.opacity.inverse();
        let d_opacity = (d_opacity - d_inverse_opacity * inverse).only_where(self.covered);
        (d_sums, d_opacity, (d_depth * inverse).only_where(self.covered))
    }
}

impl GBuffer<'_> {
    /// `Ok((width, height))` if all images have the camera's size, `features` has `channels` channels and the others one.
    pub(crate) fn check(&self, camera: &Camera, channels: usize) -> Result<(usize, usize), ShadingError> {
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        check_image("GBuffer::features", self.features, (width, height, channels))?;
        check_image("GBuffer::opacity", self.opacity, (width, height, 1))?;
        check_image("GBuffer::depth", self.depth, (width, height, 1))?;
        Ok((width, height))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::adjoint::worst_relative;
    use diamond_testkit::strategies::{finite, values};
    use diamond_testkit::{Dual, vjp};
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]

        /// `[eq:gbuffer-normalise]`
        #[test]
        fn normalisation_agrees_with_the_oracle(
            sums in values(3, -1.0..1.0), opacity in finite(1e-3..1.0), depth in finite(0.1..2.0),
            d in values(5, -1.0..1.0), normalise in prop::bool::ANY,
        ) {
            let sums: [f32; 3] = sums.try_into().expect("three");
            let oracle = |x: &[Dual]| {
                let f = |i: usize| if normalise { x[i] / x[3] } else { x[i] };
                vec![f(0), f(1), f(2), x[3], x[4] / x[3]]
            };
            let x: Vec<f64> = sums.iter().chain([&opacity, &depth]).map(|&v| f64::from(v)).collect();
            let cotangent: Vec<f64> = d.iter().map(|&v| f64::from(v)).collect();
            let expected = vjp(oracle, &x, &cotangent);
            let blended = Blended::new(&sums, opacity, depth, normalise);
            let (s, o, z) = blended.pull(&[d[0], d[1], d[2]], d[3], d[4], normalise);
            let actual: Vec<f64> = s.iter().chain([&o, &z]).map(|&v| f64::from(v)).collect();
            prop_assert!(worst_relative(&actual, &expected, 1e-2 / f64::from(opacity)) <= 1e-4);
        }
    }

    #[test]
    fn empty_pixels_are_not_shaded() {
        assert!(!Blended::new(&[1.0], 0.0, 1.0, true).covered);
        assert!(!Blended::new(&[1.0], f32::NAN, 1.0, true).covered);
        assert!(Blended::new(&[1.0], MIN_OPACITY, 1.0, true).covered);
    }

    #[test]
    fn the_channels_tile_the_buffer() {
        let mut all: Vec<usize> = channel::BASE_COLOR.collect();
        all.extend([channel::ROUGHNESS, channel::METALNESS, channel::SUBSURFACENESS]);
        all.extend(channel::NORMAL);
        assert_eq!(all, channel::GEOMETRY.collect::<Vec<_>>());
        all.extend(channel::RESIDUAL);
        all.extend([channel::INCIDENT, channel::VISIBILITY]);
        assert_eq!(all, (0..channel::COUNT).collect::<Vec<_>>());
        assert_eq!(channel::TRANSPORT.end, channel::COUNT);
    }
}
