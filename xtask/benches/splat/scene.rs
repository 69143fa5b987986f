//! Random scenes that any language can reproduce.
//!
//! SplitMix64 from the seed, numbers `(next >> 40) · 2⁻²⁴`, thirteen per Gaussian: mean x, y in [−½, ½], z in [½, 1½];
//! three scales, log-uniform; a uniform rotation from three numbers (Shoemake); opacity in [0.02, 0.98]; three colours.
//! The camera is at the origin and looks along +z with a focal length of one image width.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_splat::{Features, Gaussians, RasterConfig};
use glam::{Quat, Vec3};

/// Seed of all scenes.
pub const SEED: u64 = 42;
/// Smallest and largest scale of a dense scene, scene units.
pub const DENSE: [f64; 2] = [0.002, 0.02];
/// Smallest and largest scale of a thin scene, scene units.
pub const THIN: [f64; 2] = [0.0005, 0.005];
/// Kind, Gaussians and side in pixels of the scenes that every version is measured with.
pub const EIGHT: [&str; 8] = [
    "dense 10k 256²",
    "dense 10k 512²",
    "dense 100k 256²",
    "dense 100k 512²",
    "thin 10k 256²",
    "thin 10k 512²",
    "thin 100k 256²",
    "thin 100k 512²",
];

/// A scene with its camera and the settings that the reference images were made with.
pub struct BenchScene {
    pub gaussians: Gaussians,
    pub features: Features,
    pub camera: Camera,
    pub config: RasterConfig,
}

struct SplitMix(u64);

impl SplitMix {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 40) as f64 / (1u64 << 24) as f64
    }
}

impl BenchScene {
    /// One of [`EIGHT`].
    pub fn named(name: &str) -> Result<Self, String> {
        let mut words = name.split(' ');
        let mut next = || words.next().ok_or_else(|| format!("{name}: not the name of a scene"));
        let scales = if next()? == "dense" { DENSE } else { THIN };
        let n = if next()? == "10k" { 10_000 } else { 100_000 };
        let side = if next()? == "256²" { 256 } else { 512 };
        Ok(Self::new(n, side, 3, scales))
    }

    /// `n` Gaussians in an image of `side`² pixels; channels beyond three repeat the colours.
    pub fn new(n: usize, side: u32, channels: usize, [smallest, largest]: [f64; 2]) -> Self {
        let mut random = SplitMix(SEED);
        let mut gaussians = Gaussians::default();
        let mut features = Features { channels, data: Vec::with_capacity(n * channels) };
        for _ in 0..n {
            let u: [f64; 13] = std::array::from_fn(|_| random.next());
            let scale = |k: usize| (smallest.ln() + u[k] * (largest.ln() - smallest.ln())).exp() as f32;
            let (a, b) = ((1.0 - u[6]).sqrt(), u[6].sqrt());
            let (t1, t2) = (std::f64::consts::TAU * u[7], std::f64::consts::TAU * u[8]);
            let [x, y, z, w] = [a * t1.sin(), a * t1.cos(), b * t2.sin(), b * t2.cos()].map(|v| v as f32);
            gaussians.push(
                Vec3::new((u[0] - 0.5) as f32, (u[1] - 0.5) as f32, (u[2] + 0.5) as f32),
                Vec3::new(scale(3), scale(4), scale(5)),
                Quat::from_xyzw(x, y, z, w),
                (0.02 + 0.96 * u[9]) as f32,
            );
            features.data.extend((0..channels).map(|c| u[10 + c % 3] as f32));
        }
        let half = 0.5 * side as f32;
        let intrinsics = Intrinsics { fx: side as f32, fy: side as f32, cx: half, cy: half, width: side, height: side };
        let camera = Camera { intrinsics, pose: Pose::IDENTITY };
        let config = RasterConfig { max_alpha: 0.999, near: 0.01, ..Default::default() };
        Self { gaussians, features, camera, config }
    }
}
