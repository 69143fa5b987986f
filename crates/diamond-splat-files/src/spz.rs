//! SPZ, the compact splat format of Niantic: quantised attributes one after another, compressed.
//!
//! Versions 1 to 3 are one gzip stream of a 16-byte header and six attributes; version 4 is a 32-byte header, a table of
//! contents and one zstd frame per attribute. All numbers are little-endian.
//!
//! | attribute | stored | step |
//! |---|---|---|
//! | position | 24-bit fixed point, the header says how many fractional bits (version 1: half floats) | 2^−fractional bits |
//! | opacity | byte, 255·σ | 1/255 |
//! | colour | bytes, 255·(½ + 0.15·f_dc) | 0.026 in f_dc, which is 1/135 in colour; |f_dc| ≤ 3.33 |
//! | scale | bytes, 16·(log-scale + 10) | 1/16 in the logarithm, that is 6 %; −10 to 5.94 |
//! | rotation | smallest three: 2 bits which, 3 × (sign, 9 bits) of √½ (before version 3: x y z as bytes, w ≥ 0) | 0.0014 (0.008) |
//! | harmonics | bytes 128 + 128·coefficient, coefficient after coefficient, red green blue within | 1/128; −1 to 0.99 |
//!
//! The format states that its axes are x right, y up, z backward. Coordinates are passed on as they are all the same.
mod attributes;
mod container;

use crate::error::{EXPORT_AGAIN, TRUNCATED, malformed};
use crate::{SplatCloud, SplatFileError};

const FORMAT: &str = "SPZ";

/// "NGSP" read as a little-endian number.
const MAGIC: u32 = 0x5053_474e;

/// Fitted with an antialiasing filter.
const FLAG_ANTIALIASED: u8 = 0x01;
/// Records of other programs follow.
const FLAG_EXTENSIONS: u8 = 0x02;

/// What the header says that both containers share.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Header {
    version: u32,
    count: usize,
    degree: usize,
    fractional_bits: u32,
    flags: u8,
}

impl Header {
    /// The first 15 bytes, which are the same in all versions.
    fn parse(bytes: &[u8]) -> Result<Self, SplatFileError> {
        let Some(head) = bytes.get(..16) else {
            let found = format!("{} bytes", bytes.len());
            return Err(malformed(FORMAT, "header", "16 bytes or more", found, TRUNCATED));
        };
        let word = |at: usize| u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
        if word(0) != MAGIC {
            let found = format!("{:08x}", word(0));
            return Err(malformed(FORMAT, "first four bytes", format!("{MAGIC:08x}"), found, "this is no SPZ file"));
        }
        let (version, count) = (word(4), word(8));
        if !(1..=4).contains(&version) {
            return Err(malformed(
                FORMAT,
                "version",
                "1 to 4",
                version.to_string(),
                "export the file as version 3 or 4",
            ));
        }
        if count as usize > crate::limits::MAX_SPLATS {
            let expected = format!("at most {} splats", crate::limits::MAX_SPLATS);
            return Err(malformed(FORMAT, "count", expected, count.to_string(), TRUNCATED));
        }
        if head[12] > 4 {
            return Err(malformed(FORMAT, "degree", "0 to 4", head[12].to_string(), EXPORT_AGAIN));
        }
        if head[13] > 24 {
            return Err(malformed(FORMAT, "fractional bits", "0 to 24", head[13].to_string(), EXPORT_AGAIN));
        }
        Ok(Self {
            version,
            count: count as usize,
            degree: usize::from(head[12]),
            fractional_bits: u32::from(head[13]),
            flags: head[14],
        })
    }

    /// Bytes per splat of each attribute, in file order.
    fn widths(&self) -> [usize; 6] {
        let position = if self.version == 1 { 6 } else { 9 };
        let rotation = if self.version < 3 { 3 } else { 4 };
        [position, 1, 3, 3, rotation, (crate::cloud::coefficients(self.degree) - 1) * 3]
    }
}

/// Whether bytes begin as an SPZ file does.
pub(crate) fn looks_like(bytes: &[u8]) -> bool {
    bytes.starts_with(&MAGIC.to_le_bytes()) || bytes.starts_with(&[0x1f, 0x8b])
}

/// Reads any version.
pub(crate) fn parse(bytes: &[u8]) -> Result<(SplatCloud, Vec<String>), SplatFileError> {
    let (header, body) = container::unpack(bytes)?;
    let mut notes = Vec::new();
    if header.degree > crate::MAX_DEGREE {
        notes.push(format!("colour of degree {}: read to degree {}", header.degree, crate::MAX_DEGREE));
    }
    if header.flags & FLAG_EXTENSIONS != 0 {
        notes.push("extension records not read".into());
    }
    if header.flags & !(FLAG_EXTENSIONS | FLAG_ANTIALIASED) != 0 {
        notes.push(format!("unknown flags {:#04x} passed over", header.flags & !(FLAG_EXTENSIONS | FLAG_ANTIALIASED)));
    }
    let mut cloud = attributes::decode(&header, &body)?;
    cloud.antialiased = header.flags & FLAG_ANTIALIASED != 0;
    Ok((cloud, notes))
}

/// Writes `version` 3 or 4.
pub(crate) fn to_bytes(cloud: &SplatCloud, version: u32) -> Result<Vec<u8>, SplatFileError> {
    if !(3..=4).contains(&version) {
        return Err(malformed(FORMAT, "version to write", "3 or 4", version.to_string(), "choose one of the two"));
    }
    let header = Header {
        version,
        count: cloud.len(),
        degree: cloud.degree,
        fractional_bits: attributes::fractional_bits(cloud)?,
        flags: if cloud.antialiased { FLAG_ANTIALIASED } else { 0 },
    };
    let streams = attributes::encode(&header, cloud);
    container::pack(&header, &streams)
}
