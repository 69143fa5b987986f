//! Sixteen neighbouring pixels of a row, channel by channel instead of pixel by pixel: what vectors of pixels are loaded from.
use diamond_image::Image;
use diamond_simd::{BLOCK, Lanes, Simd};

/// Channels of sixteen pixels.
pub(crate) type Planes<const C: usize> = [[f32; BLOCK]; C];

/// Channels from `first` on of the pixels of row `y` from `x` on, as many as there are planes and pixels; the rest of the
/// planes stays as it is.
#[inline(always)]
pub(crate) fn gather(planes: &mut [[f32; BLOCK]], image: &Image, first: usize, x: usize, y: usize) {
    let (width, _, channels) = image.shape();
    let count = (width - x).min(BLOCK);
    let row = &image.data()[(y * width + x) * channels..][..count * channels];
    for (i, pixel) in row.chunks_exact(channels).enumerate() {
        for (plane, value) in planes.iter_mut().zip(&pixel[first..]) {
            plane[i] = *value;
        }
    }
}

/// Interleaves as many pixels as `out` has room for.
#[inline(always)]
pub(crate) fn scatter<const C: usize>(planes: &Planes<C>, out: &mut [f32]) {
    for (i, pixel) in out.as_chunks_mut::<C>().0.iter_mut().enumerate().take(BLOCK) {
        for c in 0..C {
            pixel[c] = planes[c][i];
        }
    }
}

/// One vector of each plane, from lane `at` of the block on.
#[inline(always)]
pub(crate) fn load<S: Simd, const C: usize>(s: S, planes: &Planes<C>, at: usize) -> [Lanes<S>; C] {
    let mut out = [Lanes::splat(s, 0.0); C];
    for c in 0..C {
        out[c] = Lanes::load(s, &planes[c][at..]);
    }
    out
}

/// The inverse of [`load`].
#[inline(always)]
pub(crate) fn store<S: Simd, const C: usize>(values: [Lanes<S>; C], planes: &mut Planes<C>, at: usize) {
    for c in 0..C {
        values[c].store(&mut planes[c][at..]);
    }
}

/// Column and row of the centres of the pixels from `x` on in row `y`.
#[inline(always)]
pub(crate) fn centres<S: Simd>(s: S, x: usize, y: usize) -> (Lanes<S>, Lanes<S>) {
    const HALVES: [f32; BLOCK] = [0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5, 8.5, 9.5, 10.5, 11.5, 12.5, 13.5, 14.5, 15.5];
    (Lanes::load(s, &HALVES) + x as f32, Lanes::splat(s, y as f32 + 0.5))
}
