//! How far bulk pictures are from the reference, and how noisy they are.
use super::{Bulk, BulkOptions};
use crate::{PathtraceError, ReferenceOptions, Scene, render_reference};
use diamond_camera::Camera;
use diamond_image::Image;

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
    /// Root of the mean squared difference from the reference, without the reference's own noise, over the mean radiance.
    pub rmse: f64,
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

/// Solves and renders `cameras` in bulk and by [`render_reference`], and compares; two more solutions with half the walks and other
/// seeds measure the noise, each half as good as the whole in variance.
pub fn measure_bulk(
    scene: &Scene,
    options: &BulkOptions,
    cameras: &[Camera],
    reference: &ReferenceOptions,
    progress: &(dyn Fn(f32) + Sync),
) -> Result<BulkError, PathtraceError> {
    let references = cameras
        .iter()
        .enumerate()
        .map(|(i, camera)| {
            render_reference(scene, camera, &ReferenceOptions { seed: reference.seed + i as u64, ..*reference })
        })
        .collect::<Result<Vec<_>, _>>()?;
    BulkError::against(scene, options, cameras, &references, progress)
}

impl BulkError {
    /// [`measure_bulk`] with references that are at hand, one for each camera.
    pub fn against(
        scene: &Scene,
        options: &BulkOptions,
        cameras: &[Camera],
        references: &[crate::ReferenceImage],
        progress: &(dyn Fn(f32) + Sync),
    ) -> Result<Self, PathtraceError> {
        if cameras.len() != references.len() || cameras.is_empty() {
            return Err(PathtraceError::Shape {
                what: "references of a measurement",
                expected: format!("{}, one for each camera, and at least one", cameras.len()),
                found: format!("{}", references.len()),
            });
        }
        let halved = |seed: u64| BulkOptions { walks: (options.walks / 2).max(1), seed, ..*options };
        let whole = Bulk::solve(scene, options, &|f| progress(f * 0.5))?;
        let first = Bulk::solve(scene, &halved(options.seed.wrapping_add(1)), &|f| progress(0.5 + f * 0.25))?;
        let second = Bulk::solve(scene, &halved(options.seed.wrapping_add(2)), &|f| progress(0.75 + f * 0.25))?;
        let (mut sum, mut reference_sum, mut reference_square) = (0.0f64, 0.0f64, 0.0f64);
        let (mut squares, mut own, mut noise, mut relative, mut n) = (0.0f64, 0.0f64, 0.0f64, 0.0f64, 0usize);
        let (mut spread, mut apart) = (0.0f64, 0.0f64);
        let mut pictures = 0usize;
        for (v, (camera, reference)) in cameras.iter().zip(references).enumerate() {
            let view = whole.render(camera, v as u64)?;
            let (a, b) = (first.render(camera, 1000 + v as u64)?, second.render(camera, 2000 + v as u64)?);
            // Lamps share paths: their errors add up, pixels' do not.
            let mut pixel_error = vec![0.0f64; view.coverage.pixels()];
            for (l, image) in view.lights.iter().enumerate() {
                let target = &reference.lights[l];
                let peak = peak(image, &view.coverage);
                let (mut here, mut here_n) = (0.0f64, 0usize);
                for (i, covered) in reference.coverage.data().iter().enumerate() {
                    if *covered <= 0.0 && view.coverage.data()[i] <= 0.0 {
                        continue;
                    }
                    for k in 3 * i..3 * i + 3 {
                        let (x, r) = (f64::from(image.data()[k]), f64::from(target.mean.data()[k]));
                        let e = f64::from(target.standard_error.data()[k]);
                        let half = f64::from(a.lights[l].data()[k] - b.lights[l].data()[k]);
                        sum += x;
                        reference_sum += r;
                        reference_square += r * r;
                        squares += (x - r) * (x - r);
                        own += e * e;
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
        }
        let n = n.max(1) as f64;
        let mean = (reference_sum / n).max(1e-30);
        let rms = (reference_square / n).sqrt().max(1e-30);
        let error = ((squares - own) / n).max(0.0).sqrt();
        Ok(Self {
            bias: sum / reference_sum.max(1e-30) - 1.0,
            bias_standard_error: spread.sqrt() / reference_sum.max(1e-30),
            bias_noise: 0.5 * apart.abs() / reference_sum.max(1e-30),
            rmse: error / mean,
            rmse_of_rms: error / rms,
            noise: (noise / n).sqrt() / mean,
            noise_db: -10.0 * (relative / pictures.max(1) as f64).max(1e-30).log10(),
        })
    }
}
