//! The pixels of a row, shaded as many at once as the instruction set has lanes, forward and backward.
//!
//! [`shade_pixels`] and [`pull_pixels`] say what happens to a pixel, over a [`Number`]; the rows gather sixteen pixels from the
//! interleaved G-buffer, run them over vectors, and scatter the results. Sixteen pixels that are all empty are skipped.
//! Neighbours in a vector do not influence each other, so the bits do not depend on the number of lanes.
use crate::deferred::ShadingConfig;
use crate::gbuffer::{Blended, GBuffer, MIN_OPACITY, channel};
use crate::number::Number;
use crate::pixel_block::{Planes, centres, gather, load, scatter, store};
use crate::shaded::{COTANGENTS, RECORD, ShadedGrad, cotangents, record};
use crate::surface_point::{Eye, GEOMETRY, POINT, SurfacePoint, TRANSPORT, Transport};
use diamond_light::OlatLight;
use diamond_simd::{BLOCK, Lanes, Simd, WithSimd};

/// Sums, opacity and depth of one pixel.
pub(crate) const INPUTS: usize = channel::COUNT + 2;

/// Numbers of a prepared pixel: its point, opacity (0 where it is empty), and the factor of its features.
pub(crate) const KEPT: usize = POINT + 2;

/// What all pixels have in common.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scene {
    pub eye: Eye,
    pub light: OlatLight,
    pub config: ShadingConfig,
}

/// `N` of the `from.len()` numbers.
#[inline(always)]
fn part<T: Number, const M: usize, const N: usize>(from: &[T; M], first: usize) -> [T; N] {
    let mut out = [from[0]; N];
    out.copy_from_slice(&from[first..first + N]);
    out
}

/// Sums, opacity, depth → the pixel's record.
#[inline(always)]
pub(crate) fn shade_pixels<T: Number>(scene: &Scene, inputs: [T; INPUTS], pixel: (T, T)) -> [T; RECORD] {
    let sums: [T; channel::COUNT] = part(&inputs, 0);
    let config = &scene.config;
    let blended = Blended::new(&sums, inputs[channel::COUNT], inputs[channel::COUNT + 1], config.normalise);
    let geometry = part(&blended.features, channel::GEOMETRY.start);
    let (point, _) = SurfacePoint::new(geometry, blended.depth, pixel, &scene.eye, config);
    let transport = Transport::new(part(&blended.features, channel::TRANSPORT.start));
    let lit = point.light(&transport, &scene.light, config);
    record(&point, &transport, &lit, blended.opacity, blended.covered)
}

/// Sums, opacity, depth and the cotangents of the radiance and the maps → cotangents of sums, opacity, depth.
#[inline(always)]
pub(crate) fn pull_pixels<T: Number>(
    scene: &Scene,
    inputs: [T; INPUTS],
    pixel: (T, T),
    d: [T; COTANGENTS],
) -> [T; INPUTS] {
    let sums: [T; channel::COUNT] = part(&inputs, 0);
    let Scene { eye, light, config } = scene;
    let blended = Blended::new(&sums, inputs[channel::COUNT], inputs[channel::COUNT + 1], config.normalise);
    let geometry = part(&blended.features, channel::GEOMETRY.start);
    let (point, seen) = SurfacePoint::new(geometry, blended.depth, pixel, eye, config);
    let transport = Transport::new(part(&blended.features, channel::TRANSPORT.start));
    let (d_radiance, maps) = cotangents(d);
    let (lit, geometry, transported, d_depth) =
        point.light_pull(&seen, &transport, (light, eye, config), d_radiance * blended.opacity, maps);
    let d_opacity = d_radiance.dot(lit.surface + lit.subsurface);
    let mut d_features = sums;
    d_features[channel::GEOMETRY].copy_from_slice(&geometry);
    d_features[channel::TRANSPORT].copy_from_slice(&transported);
    let (d_sums, d_opacity, d_depth) = blended.pull(&d_features, d_opacity, d_depth, config.normalise);
    let mut out = inputs;
    out[..channel::COUNT].copy_from_slice(&d_sums);
    out[channel::COUNT] = d_opacity;
    out[channel::COUNT + 1] = d_depth;
    out
}

/// Geometry sums, opacity, depth → what is kept of the pixel; zero where it is empty.
#[inline(always)]
pub(crate) fn prepare_pixels<T: Number>(
    eye: &Eye,
    config: &ShadingConfig,
    inputs: [T; GEOMETRY + 2],
    pixel: (T, T),
) -> [T; KEPT] {
    let sums: [T; GEOMETRY] = part(&inputs, 0);
    let blended = Blended::new(&sums, inputs[GEOMETRY], inputs[GEOMETRY + 1], config.normalise);
    let (point, _) = SurfacePoint::new(blended.features, blended.depth, pixel, eye, config);
    let mut out = [blended.opacity; KEPT];
    out[..POINT].copy_from_slice(&point.numbers());
    out[POINT + 1] = blended.weight;
    for v in &mut out {
        *v = v.only_where(blended.covered);
    }
    out
}

/// What was kept, and the transport sums → the pixel's record.
#[inline(always)]
pub(crate) fn light_pixels<T: Number>(
    light: &OlatLight,
    config: &ShadingConfig,
    kept: [T; KEPT],
    mut sums: [T; TRANSPORT],
) -> [T; RECORD] {
    let point = SurfacePoint::of_numbers(part(&kept, 0));
    let (opacity, weight) = (kept[POINT], kept[POINT + 1]);
    for f in &mut sums {
        *f = *f * weight;
    }
    let transport = Transport::new(sums);
    let lit = point.light(&transport, light, config);
    record(&point, &transport, &lit, opacity, opacity.reaches(MIN_OPACITY))
}

/// Whether all pixels are empty.
#[inline(always)]
fn all_empty(opacity: &[f32; BLOCK]) -> bool {
    !opacity.iter().any(|o| *o >= MIN_OPACITY)
}

/// The first `M` − 2 channels, the opacity and the depth of a block.
#[inline(always)]
fn gather_inputs<const M: usize>(gbuffer: &GBuffer<'_>, x: usize, y: usize) -> Planes<M> {
    let mut planes = [[0.0; BLOCK]; M];
    gather(&mut planes[..M - 2], gbuffer.features, 0, x, y);
    gather(&mut planes[M - 2..M - 1], gbuffer.opacity, 0, x, y);
    gather(&mut planes[M - 1..], gbuffer.depth, 0, x, y);
    planes
}

/// Shades row `y`; `out` holds its records and is zero.
pub(crate) struct ShadeRow<'a> {
    pub gbuffer: &'a GBuffer<'a>,
    pub scene: &'a Scene,
    pub y: usize,
    pub out: &'a mut [f32],
}

impl WithSimd for ShadeRow<'_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        for (block, out) in self.out.chunks_mut(BLOCK * RECORD).enumerate() {
            let x = block * BLOCK;
            let inputs: Planes<INPUTS> = gather_inputs(self.gbuffer, x, self.y);
            if all_empty(&inputs[channel::COUNT]) {
                continue;
            }
            let mut results = [[0.0; BLOCK]; RECORD];
            for at in (0..out.len() / RECORD).step_by(S::F32_LANES) {
                let pixel = centres(s, x + at, self.y);
                store(shade_pixels(self.scene, load(s, &inputs, at), pixel), &mut results, at);
            }
            scatter(&results, out);
        }
    }
}

/// Pulls row `y` back; `out` holds the cotangents of its inputs and is zero.
pub(crate) struct PullRow<'a> {
    pub gbuffer: &'a GBuffer<'a>,
    pub scene: &'a Scene,
    pub d: &'a ShadedGrad,
    pub y: usize,
    pub out: &'a mut [f32],
}

impl WithSimd for PullRow<'_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let mut d = [[0.0; BLOCK]; COTANGENTS];
        for (block, out) in self.out.chunks_mut(BLOCK * INPUTS).enumerate() {
            let x = block * BLOCK;
            let inputs: Planes<INPUTS> = gather_inputs(self.gbuffer, x, self.y);
            if all_empty(&inputs[channel::COUNT]) {
                continue;
            }
            self.d.gather(&mut d, x, self.y);
            let mut results = [[0.0; BLOCK]; INPUTS];
            for at in (0..out.len() / INPUTS).step_by(S::F32_LANES) {
                let pixel = centres(s, x + at, self.y);
                store(pull_pixels(self.scene, load(s, &inputs, at), pixel, load(s, &d, at)), &mut results, at);
            }
            scatter(&results, out);
        }
    }
}

/// Prepares row `y`; `out` holds its blocks.
pub(crate) struct PrepareRow<'a> {
    pub gbuffer: &'a GBuffer<'a>,
    pub eye: &'a Eye,
    pub config: &'a ShadingConfig,
    pub y: usize,
    pub out: &'a mut [Planes<KEPT>],
}

impl WithSimd for PrepareRow<'_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        for (block, out) in self.out.iter_mut().enumerate() {
            let x = block * BLOCK;
            let inputs: Planes<{ GEOMETRY + 2 }> = gather_inputs(self.gbuffer, x, self.y);
            if all_empty(&inputs[GEOMETRY]) {
                continue;
            }
            for at in (0..BLOCK).step_by(S::F32_LANES) {
                let pixel = centres(s, x + at, self.y);
                store(prepare_pixels(self.eye, self.config, load(s, &inputs, at), pixel), out, at);
            }
        }
    }
}

/// Lights a prepared row; `out` holds `WIDTH` numbers per pixel, the first of its record, and is zero.
pub(crate) struct LightRow<'a, const WIDTH: usize, G> {
    pub kept: &'a [Planes<KEPT>],
    pub light: &'a OlatLight,
    pub config: &'a ShadingConfig,
    /// Fills the transport sums of the pixels from the column that it is given on.
    pub gather: G,
    pub out: &'a mut [f32],
}

impl<const WIDTH: usize, G: Fn(&mut Planes<TRANSPORT>, usize)> WithSimd for LightRow<'_, WIDTH, G> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let mut sums = [[0.0; BLOCK]; TRANSPORT];
        for (block, out) in self.out.chunks_mut(BLOCK * WIDTH).enumerate() {
            let kept = &self.kept[block];
            if all_empty(&kept[POINT]) {
                continue;
            }
            (self.gather)(&mut sums, block * BLOCK);
            let mut results = [[0.0; BLOCK]; WIDTH];
            for at in (0..out.len() / WIDTH).step_by(S::F32_LANES) {
                let record = light_pixels(self.light, self.config, load(s, kept, at), load(s, &sums, at));
                store(part::<Lanes<S>, RECORD, WIDTH>(&record, 0), &mut results, at);
            }
            scatter(&results, out);
        }
    }
}
