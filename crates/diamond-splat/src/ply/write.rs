//! Writing PLY tables.
use super::header::{PlyFormat, ScalarType, quoted};
use super::{Place, PlyTable, in_file, malformed, refused};
use crate::SplatError;
use crate::whole_file::write_whole;
use std::path::Path;

/// The bytes of a PLY file with `table` as its vertex element.
///
/// Errors where the file could not be read back as the same table: columns of another length than the table, names
/// that are empty, repeated or hold blanks, comments with line breaks, values that are not finite or that the
/// column's integer type cannot hold.
pub fn ply_bytes(table: &PlyTable, format: PlyFormat) -> Result<Vec<u8>, SplatError> {
    check(table)?;
    let mut header = format!("ply\nformat {} 1.0\n", format.name());
    for comment in &table.comments {
        header.push_str(&format!("comment {comment}\n"));
    }
    header.push_str(&format!("element vertex {}\n", table.len));
    for column in &table.columns {
        header.push_str(&format!("property {} {}\n", column.scalar.name(), column.name));
    }
    header.push_str("end_header\n");
    let mut out = header.into_bytes();
    let stride: usize = table.columns.iter().map(|c| c.scalar.size()).sum();
    out.reserve(stride * table.len);
    for row in 0..table.len {
        for (index, column) in table.columns.iter().enumerate() {
            let value = column.values[row];
            match format {
                PlyFormat::Ascii => {
                    let separator = if index == 0 { "" } else { " " };
                    // `{:e}` is the shortest text that reads back as the same bits.
                    let text = match column.scalar.integer_range() {
                        Some(_) => format!("{separator}{value:.0}"),
                        None => format!("{separator}{value:e}"),
                    };
                    out.extend_from_slice(text.as_bytes());
                }
                _ => push_scalar(&mut out, value, column.scalar, format == PlyFormat::BinaryBigEndian),
            }
        }
        if format == PlyFormat::Ascii {
            out.push(b'\n');
        }
    }
    Ok(out)
}

fn push_scalar(out: &mut Vec<u8>, value: f32, scalar: ScalarType, big: bool) {
    let start = out.len();
    match scalar {
        ScalarType::I8 => out.extend((value as i8).to_le_bytes()),
        ScalarType::U8 => out.extend((value as u8).to_le_bytes()),
        ScalarType::I16 => out.extend((value as i16).to_le_bytes()),
        ScalarType::U16 => out.extend((value as u16).to_le_bytes()),
        ScalarType::I32 => out.extend((value as i32).to_le_bytes()),
        ScalarType::U32 => out.extend((value as u32).to_le_bytes()),
        ScalarType::F32 => out.extend(value.to_le_bytes()),
        ScalarType::F64 => out.extend((value as f64).to_le_bytes()),
    }
    if big {
        out[start..].reverse();
    }
}

fn check(table: &PlyTable) -> Result<(), SplatError> {
    let bad = |what: String, expected: &str, found: String| {
        let problem = format!("cannot write this table as PLY: {what}: expected {expected}, found {found}");
        Err(malformed(Place::File, problem, "change the table"))
    };
    if table.len > 0 && table.columns.is_empty() {
        return bad("columns".into(), "at least one", format!("none for {} vertices", table.len));
    }
    for comment in &table.comments {
        if comment.contains(['\n', '\r']) {
            return bad("a comment".into(), "one line", quoted(comment));
        }
    }
    for (index, column) in table.columns.iter().enumerate() {
        let name = &column.name;
        if name.is_empty() || !name.bytes().all(|b| b.is_ascii_graphic()) {
            return bad(format!("the name of column {index}"), "printable ASCII without blanks", quoted(name));
        }
        if table.columns[..index].iter().any(|c| &c.name == name) {
            return bad(format!("column {index}"), "a name of its own", quoted(name));
        }
        if column.values.len() != table.len {
            return bad(format!("column {name}"), &format!("{} values", table.len), column.values.len().to_string());
        }
        for (row, &value) in column.values.iter().enumerate() {
            let fits = match column.scalar.integer_range() {
                Some((low, high)) => value.fract() == 0.0 && (low..=high).contains(&(value as f64)),
                None => value.is_finite(),
            };
            if !fits {
                let expected = match column.scalar.integer_range() {
                    Some((low, high)) => format!("a whole number from {low} to {high}"),
                    None => "a finite value".into(),
                };
                return bad(format!("column {name}, vertex {row}"), &expected, value.to_string());
            }
        }
    }
    Ok(())
}

/// Writes `table` as a `binary_little_endian` PLY file.
///
/// Whoever reads `path` sees the old file or the new one, also after a crash ([`replace_file`]).
pub fn write_ply(path: impl AsRef<Path>, table: &PlyTable) -> Result<(), SplatError> {
    let path = path.as_ref();
    let bytes = ply_bytes(table, PlyFormat::BinaryLittleEndian).map_err(|e| in_file(e, path))?;
    replace_file(path, &bytes)
}

/// Writes `bytes` to `path` whole or not at all, see [`write_whole`].
pub fn replace_file(path: &Path, bytes: &[u8]) -> Result<(), SplatError> {
    write_whole(path, bytes).map_err(|failure| {
        let doing = format!("could not {}; check the folder, its permissions and the space left", failure.action);
        refused(path, &doing, failure.source)
    })
}
