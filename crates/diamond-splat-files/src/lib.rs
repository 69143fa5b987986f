//! Splat files of other programs, in and out: one cloud of Gaussians with colour in spherical harmonics, five formats.
//!
//! | format | read | written | precision |
//! |---|---|---|---|
//! | PLY (`x … f_dc_* f_rest_* opacity scale_* rot_*`) | text, binary of either order, any types and order of properties | `binary_little_endian`, float | as stored: bit for bit |
//! | compressed PLY (SuperSplat, splat-transform) | yes | no | 11, 10 and 8 bits in chunks of 256 |
//! | `.splat` | yes | yes | float positions and scales, 8 bits for the rest |
//! | SPZ | versions 1 to 4 | versions 3 and 4 | 24-bit positions, 8 bits for the rest |
//! | glTF `KHR_gaussian_splatting` (`.glb`, `.gltf`) | yes | yes | float |
//!
//! Invariants: coordinates are passed on as they are, no axis is turned unless [`SplatCloud::transform`] is asked to;
//! files come from elsewhere and are not trusted: a broken one is an error that names file, field, what was
//! expected and found, and what to do, never a panic; memory is bounded by a multiple of the file's size, see [`limits`].
//!
//! ```no_run
//! use diamond_splat_files::{SplatFormat, read, write};
//! let file = read("bunny.spz")?;
//! file.notes.iter().for_each(|note| eprintln!("{note}"));
//! for lost in write("bunny.glb", &file.cloud, &Default::default())? {
//!     eprintln!("{lost}");
//! }
//! # Ok::<(), diamond_splat_files::SplatFileError>(())
//! ```
mod cloud;
mod compressed_ply;
mod error;
mod format;
mod gltf;
mod harmonics;
pub mod limits;
mod plain_ply;
mod quantise;
mod splat_rows;
mod spz;
mod summary;
mod transform;

pub use cloud::{ColorSpace, MAX_DEGREE, MAX_LOG_SCALE, MAX_LOGIT, SplatCloud};
pub use error::SplatFileError;
pub use format::{SplatFile, SplatFormat, WriteOptions, parse, read, read_as, to_bytes, write, write_as};
pub use gltf::GLTF_EXTENSION;
pub use harmonics::rotate_harmonics;
pub use summary::{OPACITY_BINS, Summary};
