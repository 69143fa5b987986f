//! Images as they are stored: 8- or 16-bit samples of a PNG, not yet decoded to radiance.
use crate::{DatasetError, Place, Shot};
use image::{DynamicImage, ImageDecoder, Limits, codecs::png::PngDecoder};
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

/// Deflate cannot expand data by more than 1032 : 1, so a header that promises more than the file can hold is refused
/// before anything is allocated. Rounded up, since the rows are filtered first.
const MAX_DEFLATE_RATIO: u64 = 1100;

/// Bytes that a decoder may allocate per pixel (16-bit RGBA, twice) and besides.
const DECODER_BYTES_PER_PIXEL: u64 = 16;
const DECODER_BYTES_BESIDES: u64 = 16 << 20;

/// What to do about an image that cannot be decoded.
const ADVICE: &str = "export it again as an 8- or 16-bit PNG, or list its name in exclude_list.txt";

/// Samples of a stored image, row-major and interleaved.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Samples {
    /// 8 bits per sample.
    Eight(Vec<u8>),
    /// 16 bits per sample.
    Sixteen(Vec<u16>),
}

/// A stored image: grey, grey and alpha, RGB, or RGBA.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct StoredImage {
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// 1 grey, 2 grey and alpha, 3 RGB, 4 RGBA.
    pub(crate) channels: usize,
    pub(crate) samples: Samples,
}

impl StoredImage {
    /// An 8-bit image from its samples.
    #[cfg(test)]
    pub(crate) fn from_bytes(width: u32, height: u32, channels: usize, samples: Vec<u8>) -> Self {
        Self { width, height, channels, samples: Samples::Eight(samples) }
    }

    /// Bytes of samples.
    pub(crate) fn bytes(&self) -> usize {
        match &self.samples {
            Samples::Eight(v) => v.len(),
            Samples::Sixteen(v) => 2 * v.len(),
        }
    }

    /// The channel of the alpha, if there is one.
    pub(crate) fn alpha_channel(&self) -> Option<usize> {
        self.channels.is_multiple_of(2).then_some(self.channels - 1)
    }

    /// The stored values of a pixel in `[0, 1]`: `[r, g, b, alpha]`; grey is repeated, a missing alpha is 1.
    pub(crate) fn rgba(&self, pixel: usize) -> [f32; 4] {
        let at = |c: usize| match &self.samples {
            Samples::Eight(v) => f32::from(v[pixel * self.channels + c]) / 255.0,
            Samples::Sixteen(v) => f32::from(v[pixel * self.channels + c]) / 65535.0,
        };
        let [r, g, b] = if self.channels < 3 { [at(0); 3] } else { [at(0), at(1), at(2)] };
        [r, g, b, self.alpha_channel().map_or(1.0, at)]
    }
}

/// Reads the stored image of a shot. The header is checked against the frame's size and the limit first.
pub(crate) fn read_stored(shot: &Shot, max_pixels: u64) -> Result<StoredImage, DatasetError> {
    let bad = |reason: String, advice: &'static str| DatasetError::Image {
        path: shot.path.clone(),
        named_by: shot.named_by.clone().into(),
        reason,
        advice,
    };
    let (mut decoder, file_bytes) = open(&shot.path, &shot.named_by)?;
    let (width, height) = decoder.dimensions();
    let pixels = u64::from(width) * u64::from(height);
    if pixels > max_pixels {
        return Err(too_large(&shot.path, &shot.named_by, (width, height), max_pixels));
    }
    if (width, height) != (shot.width, shot.height) {
        return Err(bad(
            format!("the image is {width}×{height} pixels, its frame says {}×{}", shot.width, shot.height),
            "correct width and height in the frame, or scale the image; all images of a frame have one size",
        ));
    }
    if pixels / 8 > file_bytes.saturating_mul(MAX_DEFLATE_RATIO) {
        return Err(bad(
            format!("the header promises {width}×{height} pixels, more than a file of {file_bytes} bytes can hold"),
            ADVICE,
        ));
    }
    let mut limits = Limits::no_limits();
    limits.max_alloc = Some(pixels * DECODER_BYTES_PER_PIXEL + DECODER_BYTES_BESIDES);
    decoder.set_limits(limits).map_err(|e| bad(e.to_string(), ADVICE))?;
    let image = DynamicImage::from_decoder(decoder)
        .map_err(|e| bad(format!("cannot decode the PNG ({e}); is it cut short?"), ADVICE))?;
    let (channels, samples) = match image {
        DynamicImage::ImageLuma8(v) => (1, Samples::Eight(v.into_raw())),
        DynamicImage::ImageLumaA8(v) => (2, Samples::Eight(v.into_raw())),
        DynamicImage::ImageRgb8(v) => (3, Samples::Eight(v.into_raw())),
        DynamicImage::ImageRgba8(v) => (4, Samples::Eight(v.into_raw())),
        DynamicImage::ImageLuma16(v) => (1, Samples::Sixteen(v.into_raw())),
        DynamicImage::ImageLumaA16(v) => (2, Samples::Sixteen(v.into_raw())),
        DynamicImage::ImageRgb16(v) => (3, Samples::Sixteen(v.into_raw())),
        DynamicImage::ImageRgba16(v) => (4, Samples::Sixteen(v.into_raw())),
        other => return Err(bad(format!("unexpected pixel format {:?}", other.color()), ADVICE)),
    };
    Ok(StoredImage { width, height, channels, samples })
}

/// Width and height from the header of an image.
pub(crate) fn read_size(path: &Path, named_by: &Place) -> Result<(u32, u32), DatasetError> {
    let (decoder, _) = open(path, named_by)?;
    Ok(decoder.dimensions())
}

/// A decoder that has read the header, and the length of the file in bytes.
fn open(path: &Path, named_by: &Place) -> Result<(PngDecoder<BufReader<File>>, u64), DatasetError> {
    let io = |source| DatasetError::Io { place: named_by.clone().into(), action: "open the image", source };
    let file = File::open(path).map_err(io)?;
    let file_bytes = file.metadata().map_err(io)?.len();
    let mut limits = Limits::no_limits();
    limits.max_alloc = Some(DECODER_BYTES_BESIDES);
    let decoder = PngDecoder::with_limits(BufReader::new(file), limits).map_err(|e| DatasetError::Image {
        path: path.to_path_buf(),
        named_by: named_by.clone().into(),
        reason: format!("cannot read the PNG header ({e})"),
        advice: ADVICE,
    })?;
    Ok((decoder, file_bytes))
}

fn too_large(path: &Path, named_by: &Place, (width, height): (u32, u32), max_pixels: u64) -> DatasetError {
    DatasetError::TooLarge { path: path.to_path_buf(), named_by: named_by.clone().into(), width, height, max_pixels }
}
