//! Points on the surface at which light is gathered once, and how a place between them takes its value from those around it.
//!
//! Points are uniform by area and keep a distance from each other (dart throwing). Between them, values are fitted by moving least
//! squares: a linear function of the place in the tangent plane, weighted towards near points of like orientation. It reproduces
//! constants and slopes, so its error is that of curvature.
use crate::geometry::NO_PRIMITIVE;
use crate::{Geometry, Mesh, Patch, PathtraceError, Rng, sampling::uniform_sphere};
use glam::{DVec3, Vec3};

/// Neighbours within this many spacings are used.
const REACH: f32 = 1.8;

/// Neighbours whose normals differ by more than this cosine belong to another side of the object.
const LIKE_NORMALS: f32 = 0.3;

/// How many candidates are thrown for each point that is wanted.
const CANDIDATES: usize = 12;

/// Weight of slopes that are zero, relative to the neighbours': keeps the fit solvable where points are few or in a line.
const SLOPE_RIDGE: f64 = 1e-3;

/// A point of the surface.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SurfacePoint {
    /// World.
    pub position: Vec3,
    /// Outward unit normal of the surface itself.
    pub normal: Vec3,
    /// Interpolated unit normal, where the mesh has one.
    pub smooth_normal: Vec3,
    /// Triangle; 0 on other shapes.
    pub primitive: u32,
}

/// Points all over a surface.
#[derive(Debug)]
pub(crate) struct SurfacePoints {
    points: Vec<SurfacePoint>,
    /// Smallest distance between points of like orientation, scene units.
    pub spacing: f32,
    low: Vec3,
    per_cell: f32,
    size: [usize; 3],
    starts: Vec<u32>,
    members: Vec<u32>,
}

/// Draws points of a shape uniformly by area.
struct AreaSampler<'a> {
    geometry: &'a Geometry,
    /// Running sums of twice the triangles' areas.
    cumulative: Vec<f64>,
    area: f64,
}

impl<'a> AreaSampler<'a> {
    fn new(geometry: &'a Geometry) -> Result<Self, PathtraceError> {
        let mut cumulative = Vec::new();
        let area = match geometry {
            Geometry::Mesh(mesh) => {
                let mut sum = 0.0;
                for t in 0..mesh.mesh().triangles.len() {
                    sum += mesh.mesh().area_vector(t).length();
                    cumulative.push(sum);
                }
                0.5 * sum
            }
            Geometry::Sphere { radius, .. } => 4.0 * std::f64::consts::PI * f64::from(radius * radius),
            Geometry::Slab { .. } => f64::INFINITY,
        };
        if area > 0.0 && area.is_finite() {
            return Ok(Self { geometry, cumulative, area });
        }
        Err(PathtraceError::Mesh {
            problem: format!("its surface has the area {area}"),
            advice: "the bulk renderer needs an object of finite size",
        })
    }

    fn draw(&self, rng: &mut Rng) -> SurfacePoint {
        match self.geometry {
            Geometry::Mesh(mesh) => {
                let total = self.cumulative.last().copied().unwrap_or(0.0);
                // 48 bits: with 24, large meshes would have triangles that are never drawn.
                let u = (f64::from(rng.bits()) + f64::from(rng.bits() >> 16) / 65_536.0) / 4_294_967_296.0;
                let t = self.cumulative.partition_point(|c| *c <= u * total).min(self.cumulative.len() - 1);
                let (a, b) = (rng.uniform().sqrt(), rng.uniform());
                let (v, w) = (a * (1.0 - b), a * b);
                let corners = mesh.mesh().corners(t);
                let position = corners[0] + (corners[1] - corners[0]) * v + (corners[2] - corners[0]) * w;
                let normal = mesh.normal(t as u32);
                let smooth_normal = smooth_normal(mesh.mesh(), t, [1.0 - v - w, v, w], normal);
                SurfacePoint { position, normal, smooth_normal, primitive: t as u32 }
            }
            Geometry::Sphere { centre, radius } => {
                let normal = uniform_sphere(rng);
                SurfacePoint { position: *centre + normal * *radius, normal, smooth_normal: normal, primitive: 0 }
            }
            Geometry::Slab { top, .. } => {
                SurfacePoint { position: Vec3::Z * *top, normal: Vec3::Z, smooth_normal: Vec3::Z, primitive: 0 }
            }
        }
    }
}

fn smooth_normal(mesh: &Mesh, triangle: usize, weights: [f32; 3], normal: Vec3) -> Vec3 {
    let Some(normals) = &mesh.normals else { return normal };
    let [a, b, c] = mesh.triangles[triangle].map(|i| normals[i as usize]);
    let smooth = (a * weights[0] + b * weights[1] + c * weights[2]).normalize_or(normal);
    if smooth.dot(normal) > 0.0 { smooth } else { normal }
}

/// Cell of a grid, clamped to it.
fn cell_of(p: Vec3, low: Vec3, per_cell: f32, size: [usize; 3]) -> [usize; 3] {
    let at = ((p - low) * per_cell).to_array();
    std::array::from_fn(|k| (at[k].max(0.0) as usize).min(size[k] - 1))
}

impl SurfacePoints {
    /// About `count` points.
    pub fn new(geometry: &Geometry, count: usize, seed: u64) -> Result<Self, PathtraceError> {
        let sampler = AreaSampler::new(geometry)?;
        let count = count.max(16);
        // Darts that keep the distance r end up with 0.6 … 0.7 points for each r² of area (discs that cover 0.55).
        let spacing = (0.62 * sampler.area / count as f64).sqrt() as f32;
        let reach = REACH * spacing;
        let (low, high) = geometry.bounds();
        let per_cell = 1.0 / reach;
        let size = ((high - low) * per_cell).to_array().map(|n| (n as usize + 1).min(512));
        let mut cells: Vec<Vec<u32>> = vec![Vec::new(); size[0] * size[1] * size[2]];
        let mut points: Vec<SurfacePoint> = Vec::with_capacity(count);
        let mut rng = Rng::new(seed, u64::MAX);
        for _ in 0..CANDIDATES * count {
            let point = sampler.draw(&mut rng);
            let [x, y, z] = cell_of(point.position, low, per_cell, size);
            let near = |k: usize, n: usize| k.saturating_sub(1)..(k + 2).min(n);
            let free = near(z, size[2]).all(|z| {
                near(y, size[1]).all(|y| {
                    near(x, size[0]).all(|x| {
                        cells[(z * size[1] + y) * size[0] + x].iter().all(|k| {
                            let other = &points[*k as usize];
                            (other.position - point.position).length_squared() >= spacing * spacing
                                || other.smooth_normal.dot(point.smooth_normal) < LIKE_NORMALS
                        })
                    })
                })
            });
            if free {
                cells[(z * size[1] + y) * size[0] + x].push(points.len() as u32);
                points.push(point);
            }
        }
        Ok(Self::sorted(points, spacing, low, per_cell, size, &cells))
    }

    /// Points that are given. Places are fitted from those within [`REACH`] times the root of the largest area.
    pub fn of_patches(patches: &[Patch]) -> Self {
        let largest = patches.iter().map(|p| p.area).fold(f32::MIN_POSITIVE, f32::max);
        let spacing = largest.sqrt();
        let low = patches.iter().fold(Vec3::INFINITY, |a, p| a.min(p.position));
        let high = patches.iter().fold(Vec3::NEG_INFINITY, |a, p| a.max(p.position));
        let per_cell = 1.0 / (REACH * spacing).max((high - low).max_element() / 512.0);
        let size = ((high - low) * per_cell).to_array().map(|n| (n as usize + 1).min(512));
        let point = |p: &Patch| SurfacePoint {
            position: p.position,
            normal: p.normal,
            smooth_normal: p.normal,
            primitive: NO_PRIMITIVE,
        };
        let points: Vec<SurfacePoint> = patches.iter().map(point).collect();
        let mut cells: Vec<Vec<u32>> = vec![Vec::new(); size[0] * size[1] * size[2]];
        for (k, point) in points.iter().enumerate() {
            let [x, y, z] = cell_of(point.position, low, per_cell, size);
            cells[(z * size[1] + y) * size[0] + x].push(k as u32);
        }
        Self::sorted(points, spacing, low, per_cell, size, &cells)
    }

    fn sorted(
        points: Vec<SurfacePoint>,
        spacing: f32,
        low: Vec3,
        per_cell: f32,
        size: [usize; 3],
        cells: &[Vec<u32>],
    ) -> Self {
        let mut starts = Vec::with_capacity(cells.len() + 1);
        let mut members = Vec::with_capacity(points.len());
        for cell in cells {
            starts.push(members.len() as u32);
            members.extend(cell);
        }
        starts.push(members.len() as u32);
        Self { points, spacing, low, per_cell, size, starts, members }
    }

    /// The points.
    pub fn points(&self) -> &[SurfacePoint] {
        &self.points
    }

    /// Calls `visit` for the points of all cells around `position`.
    #[inline]
    fn around(&self, position: Vec3, mut visit: impl FnMut(u32, &SurfacePoint)) {
        let [x, y, z] = cell_of(position, self.low, self.per_cell, self.size);
        let [nx, ny, nz] = self.size;
        for z in z.saturating_sub(1)..(z + 2).min(nz) {
            for y in y.saturating_sub(1)..(y + 2).min(ny) {
                let row = (z * ny + y) * nx;
                let first = self.starts[row + x.saturating_sub(1)];
                let last = self.starts[row + (x + 2).min(nx)];
                for &k in &self.members[first as usize..last as usize] {
                    visit(k, &self.points[k as usize]);
                }
            }
        }
    }

    /// The nearest point of like orientation, or the nearest of all.
    pub fn nearest(&self, position: Vec3, normal: Vec3) -> u32 {
        let mut best = (f32::INFINITY, 0);
        let mut like = (f32::INFINITY, 0);
        self.around(position, |k, point| {
            let squared = (point.position - position).length_squared();
            if squared < best.0 {
                best = (squared, k);
            }
            if squared < like.0 && point.smooth_normal.dot(normal) > LIKE_NORMALS {
                like = (squared, k);
            }
        });
        if like.0 < f32::INFINITY || best.0 < f32::INFINITY {
            return if like.0 < f32::INFINITY { like.1 } else { best.1 };
        }
        let all = self.points.iter().enumerate();
        let squared = |p: &SurfacePoint| (p.position - position).length_squared();
        all.min_by(|a, b| squared(a.1).total_cmp(&squared(b.1))).map_or(0, |(k, _)| k as u32)
    }

    /// Point `k` and those around it, with weights that add up to 1 and fall with the distance.
    pub fn neighbours(&self, k: usize) -> Vec<(u32, f32)> {
        let centre = &self.points[k];
        let reach = REACH * self.spacing;
        let mut found = Vec::new();
        let mut sum = 0.0;
        self.around(centre.position, |k, point| {
            let near = 1.0 - ((point.position - centre.position) / reach).length_squared();
            let like = point.smooth_normal.dot(centre.smooth_normal) - LIKE_NORMALS;
            if near > 0.0 && like > 0.0 {
                found.push((k, near * like));
                sum += near * like;
            }
        });
        found.iter_mut().for_each(|(_, weight)| *weight /= sum);
        found
    }

    /// Points and weights (which add up to 1) whose weighted sum is the value at a place of the surface.
    /// `[eq:surface-fit]`
    pub fn weights(&self, position: Vec3, normal: Vec3, out: &mut Vec<(u32, f32)>) {
        out.clear();
        let reach = REACH * self.spacing;
        let (tangent, bitangent) = normal.any_orthonormal_pair();
        let mut matrix = glam::DMat3::ZERO;
        // Places of the neighbours in units of the reach, with their weights.
        let mut places: Vec<DVec3> = Vec::with_capacity(16);
        self.around(position, |k, point| {
            let offset = (point.position - position) / reach;
            let like = (point.smooth_normal.dot(normal) - LIKE_NORMALS) / (1.0 - LIKE_NORMALS);
            let near = 1.0 - offset.length_squared();
            if near <= 0.0 || like <= 0.0 {
                return;
            }
            let weight = near * near * like;
            let place = Vec3::new(1.0, tangent.dot(offset), bitangent.dot(offset)).as_dvec3();
            let w = f64::from(weight);
            matrix += glam::DMat3::from_cols(place * (w * place.x), place * (w * place.y), place * (w * place.z));
            places.push(place);
            out.push((k, weight));
        });
        if out.is_empty() {
            out.push((self.nearest(position, normal), 1.0));
            return;
        }
        let total = matrix.x_axis.x;
        matrix.y_axis.y += SLOPE_RIDGE * total;
        matrix.z_axis.z += SLOPE_RIDGE * total;
        let row = matrix.inverse() * DVec3::X;
        let mut sum = 0.0;
        for ((_, weight), place) in out.iter_mut().zip(&places) {
            *weight *= row.dot(*place) as f32;
            sum += *weight;
        }
        if sum.is_finite() && sum > 1e-3 {
            out.iter_mut().for_each(|(_, weight)| *weight /= sum);
        } else {
            out.clear();
            out.push((self.nearest(position, normal), 1.0));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `[eq:surface-fit]`: points keep their distance, about as many come as were asked for, and linear functions of the place are
    /// reproduced up to the surface's curvature.
    #[test]
    fn points_are_even_and_slopes_are_reproduced() {
        let geometries = [
            Geometry::Sphere { centre: Vec3::new(1.0, 2.0, 3.0), radius: 1.0 },
            Geometry::from_mesh(Mesh::icosphere(Vec3::new(1.0, 2.0, 3.0), 1.0, 3)).unwrap(),
        ];
        for geometry in &geometries {
            let points = SurfacePoints::new(geometry, 2000, 1).unwrap();
            let n = points.points().len();
            assert!((1600..2400).contains(&n), "{n}");
            let mut rng = Rng::new(1, 1);
            let mut weights = Vec::new();
            for _ in 0..500 {
                let normal = uniform_sphere(&mut rng);
                let position = Vec3::new(1.0, 2.0, 3.0) + normal;
                points.weights(position, normal, &mut weights);
                assert!(weights.len() >= 3, "{}", weights.len());
                let sum: f32 = weights.iter().map(|w| w.1).sum();
                let mean: Vec3 = weights.iter().map(|(k, w)| points.points()[*k as usize].position * *w).sum();
                assert!((sum - 1.0).abs() < 1e-4 && (mean - position).length() < 0.01, "{sum} {mean} {position}");
            }
        }
    }
}
