//! See Cargo.toml.
mod angles;
mod brdf;
mod deferred;
mod encoding;
mod error;
mod fresnel;
pub mod gbuffer;
pub mod ggx;
mod material;
mod mlp;
mod mlp_chunk;
mod prepared;
mod pseudo_normal;
mod residual;
mod row_chunks;
pub mod sh_visibility;
mod shaded;
mod simd;
mod surface_point;
mod transfer;

pub use angles::{Angles, AnglesGrad, DirectionsGrad};
pub use brdf::{BrdfModel, CosineFloor, Diffuse, ReflectGrad};
pub use deferred::{Combine, IncidentModel, ShadePullback, ShadingConfig, SurfaceVisibility, shade};
pub use encoding::{
    ENCODED_POSITION, ENCODING_FREQUENCIES, InputGradients, InputScaling, LightDistanceInput, RESIDUAL_INPUTS, ResidualInputs,
    ResidualInputsGrad, ResidualInputsPullback, ScaleInput, positional_encoding, positional_encoding_pull,
};
pub use error::ShadingError;
pub use fresnel::Fresnel;
pub use gbuffer::{GBuffer, GBufferGrad, MIN_OPACITY, channel};
pub use ggx::Masking;
pub use material::{DIELECTRIC_F0, MIN_ROUGHNESS, Material, MaterialGrad};
pub use mlp::{Activation, CHUNK_ROWS, GRADIENT_GROUPS, Mlp, MlpGrad, MlpPullback, MlpShape};
pub use prepared::Prepared;
pub use pseudo_normal::{MIN_COVERAGE, PseudoNormalPullback, pseudo_normals};
pub use residual::{ResidualNetwork, ResidualNetworkConfig, ResidualNetworkGrad, ResidualOutput, ResidualPullback};
pub use shaded::{Shaded, ShadedGrad, ShadedMaps, ShadedMapsGrad};
pub use surface_point::{MIN_COS_THETA_O, MIN_NORMAL_LENGTH};
pub use transfer::{TransferActivation, TransferConfig, TransferGrad, TransferPullback, transfer_radiance};
