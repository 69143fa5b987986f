//! Time of one view under 1, 2, 4, … lights: what a further light costs beside the first.
//! `cargo run --release -p diamond-reconstruct --example light_scaling -- CAPTURE [STEPS [WIDTH]]` trains briefly first; given the
//! folder of a finished run instead of a capture, it renders that model from a camera of its own. Times are of the
//! processors, all threads together, where the system tells (Linux): other programs on the machine lengthen wall time.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_dataset::{Capture, OpenOptions};
use diamond_light::OlatLight;
use diamond_reconstruct::{Config, Model, Reconstruction, Renderer};
use glam::Vec3;
use std::path::Path;
use std::time::Instant;

type Failure = Box<dyn std::error::Error>;

/// Repetitions of each measurement; the median is shown.
const REPETITIONS: usize = 9;

/// Seconds that the processors have spent on this program, where the system says.
fn processor_seconds() -> Option<f64> {
    let mut nanoseconds = 0u64;
    for task in std::fs::read_dir("/proc/self/task").ok()? {
        let text = std::fs::read_to_string(task.ok()?.path().join("schedstat")).ok()?;
        nanoseconds += text.split_whitespace().next()?.parse::<u64>().ok()?;
    }
    Some(nanoseconds as f64 * 1e-9)
}

fn median(mut f: impl FnMut() -> Result<(), Failure>) -> Result<f64, Failure> {
    let mut times = Vec::new();
    for _ in 0..REPETITIONS {
        let (start, processors) = (Instant::now(), processor_seconds());
        f()?;
        times.push(match (processors, processor_seconds()) {
            (Some(before), Some(after)) => after - before,
            _ => start.elapsed().as_secs_f64(),
        });
    }
    times.sort_by(f64::total_cmp);
    Ok(1e3 * times[REPETITIONS / 2])
}

/// `n` directions spread evenly over the sphere.
fn directions(n: usize) -> impl Iterator<Item = Vec3> {
    (0..n).map(move |i| {
        let z = 1.0 - (2 * i + 1) as f32 / n as f32;
        let (sin, cos) = (i as f32 * 2.399_963).sin_cos();
        let r = (1.0 - z * z).sqrt();
        Vec3::new(r * cos, r * sin, z)
    })
}

fn trained(folder: &Path, steps: u64, width: u32) -> Result<(Model, Camera), Failure> {
    if folder.join("model.ply").exists() {
        let model = Model::load(folder)?;
        let eye = model.scene.centre() + model.scene.camera_distance * Vec3::new(0.8, 0.55, 0.24);
        let pose = Pose::look_at(eye, model.scene.centre(), Vec3::Z);
        return Ok((model, Camera { intrinsics: Intrinsics::from_fov_x(0.61, width, width), pose }));
    }
    let mut config = Config::preset("resolved")?;
    config.steps = steps;
    let mut run = Reconstruction::new(Capture::open(folder, &OpenOptions::default())?, &config)?;
    while !run.finished() {
        run.step()?;
    }
    let camera = run.capture().train[0].camera;
    Ok((run.model()?.clone(), camera))
}

fn main() -> Result<(), Failure> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let folder = args.first().ok_or("usage: light_scaling CAPTURE_OR_RUN [STEPS [WIDTH]]")?;
    let number = |k: usize, default: usize| args.get(k).map_or(Ok(default), |s| s.parse());
    let (model, camera) = trained(Path::new(folder), number(1, 300)? as u64, number(2, 128)? as u32)?;
    let distance = model.scene.light_distance;
    let lights: Vec<OlatLight> = directions(112)
        .map(|d| OlatLight::Point { position: model.scene.centre() + distance * d, intensity: Vec3::ONE })
        .collect();
    println!("{:?}", Renderer::new(&model).work(&camera, 112)?);
    // A renderer for each repetition: what it does once per model counts too.
    let one = median(|| Ok(Renderer::new(&model).radiance(&camera, &lights[..1]).map(drop)?))?;
    for n in [1, 4, 16, 112] {
        let time = median(|| Ok(Renderer::new(&model).radiance(&camera, &lights[..n]).map(drop)?))?;
        println!("{n:4} lights {time:8.2} ms  {:6.2} × one light  {:6.3} ms each", time / one, time / n as f64);
    }
    let mut untraced = model.clone();
    untraced.config.visibility.traced = false;
    let of = |n: usize| median(|| Ok(Renderer::new(&untraced).radiance(&camera, &lights[..n]).map(drop)?));
    let (first, all) = (of(1)?, of(112)?);
    println!("with fitted visibility, 1 light {first:8.2} ms, 112 lights {all:8.2} ms, {:6.2} ×", all / first);
    let maps = median(|| Ok(Renderer::new(&model).renderings(&camera, &lights[..1]).map(drop)?))?;
    println!("   1 light with all maps {maps:8.2} ms");
    Ok(())
}
