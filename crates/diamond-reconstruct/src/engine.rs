//! What runs a training step and renders: the CPU now, a GPU later, behind one trait.
use crate::objective::TermValue;
use crate::region::Region;
use crate::{Blender, Guide, MediumTerm, Model, ReconstructError, StepPlan, Stepper, TensorFile};
use diamond_camera::Camera;
use diamond_image::{Image, Mask};
use diamond_light::OlatLight;
use diamond_shading::ShadedMaps;
use std::path::Path;

/// Another view that a photograph's view may be compared with.
#[derive(Debug, Clone, Copy)]
pub struct Neighbour<'a> {
    /// Where it is seen from.
    pub camera: &'a Camera,
    /// Decides at which pixels they are compared.
    pub seed: u64,
}

/// One photograph to learn from.
#[derive(Debug, Clone, Copy)]
pub struct TrainingPair<'a> {
    /// Where it was taken from.
    pub camera: &'a Camera,
    /// What lit it.
    pub light: &'a OlatLight,
    /// Linear RGB over black, the camera's size.
    pub radiance: &'a Image,
    /// Coverage, where known.
    pub mask: Option<&'a Mask>,
    /// Weight in the photometric terms (1 for photographs); of a picture that nobody took also in the mask's.
    pub weight: f32,
    /// Of a picture that nobody took how much of each pixel is believed, one channel, 0 … 1; `None` for photographs.
    pub believed: Option<&'a Image>,
    /// The rectangle outside of which `radiance` and `mask` are 0 everywhere; `None` where they are so altogether.
    pub content: Option<Region>,
    /// Index of the training view.
    pub view: usize,
    /// Index of the photograph among all training photographs; `usize::MAX` where it is none.
    pub image: usize,
    /// Another training view for geometric consistency; `None` where there is none or this step compares nothing.
    pub neighbour: Option<Neighbour<'a>>,
    /// What photometric stereo says of the view; `None` where it is not asked or cannot say.
    pub guide: Option<Guide<'a>>,
}

/// What one training step did.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct StepReport {
    /// Number of the step, from 0.
    pub step: u64,
    /// Weighted sum of all terms.
    pub objective: f32,
    /// Each term: name, weight, value (mean over the batch).
    pub terms: Vec<TermValue>,
    /// PSNR of the rendered training images in display sRGB, all pixels, dB; pictures that nobody took among them.
    pub psnr: f32,
    /// Gaussians after the step.
    pub gaussians: usize,
    /// Gaussians that could contribute to the last view.
    pub visible: usize,
    /// Gaussians cloned, split and pruned after this step; with relocation: added, none, and moved.
    pub density: [usize; 3],
}

/// A view under one light.
#[derive(Debug, Clone)]
pub struct Rendering {
    /// Linear RGB over black, times the global gain where exposure has one.
    pub radiance: Image,
    /// Surface part, linear RGB over black.
    pub surface: Image,
    /// Subsurface part, linear RGB over black.
    pub subsurface: Image,
    /// Opacity.
    pub opacity: Image,
    /// Material, normal, visibility and depth maps.
    pub maps: ShadedMaps,
}

/// Runs training steps and renders. The CPU implementation is [`crate::CpuEngine`].
pub trait Engine {
    /// Name for logs: `cpu` or a device's.
    fn name(&self) -> &str;

    /// One step: forward and backward over the batch, Adam, density control as `plan` says.
    fn training_step(
        &mut self,
        step: u64,
        plan: &StepPlan,
        batch: &[TrainingPair<'_>],
    ) -> Result<StepReport, ReconstructError>;

    /// Renders one camera under each light.
    fn render(&mut self, camera: &Camera, lights: &[OlatLight]) -> Result<Vec<Rendering>, ReconstructError>;

    /// From now on training pictures are blended by `blender`.
    fn blend_by(&mut self, blender: Box<dyn Blender>);

    /// From now on `stepper` makes the training steps that it can make; the others are made as before. What of a step without images it cannot do, in words
    /// of the configuration; `None`: nothing that is known beforehand.
    fn step_by(&mut self, stepper: Box<dyn Stepper>, plan: &StepPlan) -> Option<String>;

    /// What has happened since this was last asked that a user wants to know: which steps a stepper cannot make.
    fn take_notes(&mut self) -> Vec<String>;

    /// Takes a medium into the model, the first one or another.
    fn adopt_medium(&mut self, medium: MediumTerm) -> Result<(), ReconstructError>;

    /// The model as it stands.
    fn model(&mut self) -> Result<&Model, ReconstructError>;

    /// Everything that the next step depends on.
    fn state(&mut self) -> Result<TensorFile, ReconstructError>;

    /// Puts back what [`Engine::state`] gave; `path` names the file in errors.
    fn restore(&mut self, path: &Path, state: TensorFile) -> Result<(), ReconstructError>;

    /// Seconds spent so far in each part of a step, in order.
    fn profile(&self) -> Vec<(&'static str, f64)>;

    /// How much work the steps so far were, and would have been without leaving anything out.
    fn counters(&self) -> Vec<(&'static str, u64)>;
}
