//! Orchestration: from a capture to a relightable model, its figures, pictures and report. The `diamond` program is a thin
//! shell around this library.
//!
//! Invariant: nothing here computes gradients or shades; everything that is written to disk is written beside its place,
//! synchronised and renamed, so that a crash never leaves half a file. Only the program parses command lines and prints.
//!
//! ```no_run
//! use diamond_sss::{ReconstructOptions, reconstruct};
//! use std::sync::atomic::AtomicBool;
//! let mut options = ReconstructOptions::new("capture", "out");
//! options.steps = Some(1000);
//! let outcome = reconstruct(&options, &mut |_| {}, &AtomicBool::new(false))?;
//! assert!(outcome.metrics.is_some());
//! # Ok::<(), diamond_sss::SssError>(())
//! ```
mod camera_path;
mod capture_check;
mod contact_sheet;
mod devices;
mod error;
mod evaluation;
mod export;
mod geometry_score;
mod inspect;
mod inspect_medium;
mod light_choice;
mod memory;
mod metrics_file;
mod models;
mod output_file;
mod peak_memory;
mod picture;
mod plan;
mod predicted_shards;
mod reconstruct_run;
mod relight;
mod relighter_source;
mod render_run;
mod report;
mod run_record;
mod splat_picture;
mod train;
mod training_log;

pub use camera_path::{CameraChoice, cameras_of, parse_cameras, read_cameras};
pub use capture_check::open_capture;
pub use contact_sheet::{SheetOptions, contact_sheet, family_sheet};
pub use devices::devices_text;
pub use error::SssError;
pub use evaluation::{FittedGain, HeldOutGain, ImageScore, PSNR_CAP, Scored, evaluate_model};
pub use export::{ExportOptions, Exported, convert_splats, export_model, is_splat_file, parse_turn};
pub use geometry_score::{SHAPE_METRICS, ShapeScores, ViewShape, shape_scores};
pub use inspect::{inspect_picture, inspect_text};
pub use inspect_medium::{MediumReport, edit_medium, inspect_medium};
pub use light_choice::{LightChoice, LightMix, parse_mix, parse_vec3};
pub use memory::{AtOnce, MemoryPlan, Moment, Part, Refused, moments};
pub use metrics_file::{Metrics, Summary, evaluate_folder};
pub use models::{check_weights, convert_weights, inspect_weights};
pub use output_file::write_output;
pub use peak_memory::peak_bytes;
pub use picture::{encode_exr, encode_png_grey, encode_png_rgb};
pub use plan::{Milestone, Plan, PlanOptions, plan_capture};
pub use predicted_shards::export_predictions;
pub use reconstruct_run::{Event, Outcome, ReconstructOptions, reconstruct};
pub use relight::render_lights;
pub use relighter_source::{RelighterOnSurface, RelighterSource, SurfaceView};
pub use render_run::{RenderOptions, render_folder};
pub use report::write_report;
pub use run_record::{RunRecord, StoredCamera, StoredLight};
pub use splat_picture::{inspect_splats, splat_picture};
pub use train::{TrainOptions, train_on_shards};
pub use training_log::{LogRow, TrainingLog};
