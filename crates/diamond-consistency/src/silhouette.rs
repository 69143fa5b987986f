//! The cost of two silhouette values that should be one.
use crate::SilhouettePenalty;

/// Silhouettes are kept this far from 0 and 1 before their logarithm is taken, in f64; where that acts there is no
/// gradient. Small enough that two silhouettes which are both 1 cost less than 10⁻⁶.
pub const SILHOUETTE_MARGIN: f64 = 1e-7;

impl SilhouettePenalty {
    /// `[eq:silhouette-consistency]` The cost of the value `found` where `label` should be: −(m·ln o + (1 − m)·ln(1 − o)),
    /// or |m − o|.
    pub fn value(self, label: f32, found: f32) -> f64 {
        let (m, o) = (f64::from(label), f64::from(found));
        match self {
            Self::L1 => (m - o).abs(),
            Self::Bce => {
                let (m, o) = (m.clamp(0.0, 1.0), kept(o));
                -(m * libm::log(o) + (1.0 - m) * libm::log(1.0 - o))
            }
        }
    }

    /// `[eq:silhouette-consistency]` Pullback of [`SilhouettePenalty::value`]: derivatives with respect to label and found
    /// value. |·| has the derivative 0 at 0.
    pub fn pull(self, label: f32, found: f32) -> (f64, f64) {
        let (m, o) = (f64::from(label), f64::from(found));
        match self {
            Self::L1 => {
                let sign = if m > o {
                    1.0
                } else if m < o {
                    -1.0
                } else {
                    0.0
                };
                (sign, -sign)
            }
            Self::Bce => {
                let d_label = match (0.0..=1.0).contains(&m) {
                    true => libm::log(1.0 - kept(o)) - libm::log(kept(o)),
                    false => 0.0,
                };
                let d_found = match kept(o) == o {
                    true => (o - m.clamp(0.0, 1.0)) / (o * (1.0 - o)),
                    false => 0.0,
                };
                (d_label, d_found)
            }
        }
    }
}

fn kept(silhouette: f64) -> f64 {
    silhouette.clamp(SILHOUETTE_MARGIN, 1.0 - SILHOUETTE_MARGIN)
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::consistency;
    use diamond_testkit::{Dual, gradient};
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// [eq:silhouette-consistency]: value and both derivatives.
        #[test]
        fn penalties_agree_with_dual_numbers(label in 0.0f32..1.0, found in 0.001f32..0.999) {
            prop_assume!((label - found).abs() > 1e-3);
            for (penalty, bce) in [(SilhouettePenalty::Bce, true), (SilhouettePenalty::L1, false)] {
                let at = [f64::from(label), f64::from(found)];
                let value = consistency::penalty(bce, Dual::new(at[0], 0.0), Dual::new(at[1], 0.0)).v;
                prop_assert!((penalty.value(label, found) - value).abs() <= 1e-12 * (1.0 + value));
                let expected = gradient(|x| consistency::penalty(bce, x[0], x[1]), &at);
                let (d_label, d_found) = penalty.pull(label, found);
                prop_assert!((d_label - expected[0]).abs() <= 1e-12 * (1.0 + expected[0].abs()));
                prop_assert!((d_found - expected[1]).abs() <= 1e-12 * (1.0 + expected[1].abs()));
            }
        }
    }

    #[test]
    fn extremes_are_finite_and_agreement_is_free() {
        for penalty in [SilhouettePenalty::Bce, SilhouettePenalty::L1] {
            for (label, found) in [(0.0, 0.0), (1.0, 1.0)] {
                assert!(penalty.value(label, found) <= 1e-6, "{penalty:?}");
            }
            for (label, found) in [(0.0, 1.0), (1.0, 0.0), (2.0, -1.0), (f32::MAX, f32::MIN)] {
                let (a, b) = penalty.pull(label, found);
                assert!(penalty.value(label, found).is_finite() && a.is_finite() && b.is_finite());
            }
        }
        assert_eq!(SilhouettePenalty::L1.pull(0.5, 0.5), (0.0, 0.0));
        assert_eq!(SilhouettePenalty::Bce.pull(1.0, 0.0).1, 0.0, "where the margin acts there is no gradient");
    }
}
