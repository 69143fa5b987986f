//! The folder of a capture: no path that a file of the capture names may lead out of it.
use crate::{DatasetError, Place};
use std::path::{Component, Path, PathBuf};

/// Resolves `relative`, a path written in a capture's file with `/` or `\` between its parts, to an existing file
/// below `root` (which must be canonical). Absolute paths, paths that climb out with `..`, and links that lead out are
/// refused; a missing file is an I/O error. `place` is who names the path.
pub(crate) fn resolve(root: &Path, relative: &str, place: &Place) -> Result<PathBuf, DatasetError> {
    let outside = || DatasetError::Outside { place: place.clone().into(), path: relative.to_string() };
    let lexical = lexical(relative).ok_or_else(outside)?;
    let full = root.join(&lexical);
    let canonical = full.canonicalize().map_err(|source| DatasetError::Io {
        place: Place { file: place.file.clone(), frame: place.frame, field: Some(named(place, &lexical)) }.into(),
        action: "find the image",
        source,
    })?;
    if !canonical.starts_with(root) {
        return Err(outside());
    }
    Ok(canonical)
}

/// The field that names a path, with the path.
fn named(place: &Place, path: &Path) -> String {
    match &place.field {
        Some(field) => format!("{field} = \"{}\"", path.display()),
        None => format!("\"{}\"", path.display()),
    }
}

/// `relative` with `.` and `..` resolved by text alone; `None` where it is absolute, empty or climbs out.
fn lexical(relative: &str) -> Option<PathBuf> {
    let unified = relative.replace('\\', "/");
    // "C:/…" is absolute on one system and a plain name on another: refuse it everywhere.
    if unified.as_bytes().get(1) == Some(&b':') || unified.contains('\0') {
        return None;
    }
    let mut parts: Vec<&std::ffi::OsStr> = Vec::new();
    for part in Path::new(&unified).components() {
        match part {
            Component::Normal(name) => parts.push(name),
            Component::CurDir => {}
            Component::ParentDir => {
                parts.pop()?;
            }
            Component::RootDir | Component::Prefix(_) => return None,
        }
    }
    if parts.is_empty() { None } else { Some(parts.iter().collect()) }
}

/// Reads a file of at most `limit` bytes.
pub(crate) fn read_bytes(path: &Path, limit: u64, action: &'static str) -> Result<Vec<u8>, DatasetError> {
    use std::io::Read;
    let file = std::fs::File::open(path).map_err(|e| DatasetError::io(path, action, e))?;
    let mut bytes = Vec::new();
    file.take(limit + 1).read_to_end(&mut bytes).map_err(|e| DatasetError::io(path, action, e))?;
    if bytes.len() as u64 > limit {
        let reason = format!("longer than the limit of {limit} bytes");
        return Err(DatasetError::io(path, action, std::io::Error::other(reason)));
    }
    Ok(bytes)
}

/// Reads a text file of at most `limit` bytes.
pub(crate) fn read_text(path: &Path, limit: u64, action: &'static str) -> Result<String, DatasetError> {
    let bytes = read_bytes(path, limit, action)?;
    as_text(path, &bytes).map(str::to_string)
}

/// Bytes as text; a byte-order mark is no part of it.
pub(crate) fn as_text<'a>(path: &Path, bytes: &'a [u8]) -> Result<&'a str, DatasetError> {
    let text = std::str::from_utf8(bytes).map_err(|e| {
        DatasetError::io(path, "read the file as text", std::io::Error::new(std::io::ErrorKind::InvalidData, e))
    })?;
    Ok(text.strip_prefix('\u{feff}').unwrap_or(text))
}

#[cfg(test)]
mod tests {
    use super::lexical;
    use std::path::PathBuf;

    #[test]
    fn stays_inside_or_is_refused() {
        for (written, expected) in [
            ("train/r_0.png", Some("train/r_0.png")),
            ("./train//r_0.png", Some("train/r_0.png")),
            ("train\\r_0.png", Some("train/r_0.png")),
            ("a/../b.png", Some("b.png")),
            ("../b.png", None),
            ("a/../../b.png", None),
            ("/etc/passwd", None),
            ("C:/x.png", None),
            ("", None),
            (".", None),
            ("a\0b", None),
        ] {
            assert_eq!(lexical(written), expected.map(PathBuf::from), "{written}");
        }
    }
}
