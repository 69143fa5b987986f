//! `.splat`: rows of 32 bytes without a header, as web viewers stream them.
//!
//! Little-endian: position 3 × f32, scale 3 × f32 (linear), red green blue and opacity 4 × u8, quaternion w x y z as
//! 128 + 128·q in 4 × u8. Colour is ½ + Y₀₀ · coefficient 0; there is no dependence on direction. Steps: 1/255 in
//! colour and opacity, 1/128 in a component of the quaternion.
use crate::cloud::{log_scale, logit, scale, sigmoid, unit};
use crate::error::{EXPORT_AGAIN, TRUNCATED, malformed};
use crate::limits::MAX_SPLATS;
use crate::quantise::byte;
use crate::{SplatCloud, SplatFileError};
use diamond_splat::SH_DC;
use glam::{Quat, Vec3};

const ROW: usize = 32;
const FORMAT: &str = ".splat";

/// Reads rows.
pub(crate) fn parse(bytes: &[u8]) -> Result<(SplatCloud, Vec<String>), SplatFileError> {
    if !bytes.len().is_multiple_of(ROW) {
        let found = format!("{} bytes, {} too many", bytes.len(), bytes.len() % ROW);
        return Err(malformed(FORMAT, "length", "a multiple of 32 bytes (no header, 32 per splat)", found, TRUNCATED));
    }
    let count = bytes.len() / ROW;
    if count > MAX_SPLATS {
        let found = format!("{count} splats");
        return Err(malformed(FORMAT, "length", format!("at most {MAX_SPLATS} splats"), found, "split the file"));
    }
    let mut cloud = SplatCloud::zeros(count, 0);
    for (i, row) in bytes.chunks_exact(ROW).enumerate() {
        let float = |at: usize| f32::from_le_bytes([row[at], row[at + 1], row[at + 2], row[at + 3]]);
        let mean = Vec3::new(float(0), float(4), float(8));
        if !mean.is_finite() {
            return Err(malformed(
                FORMAT,
                format!("position of splat {i}"),
                "finite numbers",
                mean.to_string(),
                EXPORT_AGAIN,
            ));
        }
        let scales = [float(12), float(16), float(20)];
        if let Some(bad) = scales.iter().find(|s| !(**s >= 0.0 && s.is_finite())) {
            let field = format!("scale of splat {i}");
            return Err(malformed(FORMAT, field, "standard deviations of 0 or more", bad.to_string(), EXPORT_AGAIN));
        }
        cloud.means[i] = mean;
        cloud.log_scales[i] = Vec3::from(scales.map(|s| log_scale(f64::from(s))));
        for k in 0..3 {
            cloud.sh[i * 3 + k] = (f32::from(row[24 + k]) / 255.0 - 0.5) / SH_DC;
        }
        cloud.opacity_logits[i] = logit(f64::from(row[27]) / 255.0);
        let [w, x, y, z] = [28, 29, 30, 31].map(|at| (f32::from(row[at]) - 128.0) / 128.0);
        cloud.rotations[i] = unit(Quat::from_xyzw(x, y, z, w));
    }
    Ok((cloud, Vec::new()))
}

/// Writes rows; only degree 0 of the colour.
pub(crate) fn to_bytes(cloud: &SplatCloud) -> Vec<u8> {
    let mut out = Vec::with_capacity(cloud.len() * ROW);
    for i in 0..cloud.len() {
        cloud.means[i].to_array().iter().for_each(|v| out.extend(v.to_le_bytes()));
        cloud.log_scales[i].to_array().iter().for_each(|v| out.extend(scale(*v).to_le_bytes()));
        cloud.base_color(i).to_array().iter().for_each(|v| out.push(byte(f64::from(*v) * 255.0)));
        out.push(byte(f64::from(sigmoid(cloud.opacity_logits[i])) * 255.0));
        let q = unit(cloud.rotations[i]);
        [q.w, q.x, q.y, q.z].iter().for_each(|v| out.push(byte(f64::from(*v) * 128.0 + 128.0)));
    }
    out
}
