//! What a file of a relighter says beside its weights, and relighters from files.
use super::relighter::{Relighter, RelighterConfig};
use crate::error::{DiffusionError, Result};
use crate::nn::{Source, VariablesBuilder};
use crate::weights::{WeightsHeader, weights_of_bytes};
use std::path::Path;

/// The metadata of a relighter's file.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ModelNote {
    /// Sizes of its networks.
    pub sizes: RelighterConfig,
    /// Root mean square errors on held-out objects, display values: from the shape alone, and with a fitted medium; as far as they were measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub errors: Option<[Option<f32>; 2]>,
}

impl ModelNote {
    /// As it is written to `path`.
    pub fn to_text(&self, path: &Path) -> Result<String> {
        serde_json::to_string(self).map_err(|e| DiffusionError::File {
            path: path.display().to_string(),
            problem: format!("its sizes cannot be written: {e}"),
        })
    }

    fn of(header: &WeightsHeader, origin: &str) -> Result<Self> {
        let note = header.metadata.get("note").map(String::as_str).unwrap_or_default();
        serde_json::from_str(note).map_err(|e| DiffusionError::Weights {
            origin: origin.to_owned(),
            problem: format!("no relighter of `diamond train` (its note does not state the sizes: {e})"),
        })
    }
}

/// Primes of the 64-bit FNV-1a hash.
const FNV: (u64, u64) = (0xcbf2_9ce4_8422_2325, 0x0000_0100_0000_01b3);

impl Relighter {
    /// A relighter from a file that training wrote; the file says which sizes it has.
    ///
    /// # Errors
    /// Files that cannot be read, of other models, damaged, or with numbers that are none.
    pub fn load(path: &Path) -> Result<Self> {
        let problem = |e: std::io::Error| DiffusionError::File {
            path: path.display().to_string(),
            problem: format!("cannot be read: {e}"),
        };
        Self::from_bytes(&std::fs::read(path).map_err(problem)?, &path.display().to_string())
    }

    /// As [`Relighter::load`], of a file's bytes; `origin` names them in errors.
    ///
    /// # Errors
    /// As [`Relighter::load`].
    pub fn from_bytes(bytes: &[u8], origin: &str) -> Result<Self> {
        let (header, tensors) = weights_of_bytes(bytes, origin)?;
        let note = ModelNote::of(&header, origin)?;
        let builder = VariablesBuilder::new(Source::Tensors(tensors)).frozen();
        let mut relighter = Self::new(&builder.root(), &note.sizes)?;
        builder.finish().1.into_result(origin)?;
        relighter.errors = note.errors.unwrap_or_default();
        relighter.digest = bytes.iter().fold(FNV.0, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(FNV.1));
        Ok(relighter)
    }

    /// Root mean square error on held-out objects, display values, with a physical prediction or without; none where the file does not say.
    pub fn expected_error(&self, physical: bool) -> Option<f32> {
        self.errors[usize::from(physical)]
    }

    /// A hash of the file that it was read from; 0 for one that was not.
    pub fn digest(&self) -> u64 {
        self.digest
    }
}
