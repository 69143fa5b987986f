//! Rays against a closed mesh: an eight-way bounding volume hierarchy over watertight triangles.
//!
//! The hierarchy is `obvhs`'s compressed eight-wide one. It ignores boxes that end within 10⁻⁴ of a ray's origin, so it is built
//! in units in which the mesh is 2¹⁶ wide (a power of two, hence exact), where that is far below the resolution of
//! an `f32`; boxes are widened against the rounding of their test.
use crate::clearance::Clearance;
use crate::geometry::{Crossing, Facing, Hit};
use crate::triangle::ShearedRay;
use crate::{Mesh, PathtraceError};
use glam::{Vec2, Vec3, Vec3A};
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::bvh2::reinsertion::ReinsertionOptimizer;
use obvhs::cwbvh::CwBvh;
use obvhs::cwbvh::bvh2_to_cwbvh::bvh2_to_cwbvh;
use obvhs::ploc::PlocBuilder;
use obvhs::ray::{Ray, RayHit};

/// Boxes are widened by this fraction of the mesh's size (its largest coordinate): a few units in the last place of positions.
const BOX_MARGIN: f32 = 5e-7;

/// Rays that are farther away than this many sizes of the mesh lose all precision and meet nothing.
const MAX_ORIGIN: f32 = 1e7;

/// The steps of `obvhs`'s own builder, without its check of the result, whose tolerances are absolute and made for units near 1.
fn build(boxes: &[Aabb], parameters: &BvhBuildParams) -> CwBvh {
    let mut binary = PlocBuilder::with_capacity(boxes.len()).build(
        parameters.ploc_search_distance,
        boxes,
        (0..boxes.len() as u32).collect(),
        parameters.sort_precision,
        parameters.search_depth_threshold,
    );
    ReinsertionOptimizer::default().run(&mut binary, parameters.reinsertion_batch_ratio, None);
    bvh2_to_cwbvh(&binary, parameters.max_prims_per_leaf.clamp(1, 3), true, false)
}

/// A mesh ready for rays.
#[derive(Clone)]
pub struct MeshGeometry {
    mesh: Mesh,
    /// Outward unit normals of the triangles.
    normals: Vec<Vec3>,
    /// Scene units → units of the hierarchy, a power of two.
    scale: f32,
    bvh: CwBvh,
    /// Corners in units and order of the hierarchy.
    corners: Vec<[[f32; 3]; 3]>,
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
        let scale = 2f32.powi(15 - size.log2().floor() as i32);
        let margin = Vec3A::splat(BOX_MARGIN * size * scale);
        let scaled = |t: usize| mesh.corners(t).map(|c| c * scale);
        let boxes: Vec<Aabb> = (0..mesh.triangles.len())
            .map(|t| {
                let [a, b, c] = scaled(t).map(Vec3A::from);
                Aabb::new(a.min(b).min(c) - margin, a.max(b).max(c) + margin)
            })
            .collect();
        let parameters = BvhBuildParams { pre_split: false, ..BvhBuildParams::medium_build() };
        let bvh = build(&boxes, &parameters);
        let corners = bvh.primitive_indices.iter().map(|t| scaled(*t as usize).map(|c| c.to_array())).collect();
        let normals =
            (0..mesh.triangles.len()).map(|t| mesh.area_vector(t).normalize_or(glam::DVec3::Z).as_vec3()).collect();
        let triangle_boxes: Vec<(Vec3, Vec3)> = (0..mesh.triangles.len())
            .map(|t| {
                let [a, b, c] = mesh.corners(t);
                (a.min(b).min(c), a.max(b).max(c))
            })
            .collect();
        let clearance = Clearance::new(&triangle_boxes);
        Ok(Self { mesh, normals, scale, bvh, corners, clearance, bounds })
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

    #[inline]
    fn prepared(&self, origin: Vec3, direction: Vec3, max: f32) -> Option<(ShearedRay, Ray)> {
        let origin = origin * self.scale;
        // Written so that NaN fails it.
        let usable = origin.abs().max_element() <= 65536.0 * MAX_ORIGIN && direction.is_finite() && max > 0.0;
        if !usable {
            return None;
        }
        let ray = Ray::new(origin.into(), direction.into(), 0.0, max * self.scale);
        Some((ShearedRay::new(origin, direction), ray))
    }

    /// See [`crate::Geometry::closest_hit`].
    #[inline]
    pub fn closest_hit(&self, origin: Vec3, direction: Vec3, max: f32, facing: Facing, skip: u32) -> Option<Hit> {
        let (sheared, ray) = self.prepared(origin, direction, max)?;
        let mut best = (u32::MAX, [0.0f32; 2], false);
        let mut nearest = ray.tmax;
        let mut record = RayHit::none();
        self.bvh.ray_traverse(ray, &mut record, |_, slot| {
            let Some(hit) = sheared.intersect(&self.corners[slot]) else { return f32::INFINITY };
            let triangle = self.bvh.primitive_indices[slot];
            if hit.t >= nearest || !facing.accepts(hit.entering) || triangle == skip {
                return f32::INFINITY;
            }
            nearest = hit.t;
            best = (triangle, hit.barycentric, hit.entering);
            hit.t
        });
        let (primitive, [v, w], entering) = best;
        if primitive == u32::MAX {
            return None;
        }
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

    /// See [`crate::Geometry::occluded`].
    #[inline]
    pub fn occluded(&self, origin: Vec3, direction: Vec3, max: f32, facing: Facing, skip: u32) -> bool {
        let Some((sheared, ray)) = self.prepared(origin, direction, max) else { return false };
        let limit = ray.tmax;
        !self.bvh.ray_traverse_miss(ray, |_, slot| match sheared.intersect(&self.corners[slot]) {
            Some(hit) if hit.t < limit && facing.accepts(hit.entering) && self.bvh.primitive_indices[slot] != skip => {
                hit.t
            }
            _ => f32::INFINITY,
        })
    }

    /// The triangles that an endless ray crosses, in no order.
    pub(crate) fn each_crossing(&self, origin: Vec3, direction: Vec3, mut visit: impl FnMut(u32)) {
        let Some((sheared, ray)) = self.prepared(origin, direction, f32::INFINITY) else { return };
        self.bvh.ray_traverse_anyhit(ray, |_, slot| {
            if sheared.intersect(&self.corners[slot]).is_some() {
                visit(self.bvh.primitive_indices[slot]);
            }
        });
    }

    /// All crossings of a ray, summed up, in one traversal without order.
    #[inline]
    pub(crate) fn crossings(&self, origin: Vec3, direction: Vec3, max: f32, skip: u32) -> Crossing {
        let mut sum = Crossing::default();
        let Some((sheared, ray)) = self.prepared(origin, direction, max) else { return sum };
        let limit = ray.tmax;
        self.bvh.ray_traverse_anyhit(ray, |_, slot| {
            if let Some(hit) = sheared.intersect(&self.corners[slot])
                && hit.t < limit
                && self.bvh.primitive_indices[slot] != skip
            {
                let sign = if hit.entering { -1.0 } else { 1.0 };
                sum.length += sign * hit.t;
                sum.exits += if hit.entering { -1 } else { 1 };
                sum.count += 1;
            }
        });
        sum.length /= self.scale;
        sum
    }
}
