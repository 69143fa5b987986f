//! The two containers of SPZ: one gzip stream, or a table of contents and zstd frames.
//!
//! Sizes are known from the header before anything is unfolded. A body that a file of that size should not hold is refused
//! ([`crate::limits`]), and so is a stream that unfolds to more or less than its size.
use super::{FORMAT, Header, MAGIC};
use crate::SplatFileError;
use crate::error::{EXPORT_AGAIN, TRUNCATED, malformed};
use crate::limits::largest_body;
use std::io::{Read, Write};

/// Bytes of the header within a gzip stream.
const GZIP_HEADER: usize = 16;
/// Bytes of the header before a table of contents.
const TABLE_HEADER: usize = 32;
/// Bytes of an entry in the table: compressed and unfolded size.
const TABLE_ENTRY: usize = 16;
/// A zstd frame may ask for at most this much memory to look back into; encoders at usual levels ask for 8 MiB or less.
const MAX_WINDOW: u64 = 16 << 20;

/// Header and unfolded attributes.
pub(super) fn unpack(bytes: &[u8]) -> Result<(Header, Vec<u8>), SplatFileError> {
    if bytes.starts_with(&[0x1f, 0x8b]) { unpack_gzip(bytes) } else { unpack_table(bytes) }
}

/// Bytes of all attributes, if a file of `file` bytes may hold so many.
fn body_size(header: &Header, file: usize) -> Result<usize, SplatFileError> {
    let size = header.widths().iter().sum::<usize>().saturating_mul(header.count);
    if size > largest_body(file) {
        let expected = format!("at most {} bytes in a file of {file}", largest_body(file));
        let found = format!("{} splats of {size} bytes", header.count);
        return Err(malformed(FORMAT, "count", expected, found, "the file is damaged, or made to exhaust memory"));
    }
    Ok(size)
}

fn unpack_gzip(bytes: &[u8]) -> Result<(Header, Vec<u8>), SplatFileError> {
    let broken = |e: std::io::Error| malformed(FORMAT, "gzip stream", "a whole stream", e.to_string(), TRUNCATED);
    let mut stream = flate2::read::GzDecoder::new(bytes);
    let mut head = [0; GZIP_HEADER];
    stream.read_exact(&mut head).map_err(broken)?;
    let header = Header::parse(&head)?;
    if header.version > 3 {
        let found = format!("version {}", header.version);
        return Err(malformed(FORMAT, "gzip stream", "version 1 to 3", found, EXPORT_AGAIN));
    }
    let size = body_size(&header, bytes.len())?;
    let body = unfold(&mut stream, size, "attributes")?;
    Ok((header, body))
}

/// Reads exactly `size` bytes; the buffer grows with what is really there.
fn unfold(stream: &mut dyn Read, size: usize, what: &str) -> Result<Vec<u8>, SplatFileError> {
    let mut out = Vec::new();
    let read = stream.take(size as u64).read_to_end(&mut out);
    match read {
        Ok(found) if found == size => Ok(out),
        Ok(found) => Err(malformed(FORMAT, what, format!("{size} bytes"), format!("{found}"), TRUNCATED)),
        Err(e) => Err(malformed(FORMAT, what, "a whole compressed stream", e.to_string(), TRUNCATED)),
    }
}

fn unpack_table(bytes: &[u8]) -> Result<(Header, Vec<u8>), SplatFileError> {
    let header = Header::parse(bytes)?;
    if header.version != 4 {
        let found = format!("version {} without compression", header.version);
        return Err(malformed(FORMAT, "header", "version 4, or a gzip stream", found, EXPORT_AGAIN));
    }
    let Some(head) = bytes.get(..TABLE_HEADER) else {
        return Err(malformed(FORMAT, "header", "32 bytes", format!("{} bytes", bytes.len()), TRUNCATED));
    };
    let size = body_size(&header, bytes.len())?;
    let widths = header.widths();
    let expected: Vec<usize> = widths.iter().filter(|w| **w > 0).map(|w| w * header.count).collect();
    let count = usize::from(head[15]);
    if count != expected.len() {
        let wanted = format!("{} for degree {}", expected.len(), header.degree);
        return Err(malformed(FORMAT, "number of streams", wanted, count.to_string(), EXPORT_AGAIN));
    }
    let start = u32::from_le_bytes([head[16], head[17], head[18], head[19]]) as usize;
    let end = start.saturating_add(count * TABLE_ENTRY);
    let Some(table) = bytes.get(start..end).filter(|_| start >= TABLE_HEADER) else {
        let found = format!("{start} to {end} of {} bytes", bytes.len());
        return Err(malformed(FORMAT, "table of contents", "a place behind the header", found, TRUNCATED));
    };
    let mut at = end;
    let mut body = Vec::new();
    for (i, (entry, size)) in table.chunks_exact(TABLE_ENTRY).zip(&expected).enumerate() {
        let word = |k: usize| {
            let mut raw = [0; 8];
            raw.copy_from_slice(&entry[k..k + 8]);
            u64::from_le_bytes(raw)
        };
        let field = format!("stream {i}");
        if word(8) != *size as u64 {
            return Err(malformed(FORMAT, field, format!("{size} bytes unfolded"), word(8).to_string(), EXPORT_AGAIN));
        }
        let stop = usize::try_from(word(0)).ok().and_then(|length| at.checked_add(length));
        let Some(frame) = stop.and_then(|stop| bytes.get(at..stop)) else {
            let expected = format!("{} bytes at {at}", word(0));
            return Err(malformed(FORMAT, field, expected, format!("{} in all", bytes.len()), TRUNCATED));
        };
        at += frame.len();
        body.extend(unfold_zstd(frame, *size, &field)?);
    }
    debug_assert_eq!(body.len(), size);
    Ok((header, body))
}

/// How far back a zstd frame refers, bytes; `None` for what is no frame.
fn window(frame: &[u8]) -> Option<u64> {
    let rest = frame.strip_prefix(&[0x28, 0xb5, 0x2f, 0xfd])?;
    let (&descriptor, rest) = rest.split_first()?;
    if descriptor & 0x20 == 0 {
        let code = u32::from(*rest.first()?);
        let base = 1u64 << (10 + (code >> 3));
        return Some(base + base / 8 * u64::from(code & 7));
    }
    // A single segment: the window is the content, whose size follows the dictionary's identifier.
    let skip = [0, 1, 2, 4][usize::from(descriptor & 3)];
    let size = [1, 2, 4, 8][usize::from(descriptor >> 6)];
    let mut raw = [0; 8];
    raw[..size].copy_from_slice(rest.get(skip..skip + size)?);
    Some(u64::from_le_bytes(raw) + if size == 2 { 256 } else { 0 })
}

fn unfold_zstd(frame: &[u8], size: usize, field: &str) -> Result<Vec<u8>, SplatFileError> {
    if size == 0 {
        return Ok(Vec::new());
    }
    let largest = MAX_WINDOW.max(size as u64);
    match window(frame) {
        Some(window) if window <= largest => {}
        Some(window) => {
            let expected = format!("a window of at most {largest} bytes");
            return Err(malformed(
                FORMAT,
                field,
                expected,
                window.to_string(),
                "export the file at a lower level of compression",
            ));
        }
        None => return Err(malformed(FORMAT, field, "a zstd frame", "other bytes", TRUNCATED)),
    }
    let mut stream = ruzstd::decoding::StreamingDecoder::new_with_max_window_size(frame, largest)
        .map_err(|e| malformed(FORMAT, field, "a zstd frame", e.to_string(), TRUNCATED))?;
    unfold(&mut stream, size, field)
}

/// The file.
pub(super) fn pack(header: &Header, streams: &[Vec<u8>; 6]) -> Result<Vec<u8>, SplatFileError> {
    let mut head = MAGIC.to_le_bytes().to_vec();
    head.extend(header.version.to_le_bytes());
    head.extend((header.count as u32).to_le_bytes());
    head.extend([header.degree as u8, header.fractional_bits as u8, header.flags, 0]);
    if header.version < 4 {
        let internal =
            |e: std::io::Error| malformed(FORMAT, "gzip stream", "memory to write to", e.to_string(), "free some");
        let mut stream = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
        for part in std::iter::once(&head).chain(streams) {
            stream.write_all(part).map_err(internal)?;
        }
        return stream.finish().map_err(internal);
    }
    let stored: Vec<&Vec<u8>> = streams.iter().zip(header.widths()).filter(|(_, w)| *w > 0).map(|(s, _)| s).collect();
    head[15] = stored.len() as u8;
    head.extend((TABLE_HEADER as u32).to_le_bytes());
    head.resize(TABLE_HEADER, 0);
    let level = ruzstd::encoding::CompressionLevel::Fastest;
    let frames: Vec<Vec<u8>> = stored.iter().map(|s| ruzstd::encoding::compress_to_vec(s.as_slice(), level)).collect();
    for (frame, stream) in frames.iter().zip(&stored) {
        head.extend((frame.len() as u64).to_le_bytes());
        head.extend((stream.len() as u64).to_le_bytes());
    }
    frames.iter().for_each(|frame| head.extend_from_slice(frame));
    Ok(head)
}
