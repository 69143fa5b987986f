//! Which devices there are, and which one is meant.
use crate::GpuError;
use std::str::FromStr;

/// What a device is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DeviceKind {
    /// A graphics card.
    Discrete,
    /// Shares the CPU's memory.
    Integrated,
    /// Part of a virtual machine.
    Virtual,
    /// A driver that runs on the CPU, such as Mesa's llvmpipe: for tests, slower than the CPU engine.
    Software,
    /// The driver does not say.
    Unknown,
}

impl DeviceKind {
    /// One word.
    pub fn name(self) -> &'static str {
        match self {
            DeviceKind::Discrete => "discrete",
            DeviceKind::Integrated => "integrated",
            DeviceKind::Virtual => "virtual",
            DeviceKind::Software => "software",
            DeviceKind::Unknown => "unknown",
        }
    }
}

/// A device as its driver describes it.
#[derive(Debug, Clone, PartialEq)]
pub struct Adapter {
    /// Its number: `gpu:N`.
    pub index: usize,
    /// Its name.
    pub name: String,
    /// What it is.
    pub kind: DeviceKind,
    /// Interface to the driver: `vulkan`, `metal`, `dx12`.
    pub backend: String,
    /// Name and version of the driver.
    pub driver: String,
    /// Largest array that a kernel can be handed, bytes.
    pub max_binding: u64,
    /// Largest array that can be kept, bytes.
    pub max_buffer: u64,
    /// Memory that the threads of a workgroup can share, bytes.
    pub workgroup_memory: u32,
    /// Whether threads of a subgroup can exchange values.
    pub subgroups: bool,
    /// Whether there are 16-bit floats.
    pub half: bool,
}

impl Adapter {
    fn of(index: usize, adapter: &wgpu::Adapter) -> Self {
        let (info, limits, features) = (adapter.get_info(), adapter.limits(), adapter.features());
        let kind = match info.device_type {
            wgpu::DeviceType::DiscreteGpu => DeviceKind::Discrete,
            wgpu::DeviceType::IntegratedGpu => DeviceKind::Integrated,
            wgpu::DeviceType::VirtualGpu => DeviceKind::Virtual,
            wgpu::DeviceType::Cpu => DeviceKind::Software,
            wgpu::DeviceType::Other => DeviceKind::Unknown,
        };
        Self {
            index,
            name: info.name,
            kind,
            backend: info.backend.to_string(),
            driver: [info.driver, info.driver_info].join(" ").trim().to_string(),
            max_binding: limits.max_storage_buffer_binding_size,
            max_buffer: limits.max_buffer_size,
            workgroup_memory: limits.max_compute_workgroup_storage_size,
            subgroups: features.contains(wgpu::Features::SUBGROUP),
            half: features.contains(wgpu::Features::SHADER_F16),
        }
    }
}

/// Which device is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DeviceChoice {
    /// The first GPU that is not software, else the CPU.
    #[default]
    Auto,
    /// No GPU.
    Cpu,
    /// The GPU of this number; `None`: the best there is.
    Gpu(Option<usize>),
}

impl FromStr for DeviceChoice {
    type Err = GpuError;

    /// Reads `auto`, `cpu`, `gpu` or `gpu:N`.
    fn from_str(text: &str) -> Result<Self, GpuError> {
        match text {
            "auto" => Ok(DeviceChoice::Auto),
            "cpu" => Ok(DeviceChoice::Cpu),
            "gpu" => Ok(DeviceChoice::Gpu(None)),
            _ => text
                .strip_prefix("gpu:")
                .and_then(|number| number.parse().ok())
                .map(|index| DeviceChoice::Gpu(Some(index)))
                .ok_or_else(|| GpuError::Choice { found: text.chars().take(40).collect() }),
        }
    }
}

/// Every adapter of this machine, in the order of their numbers: graphics cards first, software last.
pub(crate) fn enumerate() -> Vec<(Adapter, wgpu::Adapter)> {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = wgpu::Backends::VULKAN | wgpu::Backends::METAL | wgpu::Backends::DX12;
    descriptor.flags = wgpu::InstanceFlags::empty();
    let instance = wgpu::Instance::new(descriptor);
    let mut found: Vec<wgpu::Adapter> = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::all()));
    found.sort_by_key(|adapter| match adapter.get_info().device_type {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    });
    found.into_iter().enumerate().map(|(index, adapter)| (Adapter::of(index, &adapter), adapter)).collect()
}

/// The devices of this machine, graphics cards first, software last; empty where there is no driver.
pub fn adapters() -> Vec<Adapter> {
    enumerate().into_iter().map(|(adapter, _)| adapter).collect()
}

/// The adapter that a choice means; `None`: the CPU engine.
///
/// # Errors
/// A GPU is asked for, and there is none or none of that number.
pub fn choose(choice: DeviceChoice, adapters: &[Adapter]) -> Result<Option<usize>, GpuError> {
    match choice {
        DeviceChoice::Cpu => Ok(None),
        DeviceChoice::Auto => Ok(adapters.iter().find(|a| a.kind != DeviceKind::Software).map(|a| a.index)),
        DeviceChoice::Gpu(_) if adapters.is_empty() => Err(GpuError::NoAdapter),
        DeviceChoice::Gpu(index) => {
            let index = index.unwrap_or(0);
            if index < adapters.len() {
                return Ok(Some(index));
            }
            Err(GpuError::AdapterIndex { index, found: adapters.iter().map(|a| a.name.clone()).collect() })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn adapter(index: usize, kind: DeviceKind) -> Adapter {
        Adapter {
            index,
            name: format!("device {index}"),
            kind,
            backend: "vulkan".into(),
            driver: String::new(),
            max_binding: 1 << 27,
            max_buffer: 1 << 28,
            workgroup_memory: 1 << 14,
            subgroups: false,
            half: false,
        }
    }

    #[test]
    fn choices_are_read_and_nonsense_is_refused() {
        assert_eq!("auto".parse(), Ok(DeviceChoice::Auto));
        assert_eq!("gpu:12".parse(), Ok(DeviceChoice::Gpu(Some(12))));
        for text in ["", "GPU", "gpu:", "gpu:-1", "gpu:99999999999999999999999", "cuda"] {
            assert!(matches!(text.parse::<DeviceChoice>(), Err(GpuError::Choice { .. })), "{text}");
        }
    }

    #[test]
    fn auto_takes_hardware_and_a_number_takes_anything() {
        let both = [adapter(0, DeviceKind::Discrete), adapter(1, DeviceKind::Software)];
        assert_eq!(choose(DeviceChoice::Auto, &both), Ok(Some(0)));
        assert_eq!(choose(DeviceChoice::Auto, &both[1..]), Ok(None));
        assert_eq!(choose(DeviceChoice::Auto, &[]), Ok(None));
        assert_eq!(choose(DeviceChoice::Cpu, &both), Ok(None));
        assert_eq!(choose(DeviceChoice::Gpu(None), &both), Ok(Some(0)));
        assert_eq!(choose(DeviceChoice::Gpu(Some(1)), &both), Ok(Some(1)));
        assert_eq!(choose(DeviceChoice::Gpu(None), &[]), Err(GpuError::NoAdapter));
        assert!(matches!(choose(DeviceChoice::Gpu(Some(2)), &both), Err(GpuError::AdapterIndex { index: 2, .. })));
    }
}
