//! The residual network on arrays that stay on the device: trunk, residual head and head for incident light, forward and backward.
use crate::GpuError;
use crate::kernels::Module;
use crate::network::{PART, Product, TILE};
use crate::parameter_arrays::ParameterLayout;
use crate::workspace::{Bound, Store, Workspace};
use diamond_shading::MlpShape;

/// Trunk, residual head, incident head.
pub(crate) const TRUNK: usize = 0;
/// The head for the residual.
pub(crate) const RESIDUAL: usize = 1;
/// The head for incident light.
pub(crate) const INCIDENT: usize = 2;

/// A pass of some rows through the network. Settings of passes that are recorded together have different numbers.
#[derive(Debug, Clone, Copy)]
pub(crate) struct NetworkPass<'l> {
    pub layout: &'l ParameterLayout,
    pub rows: u32,
    pub number: u32,
}

/// Products that one pass may need, so that numbers of settings differ.
const PRODUCTS: u32 = 512;

fn layer(part: usize, layer: usize) -> Store {
    Store::Layer(part as u8, layer as u8)
}

fn d_layer(part: usize, layer: usize) -> Store {
    Store::DLayer(part as u8, layer as u8)
}

/// The last layer of a part.
fn last(shape: &MlpShape) -> usize {
    shape.layers() - 1
}

/// Where a head's outputs are.
pub(crate) fn outputs(layout: &ParameterLayout, part: usize) -> Option<Store> {
    layout.network.get(part).map(|(shape, _)| layer(part, last(shape)))
}

/// Where the cotangent of a head's outputs is put.
pub(crate) fn d_outputs(layout: &ParameterLayout, part: usize) -> Option<Store> {
    layout.network.get(part).map(|(shape, _)| d_layer(part, last(shape)))
}

/// Makes room for so many rows at a time.
pub(crate) fn reserve(workspace: &mut Workspace, layout: &ParameterLayout, rows: u64) -> Result<(), GpuError> {
    workspace.upload(Store::One, &[1.0f32.to_bits(); 4])?;
    // Kernels are handed these also where there is no network.
    workspace.reserve(Store::DInputs, 4)?;
    workspace.reserve(Store::DShared, 4)?;
    let mut largest = 4;
    for (part, (shape, _)) in layout.network.iter().enumerate() {
        for (l, w) in shape.widths.windows(2).enumerate() {
            workspace.reserve(layer(part, l), rows * w[1] as u64)?;
            workspace.reserve(d_layer(part, l), rows * w[1] as u64)?;
            largest = largest.max(w[0] * w[1]);
        }
        if part == TRUNK {
            workspace.reserve(Store::Inputs, rows * shape.inputs() as u64)?;
            workspace.reserve(Store::DInputs, rows * shape.inputs() as u64)?;
            workspace.reserve(Store::DShared, rows * shape.outputs() as u64)?;
        }
    }
    workspace.reserve(Store::Parts, rows.div_ceil(PART.into()) * largest as u64)?;
    workspace.reserve(Store::NetworkGradient, layout.network_words)
}

impl NetworkPass<'_> {
    /// Records one of the product's kernels: `what` numbers it within the pass.
    fn record(
        &self,
        workspace: &mut Workspace,
        encoder: &mut wgpu::CommandEncoder,
        what: u32,
        product: Product,
        entry: &'static str,
        arrays: [Store; 3],
    ) -> Result<(), GpuError> {
        let number = self.number * PRODUCTS + what;
        workspace.set("product", number, &product)?;
        let [a, b, c] = arrays.map(Bound::Store);
        let arrays = [Bound::Settings("product", number), a, b, c];
        if entry == "multiply" {
            let parts = product.k.div_ceil(product.part.max(1)).max(1);
            let grid = [product.n.div_ceil(TILE), product.m.div_ceil(TILE) * parts];
            return workspace.run(encoder, (Module::Product, entry), None, &arrays, grid);
        }
        let values = u64::from(product.m) * u64::from(product.n);
        workspace.over(encoder, (Module::Product, entry), None, &arrays, values)
    }

    /// Outputs of some parts for the rows in [`Store::Inputs`].
    pub fn forward(
        &self,
        workspace: &mut Workspace,
        encoder: &mut wgpu::CommandEncoder,
        parts: &[usize],
    ) -> Result<(), GpuError> {
        for &part in parts {
            let Some((shape, first)) = self.layout.network.get(part) else { continue };
            let mut from = if part == TRUNK { Store::Inputs } else { layer(TRUNK, last(&self.layout.network[0].0)) };
            for (l, w) in shape.widths.windows(2).enumerate() {
                let (i, o) = (w[0] as u32, w[1] as u32);
                let weights = *first as u32 + shape.layer_offset(l) as u32;
                let product = Product {
                    m: self.rows,
                    n: o,
                    k: i,
                    part: i.next_multiple_of(16),
                    a_i: i,
                    a_k: 1,
                    b_k: 1,
                    b_j: i,
                    b_first: weights,
                    bias_first: weights + i * o,
                    ..Product::default()
                }
                .activated(shape.activation(l));
                let what = 64 * part as u32 + 2 * l as u32;
                let to = layer(part, l);
                self.record(workspace, encoder, what, product, "multiply", [from, Store::Network, to])?;
                self.record(workspace, encoder, what + 1, product, "activate", [Store::One, Store::Network, to])?;
                from = to;
            }
        }
        Ok(())
    }

    /// Adds the gradient for the cotangents of some heads' outputs to [`Store::NetworkGradient`]; that of the inputs goes to
    /// [`Store::DInputs`] where it is wanted.
    pub fn backward(
        &self,
        workspace: &mut Workspace,
        encoder: &mut wgpu::CommandEncoder,
        heads: &[usize],
        with_inputs: bool,
    ) -> Result<(), GpuError> {
        let trunk = &self.layout.network[TRUNK].0;
        let shared = d_layer(TRUNK, last(trunk));
        let mut begun = false;
        for &part in heads.iter().chain(&[TRUNK]) {
            let Some((shape, first)) = self.layout.network.get(part) else { continue };
            for (l, w) in shape.widths.windows(2).enumerate().rev() {
                let (i, o) = (w[0] as u32, w[1] as u32);
                let weights = *first as u32 + shape.layer_offset(l) as u32;
                let what = 192 + 64 * part as u32 + 8 * l as u32;
                let d = d_layer(part, l);
                let from = match (part, l) {
                    (TRUNK, 0) => Store::Inputs,
                    (_, 0) => layer(TRUNK, last(trunk)),
                    _ => layer(part, l - 1),
                };
                let size = Product { m: self.rows, n: o, ..Product::default() }.activated(shape.activation(l));
                self.record(workspace, encoder, what, size, "activate_pull", [layer(part, l), Store::Network, d])?;
                // dW = dZᵀ X, and the same with a column of ones for the bias.
                for (n, b, b_k, b_j, to, what) in
                    [(i, from, i, 1, weights, what + 1), (1, Store::One, 0, 0, weights + i * o, what + 3)]
                {
                    let k = self.rows;
                    let product =
                        Product { m: o, n, k, part: PART, a_i: 1, a_k: o, b_k, b_j, add: 1, ..Product::default() };
                    self.record(workspace, encoder, what, product, "multiply", [d, b, Store::Parts])?;
                    let sum = Product { c_first: to, ..product };
                    let arrays = [Store::Parts, Store::One, Store::NetworkGradient];
                    self.record(workspace, encoder, what + 1, sum, "sum_parts", arrays)?;
                }
                let to = match (part, l) {
                    (TRUNK, 0) if !with_inputs => continue,
                    (TRUNK, 0) => Store::DInputs,
                    (_, 0) if begun => Store::DShared,
                    (_, 0) => shared,
                    _ => d_layer(part, l - 1),
                };
                let product = Product {
                    m: self.rows,
                    n: i,
                    k: o,
                    part: o.next_multiple_of(16),
                    a_i: o,
                    a_k: 1,
                    b_k: i,
                    b_j: 1,
                    b_first: weights,
                    ..Product::default()
                };
                self.record(workspace, encoder, what + 5, product, "multiply", [d, Store::Network, to])?;
                if to == Store::DShared {
                    let sum = Product { m: self.rows, n: i, ..Product::default() };
                    self.record(workspace, encoder, what + 6, sum, "add_to", [Store::DShared, Store::One, shared])?;
                }
            }
            begun = true;
        }
        Ok(())
    }
}
