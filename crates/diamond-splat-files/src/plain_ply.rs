//! Splat PLY as trainers write it and everything reads it: one scalar property per value, raw.
//!
//! Any order and type of properties, text or binary of either byte order. `f_rest_*` may be absent and gives the
//! degree by its number (9, 24, 45; of 72, degree 4, the highest band is dropped); it holds all coefficients of red, then
//! green, then blue. Normals may be absent. Unknown properties and elements are passed over and named in a note.
//! Written: `binary_little_endian`, float, the customary order; what is read back is the same bit for bit.
use crate::cloud::{MAX_LOG_SCALE, MAX_LOGIT, coefficients};
use crate::error::{EXPORT_AGAIN, malformed};
use crate::limits::MAX_SPLATS;
use crate::{ColorSpace, SplatCloud, SplatFileError};
use diamond_splat::{Keep, PlyFormat, PlyLayout, PlyTable, ScalarType, parse_ply_columns, ply_bytes};
use glam::{Quat, Vec3};

const FORMAT: &str = "splat PLY";

/// The comment that says that colours are linear.
const LINEAR: &str = "colour: linear, BT.709 primaries";

/// Coefficients above degree 0 in a channel of degree 4, which is read to degree 3.
const DEGREE_4: usize = 24;

fn keep(name: &str) -> Keep {
    match name {
        "x" | "y" | "z" | "nx" | "ny" | "nz" | "f_dc_0" | "f_dc_1" | "f_dc_2" | "rot_0" | "rot_1" | "rot_2"
        | "rot_3" => Keep::Finite,
        // Programs write the logit of an opacity of exactly 0 or 1, and the logarithm of a scale of 0.
        "opacity" | "scale_0" | "scale_1" | "scale_2" => Keep::Infinite,
        _ if rest_index(name).is_some() => Keep::Finite,
        _ => Keep::No,
    }
}

fn rest_index(name: &str) -> Option<usize> {
    name.strip_prefix("f_rest_")?.parse().ok()
}

fn columns<'a, const N: usize>(table: &'a PlyTable, names: [&str; N]) -> Result<[&'a [f32]; N], SplatFileError> {
    let mut out: [&[f32]; N] = [&[]; N];
    for (slot, name) in out.iter_mut().zip(names) {
        *slot = table.column(name).ok_or_else(|| {
            malformed(
                FORMAT,
                format!("property {name}"),
                "x y z, f_dc_*, opacity, scale_*, rot_*",
                "no such property",
                "check that this is a splat file and not a point cloud or a mesh",
            )
        })?;
    }
    Ok(out)
}

/// Reads the splats that a header announced as `layout`.
pub(crate) fn parse(bytes: &[u8], layout: &PlyLayout) -> Result<(SplatCloud, Vec<String>), SplatFileError> {
    let table = parse_ply_columns(bytes, &keep)?;
    let n = table.len;
    if n > MAX_SPLATS {
        return Err(malformed(
            FORMAT,
            "element vertex",
            format!("at most {MAX_SPLATS}"),
            n.to_string(),
            "split the file",
        ));
    }
    let mut notes = Vec::new();
    let [x, y, z] = columns(&table, ["x", "y", "z"])?;
    let [opacity, s0, s1, s2] = columns(&table, ["opacity", "scale_0", "scale_1", "scale_2"])?;
    let [rw, rx, ry, rz] = columns(&table, ["rot_0", "rot_1", "rot_2", "rot_3"])?;
    let dc = columns(&table, ["f_dc_0", "f_dc_1", "f_dc_2"])?;
    let rest_count = table.columns.iter().filter(|c| rest_index(&c.name).is_some()).count();
    let (degree, stored) = match rest_count {
        0 => (0, 0),
        9 => (1, 3),
        24 => (2, 8),
        45 => (3, 15),
        72 => {
            notes.push("colour of degree 4: read to degree 3".to_string());
            (3, DEGREE_4)
        }
        other => {
            return Err(malformed(
                FORMAT,
                "f_rest_*",
                "0, 9, 24, 45 or 72 properties (degrees 0 to 4)",
                other.to_string(),
                EXPORT_AGAIN,
            ));
        }
    };
    let width = coefficients(degree);
    let mut cloud = SplatCloud::zeros(n, degree);
    let clamp = |v: f32, limit: f32| if v.is_finite() { v } else { v.clamp(-limit, limit) };
    for i in 0..n {
        cloud.means[i] = Vec3::new(x[i], y[i], z[i]);
        cloud.log_scales[i] = Vec3::from([s0[i], s1[i], s2[i]].map(|v| clamp(v, MAX_LOG_SCALE)));
        cloud.rotations[i] = Quat::from_xyzw(rx[i], ry[i], rz[i], rw[i]);
        cloud.opacity_logits[i] = clamp(opacity[i], MAX_LOGIT);
        for channel in 0..3 {
            cloud.sh[i * width * 3 + channel] = dc[channel][i];
        }
    }
    for channel in 0..3 {
        for k in 1..width {
            let name = format!("f_rest_{}", channel * stored + k - 1);
            let [column] = columns(&table, [name.as_str()])?;
            for (i, value) in column.iter().enumerate() {
                cloud.sh[(i * width + k) * 3 + channel] = *value;
            }
        }
    }
    if let (Some(nx), Some(ny), Some(nz)) = (table.column("nx"), table.column("ny"), table.column("nz")) {
        let normals: Vec<Vec3> = (0..n).map(|i| Vec3::new(nx[i], ny[i], nz[i])).collect();
        cloud.normals = normals.iter().any(|v| *v != Vec3::ZERO).then_some(normals);
    }
    if table.comments.iter().any(|c| c == LINEAR) {
        cloud.color_space = ColorSpace::Linear;
    }
    notes.extend(ignored(layout));
    Ok((cloud, notes))
}

/// What in the file has no place in a cloud.
fn ignored(layout: &PlyLayout) -> Vec<String> {
    const SHOWN: usize = 12;
    let vertex = layout.element("vertex");
    let unknown: Vec<&str> =
        vertex.iter().flat_map(|e| &e.properties).map(|p| p.name.as_str()).filter(|n| keep(n) == Keep::No).collect();
    let mut out = Vec::new();
    if !unknown.is_empty() {
        let more = if unknown.len() > SHOWN { format!(" and {} more", unknown.len() - SHOWN) } else { String::new() };
        out.push(format!("properties not read: {}{more}", unknown[..unknown.len().min(SHOWN)].join(", ")));
    }
    let others: Vec<&str> =
        layout.elements.iter().map(|e| e.name.as_str()).filter(|n| *n != "vertex").take(SHOWN).collect();
    if !others.is_empty() {
        out.push(format!("elements not read: {}", others.join(", ")));
    }
    out
}

/// Writes `binary_little_endian`; absent normals are zeros, which other programs expect.
pub(crate) fn to_bytes(cloud: &SplatCloud) -> Result<Vec<u8>, SplatFileError> {
    let n = cloud.len();
    let mut table = PlyTable::new(n);
    table.comments.push("3D Gaussians".into());
    if cloud.color_space == ColorSpace::Linear {
        table.comments.push(LINEAR.into());
    }
    let mut push = |name: String, values: Vec<f32>| table.push(name, ScalarType::F32, values);
    for (k, axis) in ["x", "y", "z"].iter().enumerate() {
        push((*axis).into(), cloud.means.iter().map(|v| v[k]).collect());
    }
    for (k, axis) in ["nx", "ny", "nz"].iter().enumerate() {
        push((*axis).into(), cloud.normals.as_ref().map_or(vec![0.0; n], |v| v.iter().map(|v| v[k]).collect()));
    }
    let width = cloud.coefficients();
    let coefficient =
        |k: usize, channel: usize| cloud.sh.iter().skip(k * 3 + channel).step_by(width * 3).copied().collect();
    for channel in 0..3 {
        push(format!("f_dc_{channel}"), coefficient(0, channel));
    }
    for channel in 0..3 {
        for k in 1..width {
            push(format!("f_rest_{}", channel * (width - 1) + k - 1), coefficient(k, channel));
        }
    }
    push("opacity".into(), cloud.opacity_logits.clone());
    for k in 0..3 {
        push(format!("scale_{k}"), cloud.log_scales.iter().map(|v| v[k]).collect());
    }
    for k in 0..4 {
        push(format!("rot_{k}"), cloud.rotations.iter().map(|q| [q.w, q.x, q.y, q.z][k]).collect());
    }
    Ok(ply_bytes(&table, PlyFormat::BinaryLittleEndian)?)
}

/// Whether the header is of a plain splat file with colour: for telling it from a point cloud.
pub(crate) fn looks_like(layout: &PlyLayout) -> bool {
    let vertex = layout.element("vertex");
    vertex.is_some_and(|e| ["opacity", "scale_0", "rot_0"].iter().all(|name| e.property(name).is_some()))
}
