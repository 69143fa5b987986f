//! `cargo xtask bench splat`: the rasteriser, forward and forward + backward, time and error on the same line.
//!
//! Each of the eight scenes (see [`scene`]) is timed on a pool of `--threads` threads beside the blending roofline of the
//! same threads, measured right before and after; its errors are taken on some pixels against the oracle in f64 (see
//! [`error`]). Then growth: Gaussians, pixels and channels over a factor of 64, with fitted exponents and peak memory.
mod error;
mod roofline;
mod scene;

use clap::Parser;
use diamond_splat::{RasterGrad, rasterize};
use scene::BenchScene;
use std::hint::black_box;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;
use xtask::bench::{Table, exponent, median, memory, time};

/// Wall milliseconds of OpenSplat 1.2 on two threads of an idle Zen 4 server, forward and forward + backward, in the
/// order of [`scene::EIGHT`]: another machine, hence a comparison of orders of magnitude only.
const OPENSPLAT_MS: [[f64; 2]; 8] = [
    [26.0, 61.0],
    [87.0, 206.0],
    [149.0, 287.0],
    [442.0, 863.0],
    [13.0, 25.0],
    [22.0, 53.0],
    [83.0, 164.0],
    [141.0, 294.0],
];

/// The rasteriser: time, pairs per second, share of the blending roofline, error against f64, growth.
#[derive(Parser)]
struct Arguments {
    /// Threads.
    #[arg(long, default_value_t = 2)]
    threads: usize,
    /// Repeats at least.
    #[arg(long, default_value_t = 7)]
    least: usize,
    /// Seconds of repeats per scene and direction.
    #[arg(long, default_value_t = 1.5)]
    seconds: f64,
    /// Only scenes whose name contains this; no growth.
    #[arg(long)]
    only: Option<String>,
    /// Forward only and no errors: for a profiler.
    #[arg(long)]
    forward_only: bool,
    /// Folder of the CSV and JSON files.
    #[arg(long, default_value = "out/bench")]
    out: PathBuf,
    /// One forward and backward pass of so many Gaussians, side, channels; prints the peak of resident memory, MB.
    #[arg(long, hide = true, value_delimiter = ',')]
    peak_of: Vec<usize>,
    /// Given by `cargo bench`; without meaning.
    #[arg(long, hide = true)]
    bench: bool,
}

impl Arguments {
    /// The same with less time for each scene.
    fn short(&self) -> Self {
        let (only, out, peak_of) = (self.only.clone(), self.out.clone(), Vec::new());
        Self { seconds: 0.3 * self.seconds, only, out, peak_of, ..*self }
    }
}

/// Peak of resident memory, MB, of a process of its own that renders once forward and backward.
fn peak_of(gaussians: usize, side: usize, channels: usize, threads: usize) -> Option<f64> {
    let of = format!("{gaussians},{side},{channels}");
    let arguments = ["--peak-of", &of, "--threads", &threads.to_string()].map(str::to_owned);
    let out = std::process::Command::new(std::env::current_exe().ok()?).args(arguments).output().ok()?;
    String::from_utf8_lossy(&out.stdout).trim().parse().ok()
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("bench splat: {message}");
            ExitCode::from(1)
        }
    }
}

fn run(arguments: &Arguments) -> Result<(), String> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(arguments.threads).build().map_err(|e| e.to_string())?;
    pool.install(|| {
        if let [gaussians, side, channels] = arguments.peak_of[..] {
            let scene = BenchScene::new(gaussians, side as u32, channels, scene::DENSE);
            measure(&scene, &Arguments { seconds: 0.0, least: 1, ..arguments.short() })?;
            println!("{}", memory().map_or(f64::NAN, |(peak, _)| peak));
            return Ok(());
        }
        eight(arguments)?;
        if arguments.only.is_none() && !arguments.forward_only { growth(arguments) } else { Ok(()) }
    })
}

/// Seconds of the forward pass, and of forward and backward together.
fn measure(scene: &BenchScene, arguments: &Arguments) -> Result<[Vec<f64>; 2], String> {
    let budget = Duration::from_secs_f64(arguments.seconds);
    let (gaussians, features) = (&scene.gaussians, &scene.features);
    let side = scene.camera.intrinsics.width as usize;
    let mut d = RasterGrad::zeros(side, side, features.channels);
    for image in [&mut d.features, &mut d.opacity, &mut d.depth] {
        image.data_mut().iter_mut().enumerate().for_each(|(i, v)| *v = (i % 7) as f32 - 3.0);
    }
    let forward = || rasterize(gaussians, features, &scene.camera, &scene.config);
    forward().map_err(|e| e.to_string())?.1.pull(&d).map_err(|e| e.to_string())?;
    let one = time(budget, arguments.least, || {
        let _ = black_box(forward());
    });
    if arguments.forward_only {
        return Ok([one.clone(), one]);
    }
    let both = time(budget, arguments.least, || {
        if let Ok((raster, pullback)) = forward() {
            let _ = black_box((raster, pullback.pull(&d)));
        }
    });
    Ok([one, both])
}

fn eight(arguments: &Arguments) -> Result<(), String> {
    let context = [
        ("threads", arguments.threads.to_string()),
        ("seed", scene::SEED.to_string()),
        ("instruction set", diamond_simd::current().to_string()),
    ];
    let columns = [
        "scene",
        "forward ms (median)",
        "forward ms (best)",
        "both ms (median)",
        "both ms (best)",
        "M pairs blended",
        "M pairs evaluated",
        "G pairs/s (best)",
        "roofline G pairs/s",
        "forward % of roofline (best)",
        "OpenSplat / ours, forward",
        "OpenSplat / ours, both",
        "image error",
        "gradient error",
        "pixels compared",
    ];
    let mut table = Table::new("splat", &columns, &context);
    for (name, peer) in scene::EIGHT.iter().zip(OPENSPLAT_MS) {
        if arguments.only.as_ref().is_some_and(|only| !name.contains(only.as_str())) {
            continue;
        }
        let scene = BenchScene::named(name)?;
        let before = roofline::pairs_per_second();
        let [forward, both] = measure(&scene, arguments)?;
        let roof = before.max(roofline::pairs_per_second());
        let counted = diamond_splat::RasterConfig { count_blended: true, ..scene.config };
        let (raster, _) =
            rasterize(&scene.gaussians, &scene.features, &scene.camera, &counted).map_err(|e| e.to_string())?;
        let blended = raster.stats.blended_pairs.unwrap_or(0) as f64;
        let errors = if arguments.forward_only || std::env::var("NOERR").is_ok() {
            None
        } else {
            Some(error::against_f64(&scene)?)
        };
        let best = |seconds: &[f64]| seconds.iter().copied().fold(f64::MAX, f64::min);
        let number = |v: f64| format!("{v:.2}");
        let share = 100.0 * blended / best(&forward) / roof;
        table.push(vec![
            name.to_string(),
            number(median(&forward) * 1e3),
            number(best(&forward) * 1e3),
            number(median(&both) * 1e3),
            number(best(&both) * 1e3),
            number(blended * 1e-6),
            number(raster.stats.evaluated_pairs as f64 * 1e-6),
            number(blended / best(&forward) * 1e-9),
            number(roof * 1e-9),
            format!("{share:.1}"),
            format!("{:.1}", peer[0] * 1e-3 / median(&forward)),
            format!("{:.1}", peer[1] * 1e-3 / median(&both)),
            errors.as_ref().map_or("-".into(), |e| format!("{:.1e}", e.image)),
            errors.as_ref().map_or("-".into(), |e| format!("{:.1e}", e.gradient)),
            errors.as_ref().map_or("-".into(), |e| e.pixels.to_string()),
        ]);
    }
    let files = table.write(&arguments.out)?;
    println!("wrote {} and {}", files[0].display(), files[1].display());
    Ok(())
}

fn growth(arguments: &Arguments) -> Result<(), String> {
    let context = [("threads", arguments.threads.to_string()), ("seed", scene::SEED.to_string())];
    let columns = ["of", "value", "forward ms", "both ms", "peak MB (process of its own, scene included)"];
    let mut table = Table::new("splat-growth", &columns, &context);
    let short = arguments.short();
    // What a process takes that renders next to nothing.
    let base = peak_of(1, 8, 1, arguments.threads);
    let mut exponents = Vec::new();
    let axes: [(&str, &[usize]); 3] = [
        ("Gaussians", &[4_000, 16_000, 64_000, 256_000]),
        ("pixels", &[16_384, 65_536, 262_144, 1_048_576]),
        ("channels", &[1, 4, 16, 64]),
    ];
    for (axis, values) in axes {
        let mut points = [Vec::new(), Vec::new(), Vec::new()];
        for &value in values {
            let (gaussians, side, channels) = match axis {
                "Gaussians" => (value, 512, 3),
                "pixels" => (20_000, (value as f64).sqrt() as usize, 3),
                _ => (20_000, 256, value),
            };
            let scene = BenchScene::new(gaussians, side as u32, channels, scene::DENSE);
            let [forward, both] = measure(&scene, &short)?;
            let peak = base.zip(peak_of(gaussians, side, channels, arguments.threads)).map(|(base, peak)| peak - base);
            let x = value as f64;
            points[0].push((x, median(&forward)));
            points[1].push((x, median(&both)));
            points[2].push((x, peak.unwrap_or(f64::NAN).max(0.1)));
            table.push(vec![
                axis.into(),
                value.to_string(),
                format!("{:.2}", median(&forward) * 1e3),
                format!("{:.2}", median(&both) * 1e3),
                peak.map_or("-".into(), |p| format!("{p:.1}")),
            ]);
        }
        exponents.push((axis, points.map(|p| exponent(&p))));
    }
    for (axis, [forward, both, peak]) in exponents {
        table.push(vec![
            format!("{axis}, exponent"),
            "-".into(),
            format!("{forward:.2}"),
            format!("{both:.2}"),
            format!("{peak:.2}"),
        ]);
    }
    let files = table.write(&arguments.out)?;
    println!("wrote {} and {}", files[0].display(), files[1].display());
    Ok(())
}
