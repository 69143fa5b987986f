//! From a cloud to a glTF document: one buffer, one primitive, one node.
use super::{CHUNK_BINARY, CHUNK_JSON, DISPLAY, FORMAT, GLB_MAGIC, GLTF_EXTENSION, LINEAR, POINTS};
use super::{attribute, coefficient_attribute};
use crate::cloud::{scale, sigmoid, unit};
use crate::error::malformed;
use crate::quantise::byte;
use crate::{ColorSpace, SplatCloud, SplatFileError};
use base64::Engine;
use glam::Vec3;
use serde_json::{Map, Value, json};

const FLOAT: u32 = 5126;
const UNSIGNED_BYTE: u32 = 5121;
const ARRAY_BUFFER: u32 = 34962;

/// Bytes of attributes and what describes them.
#[derive(Default)]
struct Parts {
    binary: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
    attributes: Map<String, Value>,
}

impl Parts {
    fn push(&mut self, name: String, kind: &str, component: u32, count: usize, bytes: impl FnOnce(&mut Vec<u8>)) {
        let start = self.binary.len();
        bytes(&mut self.binary);
        let length = self.binary.len() - start;
        self.binary.resize(self.binary.len().next_multiple_of(4), 0);
        self.attributes.insert(name, self.accessors.len().into());
        let mut accessor =
            json!({ "bufferView": self.views.len(), "componentType": component, "count": count, "type": kind });
        if component == UNSIGNED_BYTE {
            accessor["normalized"] = true.into();
        }
        self.accessors.push(accessor);
        self.views.push(json!({ "buffer": 0, "byteOffset": start, "byteLength": length, "target": ARRAY_BUFFER }));
    }

    fn floats(&mut self, name: String, kind: &str, count: usize, values: impl Iterator<Item = f32>) {
        self.push(name, kind, FLOAT, count, |out| values.for_each(|v| out.extend(v.to_le_bytes())));
    }
}

/// Document and binary buffer; the document lacks the buffer's uri.
fn document(cloud: &SplatCloud) -> Result<(Value, Vec<u8>), SplatFileError> {
    let n = cloud.len();
    if n == 0 {
        return Err(malformed(FORMAT, "cloud to write", "at least one Gaussian", "none", "write PLY"));
    }
    let mut parts = Parts::default();
    parts.floats("POSITION".into(), "VEC3", n, cloud.means.iter().flat_map(|v| v.to_array()));
    let low = cloud.means.iter().copied().reduce(Vec3::min).unwrap_or_default();
    let high = cloud.means.iter().copied().reduce(Vec3::max).unwrap_or_default();
    parts.accessors[0]["min"] = json!(low.to_array());
    parts.accessors[0]["max"] = json!(high.to_array());
    parts.push("COLOR_0".into(), "VEC4", UNSIGNED_BYTE, n, |out| {
        for i in 0..n {
            out.extend(cloud.base_color(i).to_array().map(|v| byte(f64::from(v) * 255.0)));
            out.push(byte(f64::from(sigmoid(cloud.opacity_logits[i])) * 255.0));
        }
    });
    parts.floats(attribute("ROTATION"), "VEC4", n, cloud.rotations.iter().flat_map(|q| unit(*q).to_array()));
    parts.floats(attribute("SCALE"), "VEC3", n, cloud.log_scales.iter().flat_map(|s| s.to_array().map(scale)));
    parts.floats(attribute("OPACITY"), "SCALAR", n, cloud.opacity_logits.iter().map(|v| sigmoid(*v)));
    let width = cloud.coefficients() * 3;
    for l in 0..=cloud.degree {
        for k in 0..2 * l + 1 {
            let at = (l * l + k) * 3;
            let values = cloud.sh.chunks_exact(width).flat_map(|row| row[at..at + 3].iter().copied());
            parts.floats(coefficient_attribute(l, k), "VEC3", n, values);
        }
    }
    let space = match cloud.color_space {
        ColorSpace::Display => DISPLAY,
        ColorSpace::Linear => LINEAR,
    };
    let extension = json!({ "kernel": "ellipse", "colorSpace": space, "projection": "perspective",
        "sortingMethod": "cameraDistance" });
    let document = json!({
        "asset": { "version": "2.0", "generator": "diamond-splat-files" },
        "extensionsUsed": [GLTF_EXTENSION],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "mode": POINTS, "attributes": parts.attributes,
            "extensions": { GLTF_EXTENSION: extension } }] }],
        "accessors": parts.accessors,
        "bufferViews": parts.views,
        "buffers": [{ "byteLength": parts.binary.len() }],
    });
    Ok((document, parts.binary))
}

/// One JSON text with the buffer as a data URI.
pub(crate) fn gltf_bytes(cloud: &SplatCloud) -> Result<Vec<u8>, SplatFileError> {
    let (mut document, binary) = document(cloud)?;
    let data = base64::engine::general_purpose::STANDARD.encode(&binary);
    document["buffers"][0]["uri"] = format!("data:application/octet-stream;base64,{data}").into();
    Ok(format!("{document:#}\n").into_bytes())
}

/// Header, JSON chunk, binary chunk.
pub(crate) fn glb_bytes(cloud: &SplatCloud) -> Result<Vec<u8>, SplatFileError> {
    let (document, binary) = document(cloud)?;
    let mut json = document.to_string().into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let total = 12 + 8 + json.len() + 8 + binary.len();
    let Ok(length) = u32::try_from(total) else {
        return Err(malformed(
            FORMAT,
            "length",
            "less than 4 GiB",
            format!("{total} bytes"),
            "write PLY or SPZ, or fewer degrees",
        ));
    };
    let mut out = Vec::with_capacity(total);
    out.extend(GLB_MAGIC);
    out.extend(2u32.to_le_bytes());
    out.extend(length.to_le_bytes());
    for (kind, chunk) in [(CHUNK_JSON, &json), (CHUNK_BINARY, &binary)] {
        out.extend((chunk.len() as u32).to_le_bytes());
        out.extend(kind);
        out.extend(chunk);
    }
    Ok(out)
}
