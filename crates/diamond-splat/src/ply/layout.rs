//! Where each element of a PLY file lies, for readers of packed formats that need its bits rather than its numbers.
use super::header::{self, PlyFormat, ScalarType, Shape, quoted};
use super::{Place, malformed};
use crate::SplatError;

/// A scalar property of an element.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PlyPropertyLayout {
    /// Its name.
    pub name: String,
    /// Its type; `None` for a list.
    pub scalar: Option<ScalarType>,
    /// Bytes from the start of the row, where no list precedes it.
    pub offset: usize,
}

/// An element.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PlyElementLayout {
    /// Its name.
    pub name: String,
    /// Rows, as the header says; not yet compared with the bytes there are.
    pub count: usize,
    /// Properties in file order.
    pub properties: Vec<PlyPropertyLayout>,
    /// Bytes of a row; `None` where a list makes rows differ.
    pub stride: Option<usize>,
    /// Offset in the file of its first row; `None` for text and behind lists.
    pub start: Option<usize>,
}

/// What the header of a PLY file declares.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PlyLayout {
    /// How values are stored.
    pub format: PlyFormat,
    /// Comments, in order.
    pub comments: Vec<String>,
    /// Elements in file order.
    pub elements: Vec<PlyElementLayout>,
}

impl PlyLayout {
    /// The element of that name.
    pub fn element(&self, name: &str) -> Option<&PlyElementLayout> {
        self.elements.iter().find(|e| e.name == name)
    }
}

impl PlyElementLayout {
    /// The property of that name.
    pub fn property(&self, name: &str) -> Option<&PlyPropertyLayout> {
        self.properties.iter().find(|p| p.name == name)
    }

    /// The rows of a binary element without lists: `count` × `stride` bytes. Errors where the file ends before.
    pub fn rows<'a>(&self, bytes: &'a [u8]) -> Result<&'a [u8], SplatError> {
        let (Some(stride), Some(start)) = (self.stride, self.start) else {
            let problem = format!("element {} is text or has lists", quoted(&self.name));
            return Err(malformed(Place::File, problem, "convert the file to binary_little_endian"));
        };
        let size = self.count.checked_mul(stride);
        let end = size.and_then(|size| start.checked_add(size));
        match end.and_then(|end| bytes.get(start..end)) {
            Some(rows) => Ok(rows),
            None => Err(malformed(
                Place::Byte(start.min(bytes.len())),
                format!(
                    "element {} needs {} × {stride} bytes, found {}",
                    quoted(&self.name),
                    self.count,
                    bytes.len().saturating_sub(start)
                ),
                "the file is truncated or its header is wrong: copy or export it again",
            )),
        }
    }
}

/// Reads the header of a PLY file and nothing else.
pub fn ply_layout(bytes: &[u8]) -> Result<PlyLayout, SplatError> {
    let header = header::parse(bytes)?;
    let mut start = (header.format != PlyFormat::Ascii).then_some(header.body_start);
    let mut elements = Vec::with_capacity(header.elements.len());
    for element in &header.elements {
        let mut offset = 0usize;
        let mut fixed = true;
        let mut properties = Vec::with_capacity(element.properties.len());
        for property in &element.properties {
            let scalar = match property.shape {
                Shape::Scalar(scalar) => Some(scalar),
                Shape::List { .. } => None,
            };
            properties.push(PlyPropertyLayout { name: property.name.clone(), scalar, offset });
            fixed &= scalar.is_some();
            offset += property.min_size();
        }
        let stride = fixed.then_some(offset);
        elements.push(PlyElementLayout { name: element.name.clone(), count: element.count, properties, stride, start });
        start = match (start, stride) {
            (Some(at), Some(stride)) => element.count.checked_mul(stride).and_then(|size| at.checked_add(size)),
            _ => None,
        };
    }
    Ok(PlyLayout { format: header.format, comments: header.comments, elements })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offsets_add_up_and_rows_are_bounded() {
        let head = "ply\nformat binary_little_endian 1.0\nelement chunk 2\nproperty float a\nproperty uchar b\n\
                    element vertex 3\nproperty uint p\nproperty list uchar int q\nelement sh 1\nproperty uchar c\n\
                    end_header\n";
        let mut bytes = head.as_bytes().to_vec();
        bytes.extend([7; 10]);
        let layout = ply_layout(&bytes).unwrap();
        let chunk = layout.element("chunk").unwrap();
        assert_eq!((chunk.stride, chunk.start), (Some(5), Some(head.len())));
        assert_eq!(chunk.property("b").unwrap().offset, 4);
        assert_eq!(chunk.rows(&bytes).unwrap(), &[7; 10]);
        assert!(chunk.rows(&bytes[..bytes.len() - 1]).unwrap_err().to_string().contains("2 × 5 bytes, found 9"));
        let vertex = layout.element("vertex").unwrap();
        assert_eq!((vertex.stride, vertex.start), (None, Some(head.len() + 10)));
        assert!(vertex.rows(&bytes).is_err());
        assert_eq!(layout.element("sh").unwrap().start, None);
    }
}
