//! The GGX distribution of microfacets in the frame whose z is the normal, and its visible normals.
//!
//! `alpha` is the width of the lobe, the square of perceptual roughness. Masking is Smith's, by default separable, G(v)·G(l),
//! as in Walter et al. 2007.
use crate::Rng;
use glam::{Vec2, Vec3};
use std::f32::consts::{PI, TAU};

/// Narrowest lobe: below it a boundary is to be modelled as smooth, since f32 half vectors no longer resolve the peak.
pub const MIN_ALPHA: f32 = 1e-3;

/// Density of microfacet normals `h` (unit, h.z > 0), per steradian of projected area.
/// `[eq:ggx-distribution]`
#[inline]
pub fn distribution(alpha: f32, h: Vec3) -> f32 {
    if h.z <= 0.0 {
        return 0.0;
    }
    // tan² + α² over cos²: sin² from x and y keeps the peak exact.
    let a2 = alpha * alpha;
    let d = h.x * h.x + h.y * h.y + a2 * h.z * h.z;
    a2 / (PI * d * d)
}

/// Smith's masking of the direction `v` (unit): the fraction of microfacets facing `v` that it sees. 0 … 1, even in z.
/// `[eq:ggx-masking]`
#[inline]
pub fn masking(alpha: f32, v: Vec3) -> f32 {
    let z = v.z.abs();
    let root = (z * z + alpha * alpha * (v.x * v.x + v.y * v.y)).sqrt();
    if z + root > 0.0 { 2.0 * z / (z + root) } else { 0.0 }
}

/// Height-correlated masking and shadowing of two directions on the same side.
/// `[eq:ggx-masking]`
#[inline]
pub fn masking_correlated(alpha: f32, v: Vec3, l: Vec3) -> f32 {
    let (a, b) = (masking(alpha, v), masking(alpha, l));
    if a * b > 0.0 { 1.0 / (1.0 / a + 1.0 / b - 1.0) } else { 0.0 }
}

/// Density with which [`sample_visible_normal`] draws `h`, per steradian.
/// `[eq:ggx-visible-normals]`
#[inline]
pub fn visible_normal_pdf(alpha: f32, v: Vec3, h: Vec3) -> f32 {
    let z = v.z.abs();
    let root = (z * z + alpha * alpha * (v.x * v.x + v.y * v.y)).sqrt();
    // G1(v)/v.z without the division by z.
    let scale = if z + root > 0.0 { 2.0 / (z + root) } else { return 0.0 };
    scale * v.dot(h).max(0.0) * distribution(alpha, h)
}

/// Draws the normal of a microfacet that `v` (unit, v.z ≥ 0) sees: the hemisphere of stretched directions is mapped to a
/// spherical cap (Dupuy and Benyoub 2023).
/// `[eq:ggx-visible-normals]`
#[inline]
pub fn sample_visible_normal(alpha: f32, v: Vec3, rng: &mut Rng) -> Vec3 {
    let stretched = (v * Vec3::new(alpha, alpha, 1.0)).normalize_or(Vec3::Z);
    let u = Vec2::new(rng.uniform(), rng.uniform());
    let (sin_phi, cos_phi) = (TAU * u.x).sin_cos();
    let z = (1.0 - u.y) * (1.0 + stretched.z) - stretched.z;
    let sin_theta = (1.0 - z * z).clamp(0.0, 1.0).sqrt();
    let half = Vec3::new(sin_theta * cos_phi, sin_theta * sin_phi, z) + stretched;
    Vec3::new(half.x * alpha, half.y * alpha, half.z.max(1e-9)).normalize_or(Vec3::Z)
}
