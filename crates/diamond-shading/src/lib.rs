//! Appearance of a surface under a known light: functions of geometry, light and material, forward and backward.
//!
//! The radiance of a pixel is made of two parts. The surface part is a microfacet BRDF over a diffuse base
//! ([`BrdfModel`], [`Material`]). The subsurface part is learned: a residual per point, from a small network
//! ([`ResidualNetwork`]) or from transfer coefficients in spherical harmonics of the light's direction
//! ([`transfer_radiance`]). [`shade`] blends both, pixel by pixel, from the feature channels that any rasteriser left in a
//! [`GBuffer`], and [`ShadePullback::pull`] takes an image gradient back to those channels. Beside them stand the visibility
//! of a point as spherical harmonics ([`sh_visibility`]) and the normals that a depth map implies ([`pseudo_normals`]).
//!
//! What physics says of the subsurface part without learning is [`SurfelTransport`]: a [`RadialProfile`] carries light between
//! points of the surface, and its few weights are fitted to photographs by [`NormalEquations`].
//!
//! Invariant: nothing here knows of Gaussians, of how the features were blended, of files or of optimisers. Every function is
//! deterministic, with the same bits on any number of threads. Directions are unit vectors that point away from the surface;
//! radiance is linear RGB; α is the square of the roughness. Gradients with respect to unit vectors are those of free
//! vectors: their part along the vector is meaningless and vanishes in the pullback of whatever normalised it.
//!
//! Deferred shading and the network run on the process's instruction set (`diamond-simd`), chosen at run time. The feature
//! `parallel`, off by default, spreads rows and chunks over threads.
//!
//! ```
//! use diamond_camera::{Camera, Intrinsics, Pose};
//! use diamond_image::Image;
//! use diamond_light::OlatLight;
//! use diamond_shading::{GBuffer, IncidentModel, ShadedGrad, ShadingConfig, channel, shade};
//! use diamond_light::Falloff;
//! use glam::Vec3;
//!
//! // One pixel of clay, two units ahead, facing the camera.
//! let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.5, 1, 1), pose: Pose::IDENTITY };
//! let mut features = Image::new(1, 1, channel::COUNT);
//! features.pixel_mut(0, 0)[channel::BASE_COLOR].copy_from_slice(&[0.8, 0.5, 0.3]);
//! features.pixel_mut(0, 0)[channel::ROUGHNESS] = 0.6;
//! features.pixel_mut(0, 0)[channel::NORMAL].copy_from_slice(&[0.0, 0.0, -1.0]);
//! let (opacity, depth) = (Image::filled(1, 1, 1, 1.0), Image::filled(1, 1, 1, 2.0));
//! let gbuffer = GBuffer { features: &features, opacity: &opacity, depth: &depth };
//!
//! let light = OlatLight::Point { position: Vec3::new(1.0, 0.0, 0.0), intensity: Vec3::ONE };
//! let config = ShadingConfig { incident: IncidentModel::Physical(Falloff::None), ..ShadingConfig::default() };
//! let (shaded, pullback) = shade(&gbuffer, &camera, &light, &config)?;
//! assert!(shaded.radiance.pixel(0, 0)[0] > shaded.radiance.pixel(0, 0)[2]);
//!
//! // How should the material change to make the pixel brighter?
//! let brighter = ShadedGrad { radiance: Some(Image::filled(1, 1, 3, 1.0)), ..ShadedGrad::default() };
//! let grad = pullback.pull(&brighter)?;
//! assert!(grad.features.pixel(0, 0)[channel::BASE_COLOR.start] > 0.0);
//! # Ok::<(), diamond_shading::ShadingError>(())
//! ```
mod angles;
mod block_shader;
mod brdf;
mod deferred;
mod encoding;
mod error;
mod fresnel;
mod gaussian_sum;
pub mod gbuffer;
pub mod ggx;
mod incidence;
mod many_lights;
mod material;
mod mlp;
mod mlp_chunk;
mod normal_equations;
mod normalized_diffusion;
mod number;
mod pixel_block;
mod pixels;
mod prepared;
mod pseudo_normal;
mod radial_profile;
mod residual;
mod row_blocks;
mod row_chunks;
pub mod sh_visibility;
mod shaded;
mod simd;
mod surface_point;
mod surfel_irradiance;
mod surfel_transport;
mod transfer;
mod vector;

pub use angles::{Angles, AnglesGrad, DirectionsGrad};
pub use block_shader::{BlendedBlock, BlockShader, PreparedBlock, ShadedRecords};
pub use brdf::{BrdfModel, CosineFloor, Diffuse, ReflectGrad};
pub use deferred::{Combine, IncidentModel, ShadePullback, ShadingConfig, SurfaceVisibility, shade, shade_at};
pub use encoding::{
    ENCODED_POSITION, ENCODING_FREQUENCIES, InputGradients, InputScaling, LIGHT_COLUMNS, LightDistanceInput,
    RESIDUAL_INPUTS, ResidualInputs, ResidualInputsGrad, ResidualInputsPullback, ScaleInput, positional_encoding,
    positional_encoding_pull,
};
pub use error::ShadingError;
pub use fresnel::Fresnel;
pub use gaussian_sum::GAUSSIAN_SUM_TOLERANCE;
pub use gbuffer::{GBuffer, GBufferGrad, MIN_OPACITY, channel};
pub use ggx::Masking;
pub use many_lights::{LightChannels, LitRows, ManyLights};
pub use material::{DIELECTRIC_F0, MIN_ROUGHNESS, Material, MaterialGrad};
pub use mlp::{Activation, CHUNK_ROWS, GRADIENT_GROUPS, Mlp, MlpGrad, MlpPullback, MlpShape};
pub use normal_equations::{NormalEquations, SolveOptions};
pub use normalized_diffusion::{MIN_DIFFUSION_LENGTH, NormalizedDiffusion, NormalizedDiffusionGrad};
pub use prepared::{Prepared, TransportChannels};
pub use pseudo_normal::{MIN_COVERAGE, PseudoNormalPullback, pseudo_normals};
pub use radial_profile::{RadialProfile, RadialProfileGrad, plane_gaussian, plane_gaussian_pull};
pub use residual::{ResidualNetwork, ResidualNetworkConfig, ResidualNetworkGrad, ResidualOutput, ResidualPullback};
pub use shaded::{Shaded, ShadedGrad, ShadedMaps, ShadedMapsGrad};
pub use surface_point::{MIN_COS_THETA_O, MIN_NORMAL_LENGTH};
pub use surfel_irradiance::{Entry, SurfelLighting, SurfelLightingGrad};
pub use surfel_transport::{Balance, ExitanceGrad, ExitancePullback, Receivers, SurfelTransport, Surfels};
pub use transfer::{TransferActivation, TransferConfig, TransferGrad, TransferPullback, transfer_radiance};
