//! The errors of recipes at their own quality against the unbiased reference, as a table, and where in the pictures they are.
//!
//!     cargo run --release -p diamond-synth --example recipe_error -- PATHS RECIPE... [KEY=VALUE...] [--pictures DIR] [--keep DIR] [--whole-rig]
//!
//! PATHS of the reference per pixel. KEY=VALUE changes all recipes, such as `quality.walks=4096`. `--pictures`: for each recipe reference, bulk, and ten times
//! their difference (grey is none). `--keep`: references are written there and read again by the next run with the same recipe, resolution and
//! PATHS; changes to the object, the material or the rig want another folder. With it, `RECIPE.f32` holds all pictures of the first view.
//! `--whole-rig`: what a solution and a view with all lamps cost.
use diamond_image::{Image, Transfer};
use diamond_light::Falloff;
use diamond_pathtrace::{Bulk, BulkError, BulkOptions, BulkView, Light, LightImage, ReferenceImage, reference_pairs};
use diamond_synth::{Measurement, Object, Plan, Recipe, exposure};
use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Largest values are shown as this fraction of the largest of all: highlights would leave the rest black.
const WHITE: f32 = 0.5;

/// Seconds of processor time that this process has used, all threads together (Linux; elsewhere since `start`).
fn processor_seconds(start: Instant) -> f32 {
    let ticks = |text: String| -> Option<f32> {
        let fields: Vec<&str> = text.rsplit(')').next()?.split_whitespace().collect();
        Some((fields.get(11)?.parse::<f32>().ok()? + fields.get(12)?.parse::<f32>().ok()?) / 100.0)
    };
    let stat = std::fs::read_to_string("/proc/self/stat").ok().and_then(ticks);
    stat.unwrap_or_else(|| start.elapsed().as_secs_f32())
}

/// A row for each light.
fn picture(pair: &[ReferenceImage; 2], bulk: &[Image]) -> Vec<u8> {
    let (side, height, _) = bulk[0].shape();
    let mut file = format!("P6 {} {} 255\n", 3 * side, height * bulk.len()).into_bytes();
    for (l, found) in bulk.iter().enumerate() {
        let [one, two] = [&pair[0].lights[l].mean, &pair[1].lights[l].mean];
        let target: Vec<f32> = one.data().iter().zip(two.data()).map(|(a, b)| 0.5 * (a + b)).collect();
        let mut values = target.clone();
        values.sort_by(f32::total_cmp);
        let white = (values[values.len() * 99 / 100] / WHITE).max(1e-9);
        for y in 0..height {
            for kind in 0..3 {
                for x in 0..side {
                    for c in 0..3 {
                        let (r, b) = (target[3 * (y * side + x) + c] / white, found.pixel(x, y)[c] / white);
                        let v = [r, b, 0.2 + 10.0 * (b - r)][kind].clamp(0.0, 1.0);
                        file.push((255.0 * Transfer::Srgb.encode(v) + 0.5) as u8);
                    }
                }
            }
        }
    }
    file
}

fn put(images: &[&Image]) -> Vec<u8> {
    images.iter().flat_map(|image| image.data()).flat_map(|v| v.to_le_bytes()).collect()
}

fn of_pairs(pairs: &[[ReferenceImage; 2]]) -> Vec<u8> {
    let each = pairs.iter().flatten();
    let images = each.flat_map(|r| r.lights.iter().flat_map(|l| [&l.mean, &l.standard_error]).chain([&r.coverage]));
    put(&images.collect::<Vec<_>>())
}

/// References of a file, if it has the size for them.
fn kept(path: &Path, m: &Measurement) -> Option<Vec<[ReferenceImage; 2]>> {
    let bytes = std::fs::read(path).ok()?;
    let mut values = bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    let mut take = |width: u32, height: u32, channels: usize| {
        let mut image = Image::new(width as usize, height as usize, channels);
        for v in image.data_mut() {
            *v = values.next()?;
        }
        Some(image)
    };
    let mut pairs = Vec::new();
    for camera in &m.cameras {
        let (w, h) = (camera.intrinsics.width, camera.intrinsics.height);
        let mut one = || {
            let light = |_| Some(LightImage { mean: take(w, h, 3)?, standard_error: take(w, h, 3)? });
            let lights = (0..m.scene.lights.len()).map(light).collect::<Option<_>>()?;
            Some(ReferenceImage { lights, coverage: take(w, h, 1)?, events: 0, truncated: 0 })
        };
        pairs.push([one()?, one()?]);
    }
    values.next().is_none().then_some(pairs)
}

/// References, bulk, and two of half the walks, light by light; then coverage and normals.
fn everything(pair: &[ReferenceImage; 2], views: &[BulkView; 3]) -> Vec<u8> {
    let mut images = Vec::new();
    for l in 0..views[0].lights.len() {
        images.extend([&pair[0].lights[l].mean, &pair[1].lights[l].mean]);
        images.extend(views.iter().map(|v| &v.lights[l]));
    }
    images.extend([&views[0].coverage, &views[0].normal]);
    put(&images)
}

fn option(arguments: &mut Vec<String>, name: &str) -> Option<PathBuf> {
    let at = arguments.iter().position(|a| a == name)?;
    arguments.drain(at..(at + 2).min(arguments.len())).nth(1).map(PathBuf::from)
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments: Vec<String> = std::env::args().skip(1).collect();
    let (folder, keep) = (option(&mut arguments, "--pictures"), option(&mut arguments, "--keep"));
    let whole = arguments.iter().any(|a| a == "--whole-rig");
    arguments.retain(|a| a != "--whole-rig");
    let changes: Vec<String> = arguments.iter().filter(|a| a.contains('=')).cloned().collect();
    arguments.retain(|a| !a.contains('='));
    let (paths, files) = arguments.split_first().ok_or("expected PATHS and recipes")?;
    println!(
        "| recipe | points × walks | bias % | ± | RMSE % | ± | beyond white % | systematic % | noise % | noise dB | solve CPU s | view CPU s | reference CPU s |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|---|---|");
    for file in files {
        let mut recipe = Recipe::parse_changed(&std::fs::read_to_string(file)?, file, &changes)?;
        recipe.quality.measured_paths = paths.parse()?;
        let object = Object::new(&recipe, Path::new(file).parent().unwrap_or(Path::new("")))?;
        let plan = Plan::new(&recipe)?;
        let white = 1.0 / exposure(&recipe, &object, &plan, &|_| ())?;
        let m = Measurement::new(&recipe, &object, &plan, white);
        let start = Instant::now();
        let mut last = processor_seconds(start);
        let mut lap = || {
            let now = processor_seconds(start);
            now - std::mem::replace(&mut last, now)
        };
        let stem = Path::new(file).file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let at = keep.as_ref().map(|k| k.join(format!("{stem}-{}-{paths}.references", m.cameras[0].intrinsics.width)));
        let references = match at.as_ref().and_then(|at| kept(at, &m)) {
            Some(references) => references,
            None => {
                let made = reference_pairs(&m.scene, &m.cameras, &m.reference)?;
                if let Some(at) = &at {
                    std::fs::create_dir_all(at.parent().unwrap_or(Path::new("")))?;
                    std::fs::write(at, of_pairs(&made))?;
                }
                made
            }
        };
        let reference = lap();
        let bulk = Bulk::solve(&m.scene, &m.bulk, &|_| ())?;
        let solve = lap();
        let view = bulk.render(&m.cameras[0], 0)?;
        let rendered = lap();
        let half = |seed: u64| {
            let (walks, seed) = ((m.bulk.walks / 2).max(1), m.bulk.seed.wrapping_add(seed));
            Bulk::solve(&m.scene, &BulkOptions { walks, seed, ..m.bulk }, &|_| ())
        };
        let halves = [half(1)?, half(2)?];
        let e = BulkError::between(&bulk, [&halves[0], &halves[1]], &m.cameras, &references, m.white)?;
        println!(
            "| {} | {} × {} | {:+.2} | {:.2} | {:.2} | {:.2} | {:.2} | {:.2} | {:.2} | {:.1} | {solve:.1} | {rendered:.2} | {reference:.0} |",
            recipe.name,
            bulk.points(),
            m.bulk.walks,
            100.0 * e.bias,
            100.0 * e.bias_standard_error.hypot(e.bias_noise),
            100.0 * e.rmse,
            100.0 * e.square_standard_error / (2.0 * e.rmse).max(e.square_standard_error.sqrt()),
            100.0 * e.rmse_beyond_white,
            100.0 * e.systematic(),
            100.0 * e.noise,
            e.noise_db,
        );
        if whole {
            let falloff = Falloff::InverseSquare { reference: recipe.rig.light_distance };
            let mut scene = m.scene.clone();
            scene.lights = plan.lights.iter().map(|l| Light::Olat { light: *l, falloff }).collect();
            lap();
            let bulk = Bulk::solve(&scene, &m.bulk, &|_| ())?;
            let solve = lap();
            bulk.render(&m.cameras[0], 0)?;
            println!("all {} lamps: solve {solve:.1} CPU s, view {:.2} CPU s", scene.lights.len(), lap());
        }
        if let Some(folder) = &folder {
            std::fs::create_dir_all(folder)?;
            std::fs::write(folder.join(&stem).with_extension("ppm"), picture(&references[0], &view.lights))?;
        }
        if let Some(keep) = &keep {
            let views = [view, halves[0].render(&m.cameras[0], 1)?, halves[1].render(&m.cameras[0], 2)?];
            std::fs::write(keep.join(format!("{stem}.f32")), everything(&references[0], &views))?;
        }
    }
    Ok(())
}
