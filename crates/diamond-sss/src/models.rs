//! Files of network weights: what is in them, whether they fit a model, and the same under our names.
use crate::SssError;
use diamond_diffusion::nn::Variables;
use diamond_diffusion::published::{Comparison, ModelKind, Renamed, compare, converted};
use diamond_diffusion::{DiffusionError, NumberType, WeightsHeader, write_weights};
use diamond_lpips::Network;
use std::fmt::Write;
use std::path::Path;

/// Names that are listed of each kind of misfit.
const LISTED: usize = 20;

/// A model that a file may hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Model {
    Diffusion(ModelKind),
    Lpips(Network),
}

impl Model {
    fn all() -> Vec<(&'static str, Self)> {
        let diffusion = ModelKind::ALL.into_iter().map(|(name, kind)| (name, Self::Diffusion(kind)));
        let lpips = [("lpips-vgg", Self::Lpips(Network::Vgg)), ("lpips-alex", Self::Lpips(Network::Alex))];
        diffusion.chain(lpips).collect()
    }

    fn from_name(name: &str) -> Result<Self, SssError> {
        let all = Self::all();
        all.iter().find(|(known, _)| *known == name).map(|(_, model)| *model).ok_or_else(|| {
            let names: Vec<&str> = all.iter().map(|(name, _)| *name).collect();
            SssError::Usage(format!("--model {name}: expected one of {}", names.join(", ")))
        })
    }

    fn shapes(self) -> Result<Variables, DiffusionError> {
        match self {
            Self::Diffusion(kind) => kind.shapes(),
            Self::Lpips(network) => network.shapes(),
        }
    }

    fn rename(self, name: &str) -> Renamed {
        match self {
            Self::Diffusion(kind) => kind.rename(name),
            Self::Lpips(network) => network.rename(name),
        }
    }

    fn compare(self, header: &WeightsHeader) -> Result<Comparison, DiffusionError> {
        Ok(compare(header, &self.shapes()?, |name| self.rename(name)))
    }
}

fn at(path: &Path) -> impl Fn(DiffusionError) -> SssError + '_ {
    move |error| {
        // The library says the path first; the program's errors do too.
        let text = error.to_string();
        let detail = text.strip_prefix(&format!("{}: ", path.display())).unwrap_or(&text).to_owned();
        SssError::Input { path: path.to_owned(), detail }
    }
}

/// What a file holds, and which models it fits.
pub fn inspect_weights(path: &Path) -> Result<String, SssError> {
    let header = WeightsHeader::read(path).map_err(at(path))?;
    let mut text =
        format!("{}: {} tensors, {} parameters\n", path.display(), header.tensors.len(), header.parameters());
    for (key, value) in &header.metadata {
        let shown: String = value.chars().take(200).collect();
        let _ = writeln!(text, "{key}: {shown}");
    }
    let _ = writeln!(text, "\n{:<18} {:>8} {:>8} {:>10} {:>9}", "model", "fit", "missing", "unexpected", "misshapen");
    for (name, model) in Model::all() {
        let found = model.compare(&header).map_err(at(path))?;
        let r = &found.report;
        let verdict = if r.is_clean() { "  fits" } else { "" };
        let _ = writeln!(
            text,
            "{name:<18} {:>8} {:>8} {:>10} {:>9}{verdict}",
            found.matched,
            r.missing.len(),
            r.unexpected.len(),
            r.misshapen.len()
        );
    }
    Ok(text)
}

/// Compares a file with a model; one that does not fit is an error that lists what does not.
pub fn check_weights(path: &Path, model: &str) -> Result<String, SssError> {
    let kind = Model::from_name(model)?;
    let header = WeightsHeader::read(path).map_err(at(path))?;
    let found = kind.compare(&header).map_err(at(path))?;
    let summary = format!(
        "{} weights fit, {} of them under other names, {} tensors belong to other models",
        found.matched, found.renamed, found.elsewhere
    );
    if found.report.is_clean() {
        return Ok(format!("{}: a {model}; {summary}\n", path.display()));
    }
    let mut detail = format!("no {model}: {summary}");
    let lists = [
        ("missing", &found.report.missing),
        ("unexpected", &found.report.unexpected),
        ("other shape", &found.report.misshapen),
    ];
    for (what, names) in lists {
        for name in names.iter().take(LISTED) {
            let _ = write!(detail, "\n  {what}: {name}");
        }
        if names.len() > LISTED {
            let _ = write!(detail, "\n  {what}: {} more", names.len() - LISTED);
        }
    }
    Err(SssError::Input { path: path.to_owned(), detail })
}

/// Writes the weights of a model that a file holds, under our names.
pub fn convert_weights(path: &Path, output: &Path, model: &str, numbers: &str) -> Result<String, SssError> {
    let kind = Model::from_name(model)?;
    let number = match numbers {
        "f32" => NumberType::F32,
        "f16" => NumberType::F16,
        "bf16" => NumberType::Bf16,
        other => return Err(SssError::Usage(format!("--numbers {other}: expected f32, f16 or bf16"))),
    };
    let shapes = kind.shapes().map_err(at(path))?;
    let tensors = converted(path, &shapes, |name| kind.rename(name)).map_err(at(path))?;
    let count = tensors.len();
    let named = tensors.iter().map(|(name, tensor)| (name.as_str(), tensor));
    write_weights(output, named, number, model).map_err(at(output))?;
    Ok(format!("written: {} ({model}, {count} tensors, {numbers})\n", output.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_inspected_checked_and_converted() {
        let folder = std::env::temp_dir().join(format!("diamond-models-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let (path, output) = (folder.join("theirs.safetensors"), folder.join("ours.safetensors"));
        let shapes = Network::Alex.shapes().unwrap();
        let theirs: Vec<(String, _)> = shapes
            .tensors()
            .map(|(name, tensor)| {
                (
                    name.replace(".weight", if name.starts_with("lin") { ".model.1.weight" } else { ".weight" }),
                    tensor.contiguous().unwrap(),
                )
            })
            .collect();
        let named = || theirs.iter().map(|(name, tensor)| (name.as_str(), tensor));
        write_weights(&path, named(), NumberType::F32, "zeros").unwrap();
        let text = inspect_weights(&path).unwrap();
        assert!(text.contains("15 tensors, 2470848 parameters") && text.contains("note: zeros"), "{text}");
        let line = |text: &str, name: &str| text.lines().find(|line| line.starts_with(name)).unwrap().to_owned();
        assert!(line(&text, "lpips-alex").ends_with("fits") && !line(&text, "lpips-vgg").ends_with("fits"), "{text}");
        let said = check_weights(&path, "lpips-alex").unwrap();
        assert!(said.contains("15 weights fit, 5 of them under other names"), "{said}");
        let error = check_weights(&path, "sd-vae").unwrap_err();
        assert!(error.exit_code() == 3 && error.to_string().contains("missing: decoder.conv_in.bias"), "{error}");
        assert!(convert_weights(&path, &output, "sd-vae", "f16").unwrap_err().to_string().contains("not the weights"));
        assert!(!output.exists());
        convert_weights(&path, &output, "lpips-alex", "f16").unwrap();
        assert!(check_weights(&output, "lpips-alex").unwrap().contains("0 of them under other names"));
        assert!(diamond_lpips::Lpips::load(Network::Alex, &output).is_ok());
        for wrong in [check_weights(&path, "gpt"), convert_weights(&path, &output, "sd-vae", "f8")] {
            assert_eq!(wrong.unwrap_err().exit_code(), 2);
        }
        assert!(inspect_weights(&folder.join("none")).unwrap_err().to_string().contains("cannot be read"));
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
