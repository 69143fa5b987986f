//! What a shot shows: linear radiance, coverage, and the picture that metrics compare with.
//!
//! Stored samples are kept in the cache; an observation is computed from them on each request through a table with one
//! entry per stored value. At 128² that takes a tenth of a millisecond and an image costs 64 KiB of cache instead of
//! 300.
use crate::stored::{Samples, StoredImage};
use crate::{AlphaPremultiplied, Capture, DatasetError, MaskSource, Shot};
use diamond_image::{Image, Mask, Transfer};
use std::sync::{Arc, OnceLock};

/// One image, decoded.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    /// Linear RGB radiance over black, that is multiplied by coverage; width × height × 3.
    pub radiance: Image,
    /// Coverage; `None` where nothing says which pixels show the object (see [`MaskSource`]).
    pub mask: Option<Mask>,
    /// Display sRGB over black, 8 bits, row-major RGB, width · height · 3 bytes: what metrics compare with. Where the
    /// file is 8-bit sRGB over black these are the bytes of the file.
    pub display: Vec<u8>,
}

/// How an image is kept in memory: as it is in its file, until it is looked at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StoredForm {
    /// Type of a sample: `8-bit` or `16-bit`, encoded, or `f32`, linear.
    pub sample: &'static str,
    /// 1 grey, 2 grey and alpha, 3 RGB, 4 RGBA.
    pub channels: usize,
    /// Bytes of all samples.
    pub bytes: u64,
}

impl Capture {
    /// The number of images of the capture as opened, whatever is selected.
    pub fn image_files(&self) -> usize {
        self.shared.images.len()
    }

    /// Loads a shot of this capture. Thread-safe and deterministic: what was loaded before changes nothing but time.
    ///
    /// Errors: the file is gone, cut short, no image that can be read, larger than [`crate::OpenOptions::max_pixels`], or its size is not
    /// the frame's.
    pub fn observation(&self, shot: &Shot) -> Result<Arc<Observation>, DatasetError> {
        let stored = self.stored(shot)?;
        observe(&stored, self.options.transfer, self.is_premultiplied(&stored))
            .map(Arc::new)
            .map_err(|e| self.unusable(shot, e.to_string()))
    }

    /// Whether the RGB of an image is already multiplied by its alpha.
    pub(crate) fn is_premultiplied(&self, image: &StoredImage) -> bool {
        match self.options.alpha_premultiplied {
            _ if image.alpha_channel().is_none() => true,
            AlphaPremultiplied::Auto => image.premultiplied.unwrap_or_else(|| self.alpha_premultiplied()),
            AlphaPremultiplied::Yes => true,
            AlphaPremultiplied::No => false,
        }
    }

    /// Whether RGB is read as already multiplied by alpha: the option, or what the images say.
    ///
    /// `Auto` looks at up to eight training images, spread evenly. Its witnesses are pixels of at most half coverage
    /// that are not black. Premultiplied RGB, decoded, is radiance × alpha, so it exceeds 2 · peak · alpha, peak being
    /// the brightest fully covered pixel of the image, only where a rim is twice as bright as anything inside; straight
    /// RGB does not fall with alpha and exceeds it often. RGB counts as straight where more than 5 % of the witnesses
    /// exceed. The comparison is made on decoded values: a renderer multiplies in linear light before it encodes, so
    /// the stored value of a correct premultiplied pixel may well exceed its alpha (it does in 7 % of the partly
    /// covered pixels of the example capture), and comparing stored values would call it straight. Images without
    /// alpha, or that cannot be read, have no say. Without a witness RGB counts as premultiplied.
    pub fn alpha_premultiplied(&self) -> bool {
        match self.options.alpha_premultiplied {
            AlphaPremultiplied::Yes => true,
            AlphaPremultiplied::No => false,
            AlphaPremultiplied::Auto => *self.shared.premultiplied.get_or_init(|| {
                let mut tally = Tally::default();
                for shot in &self.shared.witnesses {
                    // A mask from a file says nothing about the alpha, and undistortion needs the answer first.
                    if matches!(shot.mask, MaskSource::File(_)) {
                        continue;
                    }
                    let stored = match shot.undistortion {
                        None => self.stored(shot),
                        Some(_) => self.read_shot(shot).map(Arc::new),
                    };
                    if let Ok(stored) = stored
                        && stored.premultiplied.is_none()
                    {
                        tally.add(&stored, self.options.transfer);
                    }
                }
                tally.says_premultiplied()
            }),
        }
    }

    /// Bytes of stored samples that the cache holds now; at most [`crate::OpenOptions::cache_bytes`].
    pub fn cached_bytes(&self) -> usize {
        self.shared.cache.bytes()
    }

    /// Keeps at most so many bytes of stored samples from now on, for all selections of this capture, in place of
    /// [`crate::OpenOptions::cache_bytes`]. Only time depends on it.
    pub fn limit_cache(&self, bytes: usize) {
        self.shared.cache.set_limit(bytes);
    }

    /// How the samples of an image are kept in the cache: decodes it, unless it is there.
    pub fn stored_form(&self, shot: &Shot) -> Result<StoredForm, DatasetError> {
        let stored = self.stored(shot)?;
        let sample = match stored.samples {
            Samples::Eight(_) => "8-bit",
            Samples::Sixteen(_) => "16-bit",
            Samples::Linear(_) => "f32",
        };
        Ok(StoredForm { sample, channels: stored.channels, bytes: stored.bytes() as u64 })
    }

    pub(crate) fn stored(&self, shot: &Shot) -> Result<Arc<StoredImage>, DatasetError> {
        // One file may be seen through two lenses, once in each split.
        let key = match &shot.undistortion {
            None => shot.path.clone(),
            Some(lens) => shot.path.join(format!("{lens:?}")),
        };
        self.shared.cache.get(&key, || self.develop(shot))
    }
}

/// Votes on whether RGB is premultiplied.
#[derive(Debug, Default)]
struct Tally {
    witnesses: usize,
    exceeding: usize,
}

/// Rounding of RGB and of alpha to 8 bits.
const ROUNDING: f32 = 1.5 / 255.0;

impl Tally {
    fn add(&mut self, stored: &StoredImage, transfer: Transfer) {
        // Linear images say themselves what they are.
        if stored.alpha_channel().is_none() || matches!(stored.samples, Samples::Linear(_)) {
            return;
        }
        let pixels = 0..stored.width as usize * stored.height as usize;
        let brightest = |pixel: usize| {
            let [r, g, b, alpha] = stored.rgba(pixel);
            (r.max(g).max(b), alpha)
        };
        let covered = pixels.clone().map(brightest).filter(|&(_, alpha)| alpha > 0.99).map(|(v, _)| v);
        let peak = transfer.decode(covered.reduce(f32::max).unwrap_or(1.0));
        for (v, alpha) in pixels.map(brightest) {
            if alpha <= 0.5 && v > ROUNDING {
                self.witnesses += 1;
                self.exceeding += usize::from(transfer.decode(v - ROUNDING) > 2.0 * peak * (alpha + ROUNDING));
            }
        }
    }

    fn says_premultiplied(&self) -> bool {
        self.exceeding * 20 <= self.witnesses
    }
}

/// Stored value → linear radiance, for every value that 8 or 16 bits can hold.
fn decode_table(transfer: Transfer, sixteen: bool) -> &'static [f32] {
    static TABLES: [OnceLock<Vec<f32>>; 6] = [const { OnceLock::new() }; 6];
    let (row, last) = if sixteen { (3, 65535u16) } else { (0, 255) };
    let slot = row
        + match transfer {
            Transfer::Linear => 0,
            Transfer::Srgb => 1,
            Transfer::Gamma22 => 2,
        };
    TABLES[slot].get_or_init(|| (0..=last).map(|v| transfer.decode(f32::from(v) / f32::from(last))).collect())
}

/// Linear radiance → 8-bit display sRGB: clamped, rounded to nearest.
fn display_byte(linear: f32) -> u8 {
    (Transfer::Srgb.encode(linear.clamp(0.0, 1.0)) * 255.0).round() as u8
}

/// Linear RGB radiance → 8-bit display sRGB, values clamped to `[0, 1]` and rounded to nearest; NaN becomes 0. What
/// [`Observation::display`] holds, for any image.
pub fn to_display(image: &Image) -> Vec<u8> {
    image.data().iter().map(|&v| display_byte(v)).collect()
}

/// Decodes stored samples. `premultiplied` says whether RGB is already multiplied by alpha.
pub(crate) fn observe(
    stored: &StoredImage,
    transfer: Transfer,
    premultiplied: bool,
) -> Result<Observation, diamond_image::ImageError> {
    match &stored.samples {
        Samples::Eight(v) => {
            expand(stored, v, usize::from, 255.0, decode_table(transfer, false), transfer, premultiplied)
        }
        Samples::Sixteen(v) => {
            expand(stored, v, usize::from, 65535.0, decode_table(transfer, true), transfer, premultiplied)
        }
        Samples::Linear(v) => expand_linear(stored, v, premultiplied),
    }
}

/// As [`expand`], of samples that are linear already.
fn expand_linear(
    stored: &StoredImage,
    samples: &[f32],
    premultiplied: bool,
) -> Result<Observation, diamond_image::ImageError> {
    let (width, height) = (stored.width as usize, stored.height as usize);
    let colours = if stored.channels < 3 { [0, 0, 0] } else { [0, 1, 2] };
    let alpha = stored.alpha_channel();
    let mut radiance = Vec::with_capacity(width * height * 3);
    let mut coverage = Vec::with_capacity(if alpha.is_some() { width * height } else { 0 });
    for pixel in samples.chunks_exact(stored.channels) {
        let a = alpha.map(|a| pixel[a]);
        coverage.extend(a);
        let factor = if premultiplied { 1.0 } else { a.unwrap_or(1.0) };
        radiance.extend(colours.map(|c| pixel[c] * factor));
    }
    let radiance = Image::from_vec(width, height, 3, radiance)?;
    let display = to_display(&radiance);
    let mask = alpha.map(|_| Mask::from_vec(width, height, coverage)).transpose()?;
    Ok(Observation { radiance, mask, display })
}

fn expand<T: Copy>(
    stored: &StoredImage,
    samples: &[T],
    index: impl Fn(T) -> usize,
    white: f32,
    decode: &[f32],
    transfer: Transfer,
    premultiplied: bool,
) -> Result<Observation, diamond_image::ImageError> {
    let (width, height) = (stored.width as usize, stored.height as usize);
    let colours = if stored.channels < 3 { [0, 0, 0] } else { [0, 1, 2] };
    let alpha = stored.alpha_channel();
    // The bytes of an 8-bit sRGB image over black are the display picture itself.
    let as_stored = transfer == Transfer::Srgb && premultiplied && white == 255.0;
    let mut radiance = Vec::with_capacity(width * height * 3);
    let mut display = Vec::with_capacity(width * height * 3);
    let mut coverage = Vec::with_capacity(if alpha.is_some() { width * height } else { 0 });
    for pixel in samples.chunks_exact(stored.channels) {
        let mut factor = 1.0;
        if let Some(a) = alpha {
            let a = index(pixel[a]) as f32 / white;
            coverage.push(a);
            if !premultiplied {
                factor = a;
            }
        }
        for c in colours {
            let v = index(pixel[c]);
            let linear = decode[v] * factor;
            radiance.push(linear);
            display.push(if as_stored { v as u8 } else { display_byte(linear) });
        }
    }
    Ok(Observation {
        radiance: Image::from_vec(width, height, 3, radiance)?,
        mask: alpha.map(|_| Mask::from_vec(width, height, coverage)).transpose()?,
        display,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_stored_byte_comes_back_as_the_display_byte() {
        for v in 0..=255u8 {
            assert_eq!(display_byte(decode_table(Transfer::Srgb, false)[usize::from(v)]), v);
        }
    }

    #[test]
    fn straight_and_premultiplied_differ_by_the_coverage() {
        let stored = StoredImage::from_bytes(2, 1, 4, vec![200, 100, 50, 128, 200, 100, 50, 255]);
        let over_black = observe(&stored, Transfer::Srgb, true).unwrap();
        let straight = observe(&stored, Transfer::Srgb, false).unwrap();
        let a = 128.0 / 255.0;
        for c in 0..3 {
            let (p, s) = (over_black.radiance.pixel(0, 0)[c], straight.radiance.pixel(0, 0)[c]);
            assert!((p * a - s).abs() < 1e-6);
            assert_eq!(over_black.radiance.pixel(1, 0)[c], straight.radiance.pixel(1, 0)[c]);
        }
        assert_eq!(over_black.display, [200, 100, 50, 200, 100, 50]);
        assert_eq!(straight.display[3..], [200, 100, 50]);
        assert_eq!(straight.mask.unwrap().coverage(0, 0), a);
    }

    #[test]
    fn grey_is_repeated_and_no_alpha_is_no_mask() {
        let stored = StoredImage::from_bytes(1, 1, 1, vec![64]);
        let o = observe(&stored, Transfer::Linear, true).unwrap();
        assert_eq!(o.radiance.pixel(0, 0), [64.0 / 255.0; 3]);
        assert!(o.mask.is_none());
        let samples = Samples::Sixteen(vec![65535, 32768]);
        let sixteen = StoredImage { width: 1, height: 1, channels: 2, samples, premultiplied: None };
        let o = observe(&sixteen, Transfer::Gamma22, true).unwrap();
        assert_eq!(o.radiance.pixel(0, 0), [1.0; 3]);
        assert!((o.mask.unwrap().coverage(0, 0) - 0.5).abs() < 1e-4);
        assert_eq!(o.display, [255; 3]);
    }

    /// A disc with a soft rim, of radiance `level`, multiplied in linear light or not at all.
    fn disc(level: f32, premultiplied: bool) -> StoredImage {
        let n = 64;
        let mut samples = Vec::new();
        for i in 0..n * n {
            let (x, y) = ((i % n) as f32 - 31.5, (i / n) as f32 - 31.5);
            let alpha = ((24.0 - (x * x + y * y).sqrt()) / 2.0 + 0.5).clamp(0.0, 1.0);
            let linear = if premultiplied { level * alpha } else { level };
            let v = display_byte(if alpha > 0.0 { linear } else { 0.0 });
            samples.extend([v, v, v, (alpha * 255.0).round() as u8]);
        }
        StoredImage::from_bytes(n, n, 4, samples)
    }

    #[test]
    fn the_rim_tells_straight_from_premultiplied() {
        for level in [0.02, 0.05, 0.2, 0.5, 0.9] {
            for premultiplied in [true, false] {
                let mut tally = Tally::default();
                tally.add(&disc(level, premultiplied), Transfer::Srgb);
                assert!(tally.witnesses > 50);
                assert_eq!(tally.says_premultiplied(), premultiplied, "level {level}: {tally:?}");
            }
        }
        assert!(Tally::default().says_premultiplied(), "nothing to go by");
    }
}
