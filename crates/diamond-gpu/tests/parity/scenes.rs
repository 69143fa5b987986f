//! Scenes on which the two sides are compared: random ones, and those in which something is at its limit.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_gpu::RasterScene;
use diamond_splat::{Features, Gaussians, LowerFactor, RasterConfig, RasterGrad};
use glam::{Quat, Vec3};
use rand_pcg::Pcg64Mcg;
use rand_pcg::rand_core::{Rng, SeedableRng};

/// Uniform in [low, high).
pub fn uniform(rng: &mut Pcg64Mcg, low: f32, high: f32) -> f32 {
    low + (high - low) * ((rng.next_u32() >> 8) as f32 / 16_777_216.0)
}

/// What a random scene is like.
struct Cloud {
    n: usize,
    size: [u32; 2],
    channels: usize,
    /// Centres lie in this box, camera at the origin.
    low: Vec3,
    high: Vec3,
    /// Natural logarithms of the standard deviations.
    log_scale: [f32; 2],
    opacity: [f32; 2],
    factors: bool,
}

impl Default for Cloud {
    fn default() -> Self {
        Self {
            n: 300,
            size: [53, 41],
            channels: 5,
            low: Vec3::new(-1.2, -1.0, 1.5),
            high: Vec3::new(1.2, 1.0, 4.0),
            log_scale: [-4.0, -1.5],
            opacity: [0.02, 0.98],
            factors: false,
        }
    }
}

fn scene(seed: u64, cloud: &Cloud) -> RasterScene {
    let rng = &mut Pcg64Mcg::seed_from_u64(seed);
    let mut gaussians = Gaussians::default();
    for _ in 0..cloud.n {
        let [low, high] = [cloud.low, cloud.high];
        let mean = Vec3::from_array(std::array::from_fn(|k| uniform(rng, low[k], high[k])));
        let [small, large] = cloud.log_scale;
        let scale = Vec3::from_array(std::array::from_fn(|_| uniform(rng, small, large))).exp();
        let rotation = Quat::from_array(std::array::from_fn(|_| uniform(rng, -1.0, 1.0)));
        gaussians.push(mean, scale, rotation, uniform(rng, cloud.opacity[0], cloud.opacity[1]));
        if cloud.factors {
            gaussians.factors.push(LowerFactor::from_scale_rotation(scale, rotation));
        }
    }
    gaussians.decompose_factors();
    with_features(rng, gaussians, cloud.size, cloud.channels)
}

fn with_features(rng: &mut Pcg64Mcg, gaussians: Gaussians, size: [u32; 2], channels: usize) -> RasterScene {
    let data = (0..gaussians.len() * channels).map(|_| uniform(rng, -0.3, 1.0)).collect();
    let [width, height] = size;
    let mut d = RasterGrad::zeros(width as usize, height as usize, channels);
    for image in [&mut d.features, &mut d.opacity, &mut d.depth] {
        image.data_mut().iter_mut().for_each(|v| *v = uniform(rng, -1.0, 1.0));
    }
    // Neither square pixels nor a centred principal point.
    let f = 0.9 * width.max(height) as f32;
    let intrinsics =
        Intrinsics { fx: f, fy: 0.93 * f, cx: 0.48 * width as f32, cy: 0.53 * height as f32, width, height };
    let pose = Pose::look_at(Vec3::new(0.05, -0.02, -0.1), Vec3::new(0.0, 0.0, 2.5), Vec3::Y);
    RasterScene {
        gaussians,
        features: Features { channels, data },
        camera: Camera { intrinsics, pose },
        config: RasterConfig::default(),
        d,
    }
}

/// Gaussians at the edges of what is allowed.
fn odd() -> RasterScene {
    let rng = &mut Pcg64Mcg::seed_from_u64(8);
    let mut g = Gaussians::default();
    let q = Quat::from_xyzw(0.1, -0.4, 0.3, 0.8);
    // A speck, a sheet, a needle, nothing at all, larger than the picture, behind, at the near plane, far outside.
    g.push(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(1e-7), q, 0.9);
    g.push(Vec3::new(0.3, 0.1, 2.5), Vec3::new(0.5, 0.5, 0.0), q, 0.7);
    g.push(Vec3::new(-0.2, 0.3, 2.2), Vec3::new(1.5, 1e-4, 1e-4), q, 0.8);
    g.push(Vec3::new(0.2, -0.3, 2.1), Vec3::ZERO, q, 1.0);
    g.push(Vec3::new(0.0, 0.1, 3.0), Vec3::splat(30.0), q, 0.4);
    g.push(Vec3::new(0.0, 0.0, -2.0), Vec3::splat(0.3), q, 0.9);
    g.push(Vec3::new(0.01, 0.0, 0.099_9), Vec3::splat(0.01), q, 0.9);
    g.push(Vec3::new(0.01, 0.0, 0.100_1), Vec3::splat(0.01), q, 0.5);
    g.push(Vec3::new(500.0, 0.0, 2.0), Vec3::splat(0.3), q, 0.9);
    g.push(Vec3::new(3.0, 0.5, 0.4), Vec3::splat(0.6), q, 0.6);
    // Quaternions of no direction and of any length; opacities at the threshold and at nothing.
    g.push(Vec3::new(-0.3, -0.2, 2.3), Vec3::new(0.1, 0.05, 0.2), Quat::from_xyzw(0.0, 0.0, 0.0, 0.0), 0.6);
    g.push(Vec3::new(-0.4, 0.2, 2.4), Vec3::new(0.1, 0.05, 0.2), Quat::from_xyzw(1e-13, 0.0, 0.0, 0.0), 0.6);
    g.push(Vec3::new(0.4, 0.2, 2.6), Vec3::new(0.1, 0.05, 0.2), Quat::from_xyzw(3e15, -1e15, 2e15, 1e15), 0.6);
    g.push(Vec3::new(0.4, -0.2, 2.7), Vec3::new(0.1, 0.2, 0.3), Quat::from_xyzw(3e-9, -1e-9, 2e-9, 1e-9), 0.6);
    g.push(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.2), q, 1.0 / 255.0);
    g.push(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.2), q, 0.003);
    g.push(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.2), q, 0.0);
    // As large as numbers go.
    g.push(Vec3::new(1e8, 1e8, 1e9), Vec3::splat(1e8), q, 0.5);
    with_features(rng, g, [37, 50], 3)
}

/// Every scene, with its name.
pub fn all() -> Vec<(&'static str, RasterScene)> {
    let cloud = Cloud::default;
    let inside =
        Cloud { low: Vec3::splat(-1.0), high: Vec3::splat(1.0), log_scale: [-4.0, -2.0], size: [40, 40], ..cloud() };
    let mut coincident = scene(5, &Cloud { n: 90, opacity: [0.3, 0.9], ..cloud() });
    coincident.gaussians.means.iter_mut().for_each(|mean| *mean = Vec3::new(0.1, -0.1, 2.0));
    let mut needles = scene(3, &Cloud { n: 120, log_scale: [-6.5, -5.5], opacity: [0.2, 0.9], ..cloud() });
    needles.gaussians.scales.iter_mut().enumerate().for_each(|(i, scale)| scale[i % 3] = 0.5);
    vec![
        ("random", scene(1, &cloud())),
        ("factors", scene(2, &Cloud { factors: true, channels: 3, ..cloud() })),
        ("needles", needles),
        ("camera inside", scene(4, &inside)),
        ("coincident", coincident),
        ("opaque", scene(6, &Cloud { opacity: [0.97, 1.0], log_scale: [-3.0, -1.0], ..cloud() })),
        ("one pixel", scene(7, &Cloud { size: [1, 1], log_scale: [-1.5, 0.0], ..cloud() })),
        ("odd", odd()),
        ("empty", scene(9, &Cloud { n: 0, ..cloud() })),
        ("no channels", scene(10, &Cloud { channels: 0, n: 40, ..cloud() })),
        ("many tiles", scene(11, &Cloud { n: 60, size: [300, 290], channels: 2, log_scale: [-4.0, -2.5], ..cloud() })),
        ("sixteen channels", scene(12, &Cloud { n: 100, channels: 16, ..cloud() })),
    ]
}

/// More channels than go through the kernels together.
pub fn in_pieces() -> RasterScene {
    scene(13, &Cloud { n: 100, channels: 37, ..Cloud::default() })
}

/// More Gaussians than one block of a sort holds, and more than one digit of tiles.
pub fn large() -> RasterScene {
    scene(14, &Cloud { n: 6000, size: [128, 128], channels: 3, log_scale: [-5.0, -3.5], ..Cloud::default() })
}
