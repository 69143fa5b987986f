//! Image files: PNG (8 and 16 bit), JPEG, and EXR (`half`, `float`), told apart by their first bytes.
//!
//! Headers are checked against the limit, and against what a file of that length can hold, before anything is allocated.
use crate::stored::{Samples, StoredImage};
use crate::{DatasetError, Place};
use diamond_image::Transfer;
use exr::prelude::{FlatSamples, MetaData, ReadChannels, ReadLayers};
use image::{DynamicImage, ImageDecoder, Limits, codecs::jpeg::JpegDecoder, codecs::png::PngDecoder};
use std::io::Cursor;
use std::path::Path;

/// Deflate cannot expand data by more than 1032 : 1, and no JPEG or EXR codec by more than that either, so a header that
/// promises more than the file can hold is refused before anything is allocated. Rounded up, since the rows are
/// filtered first.
const MAX_RATIO: u64 = 1100;

/// Bytes that a decoder may allocate per pixel (16-bit RGBA, twice) and besides.
const DECODER_BYTES_PER_PIXEL: u64 = 16;
const DECODER_BYTES_BESIDES: u64 = 16 << 20;

/// EXR files with more channels than this are refused: renderers write a few dozen.
const MAX_EXR_CHANNELS: usize = 256;

/// What to do about an image that cannot be decoded.
const ADVICE: &str = "export it again as an 8- or 16-bit PNG, a JPEG or an EXR, or list its name in exclude_list.txt";

/// How image files are to be read.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct DecodeOptions {
    /// More pixels than this are refused.
    pub(crate) max_pixels: u64,
    /// Of the samples of EXR files.
    pub(crate) exr_transfer: Transfer,
}

/// What an image file is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Png,
    Jpeg,
    Exr,
}

impl Kind {
    fn of(bytes: &[u8]) -> Result<Kind, String> {
        match bytes {
            [0x89, b'P', b'N', b'G', ..] => Ok(Kind::Png),
            [0xff, 0xd8, 0xff, ..] => Ok(Kind::Jpeg),
            [0x76, 0x2f, 0x31, 0x01, ..] => Ok(Kind::Exr),
            _ => {
                let start: Vec<String> = bytes.iter().take(8).map(|b| format!("{b:02x}")).collect();
                Err(format!(
                    "neither PNG, JPEG nor EXR: no header of theirs (the file begins with [{}])",
                    start.join(" ")
                ))
            }
        }
    }

    fn name(self) -> &'static str {
        match self {
            Kind::Png => "PNG",
            Kind::Jpeg => "JPEG",
            Kind::Exr => "EXR",
        }
    }
}

/// Why bytes are no usable image.
#[derive(Debug)]
pub(crate) enum Refusal {
    /// They cannot be decoded.
    Broken(String),
    /// The header promises too many pixels.
    TooLarge(u32, u32),
}

impl Refusal {
    /// The error about the file at `path`.
    pub(crate) fn at(self, path: &Path, named_by: &Place, max_pixels: u64) -> DatasetError {
        let (path, named_by) = (path.to_path_buf(), named_by.clone().into());
        match self {
            Refusal::Broken(reason) => DatasetError::Image { path, named_by, reason, advice: ADVICE },
            Refusal::TooLarge(width, height) => DatasetError::TooLarge { path, named_by, width, height, max_pixels },
        }
    }
}

/// Parses an image file in memory and throws the samples away: width, height and channels, or what is wrong with it.
/// `path` is only named in errors.
pub fn decode_image(path: &Path, bytes: &[u8], max_pixels: u64) -> Result<(u32, u32, usize), DatasetError> {
    let options = DecodeOptions { max_pixels, exr_transfer: Transfer::Linear };
    let image = decode(bytes, &options).map_err(|e| e.at(path, &Place::file(path), max_pixels))?;
    Ok((image.width, image.height, image.channels))
}

/// Bytes that are read to find an image's size; where that does not do, the whole file is.
const HEADER_BYTES: u64 = 64 << 10;

/// Width and height from the header of an image file.
pub(crate) fn read_size(path: &Path, named_by: &Place) -> Result<(u32, u32), DatasetError> {
    use std::io::Read;
    let io = |source| DatasetError::Io { place: named_by.clone().into(), action: "open the image", source };
    let mut start = Vec::new();
    let mut file = std::fs::File::open(path).map_err(io)?;
    file.by_ref().take(HEADER_BYTES).read_to_end(&mut start).map_err(io)?;
    if let Ok(size) = size_of(&start) {
        return Ok(size);
    }
    file.take(MAX_FILE_BYTES).read_to_end(&mut start).map_err(io)?;
    size_of(&start).map_err(|reason| Refusal::Broken(reason).at(path, named_by, 0))
}

/// The largest image file that is read, bytes.
const MAX_FILE_BYTES: u64 = 4 << 30;

/// The bytes of an image file; `named_by` is who names it.
pub(crate) fn read_image_bytes(path: &Path, named_by: &Place, max_pixels: u64) -> Result<Vec<u8>, DatasetError> {
    use std::io::Read;
    let io = |source| {
        let field = match &named_by.field {
            Some(field) => format!("{field} = \"{}\"", path.display()),
            None => format!("\"{}\"", path.display()),
        };
        let place = Place { file: named_by.file.clone(), frame: named_by.frame, field: Some(field) };
        DatasetError::Io { place: place.into(), action: "open the image", source }
    };
    let mut bytes = Vec::new();
    // Not even uncompressed float RGBA with as much again beside it is longer than this.
    let limit = max_pixels.saturating_mul(32).saturating_add(64 << 20).min(MAX_FILE_BYTES);
    std::fs::File::open(path).map_err(io)?.take(limit).read_to_end(&mut bytes).map_err(io)?;
    Ok(bytes)
}

fn limits(bytes: u64) -> Limits {
    let mut limits = Limits::no_limits();
    limits.max_alloc = Some(bytes);
    limits
}

/// Width and height of an image, from its first bytes.
fn size_of(bytes: &[u8]) -> Result<(u32, u32), String> {
    let kind = Kind::of(bytes)?;
    let bad = |e: &dyn std::fmt::Display| format!("cannot read the {} header ({e})", kind.name());
    match kind {
        Kind::Png => PngDecoder::with_limits(Cursor::new(bytes), limits(DECODER_BYTES_BESIDES))
            .map(|d| d.dimensions())
            .map_err(|e| bad(&e)),
        Kind::Jpeg => JpegDecoder::new(Cursor::new(bytes)).map(|d| d.dimensions()).map_err(|e| bad(&e)),
        Kind::Exr => {
            let meta = MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(|e| bad(&e))?;
            let size = meta.headers.first().map(|h| h.shared_attributes.display_window.size);
            let side = |v: usize| u32::try_from(v).map_err(|e| bad(&e));
            size.map_or(Err(bad(&"no layer")), |s| Ok((side(s.0)?, side(s.1)?)))
        }
    }
}

/// Decodes an image file in memory.
pub(crate) fn decode(bytes: &[u8], options: &DecodeOptions) -> Result<StoredImage, Refusal> {
    let kind = Kind::of(bytes).map_err(Refusal::Broken)?;
    let (width, height) = size_of(bytes).map_err(Refusal::Broken)?;
    let pixels = u64::from(width) * u64::from(height);
    if pixels > options.max_pixels {
        return Err(Refusal::TooLarge(width, height));
    }
    if pixels / 8 > (bytes.len() as u64).saturating_mul(MAX_RATIO) {
        let n = bytes.len();
        return Err(Refusal::Broken(format!(
            "the header promises {width}×{height} pixels, more than a file of {n} bytes can hold"
        )));
    }
    if kind == Kind::Exr {
        return decode_exr(bytes, (width, height), options).map_err(Refusal::Broken);
    }
    let bad =
        |e: image::ImageError| Refusal::Broken(format!("cannot decode the {} ({e}); is it cut short?", kind.name()));
    let allowed = || limits(pixels * DECODER_BYTES_PER_PIXEL + DECODER_BYTES_BESIDES);
    let image = if kind == Kind::Png {
        let mut decoder = PngDecoder::with_limits(Cursor::new(bytes), limits(DECODER_BYTES_BESIDES)).map_err(bad)?;
        decoder.set_limits(allowed()).map_err(bad)?;
        DynamicImage::from_decoder(decoder)
    } else {
        let mut decoder = JpegDecoder::new(Cursor::new(bytes)).map_err(bad)?;
        decoder.set_limits(allowed()).map_err(bad)?;
        DynamicImage::from_decoder(decoder)
    }
    .map_err(bad)?;
    let (channels, samples) = match image {
        DynamicImage::ImageLuma8(v) => (1, Samples::Eight(v.into_raw())),
        DynamicImage::ImageLumaA8(v) => (2, Samples::Eight(v.into_raw())),
        DynamicImage::ImageRgb8(v) => (3, Samples::Eight(v.into_raw())),
        DynamicImage::ImageRgba8(v) => (4, Samples::Eight(v.into_raw())),
        DynamicImage::ImageLuma16(v) => (1, Samples::Sixteen(v.into_raw())),
        DynamicImage::ImageLumaA16(v) => (2, Samples::Sixteen(v.into_raw())),
        DynamicImage::ImageRgb16(v) => (3, Samples::Sixteen(v.into_raw())),
        DynamicImage::ImageRgba16(v) => (4, Samples::Sixteen(v.into_raw())),
        other => return Err(Refusal::Broken(format!("unexpected pixel format {:?}", other.color()))),
    };
    Ok(StoredImage { width, height, channels, samples, premultiplied: None })
}

/// The first layer of an EXR that has `R G B` (or `Y`, or those behind a layer's name and a dot), in its display window;
/// what the data window leaves open is 0. `A` is the alpha, by which an EXR's colour is multiplied already. Negative
/// values, as filters and denoisers leave them, become 0.
fn decode_exr(bytes: &[u8], (width, height): (u32, u32), options: &DecodeOptions) -> Result<StoredImage, String> {
    let broken = |e: exr::error::Error| format!("cannot decode the EXR ({e}); is it cut short?");
    let meta = MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(broken)?;
    for header in &meta.headers {
        let (size, channels) = (header.layer_size, header.channels.list.len());
        let samples = (size.0 as u64).saturating_mul(size.1 as u64).saturating_mul(channels as u64);
        let allowed = options.max_pixels.saturating_mul(4 + channels as u64 / 4);
        if channels > MAX_EXR_CHANNELS
            || samples > allowed
            || samples / 8 > (bytes.len() as u64).saturating_mul(MAX_RATIO)
        {
            return Err(format!(
                "a layer of {}×{} pixels with {channels} channels is more than the limits or the file allow",
                size.0, size.1
            ));
        }
    }
    let image = exr::prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .all_layers()
        .all_attributes()
        .from_buffered(Cursor::new(bytes))
        .map_err(broken)?;
    let window = image.attributes.display_window.position;
    let mut seen = Vec::new();
    for layer in &image.layer_data {
        let list = &layer.channel_data.list;
        let find = |prefix: &str, name: &str| list.iter().find(|c| c.name.to_string() == format!("{prefix}{name}"));
        let names: Vec<String> = list.iter().map(|c| c.name.to_string()).collect();
        // No prefix first, then those of "prefix.R" and "prefix.Y" in the order of the file.
        let behind = names.iter().filter_map(|n| n.strip_suffix("R").or_else(|| n.strip_suffix("Y")));
        let mut prefixes = std::iter::once("").chain(behind.filter(|p| p.ends_with('.')));
        let Some((prefix, colours)) =
            prefixes.find_map(|p| match (find(p, "R"), find(p, "G"), find(p, "B"), find(p, "Y")) {
                (Some(r), Some(g), Some(b), _) => Some((p, vec![r, g, b])),
                (None, None, None, Some(y)) => Some((p, vec![y])),
                _ => None,
            })
        else {
            seen.extend(names);
            continue;
        };
        let mut planes = colours;
        planes.extend(find(prefix, "A"));
        let position = layer.attributes.layer_position;
        let offset = (position.0 - window.0, position.1 - window.1);
        let samples = place(&planes, (layer.size.0, layer.size.1), offset, (width, height), options.exr_transfer)?;
        return Ok(StoredImage { width, height, channels: planes.len(), samples, premultiplied: Some(true) });
    }
    Err(format!("no channels R, G and B (or Y) in the EXR; it has {}", seen.join(", ")))
}

/// Interleaves planes of a data window of `size` at `offset` in an image of `width` × `height`.
fn place(
    planes: &[&exr::prelude::AnyChannel<FlatSamples>],
    size: (usize, usize),
    offset: (i32, i32),
    (width, height): (u32, u32),
    transfer: Transfer,
) -> Result<Samples, String> {
    let (w, h, channels) = (width as usize, height as usize, planes.len());
    let mut out = vec![0.0f32; w * h * channels];
    for (c, plane) in planes.iter().enumerate() {
        let alpha = channels.is_multiple_of(2) && c + 1 == channels;
        if plane.sampling.0 != 1 || plane.sampling.1 != 1 || plane.sample_data.len() != size.0 * size.1 {
            return Err(format!("channel {} is subsampled, which is not supported", plane.name));
        }
        for row in 0..size.1 {
            let y = row as i64 + i64::from(offset.1);
            if y < 0 || y >= h as i64 {
                continue;
            }
            for column in 0..size.0 {
                let x = column as i64 + i64::from(offset.0);
                if x < 0 || x >= w as i64 {
                    continue;
                }
                let v = plane.sample_data.value_by_flat_index(row * size.0 + column).to_f32();
                if !v.is_finite() {
                    return Err(format!("channel {} is {v} at pixel ({x}, {y})", plane.name));
                }
                let v = if alpha { v.clamp(0.0, 1.0) } else { transfer.decode(v.max(0.0)) };
                // A half-float's range and more: brighter than this is a mistake, and its square must stay finite.
                out[(y as usize * w + x as usize) * channels + c] = v.min(MAX_RADIANCE);
            }
        }
    }
    Ok(Samples::Linear(out))
}

/// The largest radiance that is kept; squares of it are finite in `f32`.
const MAX_RADIANCE: f32 = 1e15;
