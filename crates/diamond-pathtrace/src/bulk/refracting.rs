//! Refracting objects: all light that arrives under the surface, gathered at points of it.
//!
//! What is seen of the inside comes through a narrow cone (42° for an index of 1.5) in which light varies little, so it is stored
//! as a linear function of the inner direction. Light enters through the same cone. The one path that connects a light with a
//! point inside bends at the surface and is not drawn; instead each walk that meets the surface from inside is given the light
//! that enters there, with a kernel in place of the exact direction: the kernel agrees with the exact one on all functions that are linear
//! over the cone. Energy is kept exactly, refraction up to what is not linear.
use super::BulkOptions;
use super::directions::{CONE, Moments, basis, carried};
use super::lamps::Lamps;
use super::matched::hammersley;
use super::points::{SurfacePoint, SurfacePoints};
use crate::geometry::{Facing, NO_PRIMITIVE};
use crate::medium::{Flight, sample_henyey_greenstein};
use crate::{Boundary, Frame, Geometry, Medium, Rng};
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::f32::consts::{PI, TAU};

/// Energy that carries less than this is subject to roulette; survivors carry this much.
const ROULETTE: f32 = 0.5;

/// Angles of incidence in the table of a boundary.
const ANGLES: usize = 64;

/// Directions for each angle.
const DIRECTIONS: u32 = 4096;

/// What passes a boundary, and how it is then directed.
#[derive(Debug, Clone)]
pub(crate) struct Cone {
    boundary: Boundary,
    /// Squared index of refraction.
    pub eta2: f32,
    /// Directions nearer to the normal than this cosine are stored.
    min_cos: f32,
    /// Mean cosine of the cone's directions, weighted by the cosine.
    pub mean_cos: f32,
    /// For cosines (k + ½)/[`ANGLES`] outside: the energy that passes, its mean cosine and its mean tangential part inside.
    passed: Vec<Vec3>,
    /// Inverse of the products of the functions over the cone, weighted by the cosine.
    inverse: [[f32; CONE]; CONE],
}

impl Cone {
    /// The cone of a boundary that refracts; `None` for one that does not.
    pub fn new(boundary: Boundary) -> Option<Self> {
        let (eta, alpha) = match boundary.effective() {
            Boundary::IndexMatched => return None,
            Boundary::Smooth { eta } => (eta, 0.0),
            Boundary::Rough { eta, alpha } => (eta, alpha),
        };
        // Rough surfaces widen the cone.
        let min_cos = ((1.0 - 1.0 / (eta * eta)).max(0.0).sqrt() - alpha).max(0.0);
        let passed = (0..ANGLES)
            .into_par_iter()
            .map(|k| {
                let cos = (k as f32 + 0.5) / ANGLES as f32;
                let outside = Vec3::new((1.0 - cos * cos).sqrt(), 0.0, cos);
                let mut rng = Rng::new(1, k as u64);
                let mut sum = Vec3::ZERO;
                for _ in 0..DIRECTIONS {
                    let Some(s) = boundary.sample(outside, Vec3::Z, &mut rng) else { continue };
                    if s.transmitted {
                        let energy = s.weight * s.energy_scale;
                        sum += Vec3::new(1.0, -s.direction.z, -s.direction.x) * energy;
                    }
                }
                sum / DIRECTIONS as f32
            })
            .collect();
        let mut moments = Moments::<CONE>::new();
        let steps = 64;
        for i in 0..steps * steps {
            let (u, v) = ((i % steps) as f32 + 0.5, (i / steps) as f32 + 0.5);
            let local = cone_direction(min_cos, Vec2::new(u, v) / steps as f32);
            let weight = f64::from(PI * (1.0 - min_cos * min_cos)) / f64::from(steps * steps);
            moments.add(&basis(local, 0.0), weight);
        }
        let mean_cos = 2.0 / 3.0 * (1.0 - min_cos.powi(3)) / (1.0 - min_cos * min_cos);
        Some(Self { boundary, eta2: eta * eta, min_cos, mean_cos, passed, inverse: moments.inverse() })
    }

    /// Whether light that meets the surface from inside along `direction` may have come in there against it.
    #[inline]
    pub fn holds(&self, direction: Vec3, normal: Vec3) -> bool {
        direction.dot(normal) >= self.min_cos
    }

    /// What the entering moments are multiplied by for light that goes against the local direction.
    #[inline]
    pub fn kernel(&self, local: Vec3) -> [f32; CONE] {
        let values = basis::<CONE>(local, 0.0);
        std::array::from_fn(|k| self.inverse[k].iter().zip(&values).map(|(a, b)| a * b).sum())
    }

    /// Of light from the unit direction `outside`: the fraction that passes, and the sum of its inner directions (reversed, so that they point
    /// outward), world.
    pub fn pass(&self, outside: Vec3, normal: Vec3) -> (f32, Vec3) {
        let cos = outside.dot(normal);
        if cos <= 0.0 {
            return (0.0, Vec3::ZERO);
        }
        let at = (cos * ANGLES as f32 - 0.5).clamp(0.0, ANGLES as f32 - 1.0);
        let k = (at as usize).min(ANGLES - 2);
        let mut m = self.passed[k].lerp(self.passed[k + 1], at - k as f32);
        if cos < 0.5 / ANGLES as f32 {
            // Nothing passes at grazing angles.
            m *= cos * 2.0 * ANGLES as f32;
        }
        let tangent = (outside - normal * cos).normalize_or_zero();
        (m.x, normal * m.y + tangent * m.z)
    }
}

/// A direction of the cone about +z whose cosines are at least `min_cos`, with density in proportion to the cosine.
#[inline]
fn cone_direction(min_cos: f32, u: Vec2) -> Vec3 {
    let sin2 = u.x * (1.0 - min_cos * min_cos);
    let (sin, cos) = (TAU * u.y).sin_cos();
    Vec3::new(sin2.sqrt() * cos, sin2.sqrt() * sin, (1.0 - sin2).max(0.0).sqrt())
}

/// Light that enters at each point: for each function of the direction, each light.
pub(crate) fn entering(geometry: &Geometry, lamps: &Lamps, points: &SurfacePoints, cone: &Cone) -> Vec<f32> {
    let rows: Vec<Vec<f32>> = points
        .points()
        .par_iter()
        .map(|point| {
            let lights = lamps.len();
            let mut row = vec![0.0f32; CONE * lights];
            let frame = Frame::new(point.smooth_normal);
            for l in 0..lights {
                let shine = lamps.shine(l, point.position);
                let cos = shine.direction.dot(point.normal);
                let blocked = || {
                    geometry.occluded(
                        point.position,
                        shine.direction,
                        shine.distance,
                        Facing::Entering,
                        point.primitive,
                    )
                };
                if cos <= 0.0 || blocked() {
                    continue;
                }
                let (passed, sum) = cone.pass(shine.direction, point.normal);
                let local = carried(sum, point.normal, frame);
                let received = shine.factor * cos;
                for (b, m) in [passed, local.z, local.x, local.y].into_iter().enumerate() {
                    row[b * lights + l] = received * m;
                }
            }
            row
        })
        .collect();
    rows.concat()
}

/// What walks need to know.
pub(crate) struct RefractingWalks<'a> {
    pub geometry: &'a Geometry,
    pub medium: Medium,
    pub lamps: &'a Lamps,
    pub points: &'a SurfacePoints,
    pub cone: &'a Cone,
    pub options: BulkOptions,
    /// Light that enters at each point: for each function of the direction, each light.
    entering: Vec<f32>,
}

impl<'a> RefractingWalks<'a> {
    /// Traces which point sees which light.
    pub fn new(
        geometry: &'a Geometry,
        medium: Medium,
        lamps: &'a Lamps,
        points: &'a SurfacePoints,
        cone: &'a Cone,
        options: BulkOptions,
    ) -> Self {
        let entering = entering(geometry, lamps, points, cone);
        Self { geometry, medium, lamps, points, cone, options, entering }
    }

    /// Coefficients of the light under a point: for each function of the direction, each channel, each light.
    pub fn gather(&self, point: &SurfacePoint, index: usize) -> Vec<f32> {
        let width = 3 * self.lamps.len();
        let mut sums = vec![0.0f32; CONE * width];
        let mut moments = Moments::<CONE>::new();
        let mut gathered = vec![0.0f32; width];
        let frame = Frame::new(point.smooth_normal);
        let mut rng = Rng::new(self.options.seed, index as u64);
        let shift = Vec2::new(rng.uniform(), rng.uniform());
        for i in 0..self.options.walks {
            let local = cone_direction(self.cone.min_cos, hammersley(i, self.options.walks, shift));
            let outward = frame.to_world(local);
            if outward.dot(point.normal) <= 0.0 {
                continue;
            }
            let values = basis::<CONE>(local, self.cone.mean_cos);
            moments.add(&values, 1.0);
            if self.walk(point, -outward, &mut rng, &mut gathered) {
                for (row, b) in sums.chunks_exact_mut(width).zip(values) {
                    row.iter_mut().zip(&gathered).for_each(|(sum, v)| *sum += b * v);
                }
                gathered.fill(0.0);
            }
        }
        let inverse = moments.inverse();
        let mut coefficients = vec![0.0f32; CONE * width];
        for (row, weights) in coefficients.chunks_exact_mut(width).zip(&inverse) {
            for (sum, w) in sums.chunks_exact(width).zip(weights) {
                row.iter_mut().zip(sum).for_each(|(c, s)| *c += w * s);
            }
        }
        coefficients
    }

    /// One walk; whether it gathered anything.
    fn walk(&self, point: &SurfacePoint, direction: Vec3, rng: &mut Rng, gathered: &mut [f32]) -> bool {
        let (geometry, medium) = (self.geometry, self.medium);
        let mut touched = false;
        let (mut origin, mut direction, mut skip) = (point.position, direction, point.primitive);
        let (mut throughput, mut energy) = (Vec3::ONE, 1.0f32);
        let (low, high) = geometry.bounds();
        for _ in 0..self.options.max_events {
            let carried = (throughput * energy).max_element();
            if carried < ROULETTE {
                if rng.uniform() * ROULETTE >= carried {
                    return touched;
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
                        return touched;
                    }
                    direction = sample_henyey_greenstein(medium.g, direction, rng);
                }
                Flight::Passed { weight } => {
                    throughput *= weight;
                    let Some(mut hit) = hit else { return touched };
                    touched |= self.connect(hit.position, hit.normal, direction, throughput, gathered);
                    let mut inside = true;
                    // Through the surface, perhaps around outside, and back in.
                    for _ in 0..64 {
                        let Some(s) = self.cone.boundary.sample(-direction, hit.normal, rng) else { return touched };
                        throughput *= s.weight;
                        energy *= s.energy_scale;
                        direction = s.direction;
                        inside ^= s.transmitted;
                        if inside {
                            break;
                        }
                        let next = geometry.closest_hit(
                            hit.position,
                            direction,
                            f32::INFINITY,
                            Facing::Entering,
                            hit.primitive,
                        );
                        let Some(next) = next else { return touched };
                        hit = next;
                    }
                    (origin, skip) = (hit.position, hit.primitive);
                    if !inside {
                        return touched;
                    }
                }
            }
        }
        touched
    }

    /// Light that enters where a walk meets the surface from inside, as far as it goes against the walk.
    /// `[eq:entering-light]`
    #[inline]
    fn connect(&self, at: Vec3, normal: Vec3, direction: Vec3, throughput: Vec3, gathered: &mut [f32]) -> bool {
        if !self.cone.holds(direction, normal) {
            return false;
        }
        let k = self.points.nearest(at, normal) as usize;
        let frame = Frame::new(self.points.points()[k].smooth_normal);
        let g = self.cone.kernel(carried(direction, normal, frame));
        let lights = self.lamps.len();
        let rows = &self.entering[k * CONE * lights..(k + 1) * CONE * lights];
        let (r0, rest) = rows.split_at(lights);
        let (r1, rest) = rest.split_at(lights);
        let (r2, r3) = rest.split_at(lights);
        let (red, rest) = gathered.split_at_mut(lights);
        let (green, blue) = rest.split_at_mut(lights);
        for l in 0..lights {
            let value = g[0] * r0[l] + g[1] * r1[l] + g[2] * r2[l] + g[3] * r3[l];
            red[l] += throughput.x * value;
            green[l] += throughput.y * value;
            blue[l] += throughput.z * value;
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fresnel::dielectric;

    /// `[eq:entering-light]`: what passes a polished boundary follows Fresnel and Snell, and the kernel gives linear functions
    /// over the cone their exact values.
    #[test]
    fn the_kernel_is_exact_on_linear_functions() {
        let eta = 1.4f32;
        let cone = Cone::new(Boundary::Smooth { eta }).unwrap();
        for cos in [0.3f32, 0.6, 0.95] {
            let outside = Vec3::new((1.0 - cos * cos).sqrt(), 0.0, cos);
            let (passed, sum) = cone.pass(outside, Vec3::Z);
            let (reflectance, cos_t) = dielectric(cos, eta);
            assert!((passed - (1.0 - reflectance)).abs() < 0.03, "{passed} {reflectance}");
            let inner = sum / passed;
            assert!((inner - Vec3::new(outside.x / eta, 0.0, cos_t)).length() < 0.01, "{inner}");
            // ∫ kernel·f·cos over the cone, for a linear f.
            let f = |w: Vec3| 0.3 + w.dot(Vec3::new(0.7, -0.2, 1.1));
            let moments = [passed, sum.z, sum.x, sum.y];
            let n = 128;
            let mut integral = 0.0;
            for i in 0..n * n {
                let u = Vec2::new((i % n) as f32 + 0.5, (i / n) as f32 + 0.5) / n as f32;
                let w = cone_direction(cone.min_cos, u);
                let b = basis::<CONE>(w, 0.0);
                let kernel: f32 =
                    (0..CONE).map(|i| b[i] * (0..CONE).map(|j| cone.inverse[i][j] * moments[j]).sum::<f32>()).sum();
                integral += kernel * f(w) * PI * (1.0 - cone.min_cos * cone.min_cos) / (n * n) as f32;
            }
            assert!((integral - passed * f(inner)).abs() < 2e-3 * integral, "{integral}");
        }
    }
}
