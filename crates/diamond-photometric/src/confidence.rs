//! How far a fitted normal is to be believed.
//!
//! Four signs of doubt make an expected error: lights that say little about the direction, few lights, a normal that no
//! surface through its neighbours has, and one that is far from what the silhouette suggests. How much each counts was
//! fitted to the errors on four captures of wax and stone with known geometry, three views each under 16, 8 and 3 lights; one
//! of them comes from another renderer. Confidence falls where the expected error rises, and nothing more is promised: it is
//! an order, calibrated on the average of such objects, not a bound.
use crate::normal_fit::Fitted;
use glam::Vec3;

/// Expected error at which the confidence is one half, degrees.
pub const HALF_CONFIDENCE_DEGREES: f32 = 12.0;

/// Logarithm of the expected error without doubts, and what each doubt adds.
const WITHOUT: f32 = 2.15;
const OF_INFORMATION: f32 = -0.13;
const OF_RELIEF: f32 = 1.45;
const OF_SILHOUETTE: f32 = 0.68;
const OF_FEW_LIGHTS: f32 = 0.96;
/// Information below this is as good as none.
const LEAST_INFORMATION: f32 = 0.1;
/// Taken off the error, so that the fit is not drawn to the smallest ones; degrees.
const OFFSET: f32 = 2.0;

/// What speaks against a normal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Doubts {
    /// Σ over lights of the information about the less certain direction of the normal (a light that grazes has 1).
    pub information: f32,
    /// Number of lights, at least 1.
    pub lights: usize,
    /// Angle to the normal of the integrated relief, radians.
    pub from_relief: f32,
    /// Angle to the normal of the inflated silhouette, radians.
    pub from_silhouette: f32,
}

impl Doubts {
    /// Of a fitted normal, and those of the relief and the silhouette at its pixel.
    pub(crate) fn of(fitted: &Fitted, lights: usize, normal: Vec3, relief: Vec3, silhouette: Vec3) -> Self {
        Self {
            information: fitted.information * lights as f32,
            lights,
            from_relief: angle(normal, relief),
            from_silhouette: angle(normal, silhouette),
        }
    }

    /// `[eq:normal-doubt]` Expected error in degrees: exp(a + b·ln(information + 0.1) + c·∠relief + d·∠silhouette + e/lights) − 2.
    pub fn expected_error(&self) -> f32 {
        let information = libm::logf(self.information.max(0.0) + LEAST_INFORMATION);
        let exponent = WITHOUT
            + OF_INFORMATION * information
            + OF_RELIEF * self.from_relief
            + OF_SILHOUETTE * self.from_silhouette
            + OF_FEW_LIGHTS / self.lights.max(1) as f32;
        (libm::expf(exponent.min(6.0)) - OFFSET).max(0.0)
    }

    /// `[eq:normal-confidence]` 1/(1 + (expected error / 12°)²), in (0, 1].
    pub fn confidence(&self) -> f32 {
        let e = self.expected_error() / HALF_CONFIDENCE_DEGREES;
        1.0 / (1.0 + e * e)
    }
}

/// Angle between unit vectors, radians.
fn angle(a: Vec3, b: Vec3) -> f32 {
    libm::acosf(a.dot(b).clamp(-1.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// [eq:normal-doubt], [eq:normal-confidence]: the formulas in double precision; more doubt, less confidence.
        #[test]
        fn doubts_lower_the_confidence(information in 0.0f32..8.0, lights in 3usize..40, a in 0.0f32..1.5, b in 0.0f32..1.5) {
            let doubts = Doubts { information, lights, from_relief: a, from_silhouette: b };
            let naive = (2.15 - 0.13 * (f64::from(information) + 0.1).ln() + 1.45 * f64::from(a) + 0.68 * f64::from(b)
                + 0.96 / lights as f64).min(6.0).exp() - 2.0;
            prop_assert!((f64::from(doubts.expected_error()) - naive.max(0.0)).abs() < 1e-3 * (1.0 + naive.abs()));
            let c = doubts.confidence();
            prop_assert!(c > 0.0 && c <= 1.0);
            prop_assert!((f64::from(c) - 1.0 / (1.0 + (naive.max(0.0) / 12.0).powi(2))).abs() < 1e-3);
            let surer = [
                Doubts { information: information + 1.0, ..doubts },
                Doubts { lights: lights + 5, ..doubts },
            ];
            let less_sure = [
                Doubts { from_relief: a + 0.1, ..doubts },
                Doubts { from_silhouette: b + 0.1, ..doubts },
            ];
            prop_assert!(surer.iter().all(|d| d.confidence() >= c) && less_sure.iter().all(|d| d.confidence() <= c));
        }
    }
}
