//! Rays against a closed mesh: an eight-way bounding volume hierarchy over watertight triangles.
//!
//! The hierarchy is in units in which the mesh is about 1 wide (a power of two, hence exact), so that products of three coordinates
//! neither over- nor underflow.
use crate::clearance::Clearance;
use crate::geometry::{Crossing, Facing, Hit};
use crate::hierarchy::{Hierarchy, HierarchyRay, triangle_box};
use crate::{Mesh, PathtraceError};
use glam::{Vec2, Vec3};
use obvhs::aabb::Aabb;
use std::ops::ControlFlow;

/// Boxes are widened by this fraction of the mesh's size (its largest coordinate): a few units in the last place of positions.
const BOX_MARGIN: f32 = 5e-7;

/// Rays that are farther away than this many sizes of the mesh lose all precision and meet nothing.
const MAX_ORIGIN: f32 = 1e7;

/// A mesh ready for rays.
#[derive(Clone)]
pub struct MeshGeometry {
    mesh: Mesh,
    /// Outward unit normals of the triangles.
    normals: Vec<Vec3>,
    /// Scene units → units of the hierarchy, a power of two.
    scale: f32,
    hierarchy: Hierarchy,
    clearance: Clearance,
    bounds: (Vec3, Vec3),
}

impl std::fmt::Debug for MeshGeometry {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "MeshGeometry({} triangles, bounds {:?})", self.mesh.triangles.len(), self.bounds)
    }
}

impl MeshGeometry {
    /// Builds the hierarchy. The mesh should be closed and face outward ([`Mesh::repair`] sees to that); if it is not, results are
    /// finite and meaningless.
    pub fn new(mesh: Mesh) -> Result<Self, PathtraceError> {
        mesh.validate()?;
        let bounds = mesh.bounds();
        let size = bounds.0.abs().max(bounds.1.abs()).max_element();
        if size < 1.0 / crate::mesh::MAX_COORDINATE {
            return Err(PathtraceError::Mesh {
                problem: format!("its largest coordinate is {size}"),
                advice: "scale it: sizes from 10⁻⁹ to 10⁹ can be traced",
            });
        }
        let scale = 2f32.powi(-(size.log2().floor() as i32));
        let scaled = |t: u32| mesh.corners(t as usize).map(|c| c * scale);
        let boxes: Vec<Aabb> =
            (0..mesh.triangles.len() as u32).map(|t| triangle_box(scaled(t), BOX_MARGIN * size * scale)).collect();
        let hierarchy = Hierarchy::new(&boxes, scaled);
        let normals =
            (0..mesh.triangles.len()).map(|t| mesh.area_vector(t).normalize_or(glam::DVec3::Z).as_vec3()).collect();
        let triangle_boxes: Vec<(Vec3, Vec3)> = (0..mesh.triangles.len())
            .map(|t| {
                let [a, b, c] = mesh.corners(t);
                (a.min(b).min(c), a.max(b).max(c))
            })
            .collect();
        let clearance = Clearance::new(&triangle_boxes);
        Ok(Self { mesh, normals, scale, hierarchy, clearance, bounds })
    }

    /// The mesh.
    pub fn mesh(&self) -> &Mesh {
        &self.mesh
    }

    /// Smallest and largest coordinates.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        self.bounds
    }

    /// Outward unit normal of a triangle.
    #[inline]
    pub fn normal(&self, triangle: u32) -> Vec3 {
        self.normals[triangle as usize]
    }

    /// Interpolated unit shading normal at a hit; the triangle's own where the mesh has none, or where it would face away from
    /// the triangle.
    pub fn shading_normal(&self, hit: &Hit) -> Vec3 {
        let Some(normals) = &self.mesh.normals else { return hit.normal };
        let [a, b, c] = self.mesh.triangles[hit.primitive as usize].map(|i| normals[i as usize]);
        let [v, w] = hit.barycentric.to_array();
        let normal = (a * (1.0 - v - w) + b * v + c * w).normalize_or(hit.normal);
        if normal.dot(hit.normal) > 0.0 { normal } else { hit.normal }
    }

    /// See [`crate::Geometry::clearance`].
    #[inline]
    pub fn clearance(&self, point: Vec3) -> f32 {
        self.clearance.at(point)
    }

    /// The ray and its end in units of the hierarchy.
    #[inline]
    fn prepared(&self, origin: Vec3, direction: Vec3, max: f32) -> Option<(HierarchyRay, f32)> {
        let origin = origin * self.scale;
        // Written so that NaN fails it.
        let usable = origin.abs().max_element() <= MAX_ORIGIN && direction.is_finite() && max > 0.0;
        usable.then(|| (HierarchyRay::new(origin, direction), max * self.scale))
    }

    /// See [`crate::Geometry::closest_hit`].
    #[inline]
    pub fn closest_hit(&self, origin: Vec3, direction: Vec3, max: f32, facing: Facing, skip: u32) -> Option<Hit> {
        let (ray, limit) = self.prepared(origin, direction, max)?;
        let mut nearest = limit;
        let mut best = (u32::MAX, [0.0f32; 3], false);
        self.hierarchy.visit::<true>(&ray, limit, |hits, names| {
            let mut met = facing.of(hits.entering, hits.leaving);
            while met != 0 {
                let i = met.trailing_zeros() as usize;
                met &= met - 1;
                let t = hits.t[i];
                if t > 0.0 && t < nearest && names[i] != skip {
                    nearest = t;
                    best = (names[i], hits.edges(i), hits.entering >> i & 1 == 1);
                }
            }
            ControlFlow::Continue(nearest)
        });
        let (primitive, [u, v, w], entering) = best;
        if primitive == u32::MAX {
            return None;
        }
        let (v, w) = (v / (u + v + w), w / (u + v + w));
        let [a, b, c] = self.mesh.corners(primitive as usize);
        // Relative to a corner: sums of large coordinates would round away the surface.
        let position = a + (b - a) * v + (c - a) * w;
        Some(Hit {
            distance: nearest / self.scale,
            position,
            normal: self.normals[primitive as usize],
            primitive,
            barycentric: Vec2::new(v, w),
            entering,
        })
    }

    /// Shows `visit` each crossing of a ray before `max`, in no order: triangle, distance in units of the hierarchy, whether it enters.
    /// `true` goes on.
    #[inline]
    fn each(
        &self,
        origin: Vec3,
        direction: Vec3,
        max: f32,
        facing: Facing,
        mut visit: impl FnMut(u32, f32, bool) -> bool,
    ) {
        let Some((ray, limit)) = self.prepared(origin, direction, max) else { return };
        self.hierarchy.visit::<false>(&ray, limit, |hits, names| {
            let mut met = facing.of(hits.entering, hits.leaving);
            while met != 0 {
                let i = met.trailing_zeros() as usize;
                met &= met - 1;
                let t = hits.t[i];
                if t > 0.0 && t < limit && !visit(names[i], t, hits.entering >> i & 1 == 1) {
                    return ControlFlow::Break(());
                }
            }
            ControlFlow::Continue(limit)
        });
    }

    /// See [`crate::Geometry::occluded`].
    #[inline]
    pub fn occluded(&self, origin: Vec3, direction: Vec3, max: f32, facing: Facing, skip: u32) -> bool {
        let mut met = false;
        self.each(origin, direction, max, facing, |triangle, _, _| {
            met |= triangle != skip;
            !met
        });
        met
    }

    /// The triangles that an endless ray crosses, in no order.
    pub(crate) fn each_crossing(&self, origin: Vec3, direction: Vec3, mut visit: impl FnMut(u32)) {
        self.each(origin, direction, f32::INFINITY, Facing::Any, |triangle, _, _| {
            visit(triangle);
            true
        });
    }

    /// All crossings of a ray, summed up, in one traversal without order.
    #[inline]
    pub(crate) fn crossings(&self, origin: Vec3, direction: Vec3, max: f32, skip: u32) -> Crossing {
        let mut sum = Crossing::default();
        self.each(origin, direction, max, Facing::Any, |triangle, t, entering| {
            if triangle != skip {
                let sign = if entering { -1.0 } else { 1.0 };
                sum.length += sign * t;
                sum.exits += if entering { -1 } else { 1 };
                sum.count += 1;
            }
            true
        });
        sum.length /= self.scale;
        sum
    }
}
