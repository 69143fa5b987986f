//! One family of networks: the UNets of Stable Diffusion's size, small ones of the same form, and the ControlNet.
mod condition;
mod config;
mod control;
mod encoder;
mod model;
mod residual;
mod transformer;

#[cfg(test)]
mod tests;

pub use condition::Conditions;
pub use config::{LIGHT_CHANNELS, RAY_CHANNELS, UNetConfig, ViewAttention};
pub use control::{ControlConfig, ControlNet, ControlResiduals};
pub use model::UNet;
