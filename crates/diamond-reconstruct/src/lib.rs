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
mod agreement;
mod augmentation;
mod augmentation_settings;
mod blender;
mod byte_size;
mod channel_layout;
mod config;
mod counters;
mod cpu;
mod density_control;
mod engine;
mod error;
mod exposure;
mod facts;
mod forward;
mod guided;
mod instruction_choice;
mod light_half;
mod mcmc;
mod medium_fit;
mod medium_term;
mod model;
mod needs;
mod objective;
mod pairs;
mod parameters;
mod photometric;
pub mod random;
mod reconstruction;
mod region;
mod relighter;
mod relit;
mod render;
mod resident;
mod residual_pull;
mod rows;
mod scene;
mod schedule;
mod stepper;
mod stored_medium;
mod tensor_file;
mod turns;
mod visibility_cache;

pub use augmentation_settings::{AugmentationSettings, AugmentationSource};
pub use blender::Blender;
pub use byte_size::ByteSize;
pub use channel_layout::ChannelLayout;
pub use config::*;
pub use counters::Counters;
pub use cpu::{CpuEngine, Profile};
pub use engine::{Engine, Neighbour, Rendering, StepReport, TrainingPair};
pub use error::{ReconstructError, io_advice};
pub use exposure::{Exposure, ExposureFile, NamedGain, fitted_gain};
pub use facts::CaptureFacts;
pub use guided::{Guidance, GuidedSource};
pub use instruction_choice::InstructionChoice;
pub use medium_fit::{fit_medium, medium_of, surface_of};
pub use medium_term::MediumTerm;
pub use model::Model;
pub use needs::{Decision, Kind, NIL, NeedRow, Needs, RenderNeeds, StepNeeds};
pub use objective::TermValue;
pub use parameters::{Activated, ActivatedGrad, Attribute, GaussianParameters, Group, Layout, logit, sigmoid};
pub use photometric::Guide;
pub use reconstruction::Reconstruction;
pub use region::Region;
pub use relighter::{RelightLight, RelightView, Relighter};
pub use render::{LIGHTS_TOGETHER, PICTURE_BYTES, RenderWork, RenderedShape, Renderer};
pub use scene::{InitialPoints, InitialSplats, Scene, survey};
pub use schedule::StepPlan;
pub use stepper::{ImageOutcome, PullSample, StepImage, StepMedium, StepOutcome, StepPull, StepTask, Stepper};
pub use tensor_file::{TensorFile, tensor_digest, write_atomically};
