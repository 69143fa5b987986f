//! The rasteriser and parts of the training step as WGSL on any GPU that wgpu reaches, each beside its CPU twin.
//!
//! [`Rasterizer`] keeps everything between parameters and picture on the device ([`STAGES`]), and is a
//! [`Blender`](diamond_reconstruct::Blender) for training; what else a step needs ([`COMPONENTS`]) is called part by part.
//!
//! Invariant: kernels use the limits that every WebGPU device has, no subgroups, and no atomic addition of floats: sums are made
//! in a fixed order, so that two runs on one device give the same bits.
//!
//! ```no_run
//! use diamond_camera::{Camera, Intrinsics, Pose};
//! use diamond_gpu::{Device, DeviceChoice, Rasterizer};
//! use diamond_splat::{Features, Gaussians, RasterConfig};
//! use glam::{Quat, Vec3};
//! use std::sync::Arc;
//!
//! let mut gaussians = Gaussians::default();
//! gaussians.push(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.2), Quat::IDENTITY, 0.8);
//! let features = Features { channels: 1, data: vec![0.5] };
//! let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.9, 32, 32), pose: Pose::IDENTITY };
//! if let Some(device) = Device::open(DeviceChoice::Auto)? {
//!     let mut rasterizer = Rasterizer::new(Arc::new(device))?;
//!     let (raster, _) = rasterizer.rasterize(&gaussians, &features, &camera, &RasterConfig::default())?;
//!     assert!((raster.opacity.pixel(16, 16)[0] - 0.8).abs() < 0.02);
//! }
//! # Ok::<(), diamond_gpu::GpuError>(())
//! ```
mod adam;
mod adapter;
mod arrays;
mod device;
mod device_network;
mod error;
mod frame;
mod host_state;
mod image_terms;
mod job;
mod kernels;
mod losses;
mod model_view;
mod network;
mod parameter_arrays;
mod photographs;
mod rasterizer;
mod relighter;
mod scene_arrays;
mod shading;
mod shape;
mod stage;
mod step_arrays;
mod stepper;
pub mod twin;
mod workspace;

pub use adam::{adam_step, record_view};
pub use adapter::{Adapter, DeviceChoice, DeviceKind, adapters, choose};
pub use device::Device;
pub use error::GpuError;
pub use frame::{Coverage, Frame, GaussianGrad, Splat, TILE};
pub use host_state::{HostState, RasterScene, Side};
pub use kernels::{Kernel, Module, Sources};
pub use losses::{mask_bce, photometric};
pub use network::{mlp_forward, mlp_pull};
pub use rasterizer::{DevicePullback, DeviceStats, Rasterizer, StageTime};
pub use relighter::DeviceRelighter;
pub use shading::{Lighting, shade, shade_pull};
pub use shape::{Column, Shape};
pub use stage::{COMPONENTS, ComponentRow, STAGES, STEP_PARTS, Stage, StageRow};
pub use stepper::DeviceStepper;
pub use workspace::Store;
