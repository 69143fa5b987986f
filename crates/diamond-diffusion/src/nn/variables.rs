//! Named weights of a model: made from a seed, taken from a file, or as shapes alone.
//!
//! A model is built once, by code that asks a [`Scope`] for each weight by name and shape. Where the weight comes from is the
//! builder's [`Source`], so that counting the parameters of a large model runs the same code as loading it.
use super::super::error::{DiffusionError, Result};
use crate::noise::Noise;
use candle_core::{DType, Device, Shape, Tensor, Var};
use std::cell::RefCell;
use std::collections::BTreeMap;

/// How a weight begins.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Init {
    /// Zero everywhere.
    Zeros,
    /// One everywhere.
    Ones,
    /// Uniform in ±1/√n for n inputs, as PyTorch's linear layers and convolutions begin.
    FanIn(usize),
}

/// Where weights come from.
#[derive(Debug)]
pub enum Source {
    /// Drawn: each weight has a stream of its own, named after it, so that adding a weight changes no other.
    Seed(u64),
    /// Not at all: each weight is one zero, seen as its shape. For counting and for comparing names; takes no memory.
    Shapes,
    /// By name, from a file. What is missing or left over is listed by [`VariablesBuilder::finish`].
    Tensors(BTreeMap<String, Tensor>),
}

/// A weight.
#[derive(Debug)]
struct Entry {
    shape: Shape,
    /// `None` where frozen or where there is a shape only.
    var: Option<Var>,
    tensor: Tensor,
}

/// Makes the weights of a model.
#[derive(Debug)]
pub struct VariablesBuilder {
    source: Source,
    dtype: DType,
    device: Device,
    trained: bool,
    entries: RefCell<BTreeMap<String, Entry>>,
    missing: RefCell<Vec<String>>,
    misshapen: RefCell<Vec<String>>,
}

/// What did not fit when weights were taken from a file.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LoadReport {
    /// Names that the model has and the file has not.
    pub missing: Vec<String>,
    /// Names that the file has and the model has not.
    pub unexpected: Vec<String>,
    /// Names of both with other shapes: "name: expected …, found …".
    pub misshapen: Vec<String>,
}

impl LoadReport {
    /// Whether everything fits.
    pub fn is_clean(&self) -> bool {
        self.missing.is_empty() && self.unexpected.is_empty() && self.misshapen.is_empty()
    }

    /// An error that names what does not fit, or nothing.
    pub fn into_result(self, origin: &str) -> Result<()> {
        if self.is_clean() {
            return Ok(());
        }
        let list = |what: &str, names: &[String]| match names {
            [] => String::new(),
            _ => {
                let shown: Vec<&str> = names.iter().take(4).map(String::as_str).collect();
                let more = names.len().saturating_sub(shown.len());
                let more = if more > 0 { format!(" and {more} more") } else { String::new() };
                format!("{} {what} ({}{more}); ", names.len(), shown.join(", "))
            }
        };
        let problem = format!(
            "these are not the weights of this model: {}{}{}`diamond models check` lists all",
            list("missing", &self.missing),
            list("unexpected", &self.unexpected),
            list("of another shape", &self.misshapen)
        );
        Err(DiffusionError::Weights { origin: origin.into(), problem })
    }
}

impl VariablesBuilder {
    /// Weights from `source`, to be trained, in `f32` on the CPU.
    pub fn new(source: Source) -> Self {
        Self {
            source,
            dtype: DType::F32,
            device: Device::Cpu,
            trained: true,
            entries: RefCell::default(),
            missing: RefCell::default(),
            misshapen: RefCell::default(),
        }
    }

    /// Computes in another type.
    #[must_use]
    pub fn dtype(self, dtype: DType) -> Self {
        Self { dtype, ..self }
    }

    /// On another device.
    #[must_use]
    pub fn device(self, device: &Device) -> Self {
        Self { device: device.clone(), ..self }
    }

    /// Weights that get no gradients.
    #[must_use]
    pub fn frozen(self) -> Self {
        Self { trained: false, ..self }
    }

    /// The names' root.
    pub fn root(&self) -> Scope<'_> {
        Scope { builder: self, prefix: String::new() }
    }

    /// The weights that were asked for, and what did not fit.
    pub fn finish(self) -> (Variables, LoadReport) {
        let entries = self.entries.into_inner();
        let unexpected = match &self.source {
            Source::Tensors(tensors) => tensors.keys().filter(|name| !entries.contains_key(*name)).cloned().collect(),
            _ => Vec::new(),
        };
        let report =
            LoadReport { missing: self.missing.into_inner(), unexpected, misshapen: self.misshapen.into_inner() };
        (Variables { entries }, report)
    }

    fn make(&self, name: &str, shape: &Shape, init: Init) -> Result<Tensor> {
        let placeholder = || Tensor::zeros((), self.dtype, &self.device)?.broadcast_as(shape);
        Ok(match &self.source {
            Source::Shapes => placeholder()?,
            Source::Seed(seed) => match init {
                Init::Zeros => Tensor::zeros(shape, self.dtype, &self.device)?,
                Init::Ones => Tensor::ones(shape, self.dtype, &self.device)?,
                Init::FanIn(inputs) => {
                    let bound = 1.0 / (inputs.max(1) as f32).sqrt();
                    let values = Noise::new(*seed, name, 0).uniform_tensor(shape, bound, self.dtype)?;
                    values.to_device(&self.device)?
                }
            },
            Source::Tensors(tensors) => match tensors.get(name) {
                None => {
                    self.missing.borrow_mut().push(name.into());
                    placeholder()?
                }
                Some(found) if found.shape() != shape => {
                    let line = format!("{name}: expected {:?}, found {:?}", shape.dims(), found.dims());
                    self.misshapen.borrow_mut().push(line);
                    placeholder()?
                }
                Some(found) => found.to_device(&self.device)?.to_dtype(self.dtype)?,
            },
        })
    }
}

/// A place in the tree of names.
#[derive(Debug, Clone)]
pub struct Scope<'a> {
    builder: &'a VariablesBuilder,
    prefix: String,
}

impl Scope<'_> {
    /// The place `name` below this one; `name` may have dots.
    #[must_use]
    pub fn at(&self, name: impl std::fmt::Display) -> Self {
        let prefix = if self.prefix.is_empty() { name.to_string() } else { format!("{}.{name}", self.prefix) };
        Self { builder: self.builder, prefix }
    }

    /// Where constants that a model needs beside its weights must live.
    pub fn device(&self) -> &Device {
        &self.builder.device
    }

    /// The type of the weights.
    pub fn dtype(&self) -> DType {
        self.builder.dtype
    }

    /// The weight `name` at this place. Asking twice for one weight is an error.
    pub fn weight(&self, name: &str, shape: impl Into<Shape>, init: Init) -> Result<Tensor> {
        let shape = shape.into();
        let name = self.at(name).prefix;
        let tensor = self.builder.make(&name, &shape, init)?;
        let trained = self.builder.trained && !matches!(self.builder.source, Source::Shapes);
        let var = if trained { Some(Var::from_tensor(&tensor)?) } else { None };
        let tensor = var.as_ref().map_or(tensor, |var| var.as_tensor().clone());
        let entry = Entry { shape, var, tensor: tensor.clone() };
        if self.builder.entries.borrow_mut().insert(name.clone(), entry).is_some() {
            let problem = "the model asks for this weight twice; give its parts different names".into();
            return Err(DiffusionError::Weights { origin: name, problem });
        }
        Ok(tensor)
    }
}

/// The weights of a model, in the order of their names.
#[derive(Debug)]
pub struct Variables {
    entries: BTreeMap<String, Entry>,
}

impl Variables {
    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        self.entries.values().map(|entry| entry.shape.elem_count()).sum()
    }

    /// Names and shapes.
    pub fn shapes(&self) -> impl Iterator<Item = (&str, &Shape)> {
        self.entries.iter().map(|(name, entry)| (name.as_str(), &entry.shape))
    }

    /// Weights that are trained.
    pub fn vars(&self) -> impl Iterator<Item = (&str, &Var)> {
        self.entries.iter().filter_map(|(name, entry)| Some((name.as_str(), entry.var.as_ref()?)))
    }

    /// All weights.
    pub fn tensors(&self) -> impl Iterator<Item = (&str, &Tensor)> {
        self.entries.iter().map(|(name, entry)| (name.as_str(), &entry.tensor))
    }

    /// The weight of a name.
    pub fn get(&self, name: &str) -> Option<&Tensor> {
        self.entries.get(name).map(|entry| &entry.tensor)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn three(builder: &VariablesBuilder, order: [usize; 3]) {
        for i in order {
            builder.root().at("block").at(i).weight("weight", (2, 3), Init::FanIn(3)).unwrap();
        }
    }

    #[test]
    fn a_weight_depends_on_its_name_and_not_on_the_order() {
        let built = |order, seed| {
            let builder = VariablesBuilder::new(Source::Seed(seed));
            three(&builder, order);
            let values: Vec<_> = builder.finish().0.tensors().map(|(_, t)| t.to_vec2::<f32>().unwrap()).collect();
            values
        };
        let values = built([0, 1, 2], 4);
        assert_eq!(values, built([2, 0, 1], 4));
        assert_ne!(values, built([0, 1, 2], 5));
        assert_ne!(values[0], values[1]);
        assert!(values.iter().flatten().flatten().all(|v| v.abs() <= 1.0 / 3.0f32.sqrt()));
    }

    #[test]
    fn shapes_take_no_memory_and_are_counted() {
        let builder = VariablesBuilder::new(Source::Shapes);
        let huge = builder.root().weight("weight", (1 << 20, 1 << 20), Init::Zeros).unwrap();
        assert_eq!(huge.dims(), [1 << 20, 1 << 20]);
        assert_eq!(builder.finish().0.parameters(), 1 << 40);
    }

    #[test]
    fn a_file_is_compared_by_name_and_shape() {
        let tensor = |shape: (usize, usize)| Tensor::zeros(shape, DType::F32, &Device::Cpu).unwrap();
        let names = [("block.0.weight", (2, 3)), ("block.1.weight", (3, 2)), ("head.weight", (1, 1))];
        let tensors = names.iter().map(|(name, shape)| (name.to_string(), tensor(*shape))).collect();
        let builder = VariablesBuilder::new(Source::Tensors(tensors));
        three(&builder, [0, 1, 2]);
        let (_, report) = builder.finish();
        assert_eq!(report.missing, ["block.2.weight"]);
        assert_eq!(report.unexpected, ["head.weight"]);
        assert_eq!(report.misshapen, ["block.1.weight: expected [2, 3], found [3, 2]"]);
        let message = report.into_result("model.safetensors").unwrap_err().to_string();
        assert!(message.contains("1 missing (block.2.weight)") && message.contains("head.weight"), "{message}");
    }

    #[test]
    fn a_name_is_given_once() {
        let builder = VariablesBuilder::new(Source::Seed(0));
        builder.root().weight("a", 1, Init::Ones).unwrap();
        assert!(builder.root().weight("a", 1, Init::Ones).is_err());
    }
}
