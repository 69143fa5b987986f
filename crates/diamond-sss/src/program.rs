//! From the command line to the library and back to an exit code.
mod cli;
mod progress;
mod reconstruct;
mod signals;
mod synth;

use clap::Parser;
use cli::{Cli, Command, ModelsCommand, RenderArguments};
use diamond_reconstruct::{Config, InstructionChoice, PRESETS};
use diamond_sss::{CameraChoice, LightChoice, PlanOptions, RenderOptions, SssError};
use progress::Counter;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Runs the program.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    signals::file_limit_is_an_error();
    let filter = tracing_subscriber::EnvFilter::try_from_env("DIAMOND_LOG")
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_target(false)
        .without_time()
        .log_internal_errors(false)
        .init();
    match run(cli.command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            complain(&format!("diamond: {error}"));
            ExitCode::from(error.exit_code())
        }
    }
}

/// A line to the user beside the results. `eprintln!` would end the program where standard error is gone (a closed
/// terminal, a full disk behind a redirection), and with it hours of work.
fn complain(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Prints; that the reader has gone (`diamond … | head`) is no error.
fn print(text: &str) {
    let _ = std::io::stdout().write_all(text.as_bytes());
}

fn run(command: Command) -> Result<(), SssError> {
    match command {
        Command::Reconstruct(arguments) => reconstruct::run(arguments),
        Command::Synth { recipe, changes, output, members, contact_sheet, mesh, shards } => {
            synth::run(&synth::Wish { recipe, changes, output, members, contact_sheet, mesh, shards })
        }
        Command::Shards { captures, output, shard_size, prior } => {
            synth::shards(&captures, &output, shard_size.0, prior)
        }
        Command::Evaluate { dir, capture, save_images, instruction_set } => {
            choose_instructions(instruction_set)?;
            let mut counter = Counter::new("evaluating");
            let metrics =
                diamond_sss::evaluate_folder(&dir, &capture, save_images, &mut |done, all| counter.show(done, all))?;
            counter.finish();
            print(&metrics.to_table());
            print(&format!("written: {}\n", dir.join("metrics.json").display()));
            Ok(())
        }
        Command::Render(arguments) => {
            choose_instructions(arguments.instruction_set)?;
            let mut counter = Counter::new("rendering");
            let written =
                diamond_sss::render_folder(&render_options(arguments)?, &mut |done, all| counter.show(done, all))?;
            counter.finish();
            written.iter().for_each(|path| print(&format!("{}\n", path.display())));
            Ok(())
        }
        Command::Plan { capture, preset, settings, views, lights, memory_limit, json } => {
            let plan =
                diamond_sss::plan_capture(&PlanOptions { capture, preset, settings, views, lights, memory_limit })?;
            match json {
                true => print(&format!("{:#}\n", plan.to_json()?)),
                false => print(&plan.to_string()),
            }
            Ok(())
        }
        Command::Inspect { capture, output } if diamond_sss::is_splat_file(&capture) => {
            inspect_splats(&capture, output)
        }
        Command::Inspect { capture, output } => {
            let capture = diamond_dataset::Capture::open(&capture, &Default::default())?;
            print(&diamond_sss::inspect_text(&capture));
            if let Some(path) = output {
                let picture = diamond_sss::inspect_picture(&capture)?;
                let bytes: Vec<u8> = picture.data().iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
                let png = diamond_sss::encode_png_rgb(&bytes, picture.width(), picture.height())?;
                diamond_sss::write_output(&path, &png)?;
                print(&format!("written: {}\n", path.display()));
            }
            Ok(())
        }
        Command::InspectMedium { dir, medium, output } => {
            let report = diamond_sss::inspect_medium(&dir, medium.as_deref(), output.as_deref())?;
            print(&report.text);
            print(&format!("written: {}\n", report.plot.display()));
            Ok(())
        }
        Command::Export { dir, output, materials, writing } => {
            let exported = diamond_sss::export_model(&dir, &output, &writing.options(materials))?;
            report_export(&output, &exported);
            Ok(())
        }
        Command::Convert { input, output, writing } => {
            let exported = diamond_sss::convert_splats(&input, &output, &writing.options(false))?;
            report_export(&output, &exported);
            Ok(())
        }
        Command::Models(command) => models(command),
        Command::Train {
            shards,
            output,
            steps,
            batch,
            size,
            rate,
            seed,
            save_every,
            held_out,
            test_shards,
            resume,
        } => {
            let wish =
                diamond_sss::TrainOptions { steps, batch, size, rate, seed, save_every, held_out, test_shards, resume };
            let mut counter = Counter::new("training");
            let text = diamond_sss::train_on_shards(&shards, &output, &wish, &mut |done, all| counter.show(done, all))?;
            counter.finish();
            print(&text);
            Ok(())
        }
        Command::Devices => {
            print(&diamond_sss::devices_text());
            Ok(())
        }
        Command::Presets { name } => {
            match name {
                Some(name) => print(&Config::load(&name)?.to_toml()?),
                None => PRESETS.iter().for_each(|name| print(&format!("{name}\n"))),
            }
            Ok(())
        }
    }
}

fn choose_instructions(choice: Option<InstructionChoice>) -> Result<(), SssError> {
    choice.unwrap_or_default().apply().map(drop).map_err(|e| SssError::Usage(e.to_string()))
}

fn models(command: ModelsCommand) -> Result<(), SssError> {
    match command {
        ModelsCommand::Inspect { file } => print(&diamond_sss::inspect_weights(&file)?),
        ModelsCommand::Check { file, model } => print(&diamond_sss::check_weights(&file, &model)?),
        ModelsCommand::Convert { file, output, model, numbers } => {
            print(&diamond_sss::convert_weights(&file, &output, &model, &numbers)?);
        }
    }
    Ok(())
}

fn inspect_splats(path: &Path, output: Option<PathBuf>) -> Result<(), SssError> {
    let file = diamond_splat_files::read(path)?;
    print(&diamond_sss::inspect_splats(path, &file));
    if let Some(path) = output {
        let (width, height, rgb) = diamond_sss::splat_picture(&file.cloud)?;
        diamond_sss::write_output(&path, &diamond_sss::encode_png_rgb(&rgb, width, height)?)?;
        print(&format!("written: {}\n", path.display()));
    }
    Ok(())
}

fn report_export(output: &Path, exported: &diamond_sss::Exported) {
    exported.notes.iter().for_each(|note| print(&format!("note: {note}\n")));
    print(&format!("written: {} ({} Gaussians)\n", output.display(), exported.count));
}

fn render_options(a: RenderArguments) -> Result<RenderOptions, SssError> {
    let cameras = match (a.orbit, a.camera, a.view) {
        (Some(count), _, _) => CameraChoice::Orbit(count),
        (_, Some(path), _) => CameraChoice::File(path),
        (_, _, Some(index)) => CameraChoice::View { capture: a.capture, index },
        _ if a.capture.is_some() => CameraChoice::View { capture: a.capture, index: 0 },
        _ => CameraChoice::First,
    };
    let lights = match (a.light, a.direction, a.mix, a.lights) {
        (Some(v), ..) => LightChoice::Point(diamond_sss::parse_vec3(&v)?),
        (_, Some(v), ..) => LightChoice::Direction(diamond_sss::parse_vec3(&v)?),
        (_, _, Some(v), _) => LightChoice::Mix(diamond_sss::parse_mix(&v)?),
        (_, _, _, Some(n)) => LightChoice::Dome(n),
        _ => LightChoice::Training,
    };
    Ok(RenderOptions {
        folder: a.dir,
        output: a.output,
        cameras,
        lights,
        size: a.size,
        medium: a.medium,
        linear: a.linear,
        device: Some(a.device),
        exposure: a.exposure,
    })
}
