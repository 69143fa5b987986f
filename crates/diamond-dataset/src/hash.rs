//! The identity of a capture: a hash of what it consists of.
use crate::{Capture, DatasetError};
use sha2::{Digest, Sha256};
use std::io::Read;
use std::path::Path;

impl Capture {
    /// SHA-256, in lower-case hex, of the capture as opened: for its JSON files, exclude list, point cloud, and then
    /// all images in order of their paths, the path below the folder, the length and the bytes. Where the folder lies
    /// does not matter, and a selection has the hash of the capture that it was selected from. Files are streamed; the
    /// result is kept.
    pub fn hash(&self) -> Result<String, DatasetError> {
        if let Some(hash) = self.shared.hash.get() {
            return Ok(hash.clone());
        }
        let mut state = Sha256::new();
        for path in self.shared.documents.iter().chain(&self.shared.images) {
            feed(&mut state, &self.root, path)?;
        }
        let hash: String = state.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(self.shared.hash.get_or_init(|| hash).clone())
    }
}

fn feed(state: &mut Sha256, root: &Path, path: &Path) -> Result<(), DatasetError> {
    let io = |e| DatasetError::io(path, "read the file for the hash of the capture", e);
    let relative = path.strip_prefix(root).unwrap_or(path);
    let name = relative.components().map(|c| c.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("/");
    let mut file = std::fs::File::open(path).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    state.update((name.len() as u64).to_le_bytes());
    state.update(name.as_bytes());
    state.update(length.to_le_bytes());
    let mut chunk = vec![0u8; 64 << 10];
    loop {
        match file.read(&mut chunk).map_err(io)? {
            0 => return Ok(()),
            n => state.update(&chunk[..n]),
        }
    }
}
