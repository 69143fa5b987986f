//! See below.
pub mod adam;
mod config;
mod error;
mod parameters;
pub mod random;
mod schedule;
mod tensor_file;

pub use config::*;
pub use error::ReconstructError;
pub use parameters::{Activated, ActivatedGrad, Attribute, GaussianParameters, Group, logit, sigmoid};
pub use schedule::StepPlan;
pub use tensor_file::{TensorFile, write_atomically};
