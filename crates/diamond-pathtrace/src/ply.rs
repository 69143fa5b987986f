//! Triangle meshes from PLY files: ASCII, or binary of either byte order.
use crate::{Mesh, PathtraceError};
use glam::{Vec2, Vec3};
use std::path::Path;

/// The longest list that a face may be; longer ones are damage.
const MAX_CORNERS: usize = 255;

#[derive(Clone, Copy, PartialEq)]
enum Format {
    Ascii,
    Little,
    Big,
}

struct Property {
    name: String,
    kind: String,
    /// Type of the length of a list.
    count: Option<String>,
}

struct Element {
    name: String,
    count: usize,
    properties: Vec<Property>,
}

/// The body of a file, read from its front.
struct Body<'a> {
    format: Format,
    rest: &'a [u8],
}

impl Body<'_> {
    fn number(&mut self, kind: &str) -> Result<f64, String> {
        if self.format == Format::Ascii {
            let start = self.rest.iter().position(|b| !b.is_ascii_whitespace()).ok_or("the file ends too early")?;
            let text = &self.rest[start..];
            let end = text.iter().position(u8::is_ascii_whitespace).unwrap_or(text.len());
            self.rest = &text[end..];
            let word = std::str::from_utf8(&text[..end.min(40)]).map_err(|_| "a number is no text".to_string())?;
            return word.parse().map_err(|_| format!("expected a number, found {word:?}"));
        }
        let size = match kind {
            "char" | "int8" | "uchar" | "uint8" => 1,
            "short" | "int16" | "ushort" | "uint16" => 2,
            "int" | "int32" | "uint" | "uint32" | "float" | "float32" => 4,
            "double" | "float64" => 8,
            other => return Err(format!("unknown type {other:?}")),
        };
        if self.rest.len() < size {
            return Err("the file ends too early".into());
        }
        let mut bytes = [0u8; 8];
        bytes[..size].copy_from_slice(&self.rest[..size]);
        self.rest = &self.rest[size..];
        if self.format == Format::Big {
            bytes[..size].reverse();
        }
        let [a, b, c, d, ..] = bytes;
        Ok(match kind {
            "char" | "int8" => f64::from(a as i8),
            "uchar" | "uint8" => f64::from(a),
            "short" | "int16" => f64::from(i16::from_le_bytes([a, b])),
            "ushort" | "uint16" => f64::from(u16::from_le_bytes([a, b])),
            "int" | "int32" => f64::from(i32::from_le_bytes([a, b, c, d])),
            "uint" | "uint32" => f64::from(u32::from_le_bytes([a, b, c, d])),
            "float" | "float32" => f64::from(f32::from_le_bytes([a, b, c, d])),
            _ => f64::from_le_bytes(bytes),
        })
    }
}

fn header(bytes: &[u8]) -> Result<(Vec<Element>, Body<'_>), String> {
    let mut rest = bytes;
    let mut line = || -> Result<String, String> {
        let end = rest.iter().position(|b| *b == b'\n').ok_or("the header has no end_header line")?;
        let text = String::from_utf8_lossy(&rest[..end.min(400)]).trim().to_string();
        rest = &rest[end + 1..];
        Ok(text)
    };
    if line()? != "ply" {
        return Err("expected `ply` in the first line".into());
    }
    let mut format = None;
    let mut elements: Vec<Element> = Vec::new();
    loop {
        let text = line()?;
        let words: Vec<&str> = text.split_whitespace().collect();
        match words[..] {
            ["format", "ascii", _] => format = Some(Format::Ascii),
            ["format", "binary_little_endian", _] => format = Some(Format::Little),
            ["format", "binary_big_endian", _] => format = Some(Format::Big),
            ["element", name, count] => {
                let count = count.parse().map_err(|_| format!("the number of {name} is {count:?}"))?;
                elements.push(Element { name: name.into(), count, properties: Vec::new() });
            }
            ["property", "list", count, kind, name] => {
                let element = elements.last_mut().ok_or("a property before any element")?;
                element.properties.push(Property { name: name.into(), kind: kind.into(), count: Some(count.into()) });
            }
            ["property", kind, name] => {
                let element = elements.last_mut().ok_or("a property before any element")?;
                element.properties.push(Property { name: name.into(), kind: kind.into(), count: None });
            }
            ["end_header"] => break,
            ["comment" | "obj_info", ..] | [] => {}
            _ => return Err(format!("the header line {text:?} is not understood")),
        }
    }
    let format = format.ok_or("the header names no format")?;
    Ok((elements, Body { format, rest }))
}

/// Reads the mesh in the bytes of a PLY file; polygons are cut into fans. The message says what is wrong.
pub fn parse_ply(bytes: &[u8]) -> Result<Mesh, String> {
    let (elements, mut body) = header(bytes)?;
    let mut mesh = Mesh::default();
    for element in &elements {
        if element.properties.is_empty() {
            continue;
        }
        // Each row takes at least one byte, so a damaged count cannot make us reserve what is not there.
        if element.count > body.rest.len() {
            return Err(format!(
                "{} {} rows are announced, {} bytes left",
                element.count,
                element.name,
                body.rest.len()
            ));
        }
        let column = |name: &str| element.properties.iter().position(|p| p.name == name);
        let vertex = element.name == "vertex";
        let positions = [column("x"), column("y"), column("z")];
        let normals = [column("nx"), column("ny"), column("nz")];
        let uvs = [column("u").or(column("s")), column("v").or(column("t"))];
        if vertex && positions.contains(&None) {
            return Err("vertices have no x, y, z".into());
        }
        let mut row = vec![0.0f64; element.properties.len()];
        for _ in 0..element.count {
            for (value, property) in row.iter_mut().zip(&element.properties) {
                let Some(count) = &property.count else {
                    *value = body.number(&property.kind)?;
                    continue;
                };
                let n = body.number(count)? as usize;
                if n > MAX_CORNERS {
                    return Err(format!("a list of {n} in {}", element.name));
                }
                let mut corners = [0u32; MAX_CORNERS];
                for corner in &mut corners[..n] {
                    *corner = body.number(&property.kind)? as u32;
                }
                if element.name == "face" && property.name.starts_with("vertex_ind") {
                    mesh.triangles.extend((2..n).map(|k| [corners[0], corners[k - 1], corners[k]]));
                }
            }
            if vertex {
                let of = |c: Option<usize>| c.map_or(0.0, |c| row[c] as f32);
                mesh.positions.push(Vec3::from(positions.map(of)));
                if !normals.contains(&None) {
                    mesh.normals.get_or_insert_default().push(Vec3::from(normals.map(of)).normalize_or(Vec3::Z));
                }
                if !uvs.contains(&None) {
                    mesh.uvs.get_or_insert_default().push(Vec2::from(uvs.map(of)));
                }
            }
        }
    }
    mesh.validate().map_err(|e| e.to_string())?;
    Ok(mesh)
}

/// Reads a PLY file. Errors name the file and what is wrong in it.
pub fn read_ply(path: &Path) -> Result<Mesh, PathtraceError> {
    let problem = |problem| PathtraceError::File { path: path.into(), problem };
    let bytes = std::fs::read(path).map_err(|e| problem(e.to_string()))?;
    parse_ply(&bytes).map_err(problem)
}

impl Mesh {
    /// The bytes of a binary PLY file with positions, normals where there are any, and triangles; [`parse_ply`] gives the same numbers back
    /// (normals to rounding, since they are made unit length).
    pub fn to_ply(&self) -> Vec<u8> {
        let normals = self.normals.as_ref().filter(|n| n.len() == self.positions.len());
        let mut header = format!(
            "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n",
            self.positions.len()
        );
        if normals.is_some() {
            header.push_str("property float nx\nproperty float ny\nproperty float nz\n");
        }
        let faces = self.triangles.len();
        header.push_str(&format!("element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"));
        let mut bytes = header.into_bytes();
        for (i, p) in self.positions.iter().enumerate() {
            let normal = normals.map(|n| n[i].to_array());
            p.to_array().iter().chain(normal.iter().flatten()).for_each(|v| bytes.extend(v.to_le_bytes()));
        }
        for triangle in &self.triangles {
            bytes.push(3);
            triangle.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        }
        bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: &str = "ply\nformat ascii 1.0\ncomment x\nelement vertex 4\nproperty float x\nproperty float y\n\
        property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n\
        0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n";

    #[test]
    fn text_and_both_byte_orders_give_the_same_mesh() {
        let mesh = parse_ply(SQUARE.as_bytes()).unwrap();
        assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3]]);
        for (name, little) in [("binary_little_endian", true), ("binary_big_endian", false)] {
            let header = SQUARE.split_inclusive("end_header\n").next().unwrap().replace("ascii", name);
            let mut bytes = header.into_bytes();
            for v in mesh.positions.iter().flat_map(|p| p.to_array()) {
                bytes.extend(if little { v.to_le_bytes() } else { v.to_be_bytes() });
            }
            bytes.push(4);
            (0..4i32).for_each(|v| bytes.extend(if little { v.to_le_bytes() } else { v.to_be_bytes() }));
            assert_eq!(parse_ply(&bytes).unwrap(), mesh);
            assert!(parse_ply(&bytes[..bytes.len() - 1]).unwrap_err().contains("ends too early"));
        }
    }

    #[test]
    fn what_is_written_is_read() {
        let mesh = parse_ply(SQUARE.as_bytes()).unwrap();
        assert_eq!(parse_ply(&mesh.to_ply()).unwrap(), mesh);
        let ball = Mesh::icosphere(Vec3::ONE, 0.7, 2).with_smooth_normals();
        let again = parse_ply(&ball.to_ply()).unwrap();
        assert_eq!((&again.positions, &again.triangles), (&ball.positions, &ball.triangles));
        let pairs = again.normals.iter().flatten().zip(ball.normals.iter().flatten());
        assert!(pairs.clone().count() > 0 && pairs.clone().all(|(a, b)| a.distance(*b) < 1e-6));
    }

    #[test]
    fn damage_is_an_error() {
        for (from, to) in [
            ("vertex 4", "vertex 4000000000"),
            ("4 0 1 2 3", "4 0 1 2 9"),
            ("1 1 0", "1 nan 0"),
            ("float z", "float w"),
            ("ply\n", "plx\n"),
            ("4 0 1", "400 0 1"),
            ("end_header", "end_hea"),
            ("ascii", "ebcdic"),
        ] {
            assert!(parse_ply(SQUARE.replacen(from, to, 1).as_bytes()).is_err(), "{from} → {to}");
        }
    }
}
