//! Anisotropic Gaussians and the N-channel tile rasteriser that blends them, forward and backward, on the CPU.
//!
//! Invariant: this crate knows nothing of materials, lights or images from disk: it blends feature channels.
mod config;
mod error;
mod gaussians;
mod ply;

pub use config::{Cutoff, RasterConfig};
pub use error::SplatError;
pub use gaussians::{Features, Gaussians, GaussiansGrad, RasterPull};
pub use ply::{
    PlyColumn, PlyFormat, PlyTable, PointCloud, SH_DC, ScalarType, SplatPly, parse_ply, ply_bytes, read_ply, write_ply,
};
