//! From a recipe's object to closed geometry, and points on its surface.
use crate::{ObjectRecipe, Recipe, SynthError, UpAxis};
use diamond_pathtrace::{Geometry, Mesh, RepairOptions, RepairReport, Rng, parse_obj, parse_ply, read_gltf};
use glam::{Quat, Vec3};
use std::path::{Path, PathBuf};

/// Random numbers of surface points.
const POINTS_STREAM: u64 = 0x706f_696e_7473;
/// Standard deviation of what is added to surface points, scene units: as structure from motion would have it.
const POINT_NOISE: f32 = 0.01;

/// A shape, ready to be rendered.
#[derive(Debug, Clone)]
pub struct Object {
    /// Its surface: closed, outward, inside the unit ball.
    pub mesh: Mesh,
    /// The same as the renderer wants it.
    pub geometry: Geometry,
    /// What had to be repaired.
    pub repairs: RepairReport,
}

impl Object {
    /// Builds the object of a recipe; `folder` is where the paths of the recipe are relative to.
    ///
    /// # Errors
    /// A file that cannot be read or holds no mesh, or a mesh that cannot be closed with certainty.
    pub fn new(recipe: &Recipe, folder: &Path) -> Result<Self, SynthError> {
        let mesh = match &recipe.object {
            ObjectRecipe::Mesh { path, radius, up, .. } => {
                let mut mesh = read_mesh(&folder.join(path))?;
                if *up == UpAxis::Y {
                    let turn = Quat::from_rotation_x(std::f32::consts::FRAC_PI_2);
                    mesh.positions.iter_mut().chain(mesh.normals.iter_mut().flatten()).for_each(|p| *p = turn * *p);
                }
                mesh.fitted(Vec3::ZERO, *radius)
            }
            ObjectRecipe::Solids { cells, .. } | ObjectRecipe::Random { cells, .. } => {
                let mesh = recipe.object.field().map(|field| field.polygonise(*cells)).transpose()?;
                // Blends and noise may reach beyond the ball, and random objects should fill it.
                let mesh = mesh.unwrap_or_default();
                let farthest = mesh.positions.iter().map(|p| p.length()).fold(0.0, f32::max);
                let is_random = matches!(recipe.object, ObjectRecipe::Random { .. });
                if farthest > 1.0 || is_random { mesh.fitted(Vec3::ZERO, 1.0) } else { mesh }
            }
        };
        let (mut mesh, repairs) = mesh.repair(&RepairOptions::default())?;
        match recipe.object {
            ObjectRecipe::Mesh { smooth: false, .. } => mesh.normals = None,
            _ => mesh = mesh.with_smooth_normals(),
        }
        let geometry = Geometry::from_mesh(mesh.clone())?;
        Ok(Self { mesh, geometry, repairs })
    }

    /// `count` points spread evenly over the surface, moved a little at random.
    pub fn surface_points(&self, count: usize, seed: u64) -> Vec<Vec3> {
        let corners: Vec<[Vec3; 3]> = (0..self.mesh.triangles.len()).map(|t| self.mesh.corners(t)).collect();
        let mut total = 0.0f64;
        let sums: Vec<f64> = corners
            .iter()
            .map(|[a, b, c]| {
                total += f64::from((*b - *a).cross(*c - *a).length());
                total
            })
            .collect();
        let mut rng = Rng::new(seed, POINTS_STREAM);
        let mut point = |k: usize| {
            // Stratified along the triangles.
            let at = (k as f64 + f64::from(rng.uniform())) / count as f64 * total;
            let t = sums.partition_point(|&sum| sum <= at).min(corners.len() - 1);
            let (root, v) = (rng.uniform().sqrt(), rng.uniform());
            let [a, b, c] = corners[t];
            let gaussian = |rng: &mut Rng| {
                let (radius, angle) = ((2.0 * rng.exponential()).sqrt(), std::f32::consts::TAU * rng.uniform());
                radius * angle.cos()
            };
            let noise = Vec3::new(gaussian(&mut rng), gaussian(&mut rng), gaussian(&mut rng));
            a * (1.0 - root) + b * (root * (1.0 - v)) + c * (root * v) + POINT_NOISE * noise
        };
        if corners.is_empty() { Vec::new() } else { (0..count).map(&mut point).collect() }
    }
}

/// Points as a PLY file.
pub(crate) fn points_ply(points: &[Vec3]) -> Vec<u8> {
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         end_header\n",
        points.len()
    )
    .into_bytes();
    bytes.extend(points.iter().flat_map(|p| p.to_array()).flat_map(f32::to_le_bytes));
    bytes
}

fn read_mesh(path: &Path) -> Result<Mesh, SynthError> {
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    let parse: fn(&[u8]) -> Result<Mesh, String> = match extension.as_str() {
        "gltf" | "glb" => return Ok(read_gltf(path)?.mesh),
        "obj" => parse_obj,
        "ply" => parse_ply,
        _ => {
            let detail = format!("expected .obj, .ply, .gltf or .glb, found \".{extension}\"; convert the mesh");
            return Err(SynthError::Recipe { origin: path.display().to_string(), detail });
        }
    };
    let bytes = std::fs::read(path).map_err(|source| SynthError::File { path: PathBuf::from(path), source })?;
    parse(&bytes).map_err(|detail| SynthError::Recipe { origin: path.display().to_string(), detail })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recipe(object: &str) -> Recipe {
        let text =
            format!("name = \"x\"\n[object]\n{object}\n[material]\nsigma_t = [1, 1, 1]\nalbedo = [0.5, 0.5, 0.5]\n");
        Recipe::parse(&text, "x").unwrap()
    }

    #[test]
    fn blends_become_closed_meshes_in_the_ball_and_points_lie_on_them() {
        for object in [
            "kind = \"random\"\nseed = 5\ncells = 24",
            "kind = \"solids\"\ncells = 24\nparts = [{ solid = \"sphere\", centre = [0.5, 0, 0], radius = 0.9 }]",
        ] {
            let object = Object::new(&recipe(object), Path::new("")).unwrap();
            assert!(object.mesh.is_closed() && object.mesh.signed_volume() > 0.0);
            assert!(object.mesh.positions.iter().all(|p| p.length() <= 1.0001));
            let points = object.surface_points(500, 1);
            assert_eq!(points, object.surface_points(500, 1));
            let nearest = |p: Vec3| object.mesh.positions.iter().map(|q| (p - *q).length()).fold(f32::MAX, f32::min);
            let mean = points.iter().map(|p| nearest(*p)).sum::<f32>() / 500.0;
            assert!(points.len() == 500 && mean < 0.08, "{mean}");
        }
    }

    #[test]
    fn files_that_are_not_there_or_no_meshes_are_named() {
        let of = |path: &str| {
            let object = format!("kind = \"mesh\"\npath = \"{path}\"");
            Object::new(&recipe(&object), Path::new("/nowhere")).unwrap_err().to_string()
        };
        assert!(of("thing.obj").contains("/nowhere/thing.obj"));
        assert!(of("thing.stl").contains("expected .obj, .ply, .gltf or .glb, found \".stl\""));
    }
}
