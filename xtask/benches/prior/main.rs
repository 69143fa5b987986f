//! `cargo xtask bench prior`: the levels of the physical prior against the path tracer, all with the true medium and the true surface.
//!
//! A sphere, a slab, a thin sheet and Spot, thick and thin, without a boundary and with a rough one, under four lamps, at three albedos. What is compared is
//! light that was in the medium; what a boundary reflects on its outer side is taken off the reference. Profiles (level 1) are normalised diffusion
//! with the medium's parameters, or widths that are fitted to the reference itself, which is the best that any profile can do. Walks
//! (level 2) are a matrix between patches ([`diamond_pathtrace::ExitWalks`]), radiosity of patches with lamps connected exactly, and radiance along
//! the camera's rays ([`diamond_pathtrace::ViewWalks`]).
mod levels;
#[path = "../transport/plot.rs"]
mod plot;
mod scenes;

use clap::Parser;
use diamond_pathtrace::Boundary;
use glam::Vec3;
use levels::{Pictures, Profile};
use plot::{Curve, Panel};
use scenes::{Case, Film, LAMPS, SIDE, Truth};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use xtask::bench::Table;
use xtask::tidy::workspace_root;

/// The levels of the physical prior against the path tracer.
#[derive(Parser)]
struct Arguments {
    /// Paths per pixel of the reference; four times as many behind a rough boundary.
    #[arg(long, default_value_t = 512)]
    samples: u32,
    /// Surfels of each object, about.
    #[arg(long, default_value_t = 5000.0)]
    surfels: f32,
    /// Walks from each surfel or ray.
    #[arg(long, default_value_t = 256)]
    walks: u32,
    /// Only objects whose name contains this.
    #[arg(long)]
    only: Option<String>,
    /// Only levels whose name contains this.
    #[arg(long)]
    level: Option<String>,
    /// Only cases whose name (thick or thin, matched or rough) contains this, as in thick-rough.
    #[arg(long)]
    case: Option<String>,
    /// Width of the lamps' maps of view walks in texels; 0 traces every shadow ray.
    #[arg(long, default_value_t = 256)]
    visibility: u32,
    /// Mean cosine of the medium.
    #[arg(long, default_value_t = 0.0)]
    g: f32,
    /// Run time against error instead of the table.
    #[arg(long)]
    sweep: bool,
    /// Folder of the tables and pictures.
    #[arg(long, default_value = "out/bench")]
    out: PathBuf,
    /// Also writes the picture and the table of the sweep here.
    #[arg(long)]
    plots: Option<PathBuf>,
    /// Given by `cargo bench`; without meaning.
    #[arg(long, hide = true)]
    bench: bool,
}

/// Processor seconds of all threads of this process, in hundredths.
fn seconds() -> f64 {
    let told = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let rest = told.rsplit(')').next().unwrap_or_default();
    let ticks: f64 = rest.split_whitespace().skip(11).take(2).filter_map(|t| t.parse::<f64>().ok()).sum();
    ticks * 0.01
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let done = if arguments.sweep { sweep(&arguments) } else { table(&arguments) };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("bench prior: {message}");
            ExitCode::FAILURE
        }
    }
}

const OBJECTS: [&str; 4] = ["sphere", "slab", "sheet", "spot"];
const ROUGH: Boundary = Boundary::Rough { eta: 1.4, alpha: 0.3 };

/// σ_t of thick and of thin objects, whose largest radius is about 1.
const SIGMA_T: [(&str, f32); 2] = [("thick", 25.0), ("thin", 4.0)];

fn table(arguments: &Arguments) -> Result<(), String> {
    let columns =
        ["object", "medium", "boundary", "level", "seconds", "bias %", "±", "RMSE %", "bias per lamp, green %"];
    let context = [("samples", arguments.samples.to_string()), ("walks", arguments.walks.to_string())];
    let mut table = Table::new("prior", &columns, &context);
    for name in OBJECTS {
        if arguments.only.as_ref().is_some_and(|o| !name.contains(o.as_str())) {
            continue;
        }
        for (thickness, sigma_t) in SIGMA_T {
            for (label, boundary) in [("matched", Boundary::IndexMatched), ("rough", ROUGH)] {
                let wanted = format!("{thickness}-{label}");
                if arguments.case.as_ref().is_some_and(|o| !wanted.contains(o.as_str())) {
                    continue;
                }
                let case = Case::new(workspace_root(), name, sigma_t, arguments.g, boundary, arguments.surfels)?;
                let start = seconds();
                let samples = if case.refracts() { 4 * arguments.samples } else { arguments.samples };
                let truth = case.reference(samples, 77)?;
                let time = seconds() - start;
                let film = case.film()?;
                println!("{name} {thickness} {label}: {} patches, reference {time:.1} s", case.patches.len());
                let mut shown: Vec<Pictures> = Vec::new();
                let mut add = |level: &str, make: &dyn Fn() -> Result<Pictures, String>| -> Result<(), String> {
                    if arguments.level.as_ref().is_some_and(|o| !level.contains(o.as_str())) {
                        return Ok(());
                    }
                    let start = seconds();
                    let pictures = make()?;
                    let time = seconds() - start;
                    let errors = truth.errors(&pictures, None);
                    let rgb = |v: Vec3| format!("{:.2} {:.2} {:.2}", v.x, v.y, v.z);
                    let lamp = |l: usize| format!("{:.1}", truth.errors(&pictures, Some(l)).bias.y);
                    table.push(vec![
                        name.into(),
                        thickness.into(),
                        label.into(),
                        level.into(),
                        format!("{time:.2}"),
                        rgb(errors.bias),
                        rgb(errors.bias_error),
                        rgb(errors.rmse),
                        (0..LAMPS.len()).map(lamp).collect::<Vec<_>>().join(" "),
                    ]);
                    shown.push(pictures);
                    Ok(())
                };
                add("profile, true medium", &|| levels::profile(&case, &film, &truth, Profile::True, 12))?;
                add("profile, fitted", &|| levels::profile(&case, &film, &truth, Profile::Fitted, 12))?;
                add("walk, matrix", &|| levels::operator(&case, &film, arguments.walks))?;
                add("walk, surfels", &|| levels::surfels(&case, &film, arguments.walks))?;
                add("walk, rays", &|| levels::rays(&case, &film, arguments.walks, arguments.visibility))?;
                add("bulk", &|| levels::bulk(&case, 1024))?;
                let path = arguments.out.join(format!("prior-{name}-{thickness}-{label}.png"));
                draw(&path, &truth, &shown)?;
            }
        }
    }
    table.write(&arguments.out)?;
    Ok(())
}

/// One row for each lamp: the reference, then each level beside its difference (green channel; too bright red, too dark blue, full at half of the
/// lamp's largest radiance).
fn draw(path: &Path, truth: &Truth, levels: &[Pictures]) -> Result<(), String> {
    const ZOOM: u32 = 3;
    let side = SIDE as usize;
    let columns = 1 + 2 * levels.len();
    let mut picture = image::RgbImage::new(SIDE * columns as u32, SIDE * LAMPS.len() as u32);
    for (l, mean) in truth.means.iter().enumerate() {
        let largest = mean.data().iter().fold(f32::MIN_POSITIVE, |m, v| m.max(*v));
        for i in 0..side * side {
            let mut put = |column: usize, rgb: [f32; 3]| {
                let (x, y) = ((column * side + i % side) as u32, (l * side + i / side) as u32);
                picture.put_pixel(x, y, image::Rgb(rgb.map(|v| (255.0 * v.clamp(0.0, 1.0)) as u8)));
            };
            let shown = |v: &[f32]| [0, 1, 2].map(|c| (v[3 * i + c] / largest).max(0.0).sqrt());
            put(0, shown(mean.data()));
            for (k, level) in levels.iter().enumerate() {
                let difference = 2.0 * (level[l][3 * i + 1] - mean.data()[3 * i + 1]) / largest;
                put(1 + 2 * k, shown(&level[l]));
                put(2 + 2 * k, [difference, 0.0, -difference]);
            }
        }
    }
    let (width, height) = (picture.width() * ZOOM, picture.height() * ZOOM);
    std::fs::create_dir_all(path.parent().unwrap_or(Path::new("."))).map_err(|e| e.to_string())?;
    image::imageops::resize(&picture, width, height, image::imageops::FilterType::Nearest)
        .save(path)
        .map_err(|e| format!("{}: {e}", path.display()))
}

/// Run time against error.
fn sweep(arguments: &Arguments) -> Result<(), String> {
    let columns = ["object", "level", "value", "seconds", "RMSE %", "bias %"];
    let mut table = Table::new("prior-sweep", &columns, &[("samples", arguments.samples.to_string())]);
    let mut panels = Vec::new();
    for (name, thickness, boundary, title) in [
        ("sphere", 0, Boundary::IndexMatched, "sphere, thick, index-matched"),
        ("sphere", 1, ROUGH, "sphere, thin, rough"),
        ("sheet", 0, Boundary::IndexMatched, "sheet, two mean free paths"),
        ("spot", 0, Boundary::IndexMatched, "spot, thick, index-matched"),
    ] {
        if arguments.only.as_ref().is_some_and(|o| !name.contains(o.as_str())) {
            continue;
        }
        let case = Case::new(workspace_root(), name, SIGMA_T[thickness].1, arguments.g, boundary, arguments.surfels)?;
        let samples = if case.refracts() { 4 * arguments.samples } else { arguments.samples };
        let truth = case.reference(samples, 77)?;
        let film: Film = case.film()?;
        let mut curves = Vec::new();
        let mut curve =
            |level: &str, values: &[u32], make: &dyn Fn(u32) -> Result<Pictures, String>| -> Result<(), String> {
                let mut points = Vec::new();
                for value in values {
                    let start = seconds();
                    let pictures = make(*value)?;
                    let time = (seconds() - start).max(0.01);
                    let errors = truth.errors(&pictures, None);
                    // Below this nothing can be drawn, and the reference cannot tell.
                    points.push((time, f64::from(errors.rmse.element_sum() / 3.0).max(0.5)));
                    let numbers = [time, f64::from(errors.rmse.y), f64::from(errors.bias.y)].map(|v| format!("{v:.2}"));
                    table.push([vec![title.into(), level.into(), value.to_string()], numbers.to_vec()].concat());
                }
                let labels = values.iter().map(u32::to_string).collect();
                curves.push(Curve { name: level.into(), points, labels });
                Ok(())
            };
        curve("profile, true medium: widths", &[4, 8, 16], &|n| {
            levels::profile(&case, &film, &truth, Profile::True, n as usize)
        })?;
        curve("profile, fitted: widths", &[4, 8, 16], &|n| {
            levels::profile(&case, &film, &truth, Profile::Fitted, n as usize)
        })?;
        curve("matrix: walks", &[16, 64, 256, 1024], &|n| levels::operator(&case, &film, n))?;
        curve("rays: walks", &[16, 64, 256, 1024], &|n| levels::rays(&case, &film, n, arguments.visibility))?;
        curve("bulk: walks", &[64, 256, 1024], &|n| levels::bulk(&case, n))?;
        curve("reference: paths", &[16, 64, 256], &|n| {
            Ok(case.reference(n, u64::from(n))?.means.iter().map(|m| m.data().to_vec()).collect())
        })?;
        panels.push(Panel { title: title.into(), curves });
    }
    let files = table.write(&arguments.out)?;
    let picture = plot::panels(&panels, "processor seconds", "RMSE, % of the mean");
    let write = |path: &Path, bytes: &[u8]| std::fs::write(path, bytes).map_err(|e| format!("{}: {e}", path.display()));
    write(&arguments.out.join("prior.svg"), picture.as_bytes())?;
    if let Some(folder) = &arguments.plots {
        std::fs::create_dir_all(folder).map_err(|e| format!("{}: {e}", folder.display()))?;
        write(&folder.join("prior.svg"), picture.as_bytes())?;
        let csv = std::fs::read(&files[0]).map_err(|e| e.to_string())?;
        write(&folder.join("prior.csv"), &csv)?;
    }
    Ok(())
}
