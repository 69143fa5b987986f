//! Images as they are kept: 8- or 16-bit samples not yet decoded to radiance, or linear `f32`.

/// Samples of a stored image, row-major and interleaved.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Samples {
    /// 8 bits per sample, encoded as the capture's transfer says.
    Eight(Vec<u8>),
    /// 16 bits per sample, encoded as the capture's transfer says.
    Sixteen(Vec<u16>),
    /// Linear radiance, and coverage in `[0, 1]`.
    Linear(Vec<f32>),
}

/// A stored image: grey, grey and alpha, RGB, or RGBA.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct StoredImage {
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// 1 grey, 2 grey and alpha, 3 RGB, 4 RGBA.
    pub(crate) channels: usize,
    pub(crate) samples: Samples,
    /// Whether RGB is already multiplied by alpha; `None` where that is a question to the whole capture.
    pub(crate) premultiplied: Option<bool>,
}

impl StoredImage {
    /// An 8-bit image from its samples.
    #[cfg(test)]
    pub(crate) fn from_bytes(width: u32, height: u32, channels: usize, samples: Vec<u8>) -> Self {
        Self { width, height, channels, samples: Samples::Eight(samples), premultiplied: None }
    }

    /// Bytes of samples.
    pub(crate) fn bytes(&self) -> usize {
        match &self.samples {
            Samples::Eight(v) => v.len(),
            Samples::Sixteen(v) => 2 * v.len(),
            Samples::Linear(v) => 4 * v.len(),
        }
    }

    /// Number of pixels.
    pub(crate) fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// The channel of the alpha, if there is one.
    pub(crate) fn alpha_channel(&self) -> Option<usize> {
        self.channels.is_multiple_of(2).then_some(self.channels - 1)
    }

    /// The stored values of a pixel: `[r, g, b, alpha]`, in `[0, 1]` unless they are linear; grey is repeated, a missing
    /// alpha is 1.
    pub(crate) fn rgba(&self, pixel: usize) -> [f32; 4] {
        let at = |c: usize| match &self.samples {
            Samples::Eight(v) => f32::from(v[pixel * self.channels + c]) / 255.0,
            Samples::Sixteen(v) => f32::from(v[pixel * self.channels + c]) / 65535.0,
            Samples::Linear(v) => v[pixel * self.channels + c],
        };
        let [r, g, b] = if self.channels < 3 { [at(0); 3] } else { [at(0), at(1), at(2)] };
        [r, g, b, self.alpha_channel().map_or(1.0, at)]
    }

    /// The image with `coverage` (one value in `[0, 1]` per pixel) in place of its alpha, which its RGB is not yet
    /// multiplied by.
    pub(crate) fn with_coverage(self, coverage: &[f32]) -> Self {
        let colours = if self.channels < 3 { 1 } else { 3 };
        fn interleave<T: Copy>(v: &[T], from: usize, colours: usize, coverage: impl Iterator<Item = T>) -> Vec<T> {
            let mut out = Vec::with_capacity(v.len() / from.max(1) * (colours + 1));
            for (pixel, c) in v.chunks_exact(from.max(1)).zip(coverage) {
                out.extend_from_slice(&pixel[..colours]);
                out.push(c);
            }
            out
        }
        let (from, c) = (self.channels, coverage.iter());
        let samples = match &self.samples {
            Samples::Eight(v) => Samples::Eight(interleave(v, from, colours, c.map(|&c| (c * 255.0).round() as u8))),
            Samples::Sixteen(v) => {
                Samples::Sixteen(interleave(v, from, colours, c.map(|&c| (c * 65535.0).round() as u16)))
            }
            Samples::Linear(v) => Samples::Linear(interleave(v, from, colours, c.copied())),
        };
        Self { channels: colours + 1, samples, premultiplied: Some(false), ..self }
    }

    /// The image with black where its alpha is 0; with an alpha of 0 and 1 only, RGB is then multiplied by it.
    pub(crate) fn cut_out(mut self) -> Self {
        fn blacken<T: Copy + Default + PartialEq>(v: &mut [T], channels: usize) {
            for pixel in v.chunks_exact_mut(channels) {
                if pixel.last() == Some(&T::default()) {
                    pixel.fill(T::default());
                }
            }
        }
        match &mut self.samples {
            Samples::Eight(v) => blacken(v, self.channels),
            Samples::Sixteen(v) => blacken(v, self.channels),
            Samples::Linear(v) => blacken(v, self.channels),
        }
        self.premultiplied = Some(true);
        self
    }
}
