//! Whole training steps on a device: parameters, moments, pictures, gradients and statistics stay there; what comes back of a step is what is logged.
use crate::adam::Update;
use crate::arrays::columns_of;
use crate::device_network::{self, INCIDENT, NetworkPass, RESIDUAL, TRUNK, d_outputs, outputs};
use crate::frame::Frame;
use crate::image_terms::Compared;
use crate::kernels::Module;
use crate::model_view::{ModelView, Sample, channel_bits, network};
use crate::parameter_arrays::ParameterLayout;
use crate::photographs::Photographs;
use crate::shape::{Column, Shape};
use crate::stage::{STAGES, Stage, Step, blend_pull_and_sum, steps};
use crate::workspace::{Bound, Store, Workspace};
use crate::{Device, GpuError, Lighting};
use bytemuck::{Pod, Zeroable};
use diamond_camera::Camera;
use diamond_image::Transfer;
use diamond_light::OlatLight;
use diamond_losses::Term;
use diamond_reconstruct::adam::Rows;
use diamond_reconstruct::{Attribute, ImageOutcome, Model, StepImage, StepOutcome, StepTask, TermValue};
use diamond_shading::{InputScaling, channel};
use diamond_splat::density::DensityStats;
use std::sync::Arc;

/// `Limits` of `clamp_scales.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct Limits {
    pub low: f32,
    pub high: f32,
    pub count: u32,
    pub unused_0: u32,
}

/// `Reduction` of `reduce.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct Reduction {
    pub count: u32,
    pub stride: u32,
    pub out_stride: u32,
    pub out_first: u32,
}

/// Rows that go through the network together: its layers take some 900 bytes per row.
const NETWORK_ROWS: u64 = 1 << 16;
/// Entries per Gaussian that room is made for before the first picture says how many there are.
const FIRST_GUESS: u64 = 4;
/// Room beyond what a picture needed: an eighth.
const SPARE: u64 = 8;
/// Groups of four sums per image: three of its terms, one of the photometric ones, one of visibility.
const SUMS: usize = 5;
/// Numbers that a workgroup of `reduce` adds up.
const REDUCED: u64 = 2048;
/// Words from one place of [`Store::Faults`] to the next: a binding's alignment.
const FAULT: u64 = 64;

/// What `DeviceStepper` works with.
#[derive(Debug)]
pub(crate) struct StepArrays {
    pub workspace: Workspace,
    pub layout: ParameterLayout,
    /// Numbers per Gaussian of the attachment to surfels; 0 without a medium.
    pub attached: bool,
    photographs: Photographs,
    capacity: u64,
    shape: Option<Shape>,
}

impl StepArrays {
    pub fn new(device: Arc<Device>) -> Result<Self, GpuError> {
        Ok(Self {
            workspace: Workspace::new(device)?,
            layout: ParameterLayout::default(),
            attached: false,
            photographs: Photographs::default(),
            capacity: 0,
            shape: None,
        })
    }

    /// Reads whole arrays of the rasteriser of the last step.
    pub fn read_columns(&self, columns: &[Column]) -> Result<Vec<Vec<f32>>, GpuError> {
        let Some(shape) = self.shape else { return Ok(vec![Vec::new(); columns.len()]) };
        let wanted: Vec<(Column, u64)> = columns.iter().map(|column| (*column, shape.words(*column))).collect();
        let read = self.workspace.raster.read(&self.workspace.device, &wanted)?;
        Ok(read.into_iter().map(|words| words.into_iter().map(f32::from_bits).collect()).collect())
    }

    /// Takes a model.
    pub fn load(&mut self, model: &Model, stats: &DensityStats) -> Result<(), GpuError> {
        self.layout = ParameterLayout::of(model);
        self.layout.load(&mut self.workspace, model, stats)?;
        self.attached = model.medium.is_some();
        let mut attachment = Vec::new();
        if let Some(medium) = &model.medium {
            let (surfels, weights) = medium.attachment().to_columns();
            let width = surfels.len() / model.len().max(1);
            for (surfels, weights) in surfels.chunks_exact(width.max(1)).zip(weights.chunks_exact(width.max(1))) {
                attachment.extend(surfels.iter().map(|s| *s as u32));
                attachment.extend(weights.iter().map(|w| w.to_bits()));
            }
        }
        self.workspace.upload(Store::Attachment, &attachment)?;
        self.workspace.upload(Store::Faults, &[u32::MAX; 4 * FAULT as usize])
    }

    /// Gives it back.
    pub fn store(&mut self, model: &mut Model, stats: &mut DensityStats) -> Result<(), GpuError> {
        self.layout.store(&self.workspace, model, stats)
    }

    /// A step. Where lists of tiles had too little room, it is made once more with enough; nothing has changed by then.
    pub fn step(&mut self, task: &StepTask<'_>) -> Result<StepOutcome, GpuError> {
        loop {
            if let Some(outcome) = self.attempt(task)? {
                return Ok(outcome);
            }
        }
    }

    fn attempt(&mut self, task: &StepTask<'_>) -> Result<Option<StepOutcome>, GpuError> {
        let images = task.images.len();
        let n = self.layout.gaussians;
        self.workspace.reserve(Store::RawGradient, self.layout.words())?;
        self.workspace.reserve(Store::Visibility, n)?;
        self.workspace.reserve(Store::Leaving, 4)?;
        self.workspace.reserve(Store::RowValues, 4 * n)?;
        self.workspace.reserve(Store::Totals, (4 * (SUMS * images + 2)) as u64)?;
        self.workspace.reserve(Store::Counts, (4 * images) as u64)?;
        self.reserve_network()?;
        let mut encoder = self.encoder();
        self.workspace.clear(&mut encoder, Store::RawGradient)?;
        self.workspace.clear(&mut encoder, Store::NetworkGradient)?;
        self.workspace.write(Store::Faults, 0, &[u32::MAX; 2 * FAULT as usize])?;
        if task.plan.collect_density {
            self.workspace.reserve(Store::StatisticsBefore, 4 * n)?;
            self.workspace.copy(&mut encoder, Store::Statistics, Store::StatisticsBefore)?;
        }
        self.workspace.device.submit(encoder)?;
        for (k, image) in task.images.iter().enumerate() {
            self.image(task, image, k)?;
        }
        let mut encoder = self.encoder();
        self.batch_terms(task, &mut encoder)?;
        for (place, store) in [Store::RawGradient, Store::NetworkGradient].into_iter().enumerate() {
            self.find_fault(&mut encoder, store, place as u64)?;
        }
        self.workspace.device.submit(encoder)?;
        let read = self.workspace.read(&[Store::Counts, Store::Totals, Store::Faults])?;
        let counts: Vec<u32> = read[0].iter().map(|v| v.to_bits()).collect();
        let wanted = counts.chunks_exact(4).take(images).map(|c| u64::from(c[2])).max().unwrap_or(0);
        if !self.has_room(wanted)? {
            if task.plan.collect_density {
                let mut encoder = self.encoder();
                self.workspace.copy(&mut encoder, Store::StatisticsBefore, Store::Statistics)?;
                self.workspace.device.submit(encoder)?;
            }
            return Ok(None);
        }
        if let Some(fault) = self.fault(&read[2]) {
            return Ok(Some(StepOutcome { not_finite: Some(fault), ..Default::default() }));
        }
        self.update(task)?;
        let sums: Vec<[f32; 4]> = read[1].chunks_exact(4).map(|c| [c[0], c[1], c[2], c[3]]).collect();
        Ok(Some(self.outcome(task, &counts, &sums)))
    }

    pub fn encoder(&self) -> wgpu::CommandEncoder {
        self.workspace.device.device.create_command_encoder(&Default::default())
    }

    /// What and where the first number is that is not finite.
    fn fault(&self, places: &[f32]) -> Option<[String; 2]> {
        let place = |k: u64| Some(places.get((k * FAULT) as usize)?.to_bits()).filter(|p| *p != u32::MAX);
        let raw = |place: u32| {
            let place = u64::from(place);
            let attribute = Attribute::ALL.into_iter().rfind(|a| self.layout.part(*a).0 <= place)?;
            let (first, width) = (self.layout.part(attribute).0, self.layout.width[attribute as usize].max(1));
            let detail = format!("Gaussian {}, component {}", (place - first) / width, (place - first) % width);
            Some((attribute.name(), detail))
        };
        if let Some((name, detail)) = place(0).and_then(raw) {
            return Some([format!("the gradient of `{name}`"), detail]);
        }
        if let Some(place) = place(1) {
            return Some(["the gradient of the network".into(), format!("parameter {place}")]);
        }
        if let Some((name, detail)) = place(2).and_then(raw) {
            return Some([format!("`{name}`, after the step before"), detail]);
        }
        place(3).map(|place| ["the network, after the step before".into(), format!("parameter {place}")])
    }

    fn find_fault(&self, encoder: &mut wgpu::CommandEncoder, store: Store, place: u64) -> Result<(), GpuError> {
        let arrays = [Bound::Store(store), Bound::Part(Store::Faults, place * FAULT, 4)];
        self.workspace.over(encoder, (Module::Finite, "finite"), None, &arrays, self.workspace.words(store)?)
    }

    fn outcome(&self, task: &StepTask<'_>, counts: &[u32], sums: &[[f32; 4]]) -> StepOutcome {
        let mut outcome = StepOutcome::default();
        for (k, image) in task.images.iter().enumerate() {
            let sums = &sums[SUMS * k..];
            let (mut terms, psnr) = compared(task, image).values(sums);
            if !image.samples.is_empty() {
                let drawn: u32 = image.samples.iter().map(|s| s[1]).sum();
                let (name, weight) = (Term::Visibility.name(), task.model.config.loss.visibility);
                terms.push(TermValue { name, weight, value: sums[4][0] / drawn as f32 });
            }
            outcome.images.push(ImageOutcome { terms, psnr, visible: counts[4 * k + 3] as usize });
        }
        let batch = &sums[SUMS * task.images.len()..];
        if let Some(pull) = &task.residual_pull {
            let value = batch[1][0] / (3 * pull.samples.len().max(1)) as f32;
            outcome.terms.push(TermValue { name: "residual_pull", weight: pull.weight, value });
        }
        if let Some(weight) = task.transfer_smoothness {
            outcome.terms.push(TermValue { name: "transfer_smoothness", weight, value: batch[0][0] });
        }
        outcome
    }

    /// Adam, and limits of the standard deviations; then looks for what is not finite, for the next step to say.
    fn update(&mut self, task: &StepTask<'_>) -> Result<(), GpuError> {
        let mut encoder = self.encoder();
        let sparse = task.model.config.adam.sparse;
        for (k, rate) in task.rates.iter().enumerate() {
            let (first, words) = self.layout.part(Attribute::ALL[k]);
            if *rate <= 0.0 || words == 0 {
                continue;
            }
            let width = self.layout.width[k] as usize;
            let rows = if sparse { Rows::Seen { width } } else { Rows::All };
            let stores = [Store::RawGradient, Store::Values, Store::FirstMoments, Store::SecondMoments];
            let arrays = stores.map(|store| Bound::Part(store, first, words));
            self.adam(&mut encoder, k as u32, Update::new(*rate, task.step + 1, rows), arrays, words)?;
        }
        if self.layout.network_words > 0 {
            let update = Update::new(task.plan.network_rate, task.step + 1, Rows::All);
            let stores = [Store::NetworkGradient, Store::Network, Store::NetworkFirst, Store::NetworkSecond];
            self.adam(&mut encoder, 13, update, stores.map(Bound::Store), self.layout.network_words)?;
        }
        let (first, words) = self.layout.part(Attribute::Scale);
        let [low, high] = task.scales.map(libm::logf);
        self.workspace.set("limits", 0, &Limits { low, high, count: words as u32, unused_0: 0 })?;
        let arrays = [Bound::Settings("limits", 0), Bound::Part(Store::Values, first, words)];
        self.workspace.over(&mut encoder, (Module::ClampScales, "clamp_scales"), None, &arrays, words)?;
        for (place, store) in [(2, Store::Values), (3, Store::Network)] {
            self.find_fault(&mut encoder, store, place)?;
        }
        self.workspace.device.submit(encoder)
    }

    fn adam(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        number: u32,
        update: Update,
        [gradient, values, first, second]: [Bound<'_>; 4],
        words: u64,
    ) -> Result<(), GpuError> {
        self.workspace.set("update", number, &update)?;
        self.workspace.set("values to update", number, &[words as u32, 0, 0, 0])?;
        let count = Bound::Settings("values to update", number);
        let arrays = [Bound::Settings("update", number), gradient, values, first, second, count];
        self.workspace.over(encoder, (Module::Adam, "adam"), None, &arrays, words)
    }

    /// Sums `groups` arrays of `count` groups of four that lie `stride` apart, into [`Store::Totals`] from a place on.
    pub fn reduce(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        from: Store,
        [count, stride, groups]: [u64; 3],
        place: usize,
    ) -> Result<(), GpuError> {
        let (mut from, mut count, mut stride) = (from, count, stride);
        for (level, next) in [Store::Partial, Store::Partial2, Store::Totals].into_iter().enumerate() {
            let blocks = count.div_ceil(REDUCED).max(1);
            let done = blocks == 1;
            let to = if done { Store::Totals } else { next };
            if !done {
                self.workspace.reserve(to, 4 * blocks * groups)?;
            }
            let out_first = if done { place as u32 } else { 0 };
            let reduction =
                Reduction { count: count as u32, stride: stride as u32, out_stride: blocks as u32, out_first };
            let number = 4 * place as u32 + level as u32;
            self.workspace.set("reduction", number, &reduction)?;
            let arrays = [Bound::Settings("reduction", number), Bound::Store(from), Bound::Store(to)];
            let grid = [blocks as u32, groups as u32];
            self.workspace.run(encoder, (Module::Reduce, "reduce"), None, &arrays, grid)?;
            if done {
                break;
            }
            (from, count, stride) = (to, blocks, blocks);
        }
        Ok(())
    }
}

/// How an image is compared.
fn compared<'a>(task: &StepTask<'a>, image: &StepImage<'a>) -> Compared<'a> {
    let k = &image.pair.camera.intrinsics;
    Compared {
        loss: &task.model.config.loss,
        needs: task.needs,
        size: [k.width, k.height],
        masked: image.pair.mask.is_some(),
        weight: image.pair.weight,
        believed: image.pair.believed.is_some(),
        share: 1.0 / task.images.len().max(1) as f32,
    }
}

fn too_many(entries: u64) -> GpuError {
    GpuError::Limit { what: "lists of tiles", needed: entries.saturating_mul(8), limit: u64::from(u32::MAX) * 8 }
}

/// Arrays of the rasteriser that a step reads or writes beside its stages.
const COLUMNS: [Column; 9] = [
    Column::Means,
    Column::FormA,
    Column::FormB,
    Column::Features,
    Column::Outlines,
    Column::Counts,
    Column::Picture,
    Column::Coverage,
    Column::DPicture,
];

impl StepArrays {
    /// How large the arrays of a view are.
    pub fn shape_of(&mut self, camera: &Camera) -> Result<Shape, GpuError> {
        let n = self.layout.gaussians;
        let size = [camera.intrinsics.width, camera.intrinsics.height].map(u64::from);
        self.capacity = self.capacity.max(FIRST_GUESS * n);
        let limit = self.workspace.device.max_binding();
        let shape = Shape::new(n, size, channel::COUNT, self.capacity, limit)?;
        if shape.pieces != 1 {
            let needed = shape.words(Column::Rows) * 4 * shape.pieces as u64;
            return Err(GpuError::Limit { what: "gradients of entries", needed, limit });
        }
        u32::try_from(shape.capacity).map_err(|_| too_many(shape.capacity))?;
        self.shape = Some(shape);
        Ok(shape)
    }

    /// Whether so many entries had room; else there is room for them from now on.
    pub fn has_room(&mut self, wanted: u64) -> Result<bool, GpuError> {
        if wanted <= self.capacity {
            return Ok(true);
        }
        if wanted == u64::from(u32::MAX) {
            return Err(too_many(wanted));
        }
        self.capacity = wanted + wanted / SPARE;
        Ok(false)
    }

    /// Makes room for the network's layers.
    pub fn reserve_network(&mut self) -> Result<(), GpuError> {
        let rows = self.layout.gaussians.clamp(1, NETWORK_ROWS);
        device_network::reserve(&mut self.workspace, &self.layout, rows)
    }

    /// Pieces in which the Gaussians go through the network.
    pub fn chunks(&self) -> u64 {
        self.layout.gaussians.div_ceil(NETWORK_ROWS).max(1)
    }

    /// Forward and backward for one image: its gradient is added to that of the parameters.
    fn image(&mut self, task: &StepTask<'_>, image: &StepImage<'_>, k: usize) -> Result<(), GpuError> {
        let camera = image.pair.camera;
        let n = self.layout.gaussians;
        let shape = self.shape_of(camera)?;
        let capacity = shape.capacity as u32;
        let forward: Vec<Step> = STAGES
            .iter()
            .filter(|row| !row.backward && row.stage != Stage::Blend)
            .flat_map(|row| steps(row.stage, &shape))
            .collect();
        let (blend, back) = (steps(Stage::Blend, &shape), blend_pull_and_sum(&shape));
        let last = steps(Stage::ProjectionPull, &shape);
        let mut columns: Vec<Column> =
            [&forward, &blend, &back, &last].into_iter().flat_map(|s| columns_of(s)).collect();
        columns.extend(COLUMNS);
        self.workspace.reserve_columns(&shape, &columns)?;
        let frame = Frame::new(camera, task.raster, n as u32, false, capacity);
        self.workspace.set_frame(&frame);
        self.workspace.raster.write(&self.workspace.device, Column::Counts, 0, &[n as u32, 0, 0, 0])?;
        self.upload(image, task.model.config.loss.space.transfer())?;
        let channels = channel_bits(&task.needs.layout);
        self.workspace.set("places", 0, &self.layout.raw(channels))?;
        let view = self.view(task, image, channels);
        let mut encoder = self.encoder();
        let e = &mut encoder;

        self.activate(e, &shape)?;
        self.workspace.stages(e, &forward)?;
        self.workspace.copy_column(e, Column::Counts, Store::Counts, 4 * k as u64, 4)?;
        self.see(task.needs.visibility, image.traced.is_some(), &view, e, &shape)?;
        let chunks = self.chunks();
        for chunk in 0..chunks {
            self.residual(view, chunk, e, &shape)?;
        }
        if task.medium.is_some() {
            self.medium(e, &shape, false)?;
        }
        self.workspace.stages(e, &blend)?;
        self.shade_and_compare(task, image, e, &shape)?;
        self.workspace.stages(e, &back)?;
        self.workspace.stages(e, &last)?;
        if task.medium.is_some() {
            self.medium(e, &shape, true)?;
        }
        for chunk in 0..chunks {
            if chunks > 1 {
                // Layers have room for one chunk: its outputs are made once more.
                self.network_forward(view, chunk, e, &shape)?;
            }
            self.residual_pull(task, view, chunk, e, &shape)?;
        }
        self.activate_pull(e, &shape)?;
        if task.plan.collect_density {
            let arrays =
                [Bound::Column(Column::Gradient), Bound::Column(Column::Outlines), Bound::Store(Store::Statistics)];
            self.workspace.over(e, (Module::DensityStats, "record_view"), Some(&shape), &arrays, n)?;
        }
        self.visibility_term(task, image, view, e, &shape, k)?;
        let pixels = shape.pixels();
        self.reduce(e, Store::TermValues, [pixels, pixels, 3], SUMS * k)?;
        self.reduce(e, Store::PhotometricTerms, [3 * pixels, 3 * pixels, 1], SUMS * k + 3)?;
        self.workspace.device.submit(encoder)
    }

    /// What the image brings: photograph, mask, traced visibility, light under the surface.
    fn upload(&mut self, image: &StepImage<'_>, space: Transfer) -> Result<(), GpuError> {
        self.photographs.keep(&self.workspace.device, image, space)?;
        if let Some(traced) = &image.traced {
            self.workspace.write(Store::Visibility, 0, bytemuck::cast_slice(traced))?;
        }
        if let Some(leaving) = &image.leaving {
            self.workspace.upload(Store::Leaving, bytemuck::cast_slice(leaving))?;
        }
        let samples: Vec<u32> = image.samples.iter().flatten().copied().collect();
        self.workspace.upload(Store::VisibilitySamples, &samples)?;
        let pixels = u64::from(image.pair.camera.intrinsics.width) * u64::from(image.pair.camera.intrinsics.height);
        for (store, words) in [
            (Store::Record, 24),
            (Store::Linear, 3),
            (Store::Encoded, 3),
            (Store::Fields, 12),
            (Store::Means, 3),
            (Store::DLinear, 3),
            (Store::PhotometricTerms, 12),
            (Store::DRecord, 20),
            (Store::TermValues, 12),
        ] {
            self.workspace.reserve(store, words * pixels)?;
        }
        Ok(())
    }

    fn view(&self, task: &StepTask<'_>, image: &StepImage<'_>, channels: u32) -> ModelView {
        let view = self.model_view(task.model, image.pair.camera, &image.light, &task.scaling, channels);
        task.medium.as_ref().map_or(view, |medium| view.with_medium(medium))
    }

    /// What the stages of the residual know, but for a medium.
    pub fn model_view(
        &self,
        model: &Model,
        camera: &Camera,
        light: &OlatLight,
        scaling: &InputScaling,
        channels: u32,
    ) -> ModelView {
        let residual = &model.config.residual;
        let heads = self.layout.network.len();
        let flag = |there: bool, bit: u32| if there { bit } else { 0 };
        ModelView {
            channels,
            codes: residual.codes as u32,
            harmonics: (residual.transfer_width() / 3) as u32,
            network: flag(heads > 0, network::THERE)
                | flag(heads > INCIDENT, network::INCIDENT)
                | flag(residual.incident_gradient, network::INCIDENT_LEARNS)
                | flag(residual.normal_gradient, network::NORMALS_LEARN),
            width: self.layout.network.first().map_or(0, |(shape, _)| shape.inputs() as u32),
            ..ModelView::new(camera, light, scaling)
        }
    }

    fn surface(&self, store: Store) -> Bound<'static> {
        let (first, words) = self.layout.surface();
        Bound::Part(store, first, words)
    }

    fn attribute(&self, store: Store, attribute: Attribute) -> Bound<'static> {
        let (first, words) = self.layout.part(attribute);
        // An attribute without numbers shares its place with the next one; nothing is read there.
        let first = first.min(self.layout.words().saturating_sub(FAULT));
        Bound::Part(store, first, words)
    }

    pub fn activate(&self, e: &mut wgpu::CommandEncoder, shape: &Shape) -> Result<(), GpuError> {
        let columns = [Column::Means, Column::FormA, Column::FormB, Column::Features].map(Bound::Column);
        let [a, b, c, d] = columns;
        let arrays = [Bound::Settings("places", 0), self.surface(Store::Values), a, b, c, d];
        self.workspace.over(e, (Module::Activate, "activate"), Some(shape), &arrays, self.layout.gaussians)
    }

    fn activate_pull(&self, e: &mut wgpu::CommandEncoder, shape: &Shape) -> Result<(), GpuError> {
        let arrays = [
            Bound::Settings("places", 0),
            self.surface(Store::Values),
            Bound::Column(Column::Gradient),
            Bound::Column(Column::DFeatures),
            self.surface(Store::RawGradient),
        ];
        self.workspace.over(e, (Module::ActivatePull, "activate_pull"), Some(shape), &arrays, self.layout.gaussians)
    }

    /// Visibility of the light, where none is traced.
    pub fn see(
        &mut self,
        needed: bool,
        traced: bool,
        view: &ModelView,
        e: &mut wgpu::CommandEncoder,
        shape: &Shape,
    ) -> Result<(), GpuError> {
        self.workspace.set("view", 0, view)?;
        if !needed {
            return self.workspace.clear(e, Store::Visibility);
        }
        if traced {
            return Ok(());
        }
        let arrays = [
            Bound::Settings("view", 0),
            Bound::Column(Column::Means),
            self.attribute(Store::Values, Attribute::VisibilitySh),
            Bound::Store(Store::Visibility),
        ];
        let kernel = (Module::VisibilityFit, "visibility_fit");
        self.workspace.over(e, kernel, Some(shape), &arrays, self.layout.gaussians)
    }

    /// The settings of a chunk of rows: those of number 0 are of the whole view.
    fn chunk(&mut self, view: ModelView, chunk: u64) -> Result<(u32, u64), GpuError> {
        let first = chunk * NETWORK_ROWS;
        let rows = (self.layout.gaussians - first).min(NETWORK_ROWS);
        let number = 2 + chunk as u32;
        self.workspace.set("view", number, &ModelView { first: first as u32, rows: rows as u32, ..view })?;
        Ok((number, rows))
    }

    fn network_forward(
        &mut self,
        view: ModelView,
        chunk: u64,
        e: &mut wgpu::CommandEncoder,
        shape: &Shape,
    ) -> Result<(), GpuError> {
        let (number, rows) = self.chunk(view, chunk)?;
        if self.layout.network.is_empty() {
            return Ok(());
        }
        let arrays = [
            Bound::Settings("view", number),
            Bound::Column(Column::Means),
            Bound::Column(Column::FormA),
            Bound::Column(Column::FormB),
            Bound::Column(Column::Features),
            Bound::Store(Store::Visibility),
            self.attribute(Store::Values, Attribute::Codes),
            Bound::Store(Store::Inputs),
        ];
        self.workspace.over(e, (Module::ResidualInputs, "residual_inputs"), Some(shape), &arrays, rows)?;
        let pass = NetworkPass { layout: &self.layout, rows: rows as u32, number };
        pass.forward(&mut self.workspace, e, &[TRUNK, RESIDUAL, INCIDENT])
    }

    fn outputs(&self, part: usize) -> Bound<'static> {
        Bound::Store(outputs(&self.layout, part).unwrap_or(Store::One))
    }

    pub fn residual(
        &mut self,
        view: ModelView,
        chunk: u64,
        e: &mut wgpu::CommandEncoder,
        shape: &Shape,
    ) -> Result<(), GpuError> {
        self.network_forward(view, chunk, e, shape)?;
        let (number, rows) = self.chunk(view, chunk)?;
        let arrays = [
            Bound::Settings("view", number),
            Bound::Column(Column::Means),
            self.outputs(RESIDUAL),
            self.outputs(INCIDENT),
            Bound::Store(Store::Visibility),
            self.attribute(Store::Values, Attribute::Transfer),
            Bound::Column(Column::Features),
        ];
        self.workspace.over(e, (Module::ResidualOutputs, "residual_outputs"), Some(shape), &arrays, rows)
    }

    fn residual_pull(
        &mut self,
        task: &StepTask<'_>,
        view: ModelView,
        chunk: u64,
        e: &mut wgpu::CommandEncoder,
        shape: &Shape,
    ) -> Result<(), GpuError> {
        let (number, rows) = self.chunk(view, chunk)?;
        let d = |part: usize| d_outputs(&self.layout, part);
        let arrays = [
            Bound::Settings("view", number),
            Bound::Column(Column::Means),
            Bound::Column(Column::DFeatures),
            // Two different arrays, also where nothing is written to them.
            Bound::Store(d(RESIDUAL).unwrap_or(Store::DShared)),
            Bound::Store(d(INCIDENT).unwrap_or(Store::DInputs)),
            self.attribute(Store::RawGradient, Attribute::Transfer),
        ];
        self.workspace.over(e, (Module::ResidualGather, "residual_gather"), Some(shape), &arrays, rows)?;
        if self.layout.network.is_empty() {
            return Ok(());
        }
        let with_inputs = task.needs.input_gradient;
        let pass = NetworkPass { layout: &self.layout, rows: rows as u32, number };
        pass.backward(&mut self.workspace, e, &[RESIDUAL, INCIDENT], with_inputs)?;
        if !with_inputs {
            return Ok(());
        }
        let arrays = [
            Bound::Settings("view", number),
            Bound::Store(Store::DInputs),
            Bound::Column(Column::DFeatures),
            self.attribute(Store::RawGradient, Attribute::Codes),
        ];
        self.workspace.over(e, (Module::ResidualScatter, "residual_scatter"), Some(shape), &arrays, rows)
    }

    fn medium(&self, e: &mut wgpu::CommandEncoder, shape: &Shape, backward: bool) -> Result<(), GpuError> {
        let mut arrays = vec![
            Bound::Settings("view", 0),
            Bound::Column(Column::Means),
            Bound::Store(Store::Visibility),
            Bound::Store(Store::Attachment),
            Bound::Store(Store::Leaving),
            Bound::Column(Column::Features),
        ];
        let mut kernel = (Module::MediumRows, "medium_rows");
        if backward {
            arrays.extend([Bound::Column(Column::DFeatures), Bound::Column(Column::Gradient)]);
            kernel = (Module::MediumPull, "medium_pull");
        }
        self.workspace.over(e, kernel, Some(shape), &arrays, self.layout.gaussians)
    }

    /// From the blended channels to their cotangents.
    fn shade_and_compare(
        &mut self,
        task: &StepTask<'_>,
        image: &StepImage<'_>,
        e: &mut wgpu::CommandEncoder,
        shape: &Shape,
    ) -> Result<(), GpuError> {
        let compared = compared(task, image);
        self.workspace.set("light", 0, &Lighting::new(&image.light, task.shading))?;
        self.workspace.set("photometric", 0, &compared.photometric())?;
        self.workspace.set("terms", 0, &compared.terms())?;
        let photograph = self.photographs.of(image)?;
        let pixels = shape.pixels();
        let (picture, coverage) = (Bound::Column(Column::Picture), Bound::Column(Column::Coverage));
        let light = Bound::Settings("light", 0);
        let (record, d_record) = (Bound::Store(Store::Record), Bound::Store(Store::DRecord));
        let w = &self.workspace;
        w.over(e, (Module::Shade, "shade"), Some(shape), &[light, picture, coverage, record], pixels)?;
        let arrays = [record, Bound::Store(Store::Linear)];
        w.over(e, (Module::Radiance, "radiance"), Some(shape), &arrays, pixels)?;
        let arrays = [
            Bound::Settings("photometric", 0),
            Bound::Store(Store::Linear),
            Bound::Store(Store::Encoded),
            Bound::Kept(&photograph.encoded),
            Bound::Store(Store::Fields),
            Bound::Store(Store::Means),
            Bound::Store(Store::DLinear),
            Bound::Store(Store::PhotometricTerms),
        ];
        let tiles = shape.tiles().map(|n| n as u32);
        w.over(e, (Module::Photometric, "encode"), Some(shape), &arrays, 3 * pixels)?;
        w.run(e, (Module::Photometric, "compare_windows"), Some(shape), &arrays, tiles)?;
        w.run(e, (Module::Photometric, "gather_gradient"), Some(shape), &arrays, tiles)?;
        let arrays = [
            Bound::Settings("terms", 0),
            record,
            Bound::Kept(&photograph.pixels),
            coverage,
            Bound::Store(Store::DLinear),
            d_record,
            Bound::Store(Store::TermValues),
        ];
        w.over(e, (Module::ImageTerms, "image_terms"), Some(shape), &arrays, pixels)?;
        let (d_picture, d_coverage) = (Bound::Column(Column::DPicture), Bound::Column(Column::DCoverage));
        let arrays = [light, picture, coverage, d_record, d_picture, d_coverage];
        w.over(e, (Module::ShadePull, "shade_pull"), Some(shape), &arrays, pixels)
    }

    fn visibility_term(
        &mut self,
        task: &StepTask<'_>,
        image: &StepImage<'_>,
        view: ModelView,
        e: &mut wgpu::CommandEncoder,
        shape: &Shape,
        k: usize,
    ) -> Result<(), GpuError> {
        let samples = image.samples.len() as u64;
        if samples == 0 {
            return Ok(());
        }
        let drawn: u32 = image.samples.iter().map(|s| s[1]).sum();
        let share = 1.0 / task.images.len() as f32;
        let weight = share * task.model.config.loss.visibility / drawn as f32;
        self.workspace.set("view", 1, &ModelView { rows: samples as u32, weight, ..view })?;
        let arrays = [
            Bound::Settings("view", 1),
            Bound::Column(Column::Means),
            self.attribute(Store::Values, Attribute::VisibilitySh),
            Bound::Store(Store::Visibility),
            Bound::Store(Store::VisibilitySamples),
            self.attribute(Store::RawGradient, Attribute::VisibilitySh),
            Bound::Store(Store::RowValues),
        ];
        self.workspace.over(e, (Module::VisibilityTerm, "visibility_term"), Some(shape), &arrays, samples)?;
        self.reduce(e, Store::RowValues, [samples, samples, 1], SUMS * k + 4)
    }

    /// Terms of the whole batch: shrinkage of transfer vectors, the residual's pull toward nothing.
    fn batch_terms(&mut self, task: &StepTask<'_>, e: &mut wgpu::CommandEncoder) -> Result<(), GpuError> {
        let (Some(shape), Some(image)) = (self.shape, task.images.last()) else { return Ok(()) };
        let view = self.view(task, image, channel_bits(&task.needs.layout));
        let place = SUMS * task.images.len();
        let n = self.layout.gaussians;
        if let Some(weight) = task.transfer_smoothness {
            let number = u32::MAX;
            self.workspace.set("view", number, &ModelView { weight, ..view })?;
            let arrays = [
                Bound::Settings("view", number),
                self.attribute(Store::Values, Attribute::Transfer),
                self.attribute(Store::RawGradient, Attribute::Transfer),
                Bound::Store(Store::RowValues),
            ];
            let kernel = (Module::TransferSmoothness, "transfer_smoothness");
            self.workspace.over(e, kernel, Some(&shape), &arrays, n)?;
            self.reduce(e, Store::RowValues, [n, n, 1], place)?;
        }
        let Some(pull) = task.residual_pull.as_ref().filter(|pull| !pull.samples.is_empty()) else { return Ok(()) };
        let samples: Vec<Sample> = pull.samples.iter().map(Sample::of).collect();
        self.workspace.upload(Store::PullSamples, bytemuck::cast_slice(&samples))?;
        let rows = samples.len() as u64;
        let number = u32::MAX - 1;
        let (weight, sample_distance) = (pull.weight, pull.distance);
        self.workspace.set("view", number, &ModelView { rows: rows as u32, weight, sample_distance, ..view })?;
        let settings = Bound::Settings("view", number);
        let drawn = Bound::Store(Store::PullSamples);
        let pass = NetworkPass { layout: &self.layout, rows: rows as u32, number: 1 };
        if !self.layout.network.is_empty() {
            let arrays = [
                settings,
                Bound::Column(Column::Means),
                Bound::Column(Column::FormA),
                Bound::Column(Column::FormB),
                Bound::Column(Column::Features),
                drawn,
                self.attribute(Store::Values, Attribute::Codes),
                Bound::Store(Store::Inputs),
            ];
            self.workspace.over(e, (Module::SampledInputs, "sampled_inputs"), Some(&shape), &arrays, rows)?;
            pass.forward(&mut self.workspace, e, &[TRUNK, RESIDUAL])?;
        }
        let arrays = [
            settings,
            drawn,
            self.outputs(RESIDUAL),
            self.attribute(Store::Values, Attribute::Transfer),
            Bound::Store(d_outputs(&self.layout, RESIDUAL).unwrap_or(Store::DShared)),
            self.attribute(Store::RawGradient, Attribute::Transfer),
            Bound::Store(Store::RowValues),
        ];
        self.workspace.over(e, (Module::SampledPull, "sampled_pull"), Some(&shape), &arrays, rows)?;
        if !self.layout.network.is_empty() {
            let codes = view.codes > 0;
            pass.backward(&mut self.workspace, e, &[RESIDUAL], codes)?;
            if codes {
                let arrays = [
                    settings,
                    drawn,
                    Bound::Store(Store::DInputs),
                    self.attribute(Store::RawGradient, Attribute::Codes),
                ];
                let threads = rows * u64::from(view.codes);
                self.workspace.over(e, (Module::SampledScatter, "sampled_scatter"), Some(&shape), &arrays, threads)?;
            }
        }
        self.reduce(e, Store::RowValues, [rows, rows, 1], place + 1)
    }
}
