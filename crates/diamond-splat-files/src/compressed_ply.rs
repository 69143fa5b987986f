//! Compressed PLY of SuperSplat and splat-transform: splats packed into four words, in chunks of 256 with bounds.
//!
//! Element `chunk` holds the bounds of positions, log-scales and (in newer files) colours; `vertex` holds words:
//!
//! | word | bits, from the highest | meaning |
//! |---|---|---|
//! | `packed_position`, `packed_scale` | x 11, y 10, z 11 | position, log-scale between the chunk's bounds |
//! | `packed_rotation` | which 2, then 3 × 10 | index in w x y z of the component left out, the others as (v/1023 − ½)·√2 |
//! | `packed_color` | red 8, green 8, blue 8, opacity 8 | colour ½ + Y₀₀·f_dc between the chunk's bounds or 0 and 1; opacity |
//!
//! `sh` holds `f_rest_*` as bytes: 8·((v + ½)/256 − ½), with −4 at 0 and 4 at 255. Steps of what is read: 1/2047 and
//! 1/1023 of the chunk's extent, 1.4·10⁻³ in the quaternion, 1/255 in opacity and of the colour's bounds, 1/32 in `f_rest_*`.
use crate::cloud::{coefficients, logit};
use crate::error::{EXPORT_AGAIN, malformed};
use crate::limits::MAX_SPLATS;
use crate::quantise::{from_wxyz, with_largest};
use crate::{SplatCloud, SplatFileError};
use diamond_splat::{PlyElementLayout, PlyFormat, PlyLayout, SH_DC, ScalarType};
use glam::Vec3;

const FORMAT: &str = "compressed PLY";
const PER_CHUNK: usize = 256;

/// Whether the header is of this kind.
pub(crate) fn looks_like(layout: &PlyLayout) -> bool {
    layout.element("vertex").is_some_and(|e| e.property("packed_position").is_some())
}

/// Offset in the row of a property that must be there with that type.
fn offset(element: &PlyElementLayout, name: &str, scalar: ScalarType) -> Result<usize, SplatFileError> {
    let field = format!("property {name} of element {}", element.name);
    match element.property(name) {
        Some(p) if p.scalar == Some(scalar) => Ok(p.offset),
        Some(p) => {
            let found = p.scalar.map_or("a list", ScalarType::name);
            Err(malformed(FORMAT, field, format!("type {}", scalar.name()), found, EXPORT_AGAIN))
        }
        None => Err(malformed(FORMAT, field, format!("type {}", scalar.name()), "no such property", EXPORT_AGAIN)),
    }
}

fn element<'a>(layout: &'a PlyLayout, name: &str) -> Result<&'a PlyElementLayout, SplatFileError> {
    layout.element(name).ok_or_else(|| malformed(FORMAT, "header", format!("an element {name}"), "none", EXPORT_AGAIN))
}

fn word(row: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([row[at], row[at + 1], row[at + 2], row[at + 3]])
}

/// The `bits` of `word` above `shift` as [0, 1].
fn fraction(word: u32, shift: u32, bits: u32) -> f64 {
    let mask = (1u32 << bits) - 1;
    f64::from(word >> shift & mask) / f64::from(mask)
}

/// Three numbers between bounds, from 11, 10 and 11 bits.
fn between(word: u32, low: Vec3, high: Vec3) -> Vec3 {
    let t = [fraction(word, 21, 11), fraction(word, 11, 10), fraction(word, 0, 11)];
    Vec3::from(std::array::from_fn(|k| mix(low[k], high[k], t[k])))
}

fn mix(low: f32, high: f32, t: f64) -> f32 {
    (f64::from(low) * (1.0 - t) + f64::from(high) * t) as f32
}

/// Bounds of a chunk: where they are in its row.
struct Bounds {
    low: [usize; 3],
    high: [usize; 3],
}

impl Bounds {
    fn find(chunk: &PlyElementLayout, names: [&str; 3]) -> Result<Self, SplatFileError> {
        let mut out = Self { low: [0; 3], high: [0; 3] };
        for (k, name) in names.iter().enumerate() {
            out.low[k] = offset(chunk, &format!("min_{name}"), ScalarType::F32)?;
            out.high[k] = offset(chunk, &format!("max_{name}"), ScalarType::F32)?;
        }
        Ok(out)
    }

    fn read(&self, row: &[u8], what: &str, index: usize) -> Result<(Vec3, Vec3), SplatFileError> {
        let get = |at: [usize; 3]| Vec3::from(at.map(|at| f32::from_bits(word(row, at))));
        let (low, high) = (get(self.low), get(self.high));
        if low.is_finite() && high.is_finite() {
            Ok((low, high))
        } else {
            let field = format!("{what} bounds of chunk {index}");
            Err(malformed(FORMAT, field, "finite numbers", format!("{low} to {high}"), EXPORT_AGAIN))
        }
    }
}

/// Reads the splats that a header announced as `layout`.
pub(crate) fn parse(bytes: &[u8], layout: &PlyLayout) -> Result<(SplatCloud, Vec<String>), SplatFileError> {
    if layout.format != PlyFormat::BinaryLittleEndian {
        return Err(malformed(FORMAT, "format", "binary_little_endian", layout.format.name(), EXPORT_AGAIN));
    }
    let (vertex, chunk) = (element(layout, "vertex")?, element(layout, "chunk")?);
    let n = vertex.count;
    if n > MAX_SPLATS || chunk.count.checked_mul(PER_CHUNK).is_none_or(|room| room < n) {
        let found = format!("{n} splats in {} chunks", chunk.count);
        return Err(malformed(
            FORMAT,
            "header",
            format!("at most {MAX_SPLATS} splats, 256 to a chunk"),
            found,
            EXPORT_AGAIN,
        ));
    }
    let position = offset(vertex, "packed_position", ScalarType::U32)?;
    let rotation = offset(vertex, "packed_rotation", ScalarType::U32)?;
    let scale = offset(vertex, "packed_scale", ScalarType::U32)?;
    let color = offset(vertex, "packed_color", ScalarType::U32)?;
    let means = Bounds::find(chunk, ["x", "y", "z"])?;
    let scales = Bounds::find(chunk, ["scale_x", "scale_y", "scale_z"])?;
    let colors = match chunk.property("min_r") {
        Some(_) => Some(Bounds::find(chunk, ["r", "g", "b"])?),
        None => None,
    };
    let rows = vertex.rows(bytes)?;
    let chunks = chunk.rows(bytes)?;
    let sh = harmonics(bytes, layout, n)?;
    let degree = sh.as_ref().map_or(0, |sh| sh.degree);
    let width = coefficients(degree);
    let mut cloud = SplatCloud::zeros(n, degree);
    let (stride, chunk_stride) = (vertex.stride.unwrap_or(1), chunk.stride.unwrap_or(1));
    for (index, (rows, chunk)) in rows.chunks(stride * PER_CHUNK).zip(chunks.chunks_exact(chunk_stride)).enumerate() {
        let (low, high) = means.read(chunk, "position", index)?;
        let (low_scale, high_scale) = scales.read(chunk, "scale", index)?;
        let (low_color, high_color) = match &colors {
            Some(bounds) => bounds.read(chunk, "colour", index)?,
            None => (Vec3::ZERO, Vec3::ONE),
        };
        for (row, i) in rows.chunks_exact(stride).zip(index * PER_CHUNK..) {
            cloud.means[i] = between(word(row, position), low, high);
            cloud.log_scales[i] = between(word(row, scale), low_scale, high_scale);
            let packed = word(row, rotation);
            let others = [20, 10, 0].map(|shift| (fraction(packed, shift, 10) - 0.5) * std::f64::consts::SQRT_2);
            cloud.rotations[i] = from_wxyz(with_largest((packed >> 30) as usize, others));
            let packed = word(row, color);
            for (k, shift) in [24, 16, 8].into_iter().enumerate() {
                let value = mix(low_color[k], high_color[k], fraction(packed, shift, 8));
                cloud.sh[i * width * 3 + k] = (value - 0.5) / SH_DC;
            }
            cloud.opacity_logits[i] = logit(fraction(packed, 0, 8));
        }
    }
    if let Some(sh) = sh {
        for i in 0..n {
            for channel in 0..3 {
                for k in 1..width {
                    let byte = sh.rows[i * sh.stride + sh.offsets[channel * (width - 1) + k - 1]];
                    cloud.sh[(i * width + k) * 3 + channel] = coefficient(byte);
                }
            }
        }
    }
    let notes = [(colors.is_none(), "older file without bounds of colours: colours lie in [0, 1]")];
    Ok((cloud, notes.into_iter().filter(|(yes, _)| *yes).map(|(_, note)| note.to_string()).collect()))
}

/// Element `sh`.
struct Harmonics<'a> {
    degree: usize,
    rows: &'a [u8],
    stride: usize,
    offsets: Vec<usize>,
}

fn harmonics<'a>(bytes: &'a [u8], layout: &PlyLayout, n: usize) -> Result<Option<Harmonics<'a>>, SplatFileError> {
    let Some(element) = layout.element("sh") else { return Ok(None) };
    let count = element.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let degree = match count {
        9 => 1,
        24 => 2,
        45 => 3,
        _ => {
            let found = format!("{count} properties");
            return Err(malformed(FORMAT, "element sh", "9, 24 or 45 properties f_rest_*", found, EXPORT_AGAIN));
        }
    };
    if element.count != n {
        return Err(malformed(FORMAT, "element sh", format!("{n} rows"), element.count.to_string(), EXPORT_AGAIN));
    }
    let offsets =
        (0..count).map(|i| offset(element, &format!("f_rest_{i}"), ScalarType::U8)).collect::<Result<_, _>>()?;
    Ok(Some(Harmonics { degree, rows: element.rows(bytes)?, stride: element.stride.unwrap_or(1), offsets }))
}

fn coefficient(byte: u8) -> f32 {
    match byte {
        0 => -4.0,
        255 => 4.0,
        v => ((f32::from(v) + 0.5) / 256.0 - 0.5) * 8.0,
    }
}
