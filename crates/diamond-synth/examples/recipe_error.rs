//! The errors of recipes at their own quality against the unbiased reference, as a table.
//!
//!     cargo run --release -p diamond-synth --example recipe_error -- PATHS RECIPE... [KEY=VALUE...] [--pictures DIR]
//!
//! PATHS of the reference per pixel. KEY=VALUE changes all recipes, such as `quality.walks=4096`. With a folder, a picture for each recipe: reference, bulk, and ten times their difference (grey is none).
use diamond_image::{Image, Transfer};
use diamond_pathtrace::{Bulk, BulkError, ReferenceImage, reference_pairs};
use diamond_synth::{Measurement, Object, Plan, Recipe};
use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Largest values are shown as this fraction of the largest of all: highlights would leave the rest black.
const WHITE: f32 = 0.5;

/// A row for each light.
fn picture(reference: &ReferenceImage, bulk: &[Image]) -> Vec<u8> {
    let (side, height, _) = bulk[0].shape();
    let mut file = format!("P6 {} {} 255\n", 3 * side, height * bulk.len()).into_bytes();
    for (target, found) in reference.lights.iter().zip(bulk) {
        let mut values: Vec<f32> = target.mean.data().to_vec();
        values.sort_by(f32::total_cmp);
        let white = (values[values.len() * 99 / 100] / WHITE).max(1e-9);
        for y in 0..height {
            for kind in 0..3 {
                for x in 0..side {
                    for c in 0..3 {
                        let (r, b) = (target.mean.pixel(x, y)[c] / white, found.pixel(x, y)[c] / white);
                        let v = [r, b, 0.2 + 10.0 * (b - r)][kind].clamp(0.0, 1.0);
                        file.push((255.0 * Transfer::Srgb.encode(v) + 0.5) as u8);
                    }
                }
            }
        }
    }
    file
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments: Vec<String> = std::env::args().skip(1).collect();
    let mut folder: Option<PathBuf> = None;
    if let Some(at) = arguments.iter().position(|a| a == "--pictures") {
        folder = arguments.get(at + 1).map(PathBuf::from);
        arguments.drain(at..(at + 2).min(arguments.len()));
    }
    let changes: Vec<String> = arguments.iter().filter(|a| a.contains('=')).cloned().collect();
    arguments.retain(|a| !a.contains('='));
    let (paths, files) = arguments.split_first().ok_or("expected PATHS and recipes")?;
    println!(
        "| recipe | points × walks | bias % | ± | RMSE % | RMSE below % | systematic % | noise % | noise dB | solve s | view s | reference s |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|---|");
    for file in files {
        let mut recipe = Recipe::parse_changed(&std::fs::read_to_string(file)?, file, &changes)?;
        recipe.quality.measured_paths = paths.parse()?;
        let object = Object::new(&recipe, Path::new(file).parent().unwrap_or(Path::new("")))?;
        let m = Measurement::new(&recipe, &object, &Plan::new(&recipe)?);
        let start = Instant::now();
        let references = reference_pairs(&m.scene, &m.cameras, &m.reference)?;
        let reference = start.elapsed().as_secs_f32();
        let start = Instant::now();
        let bulk = Bulk::solve(&m.scene, &m.bulk, &|_| ())?;
        let solve = start.elapsed().as_secs_f32();
        let start = Instant::now();
        let view = bulk.render(&m.cameras[0], 0)?;
        let rendered = start.elapsed().as_secs_f32();
        let e = BulkError::against(&m.scene, &m.bulk, &m.cameras, &references, &|_| ())?;
        println!(
            "| {} | {} × {} | {:+.2} | {:.2} | {:.2} | {:.2} | {:.2} | {:.2} | {:.1} | {solve:.1} | {rendered:.2} | {reference:.0} |",
            recipe.name,
            bulk.points(),
            m.bulk.walks,
            100.0 * e.bias,
            100.0 * e.bias_standard_error.hypot(e.bias_noise),
            100.0 * e.rmse,
            100.0 * (e.rmse * e.rmse + 2.0 * e.square_standard_error).sqrt(),
            100.0 * e.systematic(),
            100.0 * e.noise,
            e.noise_db,
        );
        if let Some(folder) = &folder {
            std::fs::create_dir_all(folder)?;
            let stem = Path::new(file).file_stem().unwrap_or_default();
            std::fs::write(folder.join(stem).with_extension("ppm"), picture(&references[0][0], &view.lights))?;
        }
    }
    Ok(())
}
