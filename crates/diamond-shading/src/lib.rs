//! See Cargo.toml.
mod angles;
mod brdf;
mod error;
mod fresnel;
pub mod ggx;
mod material;
mod mlp;
mod row_chunks;
mod simd;

pub use angles::{Angles, AnglesGrad, DirectionsGrad};
pub use brdf::{BrdfModel, CosineFloor, Diffuse, ReflectGrad};
pub use error::ShadingError;
pub use fresnel::Fresnel;
pub use ggx::Masking;
pub use material::{DIELECTRIC_F0, MIN_ROUGHNESS, Material, MaterialGrad};
pub use mlp::{Activation, Mlp, MlpGrad, MlpPullback, MlpShape};
