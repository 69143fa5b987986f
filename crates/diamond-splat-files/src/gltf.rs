//! glTF 2.0 with the extension `KHR_gaussian_splatting`: splats as a primitive of points with attributes of their own.
//!
//! Follows the ratified text ("Complete, Ratified by the Khronos Group"): `POSITION`; `ROTATION` as x y z w;
//! `SCALE` as linear standard deviations; `OPACITY` in [0, 1]; `SH_DEGREE_l_COEF_n` as red green blue, n = l + m, with the
//! Condon–Shortley sign and ½ added to the sum; kernel `ellipse`; colour space `srgb_rec709_display` or
//! `lin_rec709_display`. The review draft stored logarithms as `SCALE`; a primitive with a negative scale, which the
//! ratified text forbids, is read so, and a note says it. glTF's world has y up and metres; coordinates
//! are passed on as they are, times the transforms of the nodes on reading.
//!
//! Files written are float throughout, one primitive, one node without a transform, `COLOR_0` for viewers that know only
//! points. `.glb` has one binary chunk, `.gltf` the same bytes as a data URI. Opacity and scale are converted in double
//! precision and rounded once: opacity is kept to 6·10⁻⁸, the logarithm of the scale to 1.2·10⁻⁷ and one step of 32 bits;
//! rotations are normalised; all else is kept bit for bit.
mod accessors;
mod document;
mod reading;
mod writing;

pub(crate) use reading::parse;
pub(crate) use writing::{glb_bytes, gltf_bytes};

/// Name of the extension.
pub const GLTF_EXTENSION: &str = "KHR_gaussian_splatting";

const FORMAT: &str = "glTF";

/// "glTF".
const GLB_MAGIC: &[u8; 4] = b"glTF";
const CHUNK_JSON: &[u8; 4] = b"JSON";
const CHUNK_BINARY: &[u8; 4] = b"BIN\0";

/// Primitive mode of points.
const POINTS: u32 = 0;

/// Colour spaces of the extension.
const DISPLAY: &str = "srgb_rec709_display";
const LINEAR: &str = "lin_rec709_display";

/// The name of an attribute of the extension.
fn attribute(name: &str) -> String {
    format!("{GLTF_EXTENSION}:{name}")
}

/// The name of the attribute of coefficient `l² + n`.
fn coefficient_attribute(degree: usize, n: usize) -> String {
    attribute(&format!("SH_DEGREE_{degree}_COEF_{n}"))
}

/// Whether bytes begin as a `.glb` or a JSON object does.
pub(crate) fn looks_like(bytes: &[u8]) -> bool {
    bytes.starts_with(GLB_MAGIC) || bytes.trim_ascii_start().starts_with(b"{")
}
