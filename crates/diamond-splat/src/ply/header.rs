//! The header of a PLY file: format, elements and their properties.
use super::{Place, malformed};
use crate::SplatError;

/// A header longer than this is no header (bytes). Real ones have a few kilobytes; without a limit, a binary file
/// that merely begins with `ply` would be scanned to its end as text.
const MAX_HEADER: usize = 1 << 20;

/// How values are stored after the header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PlyFormat {
    /// One vertex per line, values in decimal.
    Ascii,
    /// Packed, least significant byte first.
    BinaryLittleEndian,
    /// Packed, most significant byte first.
    BinaryBigEndian,
}

impl PlyFormat {
    /// The name in the header.
    pub fn name(self) -> &'static str {
        match self {
            PlyFormat::Ascii => "ascii",
            PlyFormat::BinaryLittleEndian => "binary_little_endian",
            PlyFormat::BinaryBigEndian => "binary_big_endian",
        }
    }
}

/// Type of a scalar in the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ScalarType {
    /// `char`, `int8`.
    I8,
    /// `uchar`, `uint8`.
    U8,
    /// `short`, `int16`.
    I16,
    /// `ushort`, `uint16`.
    U16,
    /// `int`, `int32`.
    I32,
    /// `uint`, `uint32`.
    U32,
    /// `float`, `float32`.
    F32,
    /// `double`, `float64`.
    F64,
}

impl ScalarType {
    /// Every type.
    pub const ALL: [ScalarType; 8] = [
        ScalarType::I8,
        ScalarType::U8,
        ScalarType::I16,
        ScalarType::U16,
        ScalarType::I32,
        ScalarType::U32,
        ScalarType::F32,
        ScalarType::F64,
    ];

    /// From either of its two names.
    pub fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => ScalarType::I8,
            "uchar" | "uint8" => ScalarType::U8,
            "short" | "int16" => ScalarType::I16,
            "ushort" | "uint16" => ScalarType::U16,
            "int" | "int32" => ScalarType::I32,
            "uint" | "uint32" => ScalarType::U32,
            "float" | "float32" => ScalarType::F32,
            "double" | "float64" => ScalarType::F64,
            _ => return None,
        })
    }

    /// The name that every program knows.
    pub fn name(self) -> &'static str {
        match self {
            ScalarType::I8 => "char",
            ScalarType::U8 => "uchar",
            ScalarType::I16 => "short",
            ScalarType::U16 => "ushort",
            ScalarType::I32 => "int",
            ScalarType::U32 => "uint",
            ScalarType::F32 => "float",
            ScalarType::F64 => "double",
        }
    }

    /// Bytes in a binary file.
    pub fn size(self) -> usize {
        match self {
            ScalarType::I8 | ScalarType::U8 => 1,
            ScalarType::I16 | ScalarType::U16 => 2,
            ScalarType::I32 | ScalarType::U32 | ScalarType::F32 => 4,
            ScalarType::F64 => 8,
        }
    }

    /// Smallest and largest value of an integer type; `None` for floats.
    pub fn integer_range(self) -> Option<(f64, f64)> {
        Some(match self {
            ScalarType::I8 => (i8::MIN as f64, i8::MAX as f64),
            ScalarType::U8 => (0.0, u8::MAX as f64),
            ScalarType::I16 => (i16::MIN as f64, i16::MAX as f64),
            ScalarType::U16 => (0.0, u16::MAX as f64),
            ScalarType::I32 => (i32::MIN as f64, i32::MAX as f64),
            ScalarType::U32 => (0.0, u32::MAX as f64),
            ScalarType::F32 | ScalarType::F64 => return None,
        })
    }
}

/// What a property holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Shape {
    Scalar(ScalarType),
    List { count: ScalarType, item: ScalarType },
}

/// A declared property.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Property {
    pub name: String,
    pub shape: Shape,
}

impl Property {
    /// Fewest bytes that it takes in a binary file.
    pub fn min_size(&self) -> usize {
        match self.shape {
            Shape::Scalar(scalar) => scalar.size(),
            Shape::List { count, .. } => count.size(),
        }
    }
}

/// A declared element.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Element {
    pub name: String,
    pub count: usize,
    /// Line of the declaration.
    pub line: usize,
    pub properties: Vec<Property>,
}

/// A parsed header.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Header {
    pub format: PlyFormat,
    pub comments: Vec<String>,
    pub elements: Vec<Element>,
    /// Index of the element `vertex`.
    pub vertex: usize,
    /// Offset of the first byte after the header.
    pub body_start: usize,
    /// Line number of the first line after the header.
    pub body_line: usize,
}

const REPAIR: &str = "repair the header or export the file again";

/// Reads the header.
pub(super) fn parse(bytes: &[u8]) -> Result<Header, SplatError> {
    let mut at = 0;
    let mut line_number = 0;
    let mut format = None;
    let mut comments = Vec::new();
    let mut elements: Vec<Element> = Vec::new();
    loop {
        line_number += 1;
        let bad = |problem: String| malformed(Place::Line(line_number), problem, REPAIR);
        let window = &bytes[at..bytes.len().min(MAX_HEADER.max(at))];
        let Some(end) = window.iter().position(|&b| b == b'\n') else {
            return Err(if line_number == 1 {
                bad("expected a first line `ply`, found none".into())
            } else if bytes.len() > MAX_HEADER {
                bad(format!("no `end_header` within {MAX_HEADER} bytes"))
            } else {
                malformed(
                    Place::Line(line_number),
                    "the file ends before `end_header`",
                    "the file is truncated: copy or export it again",
                )
            });
        };
        let raw = &window[..end];
        at += end + 1;
        let line = String::from_utf8_lossy(raw.strip_suffix(b"\r").unwrap_or(raw));
        if line_number == 1 {
            if line.trim_end() != "ply" {
                return Err(malformed(
                    Place::Line(1),
                    format!("expected `ply`, found {}", quoted(&line)),
                    "this is not a PLY file",
                ));
            }
            continue;
        }
        let mut words = line.split_ascii_whitespace();
        match words.next() {
            None => {}
            Some("comment") => {
                let text = line.trim_start().strip_prefix("comment").unwrap_or("");
                comments.push(text.strip_prefix(' ').unwrap_or(text).to_string());
            }
            Some("obj_info") => {}
            Some("format") => {
                if format.is_some() {
                    return Err(bad("a second `format` line".into()));
                }
                let name = words.next().unwrap_or("");
                let found = [PlyFormat::Ascii, PlyFormat::BinaryLittleEndian, PlyFormat::BinaryBigEndian]
                    .into_iter()
                    .find(|f| f.name() == name);
                if found.is_none() || words.next() != Some("1.0") || words.next().is_some() {
                    return Err(bad(format!(
                        "expected `format ascii|binary_little_endian|binary_big_endian 1.0`, found {}",
                        quoted(&line)
                    )));
                }
                format = found;
            }
            Some("element") => {
                let (Some(name), Some(count), None) = (words.next(), words.next(), words.next()) else {
                    return Err(bad(format!("expected `element <name> <count>`, found {}", quoted(&line))));
                };
                let Ok(count) = count.parse::<usize>() else {
                    return Err(bad(format!("expected a count of elements, found {}", quoted(count))));
                };
                if elements.iter().any(|e| e.name == name) {
                    return Err(bad(format!("a second element {}", quoted(name))));
                }
                elements.push(Element { name: name.into(), count, line: line_number, properties: Vec::new() });
            }
            Some("property") => {
                let Some(element) = elements.last_mut() else {
                    return Err(bad("a property before any element".into()));
                };
                let words: Vec<&str> = words.collect();
                let property = parse_property(&words).map_err(|p| bad(format!("{p}, found {}", quoted(&line))))?;
                if element.properties.iter().any(|p| p.name == property.name) {
                    return Err(malformed(
                        Place::Line(line_number),
                        format!("element {} has a second property {}", quoted(&element.name), quoted(&property.name)),
                        "rename or remove one of the two",
                    ));
                }
                element.properties.push(property);
            }
            Some("end_header") => break,
            Some(word) => {
                return Err(bad(format!(
                    "expected format, comment, obj_info, element, property or end_header, found {}",
                    quoted(word)
                )));
            }
        }
    }
    let bad = |problem: &str| malformed(Place::Line(line_number), problem, REPAIR);
    let format = format.ok_or_else(|| bad("the header has no `format` line"))?;
    let vertex = elements
        .iter()
        .position(|e| e.name == "vertex")
        .ok_or_else(|| bad("the header declares no element `vertex`, so there are no points to read"))?;
    Ok(Header { format, comments, elements, vertex, body_start: at, body_line: line_number + 1 })
}

fn parse_property(words: &[&str]) -> Result<Property, String> {
    let scalar = |name: &str| ScalarType::from_name(name).ok_or(format!("{} is no type of PLY", quoted(name)));
    match *words {
        ["list", count, item, name] => {
            let (count, item) = (scalar(count)?, scalar(item)?);
            if count.integer_range().is_none() {
                return Err("a list's count must have an integer type".into());
            }
            Ok(Property { name: name.into(), shape: Shape::List { count, item } })
        }
        [kind, name] => Ok(Property { name: name.into(), shape: Shape::Scalar(scalar(kind)?) }),
        _ => Err("expected `property <type> <name>` or `property list <type> <type> <name>`".into()),
    }
}

/// Text of a hostile file, made harmless and short for a message.
pub(super) fn quoted(text: &str) -> String {
    const SHOWN: usize = 60;
    let shown: String = text.chars().take(SHOWN).flat_map(char::escape_default).collect();
    let dots = if text.chars().nth(SHOWN).is_some() { "…" } else { "" };
    format!("`{shown}{dots}`")
}
