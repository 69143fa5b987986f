//! The visual hull: what masks alone say about where the surface is.
//!
//! A point can only belong to the object if it falls on the object's mask in every view that sees it. A grid of
//! voxels is carved by that rule; what is left is the hull, the tightest shape with these silhouettes. Its surface is
//! where an optimisation may begin when there is no point cloud: one point per surface voxel, with an outward normal,
//! moved onto the ½-level of the masks so that the result is finer than the grid.
//!
//! Concavities that no silhouette shows are filled, and few views leave corners: that is a start, not a measurement.
use crate::SplatError;
use diamond_camera::Camera;
use diamond_image::Mask;
use glam::{DMat3, DVec3, UVec3, Vec2, Vec3};
use rayon::prelude::*;

/// Coverage from which a mask counts as the object.
const INSIDE: f32 = 0.5;
/// Largest number of voxels along an axis: 512³ flags are 128 MiB.
const MAX_RESOLUTION: usize = 512;
/// Normals are gradients of the occupancy under a Gaussian of this standard deviation (voxels), cut at twice that.
const NORMAL_SIGMA: f32 = 1.5;
/// Cells along each side of the coarse grid that estimates bounds.
const BOUNDS_CELLS: u32 = 48;
/// The coarse grid reaches this much further than the masks do at the centre's distance: what is behind the centre is
/// larger than it looks.
const BOUNDS_MARGIN: f32 = 1.5;
/// Rays whose common point is worse determined than two at about one degree have none (determinant of the mean of
/// I − ddᵀ, a quarter of the squared sine for two rays).
const MIN_CONVERGENCE: f64 = 1e-4;

/// How the hull is carved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HullConfig {
    /// Voxels along the longest side of the bounds, 1 to 512.
    pub resolution: usize,
    /// A voxel that fewer views than this see is not part of the hull.
    pub min_views: usize,
}

impl Default for HullConfig {
    fn default() -> Self {
        Self { resolution: 96, min_views: 1 }
    }
}

/// Points on the surface of a visual hull.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Hull {
    /// World coordinates, scene units, in order of the voxels (x fastest).
    pub points: Vec<Vec3>,
    /// Outward unit normals, one per point.
    pub normals: Vec<Vec3>,
    /// Side of a voxel, scene units: about the distance between neighbouring points.
    pub voxel_size: f32,
    /// Voxels inside the hull.
    pub occupied: usize,
}

/// Views as carving needs them.
struct Views<'a> {
    cameras: &'a [Camera],
    masks: &'a [&'a Mask],
    min_views: usize,
}

impl<'a> Views<'a> {
    fn new(cameras: &'a [Camera], masks: &'a [&'a Mask], min_views: usize) -> Result<Self, SplatError> {
        if cameras.len() != masks.len() {
            return Err(SplatError::Shape {
                what: "visual hull, masks",
                expected: format!("{} (one per camera)", cameras.len()),
                found: masks.len().to_string(),
            });
        }
        for (camera, mask) in cameras.iter().zip(masks) {
            let k = &camera.intrinsics;
            if (k.width as usize, k.height as usize) != (mask.width(), mask.height()) || mask.data().is_empty() {
                return Err(SplatError::Shape {
                    what: "visual hull, size of a mask",
                    expected: format!("{}×{} pixels as its camera has, at least one", k.width, k.height),
                    found: format!("{}×{}", mask.width(), mask.height()),
                });
            }
        }
        Ok(Self { cameras, masks, min_views })
    }

    /// `[eq:hull-coverage]` The least bilinear coverage at the projections of `point`, over the views in whose frame it
    /// falls; 0 where fewer than `min_views` see it. Abandoned, with what was found so far, once below `enough`.
    fn coverage(&self, point: Vec3, enough: f32) -> f32 {
        let mut least = 1.0f32;
        let mut seen = 0;
        for (camera, mask) in self.cameras.iter().zip(self.masks) {
            let Some((pixel, _)) = camera.project(point) else { continue };
            let size = Vec2::new(mask.width() as f32, mask.height() as f32);
            if pixel.cmpge(Vec2::ZERO).all() && pixel.cmple(size).all() {
                let mut coverage = [0.0];
                mask.as_image().sample(pixel.x, pixel.y, &mut coverage);
                least = least.min(coverage[0]);
                seen += 1;
                if least < enough {
                    return least;
                }
            }
        }
        if seen < self.min_views { 0.0 } else { least }
    }

    fn inside(&self, point: Vec3) -> bool {
        self.coverage(point, INSIDE) >= INSIDE
    }
}

/// A grid of flags.
struct Voxels {
    low: Vec3,
    side: f32,
    size: UVec3,
    inside: Vec<bool>,
}

impl Voxels {
    fn centre(&self, at: UVec3) -> Vec3 {
        self.low + self.side * (at.as_vec3() + 0.5)
    }

    /// False outside of the grid.
    fn get(&self, x: i32, y: i32, z: i32) -> bool {
        let size = self.size.as_ivec3();
        let within = (0..size.x).contains(&x) && (0..size.y).contains(&y) && (0..size.z).contains(&z);
        within && self.inside[((z * size.y + y) * size.x + x) as usize]
    }

    /// Minus the gradient of the smoothed occupancy, normalised; `[eq:hull-normal]`
    /// n ∝ −Σ occupancy(d)·d·exp(−|d|²/2σ²).
    fn normal(&self, at: UVec3) -> Vec3 {
        let at = at.as_ivec3();
        let reach = (2.0 * NORMAL_SIGMA) as i32;
        let mut sum = Vec3::ZERO;
        for dz in -reach..=reach {
            for dy in -reach..=reach {
                for dx in -reach..=reach {
                    let d = Vec3::new(dx as f32, dy as f32, dz as f32);
                    if self.get(at.x + dx, at.y + dy, at.z + dz) {
                        sum -= d * libm::expf(-0.5 * d.length_squared() / (NORMAL_SIGMA * NORMAL_SIGMA));
                    }
                }
            }
        }
        // A sheet of one voxel has no gradient: any direction that leaves it will do.
        const MIN_GRADIENT: f32 = 1e-3;
        if sum.length() > MIN_GRADIENT {
            return sum.normalize();
        }
        let open = Vec3::AXES.iter().flat_map(|&axis| [axis, -axis]).find(|direction| {
            let d = direction.as_ivec3();
            !self.get(at.x + d.x, at.y + d.y, at.z + d.z)
        });
        open.unwrap_or(Vec3::Z)
    }

    fn on_surface(&self, at: UVec3) -> bool {
        let [x, y, z] = at.as_ivec3().to_array();
        self.get(x, y, z)
            && !(self.get(x - 1, y, z)
                && self.get(x + 1, y, z)
                && self.get(x, y - 1, z)
                && self.get(x, y + 1, z)
                && self.get(x, y, z - 1)
                && self.get(x, y, z + 1))
    }
}

/// Carves the box `bounds` (lowest and highest corner) by all masks.
///
/// A voxel stays where every camera whose frame its centre falls in has a coverage of at least ½ there; a view does
/// not carve what is outside its frame or behind it. Errors where a mask does not have its camera's size, or
/// the bounds are empty or not finite. The hull may be empty: then the masks contradict each other (wrong poses, moved
/// object) or the bounds miss the object.
pub fn visual_hull(
    cameras: &[Camera],
    masks: &[&Mask],
    bounds: (Vec3, Vec3),
    config: &HullConfig,
) -> Result<Hull, SplatError> {
    let views = Views::new(cameras, masks, config.min_views)?;
    let (low, high) = bounds;
    let extent = high - low;
    if !(extent.is_finite() && extent.min_element() > 0.0) {
        let expected = "a lowest corner below the highest, finite".into();
        return Err(SplatError::Shape { what: "visual hull, bounds", expected, found: format!("{low} to {high}") });
    }
    if !(1..=MAX_RESOLUTION).contains(&config.resolution) {
        let found = config.resolution as f32;
        return Err(SplatError::Range { what: "HullConfig::resolution", index: 0, expected: "[1, 512]", found });
    }
    let side = extent.max_element() / config.resolution as f32;
    let limit = Vec3::splat(config.resolution as f32);
    let size = (extent / side).ceil().clamp(Vec3::ONE, limit).as_uvec3();
    let mut voxels = Voxels { low, side, size, inside: vec![false; (size.x * size.y * size.z) as usize] };
    let grid = Voxels { inside: Vec::new(), ..voxels };
    voxels.inside.par_chunks_mut(size.x as usize).enumerate().for_each(|(row, flags)| {
        let (y, z) = (row as u32 % size.y, row as u32 / size.y);
        for (x, flag) in flags.iter_mut().enumerate() {
            *flag = views.inside(grid.centre(UVec3::new(x as u32, y, z)));
        }
    });
    let slices: Vec<Vec<(Vec3, Vec3)>> = (0..size.z)
        .into_par_iter()
        .map(|z| {
            let mut found = Vec::new();
            for y in 0..size.y {
                for x in 0..size.x {
                    let at = UVec3::new(x, y, z);
                    if voxels.on_surface(at) {
                        let normal = voxels.normal(at);
                        found.push((refine(&views, voxels.centre(at), normal, side), normal));
                    }
                }
            }
            found
        })
        .collect();
    let (points, normals) = slices.into_iter().flatten().unzip();
    let occupied = voxels.inside.iter().filter(|&&inside| inside).count();
    Ok(Hull { points, normals, voxel_size: side, occupied })
}

/// From a point inside along the normal to where the coverage falls through ½; the point itself where that is
/// further than two voxels.
fn refine(views: &Views<'_>, inside: Vec3, normal: Vec3, side: f32) -> Vec3 {
    let at = |t: f32| inside + normal * (t * side);
    let Some(step) = (1..=4).find(|&step| !views.inside(at(0.5 * step as f32))) else { return inside };
    let (mut near, mut far) = (0.5 * (step - 1) as f32, 0.5 * step as f32);
    // 2⁻⁸ of half a voxel is finer than any mask.
    for _ in 0..8 {
        let middle = 0.5 * (near + far);
        if views.inside(at(middle)) {
            near = middle;
        } else {
            far = middle;
        }
    }
    at(0.5 * (near + far))
}

/// Counts of covered pixels in all rectangles from the corner.
struct SummedMask {
    width: usize,
    height: usize,
    sums: Vec<u32>,
}

impl SummedMask {
    fn new(mask: &Mask) -> Self {
        let (width, height) = (mask.width(), mask.height());
        let mut sums = vec![0u32; (width + 1) * (height + 1)];
        for y in 0..height {
            let mut row = 0;
            for x in 0..width {
                row += (mask.coverage(x, y) >= INSIDE) as u32;
                sums[(y + 1) * (width + 1) + x + 1] = sums[y * (width + 1) + x + 1] + row;
            }
        }
        Self { width, height, sums }
    }

    /// Whether a pixel is covered in the square of half side `radius` around `centre`; `None` if that leaves the image.
    fn any(&self, centre: Vec2, radius: f32) -> Option<bool> {
        let (low, high) = ((centre - radius).floor(), (centre + radius).ceil());
        let size = Vec2::new(self.width as f32, self.height as f32);
        if !(low.cmpge(Vec2::ZERO).all() && high.cmple(size).all()) {
            return None;
        }
        let at = |x: f32, y: f32| self.sums[y as usize * (self.width + 1) + x as usize];
        Some(at(high.x, high.y) + at(low.x, low.y) > at(low.x, high.y) + at(high.x, low.y))
    }
}

/// A box that contains the object, from masks and cameras alone; lowest and highest corner in scene units.
///
/// The rays through the centroids of the masks meet at a centre (least squares); the masks' reach around it gives
/// a cube; the cube is carved coarsely and conservatively, and the box of what is left is returned. `None` where this
/// says nothing: fewer than two masks that are not empty, rays that are almost parallel, or masks that contradict
/// each other.
pub fn scene_bounds_from_masks(cameras: &[Camera], masks: &[&Mask]) -> Result<Option<(Vec3, Vec3)>, SplatError> {
    let views = Views::new(cameras, masks, 1)?;
    let seen: Vec<(&Camera, &Mask, Vec2)> = views
        .cameras
        .iter()
        .zip(views.masks)
        .filter_map(|(camera, mask)| centroid(mask).map(|centroid| (camera, *mask, centroid)))
        .collect();
    let Some(centre) = convergence(&seen) else { return Ok(None) };
    let mut reach = 0.0f32;
    for (camera, mask, _) in &seen {
        let Some((pixel, z)) = camera.project(centre) else { continue };
        let k = &camera.intrinsics;
        for y in 0..mask.height() {
            for x in 0..mask.width() {
                if mask.coverage(x, y) >= INSIDE {
                    let offset = (Vec2::new(x as f32 + 0.5, y as f32 + 0.5) - pixel) / Vec2::new(k.fx, k.fy);
                    reach = reach.max(offset.length() * z);
                }
            }
        }
    }
    let reach = reach * BOUNDS_MARGIN;
    if !(reach > 0.0 && reach.is_finite()) {
        return Ok(None);
    }
    let side = 2.0 * reach / BOUNDS_CELLS as f32;
    let low = centre - reach;
    let sums: Vec<SummedMask> = seen.iter().map(|(_, mask, _)| SummedMask::new(mask)).collect();
    let kept = |cell: Vec3| {
        let radius = 0.5 * 3f32.sqrt() * side;
        let mut views = 0;
        for ((camera, ..), sums) in seen.iter().zip(&sums) {
            let Some((pixel, z)) = camera.project(cell) else { continue };
            // How far a sphere around the cell reaches from its centre's projection, generously: the ratio of depths
            // for its nearer half, and the slant of the ray.
            let slant = camera.pixel_direction(pixel).length();
            if z <= 2.0 * radius {
                continue;
            }
            let window = camera.intrinsics.fx.max(camera.intrinsics.fy) * slant * slant * radius / (z - radius) + 1.0;
            match sums.any(pixel, window) {
                Some(false) => return false,
                Some(true) => views += 1,
                None => {}
            }
        }
        views > 0
    };
    let rows: Vec<Option<(Vec3, Vec3)>> = (0..BOUNDS_CELLS * BOUNDS_CELLS)
        .into_par_iter()
        .map(|row| {
            let mut found: Option<(Vec3, Vec3)> = None;
            for x in 0..BOUNDS_CELLS {
                let corner = low + side * UVec3::new(x, row % BOUNDS_CELLS, row / BOUNDS_CELLS).as_vec3();
                if kept(corner + 0.5 * side) {
                    found = union(found, Some((corner, corner + side)));
                }
            }
            found
        })
        .collect();
    Ok(rows.into_iter().fold(None, union))
}

fn union(a: Option<(Vec3, Vec3)>, b: Option<(Vec3, Vec3)>) -> Option<(Vec3, Vec3)> {
    match (a, b) {
        (Some(a), Some(b)) => Some((a.0.min(b.0), a.1.max(b.1))),
        (a, b) => a.or(b),
    }
}

/// Centre of a mask, pixels.
fn centroid(mask: &Mask) -> Option<Vec2> {
    let (mut sum, mut weight) = (glam::DVec2::ZERO, 0.0f64);
    for y in 0..mask.height() {
        for x in 0..mask.width() {
            let coverage = mask.coverage(x, y) as f64;
            sum += coverage * glam::DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            weight += coverage;
        }
    }
    (weight > 0.0).then(|| (sum / weight).as_vec2())
}

/// The point nearest to the rays through the centroids: Σ(I − ddᵀ)·(p − o) = 0. In front of every camera, or `None`.
fn convergence(seen: &[(&Camera, &Mask, Vec2)]) -> Option<Vec3> {
    let (mut matrix, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for (camera, _, pixel) in seen {
        let ray = camera.ray(*pixel);
        let d = ray.direction.as_dvec3();
        let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        matrix += across;
        right += across * ray.origin.as_dvec3();
    }
    let determinant = (matrix * (1.0 / seen.len().max(1) as f64)).determinant();
    if determinant.is_nan() || determinant < MIN_CONVERGENCE {
        return None;
    }
    let centre = (matrix.inverse() * right).as_vec3();
    let in_front = seen.iter().all(|(camera, ..)| camera.pose.transform_point(centre).z > 0.0);
    (centre.is_finite() && in_front).then_some(centre)
}
