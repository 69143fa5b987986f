//! Pictures of a view under many lights on a device: one projection, one sorting, and five channels per light.
use crate::arrays::columns_of;
use crate::frame::Frame;
use crate::kernels::Module;
use crate::model_view::channel_bits;
use crate::shape::{Column, Shape};
use crate::stage::{STAGES, Step, steps};
use crate::step_arrays::StepArrays;
use crate::workspace::{Bound, Store};
use crate::{Device, GpuError, Lighting};
use diamond_image::Image;
use diamond_reconstruct::{Covariance, Model, RelightLight, RelightView, Relighter};
use diamond_shading::channel;
use diamond_splat::density::DensityStats;
use std::sync::Arc;

/// Lights whose channels are blended together: five each of sixteen.
const TOGETHER: usize = 3;

/// Makes pictures of a view under many lights on a device: Gaussians are projected, sorted and blended once, then for each light the network's rows, five
/// channels, and the shader.
#[derive(Debug)]
pub struct DeviceRelighter {
    arrays: StepArrays,
    loaded: bool,
}

impl DeviceRelighter {
    /// On a device.
    ///
    /// # Errors
    /// The device has no room left.
    pub fn new(device: Arc<Device>) -> Result<Self, GpuError> {
        Ok(Self { arrays: StepArrays::new(device)?, loaded: false })
    }

    fn make_view(&mut self, view: &RelightView<'_>) -> Result<(), GpuError> {
        if !self.loaded {
            self.arrays.load(view.model, &DensityStats::new(view.model.len()))?;
            self.loaded = true;
        }
        while !self.arrays.try_view(view)? {}
        Ok(())
    }

    fn make_radiance(&mut self, view: &RelightView<'_>, lights: &[RelightLight]) -> Result<Vec<Image>, GpuError> {
        let mut out = Vec::with_capacity(lights.len());
        for group in lights.chunks(TOGETHER) {
            out.extend(self.arrays.relight(view, group)?);
        }
        Ok(out)
    }
}

impl Relighter for DeviceRelighter {
    fn name(&self) -> &str {
        &self.arrays.workspace.device.adapter().name
    }

    fn lacks(&self, model: &Model) -> Option<String> {
        let lacking = [
            (model.is_empty(), "a model without Gaussians"),
            (model.config.model.covariance == Covariance::Cholesky, "model.covariance = \"cholesky\""),
            (crate::stepper::too_deep(model), "residual.hidden: more than seven layers"),
        ];
        lacking.into_iter().find(|(lacks, _)| *lacks).map(|(_, what)| what.to_owned())
    }

    fn view(&mut self, view: &RelightView<'_>) -> Result<(), String> {
        self.make_view(view).map_err(|error| error.to_string())
    }

    fn radiance(&mut self, view: &RelightView<'_>, lights: &[RelightLight]) -> Result<Vec<Image>, String> {
        self.make_radiance(view, lights).map_err(|error| error.to_string())
    }
}

impl StepArrays {
    /// Projects, sorts and blends what does not depend on the light; `false` where lists of tiles had too little room, which there is now.
    fn try_view(&mut self, view: &RelightView<'_>) -> Result<bool, GpuError> {
        let n = self.layout.gaussians;
        let shape = self.shape_of(view.camera)?;
        let all: Vec<Step> =
            STAGES.iter().filter(|row| !row.backward).flat_map(|row| steps(row.stage, &shape)).collect();
        let mut columns = columns_of(&all);
        columns.extend([Column::Means, Column::FormA, Column::FormB, Column::Features]);
        self.workspace.reserve_columns(&shape, &columns)?;
        self.workspace.reserve(Store::Counts, 4)?;
        self.workspace.reserve(Store::Visibility, n)?;
        self.reserve_network()?;
        let capacity = shape.capacity as u32;
        self.workspace.set_frame(&Frame::new(view.camera, view.raster, n as u32, false, capacity));
        self.workspace.raster.write(&self.workspace.device, Column::Counts, 0, &[n as u32, 0, 0, 0])?;
        self.workspace.set("places", 0, &self.layout.raw(channel_bits(view.layout)))?;
        let mut encoder = self.encoder();
        self.activate(&mut encoder, &shape)?;
        self.workspace.stages(&mut encoder, &all)?;
        self.workspace.copy_column(&mut encoder, Column::Counts, Store::Counts, 0, 4)?;
        self.workspace.device.submit(encoder)?;
        let counts = self.workspace.read(&[Store::Counts])?;
        self.has_room(u64::from(counts[0][2].to_bits()))
    }

    /// Pictures of the last view under up to three lights.
    fn relight(&mut self, view: &RelightView<'_>, lights: &[RelightLight]) -> Result<Vec<Image>, GpuError> {
        let n = self.layout.gaussians;
        let shape = self.shape_of(view.camera)?;
        let pixels = shape.pixels();
        for (store, words) in [
            (Store::Packed, 16 * n),
            (Store::PackedPicture, 16 * pixels),
            (Store::Record, 24 * pixels),
            (Store::Linear, 3 * pixels),
            (Store::Pictures, TOGETHER as u64 * (3 * pixels).next_multiple_of(64)),
            (Store::Sent, 3 * n),
        ] {
            self.workspace.reserve(store, words)?;
        }
        let mut encoder = self.encoder();
        // The fourth group has no channel of a light.
        self.workspace.clear(&mut encoder, Store::Packed)?;
        self.workspace.device.submit(encoder)?;
        for (k, light) in lights.iter().enumerate() {
            self.transport(view, light, k as u32, &shape)?;
        }
        let mut encoder = self.encoder();
        let e = &mut encoder;
        let blend = [
            Bound::Column(Column::Splats),
            Bound::Column(Column::Ranges),
            Bound::Column(Column::Pairs),
            Bound::Store(Store::Packed),
            Bound::Store(Store::PackedPicture),
            Bound::Column(Column::Coverage),
        ];
        let tiles = shape.tiles().map(|n| n as u32);
        self.workspace.run_with(e, (Module::Blend, "blend"), &[("QUADS", 4)], Some(&shape), &blend, tiles)?;
        let stride = (3 * pixels).next_multiple_of(64);
        for (k, light) in lights.iter().enumerate() {
            let number = k as u32;
            self.workspace.set("light", 1 + number, &Lighting::new(&light.light, view.shading))?;
            let picture = Bound::Column(Column::Picture);
            let arrays = [Bound::Settings("slot", number), Bound::Store(Store::PackedPicture), picture];
            let w = &self.workspace;
            w.over(e, (Module::JoinTransport, "join_transport"), Some(&shape), &arrays, pixels)?;
            let (coverage, record) = (Bound::Column(Column::Coverage), Bound::Store(Store::Record));
            let arrays = [Bound::Settings("light", 1 + number), picture, coverage, record];
            w.over(e, (Module::Shade, "shade"), Some(&shape), &arrays, pixels)?;
            let arrays = [record, Bound::Part(Store::Pictures, k as u64 * stride, 3 * pixels)];
            w.over(e, (Module::Radiance, "radiance"), Some(&shape), &arrays, pixels)?;
        }
        self.workspace.device.submit(encoder)?;
        let read = self.workspace.read(&[Store::Pictures])?.swap_remove(0);
        let (width, height) = (shape.width as usize, shape.height as usize);
        let image = |k: usize| {
            let data = read[k * stride as usize..][..3 * pixels as usize].to_vec();
            Image::from_vec(width, height, 3, data)
                .map_err(|e| GpuError::Kernel { kernel: "radiance".into(), problem: e.to_string() })
        };
        (0..lights.len()).map(image).collect()
    }

    /// The channels of one light, put beside those of the others.
    fn transport(
        &mut self,
        view: &RelightView<'_>,
        light: &RelightLight,
        k: u32,
        shape: &Shape,
    ) -> Result<(), GpuError> {
        if let Some(visibility) = &light.visibility {
            self.workspace.write(Store::Visibility, 0, bytemuck::cast_slice(visibility))?;
        }
        let sent: Vec<u32> = light.sent.iter().flat_map(|rgb| rgb.to_array()).map(f32::to_bits).collect();
        self.workspace.write(Store::Sent, 0, &sent)?;
        self.workspace.set("slot", k, &[k, u32::from(!sent.is_empty()), 0, 0])?;
        let model = self.model_view(view.model, view.camera, &light.light, view.scaling, channel_bits(view.layout));
        let mut encoder = self.encoder();
        let e = &mut encoder;
        self.see(light.visible, light.visibility.is_some(), &model, e, shape)?;
        for chunk in 0..self.chunks() {
            self.residual(model, chunk, e, shape)?;
        }
        let arrays = [
            Bound::Settings("slot", k),
            Bound::Column(Column::Features),
            Bound::Store(Store::Sent),
            Bound::Store(Store::Packed),
        ];
        let kernel = (Module::PackTransport, "pack_transport");
        self.workspace.over(e, kernel, Some(shape), &arrays, self.layout.gaussians)?;
        self.workspace.device.submit(encoder)
    }
}

const _: () = assert!(TOGETHER * (channel::TRANSPORT.end - channel::TRANSPORT.start) <= 16);
