//! Triangle meshes: what a file holds and a ray meets.
use crate::PathtraceError;
use glam::{Vec2, Vec3};

/// A triangle mesh. Corners run counter-clockwise seen from outside.
///
/// ```
/// use diamond_pathtrace::Mesh;
/// use glam::Vec3;
/// let cube = Mesh::cuboid(Vec3::splat(-1.0), Vec3::splat(1.0));
/// cube.validate()?;
/// assert!((cube.signed_volume() - 8.0).abs() < 1e-6);
/// # Ok::<(), diamond_pathtrace::PathtraceError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Mesh {
    /// Vertices, scene units.
    pub positions: Vec<Vec3>,
    /// Three indices of vertices for each triangle.
    pub triangles: Vec<[u32; 3]>,
    /// Shading normals, one for each vertex, unit length; only a coat uses them.
    pub normals: Option<Vec<Vec3>>,
    /// Texture coordinates, one for each vertex.
    pub uvs: Option<Vec<Vec2>>,
}

/// Coordinates are at most this in size, so that products of three still fit an `f32`.
pub const MAX_COORDINATE: f32 = 1e9;

impl Mesh {
    /// A box, 12 triangles.
    pub fn cuboid(min: Vec3, max: Vec3) -> Self {
        let corner = |i: u32| Vec3::select(glam::BVec3::new(i & 1 != 0, i & 2 != 0, i & 4 != 0), max, min);
        let positions = (0..8).map(corner).collect();
        let quads = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
        let triangles = quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        Self { positions, triangles, normals: None, uvs: None }
    }

    /// A sphere from an icosahedron whose triangles are divided `subdivisions` times (20·4ⁿ triangles; at most 8 times). Its
    /// vertices lie on the sphere, with the sphere's normals.
    pub fn icosphere(centre: Vec3, radius: f32, subdivisions: u32) -> Self {
        let t = 0.5 * (1.0 + 5f32.sqrt());
        let mut normals: Vec<Vec3> = [(-1.0, t), (1.0, t), (-1.0, -t), (1.0, -t)]
            .into_iter()
            .flat_map(|(a, b)| [Vec3::new(a, b, 0.0), Vec3::new(0.0, a, b), Vec3::new(b, 0.0, a)])
            .map(Vec3::normalize)
            .collect();
        // Faces: every three vertices at the edge's distance from each other, turned outward.
        let edge = 2.0 / (1.0 + t * t).sqrt();
        let near = |a: Vec3, b: Vec3| (a - b).length() < 1.1 * edge;
        let mut triangles = Vec::new();
        for a in 0..12usize {
            for b in a + 1..12 {
                for c in b + 1..12 {
                    let (p, q, r) = (normals[a], normals[b], normals[c]);
                    if near(p, q) && near(q, r) && near(r, p) {
                        let outward = (q - p).cross(r - p).dot(p) > 0.0;
                        let [a, b, c] = [a as u32, b as u32, c as u32];
                        triangles.push(if outward { [a, b, c] } else { [a, c, b] });
                    }
                }
            }
        }
        for _ in 0..subdivisions.min(8) {
            let mut middles = std::collections::BTreeMap::new();
            let mut middle = |a: u32, b: u32| {
                *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
                    normals.push((normals[a as usize] + normals[b as usize]).normalize());
                    normals.len() as u32 - 1
                })
            };
            triangles = triangles
                .iter()
                .flat_map(|&[a, b, c]| {
                    let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
                    [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
                })
                .collect();
        }
        let positions = normals.iter().map(|n| centre + *n * radius).collect();
        Self { positions, triangles, normals: Some(normals), uvs: None }
    }

    /// `Err` where a list has the wrong length, an index points outside, a coordinate is not finite or beyond 10⁹, or there is
    /// no triangle. Whether the surface is closed is the question of [`Mesh::repair`].
    pub fn validate(&self) -> Result<(), PathtraceError> {
        let n = self.positions.len();
        let shape = |what, expected: String, found: String| Err(PathtraceError::Shape { what, expected, found });
        if self.triangles.is_empty() {
            return shape("triangles of a mesh", "at least one".into(), "none".into());
        }
        for (what, length) in [
            ("normals of a mesh", self.normals.as_ref().map(Vec::len)),
            ("uvs of a mesh", self.uvs.as_ref().map(Vec::len)),
        ] {
            if let Some(length) = length.filter(|length| *length != n) {
                return shape(what, format!("{n}, one for each vertex"), format!("{length}"));
            }
        }
        for (i, triangle) in self.triangles.iter().enumerate() {
            if let Some(index) = triangle.iter().find(|index| **index as usize >= n) {
                return shape("triangles of a mesh", format!("indices below {n}"), format!("{index} in triangle {i}"));
            }
        }
        let bad = |v: &Vec3| !(v.is_finite() && v.abs().max_element() <= MAX_COORDINATE);
        for (what, list) in [("position", Some(&self.positions)), ("normal", self.normals.as_ref())] {
            if let Some((i, v)) = list.into_iter().flatten().enumerate().find(|(_, v)| bad(v)) {
                return Err(PathtraceError::Value {
                    what: format!("{what} of vertex {i}"),
                    expected: "three finite numbers up to 10⁹",
                    found: format!("{v}"),
                });
            }
        }
        Ok(())
    }

    /// The corners of a triangle.
    #[inline]
    pub fn corners(&self, triangle: usize) -> [Vec3; 3] {
        self.triangles[triangle].map(|i| self.positions[i as usize])
    }

    /// Twice the area times the unit normal of a triangle, in double precision.
    pub(crate) fn area_vector(&self, triangle: usize) -> glam::DVec3 {
        let [a, b, c] = self.corners(triangle).map(|v| v.as_dvec3());
        (b - a).cross(c - a)
    }

    /// Smallest and largest coordinates; infinite and reversed in a mesh without vertices.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        let start = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        self.positions.iter().fold(start, |(low, high), p| (low.min(*p), high.max(*p)))
    }

    /// Enclosed volume, cubic scene units; negative where the mesh is inside out. Only closed meshes have one.
    pub fn signed_volume(&self) -> f64 {
        let centre = self.positions.first().map_or(glam::DVec3::ZERO, |v| v.as_dvec3());
        let sum: f64 = (0..self.triangles.len())
            .map(|t| {
                let [a, b, c] = self.corners(t).map(|v| v.as_dvec3() - centre);
                a.dot(b.cross(c))
            })
            .sum();
        sum / 6.0
    }

    /// Vertex normals: the mean of the adjacent triangles' normals, weighted by angle. Vertices without area keep +z.
    pub fn with_smooth_normals(mut self) -> Self {
        let mut sums = vec![Vec3::ZERO; self.positions.len()];
        for (t, triangle) in self.triangles.iter().enumerate() {
            let corners = self.corners(t);
            let normal = self.area_vector(t).normalize_or_zero().as_vec3();
            for k in 0..3 {
                let (a, b) = (corners[(k + 1) % 3] - corners[k], corners[(k + 2) % 3] - corners[k]);
                sums[triangle[k] as usize] += normal * a.try_normalize().map_or(0.0, |_| a.angle_between(b));
            }
        }
        self.normals = Some(sums.into_iter().map(|sum| sum.normalize_or(Vec3::Z)).collect());
        self
    }

    /// Moves and scales the mesh uniformly into the ball of the given centre and radius (around its vertices' bounding box).
    pub fn fitted(mut self, centre: Vec3, radius: f32) -> Self {
        let (low, high) = self.bounds();
        let middle = 0.5 * (low + high);
        let extent = self.positions.iter().map(|p| (*p - middle).length()).fold(0.0, f32::max);
        let scale = if extent > 0.0 { radius / extent } else { 1.0 };
        self.positions.iter_mut().for_each(|p| *p = centre + (*p - middle) * scale);
        self
    }
}
