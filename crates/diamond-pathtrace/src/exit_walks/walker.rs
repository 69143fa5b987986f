//! One surfel's walks through the object.
use super::ExitWalkOptions;
use super::angular::AngularSums;
use super::surfel_grid::SurfelGrid;
use crate::geometry::{Facing, NO_PRIMITIVE};
use crate::medium::sample_henyey_greenstein;
use crate::sobol::Sobol;
use crate::{Boundary, Frame, Geometry, Hit, Patch, Rng};
use glam::Vec3;
use std::f32::consts::TAU;

/// Surfaces met in air between two stretches inside, at most: beyond are meshes that are none.
const MAX_BOUNCES: u32 = 64;

/// What walks need to know.
pub(crate) struct Walker<'a> {
    pub geometry: &'a Geometry,
    pub sigma_t: f32,
    pub g: f32,
    /// As [`Boundary::effective`] says.
    pub boundary: Boundary,
    pub grid: &'a SurfelGrid,
    pub options: ExitWalkOptions,
}

/// The walks of one surfel.
#[derive(Debug, Default)]
pub(crate) struct Walked {
    /// Surfel and number of scatterings of each exit, sorted.
    pub exits: Vec<(u32, u16)>,
    pub angular: AngularSums,
    pub refused: u32,
    pub unscattered: u32,
    pub left: u32,
    pub lost: u32,
    pub cut: u32,
}

/// A walk inside the object.
struct State {
    origin: Vec3,
    direction: Vec3,
    skip: u32,
    scatterings: u32,
    /// Outer cosine of the start.
    cos_start: f32,
}

/// How a walk ended.
enum End {
    Left,
    Unscattered,
    Lost,
    Cut,
}

/// What happens at a boundary.
pub(crate) enum Passage {
    Reflected(Vec3),
    Transmitted(Vec3),
    Absorbed,
}

/// The boundary (as [`Boundary::effective`] says), for a walk that arrived with `outgoing` (unit, back along the walk). What is not
/// carried on ends by chance, so that walks stay whole: energy passes with probability, not with a weight.
#[inline]
pub(crate) fn pass(boundary: Boundary, outgoing: Vec3, normal: Vec3, rng: &mut Rng) -> Passage {
    if boundary == Boundary::IndexMatched {
        return Passage::Transmitted(-outgoing);
    }
    let Some(sample) = boundary.sample(outgoing, normal, rng) else { return Passage::Absorbed };
    // 1 but for the masking of rough boundaries.
    let energy = sample.weight * sample.energy_scale;
    if energy < 1.0 && rng.uniform() >= energy {
        return Passage::Absorbed;
    }
    if sample.transmitted { Passage::Transmitted(sample.direction) } else { Passage::Reflected(sample.direction) }
}

impl Walker<'_> {
    /// All walks of a patch; `stream` numbers its random numbers.
    pub fn walks_from(&self, patch: &Patch, stream: u64) -> Walked {
        let mut rng = Rng::new(self.options.seed, stream);
        let mut numbers = Sobol::new(std::array::from_fn(|_| rng.bits()));
        let (position, normal, primitive) = self.start(patch);
        let frame = Frame::new(normal);
        let mut walked = Walked::default();
        for _ in 0..self.options.walks {
            rng.lead_with(numbers.draw());
            let (u, v) = (rng.uniform(), rng.uniform());
            let (sin, cos) = (TAU * v).sin_cos();
            let cos_start = (1.0 - u).sqrt();
            let outward = frame.to_world(Vec3::new(u.sqrt() * cos, u.sqrt() * sin, cos_start));
            let Passage::Transmitted(direction) = pass(self.boundary, outward, normal, &mut rng) else {
                walked.refused += 1;
                continue;
            };
            let mut state = State { origin: position, direction, skip: primitive, scatterings: 0, cos_start };
            match self.walk(&mut state, &mut rng, &mut walked) {
                End::Left => walked.left += 1,
                End::Unscattered => walked.unscattered += 1,
                End::Lost => walked.lost += 1,
                End::Cut => walked.cut += 1,
            }
        }
        walked.exits.sort_unstable();
        walked
    }

    /// Where walks of a patch start: on the surface over or under it.
    fn start(&self, patch: &Patch) -> (Vec3, Vec3, u32) {
        let reach = patch.area.sqrt();
        let above = patch.position + patch.normal * reach;
        let hit = self.geometry.closest_hit(above, -patch.normal, 2.0 * reach, Facing::Entering, NO_PRIMITIVE);
        match hit {
            Some(hit) if hit.normal.dot(patch.normal) > 0.5 => (hit.position, hit.normal, hit.primitive),
            _ => (patch.position, patch.normal, NO_PRIMITIVE),
        }
    }

    fn walk(&self, p: &mut State, rng: &mut Rng, walked: &mut Walked) -> End {
        let geometry = self.geometry;
        let (low, high) = geometry.bounds();
        loop {
            let flight = rng.exponential() / self.sigma_t;
            let hit = match geometry.holds_flight(p.origin, p.direction, flight) {
                true => None,
                false => geometry.closest_hit(p.origin, p.direction, flight, Facing::Leaving, p.skip),
            };
            if let Some(hit) = hit {
                match self.surface(p, hit, rng, walked) {
                    None => continue,
                    Some(end) => return end,
                }
            }
            p.origin += p.direction * flight;
            p.skip = NO_PRIMITIVE;
            // Written so that NaN fails it. A walk that rounding has brought outside at an edge ends here.
            if !(p.origin.cmpge(low).all() && p.origin.cmple(high).all()) {
                return End::Lost;
            }
            if p.scatterings == self.options.max_events {
                return End::Cut;
            }
            p.scatterings += 1;
            p.direction = sample_henyey_greenstein(self.g, p.direction, rng);
        }
    }

    /// The walk meets the surface from inside; `None` if it is inside again afterwards.
    #[inline]
    fn surface(&self, p: &mut State, mut hit: Hit, rng: &mut Rng, walked: &mut Walked) -> Option<End> {
        let direction = match pass(self.boundary, -p.direction, hit.normal, rng) {
            Passage::Absorbed => return Some(End::Lost),
            Passage::Reflected(direction) => {
                (p.origin, p.direction, p.skip) = (hit.position, direction, hit.primitive);
                return None;
            }
            Passage::Transmitted(direction) => direction,
        };
        if p.scatterings == 0 {
            return Some(End::Unscattered);
        }
        let surfel = self.grid.nearest(hit.position, hit.normal);
        walked.exits.push((surfel, p.scatterings as u16));
        walked.angular.record(p.scatterings, p.cos_start, direction.dot(hit.normal));
        if !matches!(self.geometry, Geometry::Mesh(_)) {
            return Some(End::Left);
        }
        // Through air, perhaps to another part.
        p.direction = direction;
        for _ in 0..MAX_BOUNCES {
            let next =
                self.geometry.closest_hit(hit.position, p.direction, f32::INFINITY, Facing::Entering, hit.primitive);
            let Some(next) = next else { return Some(End::Left) };
            hit = next;
            match pass(self.boundary, -p.direction, hit.normal, rng) {
                Passage::Absorbed => return Some(End::Lost),
                Passage::Reflected(direction) => p.direction = direction,
                Passage::Transmitted(direction) => {
                    (p.origin, p.direction, p.skip) = (hit.position, direction, hit.primitive);
                    return None;
                }
            }
        }
        Some(End::Left)
    }
}
