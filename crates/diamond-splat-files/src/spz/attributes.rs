//! The six attributes of SPZ: bytes to values and back.
use super::{FORMAT, Header};
use crate::cloud::{coefficients, logit, sigmoid, unit};
use crate::error::{EXPORT_AGAIN, TRUNCATED, malformed};
use crate::quantise::{byte, from_wxyz, half, split_largest, with_largest};
use crate::{MAX_DEGREE, SplatCloud, SplatFileError};
use glam::{Quat, Vec3};

/// Colour bytes are 255·(½ + this·f_dc).
const COLOR_SCALE: f64 = 0.15;

/// Largest magnitude of a position as an integer of 24 bits.
const MAX_FIXED: f64 = (1 << 23) as f64 - 1.0;

/// Fractional bits that are written where they fit, the customary number: steps of 1/4096.
const USUAL_BITS: u32 = 12;

/// Positions are written with steps of at most this part of the largest coordinate.
const WANTED_STEPS: f64 = (1 << 18) as f64;

/// Largest magnitude of a smallest-three component as an integer.
const SMALLEST: f64 = 511.0;

/// How many fractional bits the positions of a cloud are written with: as many as give 2¹⁸ steps to the largest
/// coordinate, at least the customary 12 where these fit.
pub(super) fn fractional_bits(cloud: &SplatCloud) -> Result<u32, SplatFileError> {
    let largest = cloud.means.iter().map(|m| f64::from(m.abs().max_element())).fold(0.0, f64::max);
    let fits = |bits: u32| largest * libm::exp2(f64::from(bits)) <= MAX_FIXED;
    if !fits(0) {
        let found = format!("{largest}");
        return Err(malformed(
            FORMAT,
            "positions to write",
            "coordinates below 2²³",
            found,
            "scale the cloud down, or write PLY or glTF",
        ));
    }
    let mut bits = 0;
    while bits < 23 && fits(bits + 1) && (bits < USUAL_BITS || largest * libm::exp2(f64::from(bits)) < WANTED_STEPS) {
        bits += 1;
    }
    Ok(if largest == 0.0 { USUAL_BITS } else { bits })
}

/// The values in a body whose length [`Header::widths`] gives.
pub(super) fn decode(header: &Header, body: &[u8]) -> Result<SplatCloud, SplatFileError> {
    let n = header.count;
    let widths = header.widths();
    let mut rest = body;
    let mut streams: [&[u8]; 6] = [&[]; 6];
    for (stream, width) in streams.iter_mut().zip(widths) {
        let Some((head, tail)) = n.checked_mul(width).and_then(|size| rest.split_at_checked(size)) else {
            let expected = format!("{} bytes of {n} splats", widths.iter().sum::<usize>().saturating_mul(n));
            return Err(malformed(FORMAT, "attributes", expected, format!("{} bytes", body.len()), TRUNCATED));
        };
        (*stream, rest) = (head, tail);
    }
    let [positions, alphas, colors, scales, rotations, harmonics] = streams;
    let degree = header.degree.min(MAX_DEGREE);
    let (width, stored) = (coefficients(degree), coefficients(header.degree) - 1);
    let mut cloud = SplatCloud::zeros(n, degree);
    let step = libm::exp2(-f64::from(header.fractional_bits));
    for i in 0..n {
        let p = &positions[i * widths[0]..(i + 1) * widths[0]];
        cloud.means[i] = Vec3::from(std::array::from_fn(|k| match header.version {
            1 => half(u16::from_le_bytes([p[k * 2], p[k * 2 + 1]])),
            // The sign is the highest of 24 bits: shifted up to 32 and back down.
            _ => (f64::from(i32::from_le_bytes([0, p[k * 3], p[k * 3 + 1], p[k * 3 + 2]]) >> 8) * step) as f32,
        }));
        if !cloud.means[i].is_finite() {
            let found = cloud.means[i].to_string();
            return Err(malformed(FORMAT, format!("position of splat {i}"), "finite numbers", found, EXPORT_AGAIN));
        }
        cloud.opacity_logits[i] = logit(f64::from(alphas[i]) / 255.0);
        cloud.log_scales[i] = Vec3::from(std::array::from_fn(|k| f32::from(scales[i * 3 + k]) / 16.0 - 10.0));
        for k in 0..3 {
            let value = (f64::from(colors[i * 3 + k]) / 255.0 - 0.5) / COLOR_SCALE;
            cloud.sh[i * width * 3 + k] = value as f32;
        }
        cloud.rotations[i] = rotation(&rotations[i * widths[4]..(i + 1) * widths[4]]);
        for k in 1..width {
            for channel in 0..3 {
                let byte = harmonics[(i * stored + k - 1) * 3 + channel];
                cloud.sh[(i * width + k) * 3 + channel] = (f32::from(byte) - 128.0) / 128.0;
            }
        }
    }
    Ok(cloud)
}

/// Three or four bytes.
fn rotation(bytes: &[u8]) -> Quat {
    if let [x, y, z] = *bytes {
        let others = [x, y, z].map(|v| f64::from(v) / 127.5 - 1.0);
        return unit(from_wxyz(with_largest(0, others)));
    }
    let mut packed = u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
    let largest = (packed >> 30) as usize;
    // The last component is in the lowest bits.
    let mut others = [0.0; 3];
    for slot in others.iter_mut().rev() {
        let magnitude = f64::from(packed & 511) / SMALLEST * std::f64::consts::FRAC_1_SQRT_2;
        *slot = if packed >> 9 & 1 == 1 { -magnitude } else { magnitude };
        packed >>= 10;
    }
    let [x, y, z, w] = with_largest(largest, others);
    unit(from_wxyz([w, x, y, z]))
}

fn packed_rotation(q: Quat) -> u32 {
    let (largest, others) = split_largest(unit(q).to_array().map(f64::from));
    others.iter().fold(largest as u32, |packed, v| {
        let magnitude = (v.abs() * std::f64::consts::SQRT_2 * SMALLEST).round().min(SMALLEST) as u32;
        packed << 10 | u32::from(*v < 0.0) << 9 | magnitude
    })
}

/// The streams in file order, rotations as smallest three.
pub(super) fn encode(header: &Header, cloud: &SplatCloud) -> [Vec<u8>; 6] {
    let n = cloud.len();
    let mut streams = header.widths().map(|width| Vec::with_capacity(width * n));
    let [positions, alphas, colors, scales, rotations, harmonics] = &mut streams;
    let steps = libm::exp2(f64::from(header.fractional_bits));
    let width = cloud.coefficients();
    for i in 0..n {
        for v in cloud.means[i].to_array() {
            let fixed = (f64::from(v) * steps).round().clamp(-MAX_FIXED, MAX_FIXED) as i32;
            positions.extend_from_slice(&fixed.to_le_bytes()[..3]);
        }
        alphas.push(byte(f64::from(sigmoid(cloud.opacity_logits[i])) * 255.0));
        scales.extend(cloud.log_scales[i].to_array().map(|v| byte((f64::from(v) + 10.0) * 16.0)));
        rotations.extend_from_slice(&packed_rotation(cloud.rotations[i]).to_le_bytes());
        let sh = &cloud.sh[i * width * 3..(i + 1) * width * 3];
        colors.extend(sh[..3].iter().map(|v| byte((f64::from(*v) * COLOR_SCALE + 0.5) * 255.0)));
        harmonics.extend(sh[3..].iter().map(|v| byte(f64::from(*v) * 128.0 + 128.0)));
    }
    streams
}
