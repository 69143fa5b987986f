//! An opened device: arrays on it, kernels, and what its driver reports.
use crate::adapter::{Adapter, DeviceChoice, choose, enumerate};
use crate::kernels::{Kernel, Kernels, Sources};
use crate::{DeviceKind, GpuError};
use std::sync::{Arc, Mutex, PoisonError};

/// A message from the driver that arrived outside of a call.
type Message = Arc<Mutex<Option<String>>>;

/// An opened device.
#[derive(Debug)]
pub struct Device {
    adapter: Adapter,
    pub(crate) device: wgpu::Device,
    pub(crate) queue: wgpu::Queue,
    kernels: Kernels,
    lost: Message,
    failed: Message,
}

/// What the kernels are written for: the limits that every WebGPU device has.
pub(crate) const STORAGE_BINDINGS: u32 = 8;

impl Device {
    /// Opens the device that a choice means; `None` where it means the CPU engine.
    ///
    /// # Errors
    /// No such device, or its driver refuses.
    pub fn open(choice: DeviceChoice) -> Result<Option<Self>, GpuError> {
        Self::open_with(choice, Sources::default())
    }

    /// [`Device::open`] with other sources of kernels than those of this crate, for tests that plant errors.
    ///
    /// # Errors
    /// As [`Device::open`].
    pub fn open_with(choice: DeviceChoice, sources: Sources) -> Result<Option<Self>, GpuError> {
        if choice == DeviceChoice::Cpu {
            return Ok(None);
        }
        let mut found = enumerate();
        let adapters: Vec<Adapter> = found.iter().map(|(adapter, _)| adapter.clone()).collect();
        let Some(index) = choose(choice, &adapters)? else {
            return Ok(None);
        };
        let (adapter, handle) = found.swap_remove(index);
        let available = handle.limits();
        // The limits of WebGPU, but arrays as large as the device can.
        let limits = wgpu::Limits {
            max_storage_buffer_binding_size: available.max_storage_buffer_binding_size,
            max_buffer_size: available.max_buffer_size,
            ..wgpu::Limits::default()
        };
        let problem = |problem: String| GpuError::Open { device: adapter.name.clone(), problem };
        if !limits.check_limits(&available) {
            return Err(problem("less than the limits that every WebGPU device has".into()));
        }
        let descriptor = wgpu::DeviceDescriptor { required_limits: limits, ..Default::default() };
        let (device, queue) =
            pollster::block_on(handle.request_device(&descriptor)).map_err(|error| problem(error.to_string()))?;
        let (lost, failed) = (Message::default(), Message::default());
        let to = lost.clone();
        device.set_device_lost_callback(move |reason, text| {
            // Being dropped is no loss.
            if reason != wgpu::DeviceLostReason::Destroyed {
                put(&to, format!("{reason:?}: {text}"));
            }
        });
        let to = failed.clone();
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| put(&to, error.to_string())));
        Ok(Some(Self { adapter, device, queue, kernels: Kernels::new(sources), lost, failed }))
    }

    /// What it is.
    pub fn adapter(&self) -> &Adapter {
        &self.adapter
    }

    /// Whether it is a driver that runs on the CPU.
    pub fn is_software(&self) -> bool {
        self.adapter.kind == DeviceKind::Software
    }

    /// Largest array that a kernel can be handed, bytes.
    pub fn max_binding(&self) -> u64 {
        self.adapter.max_binding.min(self.adapter.max_buffer)
    }

    /// An array of this many 32-bit words, of unknown content.
    ///
    /// # Errors
    /// It is larger than kernels can be handed, or than the device has room for.
    pub(crate) fn array(&self, what: &'static str, words: u64) -> Result<wgpu::Buffer, GpuError> {
        let bytes = words.max(4) * 4;
        if bytes > self.adapter.max_buffer {
            return Err(GpuError::Limit { what, needed: bytes, limit: self.adapter.max_buffer });
        }
        let scope = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(what),
            size: bytes,
            usage: wgpu::BufferUsages::STORAGE
                | wgpu::BufferUsages::UNIFORM
                | wgpu::BufferUsages::COPY_SRC
                | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        match pollster::block_on(scope.pop()) {
            Some(_) => Err(GpuError::OutOfMemory { what, bytes }),
            None => Ok(buffer),
        }
    }

    /// The pipeline of a kernel; compiled when it is first asked for.
    pub(crate) fn kernel(&self, kernel: &Kernel) -> Result<Arc<crate::kernels::Pipeline>, GpuError> {
        self.kernels.get(self, kernel)
    }

    /// Hands commands to the device.
    pub(crate) fn submit(&self, encoder: wgpu::CommandEncoder) -> Result<(), GpuError> {
        self.queue.submit([encoder.finish()]);
        self.check()
    }

    /// `Err` if the driver has reported that the device is lost or that a command failed.
    pub(crate) fn check(&self) -> Result<(), GpuError> {
        let device = self.adapter.name.clone();
        if let Some(problem) = get(&self.lost) {
            return Err(GpuError::Lost { device, problem });
        }
        match get(&self.failed) {
            Some(problem) => Err(GpuError::Kernel { kernel: format!("on {device}"), problem }),
            None => Ok(()),
        }
    }

    /// Copies words of arrays (array, first word, words) to the host, in one go.
    ///
    /// # Errors
    /// No room for the copy, or the device is lost.
    pub(crate) fn read(&self, parts: &[(&wgpu::Buffer, u64, u64)]) -> Result<Vec<Vec<u32>>, GpuError> {
        let words: u64 = parts.iter().map(|(_, _, words)| words).sum();
        if words == 0 {
            return Ok(vec![Vec::new(); parts.len()]);
        }
        let scope = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let staging = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("copy to the host"),
            size: words * 4,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        if pollster::block_on(scope.pop()).is_some() {
            return Err(GpuError::OutOfMemory { what: "copy to the host", bytes: words * 4 });
        }
        let mut encoder = self.device.create_command_encoder(&Default::default());
        let mut at = 0;
        for &(buffer, first, words) in parts {
            if words > 0 {
                encoder.copy_buffer_to_buffer(buffer, first * 4, &staging, at * 4, words * 4);
            }
            at += words;
        }
        self.submit(encoder)?;
        let done: Message = Message::default();
        let to = done.clone();
        staging.map_async(wgpu::MapMode::Read, .., move |result| {
            if let Err(error) = result {
                put(&to, error.to_string());
            }
        });
        let lost = |problem: String| GpuError::Lost { device: self.adapter.name.clone(), problem };
        self.device.poll(wgpu::PollType::wait_indefinitely()).map_err(|error| lost(error.to_string()))?;
        self.check()?;
        if let Some(problem) = get(&done) {
            return Err(lost(problem));
        }
        let view = staging.get_mapped_range(..).map_err(|error| lost(error.to_string()))?;
        let all: &[u8] = &view;
        let mut out = Vec::with_capacity(parts.len());
        let mut at = 0;
        for &(_, _, words) in parts {
            let bytes = &all[at..at + words as usize * 4];
            out.push(bytemuck::pod_collect_to_vec(bytes));
            at += bytes.len();
        }
        Ok(out)
    }
}

fn put(to: &Message, text: String) {
    to.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(text);
}

fn get(from: &Message) -> Option<String> {
    from.lock().unwrap_or_else(PoisonError::into_inner).clone()
}
