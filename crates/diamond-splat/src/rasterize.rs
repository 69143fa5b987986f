//! The rasteriser's front: `rasterize`, what it returns, and the pullback that belongs to it.
use crate::bins::{REGION, Reached, Scratch};
use crate::blend::{RegionForward, RegionImage, Scene};
use crate::ellipse::KAPPA2;
use crate::footprint::{FootprintGrad, View, finite_f32, project_pull};
use crate::lanes::Thresholds;
use crate::projection::{CHUNK, is_smooth, project};
use crate::pullback::{GEOMETRY, RegionBackward};
use crate::recycle::FLOATS;
use crate::wide::WIDTH;
use crate::{Features, Gaussians, GaussiansGrad, LowerFactor, Projection, RasterConfig, RasterPull, SplatError};
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_simd::Level;
use glam::{Vec2, Vec3, Vec4};
use rayon::prelude::*;
use std::borrow::Cow;
use std::cell::RefCell;

/// What a view of the Gaussians looks like. Weights are `w_k = α_k Π_{j<k} (1 − α_j)`, nearest first.
#[derive(Debug, Clone, PartialEq)]
pub struct Raster {
    /// Σ w f: as many channels as the features.
    pub features: Image,
    /// Σ w, in [0, 1): one channel.
    pub opacity: Image,
    /// Σ w z with view-space z, scene units, not divided by opacity: one channel.
    pub depth: Image,
    /// How much work it was.
    pub stats: RasterStats,
}

/// How much work a picture was.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RasterStats {
    /// Gaussians that could contribute.
    pub visible: usize,
    /// (Gaussian, block of 4 × 4 pixels) pairs.
    pub block_entries: u64,
    /// (Gaussian, pixel) pairs whose alpha was evaluated.
    pub evaluated_pairs: u64,
    /// (Gaussian, pixel) pairs with a weight above 0; `None` unless
    /// [`count_blended`](crate::RasterConfig::count_blended).
    pub blended_pairs: Option<u64>,
}

/// Cotangent of [`Raster`]: images of the same shapes.
#[derive(Debug, Clone, PartialEq)]
pub struct RasterGrad {
    /// d loss / d features.
    pub features: Image,
    /// d loss / d opacity.
    pub opacity: Image,
    /// d loss / d depth.
    pub depth: Image,
}

impl RasterGrad {
    /// Zeros for a raster of this size.
    pub fn zeros(width: usize, height: usize, channels: usize) -> Self {
        Self {
            features: Image::new(width, height, channels),
            opacity: Image::new(width, height, 1),
            depth: Image::new(width, height, 1),
        }
    }
}

/// The reverse of one [`rasterize`] call. It borrows the parameters, so that they cannot change before it is used.
#[derive(Debug)]
pub struct RasterPullback<'a> {
    gaussians: &'a Gaussians,
    projection: Cow<'a, Projection>,
    features: &'a Features,
    lists: Vec<Reached>,
    /// The instruction set of the forward pass: the reverse must see the same bits.
    level: Level,
}

/// Projects and blends `[eq:splat-blend]`.
///
/// Gaussians are blended in the order of their view-space z, ties by index. With `a = opacity · exp(−σ)`: alphas
/// `a < min_alpha` are skipped, `α = min(a, max_alpha)`, and a pixel stops before the Gaussian that would bring its
/// transmittance to `min_transmittance` or below. With [`Cutoff::Smooth`](crate::Cutoff::Smooth) alpha is multiplied by
/// the smoothstep of `(a − min_alpha) / min_alpha` and pixels never stop.
///
/// Bits are the same for any number of threads (on one instruction set).
///
/// # Errors
/// Whatever [`project`](crate::project()) refuses; features whose shape does not fit; visible features that are not finite.
///
/// ```
/// use diamond_camera::{Camera, Intrinsics, Pose};
/// use diamond_splat::{Features, Gaussians, RasterConfig, RasterGrad, rasterize};
/// use glam::{Quat, Vec3};
///
/// let mut gaussians = Gaussians::default();
/// gaussians.push(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.2), Quat::IDENTITY, 0.8);
/// let features = Features { channels: 1, data: vec![0.5] };
/// let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.9, 32, 32), pose: Pose::IDENTITY };
/// let (raster, pullback) = rasterize(&gaussians, &features, &camera, &RasterConfig::default())?;
/// assert!((raster.opacity.pixel(16, 16)[0] - 0.8).abs() < 0.02);
/// let mut d = RasterGrad::zeros(32, 32, 1);
/// d.opacity.data_mut().fill(1.0);
/// assert!(pullback.pull(&d)?.gaussians.opacities[0] > 0.0);
/// # Ok::<(), diamond_splat::SplatError>(())
/// ```
pub fn rasterize<'a>(
    gaussians: &'a Gaussians,
    features: &'a Features,
    camera: &Camera,
    config: &RasterConfig,
) -> Result<(Raster, RasterPullback<'a>), SplatError> {
    let projection = project(gaussians, camera, config)?;
    blend(Cow::Owned(projection), gaussians, features, Level::current())
}

/// [`rasterize`] with a projection that was made before, for callers that compute features of
/// [`visible`](Projection::visible) Gaussians only. `gaussians` must be the ones it was made from; feature rows of
/// invisible Gaussians must exist and are never read.
///
/// # Errors
/// As [`rasterize`].
pub fn rasterize_projected<'a>(
    projection: &'a Projection,
    gaussians: &'a Gaussians,
    features: &'a Features,
) -> Result<(Raster, RasterPullback<'a>), SplatError> {
    blend(Cow::Borrowed(projection), gaussians, features, Level::current())
}

fn blend<'a>(
    projection: Cow<'a, Projection>,
    gaussians: &'a Gaussians,
    features: &'a Features,
    level: Level,
) -> Result<(Raster, RasterPullback<'a>), SplatError> {
    let n = gaussians.len();
    check_same(&projection, n)?;
    let channels = features.channels;
    if features.data.len() != n * channels {
        features.validate(n)?;
    }
    if let Some(&i) = projection.visible().iter().find(|&&i| !features.row(i as usize).iter().all(|v| v.is_finite())) {
        return Err(SplatError::NonFinite { what: "Features::data (row of Gaussian)", index: i as usize });
    }
    let k = &projection.camera.intrinsics;
    let (width, height) = (k.width as usize, k.height as usize);
    let scene = scene(&projection, features, level);
    let regions: Vec<RegionImage> = (0..projection.bins.regions)
        .into_par_iter()
        .map(|region| with_scratch(|scratch| level.dispatch(RegionForward { scene: &scene, region, scratch })))
        .collect();
    let mut raster = Raster {
        features: Image::new(width, height, channels),
        opacity: Image::new(width, height, 1),
        depth: Image::new(width, height, 1),
        stats: RasterStats { visible: projection.visible().len(), ..Default::default() },
    };
    assemble(&mut raster, &scene, &regions);
    let work = regions.iter().map(|region| region.work);
    raster.stats.block_entries = work.clone().map(|w| w.entries).sum();
    raster.stats.evaluated_pairs = work.clone().map(|w| w.evaluated).sum();
    raster.stats.blended_pairs = projection.config.count_blended.then(|| work.map(|w| w.blended).sum());
    let take_lists = |region: RegionImage| {
        FLOATS.give(region.data);
        region.lists
    };
    let lists = regions.into_iter().map(take_lists).collect();
    Ok((raster, RasterPullback { gaussians, features, projection, lists, level }))
}

/// Whether the projection is one of so many Gaussians.
pub(crate) fn check_same(projection: &Projection, gaussians: usize) -> Result<(), SplatError> {
    let found = projection.radii().len();
    if found == gaussians {
        return Ok(());
    }
    let expected = format!("{gaussians} Gaussians");
    Err(SplatError::Shape { what: "Projection (of other Gaussians)", expected, found: found.to_string() })
}

/// Copies the regions into the images.
fn assemble(raster: &mut Raster, scene: &Scene, regions: &[RegionImage]) {
    let (width, channels) = (scene.width, scene.channels);
    let columns = width.div_ceil(REGION[0]);
    let band = width * REGION[1];
    // Zero channels: every band gets an empty piece.
    let mut features: Vec<&mut [f32]> = raster.features.data_mut().chunks_mut((band * channels).max(1)).collect();
    features.resize_with(scene.height.div_ceil(REGION[1]), Default::default);
    (features, raster.opacity.data_mut().par_chunks_mut(band), raster.depth.data_mut().par_chunks_mut(band))
        .into_par_iter()
        .enumerate()
        .for_each(|(y, (features, opacity, depth))| {
            for x in 0..columns {
                let region = y * columns + x;
                let data = &regions[region].data;
                if data.is_empty() {
                    continue;
                }
                let [w, h] = scene.region_size(region);
                let (from_features, rest) = data.split_at(w * h * channels);
                let (from_opacity, from_depth) = rest.split_at(w * h);
                for line in 0..h {
                    let (to, from) = (line * width + x * REGION[0], line * w);
                    features[to * channels..(to + w) * channels]
                        .copy_from_slice(&from_features[from * channels..(from + w) * channels]);
                    opacity[to..to + w].copy_from_slice(&from_opacity[from..from + w]);
                    depth[to..to + w].copy_from_slice(&from_depth[from..from + w]);
                }
            }
        });
}

/// Runs `f` with the buffers of this thread.
pub(crate) fn with_scratch<T>(f: impl FnOnce(&mut Scratch) -> T) -> T {
    thread_local! {
        static SCRATCH: RefCell<Scratch> = RefCell::default();
    }
    SCRATCH.with_borrow_mut(f)
}

pub(crate) fn scene<'a>(projection: &'a Projection, features: &'a Features, level: Level) -> Scene<'a> {
    let config = &projection.config;
    let smooth = is_smooth(config);
    Scene {
        bins: &projection.bins,
        features,
        stride: stride(features.channels, level),
        channels: features.channels,
        limits: Thresholds {
            min_alpha: config.min_alpha,
            max_alpha: config.max_alpha,
            min_transmittance: if smooth { -1.0 } else { config.min_transmittance },
        },
        smooth,
        count: config.count_blended,
        keep: false,
        width: projection.camera.intrinsics.width as usize,
        height: projection.camera.intrinsics.height as usize,
    }
}

/// Values per splat in a region's copy of the features.
fn stride(channels: usize, level: Level) -> usize {
    (channels + 1).next_multiple_of(level.width().max(GEOMETRY))
}

impl RasterPullback<'_> {
    /// The projection that was rendered.
    pub fn projection(&self) -> &Projection {
        &self.projection
    }

    /// Cotangents of the images to gradients of Gaussians and features; zero for what is not visible.
    ///
    /// # Errors
    /// Images of the wrong shape, or with values that are not finite.
    pub fn pull(&self, d: &RasterGrad) -> Result<RasterPull, SplatError> {
        let k = &self.projection.camera.intrinsics;
        let (width, height) = (k.width as usize, k.height as usize);
        check(&d.features, (width, height, self.features.channels), "RasterGrad::features")?;
        check(&d.opacity, (width, height, 1), "RasterGrad::opacity")?;
        check(&d.depth, (width, height, 1), "RasterGrad::depth")?;
        let scene = scene(&self.projection, self.features, self.level);
        let parts: Vec<Vec<f32>> = self
            .lists
            .par_iter()
            .enumerate()
            .map(|(region, lists)| {
                with_scratch(|scratch| self.level.dispatch(RegionBackward { scene: &scene, region, lists, scratch, d }))
            })
            .collect();
        let pull = self.gather(&parts);
        parts.into_iter().for_each(|part| FLOATS.give(part));
        Ok(pull)
    }

    /// Sums the regions' contributions per splat, in order of regions, and pulls them through the projection.
    fn gather(&self, parts: &[Vec<f32>]) -> RasterPull {
        let n = self.gaussians.len();
        let channels = self.features.channels;
        let line = GEOMETRY + stride(channels, self.level);
        let view = View::new(&self.projection.camera);
        let mut g = GaussiansGrad::zeros(n);
        g.factors = vec![LowerFactor::default(); self.gaussians.factors.len()];
        let mut factor_pieces: Vec<&mut [LowerFactor]> = g.factors.chunks_mut(CHUNK).collect();
        factor_pieces.resize_with(n.div_ceil(CHUNK), Default::default);
        let mut screen = vec![Vec2::ZERO; n];
        let mut d_features = vec![0.0; n * channels];
        let mut feature_pieces: Vec<&mut [f32]> = d_features.chunks_mut((CHUNK * channels).max(1)).collect();
        feature_pieces.resize_with(n.div_ceil(CHUNK), Default::default);
        (
            g.means.par_chunks_mut(CHUNK),
            g.scales.par_chunks_mut(CHUNK),
            g.rotations.par_chunks_mut(CHUNK),
            factor_pieces,
            g.opacities.par_chunks_mut(CHUNK),
            screen.par_chunks_mut(CHUNK),
            feature_pieces,
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(run, (means, scales, rotations, factors, opacities, screen, features))| {
                let to = RunGrad { means, scales, rotations, factors, opacities, screen, features };
                self.level.dispatch(GatherRun { pullback: self, parts, view: &view, line, run, to });
            });
        RasterPull { gaussians: g, features: d_features, screen }
    }
}

/// Where the gradient of one run's Gaussians goes.
struct RunGrad<'a> {
    means: &'a mut [Vec3],
    scales: &'a mut [Vec3],
    rotations: &'a mut [Vec4],
    factors: &'a mut [LowerFactor],
    opacities: &'a mut [f32],
    screen: &'a mut [Vec2],
    features: &'a mut [f32],
}

/// The gradient of one run, compiled for the instruction set.
struct GatherRun<'a> {
    pullback: &'a RasterPullback<'a>,
    /// By region: slots × line.
    parts: &'a [Vec<f32>],
    view: &'a View,
    line: usize,
    run: usize,
    to: RunGrad<'a>,
}

impl diamond_simd::WithSimd for GatherRun<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: diamond_simd::Simd>(self, _: S) {
        let GatherRun { pullback, parts, view, line, run, to } = self;
        let bins = &pullback.projection.bins;
        let channels = pullback.features.channels;
        let splats = &bins.runs[run].splats;
        let mut sums = vec![0.0f32; splats.len() * line];
        bins.for_each_place(run, |splat, region, slot| {
            let from = &parts[region][slot * line..][..line];
            sums[splat * line..][..line].iter_mut().zip(from).for_each(|(a, b)| *a += b);
        });
        for (first, splats) in (0..splats.len()).step_by(WIDTH).zip(splats.chunks(WIDTH)) {
            // The last stands in for those beyond the end.
            let mut four = [0; WIDTH];
            let mut footprints = [FootprintGrad::default(); WIDTH];
            for k in 0..WIDTH {
                let last = k.min(splats.len() - 1);
                let (moments, features) = sums[(first + last) * line..][..line].split_at(GEOMETRY);
                four[k] = splats[last].gaussian as usize;
                footprints[k] = footprint_grad(moments, splats[last].chol, features[channels] as f64);
            }
            let pulled = project_pull(pullback.gaussians, four, view, &footprints);
            for (k, splat) in splats.iter().enumerate() {
                let (i, d) = (four[k] - run * CHUNK, &pulled[k]);
                let (moments, features) = sums[(first + k) * line..][..line].split_at(GEOMETRY);
                (to.means[i], to.scales[i], to.rotations[i]) = (d.mean, d.scale, d.rotation);
                if let Some(factor) = to.factors.get_mut(i) {
                    *factor = d.factor;
                }
                to.opacities[i] = finite_f32(moments[0] as f64 / splat.opacity as f64);
                to.screen[i] = Vec2::from_array(footprints[k].mean.map(finite_f32));
                to.features[i * channels..(i + 1) * channels].copy_from_slice(&features[..channels]);
            }
        }
    }
}

/// Whitened moments to the cotangent of mean and covariance `[eq:splat-footprint-pull]`:
/// `d/d mean = L Σ g w`, `d/d Σ = ½ L (Σ g w wᵀ) Lᵀ` with `w = Lᵀd`.
#[inline(always)]
fn footprint_grad(moments: &[f32], [l11, l21, l22]: [f64; 3], d_depth: f64) -> FootprintGrad {
    let (inv, half) = (1.0 / KAPPA2.sqrt(), 0.5 / KAPPA2);
    let [u, v] = [moments[1], moments[2]].map(|m| m as f64 * inv);
    let [uu, uv, vv] = [moments[3], moments[4], moments[5]].map(|m| m as f64 * half);
    FootprintGrad {
        mean: [l11 * u, l21 * u + l22 * v],
        cov: [l11 * l11 * uu, l11 * (l21 * uu + l22 * uv), l21 * l21 * uu + 2.0 * l21 * l22 * uv + l22 * l22 * vv],
        depth: d_depth,
    }
}

fn check(image: &Image, shape: (usize, usize, usize), what: &'static str) -> Result<(), SplatError> {
    if image.shape() != shape {
        return Err(SplatError::Shape { what, expected: format!("{shape:?}"), found: format!("{:?}", image.shape()) });
    }
    // Infinity and NaN have the largest exponents. A maximum of integers is something that compilers vectorise.
    let largest = image.data().iter().fold(0u32, |m, v| m.max(v.to_bits() & 0x7FFF_FFFF));
    let finite = f32::from_bits(largest).is_finite();
    if finite {
        return Ok(());
    }
    let index = image.data().iter().position(|v| !v.is_finite()).unwrap_or(0);
    Err(SplatError::NonFinite { what, index })
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_camera::{Intrinsics, Pose};
    use glam::{Quat, Vec3};

    /// The vector kernels against the same kernels on one lane at a time.
    #[test]
    fn instruction_sets_agree() {
        let mut g = Gaussians::default();
        let mut features = Features { channels: 5, data: Vec::new() };
        for i in 0..400u32 {
            let r = |k: u32| ((i * 13 + k) as f32 * 0.618_034).fract();
            let mean = Vec3::new(r(0) - 0.5, r(1) - 0.5, 0.6 + r(2));
            let scale = Vec3::new(0.004 + 0.1 * r(3), 0.004 + 0.05 * r(4), 0.01);
            g.push(mean, scale, Quat::from_xyzw(r(5) - 0.5, r(6) - 0.5, r(7), 0.3), 0.02 + 0.9 * r(8));
            features.data.extend((0..5).map(|c| r(c + 9) - 0.3));
        }
        let intrinsics = Intrinsics { fx: 50.0, fy: 45.0, cx: 20.3, cy: 18.9, width: 43, height: 37 };
        let camera = Camera { intrinsics, pose: Pose::IDENTITY };
        let projection = project(&g, &camera, &RasterConfig::default()).unwrap();
        let mut d = RasterGrad::zeros(43, 37, 5);
        for image in [&mut d.features, &mut d.opacity, &mut d.depth] {
            image.data_mut().iter_mut().enumerate().for_each(|(i, v)| *v = ((i * 7) % 11) as f32 - 5.0);
        }
        let run = |level| {
            let (raster, pullback) = blend(Cow::Borrowed(&projection), &g, &features, level).unwrap();
            let pull = pullback.pull(&d).unwrap();
            (raster, pull)
        };
        let close = |a: &[f32], b: &[f32], what: &str| {
            let (error, norm) = a.iter().zip(b).fold((0.0f64, 0.0f64), |(e, n), (x, y)| {
                (e + (*x as f64 - *y as f64).powi(2), n + (*y as f64).powi(2))
            });
            assert!(error.sqrt() <= 2e-6 * norm.sqrt(), "{what}: {:.2e}", error.sqrt() / norm.sqrt());
        };
        let flat = |v: &[Vec3]| v.iter().flat_map(|v| v.to_array()).collect::<Vec<f32>>();
        let (b, pull_b) = run(Level::current());
        for level in Level::testable() {
            let (a, pull_a) = run(level);
            close(a.features.data(), b.features.data(), "features");
            close(a.depth.data(), b.depth.data(), "depth");
            close(&pull_a.features, &pull_b.features, "d features");
            close(&pull_a.gaussians.opacities, &pull_b.gaussians.opacities, "d opacities");
            close(&flat(&pull_a.gaussians.means), &flat(&pull_b.gaussians.means), "d means");
            close(&flat(&pull_a.gaussians.scales), &flat(&pull_b.gaussians.scales), "d scales");
            if level.is_fused() == Level::current().is_fused() {
                assert_eq!((a, pull_a), (b.clone(), pull_b.clone()), "same bits at {} lanes", level.width());
            }
        }
    }
}
