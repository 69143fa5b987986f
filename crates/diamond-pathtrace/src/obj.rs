//! Triangle meshes from Wavefront OBJ files, through `tobj`. Materials are not read: OBJ has none that describe a medium.
use crate::{Mesh, PathtraceError};
use glam::{Vec2, Vec3};
use std::io::Cursor;
use std::path::Path;

/// `Err` where a face counts back beyond the first vertex, texture coordinate or normal, or on beyond 2³²; `tobj` expects neither.
fn check_indices(bytes: &[u8]) -> Result<(), String> {
    let mut counts = [0i64; 3];
    for (n, line) in bytes.split(|b| *b == b'\n' || *b == b'\r').enumerate() {
        let line = String::from_utf8_lossy(line);
        let mut words = line.split_whitespace();
        match words.next() {
            Some("v") => counts[0] += 1,
            Some("vt") => counts[1] += 1,
            Some("vn") => counts[2] += 1,
            Some("f" | "l" | "p") => {
                for (word, count) in words.flat_map(|word| word.split('/').zip(counts)) {
                    let Ok(index) = word.parse::<i64>() else { continue };
                    if !(-count..=i64::from(u32::MAX)).contains(&index) {
                        return Err(format!("line {}: index {index}, where {count} have been listed before", n + 1));
                    }
                }
            }
            _ => {}
        }
    }
    Ok(())
}

/// Reads the mesh in the text of an OBJ file: all its objects together, polygons cut into triangles. The message says what is
/// wrong.
pub fn parse_obj(bytes: &[u8]) -> Result<Mesh, String> {
    check_indices(bytes)?;
    let options = tobj::LoadOptions { single_index: true, triangulate: true, ..Default::default() };
    let no_materials = |_: &Path| Err(tobj::LoadError::OpenFileFailed);
    let (models, _) = tobj::load_obj_buf(&mut Cursor::new(bytes), &options, no_materials).map_err(|e| e.to_string())?;
    let mut mesh = Mesh::default();
    // Attributes are kept where every object has them.
    let complete = |per_vertex: usize, of: fn(&tobj::Mesh) -> usize| {
        models.iter().all(|m| of(&m.mesh) * 3 == m.mesh.positions.len() * per_vertex)
    };
    let (normals, uvs) = (complete(3, |m| m.normals.len()), complete(2, |m| m.texcoords.len()));
    let triples = |list: &[f32]| list.chunks_exact(3).map(Vec3::from_slice).collect::<Vec<_>>();
    for tobj::Model { mesh: part, .. } in &models {
        let first = mesh.positions.len() as u32;
        mesh.positions.extend(triples(&part.positions));
        if normals {
            let unit = triples(&part.normals).into_iter().map(|n| n.normalize_or(Vec3::Z));
            mesh.normals.get_or_insert_default().extend(unit);
        }
        if uvs {
            mesh.uvs.get_or_insert_default().extend(part.texcoords.chunks_exact(2).map(Vec2::from_slice));
        }
        // Lines and points have fewer than three indices; with a list of arities nothing was cut into triangles.
        if part.face_arities.is_empty() {
            mesh.triangles.extend(part.indices.chunks_exact(3).map(|t| [t[0] + first, t[1] + first, t[2] + first]));
        }
    }
    mesh.validate().map_err(|e| e.to_string())?;
    Ok(mesh)
}

/// Reads an OBJ file. Errors name the file and what is wrong in it.
pub fn read_obj(path: &Path) -> Result<Mesh, PathtraceError> {
    let problem = |problem| PathtraceError::File { path: path.into(), problem };
    let bytes = std::fs::read(path).map_err(|e| problem(e.to_string()))?;
    parse_obj(&bytes).map_err(problem)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TETRAHEDRON: &str = "mtllib none.mtl\no body\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nusemtl wax\n\
        f 1 3 2\nf 1 2 4\no rest\nf 2 3 4\nf -4 -1 -2\n";

    #[test]
    fn objects_are_put_together_and_close() {
        let mesh = parse_obj(TETRAHEDRON.as_bytes()).unwrap();
        assert_eq!(mesh.triangles.len(), 4);
        let (mesh, report) = mesh.repair(&Default::default()).unwrap();
        assert!(!report.changed() && (mesh.signed_volume() - 1.0 / 6.0).abs() < 1e-9, "{report}");
    }

    #[test]
    fn quads_with_normals_and_texture_coordinates() {
        let text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 1\nvn 0 0 2\nf 1/1/1 2/2/1 3/2/1 4/1/1\n";
        let mesh = parse_obj(text.as_bytes()).unwrap();
        assert_eq!((mesh.triangles.len(), mesh.normals.as_ref().unwrap()[0]), (2, Vec3::Z));
        assert_eq!(mesh.uvs.as_ref().map(Vec::len), Some(4));
    }

    #[test]
    fn damage_is_an_error() {
        for (from, to) in
            [("f 2 3 4", "f 2 3 9"), ("v 1 0 0", "v 1 x 0"), ("v 0 1 0", "v 0 inf 0"), ("f 1 3 2", "f 1 3 0")]
        {
            assert!(parse_obj(TETRAHEDRON.replacen(from, to, 1).as_bytes()).is_err(), "{from} → {to}");
        }
        assert!(parse_obj(b"").is_err() && parse_obj(&[0xff, 0xfe, 0]).is_err());
        assert!(read_obj(Path::new("no/such.obj")).unwrap_err().to_string().contains("no/such.obj"));
    }
}
