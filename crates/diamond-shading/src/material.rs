//! The surface material: what the microfacet BRDF is a function of, besides directions.
//!
//! A material is the metal/rough parametrisation of real-time rendering: a base colour that is the albedo of a
//! dielectric or the reflectance of a metal, a perceptual roughness whose square is the width α of the microfacet
//! distribution, and a metalness that moves between dielectric and metal.
use crate::number::Number;
use crate::vector::Vector;
use glam::Vec3;

/// Reflectance at normal incidence of a dielectric: an index of refraction of 1.5.
pub const DIELECTRIC_F0: f32 = 0.04;

/// The smallest roughness that is shaded; smaller ones, and none at all, are treated as it. α is then at least 1e-6,
/// which keeps the peak of the distribution (1/πα² ≈ 3e11) and its gradient inside the range of `f32`.
pub const MIN_ROUGHNESS: f32 = 1e-3;

/// Metal/rough surface material.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    /// Linear RGB, in `[0, 1]`: diffuse albedo of a dielectric, reflectance at normal incidence of a metal.
    pub base_color: Vec3,
    /// Perceptual roughness in `[0, 1]`; α = roughness². Raised to [`MIN_ROUGHNESS`], lowered to 1.
    pub roughness: f32,
    /// 0 is a dielectric, 1 a metal.
    pub metalness: f32,
}

/// Gradient of a scalar with respect to a [`Material`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct MaterialGrad {
    /// With respect to the base colour, per channel.
    pub base_color: Vec3,
    /// With respect to the roughness; 0 where it is outside the range that is shaded.
    pub roughness: f32,
    /// With respect to the metalness.
    pub metalness: f32,
}

/// The numbers of a [`Material`], or of its gradient, of one pixel or of many.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Surface<T> {
    pub base_color: Vector<T>,
    pub roughness: T,
    pub metalness: T,
}

impl<T: Number> Surface<T> {
    /// [`Material::shaded_roughness`].
    #[inline(always)]
    pub fn shaded_roughness(&self) -> T {
        self.roughness.at_least(MIN_ROUGHNESS).at_most(1.0)
    }

    /// [`Material::shaded_roughness_pull`].
    #[inline(always)]
    pub fn shaded_roughness_pull(&self, d_roughness: T) -> T {
        d_roughness.only_where(self.roughness.reaches(MIN_ROUGHNESS) & (-self.roughness).reaches(-1.0))
    }

    #[inline(always)]
    fn above_dielectric(&self) -> Vector<T> {
        let c = self.base_color;
        Vector::new(c.x - DIELECTRIC_F0, c.y - DIELECTRIC_F0, c.z - DIELECTRIC_F0)
    }

    /// [`Material::f0`].
    #[inline(always)]
    pub fn f0(&self) -> Vector<T> {
        let c = self.above_dielectric() * self.metalness;
        Vector::new(c.x + DIELECTRIC_F0, c.y + DIELECTRIC_F0, c.z + DIELECTRIC_F0)
    }

    /// [`Material::f0_pull`]: of the base colour and the metalness.
    #[inline(always)]
    pub fn f0_pull(&self, d_f0: Vector<T>) -> (Vector<T>, T) {
        (d_f0 * self.metalness, d_f0.dot(self.above_dielectric()))
    }
}

impl From<&Material> for Surface<f32> {
    #[inline(always)]
    fn from(m: &Material) -> Self {
        Self { base_color: m.base_color.into(), roughness: m.roughness, metalness: m.metalness }
    }
}

impl From<Surface<f32>> for MaterialGrad {
    #[inline(always)]
    fn from(d: Surface<f32>) -> Self {
        Self { base_color: d.base_color.into(), roughness: d.roughness, metalness: d.metalness }
    }
}

impl Material {
    /// The roughness that is shaded: clamped to `[MIN_ROUGHNESS, 1]`.
    #[inline]
    pub fn shaded_roughness(&self) -> f32 {
        Surface::from(self).shaded_roughness()
    }

    /// Width α of the microfacet distribution: the square of the shaded roughness, dimensionless.
    /// `[eq:ggx-alpha]`
    #[inline]
    pub fn alpha(&self) -> f32 {
        let roughness = self.shaded_roughness();
        roughness * roughness
    }

    /// Reflectance at normal incidence: F0 = 0.04 + metalness · (base_color − 0.04), linear RGB.
    /// `[eq:f0]`
    #[inline]
    pub fn f0(&self) -> Vec3 {
        Surface::from(self).f0().into()
    }

    /// Pullback of [`Material::f0`], added to `grad`.
    /// `[eq:f0]`
    #[inline]
    pub fn f0_pull(&self, d_f0: Vec3, grad: &mut MaterialGrad) {
        let (base_color, metalness) = Surface::from(self).f0_pull(d_f0.into());
        grad.base_color += Vec3::from(base_color);
        grad.metalness += metalness;
    }

    /// Pullback of [`Material::shaded_roughness`]: the cotangent passes inside the range and stops outside it.
    #[inline]
    pub fn shaded_roughness_pull(&self, d_roughness: f32) -> f32 {
        Surface::from(self).shaded_roughness_pull(d_roughness)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `[eq:f0]` `[eq:ggx-alpha]`
    #[test]
    fn dielectrics_reflect_four_percent_and_metals_their_colour() {
        let base_color = Vec3::new(0.9, 0.5, 0.1);
        let at = |metalness| Material { base_color, roughness: 0.3, metalness };
        assert_eq!(at(0.0).f0(), Vec3::splat(0.04));
        assert!((at(1.0).f0() - base_color).abs().max_element() < 1e-7);
        assert_eq!(at(0.0).alpha(), 0.3f32 * 0.3);
    }

    /// `[eq:f0]`: bilinear in base colour and metalness, so differences of `f64` are exact.
    #[test]
    fn f0_pull_is_the_transpose() {
        let material = Material { base_color: Vec3::new(0.9, 0.5, 0.1), roughness: 0.3, metalness: 0.7 };
        let d_f0 = Vec3::new(1.0, -2.0, 0.5);
        let mut grad = MaterialGrad::default();
        material.f0_pull(d_f0, &mut grad);
        let f = |b: Vec3, m: f32| d_f0.as_dvec3().dot((b.as_dvec3() - 0.04) * f64::from(m));
        let metal = f(material.base_color, 1.7) - f(material.base_color, 0.7);
        assert!((f64::from(grad.metalness) - metal).abs() < 1e-5, "{} {metal}", grad.metalness);
        let red = f(material.base_color + Vec3::X, 0.7) - f(material.base_color, 0.7);
        assert!((f64::from(grad.base_color.x) - red).abs() < 1e-5);
    }

    #[test]
    fn roughness_outside_the_range_has_no_gradient() {
        let at = |roughness| Material { base_color: Vec3::ONE, roughness, metalness: 0.0 };
        assert_eq!(at(0.0).alpha(), MIN_ROUGHNESS * MIN_ROUGHNESS);
        assert_eq!([at(0.0), at(0.5), at(1.0), at(1.1)].map(|m| m.shaded_roughness_pull(2.0)), [0.0, 2.0, 2.0, 0.0]);
    }
}
