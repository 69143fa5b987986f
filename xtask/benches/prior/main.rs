//! `cargo xtask bench prior`: the levels of the physical prior against the path tracer.
mod levels;
#[path = "../transport/plot.rs"]
mod plot;
mod scenes;

use clap::Parser;
use diamond_pathtrace::{Boundary, ExitWalkOptions};
use glam::Vec3;
use levels::{Angles, Profile};
use scenes::{Case, Errors, LAMPS};
use std::path::PathBuf;
use std::process::ExitCode;
use xtask::bench::Table;
use xtask::tidy::workspace_root;

/// The levels of the physical prior against the path tracer.
#[derive(Parser)]
struct Arguments {
    /// Paths per pixel of the reference.
    #[arg(long, default_value_t = 512)]
    samples: u32,
    /// Surfels of each object, about.
    #[arg(long, default_value_t = 6000.0)]
    surfels: f32,
    /// Walks from each surfel.
    #[arg(long, default_value_t = 256)]
    walks: u32,
    /// Only objects whose name contains this.
    #[arg(long)]
    only: Option<String>,
    /// Mean cosine of the medium.
    #[arg(long, default_value_t = 0.0)]
    g: f32,
    /// Folder of the tables.
    #[arg(long, default_value = "out/bench")]
    out: PathBuf,
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
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("bench prior: {message}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> Result<(), String> {
    let columns = ["object", "radius·σ_t", "boundary", "level", "seconds", "bias %", "±", "RMSE %", "bias per lamp %"];
    let mut table = Table::new("prior", &columns, &[("samples", arguments.samples.to_string())]);
    for name in ["sphere", "slab", "sheet", "spot"] {
        if arguments.only.as_ref().is_some_and(|o| !name.contains(o.as_str())) {
            continue;
        }
        for (thickness, sigma_t) in [("thick", 25.0f32), ("thin", 4.0)] {
            for (label, boundary) in
                [("matched", Boundary::IndexMatched), ("rough", Boundary::Rough { eta: 1.4, alpha: 0.3 })]
            {
                let case = Case::new(workspace_root(), name, sigma_t, arguments.g, boundary, arguments.surfels)?;
                let start = seconds();
                let truth = case.reference(arguments.samples, 77)?;
                let time = seconds() - start;
                let film = case.film()?;
                println!("{name} {thickness} {label}: {} surfels, reference {time:.1} s", case.patches.len());
                let options = ExitWalkOptions { walks: arguments.walks, ..Default::default() };
                let mut add =
                    |level: &str, make: &dyn Fn() -> Result<levels::Pictures, String>| -> Result<(), String> {
                        let start = seconds();
                        let pictures = make()?;
                        let time = seconds() - start;
                        let errors = truth.errors(&pictures, None);
                        let rgb = |v: Vec3| format!("{:.2} {:.2} {:.2}", v.x, v.y, v.z);
                        let lamps = (0..LAMPS.len()).map(|l| {
                            let Errors { bias, .. } = truth.errors(&pictures, Some(l));
                            format!("{:.1} {:.1} {:.1}", bias.x, bias.y, bias.z)
                        });
                        table.push(vec![
                            name.into(),
                            thickness.into(),
                            label.into(),
                            level.into(),
                            format!("{time:.2}"),
                            rgb(errors.bias),
                            rgb(errors.bias_error),
                            rgb(errors.rmse),
                            lamps.collect::<Vec<_>>().join("; "),
                        ]);
                        Ok(())
                    };
                add("profile, true medium", &|| levels::profile(&case, &film, &truth, Profile::True, 12))?;
                add("profile, fitted", &|| levels::profile(&case, &film, &truth, Profile::Fitted, 12))?;
                add("walk, diffuse", &|| levels::walk(&case, &film, &options, Angles::Diffuse))?;
                add("walk, one A", &|| levels::walk(&case, &film, &options, Angles::One))?;
                add("walk, classes", &|| levels::walk(&case, &film, &options, Angles::Classes))?;
            }
        }
    }
    table.write(&arguments.out)?;
    Ok(())
}
