//! Who makes whole training steps, if not the CPU: whoever implements [`Stepper`] keeps parameters, moments and statistics, and gives them back when they
//! are asked for.
use crate::objective::TermValue;
use crate::{Model, StepNeeds, StepPlan, TrainingPair};
use diamond_light::{Falloff, OlatLight};
use diamond_shading::{InputScaling, ShadingConfig};
use diamond_splat::RasterConfig;
use diamond_splat::density::DensityStats;
use glam::Vec3;
use std::sync::Arc;

/// A medium as a step needs it: everything that does not depend on the light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepMedium {
    /// What leaves where it enters, radiance per irradiance over `whole`, linear RGB.
    pub local: Vec3,
    /// The subsurfaceness that transport is divided by.
    pub whole: f32,
    /// The lights' falloff.
    pub falloff: Falloff,
    /// A Gaussian's tint over its base colour.
    pub tint: f32,
}

/// Who is asked what the residual adds, at a place and under a light that were drawn at random.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PullSample {
    /// The Gaussian.
    pub gaussian: u32,
    /// Unit direction to the viewer, or its opposite where that is behind the normal.
    pub view: Vec3,
    /// Unit direction to the light.
    pub light: Vec3,
    /// Visibility of the light for the so manyth sample whose light is in front of its normal; the others' is 0.
    pub visibility: f32,
}

/// The residual's pull toward nothing.
#[derive(Debug, Clone, PartialEq)]
pub struct StepPull {
    /// Weight of the term.
    pub weight: f32,
    /// Each Gaussian once, ascending.
    pub samples: Vec<PullSample>,
    /// Distance of the lights, scene units.
    pub distance: f32,
}

/// One image of a step.
#[derive(Debug, Clone)]
pub struct StepImage<'a> {
    /// What is to be learned.
    pub pair: &'a TrainingPair<'a>,
    /// Its light, scaled to the scene.
    pub light: OlatLight,
    /// Traced visibility of every Gaussian; `None` where none is traced.
    pub traced: Option<Arc<Vec<f32>>>,
    /// Gaussians on which visibility by harmonics is compared with the traced one, each once, and how often each was drawn.
    pub samples: Vec<[u32; 2]>,
    /// Radiance that leaves each surfel of the medium under the light with intensity 1, surfels × 3; `None` without a medium.
    pub leaving: Option<Arc<Vec<f32>>>,
}

/// Everything that a step needs to know.
#[derive(Debug, Clone)]
pub struct StepTask<'a> {
    /// Number of the step, from 0.
    pub step: u64,
    /// What the step number decides.
    pub plan: &'a StepPlan,
    /// What is computed.
    pub needs: &'a StepNeeds,
    /// Configuration, scene and number of Gaussians; parameters and moments are those that were loaded, or older.
    pub model: &'a Model,
    /// Settings of the shader.
    pub shading: &'a ShadingConfig,
    /// Settings of the rasteriser.
    pub raster: &'a RasterConfig,
    /// How the network's inputs are made dimensionless.
    pub scaling: InputScaling,
    /// Learning rate of each attribute, in the order of [`crate::Attribute::ALL`]; 0: it stays as it is.
    pub rates: [f32; 13],
    /// Limits of the standard deviations, scene units.
    pub scales: [f32; 2],
    /// The batch.
    pub images: Vec<StepImage<'a>>,
    /// Weight of the shrinkage of the transfer vectors, where that is a term.
    pub transfer_smoothness: Option<f32>,
    /// The medium, where there is one.
    pub medium: Option<StepMedium>,
    /// The residual's pull toward nothing, where that is a term.
    pub residual_pull: Option<StepPull>,
}

/// What became of one image.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ImageOutcome {
    /// Terms, not yet multiplied by the share of the batch.
    pub terms: Vec<TermValue>,
    /// PSNR in display sRGB, all pixels, dB.
    pub psnr: f32,
    /// Gaussians that could contribute.
    pub visible: usize,
}

/// What became of a step.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct StepOutcome {
    /// Image by image.
    pub images: Vec<ImageOutcome>,
    /// Terms of the whole batch.
    pub terms: Vec<TermValue>,
    /// What is not finite, and where, if anything is.
    pub not_finite: Option<[String; 2]>,
}

/// Makes the training steps of [`crate::CpuEngine`] elsewhere: the same formulas and thresholds, gradients that agree to rounding, and the same bits
/// from the same input. Errors are text: what is wrong and what to do.
pub trait Stepper {
    /// Name for logs.
    fn name(&self) -> &str;

    /// What of such a step it cannot do, in words of the configuration; `None`: it can do all.
    fn lacks(&self, model: &Model, needs: &StepNeeds, batch: &[TrainingPair<'_>]) -> Option<String>;

    /// Takes parameters, moments, network, statistics, and the surfels of the Gaussians, in place of what it has.
    ///
    /// # Errors
    /// No room for them.
    fn load(&mut self, model: &Model, stats: &DensityStats) -> Result<(), String>;

    /// Gives parameters, moments, network and statistics back.
    ///
    /// # Errors
    /// The device is lost.
    fn store(&mut self, model: &mut Model, stats: &mut DensityStats) -> Result<(), String>;

    /// One step: forward and backward over the batch, statistics of density control, Adam.
    ///
    /// # Errors
    /// No room, or the device is lost.
    fn step(&mut self, task: &StepTask<'_>) -> Result<StepOutcome, String>;
}
