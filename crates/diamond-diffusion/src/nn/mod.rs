//! Layers over candle's tensors whose gradients are right, checked one by one.
//!
//! Some of candle's operations drop, halve or overwrite gradients without a word, or are slow on the CPU. The ones here are
//! composed of operations whose backward pass is right, or are operations of our own with a backward pass written by hand: on the
//! CPU in `f32` and `f64`; on other devices the composed form takes over. Each has a test against central differences in `f64`.
//!
//! Names and shapes of weights are those of PyTorch: `weight` of a linear layer is (out, in), of a convolution (out, in, height,
//! width). Pictures are (batch, channels, height, width), sequences (batch, tokens, channels).
mod activation;
mod attention;
mod attention_op;
mod conv;
mod conv_op;
mod cpu;
mod group_norm_op;
mod linear;
mod norm;
mod pool;
mod resize;
mod time_embedding;
mod variables;

pub use activation::{gelu, sigmoid, silu, softmax};
pub use attention::{Attention, FeedForward, attend};
pub use conv::Conv2d;
pub use conv_op::conv2d;
pub use linear::Linear;
pub use norm::{GroupNorm, LayerNorm, group_norm, layer_norm};
pub use pool::max_pool2d;
pub use resize::{depth_to_space, resize_bilinear, space_to_depth, upsample_nearest};
pub use time_embedding::{TimeEmbedding, timestep_embedding};
pub use variables::{Init, LoadReport, Scope, Source, Variables, VariablesBuilder};
