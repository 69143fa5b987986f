//! A file against a model: what is missing, left over, or of another shape, from headers alone; and the file in our names.
use crate::error::{DiffusionError, Result};
use crate::nn::{LoadReport, Variables};
use crate::weights::{NumberType, WeightsHeader, read_weights};
use candle_core::Tensor;
use std::collections::BTreeMap;
use std::path::Path;

/// What a published name is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Renamed {
    /// A weight of the model by our name, or a name that nobody knows as it is.
    As(String),
    /// A part of another model in the same file.
    Elsewhere,
}

/// A file against a model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Comparison {
    /// What does not fit.
    pub report: LoadReport,
    /// Weights that fit.
    pub matched: usize,
    /// Of these, how many have another name in the file.
    pub renamed: usize,
    /// Tensors of other models in the same file.
    pub elsewhere: usize,
}

/// Whether shapes are the same but for a 1 × 1 kernel at the end of one of them.
fn same_but_for_kernel(a: &[usize], b: &[usize]) -> bool {
    let bare = |shape: &[usize]| match shape {
        [out, inputs, 1, 1] => vec![*out, *inputs],
        other => other.to_vec(),
    };
    bare(a) == bare(b)
}

/// Compares names and shapes; no tensor is read.
pub fn compare(header: &WeightsHeader, model: &Variables, rename: impl Fn(&str) -> Renamed) -> Comparison {
    let expected: BTreeMap<&str, &[usize]> = model.shapes().map(|(name, shape)| (name, shape.dims())).collect();
    let mut missing: BTreeMap<&str, ()> = expected.keys().map(|name| (*name, ())).collect();
    let mut found = Comparison { report: LoadReport::default(), matched: 0, renamed: 0, elsewhere: 0 };
    for (name, stored) in &header.tensors {
        let ours = match rename(name) {
            _ if matches!(stored.number, NumberType::Other(_)) => {
                found.elsewhere += 1;
                continue;
            }
            Renamed::Elsewhere => {
                found.elsewhere += 1;
                continue;
            }
            Renamed::As(ours) => ours,
        };
        let Some((known, shape)) = expected.get_key_value(ours.as_str()) else {
            found.report.unexpected.push(name.clone());
            continue;
        };
        if missing.remove(known).is_none() {
            found.report.unexpected.push(format!("{name} (a second {ours})"));
        } else if !same_but_for_kernel(shape, &stored.shape) {
            found.report.misshapen.push(format!("{name}: expected {shape:?}, found {:?}", stored.shape));
        } else {
            found.matched += 1;
            found.renamed += usize::from(ours != *name);
        }
    }
    found.report.missing = missing.into_keys().map(str::to_owned).collect();
    found
}

/// The tensors of a file by our names and in our shapes. A file that does not fit is an error that says how.
pub fn converted(path: &Path, model: &Variables, rename: impl Fn(&str) -> Renamed) -> Result<BTreeMap<String, Tensor>> {
    let origin = path.display().to_string();
    compare(&WeightsHeader::read(path)?, model, &rename).report.into_result(&origin)?;
    let mut tensors = BTreeMap::new();
    for (name, tensor) in read_weights(path)? {
        let Renamed::As(ours) = rename(&name) else { continue };
        let wanted = model.get(&ours).ok_or_else(|| DiffusionError::Weights {
            origin: origin.clone(),
            problem: format!("{name}: the file changed while it was read"),
        })?;
        tensors.insert(ours, tensor.reshape(wanted.shape())?);
    }
    Ok(tensors)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{Init, Source, VariablesBuilder};
    use crate::published::ModelKind;
    use crate::weights::write_weights;
    use candle_core::Device;

    /// A header of made-up offsets.
    fn header(shapes: &[(&str, &[usize])]) -> WeightsHeader {
        let folder = std::env::temp_dir().join(format!("diamond-header-{}-{}", shapes.len(), std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("a.safetensors");
        let tensors: Vec<(&str, Tensor)> = shapes
            .iter()
            .map(|(name, shape)| (*name, Tensor::zeros(*shape, candle_core::DType::F32, &Device::Cpu).unwrap()))
            .collect();
        write_weights(&path, tensors.iter().map(|(n, t)| (*n, t)), NumberType::F16, "").unwrap();
        let header = WeightsHeader::read(&path).unwrap();
        std::fs::remove_dir_all(&folder).unwrap();
        header
    }

    fn small() -> Variables {
        let builder = VariablesBuilder::new(Source::Shapes);
        builder.root().at("encoder.mid_block.attentions.0.to_q").weight("weight", (4, 4), Init::Zeros).unwrap();
        builder.root().at("quant_conv").weight("weight", (2, 2, 1, 1), Init::Zeros).unwrap();
        builder.root().at("post_quant_conv").weight("weight", (2, 2, 1, 1), Init::Zeros).unwrap();
        builder.finish().0
    }

    #[test]
    fn what_does_not_fit_is_listed() {
        let header = header(&[
            ("first_stage_model.encoder.mid.attn_1.q.weight", &[4, 4, 1, 1]),
            ("first_stage_model.quant_conv.weight", &[3, 2, 1, 1]),
            ("first_stage_model.surprise", &[1]),
            ("model.diffusion_model.out.2.bias", &[4]),
        ]);
        let comparison = compare(&header, &small(), |name| ModelKind::Vae.rename(name));
        assert_eq!((comparison.matched, comparison.renamed, comparison.elsewhere), (1, 1, 1));
        assert_eq!(comparison.report.missing, ["post_quant_conv.weight"]);
        assert_eq!(comparison.report.unexpected, ["first_stage_model.surprise"]);
        assert_eq!(
            comparison.report.misshapen,
            ["first_stage_model.quant_conv.weight: expected [2, 2, 1, 1], found [3, 2, 1, 1]"]
        );
    }

    #[test]
    fn a_file_is_converted_with_its_values() {
        let folder = std::env::temp_dir().join(format!("diamond-converted-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("vae.safetensors");
        let values: Vec<f32> = (0..16).map(|v| v as f32).collect();
        let q = Tensor::from_vec(values.clone(), (4, 4, 1, 1), &Device::Cpu).unwrap();
        let two = Tensor::ones((2, 2, 1, 1), candle_core::DType::F32, &Device::Cpu).unwrap();
        let mut tensors = vec![
            ("first_stage_model.encoder.mid.attn_1.q.weight", &q),
            ("first_stage_model.quant_conv.weight", &two),
            ("model.diffusion_model.out.2.bias", &two),
        ];
        write_weights(&path, tensors.clone(), NumberType::F32, "").unwrap();
        let rename = |name: &str| ModelKind::Vae.rename(name);
        let error = converted(&path, &small(), rename).unwrap_err().to_string();
        assert!(error.contains("1 missing (post_quant_conv.weight)"), "{error}");
        tensors.push(("first_stage_model.post_quant_conv.weight", &two));
        write_weights(&path, tensors, NumberType::F32, "").unwrap();
        let converted = converted(&path, &small(), rename).unwrap();
        assert_eq!(converted.len(), 3);
        let q = &converted["encoder.mid_block.attentions.0.to_q.weight"];
        assert_eq!((q.dims(), q.flatten_all().unwrap().to_vec1::<f32>().unwrap()), (&[4usize, 4][..], values));
        std::fs::remove_dir_all(&folder).unwrap();
    }

    /// All names of our models stay what they are, so that files in our own layout are read as they are.
    #[test]
    fn our_own_names_stay() {
        for (name, kind) in ModelKind::ALL {
            for (weight, _) in kind.shapes().unwrap().shapes() {
                assert_eq!(kind.rename(weight), Renamed::As(weight.into()), "{name}");
            }
        }
    }
}
