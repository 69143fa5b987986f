//! Time of every stage on a GPU, and its growth with Gaussians, pixels, channels and lights: `cargo xtask bench gpu`.
//!
//! On a driver that runs on the CPU the scenes are small, and the numbers say that it runs, not how fast a GPU is.
use clap::Parser;
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_gpu::{Device, DeviceChoice, DeviceRelighter, DeviceStepper, Rasterizer};
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_reconstruct::{
    CaptureFacts, Config, CpuEngine, Engine, InitialPoints, Model, Needs, Renderer, Scene, StepPlan, SubsurfaceModel,
    TrainingPair,
};
use diamond_splat::{Features, Gaussians, RasterConfig, RasterGrad};
use glam::{Quat, Vec3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use xtask::bench::Table;

#[derive(Parser)]
struct Arguments {
    /// gpu, gpu:N or auto
    #[arg(long, default_value = "gpu")]
    device: DeviceChoice,
    /// Runs of each stage
    #[arg(long, default_value_t = 10)]
    repeats: usize,
    /// Where tables are written
    #[arg(long, default_value = "target/bench")]
    output: PathBuf,
    /// Passed by cargo
    #[arg(long, hide = true)]
    bench: bool,
}

fn uniform(rng: &mut ChaCha8Rng, low: f32, high: f32) -> f32 {
    low + (high - low) * ((rng.next_u32() >> 8) as f32 / 16_777_216.0)
}

/// Points in the unit ball.
fn points(n: usize) -> Vec<Vec3> {
    let rng = &mut ChaCha8Rng::seed_from_u64(1);
    let mut out = Vec::with_capacity(n);
    while out.len() < n {
        let p = Vec3::from_array(std::array::from_fn(|_| uniform(rng, -1.0, 1.0)));
        if p.length() < 1.0 {
            out.push(p);
        }
    }
    out
}

/// Standard deviation at which so many Gaussians overlap a little.
fn size(n: usize) -> f32 {
    0.7 / (n as f32).cbrt()
}

fn gaussians(n: usize) -> Gaussians {
    let rng = &mut ChaCha8Rng::seed_from_u64(2);
    let mut g = Gaussians::default();
    for p in points(n) {
        let scale = Vec3::from_array(std::array::from_fn(|_| size(n) * uniform(rng, 0.3, 1.0)));
        let rotation = Quat::from_array(std::array::from_fn(|_| uniform(rng, -1.0, 1.0))).normalize();
        g.push(p, scale, rotation, uniform(rng, 0.05, 0.95));
    }
    g
}

fn camera([width, height]: [u32; 2]) -> Camera {
    let f = 1.2 * width.max(height) as f32;
    let intrinsics = Intrinsics { fx: f, fy: f, cx: 0.5 * width as f32, cy: 0.5 * height as f32, width, height };
    Camera { intrinsics, pose: Pose::look_at(Vec3::new(0.0, -0.4, -3.0), Vec3::ZERO, Vec3::Y) }
}

fn milliseconds(seconds: f64) -> String {
    format!("{:.3}", 1e3 * seconds)
}

/// Time, bytes and pairs of each stage of a picture and its gradient.
fn stages(device: &Arc<Device>, arguments: &Arguments, scenes: &[(usize, [u32; 2], usize)]) -> Result<Table, String> {
    let columns = ["gaussians", "width", "height", "channels", "entries", "stage", "ms", "GB/s", "million entries/s"];
    let context = [("device", device.adapter().name.clone()), ("repeats", arguments.repeats.to_string())];
    let mut table = Table::new("gpu_stages", &columns, &context);
    for &(n, [width, height], channels) in scenes {
        let g = gaussians(n);
        let rng = &mut ChaCha8Rng::seed_from_u64(3);
        let features = Features { channels, data: (0..n * channels).map(|_| uniform(rng, 0.0, 1.0)).collect() };
        let mut d = RasterGrad::zeros(width as usize, height as usize, channels);
        d.features.data_mut().iter_mut().for_each(|v| *v = uniform(rng, -1.0, 1.0));
        let mut rasterizer = Rasterizer::new(device.clone()).map_err(|e| e.to_string())?;
        let config = RasterConfig::default();
        let camera = camera([width, height]);
        let (stats, times) = match rasterizer.time_stages(&g, &features, &camera, &config, &d, arguments.repeats) {
            Ok(times) => times,
            // Too large for this device: said, and the others go on.
            Err(error) => {
                println!("{n} Gaussians, {width} × {height}, {channels} channels: {error}");
                continue;
            }
        };
        let mut total = 0.0;
        let mut row = |name: &str, seconds: f64, bytes: u64| {
            table.push(vec![
                n.to_string(),
                width.to_string(),
                height.to_string(),
                channels.to_string(),
                stats.entries.to_string(),
                name.to_owned(),
                milliseconds(seconds),
                if bytes > 0 { format!("{:.2}", bytes as f64 / seconds / 1e9) } else { String::new() },
                format!("{:.2}", stats.entries as f64 / seconds / 1e6),
            ]);
        };
        for time in &times {
            row(time.name, time.seconds, time.bytes);
            total += time.seconds;
        }
        row("all", total, 0);
    }
    Ok(table)
}

fn model(n: usize) -> Result<Model, String> {
    let mut config = Config::preset("resolved").map_err(|e| e.to_string())?;
    config.subsurface.model = SubsurfaceModel::Mlp;
    config.visibility.traced = false;
    config.density.max_gaussians = n;
    let scene = Scene {
        centre: [0.0; 3],
        radius: 1.1,
        extent: 3.0,
        camera_distance: 3.0,
        light_distance: 3.0,
        light_scale: 2.0,
    };
    let positions = points(n);
    let normals = positions.iter().map(|p| p.normalize_or(Vec3::Z)).collect();
    let points = InitialPoints { positions, normals, ..Default::default() };
    let mut model = Model::initial(&config, scene, &points).map_err(|e| e.to_string())?;
    for i in 0..n {
        let width = size(n);
        model.parameters.set_covariance(i, Vec3::new(width, width, 0.5 * width), Quat::IDENTITY);
    }
    Ok(model)
}

fn light(k: usize) -> OlatLight {
    let angle = k as f32 * 0.7;
    let position = Vec3::new(3.0 * angle.cos(), -1.0 - 0.01 * k as f32, 3.0 * angle.sin());
    OlatLight::Point { position, intensity: Vec3::ONE }
}

/// A training step, and a view under many lights.
fn steps(
    device: &Arc<Device>,
    arguments: &Arguments,
    scenes: &[(usize, [u32; 2])],
    lights: &[usize],
) -> Result<Table, String> {
    let columns = ["gaussians", "width", "height", "what", "lights", "ms"];
    let context = [("device", device.adapter().name.clone()), ("repeats", arguments.repeats.to_string())];
    let mut table = Table::new("gpu_steps", &columns, &context);
    let text = |e: diamond_reconstruct::ReconstructError| e.to_string();
    for &(n, [width, height]) in scenes {
        let model = model(n)?;
        let camera = camera([width, height]);
        let photograph = Image::filled(width as usize, height as usize, 3, 0.25);
        let light_of_pair = light(0);
        let pair = TrainingPair {
            camera: &camera,
            light: &light_of_pair,
            radiance: &photograph,
            mask: None,
            weight: 1.0,
            believed: None,
            content: None,
            view: 0,
            image: 0,
            neighbour: None,
            guide: None,
        };
        let mut row = |what: &str, lights: usize, seconds: f64| {
            let cells = [n.to_string(), width.to_string(), height.to_string(), what.to_owned(), lights.to_string()];
            table.push(cells.into_iter().chain([milliseconds(seconds)]).collect());
        };
        let config = model.config.clone();
        let needs = Needs::decide(&config, &CaptureFacts { views: 3, ..CaptureFacts::default() });
        let mut engine = CpuEngine::with_needs(model.clone(), needs).with_views(3);
        // Steps without density control.
        let plan = |step: u64| StepPlan::new(&config, 6001 + step);
        let stepper = DeviceStepper::new(device.clone()).map_err(|e| e.to_string())?;
        if let Some(lacking) = engine.step_by(Box::new(stepper), &plan(0)) {
            return Err(format!("the device lacks {lacking}"));
        }
        for step in 0..2 {
            engine.training_step(step, &plan(step), &[pair]).map_err(text)?;
        }
        let t = Instant::now();
        for step in 2..2 + arguments.repeats as u64 {
            engine.training_step(step, &plan(step), &[pair]).map_err(text)?;
        }
        row("training step", 1, t.elapsed().as_secs_f64() / arguments.repeats as f64);
        let relighter = DeviceRelighter::new(device.clone()).map_err(|e| e.to_string())?;
        let (renderer, lacking) = Renderer::new(&model).relight_by(Box::new(relighter));
        if let Some(lacking) = lacking {
            return Err(format!("the device lacks {lacking}"));
        }
        let renderer = renderer.with_kept_visibility(1 << 32);
        for &count in lights {
            let lights: Vec<OlatLight> = (0..count).map(light).collect();
            renderer.radiance(&camera, &lights).map_err(text)?;
            let t = Instant::now();
            renderer.radiance(&camera, &lights).map_err(text)?;
            row("a view relit", count, t.elapsed().as_secs_f64());
        }
    }
    Ok(table)
}

fn run() -> Result<(), String> {
    let arguments = Arguments::parse();
    let device = Device::open(arguments.device).map_err(|e| e.to_string())?;
    let device = Arc::new(device.ok_or("no GPU that is not software: name one with --device gpu:N")?);
    let (by_stage, by_step, lights): (Vec<_>, Vec<_>, Vec<usize>) = if device.is_software() {
        println!("{} runs on the CPU: small scenes", device.adapter().name);
        (
            vec![(300, [64, 64], 3), (3000, [64, 64], 3), (3000, [128, 128], 3), (3000, [128, 128], 14)],
            vec![(500, [64, 64]), (5000, [64, 64])],
            vec![1, 8],
        )
    } else {
        let by_gaussians = [10_000, 100_000, 1_000_000, 2_000_000].map(|n| (n, [1024, 1024], 14));
        let by_pixels = [256, 512, 2048].map(|side| (100_000, [side, side], 14));
        let by_channels = [3, 32, 64].map(|channels| (100_000, [1024, 1024], channels));
        let mut all = by_gaussians.to_vec();
        all.extend(by_pixels);
        all.extend(by_channels);
        all.push((1_000_000, [1920, 1080], 3));
        (all, vec![(100_000, [800, 800]), (1_000_000, [1920, 1080])], vec![1, 8, 112])
    };
    for table in [stages(&device, &arguments, &by_stage)?, steps(&device, &arguments, &by_step, &lights)?] {
        for path in table.write(&arguments.output)? {
            println!("{}", path.display());
        }
    }
    Ok(())
}

fn main() -> std::process::ExitCode {
    match run() {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("bench gpu: {error}");
            std::process::ExitCode::FAILURE
        }
    }
}
