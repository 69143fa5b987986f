//! Anisotropic Gaussians and the N-channel tile rasteriser that blends them, forward and backward, on the CPU.
//!
//! Invariant: this crate knows nothing of materials, lights or images from disk: it blends feature channels.
mod bins;
mod blend;
mod blend_weights;
mod bvh;
mod config;
pub mod density;
mod ellipse;
mod error;
mod factor;
mod footprint;
mod gaussians;
mod hull;
mod lanes;
mod light_grid;
mod neighbours;
mod ply;
mod projection;
mod pullback;
mod rasterize;
mod recycle;
pub mod relocation;
mod visibility;
mod whole_file;
mod wide;

pub use blend_weights::{BlendBlock, BlendWeights, BlockBlender, KeepAll};
pub use config::{Cutoff, RasterConfig};
pub use error::SplatError;
pub use factor::LowerFactor;
pub use footprint::JACOBIAN_MARGIN;
pub use gaussians::{Features, Gaussians, GaussiansGrad, RasterPull};
pub use hull::{Hull, HullConfig, scene_bounds_from_masks, visual_hull};
pub use light_grid::LightGrid;
pub use neighbours::mean_squared_distance_to_nearest;
pub use ply::{
    Keep, PlyColumn, PlyElementLayout, PlyFormat, PlyLayout, PlyPropertyLayout, PlyTable, PointCloud, SH_DC,
    ScalarType, SplatPly, parse_ply, parse_ply_columns, ply_bytes, ply_layout, read_ply, replace_file, write_ply,
};
pub use projection::{Ellipse64, Footprint, Projection, project};
pub use rasterize::{Raster, RasterGrad, RasterPullback, RasterStats, rasterize, rasterize_projected};
pub use recycle::{KEPT_BYTES, keep_buffers};
pub use visibility::{GaussianBvh, MAX_OCCLUDER_ALPHA, MIN_OCCLUDER_ALPHA, VisibilityConfig};
pub use whole_file::{WriteFailure, remove_leftovers, write_whole, write_whole_with};
