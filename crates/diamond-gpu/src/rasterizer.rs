//! The rasteriser on a device: what `diamond_splat::rasterize` does, with everything between parameters and picture, and
//! between picture's and parameters' gradients, kept there.
use crate::arrays::{Arrays, columns_of};
use crate::frame::{Coverage, Frame};
use crate::shape::{Column, Shape};
use crate::stage::{STAGES, Stage, Step, blend_pull_and_sum, steps};
use crate::{Device, GpuError, scene_arrays};
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_reconstruct::Blender;
use diamond_splat::{
    Cutoff, Features, Gaussians, Raster, RasterConfig, RasterGrad, RasterPull, RasterStats, SplatError,
};
use std::sync::Arc;

/// Entries per Gaussian that room is made for before the first picture says how many there are.
const FIRST_GUESS: u64 = 4;
/// Room beyond what a picture needed, so that the next one seldom has to be made twice: an eighth.
const SPARE: u64 = 8;

/// Makes pictures of Gaussians, and gradients, on a device.
///
/// Two runs on one device give the same bits: entries are sorted without ties, and sums are made in a fixed order.
#[derive(Debug)]
pub struct Rasterizer {
    device: Arc<Device>,
    arrays: Arrays,
    capacity: u64,
    /// The last picture, if it can be pulled back.
    last: Option<Last>,
}

/// What is remembered of a picture.
#[derive(Debug, Clone, Copy)]
struct Last {
    shape: Shape,
    factors: bool,
}

/// How large a picture was for the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DeviceStats {
    /// Gaussians that could contribute.
    pub visible: u64,
    /// (Gaussian, tile of 16 × 16 pixels) pairs.
    pub entries: u64,
}

/// The reverse of one picture. The Gaussians lie on the device, and the device is borrowed until this is used.
#[derive(Debug)]
pub struct DevicePullback<'r> {
    rasterizer: &'r mut Rasterizer,
    last: Last,
    stats: DeviceStats,
}

impl Rasterizer {
    /// On a device.
    ///
    /// # Errors
    /// The device has no room left.
    pub fn new(device: Arc<Device>) -> Result<Self, GpuError> {
        let arrays = Arrays::new(&device)?;
        Ok(Self { device, arrays, capacity: 0, last: None })
    }

    /// Projects and blends, as [`diamond_splat::rasterize`] does `[eq:splat-blend]`: the same thresholds, the same order.
    ///
    /// [`RasterStats::evaluated_pairs`] is 0 here and `blended_pairs` is `None`, for nobody counts them;
    /// `block_entries` counts tiles of 16 × 16 pixels.
    ///
    /// # Errors
    /// What the CPU refuses; [`Cutoff::Smooth`]; arrays beyond the device's limits or memory; a lost device.
    pub fn rasterize(
        &mut self,
        gaussians: &Gaussians,
        features: &Features,
        camera: &Camera,
        config: &RasterConfig,
    ) -> Result<(Raster, DevicePullback<'_>), GpuError> {
        let (raster, stats, last) = self.picture(gaussians, features, camera, config)?;
        Ok((raster, DevicePullback { rasterizer: self, last, stats }))
    }

    fn picture(
        &mut self,
        gaussians: &Gaussians,
        features: &Features,
        camera: &Camera,
        config: &RasterConfig,
    ) -> Result<(Raster, DeviceStats, Last), GpuError> {
        self.last = None;
        validate(gaussians, features, camera, config)?;
        let device = &*self.device;
        let n = gaussians.len() as u64;
        let size = [camera.intrinsics.width, camera.intrinsics.height].map(u64::from);
        let forms = scene_arrays::gaussians(gaussians);
        self.capacity = self.capacity.max(FIRST_GUESS * n);
        loop {
            let shape = Shape::new(n, size, features.channels, self.capacity, device.max_binding())?;
            let capacity = u32::try_from(shape.capacity).map_err(|_| too_many(shape.capacity))?;
            let frame = Frame::new(camera, config, n as u32, !gaussians.factors.is_empty(), capacity);
            let all: Vec<Step> =
                STAGES.iter().filter(|row| !row.backward).flat_map(|row| steps(row.stage, &shape)).collect();
            let mut columns = columns_of(&all);
            columns.extend([Column::Counts, Column::Picture, Column::Coverage]);
            self.arrays.reserve(device, &shape, &columns)?;
            self.arrays.set_frame(device, &frame);
            if n > 0 {
                for (column, words) in [Column::Means, Column::FormA, Column::FormB].into_iter().zip(&forms) {
                    self.arrays.write(device, column, 0, words)?;
                }
            }
            let rows = scene_arrays::pieces(&shape, Column::Features, &features.data);
            self.arrays.write(device, Column::Features, 0, &rows)?;
            self.arrays.write(device, Column::Counts, 0, &[n as u32, 0, 0, 0])?;
            let mut encoder = device.device.create_command_encoder(&Default::default());
            self.arrays.encode(device, &mut encoder, &all)?;
            device.submit(encoder)?;
            let wanted = [Column::Counts, Column::Picture, Column::Coverage];
            let read = self.arrays.read(device, &wanted.map(|column| (column, shape.words(column))))?;
            let [counts, picture, coverage] = [&read[0], &read[1], &read[2]];
            let entries = u64::from(counts[2]);
            if entries > shape.capacity {
                // It was made for fewer: once more, with room. All ones: more than can be counted.
                self.capacity = entries + entries / SPARE;
                if counts[2] == u32::MAX {
                    return Err(too_many(entries));
                }
                continue;
            }
            let stats = DeviceStats { visible: counts[3].into(), entries };
            let raster = assemble(&shape, picture, coverage, stats)?;
            let last = Last { shape, factors: !gaussians.factors.is_empty() };
            self.last = Some(last);
            return Ok((raster, stats, last));
        }
    }
}

/// What a stage takes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StageTime {
    /// Its name, as in [`STAGES`].
    pub name: &'static str,
    /// Mean over the repeats, seconds.
    pub seconds: f64,
    /// Bytes of the arrays that its kernels are handed: what it moves if each number is read or written once.
    pub bytes: u64,
}

impl Rasterizer {
    /// Makes a picture and its gradient, and then each stage by itself, `repeats` times in a row. Channels that go through the kernels in several pieces are
    /// timed all together.
    ///
    /// # Errors
    /// As [`Rasterizer::rasterize`] and [`DevicePullback::pull`].
    pub fn time_stages(
        &mut self,
        gaussians: &Gaussians,
        features: &Features,
        camera: &Camera,
        config: &RasterConfig,
        d: &RasterGrad,
        repeats: usize,
    ) -> Result<(DeviceStats, Vec<StageTime>), GpuError> {
        let (_, stats, last) = self.picture(gaussians, features, camera, config)?;
        self.pull(last, d)?;
        let device = &*self.device;
        let mut times = Vec::with_capacity(STAGES.len());
        for row in STAGES {
            let steps = steps(row.stage, &last.shape);
            let words = |step: &Step| match step {
                Step::Clear(column) => last.shape.words(*column),
                Step::Dispatch { bindings, .. } => bindings.iter().map(|(_, _, words)| *words).sum(),
            };
            let bytes = 4 * steps.iter().map(words).sum::<u64>();
            let once = || -> Result<f64, GpuError> {
                let mut encoder = device.device.create_command_encoder(&Default::default());
                for _ in 0..repeats.max(1) {
                    self.arrays.encode(device, &mut encoder, &steps)?;
                }
                let begun = std::time::Instant::now();
                device.submit(encoder)?;
                // Waits for all that was submitted.
                self.arrays.read(device, &[(Column::Counts, 4)])?;
                Ok(begun.elapsed().as_secs_f64() / repeats.max(1) as f64)
            };
            // The first time kernels may still be compiled.
            once()?;
            times.push(StageTime { name: row.name, seconds: once()?, bytes });
        }
        Ok((stats, times))
    }
}

fn too_many(entries: u64) -> GpuError {
    GpuError::Limit { what: "lists of tiles", needed: entries.saturating_mul(8), limit: u64::from(u32::MAX) * 8 }
}

fn assemble(shape: &Shape, picture: &[u32], coverage: &[u32], stats: DeviceStats) -> Result<Raster, GpuError> {
    let (width, height, pixels) = (shape.width as usize, shape.height as usize, shape.pixels() as usize);
    let data = scene_arrays::rows(shape, Column::Picture, picture, pixels);
    let image = |channels, data| {
        Image::from_vec(width, height, channels, data).map_err(|error| {
            GpuError::Splat(SplatError::Shape {
                what: "Raster",
                expected: "a picture".into(),
                found: error.to_string(),
            })
        })
    };
    let coverage: Vec<Coverage> = bytemuck::pod_collect_to_vec(coverage);
    Ok(Raster {
        features: image(shape.channels, data)?,
        opacity: image(1, coverage.iter().map(|c| c.opacity).collect())?,
        depth: image(1, coverage.iter().map(|c| c.depth).collect())?,
        stats: RasterStats {
            visible: stats.visible as usize,
            block_entries: stats.entries,
            evaluated_pairs: 0,
            blended_pairs: None,
        },
    })
}

/// What the CPU would refuse is refused in the same words.
fn validate(g: &Gaussians, features: &Features, camera: &Camera, config: &RasterConfig) -> Result<(), GpuError> {
    // A projection of nothing checks settings and camera.
    diamond_splat::project(&Gaussians::default(), camera, config)?;
    if config.cutoff == Cutoff::Smooth {
        return Err(GpuError::Unsupported {
            what: "Cutoff::Smooth",
            instead: "it exists for tests of derivatives; use the CPU's rasteriser",
        });
    }
    g.validate()?;
    features.validate(g.len())?;
    if g.len() > MAX_GAUSSIANS {
        let (expected, found) = (format!("at most {MAX_GAUSSIANS}"), g.len().to_string());
        return Err(SplatError::Shape { what: "Gaussians", expected, found }.into());
    }
    Ok(())
}

/// As many as the CPU takes.
const MAX_GAUSSIANS: usize = 1 << 28;

impl DevicePullback<'_> {
    /// How large the picture was for the device.
    pub fn stats(&self) -> DeviceStats {
        self.stats
    }

    /// Cotangents of the images to gradients of Gaussians and features; zero for what is not visible.
    ///
    /// # Errors
    /// Images of the wrong shape or with values that are not finite; arrays beyond the device's limits or memory; a lost
    /// device.
    pub fn pull(self, d: &RasterGrad) -> Result<RasterPull, GpuError> {
        self.rasterizer.pull(self.last, d)
    }
}

impl Rasterizer {
    fn pull(&mut self, last: Last, d: &RasterGrad) -> Result<RasterPull, GpuError> {
        let Last { shape, factors } = last;
        let (width, height, n) = (shape.width as usize, shape.height as usize, shape.gaussians as usize);
        check(&d.features, (width, height, shape.channels), "RasterGrad::features")?;
        check(&d.opacity, (width, height, 1), "RasterGrad::opacity")?;
        check(&d.depth, (width, height, 1), "RasterGrad::depth")?;
        if n == 0 {
            return Ok(RasterPull::default());
        }
        let (device, arrays) = (&*self.device, &mut self.arrays);
        let mut all = blend_pull_and_sum(&shape);
        all.extend(steps(Stage::ProjectionPull, &shape));
        arrays.reserve(device, &shape, &columns_of(&all))?;
        let picture = scene_arrays::pieces(&shape, Column::DPicture, d.features.data());
        arrays.write(device, Column::DPicture, 0, &picture)?;
        arrays.write(device, Column::DCoverage, 0, &scene_arrays::d_coverage(&d.opacity, &d.depth))?;
        let mut encoder = device.device.create_command_encoder(&Default::default());
        arrays.encode(device, &mut encoder, &all)?;
        device.submit(encoder)?;
        let wanted = [Column::Gradient, Column::DFeatures];
        let read = arrays.read(device, &wanted.map(|column| (column, shape.words(column))))?;
        let (gaussians, screen) = scene_arrays::gradient(&read[0], n, factors);
        let features = scene_arrays::rows(&shape, Column::DFeatures, &read[1], n);
        Ok(RasterPull { gaussians, features, screen })
    }
}

/// Training pictures are blended on the device: their channels go there and their gradients come back, step by step.
impl Blender for Rasterizer {
    fn name(&self) -> &str {
        &self.device.adapter().name
    }

    fn blend(
        &mut self,
        gaussians: &Gaussians,
        features: &Features,
        camera: &Camera,
        config: &RasterConfig,
    ) -> Result<Raster, String> {
        let made = self.picture(gaussians, features, camera, config);
        made.map(|(raster, _, _)| raster).map_err(|error| error.to_string())
    }

    fn pull(&mut self, d: &RasterGrad) -> Result<RasterPull, String> {
        let last = self.last.ok_or("no picture was blended before its gradient was asked for")?;
        Rasterizer::pull(self, last, d).map_err(|error| error.to_string())
    }
}

fn check(image: &Image, shape: (usize, usize, usize), what: &'static str) -> Result<(), SplatError> {
    if image.shape() != shape {
        return Err(SplatError::Shape { what, expected: format!("{shape:?}"), found: format!("{:?}", image.shape()) });
    }
    match image.data().iter().position(|v| !v.is_finite()) {
        Some(index) => Err(SplatError::NonFinite { what, index }),
        None => Ok(()),
    }
}
