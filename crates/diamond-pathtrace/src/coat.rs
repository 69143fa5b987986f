//! A thin glossy coat over the object: it adds a reflection of the lights and takes nothing from what passes through it.
//!
//! This is the surface model of the reconstruction (a microfacet term beside a subsurface term), not a physical layer; a physical
//! one is [`crate::Boundary::Rough`]. It reflects at the point that the camera sees first, light that comes straight from a lamp, once.
use crate::error::{PathtraceError, check, check_rgb};
use crate::ggx;
use crate::{Frame, Rng};
use glam::Vec3;

/// Roughness below this is traced as this: a mirror's highlight of a point light has no width.
const MIN_ROUGHNESS: f32 = 0.04;

/// A GGX reflection on top of the object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coat {
    /// Perceptual roughness, 0 … 1; its square is the width of the lobe, and values below 0.04 act as 0.04.
    pub roughness: f32,
    /// Reflectance at normal incidence per channel, 0 … 1; Schlick's approximation takes it to 1 at grazing angles.
    pub f0: Vec3,
}

impl Coat {
    /// `Err` where a number is outside its range.
    pub fn validate(&self) -> Result<(), PathtraceError> {
        check("roughness of a coat", self.roughness, "a number from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
        check_rgb("f0 of a coat", self.f0, "a number from 0 to 1", |v| (0.0..=1.0).contains(&v))
    }

    /// Width of the GGX lobe.
    #[inline]
    pub fn alpha(&self) -> f32 {
        let r = self.roughness.max(MIN_ROUGHNESS);
        r * r
    }

    #[inline]
    fn fresnel(&self, cos: f32) -> Vec3 {
        let m = (1.0 - cos).clamp(0.0, 1.0);
        let m2 = m * m;
        self.f0 + (Vec3::ONE - self.f0) * (m2 * m2 * m)
    }

    /// Reflectance distribution times the cosine of `incident`, per channel, and the density of [`Coat::sample`]. All
    /// directions are unit and point away from the surface; `normal` is the shading normal.
    /// `[eq:coat]`
    pub fn evaluate(&self, outgoing: Vec3, incident: Vec3, normal: Vec3) -> (Vec3, f32) {
        let frame = Frame::new(normal);
        let (o, i) = (frame.to_local(outgoing), frame.to_local(incident));
        if o.z <= 0.0 || i.z <= 0.0 {
            return (Vec3::ZERO, 0.0);
        }
        let Some(h) = (o + i).try_normalize() else { return (Vec3::ZERO, 0.0) };
        let cos = o.dot(h);
        if cos <= 0.0 {
            return (Vec3::ZERO, 0.0);
        }
        let alpha = self.alpha();
        let pdf = ggx::visible_normal_pdf(alpha, o, h) / (4.0 * cos);
        (self.fresnel(cos) * (pdf * ggx::masking(alpha, i)), pdf)
    }

    /// Draws the direction from which a reflected path comes: direction, weight and density; `None` below the horizon.
    /// `[eq:coat]`
    pub fn sample(&self, outgoing: Vec3, normal: Vec3, rng: &mut Rng) -> Option<(Vec3, Vec3, f32)> {
        let frame = Frame::new(normal);
        let o = frame.to_local(outgoing);
        if o.z <= 0.0 {
            return None;
        }
        let alpha = self.alpha();
        let h = ggx::sample_visible_normal(alpha, o, rng);
        let cos = o.dot(h);
        let i = (h * (2.0 * cos) - o).normalize();
        if cos <= 0.0 || i.z <= 0.0 {
            return None;
        }
        let pdf = ggx::visible_normal_pdf(alpha, o, h) / (4.0 * cos);
        Some((frame.to_world(i), self.fresnel(cos) * ggx::masking(alpha, i), pdf))
    }
}
