//! The model being optimised, the objective, Adam, schedules, one training step, checkpoints.
//!
//! Invariant: nothing here parses command lines, prints, or knows a device; [`Engine`] is what a GPU implements as well.
//!
//! ```no_run
//! use diamond_dataset::{Capture, OpenOptions};
//! use diamond_reconstruct::{Config, Reconstruction};
//! let capture = Capture::open("capture".as_ref(), &OpenOptions::default())?;
//! let mut run = Reconstruction::new(capture, &Config::preset("resolved")?)?;
//! while !run.finished() {
//!     let report = run.step()?;
//!     assert!(report.objective.is_finite());
//! }
//! run.model()?.save("out".as_ref())?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
pub mod adam;
mod config;
mod cpu;
mod density_control;
mod engine;
mod error;
mod forward;
mod instruction_choice;
mod mcmc;
mod model;
mod objective;
mod pairs;
mod parameters;
pub mod random;
mod reconstruction;
mod scene;
mod schedule;
mod tensor_file;
mod visibility_cache;

pub use config::*;
pub use cpu::{CpuEngine, Profile};
pub use engine::{Engine, Rendering, StepReport, TrainingPair};
pub use error::ReconstructError;
pub use instruction_choice::InstructionChoice;
pub use model::Model;
pub use objective::TermValue;
pub use parameters::{Activated, ActivatedGrad, Attribute, GaussianParameters, Group, Layout, logit, sigmoid};
pub use reconstruction::Reconstruction;
pub use scene::{InitialPoints, InitialSplats, Scene, survey};
pub use schedule::StepPlan;
pub use tensor_file::{TensorFile, write_atomically};
