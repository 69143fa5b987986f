//! A small dense network evaluated on a batch of rows, and its gradient.
//!
//! Layer l maps x ↦ σ(W·x + b); every layer but the last uses the hidden activation, the last one the output activation.
//! A row is one evaluation (one Gaussian under one light). The batch is cut into fixed chunks of [`CHUNK_ROWS`] rows that
//! go through all layers while their activations sit in the first two caches. Nothing but the inputs is kept for the
//! backward pass: it recomputes a chunk's activations (a quarter of its work, cheaper than moving them through memory),
//! walks back through the layers, and sums weight gradients chunk by chunk into at most [`GRADIENT_GROUPS`] partial sums,
//! which are added in order. Chunks and groups depend on the batch alone: same bits on any number of threads.
//!
//! Parameters are one flat vector, per layer the weights `[outputs × inputs]` row-major and then the bias `[outputs]`,
//! which is how an optimiser and a checkpoint want them.
//!
//! ```
//! use diamond_shading::{Activation, Mlp, MlpShape};
//! let shape = MlpShape { widths: vec![2, 8, 1], hidden: Activation::Relu, output: Activation::Linear };
//! let mut state = 1u32; // any uniform generator of the caller's
//! let mut uniform = || { state = state.wrapping_mul(1664525).wrapping_add(1013904223); (state >> 8) as f32 / 16777216.0 };
//! let mlp = Mlp::initialise(shape, false, &mut uniform)?;
//! let (outputs, pullback) = mlp.forward(&[0.1, 0.2, 0.3, 0.4], 2)?;
//! let grad = pullback.pull(&[1.0, 1.0], true)?;
//! assert_eq!((outputs.len(), grad.parameters.len()), (2, mlp.parameters.len()));
//! # Ok::<(), diamond_shading::ShadingError>(())
//! ```
use crate::error::{ShadingError, check_length};
use crate::mlp_chunk::{ChunkNetwork, sum_in_order};
use crate::row_chunks::{map_chunks, map_chunks_mut, with_scratch};

/// Rows that pass through all layers together: a multiple of the kernel's 6 rows; at 64 wide 24 kB per layer.
pub const CHUNK_ROWS: usize = 96;

/// Weight-gradient partial sums of one pass, whatever the batch and the number of threads: bounds the memory to this many
/// copies of the parameters.
pub const GRADIENT_GROUPS: usize = 16;

/// The nonlinearity σ after a layer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Activation {
    /// σ(x) = x.
    Linear,
    /// σ(x) = max(x, 0); σ′(0) = 0.
    Relu,
    /// σ(x) = x for x > 0, slope·x otherwise; σ′(0) = slope. The slope is ≥ 0 and finite.
    LeakyRelu(f32),
    /// σ(x) = 1 / (1 + e^−x).
    Sigmoid,
}

/// Widths and activations of an [`Mlp`].
#[derive(Debug, Clone, PartialEq)]
pub struct MlpShape {
    /// Number of values at the input, after each hidden layer, and at the output: at least two, each at least 1.
    pub widths: Vec<usize>,
    /// Activation of every layer but the last.
    pub hidden: Activation,
    /// Activation of the last layer.
    pub output: Activation,
}

impl MlpShape {
    /// `Ok` if there are at least two widths, none is 0, and a leaky slope is finite and not negative.
    pub fn check(&self) -> Result<(), ShadingError> {
        if self.widths.len() < 2 || self.widths.contains(&0) {
            return Err(ShadingError::Setting {
                what: "MlpShape::widths",
                expected: "at least an input and an output width, each ≥ 1".into(),
                found: format!("{:?}", self.widths),
            });
        }
        for (what, activation) in [("MlpShape::hidden", self.hidden), ("MlpShape::output", self.output)] {
            if let Activation::LeakyRelu(slope) = activation
                && !(0.0..=1e6).contains(&slope)
            {
                return Err(ShadingError::Setting {
                    what,
                    expected: "a leaky slope in [0, 1e6]".into(),
                    found: format!("{slope}"),
                });
            }
        }
        Ok(())
    }

    /// Number of input values per row (0 if there are no widths).
    pub fn inputs(&self) -> usize {
        self.widths.first().copied().unwrap_or(0)
    }

    /// Number of output values per row (0 if there are no widths).
    pub fn outputs(&self) -> usize {
        self.widths.last().copied().unwrap_or(0)
    }

    /// Number of layers: one less than the widths.
    pub fn layers(&self) -> usize {
        self.widths.len().saturating_sub(1)
    }

    /// Number of weights and biases: Σ outputs·(inputs + 1).
    pub fn parameter_count(&self) -> usize {
        self.widths.windows(2).map(|w| w[1] * (w[0] + 1)).sum()
    }

    /// Where layer `layer`'s weights begin in the flat parameters; its bias follows its `outputs × inputs` weights.
    pub fn layer_offset(&self, layer: usize) -> usize {
        self.widths.windows(2).take(layer).map(|w| w[1] * (w[0] + 1)).sum()
    }

    /// The activation after layer `layer`.
    pub fn activation(&self, layer: usize) -> Activation {
        if layer + 1 == self.layers() { self.output } else { self.hidden }
    }
}

/// A dense network: its shape and its parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Mlp {
    /// Widths and activations.
    pub shape: MlpShape,
    /// Per layer the weights `[outputs × inputs]` row-major, then the bias `[outputs]`. Magnitudes above 1e12 act as 1e12.
    pub parameters: Vec<f32>,
}

/// The gradient of a scalar with respect to an [`Mlp`]'s parameters and, if asked for, its inputs.
#[derive(Debug, Clone, PartialEq)]
pub struct MlpGrad {
    /// As [`Mlp::parameters`].
    pub parameters: Vec<f32>,
    /// `[batch × inputs]`, row-major, if asked for.
    pub inputs: Option<Vec<f32>>,
}

/// The reverse of one [`Mlp::forward`].
#[derive(Debug)]
pub struct MlpPullback<'a> {
    mlp: &'a Mlp,
    inputs: &'a [f32],
    batch: usize,
}

impl Mlp {
    /// A network whose weights and biases are uniform in ±1/√inputs of their layer (the usual default for dense layers,
    /// a Kaiming uniform with gain √⅓), drawn in the order of [`Mlp::parameters`] from `uniform`, which returns values
    /// in [0, 1). `zero_last_layer` sets the last layer to 0 without drawing, so that the network starts as a constant.
    pub fn initialise(
        shape: MlpShape,
        zero_last_layer: bool,
        uniform: &mut dyn FnMut() -> f32,
    ) -> Result<Self, ShadingError> {
        shape.check()?;
        let mut parameters = Vec::with_capacity(shape.parameter_count());
        for (layer, w) in shape.widths.windows(2).enumerate() {
            let bound = 1.0 / (w[0] as f32).sqrt();
            let zero = zero_last_layer && layer + 1 == shape.layers();
            parameters.extend((0..w[1] * (w[0] + 1)).map(|_| if zero { 0.0 } else { bound * (2.0 * uniform() - 1.0) }));
        }
        Ok(Self { shape, parameters })
    }

    /// The outputs `[batch × outputs]` for `inputs` `[batch × inputs]` (both row-major), and the pullback.
    ///
    /// Values saturate at ±1e12 in every layer, so any finite input gives finite outputs.
    /// Errors: [`ShadingError::Shape`] if `inputs` or the parameters have the wrong length, [`ShadingError::Setting`] as
    /// in [`MlpShape::check`].
    /// `[eq:mlp]`
    pub fn forward<'a>(&'a self, inputs: &'a [f32], batch: usize) -> Result<(Vec<f32>, MlpPullback<'a>), ShadingError> {
        self.check()?;
        let (width, out) = (self.shape.inputs(), self.shape.outputs());
        check_length("inputs of Mlp::forward (batch × inputs)", batch.saturating_mul(width), inputs.len())?;
        let network = ChunkNetwork::new(self);
        let mut outputs = vec![0.0; batch * out];
        map_chunks_mut(&mut outputs, CHUNK_ROWS * out, |chunk, outputs| {
            let rows = outputs.len() / out;
            with_scratch(network.block_length(rows), |block| {
                network.load(&inputs[chunk * CHUNK_ROWS * width..][..rows * width], rows, block);
                network.forward(rows, block);
                network.store_outputs(rows, block, outputs);
            });
        });
        Ok((outputs, MlpPullback { mlp: self, inputs, batch }))
    }

    /// `Ok` if the shape is valid and the parameters have its length.
    pub fn check(&self) -> Result<(), ShadingError> {
        self.shape.check()?;
        check_length("Mlp::parameters", self.shape.parameter_count(), self.parameters.len())
    }
}

impl MlpPullback<'_> {
    /// Pulls `d_outputs` `[batch × outputs]` back to the parameters and, if `input_gradient`, to the inputs (which costs a
    /// further product with the first layer).
    ///
    /// Cotangents saturate at ±1e12 in every layer; where a forward value saturated, its slope is taken as if it had not.
    /// Errors: [`ShadingError::Shape`] if `d_outputs` has the wrong length.
    /// `[eq:mlp]`
    pub fn pull(&self, d_outputs: &[f32], input_gradient: bool) -> Result<MlpGrad, ShadingError> {
        let (width, out) = (self.mlp.shape.inputs(), self.mlp.shape.outputs());
        check_length("d_outputs of MlpPullback::pull (batch × outputs)", self.batch * out, d_outputs.len())?;
        let network = ChunkNetwork::new(self.mlp);
        let groups = Groups::of(self.batch);
        let pull_group = |group: usize, d_inputs: &mut [f32]| {
            let mut partial = vec![0.0; network.gradient_length()];
            let lengths = (network.block_length(CHUNK_ROWS), network.cotangent_length());
            with_scratch(lengths.0 + 2 * lengths.1, |scratch| {
                let (block, d) = scratch.split_at_mut(lengths.0);
                let (d, spare) = d.split_at_mut(lengths.1);
                for (start, rows) in groups.chunks(group) {
                    network.load(&self.inputs[start * width..][..rows * width], rows, block);
                    network.forward(rows, block);
                    network.load_cotangent(&d_outputs[start * out..][..rows * out], rows, d);
                    let d_x = network.pull(rows, block, (&mut *d, &mut *spare), &mut partial, input_gradient);
                    if input_gradient {
                        let first = groups.first_row(group);
                        network.store_inputs(rows, d_x, &mut d_inputs[(start - first) * width..][..rows * width]);
                    }
                }
            });
            partial
        };
        let mut inputs = input_gradient.then(|| vec![0.0; self.batch * width]);
        let partials = match &mut inputs {
            Some(inputs) => map_chunks_mut(inputs, groups.rows * width, pull_group),
            None => map_chunks(groups.count, |group| pull_group(group, &mut [])),
        };
        Ok(MlpGrad { parameters: network.unpad_gradient(&sum_in_order(partials, network.gradient_length())), inputs })
    }
}

/// A batch cut into groups of whole chunks.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Groups {
    batch: usize,
    /// Rows of every group but the last.
    pub(crate) rows: usize,
    pub(crate) count: usize,
}

impl Groups {
    /// At most [`GRADIENT_GROUPS`] groups of `batch` rows.
    pub(crate) fn of(batch: usize) -> Self {
        let rows = batch.div_ceil(CHUNK_ROWS).div_ceil(GRADIENT_GROUPS).max(1) * CHUNK_ROWS;
        Self { batch, rows, count: batch.div_ceil(rows) }
    }

    pub(crate) fn first_row(&self, group: usize) -> usize {
        group * self.rows
    }

    /// First row and number of rows of each chunk of `group`.
    pub(crate) fn chunks(&self, group: usize) -> impl Iterator<Item = (usize, usize)> {
        let end = (self.first_row(group) + self.rows).min(self.batch);
        (self.first_row(group)..end).step_by(CHUNK_ROWS).map(move |start| (start, CHUNK_ROWS.min(end - start)))
    }
}
