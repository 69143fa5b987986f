//! Which channel follows the light most closely, and how it is made to follow it more closely still.
//!
//! Channels that are absorbed more scatter less far. What a channel that scatters far shows is mostly the glow that all
//! channels share; less some of it, the sharp channel's shading is that of a less translucent body.
use crate::normal_fit::median;
use diamond_image::Image;

/// What was chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Channels {
    /// The channel whose images vary most with light.
    pub sharp: usize,
    /// The one whose images vary least; the same where there is but one.
    pub soft: usize,
}

/// Picks the channels by the median over pixels of standard deviation over mean, taken over lights. `of(pixel, light)` is
/// brightness over irradiance, one value per channel.
pub(crate) fn pick(pixels: usize, lights: usize, channels: usize, of: impl Fn(usize, usize, usize) -> f32) -> Channels {
    let variation = |c: usize| {
        let mut values: Vec<f32> = (0..pixels)
            .filter_map(|p| {
                let mean = (0..lights).map(|l| of(p, l, c)).sum::<f32>() / lights as f32;
                let square = (0..lights).map(|l| (of(p, l, c) - mean).powi(2)).sum::<f32>() / lights as f32;
                (mean > 0.0).then(|| square.sqrt() / mean)
            })
            .collect();
        median(&mut values)
    };
    let all: Vec<f32> = (0..channels).map(variation).collect();
    let mut found = Channels { sharp: 0, soft: 0 };
    for (c, v) in all.iter().enumerate() {
        if *v > all[found.sharp] {
            found.sharp = c;
        }
        if *v < all[found.soft] {
            found.soft = c;
        }
    }
    found
}

/// `[eq:sharpened-shading]` max(0, s/ŝ − κ·g/ĝ)/(1 − κ): the sharp channel less κ of the soft one, each over its median.
pub(crate) fn sharpened(sharp: f32, soft: f32, medians: [f32; 2], share: f32) -> f32 {
    ((sharp / medians[0] - share * soft / medians[1]) / (1.0 - share)).max(0.0)
}

/// Median over the object's pixels and lights of each of two channels, at least 10⁻¹² of the largest value.
pub(crate) fn medians(values: impl Fn(usize) -> Vec<f32>, channels: Channels) -> [f32; 2] {
    [channels.sharp, channels.soft].map(|c| median(&mut values(c)))
}

/// `Err` with the place if an image holds NaN or infinity.
pub(crate) fn first_non_finite(image: &Image) -> Option<String> {
    image.first_non_finite().map(|(x, y, c)| format!("column {x}, row {y}, channel {c}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// [eq:sharpened-shading]: shading plus a glow that the soft channel shows more of; less some of it, the shading is
    /// nearer.
    #[test]
    fn a_shared_glow_is_taken_off() {
        let shading = [0.0, 0.2, 0.6, 1.0, 0.9, 0.1];
        let glow = [0.5, 0.4, 0.5, 0.6, 0.5, 0.4];
        let sharp = |l: usize| 0.7 * shading[l] + 0.3 * glow[l];
        let soft = |l: usize| 0.3 * shading[l] + 0.7 * glow[l];
        let of = |_: usize, l: usize, c: usize| if c == 1 { sharp(l) } else { soft(l) };
        let channels = pick(1, 6, 3, of);
        assert_eq!(channels, Channels { sharp: 1, soft: 0 });
        let m = medians(|c| (0..6).map(|l| of(0, l, c)).collect(), channels);
        let contrast = |v: &dyn Fn(usize) -> f32| v(0) / v(3);
        let plain = contrast(&sharp);
        let better = contrast(&|l| sharpened(sharp(l), soft(l), m, 0.4));
        assert!(better < 0.5 * plain, "{better} {plain}");
        // A body that is grey stays what it is.
        assert!((sharpened(0.3, 0.3, [0.5, 0.5], 0.6) - 0.6).abs() < 1e-6);
    }
}
