//! A dense network on one chunk of rows: the part that runs while everything sits in the first two caches.
//!
//! A chunk's block of memory holds the inputs and each layer's outputs one after the other, each `[rows × padded width]`
//! where widths are padded to whole vectors. What lies in the padding is never read into a result, so scratch memory
//! needs no clearing.
use crate::mlp::{CHUNK_ROWS, Mlp, MlpShape};
use crate::simd::{Activate, ActivatePull, Init, MAGNITUDE_LIMIT, Product, dispatch, padded};

/// One layer with its parameters laid out for the products of both directions, saturated at ±[`MAGNITUDE_LIMIT`].
struct Layer {
    /// `[inputs × padded outputs]`.
    transposed: Vec<f32>,
    /// `[padded outputs]`.
    bias: Vec<f32>,
    /// `[outputs × padded inputs]`.
    weights: Vec<f32>,
}

/// A network ready to run on chunks of at most [`CHUNK_ROWS`] rows.
pub(crate) struct ChunkNetwork<'a> {
    shape: &'a MlpShape,
    layers: Vec<Layer>,
}

fn saturate(value: f32) -> f32 {
    value.clamp(-MAGNITUDE_LIMIT, MAGNITUDE_LIMIT)
}

/// Rows of `width` values → rows of `padded(width)`.
fn pad_rows(from: &[f32], width: usize, to: &mut [f32]) {
    for (to, from) in to.chunks_exact_mut(padded(width)).zip(from.chunks_exact(width)) {
        for (to, &from) in to.iter_mut().zip(from) {
            *to = saturate(from);
        }
    }
}

/// Rows of `padded(width)` values → rows of `width`.
fn unpad_rows(from: &[f32], width: usize, to: &mut [f32]) {
    for (to, from) in to.chunks_exact_mut(width).zip(from.chunks_exact(padded(width))) {
        to.copy_from_slice(&from[..width]);
    }
}

impl<'a> ChunkNetwork<'a> {
    /// Lays out the parameters of a network that passed [`Mlp::check`].
    pub(crate) fn new(mlp: &'a Mlp) -> Self {
        let mut offset = 0;
        let layers = mlp.shape.widths.windows(2).map(|w| {
            let (inputs, outputs) = (w[0], w[1]);
            let matrix = &mlp.parameters[offset..][..inputs * outputs];
            let mut weights = vec![0.0; outputs * padded(inputs)];
            pad_rows(matrix, inputs, &mut weights);
            let mut transposed = vec![0.0; inputs * padded(outputs)];
            for (o, line) in matrix.chunks_exact(inputs).enumerate() {
                for (i, &weight) in line.iter().enumerate() {
                    transposed[i * padded(outputs) + o] = saturate(weight);
                }
            }
            let mut bias = vec![0.0; padded(outputs)];
            pad_rows(&mlp.parameters[offset + inputs * outputs..][..outputs], outputs, &mut bias);
            offset += outputs * (inputs + 1);
            Layer { transposed, bias, weights }
        });
        Self { layers: layers.collect(), shape: &mlp.shape }
    }

    /// Values of a block of `rows` rows.
    pub(crate) fn block_length(&self, rows: usize) -> usize {
        rows * self.shape.widths.iter().map(|&w| padded(w)).sum::<usize>()
    }

    /// Values of a cotangent buffer for [`CHUNK_ROWS`] rows of the widest layer.
    pub(crate) fn cotangent_length(&self) -> usize {
        CHUNK_ROWS * self.shape.widths.iter().map(|&w| padded(w)).max().unwrap_or(0)
    }

    /// Values of a padded parameter gradient.
    pub(crate) fn gradient_length(&self) -> usize {
        self.shape.widths.windows(2).map(|w| w[1] * padded(w[0]) + padded(w[1])).sum()
    }

    /// Copies `inputs` `[rows × inputs]`, saturated, to the beginning of the block.
    pub(crate) fn load(&self, inputs: &[f32], rows: usize, block: &mut [f32]) {
        let width = self.shape.inputs();
        pad_rows(inputs, width, &mut block[..rows * padded(width)]);
    }

    /// As [`ChunkNetwork::load`] from rows that are padded already.
    pub(crate) fn load_padded(&self, inputs: &[f32], block: &mut [f32]) {
        block[..inputs.len()].copy_from_slice(inputs);
    }

    /// Copies `d_outputs` `[rows × outputs]` into the buffer `d` for [`ChunkNetwork::pull`].
    pub(crate) fn load_cotangent(&self, d_outputs: &[f32], rows: usize, d: &mut [f32]) {
        let width = self.shape.outputs();
        pad_rows(d_outputs, width, &mut d[..rows * padded(width)]);
    }

    /// The last layer's outputs `[rows × padded outputs]` in the block.
    pub(crate) fn padded_outputs<'b>(&self, rows: usize, block: &'b [f32]) -> &'b [f32] {
        let end = self.block_length(rows);
        &block[end - rows * padded(self.shape.outputs())..end]
    }

    /// Copies the last layer's outputs to `outputs` `[rows × outputs]`.
    pub(crate) fn store_outputs(&self, rows: usize, block: &[f32], outputs: &mut [f32]) {
        unpad_rows(self.padded_outputs(rows, block), self.shape.outputs(), outputs);
    }

    /// Copies a cotangent of the inputs `[rows × padded inputs]` to `d_inputs` `[rows × inputs]`.
    pub(crate) fn store_inputs(&self, rows: usize, d_x: &[f32], d_inputs: &mut [f32]) {
        let width = self.shape.inputs();
        unpad_rows(&d_x[..rows * padded(width)], width, d_inputs);
    }

    /// All layers: fills the block after its inputs.
    /// `[eq:mlp]`
    pub(crate) fn forward(&self, rows: usize, block: &mut [f32]) {
        let widths = &self.shape.widths;
        let (mut x, mut rest) = block.split_at_mut(rows * padded(widths[0]));
        for (l, layer) in self.layers.iter().enumerate() {
            let stride = padded(widths[l + 1]);
            let (y, after) = rest.split_at_mut(rows * stride);
            dispatch(Product {
                a: x,
                a_stride: padded(widths[l]),
                transpose_a: false,
                b: &layer.transposed,
                b_stride: stride,
                c: y,
                c_stride: stride,
                rows,
                inner: widths[l],
                columns: widths[l + 1],
                init: Init::Row(&layer.bias),
            });
            dispatch(Activate { values: y, activation: self.shape.activation(l) });
            (x, rest) = (y, after);
        }
    }

    /// Pulls the cotangent of the outputs, which the first of the two `buffers` holds (see
    /// [`ChunkNetwork::load_cotangent`]), back through all layers; adds to `partial`, the padded parameter gradient; and
    /// returns the buffer that holds the cotangent of the inputs `[rows × padded inputs]`, if `input_gradient`.
    /// `[eq:mlp]`
    pub(crate) fn pull<'b>(
        &self,
        rows: usize,
        block: &[f32],
        buffers: (&'b mut [f32], &'b mut [f32]),
        partial: &mut [f32],
        input_gradient: bool,
    ) -> &'b mut [f32] {
        let (mut d_y, mut d_x) = buffers;
        let widths = &self.shape.widths;
        // The block and the partial gradient are walked from their ends.
        let mut saved = &block[..self.block_length(rows)];
        let mut partial = partial;
        for (l, layer) in self.layers.iter().enumerate().rev() {
            let (inputs, outputs) = (widths[l], widths[l + 1]);
            let (in_stride, out_stride) = (padded(inputs), padded(outputs));
            let (before, y) = saved.split_at(saved.len() - rows * out_stride);
            let x = &before[before.len() - rows * in_stride..];
            saved = before;
            let (before, d_bias) = partial.split_at_mut(partial.len() - out_stride);
            let (before, d_weights) = before.split_at_mut(before.len() - outputs * in_stride);
            partial = before;
            let d_values = &mut d_y[..rows * out_stride];
            let activation = self.shape.activation(l);
            dispatch(ActivatePull { d_values, values: y, stride: out_stride, activation, d_bias });
            dispatch(Product {
                a: d_y,
                a_stride: out_stride,
                transpose_a: true,
                b: x,
                b_stride: in_stride,
                c: d_weights,
                c_stride: in_stride,
                rows: outputs,
                inner: rows,
                columns: inputs,
                init: Init::Accumulate,
            });
            if l > 0 || input_gradient {
                dispatch(Product {
                    a: d_y,
                    a_stride: out_stride,
                    transpose_a: false,
                    b: &layer.weights,
                    b_stride: in_stride,
                    c: d_x,
                    c_stride: in_stride,
                    rows,
                    inner: outputs,
                    columns: inputs,
                    init: Init::Zero,
                });
                std::mem::swap(&mut d_x, &mut d_y);
            }
        }
        d_y
    }

    /// The flat parameter gradient from a padded one.
    pub(crate) fn unpad_gradient(&self, padded_gradient: &[f32]) -> Vec<f32> {
        let mut parameters = Vec::with_capacity(self.shape.parameter_count());
        let mut from = padded_gradient;
        for w in self.shape.widths.windows(2) {
            for width in std::iter::repeat_n(w[0], w[1]).chain([w[1]]) {
                parameters.extend_from_slice(&from[..width]);
                from = &from[padded(width)..];
            }
        }
        parameters
    }
}

/// The element-wise sum of `partials`, each `length` values, added in their order.
pub(crate) fn sum_in_order(partials: Vec<Vec<f32>>, length: usize) -> Vec<f32> {
    let mut partials = partials.into_iter();
    let mut sum = partials.next().unwrap_or_else(|| vec![0.0; length]);
    for partial in partials {
        for (to, from) in sum.iter_mut().zip(partial) {
            *to += from;
        }
    }
    sum
}
