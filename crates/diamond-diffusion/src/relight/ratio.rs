//! The ratio of two pictures as something to diffuse.

/// Added to both radiances, so that the ratio of two dark pixels is about 1; a white surface that faces a light has a radiance of
/// about ⅓ to 1.
const GUARD: f32 = 0.02;

/// What the logarithm of a ratio is divided by: from black to 1 it is 3.9.
const RANGE: f32 = 3.0;

/// ln((target + g)/(source + g))/3 of linear radiances, both at least 0.
/// `[eq:light-ratio]`
pub fn encode_ratio(source: f32, target: f32) -> f32 {
    libm::logf((target.max(0.0) + GUARD) / (source.max(0.0) + GUARD)) / RANGE
}

/// The radiance that [`encode_ratio`] was given as target; at least 0.
/// `[eq:light-ratio]`
pub fn decode_ratio(source: f32, ratio: f32) -> f32 {
    ((source.max(0.0) + GUARD) * libm::expf(ratio * RANGE) - GUARD).max(0.0)
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
        // By hand: ln(1.02/0.02)/3.
        assert!((encode_ratio(0.0, 1.0) - 51f32.ln() / 3.0).abs() < 1e-6);
        assert_eq!(decode_ratio(0.0, -1.0), 0.0);
    }
}
