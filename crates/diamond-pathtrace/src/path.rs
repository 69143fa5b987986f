//! One path from the camera through the object, and the light of every lamp that reaches it.
//!
//! The path is drawn as light would travel backwards: free flights, Henyey–Greenstein, visible microfacets. At each vertex every lamp
//! is connected with it, so one path carries the pictures of all lamps. Lamps with an extent are also found by chance, and the two
//! ways are weighted against each other (balance heuristic); smooth environments are found by chance only. A path ends by roulette
//! on what it carries, never on a fixed probability: a survival cap below the albedo would make the variance infinite.
use crate::geometry::{Facing, NO_PRIMITIVE};
use crate::medium::{Flight, henyey_greenstein, sample_henyey_greenstein};
use crate::sampling::balance_heuristic;
use crate::{Boundary, Hit, Light, Medium, PathtraceError, Rng, Scene};
use glam::Vec3;

/// Paths that carry less than this are subject to roulette; survivors carry this much. `[eq:roulette]`
const ROULETTE: f32 = 0.5;

/// Connections from a point that is so deep that no lamp can bring more than this are made at random, in proportion.
const CONNECTION_ROULETTE: f32 = 0.5;

/// How paths are traced.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathOptions {
    /// Scatterings and surface events after which a path is cut off and counted as such. The default is beyond what roulette
    /// leaves alive, but in a medium without absorption.
    pub max_events: u32,
    /// Whether lamps are seen by rays that have not touched the object.
    pub show_lights: bool,
}

impl Default for PathOptions {
    fn default() -> Self {
        Self { max_events: 10_000_000, show_lights: false }
    }
}

/// What became of a path.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PathEnd {
    /// Whether it met the object.
    pub hit: bool,
    /// Scatterings and surface events.
    pub events: u32,
    /// Whether it was cut off by [`PathOptions::max_events`].
    pub truncated: bool,
}

/// A lamp with what the scene says of it.
#[derive(Debug, Clone, Copy)]
struct Lamp<'a> {
    light: &'a Light,
    /// Whether some of it may lie inside the object.
    inside: bool,
}

/// A scene ready for paths.
#[derive(Debug)]
pub struct Tracer<'a> {
    scene: &'a Scene,
    medium: Medium,
    boundary: Boundary,
    lamps: Vec<Lamp<'a>>,
    /// Indices of the discs.
    discs: Vec<usize>,
    any_inside: bool,
    /// Whether connections that can bring little are left to chance: where they cost more than to find that out.
    sparing: bool,
    bounds: (Vec3, Vec3),
    options: PathOptions,
}

/// A path on its way.
struct State {
    origin: Vec3,
    direction: Vec3,
    /// Radiance that one unit from ahead would bring to the camera.
    throughput: Vec3,
    /// What turns the throughput into energy: the squared index of refraction where the path is.
    energy: f32,
    inside: bool,
    skip: u32,
    /// Where the direction was drawn and with which density, if lamps were connected there too.
    last: Option<(Vec3, f32)>,
    /// Whether the path has met the object.
    seen: bool,
}

impl<'a> Tracer<'a> {
    /// Checks the scene and prepares it.
    pub fn new(scene: &'a Scene, options: PathOptions) -> Result<Self, PathtraceError> {
        scene.validate()?;
        let (low, high) = scene.geometry.bounds();
        let lamps: Vec<Lamp> = scene
            .lights
            .iter()
            .map(|light| {
                let touches = |(centre, radius): (Vec3, f32)| {
                    centre.cmpge(low - radius).all() && centre.cmple(high + radius).all()
                };
                Lamp { light, inside: light.ball().is_some_and(touches) }
            })
            .collect();
        let any_inside = lamps.iter().any(|lamp| lamp.inside);
        Ok(Self {
            scene,
            medium: scene.material.medium,
            boundary: scene.material.boundary.effective(),
            discs: (0..lamps.len()).filter(|l| matches!(lamps[*l].light, Light::Disc { .. })).collect(),
            any_inside,
            sparing: !any_inside && (matches!(scene.geometry, crate::Geometry::Mesh(_)) || lamps.len() > 2),
            lamps,
            bounds: (low, high),
            options,
        })
    }

    /// The scene.
    pub fn scene(&self) -> &'a Scene {
        self.scene
    }

    /// Whether rays that miss the object see lamps.
    pub(crate) fn shows_lights(&self) -> bool {
        self.options.show_lights
    }

    /// Traces one path from `origin` along the unit `direction`; `inside` says whether it begins in the object. `radiance` gets an estimate
    /// of the linear RGB radiance that arrives from there, one for each lamp.
    ///
    /// `radiance` must have the length of the scene's lights; what lies beyond is left alone.
    pub fn trace(&self, origin: Vec3, direction: Vec3, inside: bool, rng: &mut Rng, radiance: &mut [Vec3]) -> PathEnd {
        let radiance = &mut radiance[..self.lamps.len()];
        radiance.fill(Vec3::ZERO);
        let mut p = State {
            origin,
            direction,
            throughput: Vec3::ONE,
            energy: 1.0,
            inside,
            skip: NO_PRIMITIVE,
            last: None,
            seen: inside,
        };
        let mut end = PathEnd::default();
        while end.events < self.options.max_events {
            end.events += 1;
            let alive = if p.inside { self.inside(&mut p, rng, radiance) } else { self.outside(&mut p, rng, radiance) };
            end.hit |= p.seen;
            if !alive {
                return end;
            }
            let carried = (p.throughput * p.energy).max_element();
            if carried < ROULETTE {
                let survival = carried / ROULETTE;
                if rng.uniform() >= survival {
                    return end;
                }
                p.throughput /= survival;
            }
        }
        end.truncated = true;
        end
    }

    /// The path goes through air to the object, or away. Whether it goes on.
    #[inline]
    fn outside(&self, p: &mut State, rng: &mut Rng, radiance: &mut [Vec3]) -> bool {
        let hit = self.scene.geometry.closest_hit(p.origin, p.direction, f32::INFINITY, Facing::Entering, p.skip);
        if p.seen || self.options.show_lights {
            self.meet_discs(p, hit.map_or(f32::INFINITY, |hit| hit.distance), |_| Vec3::ONE, radiance);
            if hit.is_none() {
                self.meet_infinity(p, radiance);
            }
        }
        let Some(hit) = hit else { return false };
        if !p.seen {
            p.seen = true;
            self.reflect_off_coat(p, &hit, rng, radiance);
        }
        self.surface(p, &hit, rng, radiance)
    }

    /// The path flies through the medium to where it is scattered, or to the surface. Whether it goes on.
    #[inline]
    fn inside(&self, p: &mut State, rng: &mut Rng, radiance: &mut [Vec3]) -> bool {
        let geometry = &self.scene.geometry;
        let flight = self.medium.fly(p.throughput, rng);
        let free = geometry.holds_flight(p.origin, p.direction, flight.distance);
        let hit = match free {
            true => None,
            false => geometry.closest_hit(p.origin, p.direction, flight.distance, Facing::Leaving, p.skip),
        };
        let length = hit.map_or(f32::INFINITY, |hit| hit.distance);
        if self.any_inside {
            let end = flight.distance.min(length);
            self.meet_discs(p, end, |distance| self.medium.passed(flight, distance), radiance);
        }
        match self.medium.arrive(flight, length) {
            Flight::Scattered { distance, weight } => {
                p.origin += p.direction * distance;
                p.throughput *= weight * self.medium.variation(p.origin);
                p.skip = NO_PRIMITIVE;
                // Written so that NaN fails it. A path that rounding has brought outside at an edge ends here.
                let within = p.origin.cmpge(self.bounds.0).all() && p.origin.cmple(self.bounds.1).all();
                if !within || p.throughput.max_element() <= 0.0 {
                    return false;
                }
                self.connect_from_medium(p, rng, radiance);
                let from = p.direction;
                p.direction = sample_henyey_greenstein(self.medium.g, from, rng);
                p.last = Some((p.origin, henyey_greenstein(self.medium.g, from, p.direction)));
                true
            }
            Flight::Passed { weight } => {
                p.throughput *= weight;
                // An endless flight that meets nothing began on the surface, on its outer side.
                let Some(hit) = hit else { return false };
                self.surface(p, &hit, rng, radiance)
            }
        }
    }

    /// The path meets the boundary.
    #[inline]
    fn surface(&self, p: &mut State, hit: &Hit, rng: &mut Rng, radiance: &mut [Vec3]) -> bool {
        p.origin = hit.position;
        p.skip = hit.primitive;
        if self.boundary == Boundary::IndexMatched {
            p.inside = !p.inside;
            return p.throughput.max_element() > 0.0;
        }
        // Grazing directions may round to the wrong side of the plane.
        let outgoing = -p.direction;
        let rough = matches!(self.boundary, Boundary::Rough { .. });
        if rough {
            self.connect_from_surface(p, hit, rng, radiance);
        }
        let Some(sample) = self.boundary.sample(outgoing, hit.normal, rng) else { return false };
        p.direction = sample.direction;
        p.throughput *= sample.weight;
        p.energy *= sample.energy_scale;
        p.inside ^= sample.transmitted;
        p.last = rough.then_some((p.origin, sample.pdf));
        p.throughput.max_element() > 0.0
    }

    /// Light that lamps send straight to a point of the medium.
    #[inline]
    fn connect_from_medium(&self, p: &State, rng: &mut Rng, radiance: &mut [Vec3]) {
        let matched = self.boundary == Boundary::IndexMatched;
        if !matched && !self.any_inside {
            return;
        }
        let geometry = &self.scene.geometry;
        let mut throughput = p.throughput;
        // No lamp outside brings more than what is left on the way to the nearest surface.
        if self.sparing {
            let bound = (throughput * self.medium.transmittance(geometry.clearance(p.origin))).max_element();
            if bound < CONNECTION_ROULETTE {
                let probability = bound / CONNECTION_ROULETTE;
                if rng.uniform() >= probability {
                    return;
                }
                throughput /= probability;
            }
        }
        for (lamp, out) in self.lamps.iter().zip(radiance) {
            if !(matched || lamp.inside) {
                continue;
            }
            let Some(s) = lamp.light.sample(p.origin, rng) else { continue };
            let phase = henyey_greenstein(self.medium.g, p.direction, s.direction);
            let length = if matched {
                geometry.inside_length(p.origin, s.direction, s.distance, true, NO_PRIMITIVE)
            } else if geometry.occluded(p.origin, s.direction, s.distance, Facing::Leaving, NO_PRIMITIVE) {
                continue;
            } else {
                s.distance
            };
            let left = self.medium.transmittance(length);
            *out += throughput * left * s.irradiance * (phase * balance_heuristic(s.pdf, phase));
        }
    }

    /// Light that lamps send straight to a rough boundary.
    fn connect_from_surface(&self, p: &State, hit: &Hit, rng: &mut Rng, radiance: &mut [Vec3]) {
        let outgoing = -p.direction;
        for (lamp, out) in self.lamps.iter().zip(radiance) {
            let Some(s) = lamp.light.sample(hit.position, rng) else { continue };
            let (value, pdf) = self.boundary.evaluate(outgoing, s.direction, hit.normal);
            if value <= 0.0 {
                continue;
            }
            let left = if s.direction.dot(hit.normal) > 0.0 {
                if self.shadowed(hit, s.direction, s.distance) {
                    continue;
                }
                Vec3::ONE
            } else {
                let blocked = || {
                    self.scene.geometry.occluded(hit.position, s.direction, s.distance, Facing::Leaving, hit.primitive)
                };
                if !lamp.inside || blocked() {
                    continue;
                }
                self.medium.transmittance(s.distance)
            };
            *out += p.throughput * left * s.irradiance * (value * balance_heuristic(s.pdf, pdf));
        }
    }

    /// Whether the object stands between a point of its surface and a lamp outside.
    fn shadowed(&self, hit: &Hit, direction: Vec3, distance: f32) -> bool {
        self.scene.geometry.occluded(hit.position, direction, distance, Facing::Entering, hit.primitive)
    }

    /// The coat's reflection of every lamp at the point that the camera sees.
    fn reflect_off_coat(&self, p: &State, hit: &Hit, rng: &mut Rng, radiance: &mut [Vec3]) {
        let Some(coat) = self.scene.material.coat else { return };
        let (outgoing, normal) = (-p.direction, self.scene.geometry.shading_normal(hit));
        for (lamp, out) in self.lamps.iter().zip(radiance.iter_mut()) {
            let Some(s) = lamp.light.sample(hit.position, rng) else { continue };
            let (value, pdf) = coat.evaluate(outgoing, s.direction, normal);
            let faces = s.direction.dot(hit.normal) > 0.0 && value.max_element() > 0.0;
            if faces && !self.shadowed(hit, s.direction, s.distance) {
                *out += s.irradiance * value * balance_heuristic(s.pdf, pdf);
            }
        }
        // Lamps with an extent, by chance; all share one ray.
        if self.lamps.iter().all(|lamp| lamp.light.is_delta()) {
            return;
        }
        let Some((direction, weight, pdf)) = coat.sample(outgoing, normal, rng) else { return };
        if direction.dot(hit.normal) <= 0.0 {
            return;
        }
        let ray = State {
            origin: hit.position,
            direction,
            throughput: weight,
            energy: 1.0,
            inside: false,
            skip: hit.primitive,
            last: Some((hit.position, pdf)),
            seen: true,
        };
        let geometry = &self.scene.geometry;
        let next = geometry.closest_hit(hit.position, direction, f32::INFINITY, Facing::Entering, hit.primitive);
        self.meet_discs(&ray, next.map_or(f32::INFINITY, |hit| hit.distance), |_| Vec3::ONE, radiance);
        if next.is_none() {
            self.meet_infinity(&ray, radiance);
        }
    }

    /// What a path that leaves for good finds.
    #[inline]
    fn meet_infinity(&self, p: &State, radiance: &mut [Vec3]) {
        for (lamp, out) in self.lamps.iter().zip(radiance) {
            let Some((found, connected)) = lamp.light.at_infinity(p.direction) else { continue };
            let weight = match (p.last, connected) {
                (Some((_, pdf)), Some(other)) => balance_heuristic(pdf, other),
                _ => 1.0,
            };
            *out += p.throughput * found * weight;
        }
    }

    /// The discs that a path meets before `end`, where `left` says what arrives there of what it carries.
    #[inline]
    fn meet_discs(&self, p: &State, end: f32, left: impl Fn(f32) -> Vec3, radiance: &mut [Vec3]) {
        for &l in &self.discs {
            let lamp = &self.lamps[l];
            if p.inside && !lamp.inside {
                continue;
            }
            let Some((distance, found)) = lamp.light.met_by(p.origin, p.direction) else { continue };
            if distance >= end {
                continue;
            }
            let point = p.origin + p.direction * distance;
            let weight = match p.last {
                Some((at, pdf)) => balance_heuristic(pdf, lamp.light.disc_pdf_towards(at, p.direction, point)),
                None => 1.0,
            };
            radiance[l] += p.throughput * left(distance) * found * weight;
        }
    }
}
