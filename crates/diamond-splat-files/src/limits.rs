//! How much memory a file may cause to be used.
//!
//! Formats without compression hold each value in the file, so the cloud is at most [`PLAIN_FACTOR`] times as large as
//! the bytes ([`GLTF_FACTOR`] for glTF). A compressed body may unfold to [`MAX_EXPANSION`] times the file, or to [`SMALL_BODY`] where that is more,
//! and the cloud is at most [`PACKED_FACTOR`] times the body. A count in a header is compared with the bytes there are
//! before anything is allocated by it.

/// Unfolded bytes per byte of a compressed file. Real SPZ files reach 2 to 6.
pub const MAX_EXPANSION: usize = 64;

/// A body of this many bytes may always be unfolded: small files of equal splats compress beyond [`MAX_EXPANSION`].
pub const SMALL_BODY: usize = 16 << 20;

/// Bytes of cloud and working memory per byte of a PLY or `.splat` file, at most.
pub const PLAIN_FACTOR: usize = 32;

/// The same for glTF, where a mesh may be placed several times and JSON lists many small things.
pub const GLTF_FACTOR: usize = 128;

/// Bytes of cloud and working memory per byte of an unfolded body, at most.
pub const PACKED_FACTOR: usize = 16;

/// Splats per file at most, whatever its size: 2²⁷, a cloud of 30 GB at degree 3.
pub const MAX_SPLATS: usize = 1 << 27;

/// Most bytes that a compressed body may have in a file of `file` bytes.
pub fn largest_body(file: usize) -> usize {
    file.saturating_mul(MAX_EXPANSION).max(SMALL_BODY)
}
