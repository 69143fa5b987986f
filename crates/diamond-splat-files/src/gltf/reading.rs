//! From a glTF document to a cloud: container, scene graph, primitives.
use super::accessors::{Buffers, Rows};
use super::document::{Document, Node, Primitive, Splatting};
use super::{CHUNK_BINARY, CHUNK_JSON, DISPLAY, FORMAT, GLB_MAGIC, GLTF_EXTENSION, LINEAR, POINTS};
use super::{attribute, coefficient_attribute};
use crate::cloud::{MAX_DEGREE, MAX_LOG_SCALE, coefficients, log_scale, logit, unit};
use crate::error::{EXPORT_AGAIN, TRUNCATED, malformed};
use crate::limits::MAX_SPLATS;
use crate::{ColorSpace, SplatCloud, SplatFileError};
use diamond_splat::SH_DC;
use glam::{DAffine3, DMat4, DQuat, DVec3, Quat, Vec3};
use std::path::Path;

/// Bytes of file and buffers for each splat at least; instances of a mesh count each. A splat in floats has 56.
const BYTES_PER_SPLAT: usize = 4;

/// Extensions that a file may require and be read all the same.
const KNOWN: [&str; 2] = [GLTF_EXTENSION, "KHR_mesh_quantization"];

/// JSON and binary chunk.
fn chunks(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), SplatFileError> {
    if !bytes.starts_with(GLB_MAGIC) {
        return Ok((bytes, None));
    }
    let word = |at: usize| {
        bytes.get(at..at + 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).ok_or_else(|| {
            malformed(FORMAT, "container", "a header and chunks", format!("{} bytes", bytes.len()), TRUNCATED)
        })
    };
    if word(4)? != 2 {
        return Err(malformed(FORMAT, "version of the container", "2", word(4)?.to_string(), EXPORT_AGAIN));
    }
    let total = word(8)? as usize;
    if total > bytes.len() {
        return Err(malformed(FORMAT, "length", format!("{total} bytes"), bytes.len().to_string(), TRUNCATED));
    }
    let mut at = 12;
    let (mut json, mut binary) = (None, None);
    while at + 8 <= total {
        let length = word(at)? as usize;
        let Some(chunk) = bytes.get(at + 8..(at + 8).saturating_add(length)) else {
            let found = format!("{} bytes left", bytes.len() - at - 8);
            return Err(malformed(FORMAT, format!("chunk at {at}"), format!("{length} bytes"), found, TRUNCATED));
        };
        let kind = &bytes[at + 4..at + 8];
        if kind == CHUNK_JSON && json.is_none() {
            json = Some(chunk);
        } else if kind == CHUNK_BINARY && binary.is_none() {
            binary = Some(chunk);
        }
        at += 8 + length.next_multiple_of(4);
    }
    match json {
        Some(json) => Ok((json, binary)),
        None => Err(malformed(FORMAT, "container", "a JSON chunk", "none", TRUNCATED)),
    }
}

/// Reads a `.glb` or `.gltf`; `file` says where buffers in files of their own are.
pub(crate) fn parse(bytes: &[u8], file: Option<&Path>) -> Result<(SplatCloud, Vec<String>), SplatFileError> {
    let (json, binary) = chunks(bytes)?;
    let document: Document = serde_json::from_slice(json)
        .map_err(|e| malformed(FORMAT, "JSON", "a glTF document", e.to_string(), TRUNCATED))?;
    if !document.asset.version.starts_with("2.") {
        let found = document.asset.version.chars().take(20).collect::<String>();
        return Err(malformed(FORMAT, "asset.version", "2.x", found, EXPORT_AGAIN));
    }
    if let Some(unknown) = document.extensions_required.iter().find(|e| !KNOWN.contains(&e.as_str())) {
        let found = unknown.chars().take(80).collect::<String>();
        let advice = "export the file without compression";
        return Err(malformed(FORMAT, "extensionsRequired", KNOWN.join(", "), found, advice));
    }
    let buffers = Buffers::load(&document, binary, file)?;
    let mut reader = Reader {
        document: &document,
        buffers: &buffers,
        left: ((bytes.len() + buffers.len()) / BYTES_PER_SPLAT).min(MAX_SPLATS),
        cloud: SplatCloud::default(),
        spaces: Vec::new(),
        notes: Vec::new(),
        others: 0,
        found: 0,
    };
    reader.scene()?;
    reader.finish()
}

struct Reader<'a> {
    document: &'a Document,
    buffers: &'a Buffers<'a>,
    /// Splats that may still be read.
    left: usize,
    cloud: SplatCloud,
    spaces: Vec<ColorSpace>,
    notes: Vec<String>,
    /// Primitives of other kinds.
    others: usize,
    /// Primitives of splats.
    found: usize,
}

fn local(node: &Node) -> DAffine3 {
    match &node.matrix {
        Some(m) => DAffine3::from_mat4(DMat4::from_cols_array(m)),
        None => {
            let rotation = node.rotation.as_deref().map_or(DQuat::IDENTITY, |r| DQuat::from_array(*r));
            let rotation = if rotation.length_squared() > 0.0 { rotation.normalize() } else { DQuat::IDENTITY };
            DAffine3::from_scale_rotation_translation(
                node.scale.as_deref().map_or(DVec3::ONE, |s| DVec3::from(*s)),
                rotation,
                node.translation.as_deref().map_or(DVec3::ZERO, |t| DVec3::from(*t)),
            )
        }
    }
}

impl Reader<'_> {
    fn note(&mut self, note: String) {
        if !self.notes.contains(&note) {
            self.notes.push(note);
        }
    }

    /// Walks the scene from its roots; every node has one parent at most.
    fn scene(&mut self) -> Result<(), SplatFileError> {
        let nodes = &self.document.nodes;
        let beyond = |what: String| {
            malformed(FORMAT, what, format!("an index below {}", nodes.len()), "one beyond", EXPORT_AGAIN)
        };
        let roots: Vec<usize> = match self.document.scenes.get(self.document.scene.unwrap_or(0)) {
            Some(scene) => scene.nodes.clone(),
            None => {
                let mut child = vec![false; nodes.len()];
                for index in nodes.iter().flat_map(|n| &n.children) {
                    *child.get_mut(*index).ok_or_else(|| beyond("children of a node".into()))? = true;
                }
                (0..nodes.len()).filter(|i| !child[*i]).collect()
            }
        };
        let mut seen = vec![false; nodes.len()];
        let mut stack: Vec<(usize, DAffine3)> = roots.into_iter().rev().map(|i| (i, DAffine3::IDENTITY)).collect();
        while let Some((index, parent)) = stack.pop() {
            let node = nodes.get(index).ok_or_else(|| beyond("nodes of the scene".into()))?;
            if std::mem::replace(&mut seen[index], true) {
                let field = format!("node {index}");
                return Err(malformed(FORMAT, field, "one parent and no cycle", "a second way to it", EXPORT_AGAIN));
            }
            let world = parent * local(node);
            if !world.is_finite() {
                let field = format!("transform of node {index}");
                return Err(malformed(FORMAT, field, "finite numbers", "others", EXPORT_AGAIN));
            }
            if let Some(mesh) = node.mesh {
                let mesh = self.document.meshes.get(mesh).ok_or_else(|| {
                    let expected = format!("one of {} meshes", self.document.meshes.len());
                    malformed(FORMAT, format!("mesh of node {index}"), expected, mesh.to_string(), EXPORT_AGAIN)
                })?;
                for primitive in &mesh.primitives {
                    match &primitive.extensions.splatting {
                        Some(splatting) => self.primitive(primitive, splatting, world)?,
                        None => self.others += 1,
                    }
                }
            }
            stack.extend(node.children.iter().rev().map(|i| (*i, world)));
        }
        Ok(())
    }

    fn rows<'b>(
        &'b self,
        p: &Primitive,
        name: &str,
        kind: &str,
        float: bool,
    ) -> Result<Option<Rows<'b>>, SplatFileError> {
        p.attributes.get(name).map(|i| Rows::find(self.document, self.buffers, *i, name, kind, float)).transpose()
    }

    fn required<'b>(&'b self, p: &Primitive, name: &str, kind: &str) -> Result<Rows<'b>, SplatFileError> {
        self.rows(p, name, kind, false)?.ok_or_else(|| {
            malformed(FORMAT, format!("attribute {name}"), "an accessor", "no such attribute", EXPORT_AGAIN)
        })
    }

    fn primitive(&mut self, p: &Primitive, splatting: &Splatting, world: DAffine3) -> Result<(), SplatFileError> {
        self.found += 1;
        if p.mode != Some(POINTS) {
            let found = p.mode.map_or("none, which is triangles".to_string(), |m| m.to_string());
            return Err(malformed(FORMAT, "mode of a splat primitive", "0 (points)", found, EXPORT_AGAIN));
        }
        if let Some(name) = splatting.extensions.keys().find(|k| k.contains("compression")) {
            let found = name.chars().take(80).collect::<String>();
            return Err(malformed(
                FORMAT,
                "splat primitive",
                "values in accessors",
                found,
                "export the file without compression",
            ));
        }
        let positions = self.required(p, "POSITION", "VEC3")?;
        let n = positions.len;
        let Some(left) = self.left.checked_sub(n) else {
            let found = format!("{n} more than {}", self.left);
            return Err(malformed(
                FORMAT,
                "number of splats",
                "at least 4 bytes of file for each",
                found,
                "store instances once",
            ));
        };
        let mut cloud = SplatCloud::zeros(n, self.degree(p)?);
        let note = self.fill(p, &positions, &mut cloud)?;
        drop(positions);
        self.left = left;
        if let Some(note) = note {
            self.note(note);
        }
        if let Some(kernel) = splatting.kernel.as_deref().filter(|k| *k != "ellipse") {
            self.note(format!("kernel {kernel:?} read as \"ellipse\""));
        }
        let space = match splatting.color_space.as_deref() {
            Some(LINEAR) => ColorSpace::Linear,
            Some(DISPLAY) => ColorSpace::Display,
            other => {
                self.note(format!("colour space {other:?} read as {DISPLAY:?}"));
                ColorSpace::Display
            }
        };
        self.spaces.push(space);
        if let Some(note) = cloud.transform(world) {
            self.note(note);
        }
        self.cloud.append(cloud);
        Ok(())
    }

    /// The highest degree that is there in full.
    fn degree(&self, p: &Primitive) -> Result<usize, SplatFileError> {
        let mut degree = 0;
        for l in 1..=MAX_DEGREE {
            let there = (0..2 * l + 1).filter(|n| p.attributes.contains_key(&coefficient_attribute(l, *n))).count();
            if there == 2 * l + 1 && degree == l - 1 {
                degree = l;
            } else if there > 0 {
                let expected = format!("{} of degree {l} and all below", 2 * l + 1);
                return Err(malformed(FORMAT, "harmonics", expected, format!("{there} of degree {l}"), EXPORT_AGAIN));
            }
        }
        Ok(degree)
    }

    fn fill(
        &self,
        p: &Primitive,
        positions: &Rows<'_>,
        cloud: &mut SplatCloud,
    ) -> Result<Option<String>, SplatFileError> {
        let n = positions.len;
        let same = |rows: &Rows<'_>, name: &str| match rows.len == n {
            true => Ok(()),
            false => {
                let field = format!("attribute {name}");
                Err(malformed(FORMAT, field, format!("{n} rows, as POSITION"), rows.len.to_string(), EXPORT_AGAIN))
            }
        };
        let vec3 = |v: [f64; 3]| Vec3::from(v.map(|v| v as f32));
        for i in 0..n {
            cloud.means[i] = vec3(positions.get(i)?);
        }
        let mut note = None;
        let name = attribute("SCALE");
        let scales = self.required(p, &name, "VEC3")?;
        same(&scales, &name)?;
        let mut raw = Vec::new();
        for i in 0..n {
            raw.push(scales.get::<3>(i)?.map(|v| v as f32));
        }
        if raw.iter().flatten().any(|v| *v < 0.0) {
            note = Some("negative scales: read as logarithms, as the draft of the extension had them".to_string());
            for (log, v) in cloud.log_scales.iter_mut().zip(&raw) {
                *log = Vec3::from(v.map(|v| v.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE)));
            }
        } else {
            for (log, v) in cloud.log_scales.iter_mut().zip(&raw) {
                *log = Vec3::from(v.map(|v| log_scale(f64::from(v))));
            }
        }
        let name = attribute("ROTATION");
        let rotations = self.required(p, &name, "VEC4")?;
        same(&rotations, &name)?;
        for i in 0..n {
            let [x, y, z, w] = rotations.get::<4>(i)?.map(|v| v as f32);
            cloud.rotations[i] = unit(Quat::from_xyzw(x, y, z, w));
        }
        let name = attribute("OPACITY");
        let opacities = self.required(p, &name, "SCALAR")?;
        same(&opacities, &name)?;
        for i in 0..n {
            let [opacity] = opacities.get(i)?;
            if !(0.0..=1.0).contains(&opacity) {
                return Err(malformed(
                    FORMAT,
                    format!("{name}, row {i}"),
                    "a value in [0, 1]",
                    opacity.to_string(),
                    EXPORT_AGAIN,
                ));
            }
            cloud.opacity_logits[i] = logit(opacity);
        }
        let width = cloud.coefficients();
        for l in 0..=cloud.degree {
            for k in 0..2 * l + 1 {
                let name = coefficient_attribute(l, k);
                let Some(rows) = self.rows(p, &name, "VEC3", true)? else {
                    self.fallback_color(p, cloud)?;
                    note = Some("no harmonics of degree 0: colour read from COLOR_0".into());
                    continue;
                };
                same(&rows, &name)?;
                for i in 0..n {
                    let at = (i * width + coefficients(l) - (2 * l + 1) + k) * 3;
                    cloud.sh[at..at + 3].copy_from_slice(&rows.get::<3>(i)?.map(|v| v as f32));
                }
            }
        }
        Ok(note)
    }

    /// Degree 0 from the colour that viewers of points use.
    fn fallback_color(&self, p: &Primitive, cloud: &mut SplatCloud) -> Result<(), SplatFileError> {
        let (name, width) = ("COLOR_0", cloud.coefficients());
        let wide =
            p.attributes.get(name).and_then(|i| self.document.accessors.get(*i)).is_some_and(|a| a.kind == "VEC4");
        let rows =
            self.rows(p, name, if wide { "VEC4" } else { "VEC3" }, false)?.filter(|rows| rows.len == cloud.len());
        let Some(rows) = rows else {
            let name = coefficient_attribute(0, 0);
            return Err(malformed(
                FORMAT,
                format!("attribute {name}"),
                "an accessor",
                "none, and no COLOR_0",
                EXPORT_AGAIN,
            ));
        };
        for i in 0..cloud.len() {
            let color = rows.get::<3>(i)?;
            for (k, v) in color.iter().enumerate() {
                cloud.sh[i * width * 3 + k] = ((v - 0.5) / f64::from(SH_DC)) as f32;
            }
        }
        Ok(())
    }

    fn finish(mut self) -> Result<(SplatCloud, Vec<String>), SplatFileError> {
        if self.found == 0 {
            let advice = "this glTF holds no splats, or holds them outside its scene";
            let found = format!("{} other primitives", self.others);
            return Err(malformed(FORMAT, "scene", format!("a primitive with {GLTF_EXTENSION}"), found, advice));
        }
        if self.others > 0 {
            let note = format!("{} primitives that are no splats not read", self.others);
            self.note(note);
        }
        self.cloud.color_space = self.spaces.first().copied().unwrap_or_default();
        if self.spaces.iter().any(|s| *s != self.cloud.color_space) {
            self.note("primitives of different colour spaces: the first one's is kept, colours as they are".into());
        }
        if let Some(bad) = self.cloud.means.iter().chain(&self.cloud.log_scales).position(|v| !v.is_finite()) {
            let found = format!("overflow in splat {}", bad % self.cloud.len().max(1));
            return Err(malformed(FORMAT, "transformed splats", "finite numbers", found, EXPORT_AGAIN));
        }
        if self.cloud.sh.iter().any(|v| !v.is_finite()) {
            return Err(malformed(FORMAT, "transformed splats", "finite colours", "overflow", EXPORT_AGAIN));
        }
        Ok((self.cloud, self.notes))
    }
}
