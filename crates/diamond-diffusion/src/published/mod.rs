//! Files of published models: which model a file belongs to, and its names turned into ours.
//!
//! Ours are those of the diffusers layout. The original layout (LDM, with `input_blocks` and `middle_block`) is renamed; a file that holds
//! several models (UNet, autoencoder, text encoder) gives the part that is asked for.
mod comparison;
mod kind;
mod ldm;

pub use comparison::{Comparison, Renamed, compare, converted};
pub use kind::ModelKind;
