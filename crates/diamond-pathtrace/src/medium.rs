//! Participating media of one extinction: how far light flies, what is left of it, and where it is scattered.
//!
//! Along a ray inside a medium light is lost at the rate σ_t; of what is lost the fraction `albedo` continues in a direction
//! that the Henyey–Greenstein function draws. σ_t and albedo are per channel, the mean cosine is one number.
//!
//! A distance is drawn for one channel, chosen by what the path still carries of it, and weighted by the mean density of all
//! channels. This is one-sample multiple importance sampling (Veach), and the weight is bounded by the number of channels
//! whatever the ratio of their σ_t.
use crate::error::{PathtraceError, check, check_rgb};
use crate::{Frame, Rng, Veins};
use glam::Vec3;
use std::f32::consts::{PI, TAU};

/// Largest |g|: beyond it the phase function's peak is narrower than `f32` directions resolve.
pub const MAX_MEAN_COSINE: f32 = 0.999;

/// A medium of one extinction, homogeneous but for veins.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Medium {
    /// Extinction coefficient per channel, 1/scene unit, ≥ 0.
    pub sigma_t: Vec3,
    /// Single-scattering albedo σ_s/σ_t per channel, 0 … 1, both included.
    pub albedo: Vec3,
    /// Mean cosine of the Henyey–Greenstein phase function, −0.999 … 0.999; > 0 scatters forward.
    pub g: f32,
    /// Where its albedo is lower; nowhere without.
    pub veins: Option<Veins>,
}

/// How a flight through a medium ended, and the factor by which the path's throughput changes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Flight {
    /// It was scattered at the distance; the weight includes the albedo, but not what veins take off it there.
    Scattered {
        /// Distance from the start, scene units.
        distance: f32,
        /// Factor on the throughput.
        weight: Vec3,
    },
    /// It reached the end of the medium.
    Passed {
        /// Factor on the throughput.
        weight: Vec3,
    },
}

/// A distance that was drawn and not yet compared with the length of the medium.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FreeFlight {
    /// Distance at which the light would be scattered in an endless medium; infinite in vacuum.
    pub distance: f32,
    /// Probability of each channel to have been the one that was drawn for.
    probability: Vec3,
}

impl Medium {
    /// A medium that treats all channels alike.
    pub fn gray(sigma_t: f32, albedo: f32, g: f32) -> Self {
        Self { sigma_t: Vec3::splat(sigma_t), albedo: Vec3::splat(albedo), g, veins: None }
    }

    /// `Err` where a number is outside its range.
    pub fn validate(&self) -> Result<(), PathtraceError> {
        check_rgb("sigma_t of a medium", self.sigma_t, "a finite number ≥ 0 and ≤ 10⁹ (per scene unit)", |v| {
            (0.0..=1e9).contains(&v)
        })?;
        check_rgb("albedo of a medium", self.albedo, "a number from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
        check("g of a medium", self.g, "a number from −0.999 to 0.999", |v| v.abs() <= MAX_MEAN_COSINE)?;
        self.veins.map_or(Ok(()), |veins| veins.validate())
    }

    /// What is left of light after `distance` (scene units, ≥ 0) in the medium.
    /// `[eq:transmittance]`
    #[inline]
    pub fn transmittance(&self, distance: f32) -> Vec3 {
        if self.sigma_t.x == self.sigma_t.y && self.sigma_t.x == self.sigma_t.z {
            return Vec3::splat((-self.sigma_t.x * distance).exp());
        }
        (-self.sigma_t * distance).exp()
    }

    /// Draws where the light would be scattered next if the medium never ended. `throughput` (≥ 0) is what the path carries;
    /// channels are drawn for in proportion to it.
    #[inline]
    pub fn fly(&self, throughput: Vec3, rng: &mut Rng) -> FreeFlight {
        let tau = rng.exponential();
        let s = self.sigma_t;
        if s.x == s.y && s.x == s.z {
            return FreeFlight { distance: tau / s.x, probability: Vec3::X };
        }
        let sum = throughput.element_sum();
        let probability = if sum > 0.0 { throughput / sum } else { Vec3::splat(1.0 / 3.0) };
        let u = rng.uniform();
        let sigma = if u < probability.x {
            s.x
        } else if u < probability.x + probability.y || probability.z == 0.0 {
            s.y
        } else {
            s.z
        };
        FreeFlight { distance: tau / sigma, probability }
    }

    /// What becomes of a flight when the medium ends at `end` (scene units, may be infinite).
    /// `[eq:spectral-flight]`
    #[inline]
    pub fn arrive(&self, flight: FreeFlight, end: f32) -> Flight {
        let s = self.sigma_t;
        let scattered = flight.distance < end;
        if s.x == s.y && s.x == s.z {
            return match scattered {
                true => Flight::Scattered { distance: flight.distance, weight: self.albedo },
                false => Flight::Passed { weight: Vec3::ONE },
            };
        }
        if scattered {
            let density = s * self.transmittance(flight.distance);
            let pdf = flight.probability.dot(density);
            let weight = if pdf > 0.0 { self.albedo * density / pdf } else { Vec3::ZERO };
            Flight::Scattered { distance: flight.distance, weight }
        } else {
            Flight::Passed { weight: self.passed(flight, end) }
        }
    }

    /// The weight of having come as far as `distance`, given that the flight went at least so far.
    #[inline]
    pub(crate) fn passed(&self, flight: FreeFlight, distance: f32) -> Vec3 {
        let s = self.sigma_t;
        if s.x == s.y && s.x == s.z {
            return Vec3::ONE;
        }
        // σ = 0 and an endless medium: exp(−0·∞).
        let left = Vec3::select(s.cmpeq(Vec3::ZERO), Vec3::ONE, self.transmittance(distance));
        let pdf = flight.probability.dot(left);
        if pdf > 0.0 { left / pdf } else { Vec3::ZERO }
    }
}

/// 1 + g² − 2g·cos, from the directions instead of their cosine: exact where the peak is narrow.
#[inline]
fn squared_denominator(g: f32, from: Vec3, to: Vec3) -> f32 {
    let a = g.abs();
    let apart = if g >= 0.0 { from - to } else { from + to };
    (1.0 - a) * (1.0 - a) + a * apart.length_squared()
}

/// Henyey–Greenstein: density per steradian of leaving in direction `to` for light that travelled along `from` (both unit).
/// It is its own sampling density.
/// `[eq:henyey-greenstein]`
#[inline]
pub fn henyey_greenstein(g: f32, from: Vec3, to: Vec3) -> f32 {
    if g == 0.0 {
        return crate::sampling::UNIFORM_SPHERE_PDF;
    }
    let d = squared_denominator(g, from, to);
    (1.0 - g * g) / (4.0 * PI * d * d.sqrt())
}

/// Draws a direction by [`henyey_greenstein`] for light that travels along `from` (unit).
/// `[eq:henyey-greenstein]`
#[inline]
pub fn sample_henyey_greenstein(g: f32, from: Vec3, rng: &mut Rng) -> Vec3 {
    if g == 0.0 {
        return crate::sampling::uniform_sphere(rng);
    }
    let u = rng.uniform();
    let a = g.abs();
    // cos = (1 + a² − s²)/(2a) with s = (1 − a²)/d, d = 1 − a + 2au. Its distance from 1, without cancellation:
    // 1 − cos = (s² − (1 − a)²)/(2a), and s − (1 − a) = 2a(1 − a)(1 − u)/d.
    let d = 1.0 - a + 2.0 * a * u;
    let s = (1.0 - a) * (1.0 + a) / d;
    let versine = ((1.0 - a) * (1.0 - u) / d * (s + 1.0 - a)).clamp(0.0, 2.0);
    let sin = (versine * (2.0 - versine)).max(0.0).sqrt();
    let axis = if g > 0.0 { from } else { -from };
    let (sin_phi, cos_phi) = (TAU * rng.uniform()).sin_cos();
    let frame = Frame::new(axis);
    (frame.x * (sin * cos_phi) + frame.y * (sin * sin_phi) + axis * (1.0 - versine)).normalize()
}
