//! Training: the objective, AdamW, averages of weights, steps that can be resumed.
mod image_terms;
mod objective;
mod optimizer;
mod trainer;

#[cfg(test)]
mod tests;

pub use image_terms::{blur_difference, ssim};
pub use objective::{ImageTerms, Objective, Perceptual};
pub use optimizer::AdamW;
pub use trainer::{StepReport, TrainSettings, Trainer};
