//! The dense network on a device: what `diamond_shading::Mlp` does, forward and backward, by products of matrices.
use crate::adam::no_frame;
use crate::job::{Array, Job, words};
use crate::kernels::Module;
use crate::{Device, GpuError};
use bytemuck::{Pod, Zeroable};
use diamond_shading::{Activation, Mlp, MlpGrad, ShadingError};

/// `Product` of `product.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub(crate) struct Product {
    pub m: u32,
    pub n: u32,
    pub k: u32,
    pub part: u32,
    pub a_i: u32,
    pub a_k: u32,
    pub b_k: u32,
    pub b_j: u32,
    pub a_first: u32,
    pub b_first: u32,
    pub c_first: u32,
    pub activation: u32,
    pub slope: f32,
    pub bias_first: u32,
    pub add: u32,
    pub unused_1: u32,
}

/// Rows of a batch whose products with a cotangent are summed by one workgroup: a multiple of 16.
pub(crate) const PART: u32 = 2048;
/// Side of a tile of a product, as in `product.wgsl`.
pub(crate) const TILE: u32 = 64;

impl Product {
    pub fn activated(self, activation: Activation) -> Self {
        let (activation, slope) = match activation {
            Activation::Linear => (0, 1.0),
            Activation::Relu => (1, 0.0),
            Activation::LeakyRelu(slope) => (1, slope),
            Activation::Sigmoid => (2, 0.0),
        };
        Self { activation, slope, ..self }
    }
}

/// The layers of a network on the device.
struct Layers<'m> {
    mlp: &'m Mlp,
    batch: u32,
    parameters: Array,
    /// The inputs, then each layer's outputs.
    outputs: Vec<Array>,
}

/// Queues a product into an array.
fn multiply(job: &mut Job<'_>, product: Product, a: Array, b: Array, c: Array) -> Result<(), GpuError> {
    let parts = product.k.div_ceil(product.part.max(1)).max(1);
    let grid = [product.n.div_ceil(TILE), product.m.div_ceil(TILE) * parts];
    let settings = job.input("product", bytemuck::cast_slice(bytemuck::bytes_of(&product)))?;
    job.run(Module::Product, "multiply", &[], &[settings, a, b, c], grid)
}

fn elementwise(
    job: &mut Job<'_>,
    entry: &'static str,
    product: Product,
    [a, b, c]: [Array; 3],
) -> Result<(), GpuError> {
    let settings = job.input("product", bytemuck::cast_slice(bytemuck::bytes_of(&product)))?;
    job.over(Module::Product, entry, &[settings, a, b, c], u64::from(product.m) * u64::from(product.n))
}

fn forward<'m>(job: &mut Job<'_>, mlp: &'m Mlp, inputs: &[f32], batch: usize) -> Result<Layers<'m>, GpuError> {
    let parameters = job.input("network", words(&mlp.parameters))?;
    let nothing = job.zeros("nothing", 4)?;
    let mut outputs = vec![job.input("network inputs", words(inputs))?];
    for (layer, w) in mlp.shape.widths.windows(2).enumerate() {
        let (i, o) = (w[0] as u32, w[1] as u32);
        let first = mlp.shape.layer_offset(layer) as u32;
        let to = job.zeros("layer outputs", batch as u64 * u64::from(o))?;
        let product = Product {
            m: batch as u32,
            n: o,
            k: i,
            part: i.next_multiple_of(16),
            a_i: i,
            a_k: 1,
            b_k: 1,
            b_j: i,
            b_first: first,
            bias_first: first + i * o,
            ..Product::default()
        }
        .activated(mlp.shape.activation(layer));
        let from = outputs[layer];
        multiply(job, product, from, parameters, to)?;
        elementwise(job, "activate", product, [nothing, parameters, to])?;
        outputs.push(to);
    }
    Ok(Layers { mlp, batch: batch as u32, parameters, outputs })
}

/// The outputs `[batch × outputs]` for `inputs` `[batch × inputs]`, as [`Mlp::forward`] gives them `[eq:mlp]`.
///
/// # Errors
/// What the CPU refuses; arrays beyond the device's limits or memory; a lost device.
pub fn mlp_forward(device: &Device, mlp: &Mlp, inputs: &[f32], batch: usize) -> Result<Vec<f32>, GpuError> {
    check(mlp, inputs, batch, None)?;
    if batch == 0 {
        return Ok(Vec::new());
    }
    let mut job = Job::new(device, &no_frame(0, [1, 1]))?;
    let layers = forward(&mut job, mlp, inputs, batch)?;
    let last = layers.outputs[layers.outputs.len() - 1];
    Ok(job.finish(&[(last, (batch * mlp.shape.outputs()) as u64)])?.swap_remove(0))
}

/// The gradient for the cotangent `d_outputs` `[batch × outputs]`, as [`diamond_shading::MlpPullback::pull`] gives it
/// `[eq:mlp]`.
///
/// # Errors
/// As [`mlp_forward`].
pub fn mlp_pull(
    device: &Device,
    mlp: &Mlp,
    inputs: &[f32],
    batch: usize,
    d_outputs: &[f32],
    with_inputs: bool,
) -> Result<MlpGrad, GpuError> {
    check(mlp, inputs, batch, Some(d_outputs))?;
    if batch == 0 {
        let none = with_inputs.then(Vec::new);
        return Ok(MlpGrad { parameters: vec![0.0; mlp.parameters.len()], inputs: none });
    }
    let mut job = Job::new(device, &no_frame(0, [1, 1]))?;
    let layers = forward(&mut job, mlp, inputs, batch)?;
    let (parameters, d_inputs) = backward(&mut job, &layers, d_outputs, with_inputs)?;
    let mut wanted = vec![(parameters, mlp.parameters.len() as u64)];
    wanted.extend(d_inputs.map(|d| (d, inputs.len() as u64)));
    let mut read = job.finish(&wanted)?;
    let inputs = with_inputs.then(|| read.pop().unwrap_or_default());
    Ok(MlpGrad { parameters: read.swap_remove(0), inputs })
}

fn backward(
    job: &mut Job<'_>,
    layers: &Layers<'_>,
    d_outputs: &[f32],
    with_inputs: bool,
) -> Result<(Array, Option<Array>), GpuError> {
    let Layers { mlp, batch, parameters, outputs } = layers;
    let batch = *batch;
    let gradient = job.zeros("gradient of the network", mlp.parameters.len() as u64)?;
    let one = job.input("one", words(&[1.0]))?;
    let mut d = job.input("gradient of the outputs", words(d_outputs))?;
    for (layer, w) in mlp.shape.widths.windows(2).enumerate().rev() {
        let (i, o) = (w[0] as u32, w[1] as u32);
        let first = mlp.shape.layer_offset(layer) as u32;
        let size = Product { m: batch, n: o, ..Product::default() }.activated(mlp.shape.activation(layer));
        elementwise(job, "activate_pull", size, [outputs[layer + 1], *parameters, d])?;
        // dW = dZᵀ X, and the same with a column of ones for the bias.
        for (n, b, b_k, b_j, to) in [(i, outputs[layer], i, 1, first), (1, one, 0, 0, first + i * o)] {
            let product = Product { m: o, n, k: batch, part: PART, a_i: 1, a_k: o, b_k, b_j, ..Product::default() };
            let parts = u64::from(batch.div_ceil(PART));
            let partial = job.zeros("partial sums", parts * u64::from(o * n))?;
            multiply(job, product, d, b, partial)?;
            elementwise(job, "sum_parts", Product { c_first: to, ..product }, [partial, one, gradient])?;
        }
        if layer > 0 || with_inputs {
            let to = job.zeros("gradient of a layer", u64::from(batch) * u64::from(i))?;
            let product = Product {
                m: batch,
                n: i,
                k: o,
                part: o.next_multiple_of(16),
                a_i: o,
                a_k: 1,
                b_k: i,
                b_j: 1,
                b_first: first,
                ..Product::default()
            };
            multiply(job, product, d, *parameters, to)?;
            d = to;
        }
    }
    Ok((gradient, with_inputs.then_some(d)))
}

fn check(mlp: &Mlp, inputs: &[f32], batch: usize, d_outputs: Option<&[f32]>) -> Result<(), GpuError> {
    mlp.shape.check()?;
    let lengths = [
        ("Mlp::parameters", mlp.shape.parameter_count(), mlp.parameters.len()),
        ("network inputs", batch * mlp.shape.inputs(), inputs.len()),
        ("network cotangent", batch * mlp.shape.outputs(), d_outputs.map_or(batch * mlp.shape.outputs(), <[f32]>::len)),
    ];
    for (what, expected, found) in lengths {
        if expected != found {
            return Err(ShadingError::Setting {
                what,
                expected: format!("{expected} numbers"),
                found: found.to_string(),
            }
            .into());
        }
    }
    Ok(())
}
