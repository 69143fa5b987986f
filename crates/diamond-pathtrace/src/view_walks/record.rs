//! Walks that remember where lamps could be connected with them.
use super::entering_kernel::MIN_INNER_COSINE;
use super::{ViewWalkOptions, WalkStart};
use crate::bulk::directions::carried;
use crate::bulk::points::SurfacePoints;
use crate::exit_walks::walker::{Passage, pass};
use crate::geometry::{Facing, NO_PRIMITIVE};
use crate::medium::sample_henyey_greenstein;
use crate::sampling::cosine_hemisphere;
use crate::sobol::Sobol;
use crate::{Boundary, Frame, Geometry, Hit, Rng};
use glam::{Vec2, Vec2Swizzles, Vec3};

/// Surfaces met in air between two stretches inside, at most: beyond are meshes that are none.
const MAX_BOUNCES: u32 = 64;

/// Where a lamp's light can join a walk.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Connection {
    /// Index-matched: the scattering, in 65 535ths of the bounding box. Refracting: low and high half of the entrance's number.
    place: [u16; 3],
    /// Octahedral. Index-matched: along the walk, world. Refracting: along the walk, in the entrance's frame.
    direction: u16,
    /// Scatterings up to here, at least 1.
    pub scatterings: u16,
}

/// A unit vector as two bytes (octahedral map).
fn packed(v: Vec3) -> u16 {
    let v = v / (v.x.abs() + v.y.abs() + v.z.abs()).max(f32::MIN_POSITIVE);
    let p = match v.z < 0.0 {
        false => v.truncate(),
        true => (1.0 - v.truncate().yx().abs()) * Vec2::new(1f32.copysign(v.x), 1f32.copysign(v.y)),
    };
    let byte = |c: f32| ((c * 0.5 + 0.5) * 255.0).round().clamp(0.0, 255.0) as u16;
    byte(p.x) << 8 | byte(p.y)
}

/// See [`packed`].
fn unpacked(bits: u16) -> Vec3 {
    let p = Vec2::new(f32::from(bits >> 8), f32::from(bits & 255)) / 255.0 * 2.0 - 1.0;
    let z = 1.0 - p.x.abs() - p.y.abs();
    let p = match z < 0.0 {
        false => p,
        true => (1.0 - p.yx().abs()) * Vec2::new(1f32.copysign(p.x), 1f32.copysign(p.y)),
    };
    p.extend(z).normalize_or(Vec3::Z)
}

impl Connection {
    fn inside(place: Vec3, low: Vec3, size: Vec3, direction: Vec3, scatterings: u32) -> Self {
        let part = ((place - low) / size).to_array();
        let place = part.map(|v| (v * 65_535.0).round().clamp(0.0, 65_535.0) as u16);
        Self { place, direction: packed(direction), scatterings: scatterings as u16 }
    }

    fn at_entrance(entrance: u32, local: Vec3, scatterings: u32) -> Self {
        let place = [entrance as u16, (entrance >> 16) as u16, 0];
        Self { place, direction: packed(local), scatterings: scatterings as u16 }
    }

    /// World position of a scattering.
    pub fn position(&self, low: Vec3, size: Vec3) -> Vec3 {
        low + Vec3::from(self.place.map(|v| f32::from(v) / 65_535.0)) * size
    }

    /// Number of an entrance.
    pub fn entrance(&self) -> usize {
        usize::from(self.place[0]) | usize::from(self.place[1]) << 16
    }

    /// Unit direction along the walk.
    pub fn direction(&self) -> Vec3 {
        unpacked(self.direction)
    }
}

/// The box in which positions are told, without sides of length 0; nothing for shapes without end.
pub(crate) fn enclosing(geometry: &Geometry) -> (Vec3, Vec3) {
    let (low, high) = geometry.bounds();
    (low, (high - low).max(Vec3::splat(f32::MIN_POSITIVE)))
}

/// With which probability a scattering is kept.
#[inline]
pub(crate) fn kept(geometry: &Geometry, sigma_t: f32, position: Vec3, connections: f32) -> f32 {
    (connections * (-sigma_t * geometry.clearance(position)).exp()).min(1.0)
}

/// What walks need to know.
pub(crate) struct Recorder<'a> {
    geometry: &'a Geometry,
    sigma_t: f32,
    g: f32,
    boundary: Boundary,
    options: ViewWalkOptions,
    entrances: Option<&'a SurfacePoints>,
    low: Vec3,
    high: Vec3,
    size: Vec3,
}

/// A walk inside the object.
struct State {
    origin: Vec3,
    direction: Vec3,
    skip: u32,
    scatterings: u32,
}

impl<'a> Recorder<'a> {
    pub fn new(
        geometry: &'a Geometry,
        sigma_t: f32,
        g: f32,
        boundary: Boundary,
        options: ViewWalkOptions,
        entrances: Option<&'a SurfacePoints>,
    ) -> Self {
        let (low, high) = geometry.bounds();
        let (_, size) = enclosing(geometry);
        Self { geometry, sigma_t, g, boundary: boundary.effective(), options, entrances, low, high, size }
    }

    /// All walks of a start, and how many were cut off; `stream` numbers its random numbers.
    pub fn walks_from(&self, start: &WalkStart, stream: u64) -> (Vec<Connection>, u32) {
        let mut rng = Rng::new(self.options.seed, stream);
        let mut numbers = Sobol::new(std::array::from_fn(|_| rng.bits()));
        let frame = Frame::new(start.normal);
        let (mut connections, mut cut) = (Vec::new(), 0);
        for _ in 0..self.options.walks {
            rng.lead_with(numbers.draw());
            let outward = start.direction.unwrap_or_else(|| frame.to_world(cosine_hemisphere(&mut rng)));
            if outward.dot(start.normal) <= 0.0 {
                continue;
            }
            let Passage::Transmitted(direction) = pass(self.boundary, outward, start.normal, &mut rng) else {
                continue;
            };
            let mut state = State { origin: start.position, direction, skip: NO_PRIMITIVE, scatterings: 0 };
            cut += u32::from(self.walk(&mut state, &mut rng, &mut connections));
        }
        (connections, cut)
    }

    /// One walk; whether it was cut off.
    fn walk(&self, p: &mut State, rng: &mut Rng, connections: &mut Vec<Connection>) -> bool {
        let geometry = self.geometry;
        loop {
            let flight = rng.exponential() / self.sigma_t;
            let hit = match geometry.holds_flight(p.origin, p.direction, flight) {
                true => None,
                false => geometry.closest_hit(p.origin, p.direction, flight, Facing::Leaving, p.skip),
            };
            if let Some(hit) = hit {
                if self.surface(p, hit, rng, connections) {
                    continue;
                }
                return false;
            }
            p.origin += p.direction * flight;
            p.skip = NO_PRIMITIVE;
            // Written so that NaN fails it. A walk that rounding has brought outside at an edge ends here.
            if !(p.origin.cmpge(self.low).all() && p.origin.cmple(self.high).all()) {
                return false;
            }
            if p.scatterings == self.options.max_events {
                return true;
            }
            p.scatterings += 1;
            if self.entrances.is_none() {
                let connection = Connection::inside(p.origin, self.low, self.size, p.direction, p.scatterings);
                // Of the position as it is kept, so that the same number is found again.
                let place = connection.position(self.low, self.size);
                if rng.uniform() < kept(geometry, self.sigma_t, place, self.options.connections) {
                    connections.push(connection);
                }
            }
            p.direction = sample_henyey_greenstein(self.g, p.direction, rng);
        }
    }

    /// The walk meets the surface from inside; whether it is inside again afterwards.
    #[inline]
    fn surface(&self, p: &mut State, mut hit: Hit, rng: &mut Rng, connections: &mut Vec<Connection>) -> bool {
        if let Some(points) = self.entrances
            && p.scatterings > 0
            && p.direction.dot(hit.normal) > MIN_INNER_COSINE
        {
            let entrance = points.nearest(hit.position, hit.normal);
            let frame = Frame::new(points.points()[entrance as usize].smooth_normal);
            let local = carried(p.direction, hit.normal, frame);
            connections.push(Connection::at_entrance(entrance, local, p.scatterings));
        }
        // Through the surface, perhaps around outside, and back in.
        let mut inside = true;
        for _ in 0..MAX_BOUNCES {
            match pass(self.boundary, -p.direction, hit.normal, rng) {
                Passage::Absorbed => return false,
                Passage::Reflected(direction) => p.direction = direction,
                Passage::Transmitted(direction) => {
                    p.direction = direction;
                    inside = !inside;
                }
            }
            if inside {
                (p.origin, p.skip) = (hit.position, hit.primitive);
                return true;
            }
            let (at, skip) = (hit.position, hit.primitive);
            let Some(next) = self.geometry.closest_hit(at, p.direction, f32::INFINITY, Facing::Entering, skip) else {
                return false;
            };
            hit = next;
        }
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampling::uniform_sphere;

    #[test]
    fn directions_survive_packing() {
        let mut rng = Rng::new(6, 6);
        let worst = (0..20_000)
            .map(|_| {
                let v = uniform_sphere(&mut rng);
                (unpacked(packed(v)) - v).length()
            })
            .fold(0.0, f32::max);
        assert!(worst < 0.017, "{worst}");
    }
}
