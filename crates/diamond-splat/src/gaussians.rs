//! The vocabulary: anisotropic 3D Gaussians after activation, their gradient, and the features they carry.
use crate::{LowerFactor, SplatError};
use glam::{Quat, Vec2, Vec3, Vec4};
use rayon::prelude::*;

/// Anisotropic Gaussians, structure of arrays, after activation.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Gaussians {
    /// Centres, world coordinates, scene units.
    pub means: Vec<Vec3>,
    /// Standard deviations along the local axes, scene units, at least 0.
    pub scales: Vec<Vec3>,
    /// Local → world rotations. Need not be normalised: they are normalised where used, with the gradient through it.
    pub rotations: Vec<Quat>,
    /// Peak opacities in [0, 1].
    pub opacities: Vec<f32>,
    /// Empty, or one lower factor `L` of the covariance `Σ = L Lᵀ` per Gaussian. Where there are factors, the rasteriser
    /// takes them and its gradient goes to them, not to scales and rotations, which must then hold the decomposition of
    /// the factors for everybody else: see [`Gaussians::decompose_factors`].
    pub factors: Vec<LowerFactor>,
}

/// Gradient of [`Gaussians`].
#[derive(Debug, Clone, PartialEq, Default)]
pub struct GaussiansGrad {
    /// d loss / d mean.
    pub means: Vec<Vec3>,
    /// d loss / d scale.
    pub scales: Vec<Vec3>,
    /// d loss / d rotation with respect to the four raw numbers (x, y, z, w) of the quaternion, the order of glam.
    pub rotations: Vec<Vec4>,
    /// d loss / d opacity.
    pub opacities: Vec<f32>,
    /// d loss / d factor, empty where the Gaussians have none.
    pub factors: Vec<LowerFactor>,
}

/// N × C values that are blended: row `i` belongs to Gaussian `i`.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Features {
    /// Values per Gaussian (C).
    pub channels: usize,
    /// Row-major N × C.
    pub data: Vec<f32>,
}

impl Gaussians {
    /// How many there are.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Appends one Gaussian.
    pub fn push(&mut self, mean: Vec3, scale: Vec3, rotation: Quat, opacity: f32) {
        self.means.push(mean);
        self.scales.push(scale);
        self.rotations.push(rotation);
        self.opacities.push(opacity);
    }

    /// Sets scales and rotations to the decomposition of the factors, where there are any.
    pub fn decompose_factors(&mut self) {
        let (scales, rotations) = self
            .factors
            .par_iter()
            .with_min_len(256)
            .map(LowerFactor::scale_rotation)
            .unzip::<Vec3, Quat, Vec<_>, Vec<_>>();
        if !self.factors.is_empty() {
            (self.scales, self.rotations) = (scales, rotations);
        }
    }

    /// `Err` unless the arrays have equal lengths, everything is finite, scales are ≥ 0 and opacities in [0, 1].
    pub fn validate(&self) -> Result<(), SplatError> {
        let n = self.len();
        let same = |what, found: usize| {
            if found == n {
                return Ok(());
            }
            Err(SplatError::Shape { what, expected: format!("{n} (one per mean)"), found: found.to_string() })
        };
        same("Gaussians::scales", self.scales.len())?;
        same("Gaussians::rotations", self.rotations.len())?;
        same("Gaussians::opacities", self.opacities.len())?;
        if !self.factors.is_empty() {
            same("Gaussians::factors", self.factors.len())?;
        }
        let finite = |what, bad: Option<usize>| bad.map_or(Ok(()), |index| Err(SplatError::NonFinite { what, index }));
        finite("Gaussians::means", self.means.iter().position(|v| !v.is_finite()))?;
        finite("Gaussians::scales", self.scales.iter().position(|v| !v.is_finite()))?;
        finite("Gaussians::rotations", self.rotations.iter().position(|q| !q.is_finite()))?;
        finite("Gaussians::opacities", self.opacities.iter().position(|v| !v.is_finite()))?;
        finite("Gaussians::factors", self.factors.iter().position(|l| l.0.iter().any(|v| !v.is_finite())))?;
        if let Some(index) = self.scales.iter().position(|s| s.min_element() < 0.0) {
            let found = self.scales[index].min_element();
            return Err(SplatError::Range { what: "Gaussians::scales", index, expected: "[0, ∞)", found });
        }
        if let Some(index) = self.opacities.iter().position(|o| !(0.0..=1.0).contains(o)) {
            let found = self.opacities[index];
            return Err(SplatError::Range { what: "Gaussians::opacities", index, expected: "[0, 1]", found });
        }
        Ok(())
    }
}

impl GaussiansGrad {
    /// A gradient of zeros for `n` Gaussians.
    pub fn zeros(n: usize) -> Self {
        Self {
            means: vec![Vec3::ZERO; n],
            scales: vec![Vec3::ZERO; n],
            rotations: vec![Vec4::ZERO; n],
            opacities: vec![0.0; n],
            factors: Vec::new(),
        }
    }

    /// How many Gaussians this is the gradient of.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Adds another gradient of the same length, element by element.
    pub fn add_assign(&mut self, other: &GaussiansGrad) -> Result<(), SplatError> {
        if self.len() != other.len() {
            return Err(SplatError::Shape {
                what: "GaussiansGrad::add_assign",
                expected: self.len().to_string(),
                found: other.len().to_string(),
            });
        }
        self.means.iter_mut().zip(&other.means).for_each(|(a, b)| *a += *b);
        self.scales.iter_mut().zip(&other.scales).for_each(|(a, b)| *a += *b);
        self.rotations.iter_mut().zip(&other.rotations).for_each(|(a, b)| *a += *b);
        self.opacities.iter_mut().zip(&other.opacities).for_each(|(a, b)| *a += *b);
        if self.factors.is_empty() {
            self.factors.clone_from(&other.factors);
        } else {
            let pairs = self.factors.iter_mut().zip(&other.factors);
            pairs.for_each(|(a, b)| a.0.iter_mut().zip(&b.0).for_each(|(a, b)| *a += *b));
        }
        Ok(())
    }
}

impl Features {
    /// Features of zeros for `n` Gaussians.
    pub fn zeros(n: usize, channels: usize) -> Self {
        Self { channels, data: vec![0.0; n * channels] }
    }

    /// The values of Gaussian `i`. Panics outside, like slice indexing.
    pub fn row(&self, i: usize) -> &[f32] {
        &self.data[i * self.channels..(i + 1) * self.channels]
    }

    /// The values of Gaussian `i`, mutable. Panics outside, like slice indexing.
    pub fn row_mut(&mut self, i: usize) -> &mut [f32] {
        &mut self.data[i * self.channels..(i + 1) * self.channels]
    }

    /// `Err` unless there are `n` rows and everything is finite.
    pub fn validate(&self, n: usize) -> Result<(), SplatError> {
        if self.data.len() != n * self.channels {
            return Err(SplatError::Shape {
                what: "Features::data",
                expected: format!("{n} Gaussians × {} channels = {} values", self.channels, n * self.channels),
                found: format!("{} values", self.data.len()),
            });
        }
        match self.data.iter().position(|v| !v.is_finite()) {
            Some(index) => Err(SplatError::NonFinite { what: "Features::data", index }),
            None => Ok(()),
        }
    }
}

/// What the pullback of the rasteriser gives.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RasterPull {
    /// Gradient of the Gaussians.
    pub gaussians: GaussiansGrad,
    /// Gradient of the features, row-major N × C.
    pub features: Vec<f32>,
    /// d loss / d projected mean, per pixel unit: what density control accumulates.
    pub screen: Vec<Vec2>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn validation_names_the_culprit() {
        let mut g = Gaussians::default();
        g.push(Vec3::ZERO, Vec3::ONE, Quat::IDENTITY, 0.5);
        assert_eq!(g.validate(), Ok(()));
        g.means[0].y = f32::NAN;
        assert_eq!(g.validate(), Err(SplatError::NonFinite { what: "Gaussians::means", index: 0 }));
        g.means[0].y = 0.0;
        g.opacities[0] = 1.5;
        assert!(matches!(g.validate(), Err(SplatError::Range { what: "Gaussians::opacities", .. })));
        g.opacities.push(0.0);
        assert!(matches!(g.validate(), Err(SplatError::Shape { what: "Gaussians::opacities", .. })));
    }
}
