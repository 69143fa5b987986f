//! The values of a PLY file, text or binary.
use super::header::{Element, Header, PlyFormat, ScalarType, Shape, quoted};
use super::{Keep, Place, PlyColumn, PlyTable, malformed};
use crate::SplatError;

const TRUNCATED: &str = "the file is truncated or its header is wrong: copy or export it again";
const REPAIR: &str = "repair the file or export it again";

/// Reads those columns of the vertex element that `header` announces which `keep` wants.
pub(super) fn parse(bytes: &[u8], header: &Header, keep: &dyn Fn(&str) -> Keep) -> Result<PlyTable, SplatError> {
    let vertex = &header.elements[header.vertex];
    if vertex.count > 0 && !vertex.properties.iter().any(|p| matches!(p.shape, Shape::Scalar(_))) {
        return Err(malformed(
            Place::Line(vertex.line),
            format!("{} vertices without any scalar property", vertex.count),
            REPAIR,
        ));
    }
    let columns = match header.format {
        PlyFormat::Ascii => {
            let mut text = Text { bytes, at: header.body_start, next_line: header.body_line, place: Place::File };
            for element in &header.elements[..header.vertex] {
                text.skip(element)?;
            }
            text.columns(vertex, keep)?
        }
        PlyFormat::BinaryLittleEndian | PlyFormat::BinaryBigEndian => {
            let big = header.format == PlyFormat::BinaryBigEndian;
            let mut binary = Binary { bytes, at: header.body_start, big };
            for element in &header.elements[..header.vertex] {
                binary.skip(element)?;
            }
            binary.columns(vertex, keep)?
        }
    };
    Ok(PlyTable { comments: header.comments.clone(), columns, len: vertex.count })
}

/// Columns with room for every vertex. Call only once it is known that the bytes can hold that many.
fn empty_columns(vertex: &Element, kept: &[Keep]) -> Vec<PlyColumn> {
    vertex
        .properties
        .iter()
        .zip(kept)
        .filter_map(|(p, keep)| match p.shape {
            Shape::Scalar(scalar) if *keep != Keep::No => {
                Some(PlyColumn { name: p.name.clone(), scalar, values: Vec::with_capacity(vertex.count) })
            }
            _ => None,
        })
        .collect()
}

/// What `keep` says of each property.
fn kept(vertex: &Element, keep: &dyn Fn(&str) -> Keep) -> Vec<Keep> {
    vertex.properties.iter().map(|p| keep(&p.name)).collect()
}

/// Whether a value must be refused.
fn refused(value: f64, keep: Keep) -> bool {
    match keep {
        Keep::Finite => !(value as f32).is_finite(),
        Keep::Infinite => value.is_nan(),
        Keep::No => false,
    }
}

fn not_finite(place: Place, name: &str, vertex: usize, value: f64) -> SplatError {
    malformed(
        place,
        format!("property {} of vertex {vertex} is {value}, which is not finite in 32 bits", quoted(name)),
        "remove such vertices (they are left by a diverged optimisation) or export the file again",
    )
}

/// A cursor over a binary body.
struct Binary<'a> {
    bytes: &'a [u8],
    at: usize,
    big: bool,
}

impl Binary<'_> {
    /// Fails unless `count` items of at least `size` bytes fit in what is left.
    fn check(&self, element: &Element, count: usize, size: usize) -> Result<usize, SplatError> {
        let left = self.bytes.len() - self.at;
        match count.checked_mul(size) {
            Some(needed) if needed <= left => Ok(needed),
            _ => Err(malformed(
                Place::Byte(self.at),
                format!("element {} needs {count} × {size} bytes or more, found {left}", quoted(&element.name)),
                TRUNCATED,
            )),
        }
    }

    /// The next scalar; `None` at the end of the bytes.
    #[inline]
    fn scalar(&mut self, scalar: ScalarType) -> Option<f64> {
        let raw = self.bytes.get(self.at..self.at + scalar.size())?;
        self.at += scalar.size();
        let mut le = [0u8; 8];
        le[..raw.len()].copy_from_slice(raw);
        if self.big {
            le[..raw.len()].reverse();
        }
        let word = u64::from_le_bytes(le);
        Some(match scalar {
            ScalarType::I8 => word as i8 as f64,
            ScalarType::U8 => word as u8 as f64,
            ScalarType::I16 => word as i16 as f64,
            ScalarType::U16 => word as u16 as f64,
            ScalarType::I32 => word as i32 as f64,
            ScalarType::U32 => word as u32 as f64,
            ScalarType::F32 => f32::from_bits(word as u32) as f64,
            ScalarType::F64 => f64::from_bits(word),
        })
    }

    fn skip_list(&mut self, element: &Element, count: ScalarType, item: ScalarType) -> Result<(), SplatError> {
        let start = self.at;
        let Some(length) = self.scalar(count) else {
            return Err(malformed(
                Place::Byte(start),
                format!("element {} ends inside a list", quoted(&element.name)),
                TRUNCATED,
            ));
        };
        if length < 0.0 {
            return Err(malformed(Place::Byte(start), format!("a list of {length} items"), REPAIR));
        }
        self.at += self.check(element, length as usize, item.size())?;
        Ok(())
    }

    fn skip(&mut self, element: &Element) -> Result<(), SplatError> {
        let smallest = element.properties.iter().map(|p| p.min_size()).sum();
        let least = self.check(element, element.count, smallest)?;
        if element.properties.iter().all(|p| matches!(p.shape, Shape::Scalar(_))) {
            self.at += least;
            return Ok(());
        }
        // Every turn consumes at least one byte (a list's count), so the bytes bound the turns.
        for _ in 0..element.count {
            for property in &element.properties {
                match property.shape {
                    Shape::Scalar(scalar) => self.at += self.check(element, 1, scalar.size())?,
                    Shape::List { count, item } => self.skip_list(element, count, item)?,
                }
            }
        }
        Ok(())
    }

    fn columns(&mut self, vertex: &Element, keep: &dyn Fn(&str) -> Keep) -> Result<Vec<PlyColumn>, SplatError> {
        let smallest = vertex.properties.iter().map(|p| p.min_size()).sum();
        self.check(vertex, vertex.count, smallest)?;
        let kept = kept(vertex, keep);
        let mut columns = empty_columns(vertex, &kept);
        for row in 0..vertex.count {
            let mut column = 0;
            for (property, &keep) in vertex.properties.iter().zip(&kept) {
                match property.shape {
                    Shape::List { count, item } => self.skip_list(vertex, count, item)?,
                    Shape::Scalar(scalar) => {
                        let start = self.at;
                        let Some(value) = self.scalar(scalar) else {
                            return Err(malformed(
                                Place::Byte(start),
                                format!("the data ends inside vertex {row} of {}", vertex.count),
                                TRUNCATED,
                            ));
                        };
                        if refused(value, keep) {
                            return Err(not_finite(Place::Byte(start), &property.name, row, value));
                        }
                        if keep != Keep::No {
                            columns[column].values.push(value as f32);
                            column += 1;
                        }
                    }
                }
            }
        }
        Ok(columns)
    }
}

/// A cursor over the lines of a text body.
struct Text<'a> {
    bytes: &'a [u8],
    at: usize,
    next_line: usize,
    /// The line that was read last.
    place: Place,
}

impl<'a> Text<'a> {
    /// The next line that is not blank.
    fn line(&mut self, element: &Element, row: usize) -> Result<&'a str, SplatError> {
        while self.at < self.bytes.len() {
            let rest = &self.bytes[self.at..];
            let end = rest.iter().position(|&b| b == b'\n').unwrap_or(rest.len());
            self.at += (end + 1).min(rest.len());
            self.place = Place::Line(self.next_line);
            self.next_line += 1;
            let line = std::str::from_utf8(&rest[..end])
                .map_err(|_| malformed(self.place, "bytes that are no text in an ascii file", REPAIR))?;
            if !line.trim_ascii().is_empty() {
                return Ok(line);
            }
        }
        Err(malformed(
            Place::Line(self.next_line),
            format!("the data ends before {} {row} of {}", quoted(&element.name), element.count),
            TRUNCATED,
        ))
    }

    fn skip(&mut self, element: &Element) -> Result<(), SplatError> {
        // An element without properties has no line; otherwise every turn consumes at least one byte.
        if !element.properties.is_empty() {
            for row in 0..element.count {
                self.line(element, row)?;
            }
        }
        Ok(())
    }

    fn columns(&mut self, vertex: &Element, keep: &dyn Fn(&str) -> Keep) -> Result<Vec<PlyColumn>, SplatError> {
        // Each value takes a digit and a separator, but for the last.
        let left = self.bytes.len() - self.at;
        let least = vertex.count.checked_mul(vertex.properties.len()).and_then(|n| n.checked_mul(2));
        if least.is_none_or(|n| n > left + 1) {
            return Err(malformed(
                Place::Line(self.next_line),
                format!(
                    "{} vertices of {} properties cannot fit in the {left} bytes that follow",
                    vertex.count,
                    vertex.properties.len()
                ),
                TRUNCATED,
            ));
        }
        let kept = kept(vertex, keep);
        let mut columns = empty_columns(vertex, &kept);
        for row in 0..vertex.count {
            let line = self.line(vertex, row)?;
            let place = self.place;
            let mut words = line.split_ascii_whitespace();
            let mut next = |name: &str| {
                words.next().ok_or_else(|| {
                    malformed(
                        place,
                        format!("vertex {row} ends before its property {}", quoted(name)),
                        "put one vertex with all its values on each line",
                    )
                })
            };
            let mut column = 0;
            for (property, &keep) in vertex.properties.iter().zip(&kept) {
                match property.shape {
                    Shape::Scalar(scalar) => {
                        let value = text_scalar(next(&property.name)?, scalar, place)?;
                        if refused(value, keep) {
                            return Err(not_finite(place, &property.name, row, value));
                        }
                        if keep != Keep::No {
                            columns[column].values.push(value as f32);
                            column += 1;
                        }
                    }
                    Shape::List { count, item } => {
                        let length = text_scalar(next(&property.name)?, count, place)?;
                        if length < 0.0 {
                            return Err(malformed(place, format!("a list of {length} items"), REPAIR));
                        }
                        for _ in 0..length as u64 {
                            text_scalar(next(&property.name)?, item, place)?;
                        }
                    }
                }
            }
            if let Some(extra) = words.next() {
                return Err(malformed(
                    place,
                    format!("vertex {row} goes on after its last property with {}", quoted(extra)),
                    "put one vertex with all its values on each line",
                ));
            }
        }
        Ok(columns)
    }
}

/// One decimal value. A `float` is rounded once, from the decimal to 32 bits.
fn text_scalar(word: &str, scalar: ScalarType, place: Place) -> Result<f64, SplatError> {
    let value = match scalar {
        ScalarType::F32 => word.parse::<f32>().map(f64::from),
        _ => word.parse::<f64>(),
    };
    let expected =
        || malformed(place, format!("expected a value of type {}, found {}", scalar.name(), quoted(word)), REPAIR);
    let value = value.map_err(|_| expected())?;
    match scalar.integer_range() {
        Some((low, high)) if value.fract() != 0.0 || !(low..=high).contains(&value) => Err(expected()),
        _ => Ok(value),
    }
}
