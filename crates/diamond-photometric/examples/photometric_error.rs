//! How wrong are normals from photometric stereo? On a capture whose true geometry is known.
//!
//! ```text
//! cargo run --release -p diamond-photometric --features parallel --example photometric_error -- assets/captures/candle-small
//! cargo run --release -p diamond-photometric --features parallel --example photometric_error -- CAPTURE 16,8,3 views=3 out=FOLDER
//! ```
//!
//! For each number of lights: median and mean angle to the true normals over all pixels that the mask covers, of the
//! estimate, of the naive one and of the inflated silhouette; the error by decile of confidence; the error of depth after
//! alignment. With `out=`, a picture per view: true, estimated, naive and silhouette normals, error (white: 45°), confidence.
use diamond_dataset::{Capture, OpenOptions, View};
use diamond_image::{Image, Mask};
use diamond_light::{Falloff, OlatLight};
use diamond_photometric::*;
use glam::Vec3;
use std::error::Error;
use std::time::Instant;

/// Angles to the truth in degrees, with each pixel's confidence, of what is fully covered.
fn errors(found: &Image, truth: &Image, mask: &Mask) -> Vec<(usize, f32)> {
    (0..mask.data().len())
        .filter_map(|i| {
            let (f, t) = (Vec3::from_slice(&found.data()[3 * i..]), Vec3::from_slice(&truth.data()[3 * i..]));
            (mask.data()[i] > 0.99 && t.length() > 0.5 && f.length() > 0.5)
                .then(|| (i, f.angle_between(t).to_degrees()))
        })
        .collect()
}

fn median(values: &mut [f32]) -> f32 {
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f32::NAN)
}

/// `count` of the shots: all, evenly spread over the list, or drawn with a fixed seed where `random`.
fn chosen(view: &View, count: usize, draw: u64) -> Vec<usize> {
    let all = view.shots.len();
    if count >= all {
        return (0..all).collect();
    }
    let mut order: Vec<usize> = (0..all).collect();
    let mut state = 0x9E37_79B9_7F4A_7C15u64.wrapping_mul(draw + 1);
    for k in 0..count {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        order.swap(k, k + (state >> 33) as usize % (all - k));
    }
    order.truncate(count);
    order.sort_unstable();
    order
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let option = |name: &str| arguments.iter().find_map(|a| a.strip_prefix(name).and_then(|a| a.strip_prefix('=')));
    let folder =
        arguments.first().ok_or("usage: photometric_error CAPTURE [16,8,3] [views=3] [draws=1] [out=FOLDER]")?;
    let counts = arguments.iter().skip(1).find(|a| !a.contains('=')).map_or("16,8,3", |a| a);
    let views: usize = option("views").map_or(Ok(3), str::parse)?;
    let draws: u64 = option("draws").map_or(Ok(1), str::parse)?;
    let mut options = PhotometricOptions::default();
    let number = |name: &str, default: f32| option(name).map_or(Ok(default), str::parse);
    options.sharpening = number("sharpening", options.sharpening)?;
    options.pull = number("pull", options.pull)?;
    options.rounds = number("rounds", options.rounds as f32)? as u32;
    options.anchoring = number("anchoring", options.anchoring)?;
    options.lean = option("lean").map(str::parse).transpose()?;
    options.shadow_doubt = number("shadow_doubt", options.shadow_doubt)?;

    let capture = Capture::open(folder.as_ref(), &OpenOptions::default())?;
    let known: Vec<&View> = capture.train.iter().filter(|v| v.has_ground_truth_geometry()).collect();
    if known.is_empty() {
        return Err("the capture has no geometry/train_*.exr".into());
    }
    let views: Vec<&View> = (0..views.min(known.len()))
        .map(|i| known[if views > 1 { i * (known.len() - 1) / (views.min(known.len()) - 1).max(1) } else { 0 }])
        .collect();
    println!("{folder}: {} views; angle to the true normal in degrees, median (mean)", views.len());
    println!("lights   estimate        naive           silhouette      depth %  ms/view");
    for count in counts.split(',') {
        let count: usize = count.parse()?;
        let (mut estimate, mut naive, mut outline) = (Vec::new(), Vec::new(), Vec::new());
        let mut by_confidence: Vec<(f32, f32)> = Vec::new();
        let (mut depth, mut time) = (Vec::new(), 0.0);
        for (v, view) in views.iter().enumerate() {
            let Some(truth) = view.ground_truth_geometry()? else { continue };
            for draw in 0..if count >= view.shots.len() { 1 } else { draws } {
                let shots = chosen(view, count, draw + 17 * v as u64);
                let observations: Vec<_> =
                    shots.iter().map(|&s| capture.observation(&view.shots[s])).collect::<Result<_, _>>()?;
                let images: Vec<&Image> = observations.iter().map(|o| &o.radiance).collect();
                let lights: Vec<OlatLight> = shots.iter().map(|&s| view.shots[s].light).collect();
                let mask = observations[0].mask.clone().ok_or("no mask")?;
                let photometric_view = PhotometricView {
                    camera: &view.camera,
                    mask: &mask,
                    images: &images,
                    lights: &lights,
                    falloff: Falloff::InverseSquare { reference: 1.0 },
                    distance: view.camera.pose.centre().distance(capture.scene().centre),
                };
                let start = Instant::now();
                let found = match photometric_stereo(&photometric_view, &options) {
                    Ok(found) => found,
                    Err(e) => {
                        println!("view {}: {e}", view.name);
                        continue;
                    }
                };
                time += start.elapsed().as_secs_f64();
                let plain = naive_normals(&photometric_view)?;
                let silhouette = silhouette_normals(&view.camera, &mask)?;
                let these = errors(&found.normals, &truth.normal, &mask);
                by_confidence.extend(these.iter().map(|(i, e)| (found.confidence.data()[*i], *e)));
                estimate.extend(these.iter().map(|e| e.1));
                naive.extend(errors(&plain, &truth.normal, &mask).iter().map(|e| e.1));
                outline.extend(errors(&silhouette, &truth.normal, &mask).iter().map(|e| e.1));
                let mut gaps: Vec<f32> =
                    these.iter().map(|(i, _)| found.depth.data()[*i] - truth.depth.data()[*i]).collect();
                let middle = median(&mut gaps);
                depth.extend(gaps.iter().map(|g| (g - middle).abs()));
                if let Some(out) = option("out") {
                    let path = format!("{out}/{}-{count}-{draw}.ppm", view.name);
                    std::fs::create_dir_all(out)?;
                    std::fs::write(path, picture(&found, &plain, &silhouette, &truth.normal, &mask))?;
                }
            }
        }
        let mean = |v: &[f32]| v.iter().sum::<f32>() / v.len().max(1) as f32;
        println!(
            "{count:<8} {:<5.1} ({:<5.1})   {:<5.1} ({:<5.1})   {:<5.1} ({:<5.1})   {:<7.1}  {:.0}",
            median(&mut estimate),
            mean(&estimate),
            median(&mut naive),
            mean(&naive),
            median(&mut outline),
            mean(&outline),
            100.0 * median(&mut depth) / 2.0,
            1e3 * time / (views.len() as f64 * draws as f64),
        );
        by_confidence.sort_by(|a, b| a.0.total_cmp(&b.0));
        let decile = |k: usize| {
            let part = &by_confidence[by_confidence.len() * k / 10..by_confidence.len() * (k + 1) / 10];
            let mut e: Vec<f32> = part.iter().map(|p| p.1).collect();
            let c = part.iter().map(|p| p.0).sum::<f32>() / part.len().max(1) as f32;
            format!("{:.2}:{:.1}", c, median(&mut e))
        };
        println!("         error by decile of confidence: {}", (0..10).map(decile).collect::<Vec<_>>().join("  "));
    }
    Ok(())
}

/// Six pictures side by side as PPM.
fn picture(found: &PhotometricStereo, naive: &Image, silhouette: &Image, truth: &Image, mask: &Mask) -> Vec<u8> {
    let (w, h) = (mask.width(), mask.height());
    let mut out = format!("P6 {} {h} 255\n", 6 * w).into_bytes();
    for y in 0..h {
        for panel in 0..6 {
            for x in 0..w {
                let at = |image: &Image| Vec3::from_slice(image.pixel(x, y));
                let on = mask.coverage(x, y) > 0.5;
                let colour = match panel {
                    _ if !on => Vec3::ZERO,
                    0 => 0.5 * at(truth) + 0.5,
                    1 => 0.5 * at(&found.normals) + 0.5,
                    2 => 0.5 * at(naive) + 0.5,
                    3 => 0.5 * at(silhouette) + 0.5,
                    4 if at(truth).length() < 0.5 => Vec3::ZERO,
                    4 => Vec3::splat(at(&found.normals).angle_between(at(truth)).to_degrees() / 45.0),
                    _ => Vec3::splat(found.confidence.pixel(x, y)[0]),
                };
                out.extend(colour.to_array().map(|v| (255.0 * v.clamp(0.0, 1.0)).round() as u8));
            }
        }
    }
    out
}
