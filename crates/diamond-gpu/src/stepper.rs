//! [`Stepper`] on a device.
use crate::step_arrays::StepArrays;
use crate::workspace::Store;
use crate::{Device, GpuError};
use diamond_reconstruct::{
    Covariance, Model, StepNeeds, StepOutcome, StepTask, Stepper, SubsurfaceModel, TrainingPair,
};
use diamond_splat::density::DensityStats;
use std::sync::Arc;

/// Makes whole training steps on a device. Parameters, moments, statistics, photographs, pictures and gradients stay there; what comes back of a step
/// is what is logged: sums of terms, numbers of visible Gaussians and of list entries.
///
/// Two runs on one device give the same bits. What it cannot do says [`Stepper::lacks`].
#[derive(Debug)]
pub struct DeviceStepper {
    arrays: StepArrays,
}

/// Layers that a part of the network may have.
const MAX_LAYERS: usize = 7;

/// Whether a part of the network has too many layers.
pub(crate) fn too_deep(model: &Model) -> bool {
    let layers = |mlp: &diamond_shading::Mlp| mlp.shape.layers();
    model.network.as_ref().is_some_and(|network| {
        let heads = network.incident_head.as_ref().map_or(0, layers).max(layers(&network.residual_head));
        layers(&network.trunk).max(heads) > MAX_LAYERS
    })
}

impl DeviceStepper {
    /// On a device.
    ///
    /// # Errors
    /// The device has no room left.
    pub fn new(device: Arc<Device>) -> Result<Self, GpuError> {
        Ok(Self { arrays: StepArrays::new(device)? })
    }

    /// Reads arrays of the last step, for comparisons with the CPU.
    ///
    /// # Errors
    /// There was no step, or the device is lost.
    pub fn read(&self, stores: &[Store]) -> Result<Vec<Vec<f32>>, GpuError> {
        self.arrays.workspace.read(stores)
    }

    /// Reads arrays of the rasteriser of the last step, for comparisons with the CPU.
    ///
    /// # Errors
    /// There was no step, or the device is lost.
    pub fn read_columns(&self, columns: &[crate::Column]) -> Result<Vec<Vec<f32>>, GpuError> {
        self.arrays.read_columns(columns)
    }
}

impl Stepper for DeviceStepper {
    fn name(&self) -> &str {
        &self.arrays.workspace.device.adapter().name
    }

    fn lacks(&self, model: &Model, needs: &StepNeeds, batch: &[TrainingPair<'_>]) -> Option<String> {
        let config = &model.config;
        let walks = matches!(config.subsurface.model, SubsurfaceModel::Walk | SubsurfaceModel::WalkMlp);
        let lacking = [
            (model.is_empty(), "a model without Gaussians"),
            (config.model.covariance == Covariance::Cholesky, "model.covariance = \"cholesky\""),
            (model.medium.is_some() && walks, "subsurface.model: random walks"),
            (too_deep(model), "residual.hidden: more than seven layers"),
            (needs.silhouette_consistency || needs.depth_consistency, "steps that compare views (loss.*_consistency)"),
            (batch.iter().any(|pair| pair.guide.is_some_and(|g| g.weight > 0.0)), "photometric.supervise"),
        ];
        lacking.into_iter().find(|(lacks, _)| *lacks).map(|(_, what)| what.to_owned())
    }

    fn load(&mut self, model: &Model, stats: &DensityStats) -> Result<(), String> {
        self.arrays.load(model, stats).map_err(|error| error.to_string())
    }

    fn store(&mut self, model: &mut Model, stats: &mut DensityStats) -> Result<(), String> {
        self.arrays.store(model, stats).map_err(|error| error.to_string())
    }

    fn step(&mut self, task: &StepTask<'_>) -> Result<StepOutcome, String> {
        self.arrays.step(task).map_err(|error| error.to_string())
    }
}
