//! Time of one view under 1, 2, 4, … lights: what a further light costs beside the first.
//! `cargo run --release -p diamond-reconstruct --example light_scaling -- CAPTURE [STEPS [WIDTH]]` trains briefly first; given the
//! folder of a finished run instead of a capture, it renders that model from a camera of its own. Of each repetition it
//! takes the time of the processors, all threads together, where the system tells (Linux), and wall time; it shows the
//! median of the former and the least of the latter, which other programs on the machine lengthen.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_dataset::{Capture, OpenOptions};
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_reconstruct::{Config, Model, ReconstructError, Reconstruction, Renderer};
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

/// What something took, milliseconds.
#[derive(Clone, Copy)]
struct Time {
    /// All threads together, the median of the repetitions.
    processors: f64,
    /// The least of the repetitions.
    wall: f64,
}

fn once(f: &mut impl FnMut() -> Result<(), Failure>) -> Result<Time, Failure> {
    let (start, processors) = (Instant::now(), processor_seconds());
    f()?;
    let wall = 1e3 * start.elapsed().as_secs_f64();
    let processors = match (processors, processor_seconds()) {
        (Some(before), Some(after)) => 1e3 * (after - before),
        _ => wall,
    };
    Ok(Time { processors, wall })
}

fn median(mut times: Vec<Time>) -> Time {
    let wall = times.iter().map(|t| t.wall).fold(f64::INFINITY, f64::min);
    times.sort_by(|a, b| a.processors.total_cmp(&b.processors));
    Time { processors: times[times.len() / 2].processors, wall }
}

fn time(mut f: impl FnMut() -> Result<(), Failure>) -> Result<Time, Failure> {
    Ok(median((0..REPETITIONS).map(|_| once(&mut f)).collect::<Result<_, _>>()?))
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
    println!("{:?}", Renderer::new(&model).work(&camera)?);
    println!("                       processors    × one   each         wall    × one   each");
    // A renderer for each repetition: what it does once per model counts too.
    let of = |model: &Model, n: usize| {
        time(|| {
            let mut sum = 0.0;
            let see = |_: usize, image: &Image| -> Result<(), ReconstructError> {
                sum += image.data()[image.data().len() / 2];
                Ok(())
            };
            Renderer::new(model).each_radiance(&camera, &lights[..n], see)?;
            std::hint::black_box(sum);
            Ok(())
        })
    };
    let kept = |model: &Model, n: usize| time(|| Ok(Renderer::new(model).radiance(&camera, &lights[..n]).map(drop)?));
    let show = |what: &str, n: usize, one: Time, all: Time| {
        let column = |one: f64, all: f64| format!("{all:8.2} ms {:7.2} {:7.3}", all / one, all / n as f64);
        println!("{n:4} lights{what:8} {}  {}", column(one.processors, all.processors), column(one.wall, all.wall));
    };
    let one = of(&model, 1)?;
    for n in [1, 4, 16, 112] {
        show("", n, one, of(&model, n)?);
    }
    show(" kept", 112, kept(&model, 1)?, kept(&model, 112)?);
    // What a light costs from the second view on.
    let known = |n: usize| {
        let renderer = Renderer::new(&model).with_kept_visibility(usize::MAX);
        let render = || Ok(renderer.each_radiance(&camera, &lights[..n], |_, _| Ok::<(), ReconstructError>(()))?);
        render().and_then(|()| time(render))
    };
    let one = known(1)?;
    show(" known", 1, one, one);
    show(" known", 112, one, known(112)?);
    let mut untraced = model.clone();
    untraced.config.visibility.traced = false;
    let one = of(&untraced, 1)?;
    show(" fitted", 112, one, of(&untraced, 112)?);
    if let Some(medium) = &model.medium {
        // The lines above know what each light does in the medium; here that is computed as well, from a medium that has seen no light.
        let new = |n: usize| {
            let mut times = Vec::new();
            for _ in 0..REPETITIONS {
                let fresh = medium.with_medium(medium.medium().clone())?;
                let model = Model { medium: Some(fresh), ..model.clone() };
                times.push(once(&mut || {
                    Ok(Renderer::new(&model)
                        .each_radiance(&camera, &lights[..n], |_, _| Ok::<(), ReconstructError>(()))?)
                })?);
            }
            Ok::<Time, Failure>(median(times))
        };
        let one = new(1)?;
        show(" new", 1, one, one);
        show(" new", 112, one, new(112)?);
    }
    let maps = time(|| Ok(Renderer::new(&model).renderings(&camera, &lights[..1]).map(drop)?))?;
    println!("   1 light with all maps {:8.2} ms, wall {:8.2} ms", maps.processors, maps.wall);
    Ok(())
}
