//! A picture that was made and let in: where it belongs, who made it, and its pixels, which are in memory or on disk.
use crate::{AugmentError, Picture, Target};
use diamond_dataset::Provenance;
use diamond_image::{Image, Mask};
use half::f16;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A picture beside the photographs.
#[derive(Debug, Clone)]
pub struct Frame {
    /// From where and under which light.
    pub target: Target,
    /// [`Provenance::Synthetic`], with the source's method.
    pub provenance: Provenance,
    /// Mean confidence over the pixels that the picture's mask covers, or over all where it has none; 0 … 1.
    pub confidence: f32,
    pub(crate) pixels: Pixels,
}

/// The pixels of a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Loaded {
    /// Linear RGB over black.
    pub radiance: Image,
    /// Coverage, where it is known.
    pub mask: Option<Mask>,
    /// How much of each pixel is believed, one channel, 0 … 1.
    pub confidence: Image,
}

/// Where pixels are.
#[derive(Debug, Clone)]
pub(crate) enum Pixels {
    Memory(Arc<Packed>),
    File(PathBuf),
}

impl Frame {
    /// The pixels. A frame that lies on disk is read anew each time.
    ///
    /// # Errors
    /// [`AugmentError::File`] where its file is gone or was changed.
    pub fn load(&self) -> Result<Loaded, AugmentError> {
        match &self.pixels {
            Pixels::Memory(packed) => packed.unpack().map_err(|detail| self.wrong(detail)),
            Pixels::File(path) => {
                let fail = |detail: String| AugmentError::File { path: path.clone(), detail };
                Packed::read(path)?.unpack().map_err(fail)
            }
        }
    }

    fn wrong(&self, detail: String) -> AugmentError {
        let method = match &self.provenance {
            Provenance::Synthetic { method } => method.clone(),
            Provenance::Photograph => "a camera".into(),
        };
        AugmentError::Picture { method, detail }
    }
}

/// Pixels as they are kept: half floats and bytes. What is used is always what was packed, so that a kept picture and a new one have the same bits.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Packed {
    width: usize,
    height: usize,
    radiance: Vec<f16>,
    mask: Option<Vec<u8>>,
    confidence: Vec<u8>,
}

/// Largest radiance that is kept: what half floats hold.
const LARGEST: f32 = 65504.0;

fn byte(v: f32) -> u8 {
    (v.clamp(0.0, 1.0) * 255.0).round() as u8
}

fn unit(v: u8) -> f32 {
    f32::from(v) / 255.0
}

impl Packed {
    /// Of a picture for a camera of `width` × `height`; `Err` says what a source did wrong.
    pub fn new(picture: &Picture, width: usize, height: usize) -> Result<Self, String> {
        let expected = |what: &str, found: (usize, usize, usize), channels: usize| match found {
            f if f == (width, height, channels) => Ok(()),
            (w, h, c) => Err(format!("{what}: expected {width}×{height}×{channels}, found {w}×{h}×{c}")),
        };
        expected("radiance", picture.radiance.shape(), 3)?;
        expected("confidence", picture.confidence.shape(), 1)?;
        if let Some(mask) = &picture.mask {
            expected("mask", (mask.width(), mask.height(), 1), 1)?;
        }
        let bad = |v: &f32| !(v.is_finite() && (0.0..=LARGEST).contains(v));
        if let Some(i) = picture.radiance.data().iter().position(bad) {
            let (at, found) = (i / 3, picture.radiance.data()[i]);
            return Err(format!(
                "radiance of pixel ({}, {}): expected 0 … 65504, found {found}",
                at % width,
                at / width
            ));
        }
        if let Some(i) = picture.confidence.data().iter().position(|v| !(0.0..=1.0).contains(v)) {
            let found = picture.confidence.data()[i];
            return Err(format!("confidence of pixel ({}, {}): expected 0 … 1, found {found}", i % width, i / width));
        }
        Ok(Self {
            width,
            height,
            radiance: picture.radiance.data().iter().map(|v| f16::from_f32(*v)).collect(),
            mask: picture.mask.as_ref().map(|m| m.data().iter().map(|v| byte(*v)).collect()),
            confidence: picture.confidence.data().iter().map(|v| byte(*v)).collect(),
        })
    }

    pub fn unpack(&self) -> Result<Loaded, String> {
        let (w, h) = (self.width, self.height);
        let image = |channels: usize, data: Vec<f32>| Image::from_vec(w, h, channels, data).map_err(|e| e.to_string());
        let mask = self.mask.as_ref().map(|m| Mask::from_vec(w, h, m.iter().map(|v| unit(*v)).collect()));
        Ok(Loaded {
            radiance: image(3, self.radiance.iter().map(|v| v.to_f32()).collect())?,
            mask: mask.transpose().map_err(|e| e.to_string())?,
            confidence: image(1, self.confidence.iter().map(|v| unit(*v)).collect())?,
        })
    }

    /// The bytes of a file (safetensors): `radiance` height × width × 3 half floats, `confidence` and, where there is one, `mask` height × width bytes.
    pub fn to_bytes(&self, about: &str) -> Result<Vec<u8>, String> {
        let (w, h) = (self.width, self.height);
        let radiance: Vec<u8> = self.radiance.iter().flat_map(|v| v.to_le_bytes()).collect();
        let view =
            |dtype, shape: &[usize], bytes| TensorView::new(dtype, shape.to_vec(), bytes).map_err(|e| e.to_string());
        let mut tensors = vec![
            ("radiance", view(Dtype::F16, &[h, w, 3], &radiance)?),
            ("confidence", view(Dtype::U8, &[h, w], &self.confidence)?),
        ];
        if let Some(mask) = &self.mask {
            tensors.push(("mask", view(Dtype::U8, &[h, w], mask)?));
        }
        let metadata = HashMap::from([("diamond".to_owned(), about.to_owned())]);
        safetensors::serialize(tensors, Some(metadata)).map_err(|e| e.to_string())
    }

    /// What [`Packed::to_bytes`] gave, and the text about it.
    pub fn parse(bytes: &[u8]) -> Result<(Self, String), String> {
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| e.to_string())?;
        let about = header.metadata().as_ref().and_then(|m| m.get("diamond").cloned()).unwrap_or_default();
        let tensors = SafeTensors::deserialize(bytes).map_err(|e| e.to_string())?;
        let radiance = tensors.tensor("radiance").map_err(|e| e.to_string())?;
        let [height, width, 3] = *radiance.shape() else {
            return Err(format!("radiance: expected height × width × 3, found {:?}", radiance.shape()));
        };
        let take = |name: &str, dtype: Dtype, shape: &[usize]| -> Result<Vec<u8>, String> {
            let tensor = tensors.tensor(name).map_err(|e| e.to_string())?;
            if tensor.dtype() != dtype || tensor.shape() != shape {
                return Err(format!(
                    "{name}: expected {dtype:?} {shape:?}, found {:?} {:?}",
                    tensor.dtype(),
                    tensor.shape()
                ));
            }
            Ok(tensor.data().to_vec())
        };
        let half = take("radiance", Dtype::F16, &[height, width, 3])?;
        let radiance: Vec<f16> = half.chunks_exact(2).map(|b| f16::from_le_bytes([b[0], b[1]])).collect();
        if let Some(v) = radiance.iter().find(|v| !(v.is_finite() && v.to_f32() >= 0.0)) {
            return Err(format!("radiance: expected 0 … 65504, found {v}"));
        }
        let confidence = take("confidence", Dtype::U8, &[height, width])?;
        let mask = match tensors.names().contains(&"mask") {
            true => Some(take("mask", Dtype::U8, &[height, width])?),
            false => None,
        };
        Ok((Self { width, height, radiance, mask, confidence }, about))
    }

    pub fn read(path: &Path) -> Result<Self, AugmentError> {
        let fail = |detail: String| AugmentError::File { path: path.to_owned(), detail };
        let bytes = std::fs::read(path)
            .map_err(|e| fail(format!("a picture that was made could not be read: {e}; start anew, or resume")))?;
        let (packed, _) =
            Self::parse(&bytes).map_err(|e| fail(format!("{e}; remove the file, it will be made again")))?;
        Ok(packed)
    }

    /// See [`Frame::confidence`].
    pub fn mean_confidence(&self) -> f32 {
        let (mut sum, mut weight) = (0.0f64, 0.0f64);
        for (i, c) in self.confidence.iter().enumerate() {
            let covered = self.mask.as_ref().map_or(1.0, |m| f64::from(unit(m[i])));
            sum += covered * f64::from(unit(*c));
            weight += covered;
        }
        if weight > 0.0 { (sum / weight) as f32 } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture() -> Picture {
        let of = |n: usize, f: f32| (0..n).map(|i| ((i as f32 * 0.37 + 0.2) * f).fract()).collect::<Vec<f32>>();
        Picture {
            radiance: Image::from_vec(5, 4, 3, of(60, 1.0)).unwrap(),
            mask: Some(Mask::from_vec(5, 4, of(20, 2.0)).unwrap()),
            confidence: Image::from_vec(5, 4, 1, of(20, 3.0)).unwrap(),
        }
    }

    #[test]
    fn pixels_survive_the_file_to_the_bit() {
        let picture = picture();
        let packed = Packed::new(&picture, 5, 4).unwrap();
        let bytes = packed.to_bytes("somebody").unwrap();
        let (again, about) = Packed::parse(&bytes).unwrap();
        assert!(again == packed && about == "somebody");
        let loaded = again.unpack().unwrap();
        for (a, b) in loaded.radiance.data().iter().zip(picture.radiance.data()) {
            assert!((a - b).abs() <= 5e-4 * b + 1e-6, "{a} {b}");
        }
        for (a, b) in loaded.confidence.data().iter().zip(picture.confidence.data()) {
            assert!((a - b).abs() <= 0.5 / 255.0 + 1e-6);
        }
        let bare = Packed::new(&Picture { mask: None, ..picture }, 5, 4).unwrap();
        assert!(Packed::parse(&bare.to_bytes("").unwrap()).unwrap().0.unpack().unwrap().mask.is_none());
        for cut in [0, 7, bytes.len() / 2, bytes.len() - 1] {
            assert!(Packed::parse(&bytes[..cut]).is_err());
        }
        let mut nan = bytes.clone();
        let last = nan.len();
        // The last tensor is one of bytes; the first values of the data are half floats.
        let data = last - 60 * 2 - 2 * 20;
        nan[data..data + 2].copy_from_slice(&f16::NAN.to_le_bytes());
        assert!(Packed::parse(&nan).unwrap_err().contains("radiance"));
    }

    #[test]
    fn a_source_that_errs_is_told() {
        let wrong = |change: &dyn Fn(&mut Picture)| {
            let mut picture = picture();
            change(&mut picture);
            Packed::new(&picture, 5, 4).unwrap_err()
        };
        assert!(wrong(&|p| p.radiance.data_mut()[7] = f32::NAN).contains("pixel (2, 0)"));
        assert!(wrong(&|p| p.radiance.data_mut()[0] = -0.1).contains("-0.1"));
        assert!(wrong(&|p| p.confidence.data_mut()[3] = 1.5).contains("confidence of pixel (3, 0)"));
        assert!(wrong(&|p| p.radiance = Image::new(4, 5, 3)).contains("4×5"));
        assert!(wrong(&|p| p.mask = Some(Mask::full(2, 2))).contains("mask"));
    }
}
