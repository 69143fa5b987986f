//! Numbers behind accessors: buffers, views of them, and typed rows in the views.
use super::FORMAT;
use super::document::{Accessor, Buffer, Document};
use crate::SplatFileError;
use crate::error::{EXPORT_AGAIN, TRUNCATED, malformed};
use base64::Engine;
use std::path::{Component, Path};

/// The bytes of all buffers.
pub(super) struct Buffers<'a> {
    bytes: Vec<std::borrow::Cow<'a, [u8]>>,
}

impl<'a> Buffers<'a> {
    /// Buffer 0 of a `.glb` is its binary chunk; others are data URIs, or files beside `file` where that is known.
    pub fn load(document: &Document, binary: Option<&'a [u8]>, file: Option<&Path>) -> Result<Self, SplatFileError> {
        let mut bytes = Vec::new();
        for (i, buffer) in document.buffers.iter().enumerate() {
            let field = format!("buffer {i}");
            let loaded: std::borrow::Cow<'a, [u8]> = match (&buffer.uri, binary) {
                (None, Some(chunk)) if i == 0 => chunk.into(),
                (None, _) => {
                    return Err(malformed(
                        FORMAT,
                        field,
                        "a uri, or the binary chunk of a .glb",
                        "neither",
                        EXPORT_AGAIN,
                    ));
                }
                (Some(uri), _) => load_uri(uri, buffer, &field, file)?.into(),
            };
            if loaded.len() < buffer.byte_length {
                let expected = format!("{} bytes", buffer.byte_length);
                return Err(malformed(FORMAT, field, expected, loaded.len().to_string(), TRUNCATED));
            }
            bytes.push(loaded);
        }
        Ok(Self { bytes })
    }

    /// Bytes in all.
    pub fn len(&self) -> usize {
        self.bytes.iter().map(|b| b.len()).sum()
    }
}

fn load_uri(uri: &str, buffer: &Buffer, field: &str, file: Option<&Path>) -> Result<Vec<u8>, SplatFileError> {
    if let Some(rest) = uri.strip_prefix("data:") {
        let Some((_, data)) = rest.split_once(";base64,") else {
            return Err(malformed(FORMAT, field, "a data URI in base64", "another encoding", EXPORT_AGAIN));
        };
        return base64::engine::general_purpose::STANDARD
            .decode(data)
            .map_err(|e| malformed(FORMAT, field, "base64", e.to_string(), TRUNCATED));
    }
    let shown: String = uri.chars().take(80).flat_map(char::escape_default).collect();
    let Some(folder) = file.map(|f| f.parent().unwrap_or(Path::new(""))) else {
        return Err(malformed(
            FORMAT,
            field,
            "a data URI or a .glb",
            format!("a file `{shown}`"),
            "read the .gltf from disk, or pack it as .glb",
        ));
    };
    let relative = Path::new(uri);
    if uri.contains(':')
        || uri.contains('\\')
        || !relative.components().all(|c| matches!(c, Component::Normal(_) | Component::CurDir))
    {
        return Err(malformed(
            FORMAT,
            field,
            "a file beside the .gltf or below",
            format!("`{shown}`"),
            "put the buffer beside the .gltf",
        ));
    }
    let path = folder.join(uri.replace("%20", " "));
    let fail = |source| SplatFileError::Io { path: path.clone(), action: "read the buffer", source };
    let size = std::fs::metadata(&path).map_err(fail)?.len();
    if size < buffer.byte_length as u64 {
        return Err(malformed(
            FORMAT,
            field,
            format!("{} bytes", buffer.byte_length),
            format!("{size} in {shown}"),
            TRUNCATED,
        ));
    }
    std::fs::read(&path).map_err(|source| SplatFileError::Io { path, action: "read the buffer", source })
}

/// Component types of glTF that attributes may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    F32,
}

impl Scalar {
    fn from_code(code: u32) -> Option<Self> {
        Some(match code {
            5120 => Self::I8,
            5121 => Self::U8,
            5122 => Self::I16,
            5123 => Self::U16,
            5126 => Self::F32,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::F32 => 4,
        }
    }

    fn read(self, b: &[u8], normalized: bool) -> f64 {
        let (value, largest) = match self {
            Self::I8 => (f64::from(b[0] as i8), 127.0),
            Self::U8 => (f64::from(b[0]), 255.0),
            Self::I16 => (f64::from(i16::from_le_bytes([b[0], b[1]])), 32767.0),
            Self::U16 => (f64::from(u16::from_le_bytes([b[0], b[1]])), 65535.0),
            Self::F32 => return f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])),
        };
        if normalized { (value / largest).max(-1.0) } else { value }
    }
}

/// Rows of numbers.
pub(super) struct Rows<'a> {
    bytes: &'a [u8],
    scalar: Scalar,
    normalized: bool,
    stride: usize,
    /// Number of rows.
    pub len: usize,
    field: String,
}

impl<'a> Rows<'a> {
    /// The rows of an accessor of type `kind`; `float` where no other component is allowed.
    pub fn find(
        document: &Document,
        buffers: &'a Buffers<'_>,
        index: usize,
        name: &str,
        kind: &str,
        float: bool,
    ) -> Result<Self, SplatFileError> {
        let field = format!("attribute {name} (accessor {index})");
        let bad = |expected: String, found: String| malformed(FORMAT, field.clone(), expected, found, EXPORT_AGAIN);
        let of = |what: &str, have: usize| bad(format!("one of {have} {what}"), "an index beyond".into());
        let accessor: &Accessor =
            document.accessors.get(index).ok_or_else(|| of("accessors", document.accessors.len()))?;
        let scalar = Scalar::from_code(accessor.component_type).filter(|s| !float || *s == Scalar::F32);
        let Some(scalar) = scalar else {
            let expected = if float { "component type 5126 (float)" } else { "component type 5120 to 5123 or 5126" };
            return Err(bad(expected.into(), accessor.component_type.to_string()));
        };
        let components = match accessor.kind.as_str() {
            "SCALAR" => 1,
            "VEC3" => 3,
            "VEC4" => 4,
            _ => 0,
        };
        if accessor.kind != kind || components == 0 {
            return Err(bad(format!("type {kind}"), accessor.kind.chars().take(20).collect()));
        }
        if accessor.sparse.is_some() {
            return Err(bad("a dense accessor".into(), "a sparse one, which is not read".into()));
        }
        let view = accessor.buffer_view.ok_or_else(|| bad("a buffer view".into(), "none".into()))?;
        let view = document.buffer_views.get(view).ok_or_else(|| of("buffer views", document.buffer_views.len()))?;
        let buffer = buffers.bytes.get(view.buffer).ok_or_else(|| of("buffers", buffers.bytes.len()))?;
        let end = view.byte_offset.checked_add(view.byte_length);
        let Some(bytes) = end.and_then(|end| buffer.get(view.byte_offset..end)) else {
            return Err(bad(
                format!("a view within {} bytes", buffer.len()),
                format!("{} bytes at {}", view.byte_length, view.byte_offset),
            ));
        };
        let row = components * scalar.size();
        let stride = view.byte_stride.unwrap_or(row);
        if !(row..=252).contains(&stride) {
            return Err(bad(format!("a stride of {row} to 252 bytes"), stride.to_string()));
        }
        let needed = match accessor.count {
            0 => Some(0),
            n => (n - 1)
                .checked_mul(stride)
                .and_then(|v| v.checked_add(row))
                .and_then(|v| v.checked_add(accessor.byte_offset)),
        };
        if needed.is_none_or(|n| n > bytes.len()) {
            let found = format!("{} rows of {stride} bytes at {}", accessor.count, accessor.byte_offset);
            return Err(bad(format!("rows within {} bytes", bytes.len()), found));
        }
        let bytes = bytes.get(accessor.byte_offset..).unwrap_or(&[]);
        Ok(Self { bytes, scalar, normalized: accessor.normalized, stride, len: accessor.count, field })
    }

    /// Row `i` as numbers; an error where one is not finite.
    pub fn get<const N: usize>(&self, i: usize) -> Result<[f64; N], SplatFileError> {
        let size = self.scalar.size();
        let row = &self.bytes[i * self.stride..];
        let values = std::array::from_fn(|k| self.scalar.read(&row[k * size..], self.normalized));
        match values.iter().find(|v| !v.is_finite()) {
            None => Ok(values),
            Some(v) => {
                let found = format!("{v} in row {i}");
                Err(malformed(FORMAT, self.field.clone(), "finite numbers", found, EXPORT_AGAIN))
            }
        }
    }
}
