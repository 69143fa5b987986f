//! How long the rasteriser takes, on the random scenes that its accuracy is tested with.
//!
//! `cargo run --release -p diamond-splat --example raster_timing [-- N W CHANNELS REPEATS]`
//!
//! Without arguments: "dense" (scales 0.002 to 0.02) and "thin" (0.0005 to 0.005) scenes of 10k and 100k Gaussians at
//! 256² and 512² with 3 channels, and the sizes of a reconstruction step (10k and 50k, 128² and 256², 16 and 24
//! channels). Prints milliseconds, forward and forward + backward: best wall time, and best processor time of all
//! threads together (Linux only; meaningful on a busy machine, where wall time is not).
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_splat::{Features, Gaussians, RasterConfig, RasterGrad, rasterize};
use glam::{Quat, Vec3};
use std::time::Instant;

/// SplitMix64 as numbers in [0, 1) with 24 bits.
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 40) as f64 / (1u64 << 24) as f64
    }
}

/// Means in a unit cube in front of the camera, log-uniform scales, uniform rotations, opacities in [0.02, 0.98].
fn scene(n: usize, smallest: f64, largest: f64, channels: usize) -> (Gaussians, Features) {
    let mut random = Random(42);
    let mut gaussians = Gaussians::default();
    let mut features = Features { channels, data: Vec::with_capacity(n * channels) };
    for _ in 0..n {
        let u: [f64; 13] = std::array::from_fn(|_| random.next());
        let scale = |k: usize| (smallest.ln() + u[k] * (largest.ln() - smallest.ln())).exp() as f32;
        let (a, b) = ((1.0 - u[6]).sqrt(), u[6].sqrt());
        let (t1, t2) = (std::f64::consts::TAU * u[7], std::f64::consts::TAU * u[8]);
        gaussians.push(
            Vec3::new((u[0] - 0.5) as f32, (u[1] - 0.5) as f32, (u[2] + 0.5) as f32),
            Vec3::new(scale(3), scale(4), scale(5)),
            Quat::from_xyzw((a * t1.sin()) as f32, (a * t1.cos()) as f32, (b * t2.sin()) as f32, (b * t2.cos()) as f32),
            (0.02 + 0.96 * u[9]) as f32,
        );
        features.data.extend((0..channels).map(|c| u[10 + c % 3] as f32));
    }
    (gaussians, features)
}

/// Processor time of all threads so far, milliseconds; 0 where the system does not say.
fn processor_ms() -> f64 {
    let Ok(tasks) = std::fs::read_dir("/proc/self/task") else { return 0.0 };
    let of = |task: std::path::PathBuf| -> Option<f64> {
        std::fs::read_to_string(task.join("schedstat")).ok()?.split_whitespace().next()?.parse().ok()
    };
    tasks.flatten().filter_map(|t| of(t.path())).sum::<f64>() * 1e-6
}

fn measure(name: &str, n: usize, side: u32, channels: usize, repeats: usize) {
    let (smallest, largest) = if name == "dense" { (0.002, 0.02) } else { (0.0005, 0.005) };
    let (gaussians, features) = scene(n, smallest, largest, channels);
    let half = 0.5 * side as f32;
    let intrinsics = Intrinsics { fx: side as f32, fy: side as f32, cx: half, cy: half, width: side, height: side };
    let camera = Camera { intrinsics, pose: Pose::IDENTITY };
    let config = RasterConfig {
        max_alpha: 0.999,
        near: 0.01,
        count_blended: std::env::var("COUNT").is_ok(),
        ..Default::default()
    };
    let mut d = RasterGrad::zeros(side as usize, side as usize, channels);
    for image in [&mut d.features, &mut d.opacity, &mut d.depth] {
        image.data_mut().iter_mut().enumerate().for_each(|(i, v)| *v = (i % 7) as f32 - 3.0);
    }
    // Forward wall, forward processor, both wall, both processor.
    let mut best = [f64::MAX; 4];
    let mut stats = Default::default();
    for _ in 0..repeats {
        let (start, used) = (Instant::now(), processor_ms());
        let elapsed = || [start.elapsed().as_secs_f64() * 1e3, processor_ms() - used];
        let Ok((raster, pullback)) = rasterize(&gaussians, &features, &camera, &config) else { return };
        let forward = elapsed();
        if std::env::var("FWD").is_ok() {
            for (b, v) in best.iter_mut().zip(forward) {
                *b = b.min(v);
            }
            std::hint::black_box((&raster, &pullback));
            continue;
        }
        let Ok(pull) = pullback.pull(&d) else { return };
        let both = elapsed();
        for (b, v) in best.iter_mut().zip(forward.into_iter().chain(both)) {
            *b = b.min(v);
        }
        stats = raster.stats;
        std::hint::black_box((raster, pull));
    }
    println!(
        "{name:5} {n:>6} {side:>4}² C={channels:<2} | forward {:7.2} wall {:7.2} cpu | + backward {:7.2} wall {:7.2} cpu | {:6.2} M evaluated, {:6.2} M blended, {:7} block entries",
        best[0],
        best[1],
        best[2],
        best[3],
        stats.evaluated_pairs as f64 * 1e-6,
        stats.blended_pairs.unwrap_or(0) as f64 * 1e-6,
        stats.block_entries
    );
}

/// The blending roofline: pairs per second of one thread on a tile of 8 × 8 pixels with everything in the first cache:
/// offset, conic, 2^x by a polynomial, clamp, threshold, transmittance, three colours.
struct Roofline {
    splats: Vec<[f32; 9]>,
    repeats: usize,
}

impl pulp::WithSimd for Roofline {
    type Output = (f64, f32);

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, s: S) -> (f64, f32) {
        let lanes = S::F32_LANES;
        let side = 8;
        let xs: Vec<f32> = (0..64).map(|i| (i % side) as f32 + 0.5).collect();
        let ys: Vec<f32> = (0..64).map(|i| (i / side) as f32 + 0.5).collect();
        let mut check = 0.0;
        let start = Instant::now();
        for _ in 0..self.repeats {
            let splats = std::hint::black_box(&self.splats);
            for k in 0..64 / lanes {
                let x = S::as_simd_f32s(&xs[k * lanes..]).0[0];
                let y = S::as_simd_f32s(&ys[k * lanes..]).0[0];
                let zero = s.splat_f32s(std::hint::black_box(0.0));
                let (mut t, mut r, mut g, mut b) = (s.splat_f32s(1.0), zero, zero, zero);
                for p in splats {
                    let dx = s.sub_f32s(x, s.splat_f32s(p[0]));
                    let dy = s.sub_f32s(y, s.splat_f32s(p[1]));
                    let q = s.mul_add_f32s(
                        dx,
                        s.mul_add_f32s(s.splat_f32s(p[2]), dx, s.mul_f32s(s.splat_f32s(p[3]), dy)),
                        s.mul_add_f32s(s.mul_f32s(s.splat_f32s(p[4]), dy), dy, s.splat_f32s(p[5])),
                    );
                    let magic = s.splat_f32s(12_582_912.0);
                    let shifted = s.add_f32s(q, magic);
                    let f = s.sub_f32s(q, s.sub_f32s(shifted, magic));
                    let mut e = s.splat_f32s(0.001_327_647_2);
                    for c in [0.009_675_541, 0.055_507_133, 0.240_221_2, 0.693_146_97, 1.000_000_1] {
                        e = s.mul_add_f32s(e, f, s.splat_f32s(c));
                    }
                    let bits = s.wrapping_dyn_shl_u32s(s.transmute_u32s_f32s(shifted), s.splat_u32s(23));
                    let a = s.transmute_f32s_u32s(s.add_u32s(s.transmute_u32s_f32s(e), bits));
                    let a = s.min_f32s(a, s.splat_f32s(0.99));
                    let keep = s.greater_than_or_equal_f32s(a, s.splat_f32s(1.0 / 255.0));
                    let a = s.select_f32s(keep, a, zero);
                    let w = s.mul_f32s(a, t);
                    t = s.sub_f32s(t, w);
                    r = s.mul_add_f32s(w, s.splat_f32s(p[6]), r);
                    g = s.mul_add_f32s(w, s.splat_f32s(p[7]), g);
                    b = s.mul_add_f32s(w, s.splat_f32s(p[8]), b);
                }
                check += s.reduce_sum_f32s(s.add_f32s(s.add_f32s(r, g), s.add_f32s(b, t)));
            }
        }
        let pairs = (self.repeats * self.splats.len() * 64) as f64;
        (pairs / start.elapsed().as_secs_f64(), check)
    }
}

fn roofline() {
    let mut random = Random(7);
    let splats: Vec<[f32; 9]> = (0..64)
        .map(|_| {
            let mut r = || random.next() as f32;
            [8.0 * r(), 8.0 * r(), -0.05 - 0.2 * r(), 0.05 * r(), -0.05 - 0.2 * r(), -4.0 * r(), r(), r(), r()]
        })
        .collect();
    let mut best = 0.0f64;
    for _ in 0..30 {
        let (rate, check) = pulp::Arch::new().dispatch(Roofline { splats: splats.clone(), repeats: 400 });
        std::hint::black_box(check);
        best = best.max(rate);
    }
    println!("roofline: {:.2} G pairs/s on one thread", best * 1e-9);
}

fn main() {
    roofline();
    let arguments: Vec<usize> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    println!("threads: {}; best times in ms", rayon::current_num_threads());
    if let [n, side, channels, repeats] = arguments[..] {
        for name in ["dense", "thin"] {
            measure(name, n, side as u32, channels, repeats);
        }
        return;
    }
    for name in ["dense", "thin"] {
        for n in [10_000, 100_000] {
            for side in [256, 512] {
                measure(name, n, side, 3, 7);
            }
        }
    }
    for (n, side) in [(10_000, 128), (50_000, 128), (10_000, 256), (50_000, 256)] {
        for channels in [16, 24] {
            measure("dense", n, side, channels, 7);
            measure("thin", n, side, channels, 7);
        }
    }
}
