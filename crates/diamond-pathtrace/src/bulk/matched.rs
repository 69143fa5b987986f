//! Index-matched objects: what is scattered at least twice, gathered at points of the surface.
//!
//! For a point and an outward direction, the light that comes from the first stretch of the ray into the object is
//! (1 − e^(−σ_t s))·f, with s the length of the stretch and f the mean of the light scattered towards the point, weighted by where the ray is
//! scattered. The first factor is known exactly whenever a picture is made; f is smooth in place and direction, also towards outlines
//! where s goes to 0, and is what is stored. Light that is scattered once is left out: pictures add it exactly.
//!
//! A walk starts with a scattering on the stretch, goes on as light would backwards, and at some of its further scatterings is connected with
//! all lights. How likely a connection is follows from how much could come of it.
use super::BulkOptions;
use super::directions::{HEMISPHERE, HEMISPHERE_MEAN, Moments, basis};
use super::lamps::Lamps;
use super::light_map::{LightMaps, Ways};
use super::points::SurfacePoint;
use crate::geometry::{Facing, NO_PRIMITIVE};
use crate::medium::{Flight, henyey_greenstein, sample_henyey_greenstein};
use crate::sobol::Sobol;
use crate::{Frame, Geometry, Medium, Rng};
use glam::{Vec2, Vec3};
use std::f32::consts::TAU;

/// Walks that carry less than this are subject to roulette; survivors carry this much.
const ROULETTE: f32 = 0.5;

/// What walks need to know.
pub(crate) struct MatchedWalks<'a> {
    pub geometry: &'a Geometry,
    pub medium: Medium,
    pub lamps: &'a Lamps,
    pub maps: &'a LightMaps<'a>,
    pub options: BulkOptions,
}

/// A distance in (0, length] drawn from the mean over channels of the densities of a first scattering on a stretch that is certain
/// to scatter, and each channel's density over that mean. `u` is uniform in [0, 1), `channel` one of three, equally likely.
/// `[eq:forced-flight]`
#[inline]
pub(crate) fn forced_flight(sigma_t: Vec3, length: f32, channel: usize, u: f32) -> (f32, Vec3) {
    let sigma = sigma_t[channel];
    // 1 − e^(−σs) without cancellation, and its limit in thin media.
    let scattered = |sigma: f32| -(-sigma * length).exp_m1();
    let distance = match sigma * length > 1e-6 {
        true => -(-u * scattered(sigma)).ln_1p() / sigma,
        false => u * length,
    };
    let distance = distance.clamp(0.0, length);
    if sigma_t.x == sigma_t.y && sigma_t.x == sigma_t.z {
        return (distance, Vec3::ONE);
    }
    (distance, weights_at(sigma_t, length, distance))
}

/// Steps of [`forced_flight_quantile`] at most; where channels are alike three are enough.
const STEPS: usize = 24;

/// A step that is shorter, as a fraction of the length, is the last.
const STEP_ENOUGH: f32 = 1e-6;

/// The distance at which the mean distribution of [`forced_flight`] reaches `u`: one number instead of two leaves nothing
/// to the choice of a channel. The same weights.
/// `[eq:forced-flight]`
pub(crate) fn forced_flight_quantile(sigma_t: Vec3, length: f32, u: f32) -> (f32, Vec3) {
    if sigma_t.x == sigma_t.y && sigma_t.x == sigma_t.z {
        return forced_flight(sigma_t, length, 0, u);
    }
    // Of each channel: whether it is too thin for its exponential to differ from a line, and 1 − e^(−σs).
    let scattered = sigma_t.to_array().map(|sigma| -(-sigma * length).exp_m1());
    let thin = |c: usize| sigma_t[c] * length <= 1e-6;
    // Where the first channel gets there, the mean is not yet there.
    let mut distance = f32::INFINITY;
    for c in 0..3 {
        let quantile = if thin(c) { u * length } else { -(-u * scattered[c]).ln_1p() / sigma_t[c] };
        distance = distance.min(quantile);
    }
    // Newton's steps on a concave function come nearer from the left and never pass.
    for _ in 0..STEPS {
        let (mut sum, mut slope) = (0.0, 0.0);
        for c in 0..3 {
            let (part, density) = match thin(c) {
                true => (distance / length, 1.0 / length),
                false => {
                    let left = (-sigma_t[c] * distance).exp_m1();
                    (-left / scattered[c], sigma_t[c] * (1.0 + left) / scattered[c])
                }
            };
            sum += part;
            slope += density;
        }
        let step = (3.0 * u - sum) / slope;
        // Of NaN, as of a step that is too short, nothing is taken.
        let enough = step > STEP_ENOUGH * length;
        if !enough {
            break;
        }
        distance += step;
    }
    let distance = distance.clamp(0.0, length);
    (distance, weights_at(sigma_t, length, distance))
}

/// Each channel's density at a distance over the mean of all.
#[inline]
fn weights_at(sigma_t: Vec3, length: f32, distance: f32) -> Vec3 {
    let density = |sigma: f32| match sigma * length > 1e-6 {
        true => sigma * (-sigma * distance).exp() / -(-sigma * length).exp_m1(),
        false => 1.0 / length,
    };
    let densities = Vec3::new(density(sigma_t.x), density(sigma_t.y), density(sigma_t.z));
    let mean = densities.element_sum() / 3.0;
    if mean > 0.0 { densities / mean } else { Vec3::ZERO }
}

/// The fractional part of `i` mirrored at the binary point.
#[inline]
pub(crate) fn radical_inverse(i: u32) -> f32 {
    (i.reverse_bits() >> 8) as f32 / 16_777_216.0
}

/// Point `i` of `n` of a Hammersley set, moved by `shift` and wrapped.
#[inline]
pub(crate) fn hammersley(i: u32, n: u32, shift: Vec2) -> Vec2 {
    let p = Vec2::new((i as f32 + 0.5) / n as f32, radical_inverse(i)) + shift;
    (p - p.floor()).clamp(Vec2::ZERO, Vec2::splat(1.0 - f32::EPSILON))
}

/// Numbers that one walk gathers: for each channel, for each light.
struct Gathered {
    values: Vec<f32>,
    touched: bool,
    ways: Ways,
}

impl MatchedWalks<'_> {
    /// Coefficients of f at a point: for each function of the direction, each channel, each light.
    pub fn gather(&self, point: &SurfacePoint, index: usize) -> Vec<f32> {
        let lights = self.lamps.len();
        let width = 3 * lights;
        let mut sums = vec![0.0f32; HEMISPHERE * width];
        let mut moments = Moments::<HEMISPHERE>::new();
        let mut gathered = Gathered { values: vec![0.0; width], touched: false, ways: Ways::default() };
        let frame = Frame::new(point.smooth_normal);
        let mut rng = Rng::new(self.options.seed, index as u64);
        let mut numbers = Sobol::new(std::array::from_fn(|_| rng.bits()));
        for _ in 0..self.options.walks {
            rng.lead_with(numbers.draw());
            let u = Vec2::new(rng.uniform(), rng.uniform());
            let radius = u.x.sqrt();
            let (sin, cos) = (TAU * u.y).sin_cos();
            let local = Vec3::new(radius * cos, radius * sin, (1.0 - u.x).max(0.0).sqrt());
            let outward = frame.to_world(local);
            // Behind the surface itself there is no object.
            if outward.dot(point.normal) <= 0.0 {
                continue;
            }
            let values = basis::<HEMISPHERE>(local, HEMISPHERE_MEAN);
            if !self.walk(point, -outward, &mut rng, &mut gathered) {
                continue;
            }
            moments.add(&values, 1.0);
            if gathered.touched {
                for (row, b) in sums.chunks_exact_mut(width).zip(values) {
                    row.iter_mut().zip(&gathered.values).for_each(|(sum, v)| *sum += b * v);
                }
                gathered.values.fill(0.0);
                gathered.touched = false;
            }
        }
        let inverse = moments.inverse();
        let mut coefficients = vec![0.0f32; HEMISPHERE * width];
        for (row, weights) in coefficients.chunks_exact_mut(width).zip(&inverse) {
            for (sum, w) in sums.chunks_exact(width).zip(weights) {
                row.iter_mut().zip(sum).for_each(|(c, s)| *c += w * s);
            }
        }
        coefficients
    }

    /// One walk; whether it entered the object at all.
    fn walk(&self, point: &SurfacePoint, direction: Vec3, rng: &mut Rng, gathered: &mut Gathered) -> bool {
        let (geometry, medium) = (self.geometry, self.medium);
        let leaving = geometry.closest_hit(point.position, direction, f32::INFINITY, Facing::Leaving, point.primitive);
        let Some(end) = leaving else { return false };
        let channel = ((3.0 * rng.uniform()) as usize).min(2);
        let (distance, weight) = forced_flight(medium.sigma_t, end.distance, channel, rng.uniform());
        let mut origin = point.position + direction * distance;
        let mut throughput = weight * medium.albedo * medium.variation(origin);
        let mut direction = sample_henyey_greenstein(medium.g, direction, rng);
        let mut skip = NO_PRIMITIVE;
        let (low, high) = geometry.bounds();
        for _ in 0..self.options.max_events {
            let carried = throughput.max_element();
            if carried < ROULETTE {
                if rng.uniform() * ROULETTE >= carried {
                    return true;
                }
                throughput *= ROULETTE / carried;
            }
            let flight = medium.fly(throughput, rng);
            let hit = match flight.distance < geometry.clearance(origin) {
                true => None,
                false => geometry.closest_hit(origin, direction, flight.distance, Facing::Leaving, skip),
            };
            match medium.arrive(flight, hit.map_or(f32::INFINITY, |hit| hit.distance)) {
                Flight::Scattered { distance, weight } => {
                    origin += direction * distance;
                    throughput *= weight * medium.variation(origin);
                    skip = NO_PRIMITIVE;
                    let within = origin.cmpge(low).all() && origin.cmple(high).all();
                    if !within || throughput.max_element() <= 0.0 {
                        return true;
                    }
                    self.connect(origin, direction, throughput, rng, gathered);
                    direction = sample_henyey_greenstein(medium.g, direction, rng);
                }
                Flight::Passed { weight } => {
                    throughput *= weight;
                    let Some(hit) = hit else { return true };
                    let next =
                        geometry.closest_hit(hit.position, direction, f32::INFINITY, Facing::Entering, hit.primitive);
                    let Some(next) = next else { return true };
                    origin = next.position;
                    skip = next.primitive;
                }
            }
        }
        true
    }

    /// Light that comes straight from the lamps to `origin` and is scattered against the walk.
    #[inline]
    fn connect(&self, origin: Vec3, direction: Vec3, throughput: Vec3, rng: &mut Rng, gathered: &mut Gathered) {
        let medium = self.medium;
        let bound = (throughput * medium.transmittance(self.geometry.clearance(origin))).max_element();
        let probability = (bound * self.options.connections).min(1.0);
        if rng.uniform() >= probability {
            return;
        }
        let weight = throughput / probability;
        let lights = self.lamps.len();
        let gray = medium.sigma_t.x == medium.sigma_t.y && medium.sigma_t.x == medium.sigma_t.z;
        gathered.touched = true;
        let (red, rest) = gathered.values.split_at_mut(lights);
        let (green, blue) = rest.split_at_mut(lights);
        self.maps.look_up(self.lamps, origin, &mut gathered.ways);
        for (l, (shine, length)) in gathered.ways.shines.iter().zip(&gathered.ways.lengths).enumerate() {
            let value = shine.factor * henyey_greenstein(medium.g, direction, shine.direction);
            let left = match gray {
                true => Vec3::splat((-medium.sigma_t.x * length).exp()),
                false => (-medium.sigma_t * *length).exp(),
            };
            let sent = weight * left * value;
            red[l] += sent.x;
            green[l] += sent.y;
            blue[l] += sent.z;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `[eq:forced-flight]`: weighted histograms are the truncated exponentials of every channel.
    #[test]
    fn forced_flights_end_as_the_medium_says() {
        let (sigma_t, length) = (Vec3::new(0.0, 1.5, 9.0), 1.3f32);
        let mut rng = Rng::new(2, 2);
        let n = 200_000;
        let mut sums = [Vec3::ZERO; 3];
        for i in 0..n {
            let u = rng.uniform();
            let (t, weight) = match i % 2 {
                0 => forced_flight(sigma_t, length, (i / 2) % 3, u),
                _ => forced_flight_quantile(sigma_t, length, u),
            };
            assert!((0.0..=length).contains(&t) && weight.is_finite());
            sums[0] += weight / n as f32;
            sums[1] += weight * t / n as f32;
            sums[2] += weight * f32::from(u8::from(t < 0.2)) / n as f32;
        }
        let all = |s: f32| 1.0 - (-s * length).exp();
        let mean = |s: f32| if s == 0.0 { 0.5 * length } else { 1.0 / s - length * (-s * length).exp() / all(s) };
        let near = |s: f32| if s == 0.0 { 0.2 / length } else { (1.0 - (-s * 0.2).exp()) / all(s) };
        for c in 0..3 {
            let s = sigma_t[c];
            for (found, expected) in [(sums[0][c], 1.0), (sums[1][c], mean(s)), (sums[2][c], near(s))] {
                assert!((found - expected).abs() < 0.012 * expected, "channel {c}: {found} {expected}");
            }
        }
    }
}
