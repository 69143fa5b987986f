//! PLY files: the `vertex` element as a table of named columns, and the two readings of it that splatting needs.
//!
//! A PLY file is a text header that declares elements (`vertex`, `face`, …) and their properties, then the values,
//! as text or as packed binary of either byte order. Splat programs and scanners disagree about which properties
//! there are, in which order and of which type; so the file is read into a [`PlyTable`] first, without meaning,
//! and [`SplatPly`] and [`PointCloud`] then look for the columns that they know. Other elements and list properties
//! are walked over.
//!
//! Files come from elsewhere and are not trusted: nothing is allocated by a count that the bytes present cannot
//! satisfy, and every complaint names the file, the line or byte, and what to do.
mod body;
mod header;
mod layout;
mod point_cloud;
mod splat;
mod write;

pub use header::{PlyFormat, ScalarType};
pub use layout::{PlyElementLayout, PlyLayout, PlyPropertyLayout, ply_layout};
pub use point_cloud::PointCloud;
pub use splat::{SH_DC, SplatPly};
pub use write::{ply_bytes, replace_file, write_ply};

use crate::SplatError;
use std::path::{Path, PathBuf};

/// Stands for the path in errors about bytes that came from no file.
const NO_FILE: &str = "PLY data";

/// Where in a file something is wrong.
#[derive(Debug, Clone, Copy)]
enum Place {
    /// Line of the header or of a text body, from 1.
    Line(usize),
    /// Offset from the start of the file, from 0.
    Byte(usize),
    /// The file as a whole.
    File,
}

/// The bytes are no PLY file, or not the one that the header announces.
fn malformed(place: Place, problem: impl Into<String>, advice: &'static str) -> SplatError {
    let problem = problem.into();
    let (line, problem) = match place {
        Place::Line(line) => (Some(line), format!("{problem}; {advice}")),
        Place::Byte(byte) => (None, format!("byte {byte}: {problem}; {advice}")),
        Place::File => (None, format!("{problem}; {advice}")),
    };
    SplatError::File { path: PathBuf::from(NO_FILE), line, problem }
}

/// Says which file it was.
fn in_file(error: SplatError, file: &Path) -> SplatError {
    match error {
        SplatError::File { path, line, problem } if path == Path::new(NO_FILE) => {
            SplatError::File { path: file.to_path_buf(), line, problem }
        }
        other => other,
    }
}

/// The operating system refused.
fn refused(file: &Path, doing: &str, reason: std::io::Error) -> SplatError {
    SplatError::File { path: file.to_path_buf(), line: None, problem: format!("{doing}: {reason}") }
}

/// One scalar property of all vertices.
#[derive(Debug, Clone, PartialEq)]
pub struct PlyColumn {
    /// The property's name.
    pub name: String,
    /// The type in the file. Values are `f32` in memory whatever it is: integers beyond 2²⁴ and doubles are rounded.
    pub scalar: ScalarType,
    /// One finite value per vertex.
    pub values: Vec<f32>,
}

/// The scalar properties of the `vertex` element.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PlyTable {
    /// Comments of the header, in order.
    pub comments: Vec<String>,
    /// Columns in file order; each has `len` values, names are distinct.
    pub columns: Vec<PlyColumn>,
    /// Number of vertices.
    pub len: usize,
}

impl PlyTable {
    /// An empty table for `len` vertices.
    pub fn new(len: usize) -> Self {
        Self { comments: Vec::new(), columns: Vec::new(), len }
    }

    /// The values of a column, or `None` where there is no such property.
    pub fn column(&self, name: &str) -> Option<&[f32]> {
        self.columns.iter().find(|c| c.name == name).map(|c| c.values.as_slice())
    }

    /// Adds a column. Shapes and names are checked when the table is written.
    pub fn push(&mut self, name: impl Into<String>, scalar: ScalarType, values: Vec<f32>) {
        self.columns.push(PlyColumn { name: name.into(), scalar, values });
    }

    /// Columns `names` or the list of those that are absent.
    fn require<const N: usize>(&self, names: [&str; N], reading: &'static str) -> Result<[&[f32]; N], SplatError> {
        let mut found: [&[f32]; N] = [&[]; N];
        let mut absent = Vec::new();
        for (slot, name) in found.iter_mut().zip(names) {
            match self.column(name) {
                // The fields are public, so a short column is possible; it would be a panic later.
                Some(values) if values.len() == self.len => *slot = values,
                Some(values) => {
                    let problem = format!("column {name} has {} values for {} vertices", values.len(), self.len);
                    return Err(malformed(Place::File, problem, "give every column the table's length"));
                }
                None => absent.push(name),
            }
        }
        if absent.is_empty() {
            Ok(found)
        } else {
            let problem = format!("the vertex element lacks {}, which {reading} needs", absent.join(", "));
            Err(malformed(Place::File, problem, "check that this is the right kind of file"))
        }
    }

    /// As [`PlyTable::require`], but all columns absent is `None`; only some of them absent is an error.
    fn optional<const N: usize>(
        &self,
        names: [&str; N],
        reading: &'static str,
    ) -> Result<Option<[&[f32]; N]>, SplatError> {
        if names.iter().any(|name| self.column(name).is_some()) {
            self.require(names, reading).map(Some)
        } else {
            Ok(None)
        }
    }
}

/// What a reader wants with a property.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Keep {
    /// Nothing: its values are walked over, whatever they are.
    No,
    /// Its values; one that is NaN or infinite in 32 bits is an error.
    Finite,
    /// Its values, infinities among them; a NaN is an error.
    Infinite,
}

/// [`parse_ply`] of some properties only: `keep` is asked once for each by its name.
pub fn parse_ply_columns(bytes: &[u8], keep: &dyn Fn(&str) -> Keep) -> Result<PlyTable, SplatError> {
    let header = header::parse(bytes)?;
    body::parse(bytes, &header, keep)
}

/// Reads the `vertex` element from the bytes of a PLY file.
///
/// Elements that precede it are skipped, those after it and any trailing bytes are not looked at. List properties
/// are skipped. A value that is not finite is an error.
pub fn parse_ply(bytes: &[u8]) -> Result<PlyTable, SplatError> {
    parse_ply_columns(bytes, &|_| Keep::Finite)
}

/// [`parse_ply`] of a file.
pub fn read_ply(path: impl AsRef<Path>) -> Result<PlyTable, SplatError> {
    let path = path.as_ref();
    let bytes = std::fs::read(path)
        .map_err(|reason| refused(path, "cannot be read; check that it exists and that you may read it", reason))?;
    parse_ply(&bytes).map_err(|e| in_file(e, path))
}
