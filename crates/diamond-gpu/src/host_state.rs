//! A picture's arrays on the host, so that each stage can be run on either side and compared: stages up to one on the CPU, those
//! after it on the device, or any other way.
use crate::arrays::{Arrays, columns_of};
use crate::shape::{Column, Shape};
use crate::stage::{STAGES, Stage, steps};
use crate::{Device, Frame, GpuError, scene_arrays, twin};
use diamond_camera::Camera;
use diamond_splat::{Features, Gaussians, RasterConfig, RasterGrad};
use std::collections::BTreeMap;

/// What is rasterised, and the cotangent of the picture.
#[derive(Debug, Clone)]
pub struct RasterScene {
    /// Gaussians.
    pub gaussians: Gaussians,
    /// Their features.
    pub features: Features,
    /// The view.
    pub camera: Camera,
    /// Thresholds.
    pub config: RasterConfig,
    /// Cotangent of the picture.
    pub d: RasterGrad,
}

/// The arrays of a picture on the host.
#[derive(Debug, Clone)]
pub struct HostState {
    /// What is rasterised.
    pub scene: RasterScene,
    /// Sizes.
    pub shape: Shape,
    /// What all kernels know.
    pub frame: Frame,
    columns: BTreeMap<Column, Vec<u32>>,
}

/// Where a stage is run.
#[derive(Debug, Clone, Copy)]
pub enum Side<'d> {
    /// By its twin.
    Cpu,
    /// By its kernels.
    Gpu(&'d Device),
}

impl HostState {
    /// The arrays of a scene before the first stage, all else 0, with room for exactly the entries that the twins find.
    ///
    /// # Errors
    /// What the CPU's rasteriser refuses; arrays beyond `max_binding` bytes.
    pub fn new(scene: RasterScene, max_binding: u64) -> Result<Self, GpuError> {
        let (gaussians, k) = (&scene.gaussians, &scene.camera.intrinsics);
        gaussians.validate()?;
        scene.features.validate(gaussians.len())?;
        let n = gaussians.len() as u64;
        let size = [u64::from(k.width), u64::from(k.height)];
        let make = |capacity: u64| -> Result<(Shape, Frame), GpuError> {
            let shape = Shape::new(n, size, scene.features.channels, capacity, max_binding)?;
            let factors = !gaussians.factors.is_empty();
            Ok((shape, Frame::new(&scene.camera, &scene.config, n as u32, factors, capacity as u32)))
        };
        let (shape, frame) = make(0)?;
        let mut state = Self { scene: scene.clone(), shape, frame, columns: BTreeMap::new() };
        twin::projection(&mut state)?;
        let entries: u64 = state.get(Column::TileCounts).iter().map(|count| u64::from(*count)).sum();
        (state.shape, state.frame) = make(entries)?;
        state.columns.clear();
        let forms = scene_arrays::gaussians(&scene.gaussians);
        for (column, words) in [Column::Means, Column::FormA, Column::FormB].into_iter().zip(forms) {
            state.set(column, words);
        }
        let (shape, d) = (state.shape, &scene.d);
        state.set(Column::Features, scene_arrays::pieces(&shape, Column::Features, &scene.features.data));
        state.set(Column::DPicture, scene_arrays::pieces(&shape, Column::DPicture, d.features.data()));
        state.set(Column::DCoverage, scene_arrays::d_coverage(&d.opacity, &d.depth));
        state.set(Column::Counts, vec![n as u32, 0, 0, 0]);
        Ok(state)
    }

    /// The words of an array; zeros where no stage has written it.
    pub fn get(&self, column: Column) -> Vec<u32> {
        let mut words = self.columns.get(&column).cloned().unwrap_or_default();
        words.resize(self.shape.words(column) as usize, 0);
        words
    }

    /// The same words as another type of the same layout.
    pub fn get_as<T: bytemuck::Pod>(&self, column: Column) -> Vec<T> {
        bytemuck::pod_collect_to_vec(&self.get(column))
    }

    /// Replaces an array.
    pub fn set<T: bytemuck::Pod>(&mut self, column: Column, values: Vec<T>) {
        self.columns.insert(column, bytemuck::pod_collect_to_vec(&values));
    }

    /// Runs one stage.
    ///
    /// # Errors
    /// Whatever the side refuses.
    pub fn run(&mut self, stage: Stage, side: Side<'_>) -> Result<(), GpuError> {
        match side {
            Side::Cpu => twin::run(stage, self),
            Side::Gpu(device) => self.run_on(stage, device),
        }
    }

    /// Runs all stages: the first `on_cpu` by their twins, the others on a device.
    ///
    /// # Errors
    /// Whatever a stage refuses.
    pub fn run_all(&mut self, on_cpu: usize, device: &Device) -> Result<(), GpuError> {
        for (k, row) in STAGES.iter().enumerate() {
            self.run(row.stage, if k < on_cpu { Side::Cpu } else { Side::Gpu(device) })?;
        }
        Ok(())
    }

    fn run_on(&mut self, stage: Stage, device: &Device) -> Result<(), GpuError> {
        let steps = steps(stage, &self.shape);
        let columns = columns_of(&steps);
        let mut arrays = Arrays::new(device)?;
        arrays.reserve(device, &self.shape, &columns)?;
        arrays.set_frame(device, &self.frame);
        for &column in &columns {
            arrays.write(device, column, 0, &self.get(column))?;
        }
        let mut encoder = device.device.create_command_encoder(&Default::default());
        arrays.encode(device, &mut encoder, &steps)?;
        device.submit(encoder)?;
        let parts: Vec<(Column, u64)> = columns.iter().map(|column| (*column, self.shape.words(*column))).collect();
        for (&column, words) in columns.iter().zip(arrays.read(device, &parts)?) {
            self.columns.insert(column, words);
        }
        Ok(())
    }

    /// The picture's channels, row by row.
    pub fn picture(&self) -> Vec<f32> {
        scene_arrays::rows(&self.shape, Column::Picture, &self.get(Column::Picture), self.shape.pixels() as usize)
    }

    /// The gradient of the features, row by row.
    pub fn d_features(&self) -> Vec<f32> {
        scene_arrays::rows(&self.shape, Column::DFeatures, &self.get(Column::DFeatures), self.scene.gaussians.len())
    }
}
