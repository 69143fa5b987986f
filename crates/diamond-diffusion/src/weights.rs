//! Files of weights (safetensors): what is in them, without reading it, and the tensors themselves.
use crate::error::{DiffusionError, Result};
use candle_core::{Device, Tensor};
use half::{bf16, f16};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// Longest header that is read, in bytes; that of a large model is a few hundred kilobytes.
const LONGEST_HEADER: u64 = 64 << 20;

/// How a number is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NumberType {
    /// 64 bits.
    F64,
    /// 32 bits.
    F32,
    /// 16 bits, at most 65504.
    F16,
    /// 16 bits with the range of `F32`.
    Bf16,
    /// Not a floating-point number (positions, counters): listed, but never a weight.
    Other(usize),
}

impl NumberType {
    fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "F64" => Self::F64,
            "F32" => Self::F32,
            "F16" => Self::F16,
            "BF16" => Self::Bf16,
            "I64" | "U64" => Self::Other(8),
            "I32" | "U32" => Self::Other(4),
            "I16" | "U16" => Self::Other(2),
            "I8" | "U8" | "BOOL" => Self::Other(1),
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::F64 => 8,
            Self::F32 => 4,
            Self::F16 | Self::Bf16 => 2,
            Self::Other(bytes) => bytes,
        }
    }
}

/// A tensor in a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredTensor {
    /// How its numbers are stored.
    pub number: NumberType,
    /// Its shape.
    pub shape: Vec<usize>,
    /// First byte and the one past the last, from the beginning of the file.
    range: (u64, u64),
}

impl StoredTensor {
    /// Number of entries.
    pub fn elements(&self) -> usize {
        self.shape.iter().product()
    }
}

/// What a file holds, from its header alone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WeightsHeader {
    /// Its tensors by name.
    pub tensors: BTreeMap<String, StoredTensor>,
    /// What was written beside them.
    pub metadata: BTreeMap<String, String>,
}

fn file_error(path: &Path, problem: impl Into<String>) -> DiffusionError {
    DiffusionError::File { path: path.display().to_string(), problem: problem.into() }
}

impl WeightsHeader {
    /// Reads the header and compares what it promises with the length of the file.
    pub fn read(path: &Path) -> Result<Self> {
        let io = |e: std::io::Error| file_error(path, format!("cannot be read: {e}"));
        let mut file = File::open(path).map_err(io)?;
        let size = file.metadata().map_err(io)?.len();
        Self::read_from(path, &mut file, size)
    }

    /// As [`WeightsHeader::read`], of something that is `size` bytes long; `path` names it in errors.
    fn read_from(path: &Path, file: &mut impl Read, size: u64) -> Result<Self> {
        let io = |e: std::io::Error| file_error(path, format!("cannot be read: {e}"));
        let mut length = [0u8; 8];
        file.read_exact(&mut length).map_err(|_| not_safetensors(path, "it is shorter than 8 bytes"))?;
        let length = u64::from_le_bytes(length);
        if length > LONGEST_HEADER {
            return Err(not_safetensors(path, "its header would be longer than any model needs"));
        }
        if length + 8 > size {
            return Err(file_error(path, format!("truncated: a header of {length} bytes, a file of {size}")));
        }
        let mut header = vec![0u8; length as usize];
        file.read_exact(&mut header).map_err(io)?;
        Self::parse(path, &header, length + 8, size)
    }

    fn parse(path: &Path, header: &[u8], start: u64, size: u64) -> Result<Self> {
        let json: serde_json::Map<String, serde_json::Value> = serde_json::from_slice(header)
            .map_err(|e| not_safetensors(path, &format!("its header is no JSON: {e}")))?;
        let mut found = Self { tensors: BTreeMap::new(), metadata: BTreeMap::new() };
        for (name, value) in json {
            if name == "__metadata__" {
                let entries = value.as_object().into_iter().flatten();
                found.metadata = entries.filter_map(|(k, v)| Some((k.clone(), v.as_str()?.to_owned()))).collect();
                continue;
            }
            let wrong = |what: &str| file_error(path, format!("tensor {name}: {what}"));
            let number = value["dtype"].as_str().and_then(NumberType::from_name);
            let number = number.ok_or_else(|| wrong("unknown type of numbers; convert the file to F32 or F16"))?;
            let integers =
                |key: &str| -> Option<Vec<u64>> { value[key].as_array()?.iter().map(|v| v.as_u64()).collect() };
            let shape = integers("shape").ok_or_else(|| wrong("no shape"))?;
            let bytes = shape.iter().try_fold(number.bytes() as u64, |n, side| n.checked_mul(*side));
            let range = match integers("data_offsets").as_deref() {
                Some(&[from, to]) if to >= from && bytes == Some(to - from) => {
                    from.checked_add(start).zip(to.checked_add(start))
                }
                _ => None,
            };
            let range = range.ok_or_else(|| wrong("its bytes do not fit its shape; the file is damaged"))?;
            if range.1 > size {
                let problem = format!("truncated: {name} ends at byte {}, the file at {size}; fetch it again", range.1);
                return Err(file_error(path, problem));
            }
            let shape = shape.into_iter().map(|side| side as usize).collect();
            found.tensors.insert(name, StoredTensor { number, shape, range });
        }
        Ok(found)
    }

    /// Number of parameters, without tensors that are no floating-point numbers.
    pub fn parameters(&self) -> usize {
        let weights = self.tensors.values().filter(|tensor| !matches!(tensor.number, NumberType::Other(_)));
        weights.map(StoredTensor::elements).sum()
    }
}

fn not_safetensors(path: &Path, why: &str) -> DiffusionError {
    let problem = format!("no safetensors file ({why}); pickled .ckpt, .pth and .bin files must be converted first");
    file_error(path, problem)
}

/// The floating-point tensors of a file, as `f32` on the CPU. NaN and infinity are refused.
pub fn read_weights(path: &Path) -> Result<BTreeMap<String, Tensor>> {
    let header = WeightsHeader::read(path)?;
    let mut file = File::open(path).map_err(|e| file_error(path, format!("cannot be read: {e}")))?;
    tensors_of(path, &header, &mut file)
}

/// As [`read_weights`], of a file's bytes, and with its header; `origin` names them in errors.
pub fn weights_of_bytes(bytes: &[u8], origin: &str) -> Result<(WeightsHeader, BTreeMap<String, Tensor>)> {
    let (path, mut reader) = (Path::new(origin), std::io::Cursor::new(bytes));
    let header = WeightsHeader::read_from(path, &mut reader, bytes.len() as u64)?;
    let tensors = tensors_of(path, &header, &mut reader)?;
    Ok((header, tensors))
}

fn tensors_of(path: &Path, header: &WeightsHeader, file: &mut (impl Read + Seek)) -> Result<BTreeMap<String, Tensor>> {
    let io = |e: std::io::Error| file_error(path, format!("cannot be read: {e}"));
    let mut tensors = BTreeMap::new();
    for (name, stored) in &header.tensors {
        let mut bytes = vec![0u8; (stored.range.1 - stored.range.0) as usize];
        file.seek(SeekFrom::Start(stored.range.0)).map_err(io)?;
        file.read_exact(&mut bytes).map_err(io)?;
        let values: Vec<f32> = match stored.number {
            NumberType::Other(_) => continue,
            NumberType::F64 => bytes.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b) as f32).collect(),
            NumberType::F32 => bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
            NumberType::F16 => bytes.as_chunks().0.iter().map(|b| f16::from_le_bytes(*b).to_f32()).collect(),
            NumberType::Bf16 => bytes.as_chunks().0.iter().map(|b| bf16::from_le_bytes(*b).to_f32()).collect(),
        };
        if let Some(at) = values.iter().position(|v| !v.is_finite()) {
            let problem = match (values[at].is_nan(), stored.number) {
                (false, NumberType::F16) => {
                    "infinity: a value beyond 65504 was stored as F16; convert from the original to BF16 or F32"
                }
                (true, _) => "NaN: the training diverged or the file is damaged",
                (false, _) => "infinity: the training diverged or the file is damaged",
            };
            return Err(file_error(path, format!("tensor {name}, entry {at}: {problem}")));
        }
        tensors.insert(name.clone(), Tensor::from_vec(values, stored.shape.as_slice(), &Device::Cpu)?);
    }
    Ok(tensors)
}

/// Writes tensors beside the place and moves them there when they are whole. `note` becomes the metadata entry "note".
///
/// Values beyond 65504 cannot be stored as `F16`, and NaN nowhere: both are errors, and nothing is written.
pub fn write_weights<'a>(
    path: &Path,
    tensors: impl IntoIterator<Item = (&'a str, &'a Tensor)>,
    number: NumberType,
    note: &str,
) -> Result<()> {
    let mut stored: Vec<(String, safetensors::Dtype, Vec<usize>, Vec<u8>)> = Vec::new();
    for (name, tensor) in tensors {
        let values: Vec<f32> = tensor.to_dtype(candle_core::DType::F32)?.flatten_all()?.to_vec1()?;
        let wrong = |at: usize, what: &str| Err(file_error(path, format!("tensor {name}, entry {at}: {what}")));
        if let Some(at) = values.iter().position(|v| !v.is_finite()) {
            return wrong(at, "NaN or infinity is not written");
        }
        let (dtype, bytes): (_, Vec<u8>) = match number {
            NumberType::F16 => {
                if let Some(at) = values.iter().position(|v| f16::from_f32(*v).is_infinite()) {
                    return wrong(at, "too large for F16 (65504); write BF16 or F32");
                }
                (safetensors::Dtype::F16, values.iter().flat_map(|v| f16::from_f32(*v).to_le_bytes()).collect())
            }
            NumberType::Bf16 => {
                (safetensors::Dtype::BF16, values.iter().flat_map(|v| bf16::from_f32(*v).to_le_bytes()).collect())
            }
            NumberType::F32 => (safetensors::Dtype::F32, values.iter().flat_map(|v| v.to_le_bytes()).collect()),
            NumberType::F64 | NumberType::Other(_) => {
                return Err(DiffusionError::setting("type of numbers", "F32, F16 or BF16", format!("{number:?}")));
            }
        };
        stored.push((name.to_owned(), dtype, tensor.dims().to_vec(), bytes));
    }
    let safe = |e: safetensors::SafeTensorError| file_error(path, format!("cannot be written: {e}"));
    let mut views = Vec::with_capacity(stored.len());
    for (name, dtype, shape, bytes) in &stored {
        views.push((name.clone(), safetensors::tensor::TensorView::new(*dtype, shape.clone(), bytes).map_err(safe)?));
    }
    let metadata = std::collections::HashMap::from([("note".to_owned(), note.to_owned())]);
    let bytes = safetensors::serialize(views, Some(metadata)).map_err(safe)?;
    let io = |e: std::io::Error| file_error(path, format!("cannot be written: {e}"));
    let mut beside = path.as_os_str().to_owned();
    beside.push(".part");
    let beside = std::path::PathBuf::from(beside);
    std::fs::write(&beside, bytes).map_err(io)?;
    File::open(&beside).and_then(|file| file.sync_all()).map_err(io)?;
    std::fs::rename(&beside, path).map_err(io)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(name: &str) -> std::path::PathBuf {
        let folder = std::env::temp_dir().join(format!("diamond-weights-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        folder
    }

    fn tensor(values: &[f32]) -> Tensor {
        Tensor::new(values, &Device::Cpu).unwrap()
    }

    #[test]
    fn tensors_go_there_and_back_in_each_type_and_the_same_bytes_twice() {
        let path = folder("there").join("a.safetensors");
        let (a, b) = (tensor(&[1.0, -0.333_333_34, 60_000.0]), tensor(&[2.0]).reshape((1, 1)).unwrap());
        for (number, error) in [(NumberType::F32, 0.0), (NumberType::F16, 16.0), (NumberType::Bf16, 200.0)] {
            write_weights(&path, [("b.bias", &b), ("a.weight", &a)], number, "by hand").unwrap();
            let bytes = std::fs::read(&path).unwrap();
            write_weights(&path, [("b.bias", &b), ("a.weight", &a)], number, "by hand").unwrap();
            assert_eq!(bytes, std::fs::read(&path).unwrap());
            let header = WeightsHeader::read(&path).unwrap();
            assert_eq!((header.parameters(), header.metadata["note"].as_str()), (4, "by hand"));
            assert_eq!(header.tensors["b.bias"].shape, [1, 1]);
            let read = read_weights(&path).unwrap()["a.weight"].to_vec1::<f32>().unwrap();
            assert!(read.iter().zip([1.0, -0.333_333_34, 60_000.0]).all(|(a, b)| (a - b).abs() <= error), "{read:?}");
        }
    }

    #[test]
    fn damaged_files_are_refused_with_a_reason() {
        let folder = folder("damaged");
        let path = folder.join("a.safetensors");
        write_weights(&path, [("w", &tensor(&[1.0, 2.0, 3.0]))], NumberType::F32, "").unwrap();
        let good = std::fs::read(&path).unwrap();
        let refused = |bytes: &[u8]| {
            let path = folder.join("b.safetensors");
            std::fs::write(&path, bytes).unwrap();
            read_weights(&path).unwrap_err().to_string()
        };
        for cut in [0, 7] {
            assert!(refused(&good[..cut]).contains("no safetensors"), "{cut}");
        }
        for cut in [20, good.len() - 1] {
            assert!(refused(&good[..cut]).contains("truncated"), "{cut}");
        }
        let mut nan = good.clone();
        let at = good.len() - 4;
        nan[at..].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(refused(&nan).contains("entry 2: NaN"));
        let mut pickle = b"\x80\x02}q\x00.".to_vec();
        pickle.resize(100, 0xff);
        assert!(refused(&pickle).contains("pickled"));
        assert!(read_weights(&folder.join("none")).unwrap_err().to_string().contains("cannot be read"));
        let text = String::from_utf8_lossy(&good).replace("[3]", "[4]");
        assert!(refused(text.as_bytes()).contains("do not fit its shape"));
    }

    #[test]
    fn what_half_floats_cannot_hold_is_refused_both_ways() {
        let path = folder("half").join("a.safetensors");
        let large = tensor(&[1.0, 7e4]);
        let error = write_weights(&path, [("w", &large)], NumberType::F16, "").unwrap_err().to_string();
        assert!(error.contains("w, entry 1") && !path.exists(), "{error}");
        write_weights(&path, [("w", &tensor(&[1.0, 2.0]))], NumberType::F16, "").unwrap();
        let mut bytes = std::fs::read(&path).unwrap();
        let at = bytes.len() - 2;
        bytes[at..].copy_from_slice(&f16::INFINITY.to_le_bytes());
        std::fs::write(&path, bytes).unwrap();
        assert!(read_weights(&path).unwrap_err().to_string().contains("65504"));
        let nan = write_weights(&path, [("w", &tensor(&[f32::NAN]))], NumberType::F32, "");
        assert!(nan.unwrap_err().to_string().contains("not written"));
    }
}
