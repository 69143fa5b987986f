//! How far bulk pictures are from the reference, and how noisy they are.
use super::{Bulk, BulkOptions};
use crate::{
    Boundary, LightImage, PathOptions, PathtraceError, ReferenceImage, ReferenceOptions, Rng, Scene, Tracer,
    render_reference,
};
use diamond_camera::Camera;
use diamond_image::Image;
use glam::{DVec3, Vec2, Vec3};
use rayon::prelude::*;

/// Errors of bulk pictures, over all pixels that the object covers, all channels, lamps and views.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BulkError {
    /// Mean of bulk over mean of reference, minus 1.
    pub bias: f64,
    /// Standard error of `bias` that the reference's noise makes, lamps taken as fully correlated.
    pub bias_standard_error: f64,
    /// What two solutions with half the walks differ by in the mean, halved: the size of the bulk solution's own part in `bias`
    /// (walks are shared by all pixels and lamps, so it does not average out over them).
    pub bias_noise: f64,
    /// Root of the mean squared difference from the truth, over the mean radiance, where values above the film's white count as white. The
    /// truth is known by two independent references, and the product of the differences from both has no part of either's noise in
    /// the mean (0 where it is negative).
    pub rmse: f64,
    /// The same without white's limit. A glint of a coat is hundreds of times as bright as the mean: one pixel that is off by a hundredth of it can be
    /// more than everything else together.
    pub rmse_beyond_white: f64,
    /// Standard error of the square of `rmse`, pixels taken as independent.
    pub square_standard_error: f64,
    /// The same over the root mean square of the reference.
    pub rmse_of_rms: f64,
    /// Root mean square noise of the bulk pictures over the mean radiance, from two solutions with half the walks.
    pub noise: f64,
    /// The same as PSNR against each picture's 99.9 % quantile, averaged as squared error, dB.
    pub noise_db: f64,
}

impl BulkError {
    /// What of `rmse` is not noise.
    pub fn systematic(&self) -> f64 {
        (self.rmse * self.rmse - self.noise * self.noise).max(0.0).sqrt()
    }
}

/// The value that 99.9 % of an image's covered values do not exceed, at least the smallest positive number.
fn peak(image: &Image, coverage: &Image) -> f64 {
    let mut values: Vec<f32> = image
        .data()
        .chunks_exact(3)
        .zip(coverage.data())
        .filter(|(_, c)| **c > 0.0)
        .flat_map(|(v, _)| v.iter().copied())
        .collect();
    values.sort_by(f32::total_cmp);
    let at = (values.len() as f64 * 0.999) as usize;
    values.get(at.min(values.len().saturating_sub(1))).map_or(0.0, |v| f64::from(*v)).max(1e-30)
}

/// Whether there is a reference for each camera.
fn checked(cameras: &[Camera], references: &[ReferencePair]) -> Result<(), PathtraceError> {
    if cameras.len() == references.len() && !cameras.is_empty() {
        return Ok(());
    }
    Err(PathtraceError::Shape {
        what: "references of a measurement",
        expected: format!("{}, one for each camera, and at least one", cameras.len()),
        found: format!("{}", references.len()),
    })
}

/// Two independent references of a view, each with half the paths.
pub type ReferencePair = [ReferenceImage; 2];

/// Seeds of a coat's reflection are those of the paths through the object with these bits turned.
const COATED: u64 = 0x636f_6174 << 32;

/// Samples per axis of a pixel for a coat's reflection, one at random in each cell of a grid, twice.
const COAT_SAMPLES: u32 = 16;

/// What the coat alone reflects, from one ray in each cell of a fine grid in each pixel, and the coverage; the standard error from two such grids.
fn coat_alone(scene: &Scene, camera: &Camera, seed: u64) -> Result<ReferenceImage, PathtraceError> {
    let mut black = scene.clone();
    black.material.medium.albedo = Vec3::ZERO;
    let tracer = Tracer::new(&black, PathOptions::default())?;
    let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
    let (lights, n) = (scene.lights.len(), COAT_SAMPLES);
    let one = |i: usize| {
        let corner = Vec2::new((i % width) as f32, (i / width) as f32);
        let mut rng = Rng::new(seed ^ COATED, i as u64);
        let mut sums = [vec![DVec3::ZERO; lights], vec![DVec3::ZERO; lights]];
        let (mut out, mut hits) = (vec![Vec3::ZERO; lights], 0u32);
        for sum in &mut sums {
            for cell in 0..n * n {
                let jitter = Vec2::new(rng.uniform(), rng.uniform());
                let ray = camera.ray(corner + (Vec2::new((cell % n) as f32, (cell / n) as f32) + jitter) / n as f32);
                let end = tracer.trace(ray.origin, ray.direction, false, &mut rng, &mut out);
                hits += u32::from(end.hit);
                sum.iter_mut().zip(&out).for_each(|(sum, value)| *sum += value.as_dvec3() / f64::from(n * n));
            }
        }
        (sums, hits as f32 / (2 * n * n) as f32)
    };
    let pixels: Vec<_> = (0..width * height).into_par_iter().with_max_len(16).map(one).collect();
    let blank = || Image::new(width, height, 3);
    let mut image = ReferenceImage {
        lights: (0..lights).map(|_| LightImage { mean: blank(), standard_error: blank() }).collect(),
        coverage: Image::new(width, height, 1),
        events: 0,
        truncated: 0,
    };
    for (i, ([a, b], coverage)) in pixels.iter().enumerate() {
        image.coverage.data_mut()[i] = *coverage;
        for (l, light) in image.lights.iter_mut().enumerate() {
            let (mean, error) = (0.5 * (a[l] + b[l]), 0.5 * (a[l] - b[l]).abs());
            light.mean.data_mut()[3 * i..3 * i + 3].copy_from_slice(&mean.as_vec3().to_array());
            light.standard_error.data_mut()[3 * i..3 * i + 3].copy_from_slice(&error.as_vec3().to_array());
        }
    }
    Ok(image)
}

/// The references that [`BulkError::against`] wants, each with half of `options.samples` paths per pixel. A coat takes nothing from what
/// passes through it, so its reflection is rendered apart, evenly over each pixel, and added.
///
/// # Errors
/// As [`render_reference`].
pub fn reference_pairs(
    scene: &Scene,
    cameras: &[Camera],
    options: &ReferenceOptions,
) -> Result<Vec<ReferencePair>, PathtraceError> {
    let half = |seed: u64| ReferenceOptions { samples: (options.samples / 2).max(2), seed, ..*options };
    let mut bare = scene.clone();
    bare.material.coat = None;
    let render = |camera: &Camera, seed: u64| -> Result<ReferenceImage, PathtraceError> {
        if scene.material.coat.is_none() || scene.material.boundary.effective() != Boundary::IndexMatched {
            return render_reference(scene, camera, &half(seed));
        }
        let mut image = render_reference(&bare, camera, &half(seed))?;
        let coat = coat_alone(scene, camera, seed)?;
        for (sum, part) in image.lights.iter_mut().zip(&coat.lights) {
            sum.mean.data_mut().iter_mut().zip(part.mean.data()).for_each(|(a, b)| *a += b);
            let errors = sum.standard_error.data_mut().iter_mut().zip(part.standard_error.data());
            errors.for_each(|(a, b)| *a = a.hypot(*b));
        }
        image.coverage = coat.coverage;
        Ok(image)
    };
    let pair = |(i, camera): (usize, &Camera)| {
        let seed = options.seed.wrapping_add(2 * i as u64);
        Ok([render(camera, seed)?, render(camera, seed.wrapping_add(1))?])
    };
    cameras.iter().enumerate().map(pair).collect()
}

/// Solves and renders `cameras` in bulk and by [`reference_pairs`], and compares; two more solutions with half the walks and other
/// seeds measure the noise, each half as good as the whole in variance. `white` is the radiance that the film shows as white, infinite
/// where it holds everything.
pub fn measure_bulk(
    scene: &Scene,
    options: &BulkOptions,
    cameras: &[Camera],
    reference: &ReferenceOptions,
    white: f32,
    progress: &(dyn Fn(f32) + Sync),
) -> Result<BulkError, PathtraceError> {
    let references = reference_pairs(scene, cameras, reference)?;
    BulkError::against(scene, options, cameras, &references, white, progress)
}

impl BulkError {
    /// [`measure_bulk`] with references that are at hand, one for each camera.
    pub fn against(
        scene: &Scene,
        options: &BulkOptions,
        cameras: &[Camera],
        references: &[ReferencePair],
        white: f32,
        progress: &(dyn Fn(f32) + Sync),
    ) -> Result<Self, PathtraceError> {
        checked(cameras, references)?;
        let halved = |seed: u64| BulkOptions { walks: (options.walks / 2).max(1), seed, ..*options };
        let whole = Bulk::solve(scene, options, &|f| progress(f * 0.5))?;
        let first = Bulk::solve(scene, &halved(options.seed.wrapping_add(1)), &|f| progress(0.5 + f * 0.25))?;
        let second = Bulk::solve(scene, &halved(options.seed.wrapping_add(2)), &|f| progress(0.75 + f * 0.25))?;
        Self::between(&whole, [&first, &second], cameras, references, white)
    }

    /// The same for solutions that are at hand: the whole, and two independent ones with half its walks.
    ///
    /// # Errors
    /// Other numbers of references than of cameras; cameras inside the object.
    pub fn between(
        whole: &Bulk<'_>,
        [first, second]: [&Bulk<'_>; 2],
        cameras: &[Camera],
        references: &[ReferencePair],
        white: f32,
    ) -> Result<Self, PathtraceError> {
        checked(cameras, references)?;
        let white = f64::from(white);
        let mut unlimited = 0.0f64;
        let (mut sum, mut reference_sum, mut reference_square) = (0.0f64, 0.0f64, 0.0f64);
        let (mut squares, mut noise, mut relative, mut n) = (0.0f64, 0.0f64, 0.0f64, 0usize);
        // Of a pixel's squared differences, all lamps and channels together.
        let mut pixel_squares = 0.0f64;
        let (mut spread, mut apart) = (0.0f64, 0.0f64);
        let mut pictures = 0usize;
        for (v, (camera, [one, two])) in cameras.iter().zip(references).enumerate() {
            let view = whole.render(camera, v as u64)?;
            let (a, b) = (first.render(camera, 1000 + v as u64)?, second.render(camera, 2000 + v as u64)?);
            // Lamps share paths: their errors add up, pixels' do not.
            let mut pixel_error = vec![0.0f64; view.coverage.pixels()];
            let mut pixel_square = vec![0.0f64; view.coverage.pixels()];
            for (l, image) in view.lights.iter().enumerate() {
                let (one_light, two_light) = (&one.lights[l], &two.lights[l]);
                let peak = peak(image, &view.coverage);
                let (mut here, mut here_n) = (0.0f64, 0usize);
                for (i, covered) in view.coverage.data().iter().enumerate() {
                    if *covered <= 0.0 && one.coverage.data()[i] <= 0.0 && two.coverage.data()[i] <= 0.0 {
                        continue;
                    }
                    for k in 3 * i..3 * i + 3 {
                        let x = f64::from(image.data()[k]);
                        let (p, q) = (f64::from(one_light.mean.data()[k]), f64::from(two_light.mean.data()[k]));
                        let errors = (one_light.standard_error.data()[k], two_light.standard_error.data()[k]);
                        let (r, e) = (0.5 * (p + q), 0.5 * f64::from(errors.0).hypot(f64::from(errors.1)));
                        let half = f64::from(a.lights[l].data()[k] - b.lights[l].data()[k]);
                        sum += x;
                        reference_sum += r;
                        reference_square += p * q;
                        unlimited += (x - p) * (x - q);
                        let shown = x.min(white);
                        let square = (shown - p.min(white)) * (shown - q.min(white));
                        squares += square;
                        pixel_square[i] += square;
                        pixel_error[i] += e;
                        apart += half;
                        // Var(a − b) = 2·Var(half) = 4·Var(whole).
                        here += 0.25 * half * half;
                        here_n += 1;
                    }
                }
                noise += here;
                n += here_n;
                relative += here / (here_n.max(1) as f64 * peak * peak);
                pictures += 1;
            }
            spread += pixel_error.iter().map(|e| e * e).sum::<f64>();
            pixel_squares += pixel_square.iter().map(|e| e * e).sum::<f64>();
        }
        let n = n.max(1) as f64;
        let mean = (reference_sum / n).max(1e-30);
        let rms = (reference_square / n).max(0.0).sqrt().max(1e-30);
        let error = (squares / n).max(0.0).sqrt();
        Ok(Self {
            bias: sum / reference_sum.max(1e-30) - 1.0,
            bias_standard_error: spread.sqrt() / reference_sum.max(1e-30),
            bias_noise: 0.5 * apart.abs() / reference_sum.max(1e-30),
            rmse: error / mean,
            rmse_beyond_white: (unlimited / n).max(0.0).sqrt() / mean,
            square_standard_error: pixel_squares.sqrt() / (n * mean * mean),
            rmse_of_rms: error / rms,
            noise: (noise / n).sqrt() / mean,
            noise_db: -10.0 * (relative / pictures.max(1) as f64).max(1e-30).log10(),
        })
    }
}
