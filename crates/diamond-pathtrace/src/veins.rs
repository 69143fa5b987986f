//! Veins: a medium whose albedo varies from place to place, as in marble.
use crate::Medium;
use crate::error::{PathtraceError, check, check_rgb};
use crate::noise::fractal_noise;
use glam::Vec3;

/// Octaves of the noise whose zeros are veins.
const OCTAVES: u32 = 3;

/// Sheets in which a medium absorbs more: where a fractal noise is near 0. Extinction is the same everywhere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Veins {
    /// Cells of the noise per scene unit, > 0.
    pub frequency: f32,
    /// Noise of this size (of about 1) is half out of a vein, > 0.
    pub width: f32,
    /// Factor on the albedo in the middle of a vein, per channel, 0 … 1.
    pub factor: Vec3,
    /// Which noise.
    pub seed: u64,
}

impl Veins {
    /// `Err` where a number is outside its range.
    pub fn validate(&self) -> Result<(), PathtraceError> {
        let positive = |v: f32| v > 0.0 && v <= 1e6;
        check("frequency of veins", self.frequency, "a number > 0 and ≤ 10⁶", positive)?;
        check("width of veins", self.width, "a number > 0 and ≤ 10⁶", positive)?;
        check_rgb("factor of veins", self.factor, "a number from 0 to 1", |v| (0.0..=1.0).contains(&v))
    }

    /// Factor on the albedo at a place (scene units), per channel: `factor` in the middle of a vein, 1 far from all. `[eq:veins]`
    pub fn at(&self, position: Vec3) -> Vec3 {
        let noise = fractal_noise(position * self.frequency, OCTAVES, self.seed) / self.width;
        let inside = 1.0 / (1.0 + noise * noise).powi(2);
        Vec3::ONE + (self.factor - 1.0) * inside
    }
}

impl Medium {
    /// Factor on the albedo at a place; 1 where nothing varies.
    #[inline]
    pub(crate) fn variation(&self, position: Vec3) -> Vec3 {
        self.veins.map_or(Vec3::ONE, |veins| veins.at(position))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Rng;

    #[test]
    fn veins_lie_between_their_factor_and_one_and_are_what_validate_allows() {
        let veins = Veins { frequency: 2.0, width: 0.1, factor: Vec3::new(0.9, 0.5, 0.0), seed: 3 };
        veins.validate().unwrap();
        let mut rng = Rng::new(1, 1);
        let (mut low, mut high) = (Vec3::ONE, Vec3::ZERO);
        for _ in 0..20_000 {
            let at = veins.at(Vec3::new(rng.uniform(), rng.uniform(), rng.uniform()) * 20.0 - 10.0);
            assert!(at.cmpge(veins.factor).all() && at.cmple(Vec3::ONE).all(), "{at}");
            (low, high) = (low.min(at), high.max(at));
        }
        assert!((low - veins.factor).max_element() < 0.02 && high.min_element() > 0.9, "{low} {high}");
        for bad in [
            Veins { frequency: 0.0, ..veins },
            Veins { width: f32::NAN, ..veins },
            Veins { factor: Vec3::new(0.5, 1.5, 0.5), ..veins },
        ] {
            assert!(bad.validate().is_err(), "{bad:?}");
        }
        for far in [1e30, f32::MAX] {
            assert!(veins.at(Vec3::splat(far)).is_finite());
        }
    }
}
