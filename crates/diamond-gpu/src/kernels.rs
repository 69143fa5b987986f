//! The sources of the kernels and their compiled pipelines.
use crate::device::STORAGE_BINDINGS;
use crate::{Device, GpuError};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

/// Files of WGSL by name.
#[derive(Debug, Clone, PartialEq)]
pub struct Sources(BTreeMap<&'static str, String>);

macro_rules! sources {
    ($($name:literal),* $(,)?) => {
        [$(($name, include_str!(concat!("../wgsl/", $name)))),*]
    };
}

impl Default for Sources {
    fn default() -> Self {
        let files = sources![
            "frame.wgsl",
            "pair.wgsl",
            "linearised.wgsl",
            "tile_span.wgsl",
            "alpha.wgsl",
            "projection.wgsl",
            "scan.wgsl",
            "sort.wgsl",
            "tile_offsets.wgsl",
            "tile_entries.wgsl",
            "tile_ranges.wgsl",
            "blend.wgsl",
            "blend_pull.wgsl",
            "splat_sum.wgsl",
            "projection_pull.wgsl",
            "shading.wgsl",
            "shade.wgsl",
            "shade_pull.wgsl",
            "adam.wgsl",
            "density_stats.wgsl",
            "product.wgsl",
            "photometric.wgsl",
            "mask_bce.wgsl",
            "elementary.wgsl",
            "raw.wgsl",
            "model_view.wgsl",
            "medium.wgsl",
            "residual_row.wgsl",
            "sample.wgsl",
            "activate.wgsl",
            "activate_pull.wgsl",
            "residual_inputs.wgsl",
            "residual_outputs.wgsl",
            "residual_gather.wgsl",
            "residual_scatter.wgsl",
            "medium_rows.wgsl",
            "medium_pull.wgsl",
            "visibility_fit.wgsl",
            "visibility_term.wgsl",
            "transfer_smoothness.wgsl",
            "sampled_inputs.wgsl",
            "sampled_pull.wgsl",
            "sampled_scatter.wgsl",
            "radiance.wgsl",
            "image_terms.wgsl",
            "clamp_scales.wgsl",
            "finite.wgsl",
            "reduce.wgsl",
            "pack_transport.wgsl",
            "join_transport.wgsl",
        ];
        Self(files.into_iter().map(|(name, text)| (name, text.to_string())).collect())
    }
}

impl Sources {
    /// The sources with the only occurrence of `from` in a file replaced: how tests plant an error. `None` if there is
    /// no such file, or `from` does not occur in it exactly once.
    pub fn with_edit(mut self, file: &str, from: &str, to: &str) -> Option<Self> {
        let text = self.0.get_mut(file)?;
        if text.matches(from).count() != 1 {
            return None;
        }
        *text = text.replace(from, to);
        Some(self)
    }

    /// What a module is compiled from.
    pub fn of(&self, module: Module) -> String {
        let text = |name: &&str| self.0.get(*name).map_or("", String::as_str);
        module.files().iter().map(text).collect::<Vec<_>>().join("\n")
    }
}

/// A unit that is compiled: a file after those that it uses, and what its arrays are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Module {
    /// `projection.wgsl`
    Projection,
    /// `scan.wgsl`
    Scan,
    /// `sort.wgsl`
    Sort,
    /// `tile_offsets.wgsl`
    TileOffsets,
    /// `tile_entries.wgsl`
    TileEntries,
    /// `tile_ranges.wgsl`
    TileRanges,
    /// `blend.wgsl`
    Blend,
    /// `blend_pull.wgsl`
    BlendPull,
    /// `splat_sum.wgsl`
    SplatSum,
    /// `projection_pull.wgsl`
    ProjectionPull,
    /// `shade.wgsl`
    Shade,
    /// `shade_pull.wgsl`
    ShadePull,
    /// `adam.wgsl`
    Adam,
    /// `density_stats.wgsl`
    DensityStats,
    /// `product.wgsl`
    Product,
    /// `photometric.wgsl`
    Photometric,
    /// `mask_bce.wgsl`
    MaskBce,
    /// `activate.wgsl`
    Activate,
    /// `activate_pull.wgsl`
    ActivatePull,
    /// `residual_inputs.wgsl`
    ResidualInputs,
    /// `residual_outputs.wgsl`
    ResidualOutputs,
    /// `residual_gather.wgsl`
    ResidualGather,
    /// `residual_scatter.wgsl`
    ResidualScatter,
    /// `medium_rows.wgsl`
    MediumRows,
    /// `medium_pull.wgsl`
    MediumPull,
    /// `visibility_fit.wgsl`
    VisibilityFit,
    /// `visibility_term.wgsl`
    VisibilityTerm,
    /// `transfer_smoothness.wgsl`
    TransferSmoothness,
    /// `sampled_inputs.wgsl`
    SampledInputs,
    /// `sampled_pull.wgsl`
    SampledPull,
    /// `sampled_scatter.wgsl`
    SampledScatter,
    /// `radiance.wgsl`
    Radiance,
    /// `image_terms.wgsl`
    ImageTerms,
    /// `clamp_scales.wgsl`
    ClampScales,
    /// `finite.wgsl`
    Finite,
    /// `reduce.wgsl`
    Reduce,
    /// `pack_transport.wgsl`
    PackTransport,
    /// `join_transport.wgsl`
    JoinTransport,
}

impl Module {
    /// All of them.
    pub const ALL: [Module; 38] = [
        Module::Projection,
        Module::Scan,
        Module::Sort,
        Module::TileOffsets,
        Module::TileEntries,
        Module::TileRanges,
        Module::Blend,
        Module::BlendPull,
        Module::SplatSum,
        Module::ProjectionPull,
        Module::Shade,
        Module::ShadePull,
        Module::Adam,
        Module::DensityStats,
        Module::Product,
        Module::Photometric,
        Module::MaskBce,
        Module::Activate,
        Module::ActivatePull,
        Module::ResidualInputs,
        Module::ResidualOutputs,
        Module::ResidualGather,
        Module::ResidualScatter,
        Module::MediumRows,
        Module::MediumPull,
        Module::VisibilityFit,
        Module::VisibilityTerm,
        Module::TransferSmoothness,
        Module::SampledInputs,
        Module::SampledPull,
        Module::SampledScatter,
        Module::Radiance,
        Module::ImageTerms,
        Module::ClampScales,
        Module::Finite,
        Module::Reduce,
        Module::PackTransport,
        Module::JoinTransport,
    ];

    /// The files that it is compiled from, in this order.
    pub fn files(self) -> &'static [&'static str] {
        match self {
            Module::Projection => &["frame.wgsl", "pair.wgsl", "linearised.wgsl", "tile_span.wgsl", "projection.wgsl"],
            Module::Scan => &["frame.wgsl", "scan.wgsl"],
            Module::Sort => &["frame.wgsl", "sort.wgsl"],
            Module::TileOffsets => &["frame.wgsl", "tile_offsets.wgsl"],
            Module::TileEntries => &["frame.wgsl", "tile_span.wgsl", "tile_entries.wgsl"],
            Module::TileRanges => &["frame.wgsl", "tile_ranges.wgsl"],
            Module::Blend => &["frame.wgsl", "pair.wgsl", "alpha.wgsl", "blend.wgsl"],
            Module::BlendPull => &["frame.wgsl", "pair.wgsl", "alpha.wgsl", "blend_pull.wgsl"],
            Module::SplatSum => &["frame.wgsl", "splat_sum.wgsl"],
            Module::ProjectionPull => &["frame.wgsl", "pair.wgsl", "linearised.wgsl", "projection_pull.wgsl"],
            Module::Shade => &["frame.wgsl", "pair.wgsl", "shading.wgsl", "shade.wgsl"],
            Module::ShadePull => &["frame.wgsl", "pair.wgsl", "shading.wgsl", "shade_pull.wgsl"],
            Module::Adam => &["frame.wgsl", "adam.wgsl"],
            Module::DensityStats => &["frame.wgsl", "density_stats.wgsl"],
            Module::Product => &["frame.wgsl", "product.wgsl"],
            Module::Photometric => &["frame.wgsl", "photometric.wgsl"],
            Module::MaskBce => &["frame.wgsl", "mask_bce.wgsl"],
            Module::Activate => &["frame.wgsl", "elementary.wgsl", "raw.wgsl", "activate.wgsl"],
            Module::ActivatePull => &["frame.wgsl", "elementary.wgsl", "raw.wgsl", "activate_pull.wgsl"],
            Module::ResidualInputs => {
                &["frame.wgsl", "elementary.wgsl", "model_view.wgsl", "residual_row.wgsl", "residual_inputs.wgsl"]
            }
            Module::ResidualOutputs => &["frame.wgsl", "model_view.wgsl", "residual_outputs.wgsl"],
            Module::ResidualGather => &["frame.wgsl", "model_view.wgsl", "residual_gather.wgsl"],
            Module::ResidualScatter => &["frame.wgsl", "model_view.wgsl", "residual_scatter.wgsl"],
            Module::MediumRows => &["frame.wgsl", "model_view.wgsl", "medium.wgsl", "medium_rows.wgsl"],
            Module::MediumPull => &["frame.wgsl", "model_view.wgsl", "medium.wgsl", "medium_pull.wgsl"],
            Module::VisibilityFit => &["frame.wgsl", "model_view.wgsl", "visibility_fit.wgsl"],
            Module::VisibilityTerm => &["frame.wgsl", "model_view.wgsl", "visibility_term.wgsl"],
            Module::TransferSmoothness => &["frame.wgsl", "model_view.wgsl", "transfer_smoothness.wgsl"],
            Module::SampledInputs => &[
                "frame.wgsl",
                "elementary.wgsl",
                "model_view.wgsl",
                "residual_row.wgsl",
                "sample.wgsl",
                "sampled_inputs.wgsl",
            ],
            Module::SampledPull => &["frame.wgsl", "model_view.wgsl", "sample.wgsl", "sampled_pull.wgsl"],
            Module::SampledScatter => &["frame.wgsl", "model_view.wgsl", "sample.wgsl", "sampled_scatter.wgsl"],
            Module::Radiance => &["frame.wgsl", "radiance.wgsl"],
            Module::ImageTerms => &["frame.wgsl", "elementary.wgsl", "image_terms.wgsl"],
            Module::ClampScales => &["frame.wgsl", "clamp_scales.wgsl"],
            Module::Finite => &["frame.wgsl", "finite.wgsl"],
            Module::Reduce => &["frame.wgsl", "reduce.wgsl"],
            Module::PackTransport => &["frame.wgsl", "pack_transport.wgsl"],
            Module::JoinTransport => &["frame.wgsl", "join_transport.wgsl"],
        }
    }

    /// Whether its arrays, bindings 1 and on, are written: `r` or `w` for each.
    pub fn access(self) -> &'static str {
        match self {
            Module::Projection => "rrrwwwww",
            Module::Scan => "ww",
            Module::Sort => "rrwwwr",
            Module::TileOffsets => "rrww",
            Module::TileEntries => "rrrrww",
            Module::TileRanges => "rrrrww",
            Module::Blend => "rrrrww",
            Module::BlendPull => "rrrrrrrw",
            Module::SplatSum => "rrrw",
            Module::ProjectionPull => "rrrrrw",
            Module::Shade => "rrrw",
            Module::ShadePull => "rrrrww",
            Module::Adam => "rrwwwr",
            Module::DensityStats => "rrw",
            Module::Product => "rrrw",
            Module::Photometric => "rrwrwwww",
            Module::MaskBce => "rrww",
            Module::Activate => "rrwwww",
            Module::ActivatePull => "rrrrw",
            Module::ResidualInputs => "rrrrrrrw",
            Module::ResidualOutputs => "rrrrrrw",
            Module::ResidualGather => "rrrwww",
            Module::ResidualScatter => "rrww",
            Module::MediumRows => "rrrrrw",
            Module::MediumPull => "rrrrrrww",
            Module::VisibilityFit => "rrrw",
            Module::VisibilityTerm => "rrrrrww",
            Module::TransferSmoothness => "rrww",
            Module::SampledInputs => "rrrrrrrw",
            Module::SampledPull => "rrrrwww",
            Module::SampledScatter => "rrrw",
            Module::Radiance => "rw",
            Module::ImageTerms => "rrrrrww",
            Module::ClampScales => "rw",
            Module::Finite => "rw",
            Module::Reduce => "rrw",
            Module::PackTransport => "rrrw",
            Module::JoinTransport => "rrw",
        }
    }
}

/// An entry point of a module with values of its overridable constants.
#[derive(Debug, Clone, PartialEq)]
pub struct Kernel {
    /// Where it is.
    pub module: Module,
    /// Its name.
    pub entry: &'static str,
    /// Constants that differ from what the source says.
    pub constants: Vec<(&'static str, u32)>,
}

impl Kernel {
    fn name(&self) -> String {
        let constants: Vec<String> = self.constants.iter().map(|(name, value)| format!("{name}={value}")).collect();
        format!("{:?}::{} {}", self.module, self.entry, constants.join(" ")).trim_end().to_string()
    }
}

/// A compiled kernel.
#[derive(Debug)]
pub(crate) struct Pipeline {
    pub pipeline: wgpu::ComputePipeline,
    pub layout: wgpu::BindGroupLayout,
}

/// Kernels that were compiled so far.
#[derive(Debug)]
pub(crate) struct Kernels {
    sources: Sources,
    compiled: Mutex<BTreeMap<String, Arc<Pipeline>>>,
}

impl Kernels {
    pub fn new(sources: Sources) -> Self {
        Self { sources, compiled: Mutex::default() }
    }

    pub fn get(&self, device: &Device, kernel: &Kernel) -> Result<Arc<Pipeline>, GpuError> {
        let name = kernel.name();
        let mut compiled = self.compiled.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(pipeline) = compiled.get(&name) {
            return Ok(pipeline.clone());
        }
        let pipeline = Arc::new(compile(device, &self.sources, kernel, &name)?);
        compiled.insert(name, pipeline.clone());
        Ok(pipeline)
    }
}

fn compile(device: &Device, sources: &Sources, kernel: &Kernel, name: &str) -> Result<Pipeline, GpuError> {
    let Device { device, .. } = device;
    let access = kernel.module.access();
    debug_assert!(access.len() <= STORAGE_BINDINGS as usize);
    let entry = |binding: usize, ty| wgpu::BindGroupLayoutEntry {
        binding: binding as u32,
        visibility: wgpu::ShaderStages::COMPUTE,
        ty: wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None },
        count: None,
    };
    let mut entries = vec![entry(0, wgpu::BufferBindingType::Uniform)];
    for (k, access) in access.bytes().enumerate() {
        entries.push(entry(k + 1, wgpu::BufferBindingType::Storage { read_only: access == b'r' }));
    }
    let scope = device.push_error_scope(wgpu::ErrorFilter::Validation);
    let layout =
        device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(name), entries: &entries });
    let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some(name),
        bind_group_layouts: &[Some(&layout)],
        immediate_size: 0,
    });
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: Some(name),
        source: wgpu::ShaderSource::Wgsl(sources.of(kernel.module).into()),
    });
    let constants: Vec<(&str, f64)> = kernel.constants.iter().map(|(name, value)| (*name, f64::from(*value))).collect();
    let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(name),
        layout: Some(&pipeline_layout),
        module: &module,
        entry_point: Some(kernel.entry),
        // Kernels write what they read of the memory that a workgroup shares.
        compilation_options: wgpu::PipelineCompilationOptions {
            constants: &constants,
            zero_initialize_workgroup_memory: false,
        },
        cache: None,
    });
    match pollster::block_on(scope.pop()) {
        Some(error) => Err(GpuError::Kernel { kernel: name.to_string(), problem: error.to_string() }),
        None => Ok(Pipeline { pipeline, layout }),
    }
}
