//! Pictures without bias, with the standard error of every pixel.
//!
//! Every pixel averages paths through points of its square. The first numbers of its paths (place, depth, direction) are
//! evenly spread points; several independently shifted sets of them say by their spread what the standard error is. One pass makes the pictures of
//! all lamps.
use crate::path::{PathEnd, PathOptions, Tracer};
use crate::sobol::Sobol;
use crate::{PathtraceError, Rng, Scene};
use diamond_camera::Camera;
use diamond_image::Image;
use glam::{DVec3, Vec2, Vec3};
use rayon::prelude::*;

/// How a reference is made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReferenceOptions {
    /// Paths per pixel, at least 2.
    pub samples: u32,
    /// Pictures of different seeds are independent.
    pub seed: u64,
    /// How paths are traced.
    pub path: PathOptions,
}

impl Default for ReferenceOptions {
    fn default() -> Self {
        Self { samples: 64, seed: 0, path: PathOptions::default() }
    }
}

/// The picture of one lamp.
#[derive(Debug, Clone, PartialEq)]
pub struct LightImage {
    /// Mean linear RGB radiance of each pixel, black where no object is (premultiplied by coverage).
    pub mean: Image,
    /// Standard error of each value of `mean`.
    pub standard_error: Image,
}

impl LightImage {
    /// Mean over all pixels, and its standard error (pixels are independent).
    pub fn film_mean(&self) -> (DVec3, DVec3) {
        let (mut mean, mut variance) = (DVec3::ZERO, DVec3::ZERO);
        for (m, s) in self.mean.data().chunks_exact(3).zip(self.standard_error.data().chunks_exact(3)) {
            mean += Vec3::from_slice(m).as_dvec3();
            let s = Vec3::from_slice(s).as_dvec3();
            variance += s * s;
        }
        let n = self.mean.pixels().max(1) as f64;
        (mean / n, DVec3::new(variance.x.sqrt(), variance.y.sqrt(), variance.z.sqrt()) / n)
    }
}

/// The pictures of all lamps from one camera.
#[derive(Debug, Clone, PartialEq)]
pub struct ReferenceImage {
    /// One for each lamp of the scene.
    pub lights: Vec<LightImage>,
    /// Fraction of each pixel that the object covers.
    pub coverage: Image,
    /// Scatterings and surface events of all paths.
    pub events: u64,
    /// Paths that were cut off by [`PathOptions::max_events`]; above 0 the pictures are too dark.
    pub truncated: u64,
}

/// What one pixel has gathered.
struct Pixel {
    /// Mean and standard error of each lamp.
    values: Vec<(Vec3, Vec3)>,
    coverage: f32,
    events: u64,
    truncated: u64,
}

/// Renders the scene once for each of its lamps, without bias. The result has the same bits for any number of threads.
///
/// Errors where the scene, the camera or the options are invalid; see [`Scene::validate`].
pub fn render_reference(
    scene: &Scene,
    camera: &Camera,
    options: &ReferenceOptions,
) -> Result<ReferenceImage, PathtraceError> {
    camera.validate().map_err(|e| PathtraceError::Value {
        what: "the camera".into(),
        expected: "a valid camera",
        found: e.to_string(),
    })?;
    if options.samples < 2 {
        return Err(PathtraceError::Value {
            what: "samples per pixel".into(),
            expected: "at least 2, for the standard error",
            found: format!("{}", options.samples),
        });
    }
    let tracer = Tracer::new(scene, options.path)?;
    let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
    let inside = scene.geometry.contains(camera.pose.centre());
    let pixels: Vec<Pixel> = (0..width * height)
        .into_par_iter()
        .with_max_len(16)
        .map(|i| {
            let corner = Vec2::new((i % width) as f32, (i / width) as f32);
            gather(&tracer, camera, corner, inside, options.samples, Rng::new(options.seed, i as u64))
        })
        .collect();
    let blank = || Image::new(width, height, 3);
    let mut lights: Vec<LightImage> =
        scene.lights.iter().map(|_| LightImage { mean: blank(), standard_error: blank() }).collect();
    let mut coverage = Image::new(width, height, 1);
    for (i, pixel) in pixels.iter().enumerate() {
        for (light, (mean, error)) in lights.iter_mut().zip(&pixel.values) {
            light.mean.data_mut()[3 * i..3 * i + 3].copy_from_slice(&mean.to_array());
            light.standard_error.data_mut()[3 * i..3 * i + 3].copy_from_slice(&error.to_array());
        }
        coverage.data_mut()[i] = pixel.coverage;
    }
    let sum = |f: fn(&Pixel) -> u64| pixels.iter().map(f).sum();
    Ok(ReferenceImage { lights, coverage, events: sum(|p| p.events), truncated: sum(|p| p.truncated) })
}

/// Independent sets into which a pixel's paths are divided, if there are enough: within a set paths avoid each other, and the spread of
/// the sets' means says how far their mean may be off.
const SETS: u32 = 64;

/// Smaller sets gain nothing.
const SMALLEST_SET: u32 = 4;

/// The paths of one pixel.
fn gather(tracer: &Tracer, camera: &Camera, corner: Vec2, inside: bool, samples: u32, mut rng: Rng) -> Pixel {
    let lamps = tracer.scene().lights.len();
    let sets = (samples / SMALLEST_SET).clamp(samples.min(8), SETS);
    let mut radiance = vec![Vec3::ZERO; lamps];
    let mut set = vec![DVec3::ZERO; lamps];
    // Sums over paths; and, over sets, of squared sums and of sums, each over the number of paths.
    let mut sums = vec![(DVec3::ZERO, DVec3::ZERO); lamps];
    let (mut hits, mut events, mut truncated) = (0u32, 0, 0);
    for k in 0..sets {
        let count = samples / sets + u32::from(k < samples % sets);
        rng.drop_lead();
        let mut points = Sobol::new(std::array::from_fn(|_| rng.bits()));
        set.fill(DVec3::ZERO);
        for _ in 0..count {
            rng.lead_with(points.draw());
            let ray = camera.ray(corner + Vec2::new(rng.uniform(), rng.uniform()));
            let end: PathEnd = tracer.trace(ray.origin, ray.direction, inside, &mut rng, &mut radiance);
            events += u64::from(end.events);
            truncated += u64::from(end.truncated);
            if !end.hit && !tracer.shows_lights() {
                continue;
            }
            hits += u32::from(end.hit);
            set.iter_mut().zip(&radiance).for_each(|(sum, value)| *sum += value.as_dvec3());
        }
        for ((sum, square), set) in sums.iter_mut().zip(&set) {
            *sum += *set;
            *square += *set * *set / f64::from(count);
        }
    }
    let (n, sets) = (f64::from(samples), f64::from(sets));
    let values = sums
        .into_iter()
        .map(|(sum, square)| {
            let mean = sum / n;
            // Sets of m paths have the variance V/m around the mean: V is the mean over sets of m·(set's mean − mean)².
            let variance = ((square - mean * sum) / ((sets - 1.0) * n)).max(DVec3::ZERO);
            let error = DVec3::new(variance.x.sqrt(), variance.y.sqrt(), variance.z.sqrt());
            (mean.as_vec3(), error.as_vec3())
        })
        .collect();
    Pixel { values, coverage: hits as f32 / samples as f32, events, truncated }
}
