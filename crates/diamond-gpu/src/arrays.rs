//! The arrays of a picture on the device, and the stages run on them.
use crate::shape::{Column, Shape};
use crate::stage::Step;
use crate::{Device, Frame, GpuError};
use std::collections::BTreeMap;

/// Arrays on a device. They are kept from picture to picture and grow as they are needed.
#[derive(Debug)]
pub(crate) struct Arrays {
    buffers: BTreeMap<Column, wgpu::Buffer>,
    frame: wgpu::Buffer,
}

impl Arrays {
    /// None yet.
    pub fn new(device: &Device) -> Result<Self, GpuError> {
        let frame = device.array("frame", (size_of::<Frame>() / 4) as u64)?;
        Ok(Self { buffers: BTreeMap::new(), frame })
    }

    /// Makes room for these arrays; what they held is lost where they grow.
    pub fn reserve(&mut self, device: &Device, shape: &Shape, columns: &[Column]) -> Result<(), GpuError> {
        for &column in columns {
            let words = shape.words(column).max(4);
            if self.buffers.get(&column).is_some_and(|buffer| buffer.size() >= words * 4) {
                continue;
            }
            self.buffers.remove(&column);
            self.buffers.insert(column, device.array(column.name(), words)?);
        }
        Ok(())
    }

    /// What all kernels of the picture know.
    pub fn set_frame(&self, device: &Device, frame: &Frame) {
        device.queue.write_buffer(&self.frame, 0, bytemuck::bytes_of(frame));
    }

    /// Writes the beginning of an array.
    pub fn write(&self, device: &Device, column: Column, first: u64, words: &[u32]) -> Result<(), GpuError> {
        if !words.is_empty() {
            device.queue.write_buffer(self.buffer(column)?, first * 4, bytemuck::cast_slice(words));
        }
        Ok(())
    }

    /// Reads the first words of arrays.
    pub fn read(&self, device: &Device, columns: &[(Column, u64)]) -> Result<Vec<Vec<u32>>, GpuError> {
        let mut parts = Vec::with_capacity(columns.len());
        for &(column, words) in columns {
            parts.push((self.buffer(column)?, 0, words));
        }
        device.read(&parts)
    }

    /// Binding 0 of every kernel.
    pub fn frame(&self) -> &wgpu::Buffer {
        &self.frame
    }

    pub fn buffer(&self, column: Column) -> Result<&wgpu::Buffer, GpuError> {
        self.buffers.get(&column).ok_or_else(|| GpuError::Kernel {
            kernel: column.name().to_string(),
            problem: "the array was not made before it was used".into(),
        })
    }

    /// Appends what a stage does to the commands.
    pub fn encode(&self, device: &Device, encoder: &mut wgpu::CommandEncoder, steps: &[Step]) -> Result<(), GpuError> {
        for step in steps {
            match step {
                Step::Clear(column) => encoder.clear_buffer(self.buffer(*column)?, 0, None),
                Step::Dispatch { kernel, bindings, grid } => {
                    let pipeline = device.kernel(kernel)?;
                    let mut entries =
                        vec![wgpu::BindGroupEntry { binding: 0, resource: self.frame.as_entire_binding() }];
                    for (k, &(column, first, words)) in bindings.iter().enumerate() {
                        let resource = wgpu::BindingResource::Buffer(wgpu::BufferBinding {
                            buffer: self.buffer(column)?,
                            offset: first * 4,
                            size: wgpu::BufferSize::new(words * 4),
                        });
                        entries.push(wgpu::BindGroupEntry { binding: k as u32 + 1, resource });
                    }
                    let group = device.device.create_bind_group(&wgpu::BindGroupDescriptor {
                        label: Some(kernel.entry),
                        layout: &pipeline.layout,
                        entries: &entries,
                    });
                    let mut pass = encoder.begin_compute_pass(&Default::default());
                    pass.set_pipeline(&pipeline.pipeline);
                    pass.set_bind_group(0, &group, &[]);
                    pass.dispatch_workgroups(grid[0], grid[1], 1);
                }
            }
        }
        Ok(())
    }
}

/// The arrays that some steps use.
pub(crate) fn columns_of(steps: &[Step]) -> Vec<Column> {
    let mut columns: Vec<Column> = steps
        .iter()
        .flat_map(|step| match step {
            Step::Clear(column) => vec![*column],
            Step::Dispatch { bindings, .. } => bindings.iter().map(|(column, _, _)| *column).collect(),
        })
        .collect();
    columns.sort();
    columns.dedup();
    columns
}
