//! The shapes that light is traced through, and the questions that rays ask them.
//!
//! A path always knows whether it is inside the object. It asks for the next surface *that it can meet in this state*: from
//! inside one whose outer side faces away, from outside one that faces it. This makes rays robust without any offset: a start point
//! that rounding has put on the wrong side of its own or the neighbouring triangle sees that triangle from its wrong side and
//! passes. The triangle that a path has just left is skipped.
use crate::{Mesh, MeshGeometry, PathtraceError};
use glam::{Vec2, Vec3};

/// Where nothing is skipped.
pub const NO_PRIMITIVE: u32 = u32::MAX;

/// Which sides of a surface a ray meets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Facing {
    /// The outer side: the ray enters the object.
    Entering,
    /// The inner side: the ray leaves it.
    Leaving,
    /// Both.
    Any,
}

impl Facing {
    #[inline]
    pub(crate) fn accepts(self, entering: bool) -> bool {
        match self {
            Facing::Entering => entering,
            Facing::Leaving => !entering,
            Facing::Any => true,
        }
    }

    /// Of the crossings that enter and those that leave, one bit each, the wanted ones.
    #[inline]
    pub(crate) fn of(self, entering: u32, leaving: u32) -> u32 {
        match self {
            Facing::Entering => entering,
            Facing::Leaving => leaving,
            Facing::Any => entering | leaving,
        }
    }
}

/// Where a ray meets a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Distance from the ray's origin, scene units.
    pub distance: f32,
    /// The point on the surface, world.
    pub position: Vec3,
    /// Outward unit normal of the surface itself (of the triangle), world.
    pub normal: Vec3,
    /// The triangle; 0 on other shapes.
    pub primitive: u32,
    /// Weights of the second and third corner; 0 on other shapes.
    pub barycentric: Vec2,
    /// Whether the ray enters the object here.
    pub entering: bool,
}

/// Sums over all crossings of a ray.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Crossing {
    /// Distances of exits minus distances of entries, scene units.
    pub length: f32,
    /// Exits minus entries.
    pub exits: i32,
    /// Number of crossings.
    pub count: u32,
}

/// A shape that encloses a medium.
#[derive(Debug, Clone)]
pub enum Geometry {
    /// A closed mesh.
    Mesh(Box<MeshGeometry>),
    /// An exact sphere.
    Sphere {
        /// Centre, world.
        centre: Vec3,
        /// Radius, scene units.
        radius: f32,
    },
    /// All points with `bottom` ≤ z ≤ `top`; with `bottom` = −∞ the half-space below `top`.
    Slab {
        /// Smallest z, scene units; may be −∞.
        bottom: f32,
        /// Largest z, scene units.
        top: f32,
    },
}

/// Fixed directions, in no symmetry with anything, along which crossings are counted.
const PROBES: [Vec3; 3] = [
    Vec3::new(0.267_261_24, 0.534_522_5, 0.801_783_7),
    Vec3::new(-0.635_000_9, 0.381_000_54, 0.672_010_06),
    Vec3::new(0.408_702_73, -0.873_144_3, 0.265_656_77),
];

impl Geometry {
    /// A mesh that [`Mesh::repair`] has found closed.
    pub fn from_mesh(mesh: Mesh) -> Result<Self, PathtraceError> {
        Ok(Geometry::Mesh(Box::new(MeshGeometry::new(mesh)?)))
    }

    /// `Err` where a number is not finite or the shape has no volume.
    pub fn validate(&self) -> Result<(), PathtraceError> {
        match self {
            Geometry::Mesh(_) => Ok(()),
            Geometry::Sphere { centre, radius } => {
                crate::error::check_rgb("centre of a sphere", *centre, "a finite number", |_| true)?;
                crate::error::check("radius of a sphere", *radius, "a finite number > 0", |v| v > 0.0)
            }
            Geometry::Slab { bottom, top } => {
                crate::error::check("top of a slab", *top, "a finite number", |_| true)?;
                if *bottom < *top {
                    return Ok(());
                }
                Err(PathtraceError::Value {
                    what: "bottom of a slab".into(),
                    expected: "a number below its top, or −∞",
                    found: format!("{bottom}"),
                })
            }
        }
    }

    /// Smallest and largest coordinates; infinite where the shape is.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        match self {
            Geometry::Mesh(mesh) => mesh.bounds(),
            Geometry::Sphere { centre, radius } => (*centre - *radius, *centre + *radius),
            Geometry::Slab { bottom, top } => (Vec2::NEG_INFINITY.extend(*bottom), Vec2::INFINITY.extend(*top)),
        }
    }

    /// The nearest surface of the wanted side that the ray (unit `direction`) meets within `max` (scene units, may be infinite),
    /// without the primitive `skip`.
    #[inline]
    pub fn closest_hit(&self, origin: Vec3, direction: Vec3, max: f32, facing: Facing, skip: u32) -> Option<Hit> {
        match self {
            Geometry::Mesh(mesh) => mesh.closest_hit(origin, direction, max, facing, skip),
            Geometry::Sphere { centre, radius } => {
                let (near, far) = sphere_roots(origin - *centre, direction, *radius)?;
                let hit = |distance: f32, entering: bool| {
                    // From the projection onto the sphere: the point lies on it to the last bit or two.
                    let normal = (origin - *centre + direction * distance).normalize_or(-direction);
                    let position = *centre + normal * *radius;
                    Hit { distance, position, normal, primitive: 0, barycentric: Vec2::ZERO, entering }
                };
                let ahead = |t: f32| t > 0.0 && t < max;
                if facing.accepts(true) && ahead(near) {
                    return Some(hit(near, true));
                }
                (facing.accepts(false) && ahead(far)).then(|| hit(far, false))
            }
            Geometry::Slab { bottom, top } => {
                let mut best: Option<Hit> = None;
                for (z, normal) in [(*bottom, -Vec3::Z), (*top, Vec3::Z)] {
                    let entering = normal.z * direction.z < 0.0;
                    let distance = (z - origin.z) / direction.z;
                    let ahead = distance > 0.0 && distance < max && distance < f32::INFINITY;
                    if ahead && facing.accepts(entering) && best.is_none_or(|b| distance < b.distance) {
                        let position = (origin + direction * distance).with_z(z);
                        let (primitive, barycentric) = (0, Vec2::ZERO);
                        best = Some(Hit { distance, position, normal, primitive, barycentric, entering });
                    }
                }
                best
            }
        }
    }

    /// Whether anything of the wanted side lies on the ray (unit `direction`) nearer than `max`.
    #[inline]
    pub fn occluded(&self, origin: Vec3, direction: Vec3, max: f32, facing: Facing, skip: u32) -> bool {
        match self {
            Geometry::Mesh(mesh) => mesh.occluded(origin, direction, max, facing, skip),
            _ => self.closest_hit(origin, direction, max, facing, skip).is_some(),
        }
    }

    /// How much of the ray (unit `direction`), from `origin` to `max`, lies inside the object, scene units. `inside` says on which
    /// side it begins. Infinite for a ray that never leaves.
    #[inline]
    pub fn inside_length(&self, origin: Vec3, direction: Vec3, max: f32, inside: bool, skip: u32) -> f32 {
        match self {
            Geometry::Mesh(mesh) => {
                let sum = mesh.crossings(origin, direction, max, skip);
                // In a closed mesh entries and exits alternate, so the sum of signed distances is the length, in any order.
                let at_end = i32::from(inside) - sum.exits;
                match (at_end, max < f32::INFINITY) {
                    (0, _) => sum.length.max(0.0),
                    (1, true) => (sum.length + max).clamp(0.0, max),
                    _ => self.walk_length(origin, direction, max, inside, skip),
                }
            }
            Geometry::Sphere { centre, radius } => {
                let Some((near, far)) = sphere_roots(origin - *centre, direction, *radius) else { return 0.0 };
                let start = if inside { 0.0 } else { near.max(0.0) };
                (far.min(max) - start).max(0.0)
            }
            Geometry::Slab { bottom, top } => {
                let (a, b) = ((*bottom - origin.z) / direction.z, (*top - origin.z) / direction.z);
                if a.is_nan() || b.is_nan() {
                    return if inside { max } else { 0.0 };
                }
                let start = if inside { 0.0 } else { a.min(b).max(0.0) };
                (a.max(b).min(max) - start).max(0.0)
            }
        }
    }

    /// [`Geometry::inside_length`] from surface to surface: where rounding at an edge has counted a crossing twice, or the mesh
    /// overlaps itself.
    #[cold]
    fn walk_length(&self, origin: Vec3, direction: Vec3, max: f32, inside: bool, skip: u32) -> f32 {
        let (mut at, mut inside, mut skip) = (0.0f32, inside, skip);
        let mut length = 0.0;
        // More crossings than this are a mesh that is none.
        for _ in 0..10_000 {
            let facing = if inside { Facing::Leaving } else { Facing::Entering };
            let hit = self.closest_hit(origin + direction * at, direction, max - at, facing, skip);
            let Some(hit) = hit else {
                // A ray that starts inside and meets no exit started on the surface.
                return if inside && max < f32::INFINITY { length + (max - at) } else { length };
            };
            if inside {
                length += hit.distance;
            }
            at += hit.distance;
            inside = !inside;
            skip = hit.primitive;
        }
        length
    }

    /// Whether a point lies inside; on the surface either answer may come.
    pub fn contains(&self, point: Vec3) -> bool {
        match self {
            Geometry::Mesh(mesh) => {
                let (low, high) = mesh.bounds();
                if !(point.cmpge(low).all() && point.cmple(high).all()) {
                    return false;
                }
                let inside =
                    |direction: &&Vec3| mesh.crossings(point, **direction, f32::INFINITY, NO_PRIMITIVE).exits > 0;
                PROBES.iter().filter(inside).count() >= 2
            }
            Geometry::Sphere { centre, radius } => (point - *centre).length_squared() < radius * radius,
            Geometry::Slab { bottom, top } => point.z > *bottom && point.z < *top,
        }
    }

    /// No surface is nearer to `point` than this, scene units. 0 where nothing is known, so it is never too large. A walk whose
    /// next step is shorter needs no ray.
    #[inline]
    pub fn clearance(&self, point: Vec3) -> f32 {
        match self {
            Geometry::Mesh(mesh) => mesh.clearance(point),
            Geometry::Sphere { centre, radius } => {
                // A few units in the last place of both, for the rounding.
                let depth = radius - (point - *centre).length();
                (depth.abs() - 1e-6 * radius).max(0.0)
            }
            Geometry::Slab { bottom, top } => (top - point.z).abs().min((point.z - bottom).abs()),
        }
    }

    /// Whether a flight that starts inside certainly ends inside and meets no surface on its way. `false` says nothing.
    #[inline]
    pub(crate) fn holds_flight(&self, origin: Vec3, direction: Vec3, distance: f32) -> bool {
        match self {
            Geometry::Mesh(mesh) => distance < mesh.clearance(origin),
            // Convex: both ends inside will do. A few units in the last place are for the rounding.
            Geometry::Sphere { centre, radius } => {
                let limit = radius * radius * (1.0 - 4e-6);
                let start = origin - *centre;
                (start + direction * distance).length_squared() < limit && start.length_squared() < limit
            }
            Geometry::Slab { bottom, top } => {
                let end = origin.z + direction.z * distance;
                end < *top && end > *bottom && origin.z < *top && origin.z > *bottom
            }
        }
    }

    /// Unit normal for a coat at a hit: interpolated where a mesh has vertex normals.
    pub fn shading_normal(&self, hit: &Hit) -> Vec3 {
        match self {
            Geometry::Mesh(mesh) => mesh.shading_normal(hit),
            _ => hit.normal,
        }
    }
}

/// Both distances at which a line meets a sphere around the origin, the smaller one first.
#[inline]
fn sphere_roots(origin: Vec3, direction: Vec3, radius: f32) -> Option<(f32, f32)> {
    let b = origin.dot(direction);
    // The distance of the line from the centre, from the perpendicular part: exact for far origins.
    let across = origin - direction * b;
    let discriminant = radius * radius - across.length_squared();
    if discriminant.is_nan() || discriminant <= 0.0 {
        return None;
    }
    let half = discriminant.sqrt();
    Some((-b - half, -b + half))
}
