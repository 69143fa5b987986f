//! Ray-traced visibility: how much of a light reaches each Gaussian through all the others.
//!
//! Along a ray the density of a Gaussian is a Gaussian itself, with one peak. Each Gaussian whose peak lies between
//! the two ends of the ray takes away its opacity there, once: T = Π(1 − α). This is what the rasteriser
//! does to a pixel, for an arbitrary ray and regardless of order, so that a light sees a scene as a camera in its
//! place would.
//!
//! # Where the ray begins
//!
//! A surface is a shell of flat Gaussians that overlap. A receiver sits in the middle of this shell, among neighbours
//! that are the same surface; if they were allowed to shade it everything would be black. What is wanted
//! is the light that arrives *at* the shell, so the ray begins at its outer skin: at the mean, moved outward along the
//! normal by [`VisibilityConfig::normal_offset`] standard deviations of the receiver's own extent along that normal.
//! For flat Gaussians this is a hair's breadth. Without normals the ray begins at the mean, and its first
//! [`VisibilityConfig::light_offset`] standard deviations toward the light are free.
use crate::bvh::{Aabb, Bvh, NO_BOX, Visitor, WIDTH};
use crate::density::unit_rotation;
use crate::{Gaussians, SplatError};
use diamond_light::OlatLight;
use glam::{Mat3, Vec3};
use rayon::prelude::*;

/// Largest opacity of one occluder, as in the rasteriser.
pub const MAX_OCCLUDER_ALPHA: f32 = 0.99;
/// Opacity at which an occluder ends, as in the rasteriser.
pub const MIN_OCCLUDER_ALPHA: f32 = 1.0 / 255.0;
/// Below this transmittance a ray is abandoned.
pub(crate) const MIN_TRANSMITTANCE: f32 = 1e-4;
/// A Gaussian is at least this thick relative to its largest scale: a disc without thickness has no inverse.
const MIN_FLATNESS: f32 = 1e-6;
/// A Gaussian is at least this large (scene units), so that its inverse scale squared stays finite.
const MIN_SCALE: f32 = 1e-12;
/// Boxes are widened by this fraction of their size and position against rounding of the ray–box test.
const BOX_MARGIN: f32 = 1e-5;

/// How rays toward a light begin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VisibilityConfig {
    /// Where there is a normal: the ray begins this many of the receiver's own standard deviations along it.
    pub normal_offset: f32,
    /// Where there is none: occluders count from this many of the receiver's own standard deviations toward the light.
    pub light_offset: f32,
}

impl Default for VisibilityConfig {
    fn default() -> Self {
        Self { normal_offset: 3.0, light_offset: 3.0 }
    }
}

/// A Gaussian as rays need it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Occluder {
    /// World → units of the Gaussian's standard deviations, three columns.
    pub to_local: Mat3,
    pub mean: Vec3,
    pub opacity: f32,
    /// Squared distance in standard deviations at which opacity falls to [`MIN_OCCLUDER_ALPHA`]; negative if nowhere.
    pub max_q: f32,
}

impl Occluder {
    pub fn new(gaussians: &Gaussians, i: usize) -> Self {
        let (mean, scale, rotation) = (gaussians.means[i], gaussians.scales[i], gaussians.rotations[i]);
        let opacity = gaussians.opacities[i];
        let valid = mean.is_finite() && scale.is_finite() && rotation.is_finite() && opacity >= MIN_OCCLUDER_ALPHA;
        if !valid {
            return Self { to_local: Mat3::ZERO, mean: Vec3::ZERO, opacity: 0.0, max_q: -1.0 };
        }
        let inverse = thickened(scale).recip();
        let rotation = Mat3::from_quat(unit_rotation(rotation));
        Self {
            to_local: Mat3::from_diagonal(inverse) * rotation.transpose(),
            mean,
            opacity,
            max_q: 2.0 * libm::logf(opacity / MIN_OCCLUDER_ALPHA),
        }
    }
}

/// The occluders of one leaf, one number after the other, so that eight are tested at once.
#[derive(Debug, Clone)]
#[repr(align(64))]
struct Packet {
    /// Column `c`, row `r` of `to_local` at `3·c + r`.
    to_local: [[f32; WIDTH]; 9],
    mean: [[f32; WIDTH]; 3],
    opacity: [f32; WIDTH],
    max_q: [f32; WIDTH],
    indices: [u32; WIDTH],
}

impl Packet {
    fn new(gaussians: &Gaussians, indices: &[u32; WIDTH]) -> Self {
        let zero = [0.0; WIDTH];
        let mut packet =
            Self { to_local: [zero; 9], mean: [zero; 3], opacity: zero, max_q: [-1.0; WIDTH], indices: *indices };
        for lane in (0..WIDTH).filter(|&lane| indices[lane] != NO_BOX) {
            let occluder = Occluder::new(gaussians, indices[lane] as usize);
            for (place, value) in packet.to_local.iter_mut().zip(occluder.to_local.to_cols_array()) {
                place[lane] = value;
            }
            for (place, value) in packet.mean.iter_mut().zip(occluder.mean.to_array()) {
                place[lane] = value;
            }
            (packet.opacity[lane], packet.max_q[lane]) = (occluder.opacity, occluder.max_q);
        }
        packet
    }

    /// Squared distance of each occluder's peak in its standard deviations, and a bit for each that counts.
    #[inline(always)]
    fn peaks(&self, skip: u32, origin: Vec3, direction: Vec3, t_min: f32, t_max: f32) -> ([f32; WIDTH], u32) {
        let m = &self.to_local;
        let mut peaks = [0.0; WIDTH];
        let mut counting = 0u32;
        for l in 0..WIDTH {
            let (x, y, z) = (origin.x - self.mean[0][l], origin.y - self.mean[1][l], origin.z - self.mean[2][l]);
            let start_x = m[0][l] * x + m[3][l] * y + m[6][l] * z;
            let start_y = m[1][l] * x + m[4][l] * y + m[7][l] * z;
            let start_z = m[2][l] * x + m[5][l] * y + m[8][l] * z;
            let step_x = m[0][l] * direction.x + m[3][l] * direction.y + m[6][l] * direction.z;
            let step_y = m[1][l] * direction.x + m[4][l] * direction.y + m[7][l] * direction.z;
            let step_z = m[2][l] * direction.x + m[5][l] * direction.y + m[8][l] * direction.z;
            let t = -(start_x * step_x + start_y * step_y + start_z * step_z)
                / (step_x * step_x + step_y * step_y + step_z * step_z);
            let (x, y, z) = (start_x + step_x * t, start_y + step_y * t, start_z + step_z * t);
            let q = x * x + y * y + z * z;
            // Comparisons are false for NaN, which thus never occludes.
            let counts = (t > t_min) & (t < t_max) & (q < self.max_q[l]) & (self.indices[l] != skip);
            peaks[l] = q;
            counting |= (counts as u32) << l;
        }
        (peaks, counting)
    }
}

pub(crate) fn thickened(scale: Vec3) -> Vec3 {
    scale.abs().max(Vec3::splat((scale.abs().max_element() * MIN_FLATNESS).max(MIN_SCALE)))
}

/// `[eq:gaussian-bounds]` The box of the ellipsoid on which opacity·exp(−q/2) = 1/255: half sides √(q_max·Σ_ii) with
/// q_max = 2·ln(255·opacity). Empty where the opacity is below 1/255.
fn bounds(gaussians: &Gaussians, i: usize) -> Aabb {
    let occluder = Occluder::new(gaussians, i);
    if occluder.max_q < 0.0 {
        return Aabb::EMPTY;
    }
    let axes =
        Mat3::from_quat(unit_rotation(gaussians.rotations[i])) * Mat3::from_diagonal(thickened(gaussians.scales[i]));
    // Row lengths, in two steps so that large scales do not overflow.
    let variance = |row: Vec3| {
        let largest = row.abs().max_element().max(f32::MIN_POSITIVE);
        largest * (row / largest).length()
    };
    let deviation = Vec3::new(variance(axes.row(0)), variance(axes.row(1)), variance(axes.row(2)));
    let half = deviation * occluder.max_q.sqrt();
    let half = (half + BOX_MARGIN * (half + occluder.mean.abs())).min(Vec3::splat(0.25 * f32::MAX));
    Aabb { min: (occluder.mean - half).into(), max: (occluder.mean + half).into() }
}

/// Gaussians in a bounding volume hierarchy, for rays.
#[derive(Debug, Clone)]
pub struct GaussianBvh {
    bvh: Bvh,
    /// One per leaf.
    packets: Vec<Packet>,
    /// Number of Gaussians.
    len: usize,
}

impl GaussianBvh {
    /// Builds the hierarchy. Errors only where the arrays differ in length; Gaussians that are not finite never
    /// occlude.
    pub fn build(gaussians: &Gaussians) -> Result<Self, SplatError> {
        check_lengths(gaussians)?;
        let boxes = boxes(gaussians);
        let bvh = Bvh::build(&boxes, |i| {
            let mean = gaussians.means[i];
            if mean.is_finite() { mean } else { Vec3::ZERO }
        });
        let packets = packets(&bvh, gaussians);
        Ok(Self { bvh, packets, len: gaussians.len() })
    }

    /// Adopts changed parameters of the same Gaussians, some four times faster than building. The tree grows worse
    /// as the Gaussians move from where they were at building; results are the same.
    pub fn refit(&mut self, gaussians: &Gaussians) -> Result<(), SplatError> {
        check_lengths(gaussians)?;
        self.check_count(gaussians.len())?;
        self.bvh.refit(&boxes(gaussians));
        self.packets = packets(&self.bvh, gaussians);
        Ok(())
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The share of light, in [0, 1], that passes from `origin + t_min·direction` to `origin + t_max·direction`.
    /// `direction` need not be of unit length; t is in units of it, `t_max` may be infinite.
    ///
    /// `[eq:ray-transmittance]` T = Π(1 − α_k) over the Gaussians whose peak along the ray,
    /// t_k = −(M(o−μ)·Md)/|Md|² with M = S⁻¹Rᵀ, lies in (t_min, t_max);
    /// q_k = |M(o + t_k·d − μ)|², a_k = min(0.99, opacity·exp(−q_k/2)),
    /// α_k = a_k·clamp(255·a_k − 1, 0, 1): nothing below 1/255 as in the rasteriser, but reached without a jump.
    ///
    /// A direction of zero, and anything that is not finite, gives 1. Once T < 1e-4 the rest is not looked at.
    pub fn transmittance(&self, origin: Vec3, direction: Vec3, t_min: f32, t_max: f32) -> f32 {
        self.transmittance_without(u32::MAX, origin, direction, t_min, t_max)
    }

    fn transmittance_without(&self, skip: u32, origin: Vec3, direction: Vec3, t_min: f32, t_max: f32) -> f32 {
        struct Trace<'a>(&'a GaussianBvh, u32, Vec3, Vec3, f32, f32);
        impl diamond_simd::WithSimd for Trace<'_> {
            type Output = f32;
            #[inline(always)]
            fn with_simd<S: diamond_simd::Simd>(self, _: S) -> f32 {
                let Trace(bvh, skip, origin, direction, t_min, t_max) = self;
                bvh.trace(skip, origin, direction, t_min, t_max)
            }
        }
        diamond_simd::Level::current().dispatch(Trace(self, skip, origin, direction, t_min, t_max))
    }

    /// Written for scalars; the compiler makes vectors of whatever width the caller's instruction set has. Without
    /// fused multiply-adds, so the bits do not depend on it.
    #[inline(always)]
    fn trace(&self, skip: u32, origin: Vec3, direction: Vec3, t_min: f32, t_max: f32) -> f32 {
        let valid = origin.is_finite() && direction.is_finite() && direction != Vec3::ZERO && t_min < t_max;
        if !valid {
            return 1.0;
        }
        let mut pass = Pass { packets: &self.packets, skip, origin, direction, t_min, t_max, transmittance: 1.0 };
        self.bvh.visit(origin, direction, t_min, t_max, &mut pass);
        pass.transmittance
    }

    /// Visibility in [0, 1] of the light from each Gaussian: see the head of this file for where rays begin.
    ///
    /// `gaussians` are those that this hierarchy was built or refitted with. `normals`, if any, are one per Gaussian,
    /// outward; those of zero length count as absent. The receiver never shades itself, and
    /// nothing beyond a point light shades anything.
    pub fn visibility_to_light(
        &self,
        gaussians: &Gaussians,
        normals: Option<&[Vec3]>,
        light: &OlatLight,
        config: &VisibilityConfig,
    ) -> Result<Vec<f32>, SplatError> {
        self.check_receivers(gaussians, normals)?;
        // Neighbours in the tree take similar paths through it, so receivers go in the tree's order.
        let in_order: Vec<[f32; WIDTH]> = self
            .packets
            .par_iter()
            .with_min_len(16)
            .map(|packet| {
                packet.indices.map(|i| match i {
                    NO_BOX => 1.0,
                    i => self.visibility(gaussians, normals, light, config, i as usize),
                })
            })
            .collect();
        let mut visibility = vec![1.0; self.len];
        for (packet, values) in self.packets.iter().zip(in_order) {
            for (&i, v) in packet.indices.iter().zip(values) {
                if i != NO_BOX {
                    visibility[i as usize] = v;
                }
            }
        }
        Ok(visibility)
    }

    /// [`GaussianBvh::visibility_to_light`] for the Gaussians `indices` only, in their order.
    pub fn visibility_subset(
        &self,
        gaussians: &Gaussians,
        normals: Option<&[Vec3]>,
        light: &OlatLight,
        config: &VisibilityConfig,
        indices: &[u32],
    ) -> Result<Vec<f32>, SplatError> {
        self.check_receivers(gaussians, normals)?;
        if let Some(bad) = indices.iter().find(|&&i| i as usize >= self.len()) {
            return Err(SplatError::Shape {
                what: "visibility_subset, indices",
                expected: format!("indices below {}", self.len()),
                found: bad.to_string(),
            });
        }
        Ok(indices
            .par_iter()
            .with_min_len(64)
            .map(|&i| self.visibility(gaussians, normals, light, config, i as usize))
            .collect())
    }

    fn visibility(
        &self,
        gaussians: &Gaussians,
        normals: Option<&[Vec3]>,
        light: &OlatLight,
        config: &VisibilityConfig,
        i: usize,
    ) -> f32 {
        match ray_to_light(gaussians, normals, light, config, i) {
            Some(ray) => self.transmittance_without(ray.skip, ray.origin, ray.direction, ray.begin, ray.end),
            None => 1.0,
        }
    }

    fn check_count(&self, found: usize) -> Result<(), SplatError> {
        if found == self.len() {
            return Ok(());
        }
        let expected =
            format!("{} (as when the hierarchy was built; build it again after density control)", self.len());
        Err(SplatError::Shape { what: "GaussianBvh", expected, found: found.to_string() })
    }

    fn check_receivers(&self, gaussians: &Gaussians, normals: Option<&[Vec3]>) -> Result<(), SplatError> {
        check_lengths(gaussians)?;
        self.check_count(gaussians.len())?;
        match normals {
            Some(normals) if normals.len() != self.len() => Err(SplatError::Shape {
                what: "GaussianBvh, normals",
                expected: format!("{} (one per Gaussian)", self.len()),
                found: normals.len().to_string(),
            }),
            _ => Ok(()),
        }
    }
}

/// A ray from a receiver toward a light.
#[derive(Debug, Clone, Copy)]
struct Ray {
    /// The receiver, which does not shade itself.
    skip: u32,
    origin: Vec3,
    /// Unit.
    direction: Vec3,
    /// Occluders count from here, scene units.
    begin: f32,
    /// Distance to the light, scene units.
    end: f32,
}

/// Where the rays of Gaussian `i` begin, and whether it has a normal: see the head of this file.
pub(crate) fn ray_origin(
    gaussians: &Gaussians,
    normals: Option<&[Vec3]>,
    config: &VisibilityConfig,
    i: usize,
) -> (Vec3, bool) {
    let mean = gaussians.means[i];
    match normals.and_then(|normals| normals[i].try_normalize()) {
        Some(normal) => (mean + normal * (config.normal_offset * deviation(gaussians, i, normal)), true),
        None => (mean, false),
    }
}

/// Standard deviation of Gaussian `i` along a unit direction: |S·Rᵀ·d|.
fn deviation(gaussians: &Gaussians, i: usize, direction: Vec3) -> f32 {
    (gaussians.scales[i] * (unit_rotation(gaussians.rotations[i]).conjugate() * direction)).length()
}

/// The ray from Gaussian `i`: see the head of this file for where it begins. `None` where the light is at its origin.
fn ray_to_light(
    gaussians: &Gaussians,
    normals: Option<&[Vec3]>,
    light: &OlatLight,
    config: &VisibilityConfig,
    i: usize,
) -> Option<Ray> {
    let (origin, has_normal) = ray_origin(gaussians, normals, config, i);
    let (direction, end) = match *light {
        OlatLight::Point { position, .. } => {
            let to_light = position - origin;
            (to_light.try_normalize()?, to_light.length())
        }
        OlatLight::Directional { direction, .. } => (direction, f32::INFINITY),
    };
    let begin = if has_normal { 0.0 } else { config.light_offset * deviation(gaussians, i, direction) };
    Some(Ray { skip: i as u32, origin, direction, begin, end })
}

/// A ray on its way through the packets.
struct Pass<'a> {
    packets: &'a [Packet],
    skip: u32,
    origin: Vec3,
    direction: Vec3,
    t_min: f32,
    t_max: f32,
    transmittance: f32,
}

impl Visitor for Pass<'_> {
    #[inline(always)]
    fn packet(&mut self, packet: usize) -> bool {
        let packet = &self.packets[packet];
        let (peaks, mut counting) = packet.peaks(self.skip, self.origin, self.direction, self.t_min, self.t_max);
        while counting != 0 {
            let lane = counting.trailing_zeros() as usize;
            counting &= counting - 1;
            self.transmittance *= 1.0 - occluder_alpha(packet.opacity[lane], peaks[lane]);
        }
        self.transmittance >= MIN_TRANSMITTANCE
    }
}

/// What one occluder takes away, with the fade of [eq:ray-transmittance].
#[inline]
fn occluder_alpha(opacity: f32, q: f32) -> f32 {
    let alpha = (opacity * libm::expf(-0.5 * q)).min(MAX_OCCLUDER_ALPHA);
    alpha * (alpha / MIN_OCCLUDER_ALPHA - 1.0).clamp(0.0, 1.0)
}

fn packets(bvh: &Bvh, gaussians: &Gaussians) -> Vec<Packet> {
    bvh.packets().par_iter().with_min_len(128).map(|indices| Packet::new(gaussians, indices)).collect()
}

fn boxes(gaussians: &Gaussians) -> Vec<Aabb> {
    (0..gaussians.len()).into_par_iter().with_min_len(1024).map(|i| bounds(gaussians, i)).collect()
}

pub(crate) fn check_lengths(gaussians: &Gaussians) -> Result<(), SplatError> {
    let n = gaussians.len();
    for (what, found) in [
        ("Gaussians::scales", gaussians.scales.len()),
        ("Gaussians::rotations", gaussians.rotations.len()),
        ("Gaussians::opacities", gaussians.opacities.len()),
    ] {
        if found != n {
            return Err(SplatError::Shape { what, expected: format!("{n} (one per mean)"), found: found.to_string() });
        }
    }
    Ok(())
}
