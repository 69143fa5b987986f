//! The subsurface residual: what a small network says a Gaussian adds to its surface shading under one light.
//!
//! A trunk turns the inputs of a row (see [`ResidualInputs`](crate::ResidualInputs)) into features; one head turns them
//! into a residual colour, and an optional second head into the incident light, which stands for the unknown intensity
//! and falloff of the light. Both heads' gradients reach the trunk. A chunk of rows goes through the trunk and the heads
//! without leaving the cache, forward and backward.
use crate::encoding::RESIDUAL_INPUTS;
use crate::error::{ShadingError, check_length};
use crate::mlp::{Activation, CHUNK_ROWS, Groups, Mlp, MlpShape};
use crate::mlp_chunk::{ChunkNetwork, sum_in_order};
use crate::row_chunks::{map_chunks, map_chunks_mut, with_scratch};

/// Widths and activations of a [`ResidualNetwork`].
#[derive(Debug, Clone, PartialEq)]
pub struct ResidualNetworkConfig {
    /// K, the size of the learned code of each Gaussian; the network has 42 + K inputs.
    pub code_size: usize,
    /// Widths after the inputs; the last is the number of features.
    pub trunk: Vec<usize>,
    /// Activation after every trunk layer and after hidden layers of the heads.
    pub hidden: Activation,
    /// Hidden widths of the residual head (empty: one layer, features → 3).
    pub residual_head: Vec<usize>,
    /// Activation of the residual.
    pub residual_output: Activation,
    /// Start with a zero last layer of the residual head: a constant residual, ½ after a sigmoid.
    pub zero_residual: bool,
    /// Hidden widths of the incident-light head; `None` for no such head.
    pub incident_head: Option<Vec<usize>>,
    /// Activation of the incident light.
    pub incident_output: Activation,
    /// Added to the initial bias of the incident light. With a ReLU and 0, half of all starts are dark everywhere
    /// and then have no gradient; 1 starts near an intensity of 1.
    pub incident_bias: f32,
}

impl ResidualNetworkConfig {
    /// 42→64→32→32 with leaky ReLU 0.01; residual 32→3 sigmoid; incident light 32→32→1 ReLU.
    pub fn sss_3dgs() -> Self {
        Self {
            code_size: 0,
            trunk: vec![64, 32, 32],
            hidden: Activation::LeakyRelu(0.01),
            residual_head: vec![],
            residual_output: Activation::Sigmoid,
            zero_residual: false,
            incident_head: Some(vec![32]),
            incident_output: Activation::Relu,
            incident_bias: 0.0,
        }
    }

    /// Four layers of 64 with ReLU; residual 64→3 sigmoid; no incident light.
    pub fn paper() -> Self {
        Self { trunk: vec![64; 4], hidden: Activation::Relu, incident_head: None, ..Self::sss_3dgs() }
    }

    /// Inputs per row: 42 + K.
    pub fn inputs(&self) -> usize {
        RESIDUAL_INPUTS + self.code_size
    }
}

/// The network's parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct ResidualNetwork {
    /// Inputs → features.
    pub trunk: Mlp,
    /// Features → RGB residual.
    pub residual_head: Mlp,
    /// Features → scalar incident light.
    pub incident_head: Option<Mlp>,
}

/// The network's values on a batch.
#[derive(Debug, Clone, PartialEq)]
pub struct ResidualOutput {
    /// `[batch × 3]`, linear RGB.
    pub residual: Vec<f32>,
    /// `[batch]`; empty if there is no incident-light head.
    pub incident: Vec<f32>,
}

/// The gradient of a [`ResidualNetwork`], flat like [`Mlp::parameters`].
#[derive(Debug, Clone, PartialEq)]
pub struct ResidualNetworkGrad {
    /// Of the trunk's parameters.
    pub trunk: Vec<f32>,
    /// Of the residual head's parameters.
    pub residual_head: Vec<f32>,
    /// Of the incident-light head's parameters, if there is one.
    pub incident_head: Option<Vec<f32>>,
    /// Of the inputs, `[batch × inputs]`, if asked for.
    pub inputs: Option<Vec<f32>>,
}

/// The reverse of one [`ResidualNetwork::forward`].
#[derive(Debug)]
pub struct ResidualPullback<'a> {
    network: &'a ResidualNetwork,
    inputs: &'a [f32],
    batch: usize,
}

fn head(features: usize, hidden: &[usize], outputs: usize, activations: (Activation, Activation)) -> MlpShape {
    let widths = [&[features], hidden, &[outputs]].concat();
    MlpShape { widths, hidden: activations.0, output: activations.1 }
}

impl ResidualNetwork {
    /// A network initialised as [`Mlp::initialise`] does, in the order trunk, residual head, incident head, from
    /// uniform numbers in [0, 1).
    pub fn initialise(config: &ResidualNetworkConfig, uniform: &mut dyn FnMut() -> f32) -> Result<Self, ShadingError> {
        let widths = [&[config.inputs()], config.trunk.as_slice()].concat();
        let shape = MlpShape { widths, hidden: config.hidden, output: config.hidden };
        let features = shape.outputs();
        let trunk = Mlp::initialise(shape, false, uniform)?;
        let shape = head(features, &config.residual_head, 3, (config.hidden, config.residual_output));
        let residual_head = Mlp::initialise(shape, config.zero_residual, uniform)?;
        let incident_head = match &config.incident_head {
            None => None,
            Some(hidden) => {
                let shape = head(features, hidden, 1, (config.hidden, config.incident_output));
                let mut mlp = Mlp::initialise(shape, false, uniform)?;
                // The last parameter is the bias of the only output.
                if let Some(bias) = mlp.parameters.last_mut() {
                    *bias += config.incident_bias;
                }
                Some(mlp)
            }
        };
        Ok(Self { trunk, residual_head, incident_head })
    }

    /// Inputs per row.
    pub fn inputs(&self) -> usize {
        self.trunk.shape.inputs()
    }

    /// `Ok` if the three networks are valid and fit together.
    pub fn check(&self) -> Result<(), ShadingError> {
        self.trunk.check()?;
        let features = self.trunk.shape.outputs();
        let heads = [("ResidualNetwork::residual_head", Some(&self.residual_head), 3)];
        for (what, mlp, outputs) in
            heads.into_iter().chain([("ResidualNetwork::incident_head", self.incident_head.as_ref(), 1)])
        {
            let Some(mlp) = mlp else { continue };
            mlp.check()?;
            if mlp.shape.inputs() != features || mlp.shape.outputs() != outputs {
                return Err(ShadingError::Shape {
                    what,
                    expected: format!("a network {features} → {outputs}"),
                    found: format!("{} → {}", mlp.shape.inputs(), mlp.shape.outputs()),
                });
            }
        }
        Ok(())
    }

    /// Residual and incident light of `batch` rows of `inputs` `[batch × inputs]`, and the pullback.
    ///
    /// Values saturate at ±1e12 in every layer. Errors: [`ShadingError::Shape`] if `inputs` has the wrong length or the
    /// networks do not fit together, [`ShadingError::Setting`] as in [`MlpShape::check`].
    /// `[eq:residual-network]`
    pub fn forward<'a>(
        &'a self,
        inputs: &'a [f32],
        batch: usize,
    ) -> Result<(ResidualOutput, ResidualPullback<'a>), ShadingError> {
        self.check()?;
        let width = self.inputs();
        check_length("inputs of ResidualNetwork::forward (batch × inputs)", batch.saturating_mul(width), inputs.len())?;
        let output = evaluate(self, inputs, batch);
        Ok((output, ResidualPullback { network: self, inputs, batch }))
    }
}

/// The values of a checked network.
fn evaluate(network: &ResidualNetwork, inputs: &[f32], batch: usize) -> ResidualOutput {
    let width = network.inputs();
    let networks = Networks::new(network);
    let mut residual = vec![0.0; 3 * batch];
    let incident = map_chunks_mut(&mut residual, 3 * CHUNK_ROWS, |chunk, residual| {
        let rows = residual.len() / 3;
        with_scratch(networks.block_length(rows), |blocks| {
            let inputs = &inputs[chunk * CHUNK_ROWS * width..][..rows * width];
            networks.forward(inputs, rows, blocks);
            let (_, blocks) = blocks.split_at_mut(networks.trunk.block_length(rows));
            let (residual_block, incident_block) = blocks.split_at_mut(networks.residual_head.block_length(rows));
            networks.residual_head.store_outputs(rows, residual_block, residual);
            let mut incident = Vec::new();
            if let Some(head) = &networks.incident_head {
                incident.resize(rows, 0.0);
                head.store_outputs(rows, incident_block, &mut incident);
            }
            incident
        })
    });
    ResidualOutput { residual, incident: incident.concat() }
}

impl ResidualNetwork {
    /// The pullback of [`ResidualNetwork::forward`] at `inputs` `[batch × inputs]` without its values: for a part of the
    /// rows of a batch whose values are known already.
    ///
    /// Errors: as [`ResidualNetwork::forward`].
    /// `[eq:residual-network]`
    pub fn pullback<'a>(&'a self, inputs: &'a [f32], batch: usize) -> Result<ResidualPullback<'a>, ShadingError> {
        self.check()?;
        let expected = batch.saturating_mul(self.inputs());
        check_length("inputs of ResidualNetwork::pullback (batch × inputs)", expected, inputs.len())?;
        Ok(ResidualPullback { network: self, inputs, batch })
    }
}

/// The three networks ready for chunks; their blocks of memory follow one another.
struct Networks<'a> {
    trunk: ChunkNetwork<'a>,
    residual_head: ChunkNetwork<'a>,
    incident_head: Option<ChunkNetwork<'a>>,
}

impl<'a> Networks<'a> {
    fn new(network: &'a ResidualNetwork) -> Self {
        Self {
            trunk: ChunkNetwork::new(&network.trunk),
            residual_head: ChunkNetwork::new(&network.residual_head),
            incident_head: network.incident_head.as_ref().map(ChunkNetwork::new),
        }
    }

    fn each(&self) -> impl Iterator<Item = &ChunkNetwork<'a>> {
        [&self.trunk, &self.residual_head].into_iter().chain(&self.incident_head)
    }

    fn block_length(&self, rows: usize) -> usize {
        self.each().map(|n| n.block_length(rows)).sum()
    }

    fn forward(&self, inputs: &[f32], rows: usize, blocks: &mut [f32]) {
        let (block, mut blocks) = blocks.split_at_mut(self.trunk.block_length(rows));
        self.trunk.load(inputs, rows, block);
        self.trunk.forward(rows, block);
        let features = self.trunk.padded_outputs(rows, block);
        for head in self.each().skip(1) {
            let (block, rest) = blocks.split_at_mut(head.block_length(rows));
            head.load_padded(features, block);
            head.forward(rows, block);
            blocks = rest;
        }
    }
}

impl ResidualPullback<'_> {
    /// Pulls `d_residual` `[batch × 3]` and `d_incident` (`[batch]`, or empty for zero) back to all parameters and, if
    /// `input_gradient`, to the inputs, codes included.
    ///
    /// Cotangents saturate at ±1e12 in every layer. Errors: [`ShadingError::Shape`] if a cotangent has the wrong length;
    /// without an incident-light head `d_incident` must be empty.
    /// `[eq:residual-network]`
    pub fn pull(
        &self,
        d_residual: &[f32],
        d_incident: &[f32],
        input_gradient: bool,
    ) -> Result<ResidualNetworkGrad, ShadingError> {
        check_length("d_residual of ResidualPullback::pull (batch × 3)", 3 * self.batch, d_residual.len())?;
        if !d_incident.is_empty() {
            let expected = if self.network.incident_head.is_some() { self.batch } else { 0 };
            check_length("d_incident of ResidualPullback::pull (batch)", expected, d_incident.len())?;
        }
        let networks = Networks::new(self.network);
        let width = self.network.inputs();
        let groups = Groups::of(self.batch);
        let pull_group = |group: usize, d_inputs: &mut [f32]| {
            let mut partial = vec![0.0; networks.each().map(ChunkNetwork::gradient_length).sum()];
            let block_length = networks.block_length(CHUNK_ROWS);
            let cotangent_length = networks.each().map(ChunkNetwork::cotangent_length).max().unwrap_or(0);
            with_scratch(block_length + 3 * cotangent_length, |scratch| {
                let (blocks, cotangents) = scratch.split_at_mut(block_length);
                for (start, rows) in groups.chunks(group) {
                    networks.forward(&self.inputs[start * width..][..rows * width], rows, blocks);
                    let d_residual = &d_residual[3 * start..][..3 * rows];
                    let d_incident = if d_incident.is_empty() { &[] } else { &d_incident[start..][..rows] };
                    let d_x =
                        networks.pull(rows, blocks, [d_residual, d_incident], cotangents, &mut partial, input_gradient);
                    if input_gradient {
                        let first = groups.first_row(group);
                        networks.trunk.store_inputs(
                            rows,
                            d_x,
                            &mut d_inputs[(start - first) * width..][..rows * width],
                        );
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
        let sum = sum_in_order(partials, networks.each().map(ChunkNetwork::gradient_length).sum());
        let (trunk, sum) = sum.split_at(networks.trunk.gradient_length());
        let (residual_head, incident_head) = sum.split_at(networks.residual_head.gradient_length());
        Ok(ResidualNetworkGrad {
            trunk: networks.trunk.unpad_gradient(trunk),
            residual_head: networks.residual_head.unpad_gradient(residual_head),
            incident_head: networks.incident_head.as_ref().map(|head| head.unpad_gradient(incident_head)),
            inputs,
        })
    }
}

impl Networks<'_> {
    /// One chunk backward: adds to `partial` and returns the cotangent of the padded inputs, if `input_gradient`.
    /// `d_outputs` are those of the two heads, empty for zero; `cotangents` is scratch memory for three buffers.
    fn pull<'b>(
        &self,
        rows: usize,
        blocks: &[f32],
        d_outputs: [&[f32]; 2],
        cotangents: &'b mut [f32],
        partial: &mut [f32],
        input_gradient: bool,
    ) -> &'b mut [f32] {
        let (trunk_block, mut blocks) = blocks.split_at(self.trunk.block_length(rows));
        let (trunk_partial, mut partial) = partial.split_at_mut(self.trunk.gradient_length());
        let length = cotangents.len() / 3;
        let (d_features, buffers) = cotangents.split_at_mut(length);
        let (first, second) = buffers.split_at_mut(length);
        let size = self.trunk.padded_outputs(rows, trunk_block).len();
        d_features[..size].fill(0.0);
        for (head, d_outputs) in self.each().skip(1).zip(d_outputs) {
            let (block, rest) = blocks.split_at(head.block_length(rows));
            let (head_partial, rest_partial) = partial.split_at_mut(head.gradient_length());
            (blocks, partial) = (rest, rest_partial);
            if d_outputs.is_empty() {
                continue;
            }
            head.load_cotangent(d_outputs, rows, first);
            let d_x = head.pull(rows, block, (&mut *first, &mut *second), head_partial, true);
            for (to, from) in d_features[..size].iter_mut().zip(d_x) {
                *to += *from;
            }
        }
        self.trunk.pull(rows, trunk_block, (d_features, first), trunk_partial, input_gradient)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_have_the_published_sizes() {
        let mut uniform = || 0.25;
        let network = ResidualNetwork::initialise(&ResidualNetworkConfig::sss_3dgs(), &mut uniform).unwrap();
        assert_eq!(network.trunk.shape.widths, [42, 64, 32, 32]);
        assert_eq!(network.residual_head.shape.widths, [32, 3]);
        assert_eq!(network.incident_head.unwrap().shape.widths, [32, 32, 1]);
        let network = ResidualNetwork::initialise(&ResidualNetworkConfig::paper(), &mut uniform).unwrap();
        assert_eq!(network.trunk.shape.widths, [42, 64, 64, 64, 64]);
        assert!(network.incident_head.is_none());
    }

    #[test]
    fn networks_that_do_not_fit_are_refused() {
        let mut uniform = || 0.25;
        let mut network = ResidualNetwork::initialise(&ResidualNetworkConfig::sss_3dgs(), &mut uniform).unwrap();
        assert!(matches!(network.forward(&[0.0; 41], 1), Err(ShadingError::Shape { .. })));
        network.residual_head.shape.widths = vec![31, 3];
        network.residual_head.parameters.truncate(31 * 3 + 3);
        assert!(matches!(network.forward(&[0.0; 42], 1), Err(ShadingError::Shape { .. })));
    }
}
