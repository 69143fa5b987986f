//! Kernels run on arrays that come from the host and go back to it: how parts of the training step that are not yet chained on the
//! device are used and compared.
use crate::kernels::{Kernel, Module};
use crate::{Device, Frame, GpuError};

/// An array of a [`Job`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Array(usize);

/// Arrays on the device and the kernels that will run on them.
pub(crate) struct Job<'d> {
    device: &'d Device,
    arrays: Vec<(wgpu::Buffer, u64)>,
    encoder: wgpu::CommandEncoder,
}

impl<'d> Job<'d> {
    /// Nothing to do yet; `frame` is binding 0 of every kernel.
    pub fn new(device: &'d Device, frame: &Frame) -> Result<Self, GpuError> {
        let encoder = device.device.create_command_encoder(&Default::default());
        let mut job = Self { device, arrays: Vec::new(), encoder };
        job.input("frame", bytemuck::cast_slice(bytemuck::bytes_of(frame)))?;
        Ok(job)
    }

    /// An array with these words.
    pub fn input(&mut self, what: &'static str, words: &[u32]) -> Result<Array, GpuError> {
        let array = self.zeros(what, words.len() as u64)?;
        if !words.is_empty() {
            self.device.queue.write_buffer(&self.arrays[array.0].0, 0, bytemuck::cast_slice(words));
        }
        Ok(array)
    }

    /// An array of zeros.
    pub fn zeros(&mut self, what: &'static str, words: u64) -> Result<Array, GpuError> {
        let (bytes, limit) = (words * 4, self.device.max_binding());
        if bytes > limit {
            return Err(GpuError::Limit { what, needed: bytes, limit });
        }
        self.arrays.push((self.device.array(what, words)?, words.max(4)));
        Ok(Array(self.arrays.len() - 1))
    }

    /// Runs a kernel with a thread for each of `threads`, 256 to a workgroup.
    pub fn over(
        &mut self,
        module: Module,
        entry: &'static str,
        arrays: &[Array],
        threads: u64,
    ) -> Result<(), GpuError> {
        self.run(module, entry, &[], arrays, crate::stage::grid(threads.div_ceil(256)))
    }

    /// Runs a kernel with so many workgroups on whole arrays.
    pub fn run(
        &mut self,
        module: Module,
        entry: &'static str,
        constants: &[(&'static str, u32)],
        arrays: &[Array],
        grid: [u32; 2],
    ) -> Result<(), GpuError> {
        if grid.contains(&0) {
            return Ok(());
        }
        let kernel = Kernel { module, entry, constants: constants.to_vec() };
        let pipeline = self.device.kernel(&kernel)?;
        let mut entries = Vec::with_capacity(arrays.len() + 1);
        for (k, array) in std::iter::once(&Array(0)).chain(arrays).enumerate() {
            let (buffer, words) = &self.arrays[array.0];
            let size = wgpu::BufferSize::new(words * 4);
            let resource = wgpu::BindingResource::Buffer(wgpu::BufferBinding { buffer, offset: 0, size });
            entries.push(wgpu::BindGroupEntry { binding: k as u32, resource });
        }
        let group = self.device.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(entry),
            layout: &pipeline.layout,
            entries: &entries,
        });
        let mut pass = self.encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&pipeline.pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups(grid[0], grid[1], 1);
        Ok(())
    }

    /// Does it all, and reads the first words of these arrays.
    pub fn finish(self, wanted: &[(Array, u64)]) -> Result<Vec<Vec<f32>>, GpuError> {
        self.device.submit(self.encoder)?;
        let parts: Vec<(&wgpu::Buffer, u64, u64)> =
            wanted.iter().map(|(array, words)| (&self.arrays[array.0].0, 0, *words)).collect();
        let read = self.device.read(&parts)?;
        Ok(read.into_iter().map(|words| words.into_iter().map(f32::from_bits).collect()).collect())
    }
}

/// The bits of numbers.
pub(crate) fn words(values: &[f32]) -> &[u32] {
    bytemuck::cast_slice(values)
}
