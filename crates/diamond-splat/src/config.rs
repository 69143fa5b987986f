//! Settings of the rasteriser: thresholds of the compositing rule and the kind of alpha cut-off.
use crate::SplatError;

/// What happens to alphas near the threshold `min_alpha`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Cutoff {
    /// Alphas below the threshold are skipped, alphas above `max_alpha` are clamped: the published rule, which jumps.
    #[default]
    Hard,
    /// A C¹ stand-in, so that derivatives exist everywhere: see `rasterize`. For tests only.
    Smooth,
}

/// Settings of the rasteriser.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RasterConfig {
    /// Variance added to both screen axes (anti-aliasing low-pass), px².
    pub low_pass: f32,
    /// Upper bound of a single alpha, below 1.
    pub max_alpha: f32,
    /// Alphas below this are skipped; above 0.
    pub min_alpha: f32,
    /// A pixel stops before the Gaussian that would bring its transmittance to this or below; above 0.
    pub min_transmittance: f32,
    /// Gaussians whose centre lies at this view-space z or nearer are culled, scene units; above 0.
    pub near: f32,
    /// What happens at the alpha threshold.
    pub cutoff: Cutoff,
    /// Whether [`RasterStats::blended_pairs`](crate::RasterStats::blended_pairs) is counted, which costs a few per cent.
    pub count_blended: bool,
}

impl Default for RasterConfig {
    fn default() -> Self {
        Self {
            low_pass: 0.3,
            max_alpha: 0.99,
            min_alpha: 1.0 / 255.0,
            min_transmittance: 1e-4,
            near: 0.2,
            cutoff: Cutoff::Hard,
            count_blended: false,
        }
    }
}

/// Lower bound of every setting that something is divided by, or whose reciprocal must stay finite.
const SMALLEST: f32 = 1e-6;

impl RasterConfig {
    /// `Err` unless every setting is in its range.
    pub fn validate(&self) -> Result<(), SplatError> {
        let check = |what, value: f32, low: f32, high: f32, expected| {
            if !value.is_finite() {
                return Err(SplatError::NonFinite { what, index: 0 });
            }
            if value < low || value > high {
                return Err(SplatError::Range { what, index: 0, expected, found: value });
            }
            Ok(())
        };
        check("RasterConfig::low_pass", self.low_pass, 1e-3, 1e4, "[0.001, 10000] px²")?;
        check("RasterConfig::max_alpha", self.max_alpha, SMALLEST, 0.9999, "[1e-6, 0.9999]")?;
        check("RasterConfig::min_alpha", self.min_alpha, SMALLEST, 0.5, "[1e-6, 0.5]")?;
        check("RasterConfig::min_transmittance", self.min_transmittance, SMALLEST, 0.5, "[1e-6, 0.5]")?;
        check("RasterConfig::near", self.near, SMALLEST, f32::MAX, "[1e-6, ∞) scene units")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid_and_nonsense_is_not() {
        assert_eq!(RasterConfig::default().validate(), Ok(()));
        assert!(RasterConfig { max_alpha: 1.0, ..Default::default() }.validate().is_err());
        assert!(RasterConfig { near: f32::NAN, ..Default::default() }.validate().is_err());
        assert!(RasterConfig { min_transmittance: 0.0, ..Default::default() }.validate().is_err());
    }
}
