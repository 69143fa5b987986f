//! Colour transfer between stored values and linear radiance.

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

impl Transfer {
    /// Stored value → linear radiance. Odd-symmetric below 0, so that any finite input gives finite output.
    pub fn decode(self, stored: f32) -> f32 {
        let v = stored.abs();
        let linear = match self {
            Transfer::Linear => v,
            Transfer::Srgb if v <= 0.04045 => v / 12.92,
            Transfer::Srgb => ((v + 0.055) / 1.055).powf(2.4),
            Transfer::Gamma22 => v.powf(2.2),
        };
        linear.copysign(stored)
    }

    /// Linear radiance → stored value; the inverse of [`Transfer::decode`].
    pub fn encode(self, linear: f32) -> f32 {
        let v = linear.abs();
        let stored = match self {
            Transfer::Linear => v,
            Transfer::Srgb if v <= 0.003_130_8 => v * 12.92,
            Transfer::Srgb => 1.055 * v.powf(1.0 / 2.4) - 0.055,
            Transfer::Gamma22 => v.powf(1.0 / 2.2),
        };
        stored.copysign(linear)
    }
}
