//! Writing results so that a crash never leaves half a file.
use crate::SssError;
use diamond_reconstruct::{ReconstructError, write_atomically};
use std::path::Path;

/// Writes `bytes` to `path`: a temporary file beside it, synchronised, renamed. Missing folders are created.
pub fn write_output(path: &Path, bytes: &[u8]) -> Result<(), SssError> {
    if let Some(parent) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
        std::fs::create_dir_all(parent).map_err(SssError::io(parent, "create the folder"))?;
    }
    if path.is_dir() {
        return Err(SssError::Usage(format!("{}: is a folder; name a file to be written", path.display())));
    }
    write_atomically(path, bytes).map_err(|e| match e {
        ReconstructError::Io { path, action, source } => SssError::Io { path, action, source },
        other => other.into(),
    })
}

/// Writes a value as indented JSON with a final line break.
pub(crate) fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<(), SssError> {
    let text = serde_json::to_string_pretty(value)
        .map_err(|e| SssError::Internal(format!("{}: cannot be written as JSON: {e}", path.display())))?;
    write_output(path, format!("{text}\n").as_bytes())
}

/// Reads a value from JSON; `what` says in errors what the file should hold.
pub(crate) fn read_json<T: serde::de::DeserializeOwned>(path: &Path, what: &str) -> Result<T, SssError> {
    parse_json(path, &std::fs::read(path).map_err(SssError::io(path, "read"))?, what)
}

/// Reads a value from the bytes of a JSON file; `path` is only named in errors.
pub(crate) fn parse_json<T: serde::de::DeserializeOwned>(path: &Path, bytes: &[u8], what: &str) -> Result<T, SssError> {
    serde_json::from_slice(bytes)
        .map_err(|e| SssError::Input { path: path.to_owned(), detail: format!("expected {what}: {e}") })
}
