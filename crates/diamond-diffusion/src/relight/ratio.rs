//! The ratio of a picture to its prediction as something to diffuse.

/// Added to both radiances, so that the ratio of two dark pixels is about 1; a white surface that faces a light has a radiance of
/// about ⅓ to 1.
const GUARD: f32 = 0.02;

/// What the logarithm of a ratio is divided by, so that values to diffuse have a deviation of about 1: shading is wrong by a factor of 1.6 in the mean.
const RANGE: f32 = 0.5;

/// ln((picture + g)/(predicted + g)) of linear radiances.
pub(super) fn log_ratio(predicted: f32, picture: f32) -> f32 {
    libm::logf((picture.max(0.0) + GUARD) / (predicted.max(0.0) + GUARD))
}

/// 2·ln((picture + g)/(predicted + g)) of linear radiances, both at least 0.
/// `[eq:light-ratio]`
pub fn encode_ratio(predicted: f32, picture: f32) -> f32 {
    log_ratio(predicted, picture) / RANGE
}

/// The radiance that [`encode_ratio`] was given as picture; at least 0.
/// `[eq:light-ratio]`
pub fn decode_ratio(predicted: f32, ratio: f32) -> f32 {
    ((predicted.max(0.0) + GUARD) * libm::expf(ratio * RANGE) - GUARD).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// [eq:light-ratio]
    #[test]
    fn ratios_go_there_and_back() {
        for source in [0.0f32, 0.01, 0.4, 3.0] {
            assert_eq!(encode_ratio(source, source), 0.0);
            assert!((decode_ratio(source, 0.0) - source).abs() < 1e-6);
            for target in [0.0f32, 0.02, 0.7, 5.0] {
                let back = decode_ratio(source, encode_ratio(source, target));
                assert!((back - target).abs() < 1e-5 * (1.0 + target), "{source} {target} {back}");
            }
        }
        // By hand: 2·ln(1.02/0.02).
        assert!((encode_ratio(0.0, 1.0) - 2.0 * 51f32.ln()).abs() < 1e-5);
        assert_eq!(decode_ratio(0.0, -1.0), 0.0);
    }
}
