//! Arrays that stay on the device from step to step, and kernels recorded on them.
use crate::arrays::Arrays;
use crate::kernels::{Kernel, Module};
use crate::shape::{Column, Shape};
use crate::stage::Step;
use crate::{Device, Frame, GpuError};
use std::collections::BTreeMap;
use std::sync::Arc;

/// An array of a training step that is none of the rasteriser's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Store {
    /// Raw parameters of the Gaussians, attribute by attribute.
    Values,
    /// Their first moments.
    FirstMoments,
    /// Their second moments.
    SecondMoments,
    /// Their gradient.
    RawGradient,
    /// Parameters of the network: trunk, residual head, incident head.
    Network,
    /// Their first moments.
    NetworkFirst,
    /// Their second moments.
    NetworkSecond,
    /// Their gradient.
    NetworkGradient,
    /// By Gaussian: sum of gradients, views, largest radius.
    Statistics,
    /// The same before the step.
    StatisticsBefore,
    /// By image: Gaussians, entries made, entries wanted, visible Gaussians.
    Counts,
    /// By Gaussian: visibility of the light.
    Visibility,
    /// By Gaussian: six surfels and their weights.
    Attachment,
    /// By surfel: what leaves it under the light.
    Leaving,
    /// By row: what the network is told.
    Inputs,
    /// Outputs of a layer of a part of the network.
    Layer(u8, u8),
    /// Cotangent of the outputs of a layer.
    DLayer(u8, u8),
    /// Cotangent of the trunk's outputs that one head gives, before it is added.
    DShared,
    /// Cotangent of what the network is told.
    DInputs,
    /// Sums over parts of a batch.
    Parts,
    /// 1.
    One,
    /// By pixel: radiance, its parts, maps.
    Record,
    /// Linear RGB.
    Linear,
    /// The same, encoded.
    Encoded,
    /// Derivatives of SSIM.
    Fields,
    /// Means of windows.
    Means,
    /// Gradient of the photometric term by the radiance.
    DLinear,
    /// By value: what the photometric term sums.
    PhotometricTerms,
    /// By pixel: cotangents of radiance and maps.
    DRecord,
    /// By pixel: what the other terms sum.
    TermValues,
    /// Gaussians on which visibility is compared.
    VisibilitySamples,
    /// Gaussians whose residual is asked to be nothing.
    PullSamples,
    /// By Gaussian or sample: what a term sums.
    RowValues,
    /// By Gaussian: the channels of three lights.
    Packed,
    /// The same, blended.
    PackedPicture,
    /// By Gaussian: what a medium sends out.
    Sent,
    /// Pictures under three lights.
    Pictures,
    /// Sums of blocks.
    Partial,
    /// Sums of those.
    Partial2,
    /// Sums of terms.
    Totals,
    /// First number that is not finite: of the gradient, the network's, the values, the network's values.
    Faults,
}

impl Store {
    /// In words, for errors.
    fn name(self) -> &'static str {
        match self {
            Store::Values => "parameters",
            Store::FirstMoments | Store::SecondMoments => "moments",
            Store::RawGradient => "gradient of the parameters",
            Store::Network | Store::NetworkFirst | Store::NetworkSecond | Store::NetworkGradient => "network",
            Store::Statistics | Store::StatisticsBefore => "statistics of density control",
            Store::Visibility => "visibility",
            Store::Attachment | Store::Leaving => "surfels",
            Store::Inputs | Store::DInputs => "network inputs",
            Store::Layer(..) | Store::DLayer(..) | Store::DShared => "network layer",
            Store::Parts | Store::One => "sums of the network",
            Store::Record | Store::Linear | Store::Encoded => "shaded picture",
            Store::Fields | Store::Means | Store::PhotometricTerms | Store::TermValues => "terms of the loss",
            Store::DLinear | Store::DRecord => "gradient of the shaded picture",
            Store::VisibilitySamples | Store::PullSamples | Store::RowValues => "samples",
            Store::Packed | Store::Sent => "channels of lights",
            Store::PackedPicture | Store::Pictures => "pictures of lights",
            Store::Partial | Store::Partial2 | Store::Totals | Store::Faults | Store::Counts => "sums",
        }
    }
}

/// An array that a kernel is handed.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Bound<'a> {
    /// All of an array of the rasteriser.
    Column(Column),
    /// All of an array of the step.
    Store(Store),
    /// Words of an array of the step: first, how many.
    Part(Store, u64, u64),
    /// All of an array that is kept elsewhere.
    Kept(&'a wgpu::Buffer),
    /// A small array of settings, by name and number.
    Settings(&'static str, u32),
}

/// Arrays, and the settings of kernels, which are written again only where they have changed.
#[derive(Debug)]
pub(crate) struct Workspace {
    pub device: Arc<Device>,
    pub raster: Arrays,
    stores: BTreeMap<Store, (wgpu::Buffer, u64)>,
    settings: BTreeMap<(&'static str, u32), (wgpu::Buffer, Vec<u8>)>,
}

impl Workspace {
    /// No arrays yet.
    pub fn new(device: Arc<Device>) -> Result<Self, GpuError> {
        let raster = Arrays::new(&device)?;
        Ok(Self { device, raster, stores: BTreeMap::new(), settings: BTreeMap::new() })
    }

    /// Makes an array this long; what it held is lost where it grows.
    pub fn reserve(&mut self, store: Store, words: u64) -> Result<(), GpuError> {
        let words = words.max(4);
        if let Some((buffer, length)) = self.stores.get_mut(&store)
            && buffer.size() >= words * 4
        {
            *length = words;
            return Ok(());
        }
        self.stores.remove(&store);
        self.stores.insert(store, (kept_array(&self.device, store.name(), words)?, words));
        Ok(())
    }

    fn store(&self, store: Store) -> Result<&(wgpu::Buffer, u64), GpuError> {
        self.stores.get(&store).ok_or_else(|| GpuError::Kernel {
            kernel: store.name().to_string(),
            problem: "the array was not made before it was used".into(),
        })
    }

    /// Writes an array from a word on.
    pub fn write(&self, store: Store, first: u64, words: &[u32]) -> Result<(), GpuError> {
        if !words.is_empty() {
            self.device.queue.write_buffer(&self.store(store)?.0, first * 4, bytemuck::cast_slice(words));
        }
        Ok(())
    }

    /// Makes an array of these words.
    pub fn upload(&mut self, store: Store, words: &[u32]) -> Result<(), GpuError> {
        self.reserve(store, words.len() as u64)?;
        self.write(store, 0, words)
    }

    /// Sets an array to 0.
    pub fn clear(&self, encoder: &mut wgpu::CommandEncoder, store: Store) -> Result<(), GpuError> {
        encoder.clear_buffer(&self.store(store)?.0, 0, None);
        Ok(())
    }

    /// Copies an array over another as long as it.
    pub fn copy(&self, encoder: &mut wgpu::CommandEncoder, from: Store, to: Store) -> Result<(), GpuError> {
        let (buffer, words) = self.store(from)?;
        encoder.copy_buffer_to_buffer(buffer, 0, &self.store(to)?.0, 0, words * 4);
        Ok(())
    }

    /// Copies the first words of an array of the rasteriser to a place in another.
    pub fn copy_column(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        from: Column,
        to: Store,
        first: u64,
        words: u64,
    ) -> Result<(), GpuError> {
        let (from, to) = (self.raster.buffer(from)?, &self.store(to)?.0);
        encoder.copy_buffer_to_buffer(from, 0, to, first * 4, words * 4);
        Ok(())
    }

    /// Length of an array.
    pub fn words(&self, store: Store) -> Result<u64, GpuError> {
        Ok(self.store(store)?.1)
    }

    /// Reads whole arrays.
    pub fn read(&self, stores: &[Store]) -> Result<Vec<Vec<f32>>, GpuError> {
        let parts = stores.iter().map(|s| self.store(*s).map(|(buffer, words)| (buffer, 0, *words)));
        let read = self.device.read(&parts.collect::<Result<Vec<_>, _>>()?)?;
        Ok(read.into_iter().map(|words| words.into_iter().map(f32::from_bits).collect()).collect())
    }

    /// Settings of a kernel. A name and number stand for one value until what was recorded has been submitted.
    pub fn set<T: bytemuck::Pod>(&mut self, name: &'static str, number: u32, value: &T) -> Result<(), GpuError> {
        let bytes = bytemuck::bytes_of(value);
        let fresh = match self.settings.get_mut(&(name, number)) {
            Some((_, kept)) if kept == bytes => return Ok(()),
            Some((buffer, kept)) if buffer.size() >= bytes.len() as u64 => {
                kept.clear();
                kept.extend_from_slice(bytes);
                buffer
            }
            _ => {
                let buffer = self.device.array(name, (bytes.len() / 4) as u64)?;
                let entry = (buffer, bytes.to_vec());
                self.settings.insert((name, number), entry);
                match self.settings.get_mut(&(name, number)) {
                    Some((buffer, _)) => buffer,
                    None => return Ok(()),
                }
            }
        };
        self.device.queue.write_buffer(fresh, 0, bytes);
        Ok(())
    }

    /// Makes room for what stages of the rasteriser use.
    pub fn reserve_columns(&mut self, shape: &Shape, columns: &[Column]) -> Result<(), GpuError> {
        self.raster.reserve(&self.device, shape, columns)
    }

    /// Records stages of the rasteriser.
    pub fn stages(&self, encoder: &mut wgpu::CommandEncoder, steps: &[Step]) -> Result<(), GpuError> {
        self.raster.encode(&self.device, encoder, steps)
    }

    /// What all kernels of a picture know.
    pub fn set_frame(&self, frame: &Frame) {
        self.raster.set_frame(&self.device, frame);
    }

    /// Records a kernel with so many workgroups. `shape` says how long the rasteriser's arrays are.
    pub fn run(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        (module, entry): (Module, &'static str),
        shape: Option<&Shape>,
        arrays: &[Bound<'_>],
        grid: [u32; 2],
    ) -> Result<(), GpuError> {
        self.run_with(encoder, (module, entry), &[], shape, arrays, grid)
    }

    /// The same with values of overridable constants.
    pub fn run_with(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        (module, entry): (Module, &'static str),
        constants: &[(&'static str, u32)],
        shape: Option<&Shape>,
        arrays: &[Bound<'_>],
        grid: [u32; 2],
    ) -> Result<(), GpuError> {
        if grid.contains(&0) {
            return Ok(());
        }
        let pipeline = self.device.kernel(&Kernel { module, entry, constants: constants.to_vec() })?;
        debug_assert_eq!(arrays.len(), module.access().len(), "{entry}");
        let mut entries = vec![wgpu::BindGroupEntry { binding: 0, resource: self.raster.frame().as_entire_binding() }];
        for (k, array) in arrays.iter().enumerate() {
            let (buffer, first, words) = match *array {
                Bound::Column(column) => {
                    let words = shape.map_or(4, |shape| shape.words(column));
                    (self.raster.buffer(column)?, 0, words.max(4))
                }
                Bound::Store(store) => {
                    let (buffer, words) = self.store(store)?;
                    (buffer, 0, *words)
                }
                Bound::Part(store, first, words) => (&self.store(store)?.0, first, words.max(4)),
                Bound::Kept(buffer) => (buffer, 0, buffer.size() / 4),
                Bound::Settings(name, number) => match self.settings.get(&(name, number)) {
                    Some((buffer, bytes)) => (buffer, 0, (bytes.len() / 4) as u64),
                    None => {
                        let problem = format!("settings {name} {number} were not written before they were used");
                        return Err(GpuError::Kernel { kernel: entry.to_string(), problem });
                    }
                },
            };
            let size = wgpu::BufferSize::new(words * 4);
            let resource = wgpu::BindingResource::Buffer(wgpu::BufferBinding { buffer, offset: first * 4, size });
            entries.push(wgpu::BindGroupEntry { binding: k as u32 + 1, resource });
        }
        let group = self.device.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(entry),
            layout: &pipeline.layout,
            entries: &entries,
        });
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&pipeline.pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups(grid[0], grid[1], 1);
        Ok(())
    }

    /// Records a kernel with a thread for each of so many.
    pub fn over(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        kernel: (Module, &'static str),
        shape: Option<&Shape>,
        arrays: &[Bound<'_>],
        threads: u64,
    ) -> Result<(), GpuError> {
        self.run(encoder, kernel, shape, arrays, crate::stage::grid(threads.div_ceil(256)))
    }
}

/// An array that kernels can be handed whole.
pub(crate) fn kept_array(device: &Device, what: &'static str, words: u64) -> Result<wgpu::Buffer, GpuError> {
    let (needed, limit) = (words * 4, device.max_binding());
    if needed > limit {
        return Err(GpuError::Limit { what, needed, limit });
    }
    device.array(what, words)
}
