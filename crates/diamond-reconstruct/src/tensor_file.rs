//! Named f32 tensors with text metadata in one safetensors file, written so that a crash never leaves half a file.
use crate::ReconstructError;
use safetensors::tensor::{Dtype, SafeTensors, TensorView, View};
use sha2::{Digest, Sha256};
use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

/// Metadata key under which the SHA-256 of all tensor bytes is stored.
const DIGEST_KEY: &str = "sha256";

/// Named tensors and metadata.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TensorFile {
    /// Shape and row-major values of each tensor.
    pub tensors: BTreeMap<String, (Vec<usize>, Vec<f32>)>,
    /// Text metadata.
    pub metadata: BTreeMap<String, String>,
}

/// Writes `bytes` to `path` whole or not at all, see [`diamond_splat::write_whole`].
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), ReconstructError> {
    diamond_splat::write_whole(path, bytes).map_err(|failure| ReconstructError::Io {
        path: path.to_owned(),
        action: failure.action,
        source: failure.source,
    })
}

/// SHA-256 in lower-case hex of tensors' names, lengths and bytes, in the order of their names: what a file holds of
/// itself to be known as whole.
pub fn tensor_digest<'a>(tensors: impl Iterator<Item = (&'a String, &'a [u8])>) -> String {
    let mut hash = TensorHash::default();
    tensors.for_each(|(name, bytes)| hash.add(name, bytes));
    hash.finish()
}

/// [`tensor_digest`], a tensor at a time.
#[derive(Default)]
struct TensorHash(Sha256);

impl TensorHash {
    fn add(&mut self, name: &str, bytes: &[u8]) {
        self.0.update(name.as_bytes());
        self.0.update((bytes.len() as u64).to_le_bytes());
        self.0.update(bytes);
    }

    fn finish(self) -> String {
        self.0.finalize().iter().map(|b| format!("{b:02x}")).collect()
    }
}

/// Little-endian bytes of values.
fn bytes_of(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// A tensor whose bytes are written elsewhere: only its place in the header is asked for.
struct Announced<'a> {
    shape: &'a [usize],
    values: usize,
}

impl View for Announced<'_> {
    fn dtype(&self) -> Dtype {
        Dtype::F32
    }

    fn shape(&self) -> &[usize] {
        self.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(&[])
    }

    fn data_len(&self) -> usize {
        4 * self.values
    }
}

impl TensorFile {
    /// Adds a tensor; `values.len()` must be the product of `shape`.
    pub fn insert(&mut self, name: impl Into<String>, shape: &[usize], values: Vec<f32>) {
        debug_assert_eq!(shape.iter().product::<usize>(), values.len());
        self.tensors.insert(name.into(), (shape.to_vec(), values));
    }

    /// Writes the file, whole or not at all, a tensor at a time.
    pub fn write(&self, path: &Path) -> Result<(), ReconstructError> {
        let header = self.header(path)?;
        let written = diamond_splat::write_whole_with(path, |file| {
            file.write_all(&header)?;
            self.tensors.values().try_for_each(|(_, values)| file.write_all(&bytes_of(values)))
        });
        written.map_err(|failure| ReconstructError::Io {
            path: path.to_owned(),
            action: failure.action,
            source: failure.source,
        })
    }

    /// The bytes of the file; `path` is only named in errors.
    pub fn to_bytes(&self, path: &Path) -> Result<Vec<u8>, ReconstructError> {
        let mut bytes = self.header(path)?;
        self.tensors.values().for_each(|(_, values)| bytes.extend(bytes_of(values)));
        Ok(bytes)
    }

    /// What precedes the tensors, which follow in the order of their names: all are of one type.
    fn header(&self, path: &Path) -> Result<Vec<u8>, ReconstructError> {
        let fail = |detail: String| ReconstructError::Checkpoint { path: path.to_owned(), detail };
        let mut hash = TensorHash::default();
        for (name, (shape, values)) in &self.tensors {
            if shape.iter().product::<usize>() != values.len() {
                return Err(fail(format!("tensor {name}: {} values do not have the shape {shape:?}", values.len())));
            }
            hash.add(name, &bytes_of(values));
        }
        let mut metadata: HashMap<String, String> = self.metadata.iter().map(|(k, v)| (k.clone(), v.clone())).collect();
        metadata.insert(DIGEST_KEY.into(), hash.finish());
        let views =
            self.tensors.iter().map(|(name, (shape, values))| (name, Announced { shape, values: values.len() }));
        let mut header = safetensors::serialize(views, Some(metadata)).map_err(|e| fail(e.to_string()))?;
        header.shrink_to_fit();
        Ok(header)
    }

    /// Reads and verifies a file that [`TensorFile::write`] wrote.
    pub fn read(path: &Path) -> Result<Self, ReconstructError> {
        let bytes = std::fs::read(path).map_err(|source| ReconstructError::Io {
            path: path.to_owned(),
            action: "read",
            source,
        })?;
        Self::parse(path, &bytes)
    }

    /// Reads and verifies the bytes of a file that [`TensorFile::write`] wrote; `path` is only named in errors.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self, ReconstructError> {
        let fail = |detail: String| ReconstructError::Checkpoint { path: path.to_owned(), detail };
        let broken = |e: safetensors::SafeTensorError| {
            fail(format!(
                "expected a safetensors file, found a broken one ({e}); use an older checkpoint or start anew"
            ))
        };
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(broken)?;
        let parsed = SafeTensors::deserialize(bytes).map_err(broken)?;
        let mut metadata: BTreeMap<String, String> =
            header.metadata().iter().flatten().map(|(k, v)| (k.clone(), v.clone())).collect();
        let expected = metadata.remove(DIGEST_KEY);
        let mut views: Vec<(String, TensorView)> = parsed.tensors();
        views.sort_by(|a, b| a.0.cmp(&b.0));
        let found = tensor_digest(views.iter().map(|(n, v)| (n, v.data())));
        if expected.as_deref() != Some(found.as_str()) {
            return Err(fail("the checksum does not match its contents: the file was changed or damaged".into()));
        }
        let mut tensors = BTreeMap::new();
        for (name, view) in views {
            if view.dtype() != Dtype::F32 {
                return Err(fail(format!("tensor {name}: expected f32, found {:?}", view.dtype())));
            }
            let values: Vec<f32> =
                view.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            if let Some(at) = values.iter().position(|v| !v.is_finite()) {
                return Err(fail(format!("tensor {name}, value {at}: expected a finite number, found {}", values[at])));
            }
            tensors.insert(name, (view.shape().to_vec(), values));
        }
        Ok(Self { tensors, metadata })
    }

    /// Takes out a tensor of the given number of values.
    pub fn take(&mut self, path: &Path, name: &str, expected: usize) -> Result<Vec<f32>, ReconstructError> {
        let fail = |detail: String| ReconstructError::Checkpoint { path: path.to_owned(), detail };
        let (shape, values) = self.tensors.remove(name).ok_or_else(|| fail(format!("tensor `{name}` is missing")))?;
        if values.len() != expected {
            return Err(fail(format!("tensor `{name}`: expected {expected} values, found shape {shape:?}")));
        }
        Ok(values)
    }

    /// A metadata value, parsed.
    pub fn metadata_value<T: std::str::FromStr>(&self, path: &Path, key: &str) -> Result<T, ReconstructError> {
        let fail = |detail: String| ReconstructError::Checkpoint { path: path.to_owned(), detail };
        let text = self.metadata.get(key).ok_or_else(|| fail(format!("metadata `{key}` is missing")))?;
        text.parse().map_err(|_| fail(format!("metadata `{key}`: cannot read {text:?}")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(name: &str) -> std::path::PathBuf {
        let path = std::env::temp_dir().join(format!("diamond-tensor-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        path
    }

    #[test]
    fn round_trip_and_damage() {
        let dir = folder("round-trip");
        let path = dir.join("a.safetensors");
        let mut file = TensorFile::default();
        file.insert("x", &[2, 2], vec![1.0, f32::MIN_POSITIVE, -0.0, 1e30]);
        file.insert("empty", &[0, 3], vec![]);
        file.metadata.insert("step".into(), "12".into());
        file.write(&path).unwrap();
        let again = TensorFile::read(&path).unwrap();
        assert_eq!(file, again);
        assert_eq!(again.metadata_value::<u64>(&path, "step").unwrap(), 12);

        let mut bytes = std::fs::read(&path).unwrap();
        *bytes.last_mut().unwrap() ^= 1;
        std::fs::write(&path, &bytes).unwrap();
        assert!(TensorFile::read(&path).unwrap_err().to_string().contains("checksum"));
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        assert!(TensorFile::read(&path).unwrap_err().to_string().contains("broken"));
        std::fs::remove_dir_all(dir).unwrap();
    }
}
