//! Meshes and materials from glTF 2.0 files (`.gltf`, `.glb`), through the `gltf` crate.
//!
//! The triangles of the default scene are put together in world coordinates (y up, as glTF has it). Of the materials:
//!
//! - `KHR_materials_volume` says what light loses: σ_t = −ln(attenuationColor)/attenuationDistance. It knows no scattering, so the albedo is
//!   0, unless `KHR_materials_volume_scatter` gives the colour of multiply scattered light, which is inverted
//!   ([`crate::closed_form::albedo_from_colour`]), and g.
//! - `KHR_materials_ior` gives the boundary (1.5 without it), rough by the squared roughness, polished below α = 0.001. An index of
//!   1 is no boundary.
//! - A material without a volume, or without transmission, is opaque in glTF; what remains of it is the coat: its roughness, and
//!   F0 = ((n − 1)/(n + 1))², blended to the base colour by the metallic factor.
//!
//! Textures are not read.
use crate::closed_form::albedo_from_colour;
use crate::{Boundary, Coat, MAX_MEAN_COSINE, Material, Medium, Mesh, PathtraceError, ggx};
use base64::Engine;
use glam::{Mat4, Vec2, Vec3};
use std::path::Path;

/// Channels that are not attenuated at all keep this transmittance: ln 0 and absolute darkness have no coefficient.
const DARKEST: f32 = 1e-6;

/// Deepest nesting of nodes that is followed.
const MAX_DEPTH: usize = 64;

/// What a glTF file holds.
#[derive(Debug, Clone, PartialEq)]
pub struct GltfObject {
    /// All triangles, in world coordinates of the file.
    pub mesh: Mesh,
    /// The medium and its boundary, where a material has a volume. Without a coat: its boundary reflects.
    pub material: Option<Material>,
    /// The reflection of the first material, for objects whose medium comes from elsewhere.
    pub coat: Option<Coat>,
}

/// The bytes of a buffer: in the file, in a data address, or beside the file.
fn buffer_bytes(buffer: &gltf::Buffer, blob: Option<&[u8]>, folder: Option<&Path>) -> Result<Vec<u8>, String> {
    let bytes = match buffer.source() {
        gltf::buffer::Source::Bin => blob.ok_or("the binary part is missing")?.to_vec(),
        gltf::buffer::Source::Uri(uri) => {
            if let Some(rest) = uri.strip_prefix("data:") {
                let data = rest.split_once(";base64,").ok_or("a data address that is not base64")?.1;
                base64::engine::general_purpose::STANDARD.decode(data).map_err(|e| format!("a data address: {e}"))?
            } else {
                let name = Path::new(uri);
                let stays = name.components().all(|c| matches!(c, std::path::Component::Normal(_)));
                let folder = folder
                    .filter(|_| stays && !uri.contains(':'))
                    .ok_or(format!("the buffer {uri:.80?} lies elsewhere"))?;
                // Spaces are the one character that exporters escape in practice.
                let file = folder.join(uri.replace("%20", " "));
                std::fs::read(&file).map_err(|e| format!("{}: {e}", file.display()))?
            }
        }
    };
    if bytes.len() < buffer.length() {
        return Err(format!("buffer {}: {} bytes announced, {} found", buffer.index(), buffer.length(), bytes.len()));
    }
    Ok(bytes)
}

/// `Err` where an accessor reads beyond its view or its buffer, or is sparse.
fn check_accessor(accessor: &gltf::Accessor, buffers: &[Vec<u8>]) -> Result<(), String> {
    let view = accessor.view().filter(|_| accessor.sparse().is_none());
    let view = view.ok_or(format!("accessor {} is sparse; export without", accessor.index()))?;
    let stride = view.stride().unwrap_or(accessor.size());
    let last = accessor.count().checked_sub(1).and_then(|n| n.checked_mul(stride));
    let end = last.and_then(|n| n.checked_add(accessor.size())).and_then(|n| n.checked_add(accessor.offset()));
    let view_end = view.offset().checked_add(view.length());
    let fits = end.is_some_and(|n| n <= view.length())
        && view_end.is_some_and(|n| buffers.get(view.buffer().index()).is_some_and(|b| n <= b.len()))
        && stride >= accessor.size();
    fits.then_some(()).ok_or(format!("accessor {} reads beyond its buffer", accessor.index()))
}

fn add_primitive(
    mesh: &mut Mesh,
    primitive: &gltf::Primitive,
    transform: Mat4,
    buffers: &[Vec<u8>],
) -> Result<(), String> {
    if primitive.mode() != gltf::mesh::Mode::Triangles {
        return Err(format!("triangles are expected, found {:?}", primitive.mode()));
    }
    let wanted = [gltf::Semantic::Positions, gltf::Semantic::Normals, gltf::Semantic::TexCoords(0)];
    for accessor in wanted.iter().filter_map(|s| primitive.get(s)).chain(primitive.indices()) {
        check_accessor(&accessor, buffers)?;
    }
    use gltf::accessor::DataType;
    if let Some(accessor) = primitive.indices()
        && !matches!(accessor.data_type(), DataType::U8 | DataType::U16 | DataType::U32)
    {
        return Err(format!(
            "accessor {}: indices are whole numbers, not {:?}",
            accessor.index(),
            accessor.data_type()
        ));
    }
    let reader = primitive.reader(|buffer| buffers.get(buffer.index()).map(Vec::as_slice));
    let first = mesh.positions.len();
    let positions = reader.read_positions().ok_or("a primitive without positions")?;
    mesh.positions.extend(positions.map(|p| transform.transform_point3(p.into())));
    let count = mesh.positions.len() - first;
    let to_normal = transform.inverse().transpose();
    let normals: Option<Vec<Vec3>> = reader
        .read_normals()
        .map(|list| list.map(|n| to_normal.transform_vector3(n.into()).normalize_or(Vec3::Z)).collect());
    // Lists are kept where every primitive has them.
    mesh.normals = match (mesh.normals.take(), normals) {
        (None, Some(new)) if first == 0 => Some(new),
        (Some(mut all), Some(new)) => {
            all.extend(new);
            Some(all)
        }
        _ => None,
    };
    let uvs: Option<Vec<Vec2>> = reader.read_tex_coords(0).map(|list| list.into_f32().map(Vec2::from).collect());
    mesh.uvs = match (mesh.uvs.take(), uvs) {
        (None, Some(new)) if first == 0 => Some(new),
        (Some(mut all), Some(new)) => {
            all.extend(new);
            Some(all)
        }
        _ => None,
    };
    let indices: Vec<u32> = match reader.read_indices() {
        Some(indices) => indices.into_u32().collect(),
        None => (0..count as u32).collect(),
    };
    if let Some(bad) = indices.iter().find(|i| **i as usize >= count) {
        return Err(format!("index {bad} of {count} vertices"));
    }
    // A mirroring transform turns triangles inside out.
    let mirrored = transform.determinant() < 0.0;
    for t in indices.chunks_exact(3) {
        let [a, b, c] = [t[0], t[1], t[2]].map(|i| i + first as u32);
        mesh.triangles.push(if mirrored { [a, c, b] } else { [a, b, c] });
    }
    Ok(())
}

/// The coat of a material, and the medium where it has one.
fn read_material(material: &gltf::Material) -> Result<(Coat, Option<Material>), String> {
    let pbr = material.pbr_metallic_roughness();
    let eta = material.ior().unwrap_or(1.5);
    let f0 = Vec3::splat(((eta - 1.0) / (eta + 1.0)).powi(2));
    let [r, g, b, _] = pbr.base_color_factor();
    let coat = Coat { roughness: pbr.roughness_factor(), f0: f0.lerp(Vec3::new(r, g, b), pbr.metallic_factor()) };
    coat.validate().map_err(|e| e.to_string())?;
    let transmits = material.transmission().is_some_and(|t| t.transmission_factor() > 0.0);
    let Some(volume) = material.volume().filter(|v| transmits && v.thickness_factor() > 0.0) else {
        return Ok((coat, None));
    };
    let colour = Vec3::from(volume.attenuation_color()).clamp(Vec3::splat(DARKEST), Vec3::ONE);
    let distance = volume.attenuation_distance();
    let sigma_t = if distance.is_finite() && distance > 0.0 { -colour.ln() / distance } else { Vec3::ZERO };
    let (mut albedo, mut mean_cosine) = (Vec3::ZERO, 0.0);
    if let Some(scatter) = material.extension_value("KHR_materials_volume_scatter") {
        let numbers = |name: &str| scatter.get(name).and_then(|v| v.as_array()).cloned().unwrap_or_default();
        let colour: Vec<f64> = numbers("multiscatterColor").iter().filter_map(|v| v.as_f64()).collect();
        if let [r, g, b] = colour[..] {
            albedo = Vec3::from([r, g, b].map(|c| albedo_from_colour(c.clamp(0.0, 1.0)) as f32));
        }
        let g = scatter.get("scatterAnisotropy").and_then(|v| v.as_f64()).unwrap_or(0.0) as f32;
        mean_cosine = g.clamp(-MAX_MEAN_COSINE, MAX_MEAN_COSINE);
    }
    let alpha = coat.roughness * coat.roughness;
    let boundary = if alpha < ggx::MIN_ALPHA { Boundary::Smooth { eta } } else { Boundary::Rough { eta, alpha } };
    let medium = Medium { sigma_t, albedo, g: mean_cosine, veins: None };
    let found = Material { medium, boundary: boundary.effective(), coat: None };
    found.validate().map_err(|e| e.to_string())?;
    Ok((coat, Some(found)))
}

/// Bytes of the header of a `.glb` file, the last four of which are the file's length.
const GLB_HEADER: usize = 12;

/// A file as the `gltf` crate reads it, after the checks that it assumes to have been made.
fn document(bytes: &[u8]) -> Result<gltf::Gltf, String> {
    if let (true, Some(length)) = (bytes.starts_with(b"glTF"), bytes.get(8..GLB_HEADER)) {
        let length = length.iter().rev().fold(0usize, |n, b| n << 8 | usize::from(*b));
        if length < GLB_HEADER {
            return Err(format!("the header says that the file has {length} bytes; it alone has {GLB_HEADER}"));
        }
    }
    let file = gltf::Gltf::from_slice_without_validation(bytes).map_err(|e| e.to_string())?;
    let (blob, root) = (file.blob, file.document.into_json());
    let accessors = root.accessors.len();
    for (m, mesh) in root.meshes.iter().enumerate() {
        for index in mesh.primitives.iter().flat_map(|p| p.attributes.values()) {
            if index.value() >= accessors {
                return Err(format!("mesh {m} uses accessor {}; there are {accessors}", index.value()));
            }
        }
    }
    let document = gltf::Document::from_json(root).map_err(|e| e.to_string())?;
    Ok(gltf::Gltf { document, blob })
}

/// Reads the object in the bytes of a `.gltf` or `.glb` file; buffers beside it are looked for in `folder`. The message says what is
/// wrong.
pub fn parse_gltf(bytes: &[u8], folder: Option<&Path>) -> Result<GltfObject, String> {
    let file = document(bytes)?;
    let buffers: Vec<Vec<u8>> =
        file.buffers().map(|buffer| buffer_bytes(&buffer, file.blob.as_deref(), folder)).collect::<Result<_, _>>()?;
    let scene = file.default_scene().or_else(|| file.scenes().next()).ok_or("the file has no scene")?;
    let mut object = GltfObject { mesh: Mesh::default(), material: None, coat: None };
    let mut stack: Vec<(gltf::Node, Mat4, usize)> = scene.nodes().map(|n| (n, Mat4::IDENTITY, 0)).collect();
    while let Some((node, parent, depth)) = stack.pop() {
        if depth > MAX_DEPTH {
            return Err(format!("nodes are nested more than {MAX_DEPTH} deep"));
        }
        let transform = parent * Mat4::from_cols_array_2d(&node.transform().matrix());
        for primitive in node.mesh().iter().flat_map(|mesh| mesh.primitives().collect::<Vec<_>>()) {
            add_primitive(&mut object.mesh, &primitive, transform, &buffers)?;
            let (coat, material) = read_material(&primitive.material())?;
            object.coat.get_or_insert(coat);
            match (object.material, material) {
                (Some(a), Some(b)) if a != b => {
                    return Err("several materials with different volumes; an object has one medium".into());
                }
                (_, Some(found)) => object.material = Some(found),
                (_, None) => {}
            }
        }
        stack.extend(node.children().map(|child| (child, transform, depth + 1)));
    }
    object.mesh.validate().map_err(|e| e.to_string())?;
    Ok(object)
}

/// Reads a `.gltf` or `.glb` file. Errors name the file and what is wrong in it.
pub fn read_gltf(path: &Path) -> Result<GltfObject, PathtraceError> {
    let problem = |problem| PathtraceError::File { path: path.into(), problem };
    let bytes = std::fs::read(path).map_err(|e| problem(e.to_string()))?;
    parse_gltf(&bytes, path.parent()).map_err(problem)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A cube of glass that scatters, moved, mirrored and turned by its node.
    fn cube() -> String {
        let mesh = Mesh::cuboid(Vec3::ZERO, Vec3::ONE);
        let mut bytes: Vec<u8> = mesh.positions.iter().flat_map(|p| p.to_array()).flat_map(f32::to_le_bytes).collect();
        bytes.extend(mesh.triangles.iter().flatten().flat_map(|i| (*i as u16).to_le_bytes()));
        let data = base64::engine::general_purpose::STANDARD.encode(&bytes);
        format!(
            r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],
            "nodes":[{{"children":[1],"translation":[10,0,0]}},{{"mesh":0,"scale":[-2,1,1]}}],
            "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1,"material":0}}]}}],
            "accessors":[{{"bufferView":0,"componentType":5126,"count":8,"type":"VEC3","min":[0,0,0],"max":[1,1,1]}},
              {{"bufferView":1,"componentType":5123,"count":36,"type":"SCALAR"}}],
            "bufferViews":[{{"buffer":0,"byteLength":96}},{{"buffer":0,"byteOffset":96,"byteLength":72}}],
            "buffers":[{{"byteLength":168,"uri":"data:application/octet-stream;base64,{data}"}}],
            "extensionsUsed":["KHR_materials_ior","KHR_materials_transmission","KHR_materials_volume"],
            "materials":[{{"pbrMetallicRoughness":{{"metallicFactor":0,"roughnessFactor":0.5}},"extensions":{{
              "KHR_materials_ior":{{"ior":1.4}},"KHR_materials_transmission":{{"transmissionFactor":1}},
              "KHR_materials_volume":{{"thicknessFactor":1,"attenuationDistance":2,"attenuationColor":[0.5,0.25,1]}},
              "KHR_materials_volume_scatter":{{"multiscatterColor":[0.5,0.5,0],"scatterAnisotropy":0.3}}}}}}]}}"#
        )
    }

    #[test]
    fn a_mirrored_cube_keeps_its_outside_and_its_medium() {
        let object = parse_gltf(cube().as_bytes(), None).unwrap();
        assert!((object.mesh.signed_volume() - 2.0).abs() < 1e-5);
        assert_eq!(object.mesh.bounds(), (Vec3::new(8.0, 0.0, 0.0), Vec3::new(10.0, 1.0, 1.0)));
        let material = object.material.unwrap();
        assert_eq!(material.boundary, Boundary::Rough { eta: 1.4, alpha: 0.25 });
        let ln2 = std::f32::consts::LN_2;
        assert!((material.medium.sigma_t - Vec3::new(0.5 * ln2, ln2, 0.0)).length() < 1e-6);
        assert!((material.medium.albedo.x - 0.912_298_5).abs() < 1e-6 && material.medium.albedo.z == 0.0);
        assert_eq!(material.medium.g, 0.3);
        assert!((object.coat.unwrap().f0.x - (0.4f32 / 2.4).powi(2)).abs() < 1e-6);
    }

    #[test]
    fn damage_is_an_error() {
        for (from, to) in [
            ("\"count\":36", "\"count\":360000"),
            ("\"byteLength\":72", "\"byteLength\":720"),
            ("\"byteLength\":168", "\"byteLength\":1680"),
            ("data:application/octet-stream;base64,", "../secret.bin?"),
            ("\"attributes\":{\"POSITION\":0}", "\"attributes\":{}"),
            ("\"nodes\":[0]", "\"nodes\":[7]"),
            ("\"ior\":1.4", "\"ior\":100"),
            ("\"componentType\":5126", "\"componentType\":1"),
        ] {
            assert!(parse_gltf(cube().replacen(from, to, 1).as_bytes(), None).is_err(), "{from} → {to}");
        }
        assert!(parse_gltf(b"glTF\x02\0\0\0", None).is_err() && parse_gltf(b"", None).is_err());
    }
}
