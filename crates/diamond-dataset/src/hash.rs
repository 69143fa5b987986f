//! The identity of a capture: a hash of each of its files, and one of them all.
use crate::{Capture, DatasetError};
use sha2::{Digest, Sha256};
use std::io::Read;
use std::path::{Path, PathBuf};

/// One file of a capture, and what was in it when the capture was hashed.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct FileDigest {
    /// Path below the capture's folder, with `/` between its parts.
    pub name: String,
    /// Length, bytes.
    pub bytes: u64,
    /// SHA-256 of the content.
    pub sha256: [u8; 32],
}

impl FileDigest {
    /// The first 16 digits of the hash in lower-case hex: enough to tell a file from its changed self.
    pub fn short(&self) -> String {
        hex(&self.sha256[..8])
    }
}

/// The files of a capture, as they were at one moment.
#[derive(Debug)]
pub(crate) struct Identity {
    hash: String,
    files: Vec<FileDigest>,
    /// Full paths and places in `files`, sorted by path.
    by_path: Vec<(PathBuf, usize)>,
}

impl Identity {
    /// What the file at `path` had in it; `None` for a file that is no part of the capture.
    pub(crate) fn of(&self, path: &Path) -> Option<&FileDigest> {
        let at = self.by_path.binary_search_by(|(p, _)| p.as_path().cmp(path)).ok()?;
        Some(&self.files[self.by_path[at].1])
    }
}

impl Capture {
    /// SHA-256, in lower-case hex, of the capture as opened: for its JSON files, exclude list, point cloud, and then
    /// all images in order of their paths, the path below the folder, the length and the bytes. Where the folder lies
    /// does not matter, and a selection has the hash of the capture that it was selected from. Files are streamed; the
    /// result is kept, and from then on an image whose content is no longer the same is refused when it is loaded.
    pub fn hash(&self) -> Result<String, DatasetError> {
        Ok(self.identity()?.hash.clone())
    }

    /// The files that [`Capture::hash`] covers, in its order, each with its own hash.
    pub fn files(&self) -> Result<&[FileDigest], DatasetError> {
        Ok(&self.identity()?.files)
    }

    fn identity(&self) -> Result<&Identity, DatasetError> {
        if let Some(identity) = self.shared.identity.get() {
            return Ok(identity);
        }
        let mut whole = Sha256::new();
        let mut files = Vec::new();
        let mut by_path = Vec::new();
        for path in self.shared.documents.iter().chain(&self.shared.images) {
            by_path.push((path.clone(), files.len()));
            files.push(feed(&mut whole, &self.root, path)?);
        }
        by_path.sort();
        let hash = hex(&whole.finalize());
        Ok(self.shared.identity.get_or_init(|| Identity { hash, files, by_path }))
    }

    /// Refuses the bytes of a file that had other content when the capture was hashed; says nothing before that, and
    /// nothing about files that are no part of the capture.
    pub(crate) fn check_unchanged(&self, path: &Path, bytes: &[u8]) -> Result<(), String> {
        let Some(then) = self.shared.identity.get().and_then(|identity| identity.of(path)) else { return Ok(()) };
        if bytes.len() as u64 != then.bytes {
            return Err(format!(
                "the file changed while it was in use: it had {} bytes and now has {}",
                then.bytes,
                bytes.len()
            ));
        }
        if Sha256::digest(bytes)[..] != then.sha256 {
            return Err("the file changed while it was in use: its length is the same, its content is not".into());
        }
        Ok(())
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn feed(whole: &mut Sha256, root: &Path, path: &Path) -> Result<FileDigest, DatasetError> {
    let io = |e| DatasetError::io(path, "read the file for the hash of the capture", e);
    let relative = path.strip_prefix(root).unwrap_or(path);
    let name = relative.components().map(|c| c.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("/");
    let mut file = std::fs::File::open(path).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    whole.update((name.len() as u64).to_le_bytes());
    whole.update(name.as_bytes());
    whole.update(length.to_le_bytes());
    let mut own = Sha256::new();
    let mut bytes = 0;
    let mut chunk = vec![0u8; 64 << 10];
    loop {
        match file.read(&mut chunk).map_err(io)? {
            0 => return Ok(FileDigest { name, bytes, sha256: own.finalize().into() }),
            n => {
                bytes += n as u64;
                whole.update(&chunk[..n]);
                own.update(&chunk[..n]);
            }
        }
    }
}
