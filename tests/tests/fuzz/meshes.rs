//! Readers of meshes, and what makes solid objects of them.
use super::harness::{Answer, Target};
use super::random::Random;
use base64::Engine;
use diamond_pathtrace::{Facing, Geometry, Mesh, NO_PRIMITIVE, RepairOptions, parse_gltf, parse_obj, parse_ply};
use glam::Vec3;

/// All of them.
pub fn targets() -> Vec<Target> {
    vec![obj(), ply(), gltf(), glb()]
}

/// Of every mesh that a reader accepts: it is valid, repair answers, and rays through what repair returns end with finite numbers.
fn obeys_laws(mesh: Mesh) -> Result<Answer, String> {
    super::law("mesh", mesh.validate())?;
    let (mesh, report) = match mesh.repair(&RepairOptions::default()) {
        Err(e) => return Answer::refused(e),
        Ok(repaired) => repaired,
    };
    super::law("repaired mesh", mesh.validate())?;
    if report.components == 0 {
        return Ok(Answer::Parsed);
    }
    let geometry = match Geometry::from_mesh(mesh) {
        Err(e) => return Answer::refused(e),
        Ok(geometry) => geometry,
    };
    let (low, high) = geometry.bounds();
    let (centre, size) = (0.5 * (low + high), (high - low).length());
    for direction in [Vec3::X, Vec3::NEG_Y, Vec3::new(0.36, 0.48, 0.8)] {
        let origin = centre - direction * (2.0 * size);
        if let Some(hit) = geometry.closest_hit(origin, direction, f32::INFINITY, Facing::Entering, NO_PRIMITIVE) {
            let length = geometry.inside_length(hit.position, direction, f32::INFINITY, true, hit.primitive);
            if !(hit.position.is_finite() && hit.normal.is_finite() && length.is_finite() && length >= 0.0) {
                return Err(format!("a ray that is not finite: {hit:?}, length {length}"));
            }
        }
    }
    Ok(Answer::Parsed)
}

fn tetrahedron() -> Mesh {
    let positions = vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z];
    Mesh { positions, triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], normals: None, uvs: None }
}

fn obj() -> Target {
    let seeds = vec![
        b"# a tetrahedron\no t\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n".to_vec(),
        b"mtllib none.mtl\nv 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\nv 1 1 1.5\nvt 0 0\nvt 1 0.5\nvn 0 0 -1\nvn 0 1 0\ng a\nusemtl m\n\
          f 4/1/1 3/2/1 2/1/1 1/2/1\ng b\nf 1//2 2//2 5//2\nf 2 3 5\nf -3 -2 -1\nf 4 1 5\n"
            .to_vec(),
    ];
    let check = |bytes: &[u8]| match parse_obj(bytes) {
        Err(e) => Answer::refused(e),
        Ok(mesh) => obeys_laws(mesh),
    };
    Target { cases: 1000, ..Target::new("mesh_obj", seeds, check) }.text()
}

fn ply() -> Target {
    let mesh = tetrahedron();
    let header = |format: &str| {
        format!(
            "ply\nformat {format} 1.0\ncomment a tetrahedron\nelement vertex 4\nproperty float x\nproperty float y\n\
             property float z\nelement face 4\nproperty list uchar int vertex_indices\nend_header\n"
        )
        .into_bytes()
    };
    let mut ascii = header("ascii");
    let (mut little, mut big) = (header("binary_little_endian"), header("binary_big_endian"));
    for p in &mesh.positions {
        ascii.extend(format!("{} {} {}\n", p.x, p.y, p.z).bytes());
        for v in p.to_array() {
            little.extend(v.to_le_bytes());
            big.extend(v.to_be_bytes());
        }
    }
    for t in &mesh.triangles {
        ascii.extend(format!("3 {} {} {}\n", t[0], t[1], t[2]).bytes());
        little.push(3);
        big.push(3);
        for i in t {
            little.extend(i.to_le_bytes());
            big.extend(i.to_be_bytes());
        }
    }
    let check = |bytes: &[u8]| match parse_ply(bytes) {
        Err(e) => Answer::refused(e),
        Ok(mesh) => obeys_laws(mesh),
    };
    Target { cases: 1000, ..Target::new("mesh_ply", vec![ascii, little, big], check) }
}

/// Positions, then indices.
fn buffer() -> Vec<u8> {
    let mesh = tetrahedron();
    let positions = mesh.positions.iter().flat_map(|p| p.to_array()).flat_map(f32::to_le_bytes);
    positions.chain(mesh.triangles.iter().flatten().flat_map(|i| (*i as u16).to_le_bytes())).collect()
}

fn document(uri: &str) -> String {
    format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],
"nodes":[{{"mesh":0,"translation":[0,0,1],"rotation":[0,0,0,1],"scale":[1,2,1]}}],
"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1,"material":0}}]}}],
"materials":[{{"pbrMetallicRoughness":{{"metallicFactor":0,"roughnessFactor":0.5}},
"extensions":{{"KHR_materials_ior":{{"ior":1.4}},"KHR_materials_transmission":{{"transmissionFactor":1}},
"KHR_materials_volume":{{"thicknessFactor":1,"attenuationDistance":0.5,"attenuationColor":[0.9,0.5,0.2]}}}}}}],
"extensionsUsed":["KHR_materials_ior","KHR_materials_transmission","KHR_materials_volume"],
"accessors":[{{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3","min":[0,0,0],"max":[1,1,1]}},
{{"bufferView":1,"componentType":5123,"count":12,"type":"SCALAR"}}],
"bufferViews":[{{"buffer":0,"byteLength":48}},{{"buffer":0,"byteOffset":48,"byteLength":24}}],
"buffers":[{{{uri}"byteLength":72}}]}}"#
    )
}

fn check_gltf(bytes: &[u8]) -> Result<Answer, String> {
    let object = match parse_gltf(bytes, None) {
        Err(e) => return Answer::refused(e),
        Ok(object) => object,
    };
    if let Some(material) = object.material {
        super::law("material", material.validate())?;
    }
    if let Some(coat) = object.coat {
        super::law("coat", coat.validate())?;
    }
    obeys_laws(object.mesh)
}

fn gltf() -> Target {
    let data = base64::engine::general_purpose::STANDARD.encode(buffer());
    let text = document(&format!("\"uri\":\"data:application/octet-stream;base64,{data}\","));
    Target { cases: 1000, ..Target::new("mesh_gltf", vec![text.into_bytes()], check_gltf) }.text()
}

/// Binary glTF; half of the cases have the lengths of header and chunks put right after the mutation.
fn glb() -> Target {
    let mut json = document("").into_bytes();
    while !json.len().is_multiple_of(4) {
        json.push(b' ');
    }
    let data = buffer();
    let mut file = b"glTF".to_vec();
    file.extend(2u32.to_le_bytes());
    file.extend((12 + 8 + json.len() as u32 + 8 + data.len() as u32).to_le_bytes());
    for (chunk, kind) in [(&json, b"JSON"), (&data, b"BIN\0")] {
        file.extend((chunk.len() as u32).to_le_bytes());
        file.extend(kind);
        file.extend(chunk);
    }
    let wrap = |mut bytes: Vec<u8>, random: &mut Random| {
        if random.below(2) == 0 && bytes.len() > 12 {
            let length = (bytes.len() as u32).to_le_bytes();
            bytes[8..12].copy_from_slice(&length);
        }
        bytes
    };
    Target { cases: 1000, wrap, ..Target::new("mesh_glb", vec![file], check_gltf) }
}
