//! Points and directions drawn from the densities that transport needs.
use crate::Rng;
use glam::{Vec2, Vec3};
use std::f32::consts::{FRAC_1_PI, FRAC_PI_4, PI, TAU};

/// Density of [`uniform_sphere`], per steradian.
pub const UNIFORM_SPHERE_PDF: f32 = 1.0 / (4.0 * PI);

/// A direction, every one as likely as any other: density 1/4π.
/// `[eq:uniform-sphere]`
#[inline]
pub fn uniform_sphere(rng: &mut Rng) -> Vec3 {
    let z = 1.0 - 2.0 * rng.uniform();
    let r = (1.0 - z * z).max(0.0).sqrt();
    let (sin, cos) = (TAU * rng.uniform()).sin_cos();
    Vec3::new(r * cos, r * sin, z)
}

/// A point of the unit disc, uniform in area (the concentric map of Shirley and Chiu 1997).
#[inline]
pub fn uniform_disc(rng: &mut Rng) -> Vec2 {
    let (x, y) = (2.0 * rng.uniform() - 1.0, 2.0 * rng.uniform() - 1.0);
    if x == 0.0 && y == 0.0 {
        return Vec2::ZERO;
    }
    let (r, phi) =
        if x.abs() > y.abs() { (x, FRAC_PI_4 * (y / x)) } else { (y, 2.0 * FRAC_PI_4 - FRAC_PI_4 * (x / y)) };
    let (sin, cos) = phi.sin_cos();
    Vec2::new(r * cos, r * sin)
}

/// A direction of the hemisphere about +z with density cos θ/π.
/// `[eq:cosine-hemisphere]`
#[inline]
pub fn cosine_hemisphere(rng: &mut Rng) -> Vec3 {
    let p = uniform_disc(rng);
    p.extend((1.0 - p.length_squared()).max(0.0).sqrt())
}

/// Density of [`cosine_hemisphere`], per steradian; 0 below the horizon.
/// `[eq:cosine-hemisphere]`
#[inline]
pub fn cosine_hemisphere_pdf(cos_theta: f32) -> f32 {
    cos_theta.max(0.0) * FRAC_1_PI
}

/// Three orthonormal vectors, right-handed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// First tangent.
    pub x: Vec3,
    /// Second tangent.
    pub y: Vec3,
    /// The vector that the frame was made from.
    pub z: Vec3,
}

impl Frame {
    /// A frame whose z is the unit vector `z`.
    #[inline]
    pub fn new(z: Vec3) -> Self {
        let (x, y) = z.any_orthonormal_pair();
        Self { x, y, z }
    }

    /// World → frame.
    #[inline]
    pub fn to_local(self, v: Vec3) -> Vec3 {
        Vec3::new(self.x.dot(v), self.y.dot(v), self.z.dot(v))
    }

    /// Frame → world.
    #[inline]
    pub fn to_world(self, v: Vec3) -> Vec3 {
        self.x * v.x + self.y * v.y + self.z * v.z
    }
}

/// How much a sample drawn with density `pdf` counts when `other` could have drawn it too (Veach's balance heuristic).
/// `[eq:balance-heuristic]`
#[inline]
pub fn balance_heuristic(pdf: f32, other: f32) -> f32 {
    // An infinite density is a sampler that cannot be beaten; 0/0 is a sample that nobody draws.
    if pdf == f32::INFINITY {
        return 1.0;
    }
    let sum = pdf + other;
    if sum > 0.0 { pdf / sum } else { 0.0 }
}
