//! A surface and the medium inside it, in a checkpoint.
use crate::{ReconstructError, TensorFile, error};
use diamond_medium::{Medium, Surface};
use diamond_pathtrace::Mesh;
use glam::Vec3;
use std::path::Path;

/// Writes a surface and a medium under a name.
pub(crate) fn store(
    file: &mut TensorFile,
    name: &str,
    surface: &Surface,
    medium: &Medium,
) -> Result<(), ReconstructError> {
    let mesh = surface.mesh();
    let flat = |v: &[Vec3]| v.iter().flat_map(|p| p.to_array()).collect::<Vec<f32>>();
    file.insert(format!("{name}.positions"), &[mesh.positions.len(), 3], flat(&mesh.positions));
    let normals = flat(mesh.normals.as_deref().unwrap_or_default());
    file.insert(format!("{name}.normals"), &[mesh.positions.len(), 3], normals);
    // Far below 2²⁴, so f32 holds them exactly.
    let triangles = mesh.triangles.iter().flatten().map(|i| *i as f32).collect();
    file.insert(format!("{name}.triangles"), &[mesh.triangles.len(), 3], triangles);
    file.metadata.insert(name.into(), medium.to_toml().map_err(error::stage("medium"))?);
    file.metadata.insert(format!("{name}_vertices"), mesh.positions.len().to_string());
    file.metadata.insert(format!("{name}_triangles"), mesh.triangles.len().to_string());
    Ok(())
}

/// What [`store`] wrote under a name, if it did; the surface is cut into about `surfels` pieces.
pub(crate) fn restore(
    path: &Path,
    file: &mut TensorFile,
    name: &str,
    surfels: usize,
) -> Result<Option<(Surface, Medium)>, ReconstructError> {
    let Some(text) = file.metadata.get(name).cloned() else { return Ok(None) };
    let fail = |detail: String| ReconstructError::Checkpoint { path: path.to_owned(), detail };
    let medium = Medium::parse(&text).map_err(|e| fail(e.to_string()))?;
    let vertices: usize = file.metadata_value(path, &format!("{name}_vertices"))?;
    let triangles: usize = file.metadata_value(path, &format!("{name}_triangles"))?;
    let mut vectors = |part: &str| -> Result<Vec<Vec3>, ReconstructError> {
        let values = file.take(path, &format!("{name}.{part}"), vertices.saturating_mul(3))?;
        Ok(values.chunks_exact(3).map(Vec3::from_slice).collect())
    };
    let (positions, normals) = (vectors("positions")?, vectors("normals")?);
    let indices = file.take(path, &format!("{name}.triangles"), triangles.saturating_mul(3))?;
    let triangles = indices.chunks_exact(3).map(|t| [t[0] as u32, t[1] as u32, t[2] as u32]).collect();
    let mesh = Mesh { positions, normals: Some(normals), triangles, ..Mesh::default() };
    let surface = Surface::new(mesh, surfels).map_err(|e| fail(e.to_string()))?;
    Ok(Some((surface, medium)))
}
