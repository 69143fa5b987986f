//! `cargo xtask bench transport`: what an error costs, in processor seconds of one thread.
//!
//! Rays per second; variance × time of the reference on the scenes of `assets/fixtures/transport/mitsuba`, beside Mitsuba where
//! `--mitsuba PYTHON` names an interpreter that has it (its rounds run between ours); the same for a rig of 112 lights, along one
//! path and in bulk (see [`bulk`]); and run time against error for the settings of the bulk renderer and for the reference (see [`sweep`]), as
//! CSV and as a picture.
mod bulk;
mod plot;
mod sweep;

use clap::Parser;
use diamond_camera::{Camera, Intrinsics};
use diamond_light::LightRig;
use diamond_pathtrace::{
    Facing, Geometry, Light, NO_PRIMITIVE, ReferenceOptions, Rng, Scene, read_ply, render_reference, sampling,
};
use glam::Vec3;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use xtask::bench::{Table, median};
use xtask::oracle::mitsuba::read_scene;

/// Side of the pictures, as in `theirs.py`.
const SIDE: u32 = 64;
/// Lights of a whole rig.
const LIGHTS: usize = 112;
/// Directions in which light travels, as in `theirs.py`: some lights of a rig, for the mean over all.
const RIG: [Vec3; 4] = [Vec3::NEG_ONE, Vec3::new(1.0, 0.5, -0.5), Vec3::new(0.3, -1.0, 0.4), Vec3::new(-0.5, 0.2, 1.0)];

/// The path tracer: rays, variance × time beside Mitsuba's, time against error.
#[derive(Parser)]
struct Arguments {
    /// A Python interpreter with mitsuba and numpy; without, only ours is measured.
    #[arg(long)]
    mitsuba: Option<PathBuf>,
    /// Rows that `theirs.py` has written before, instead of running it.
    #[arg(long, conflicts_with = "mitsuba")]
    theirs: Option<PathBuf>,
    /// Paths per pixel.
    #[arg(long, default_value_t = 256)]
    samples: u32,
    /// Rounds before and as many after Mitsuba's.
    #[arg(long, default_value_t = 4)]
    rounds: u64,
    /// Only one of: rays, error, rig, bulk, sweep.
    #[arg(long)]
    only: Option<String>,
    /// Folder of the tables.
    #[arg(long, default_value = "out/bench")]
    out: PathBuf,
    /// Also writes the picture and the table of the sweep here.
    #[arg(long)]
    plots: Option<PathBuf>,
    /// Given by `cargo bench`; without meaning.
    #[arg(long, hide = true)]
    bench: bool,
}

/// Processor seconds of this thread; wall time where the system does not say.
fn seconds() -> f64 {
    let told = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let ns = told.and_then(|s| s.split_whitespace().next().and_then(|n| n.parse::<f64>().ok()));
    ns.map_or_else(
        || std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0.0, |t| t.as_secs_f64()),
        |ns| ns * 1e-9,
    )
}

fn main() -> ExitCode {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build();
    match pool.map_err(|e| e.to_string()).and_then(|pool| pool.install(|| run(&Arguments::parse()))) {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("bench transport: {message}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> Result<(), String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let folder = root.join("assets/fixtures/transport/mitsuba");
    let wanted = |what: &str| arguments.only.as_deref().is_none_or(|only| only == what);
    if wanted("rays") {
        rays(&folder)?.write(&arguments.out)?;
    }
    if wanted("error") || wanted("rig") || wanted("bulk") {
        let text = std::fs::read_to_string(folder.join("refs.json")).map_err(|e| e.to_string())?;
        let json: Value = serde_json::from_str(&text).map_err(|e| e.to_string())?;
        let (mut scenes, mut rigs) = (Vec::new(), Vec::new());
        for (name, entry) in json.as_object().ok_or("refs.json: expected scenes")? {
            let (scene, camera) = read_scene(&folder, entry)?;
            let fov = 2.0 * (0.5 * camera.intrinsics.width as f32 / camera.intrinsics.fx).atan();
            let camera = Camera { intrinsics: Intrinsics::from_fov_x(fov, SIDE, SIDE), ..camera };
            if wanted("rig") && (name == "sphere_null_front" || name == "mesh_null_front") {
                scenes.push((format!("{name}/rig"), rig(&scene)?, camera, 16.min(arguments.samples)));
            }
            if wanted("bulk") && (name == "sphere_null_front" || name == "mesh_null_front") {
                rigs.push((format!("{name}/rig"), rig(&scene)?, camera));
            }
            if wanted("error") {
                scenes.push((name.clone(), scene, camera, arguments.samples));
            }
        }
        let mut ours: Vec<Cost> = scenes.iter().map(|_| Cost::default()).collect();
        let half = |ours: &mut Vec<Cost>, first: u64| -> Result<(), String> {
            for seed in first..first + arguments.rounds {
                for (cost, (_, scene, camera, samples)) in ours.iter_mut().zip(&scenes) {
                    cost.add(scene, camera, *samples, seed)?;
                }
            }
            Ok(())
        };
        half(&mut ours, 0)?;
        let theirs = match (&arguments.mitsuba, &arguments.theirs) {
            (Some(python), _) => {
                let out = std::env::temp_dir().join(format!("diamond-theirs-{}.json", std::process::id()));
                let script = root.join("xtask/benches/transport/theirs.py");
                let done = Command::new(python).arg(script).arg(&folder).arg(&out).status();
                let done = done.map_err(|e| format!("{}: {e}", python.display()))?;
                if !done.success() {
                    return Err(format!("theirs.py ended with {done}"));
                }
                read_theirs(&out)?
            }
            (None, Some(path)) => read_theirs(path)?,
            (None, None) => Vec::new(),
        };
        half(&mut ours, arguments.rounds)?;
        for (name, scene, camera) in &rigs {
            bulk::run(name, scene, camera, &theirs)?.write(&arguments.out)?;
        }
        let columns = [
            "scene",
            "µs per path",
            "variance R",
            "G",
            "B",
            "Mitsuba",
            "its µs",
            "its variance R",
            "G",
            "B",
            "better R",
            "G",
            "B",
        ];
        let context = [("paths per pixel", arguments.samples.to_string()), ("side", SIDE.to_string())];
        let mut table = Table::new("transport", &columns, &context);
        for ((name, ..), cost) in scenes.iter().zip(&ours) {
            let (time, variance) = cost.result();
            let mut rows = compare(name, &theirs);
            if rows.is_empty() {
                rows.push(("–".into(), f64::NAN, [f64::NAN; 3]));
            }
            for (what, their_time, their_variance) in rows {
                let mut row = vec![name.clone(), format!("{:.3}", time * 1e6)];
                row.extend(variance.map(|v| format!("{v:.3e}")));
                row.extend([what, format!("{:.3}", their_time * 1e6)]);
                row.extend(their_variance.map(|v| format!("{v:.3e}")));
                row.extend((0..3).map(|c| format!("{:.2}", their_time * their_variance[c] / (time * variance[c]))));
                table.push(row);
            }
        }
        if !scenes.is_empty() {
            table.write(&arguments.out)?;
        }
    }
    if wanted("sweep") {
        sweep::run(&arguments.out, arguments.plots.as_deref())?;
    }
    Ok(())
}

/// The lights of [`RIG`] and as many more as make a whole rig.
fn rig(scene: &Scene) -> Result<Scene, String> {
    let mut lights: Vec<Light> = RIG.iter().map(|travel| Light::directional(-travel.normalize(), Vec3::ONE)).collect();
    let dome = LightRig::directional_dome(LIGHTS - RIG.len(), Vec3::Y, -1.0, Vec3::ONE).map_err(|e| e.to_string())?;
    lights.extend(dome.lights.iter().map(|light| Light::from(*light)));
    Ok(Scene { lights, ..scene.clone() })
}

/// Rounds of one scene.
#[derive(Default)]
struct Cost {
    seconds: Vec<f64>,
    variance: [f64; 3],
}

impl Cost {
    /// Variance of one path, over the film and the lights of [`RIG`], from the standard errors; time of one path of one pixel for all lights.
    fn add(&mut self, scene: &Scene, camera: &Camera, samples: u32, seed: u64) -> Result<(), String> {
        let start = seconds();
        let options = ReferenceOptions { samples, seed, ..Default::default() };
        let image = render_reference(scene, camera, &options).map_err(|e| e.to_string())?;
        let paths = f64::from(SIDE * SIDE) * f64::from(samples);
        self.seconds.push((seconds() - start) / paths);
        let lights = &image.lights[..image.lights.len().min(RIG.len())];
        for light in lights {
            for (i, e) in light.standard_error.data().iter().enumerate() {
                self.variance[i % 3] +=
                    f64::from(*e).powi(2) * f64::from(samples) / f64::from(SIDE * SIDE) / lights.len() as f64;
            }
        }
        Ok(())
    }

    fn result(&self) -> (f64, [f64; 3]) {
        (median(&self.seconds), self.variance.map(|v| v / self.seconds.len().max(1) as f64))
    }
}

/// Scene, variant and integrator, seconds and variance of a sample.
type Theirs = (String, String, f64, [f64; 3]);

fn read_theirs(path: &Path) -> Result<Vec<Theirs>, String> {
    let here = |e: String| format!("{}: {e}", path.display());
    let text = std::fs::read_to_string(path).map_err(|e| here(e.to_string()))?;
    let json: Value = serde_json::from_str(&text).map_err(|e| here(e.to_string()))?;
    let rows = json.as_array().ok_or_else(|| here("expected a list of rows".into()))?;
    rows.iter()
        .map(|row| {
            let word = |key: &str| row[key].as_str().ok_or_else(|| here(format!("expected the text {key}")));
            let variance: Option<Vec<f64>> =
                row["variance_per_sample"].as_array().and_then(|v| v.iter().map(Value::as_f64).collect());
            let variance: [f64; 3] = variance
                .and_then(|v| v.try_into().ok())
                .ok_or_else(|| here("variance_per_sample: expected three numbers".into()))?;
            let time = row["seconds_per_sample"].as_f64().ok_or_else(|| here("expected seconds_per_sample".into()))?;
            let what = format!("{} {}", word("variant")?, word("integrator")?);
            Ok((word("scene")?.to_string(), what, time, variance))
        })
        .collect()
}

/// What Mitsuba needs for a scene with each variant and integrator; for a rig the sum over its lights.
fn compare(name: &str, theirs: &[Theirs]) -> Vec<(String, f64, [f64; 3])> {
    let Some(base) = name.strip_suffix("rig") else {
        return theirs.iter().filter(|t| t.0 == name).map(|t| (t.1.clone(), t.2, t.3)).collect();
    };
    let first = format!("{base}0");
    let whats = theirs.iter().filter(|t| t.0 == first).map(|t| t.1.clone());
    whats
        .map(|what| {
            let lights: Vec<&Theirs> = theirs.iter().filter(|t| t.0.starts_with(base) && t.1 == what).collect();
            let n = lights.len() as f64;
            let mean = |f: &dyn Fn(&Theirs) -> f64| lights.iter().map(|t| f(t)).sum::<f64>() / n;
            let time = LIGHTS as f64 * mean(&|t| t.2);
            (what, time, [0, 1, 2].map(|c| mean(&|t| t.3[c])))
        })
        .collect()
}

/// Rays per second on Spot.
fn rays(folder: &Path) -> Result<Table, String> {
    let mesh = read_ply(&folder.join("spot.ply")).map_err(|e| e.to_string())?;
    let triangles = mesh.triangles.len();
    let start = seconds();
    let spot = Geometry::from_mesh(mesh).map_err(|e| e.to_string())?;
    println!("{triangles} triangles, prepared in {:.0} ms", 1e3 * (seconds() - start));
    let mut rng = Rng::new(1, 1);
    let (low, high) = spot.bounds();
    let mut inside = Vec::new();
    while inside.len() < 20_000 {
        let u = Vec3::new(rng.uniform(), rng.uniform(), rng.uniform());
        let p = low + (high - low) * u;
        if spot.contains(p) {
            inside.push((p, sampling::uniform_sphere(&mut rng)));
        }
    }
    let mut from = || sampling::uniform_sphere(&mut rng) * 4.0;
    let outside: Vec<(Vec3, Vec3)> = inside.iter().map(|(p, _)| (from(), *p)).collect();
    let outside: Vec<(Vec3, Vec3)> = outside.into_iter().map(|(o, p)| (o, (p - o).normalize())).collect();
    let mut table = Table::new("transport-rays", &["rays", "M/s"], &[("triangles", triangles.to_string())]);
    let mut rate = |name: &str, rays: &[(Vec3, Vec3)], f: &dyn Fn(Vec3, Vec3) -> f32| {
        let mut rates = Vec::new();
        for _ in 0..7 {
            let start = seconds();
            for _ in 0..10 {
                std::hint::black_box(rays.iter().map(|(o, d)| f(*o, *d)).sum::<f32>());
            }
            rates.push(10.0 * rays.len() as f64 / (seconds() - start).max(1e-9) * 1e-6);
        }
        table.push(vec![name.into(), format!("{:.2}", median(&rates))]);
    };
    let end = f32::INFINITY;
    let (leaving, entering) = (Facing::Leaving, Facing::Entering);
    let distance = |o, d, max, facing| spot.closest_hit(o, d, max, facing, NO_PRIMITIVE).map_or(0.0, |h| h.distance);
    let any = |o, d, facing| f32::from(u8::from(spot.occluded(o, d, end, facing, NO_PRIMITIVE)));
    rate("from inside: closest", &inside, &|o, d| distance(o, d, end, leaving));
    rate("from inside: closest within 0.15", &inside, &|o, d| distance(o, d, 0.15, leaving));
    rate("from inside: any", &inside, &|o, d| any(o, d, leaving));
    rate("from inside: length inside", &inside, &|o, d| spot.inside_length(o, d, end, true, NO_PRIMITIVE));
    rate("from outside: closest", &outside, &|o, d| distance(o, d, end, entering));
    rate("from outside: any", &outside, &|o, d| any(o, d, entering));
    rate("from outside: length inside", &outside, &|o, d| spot.inside_length(o, d, end, false, NO_PRIMITIVE));
    Ok(table)
}
