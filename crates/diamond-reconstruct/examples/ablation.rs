//! Trains one configuration on a capture and prints PSNR on its test pairs, seen and unseen lights apart: the smallest
//! loop for comparing settings. `cargo run --release -p diamond-reconstruct --example ablation -- CAPTURE PRESET
//! [key=value …]`, where a key is a dotted path of the configuration such as `loss.ssim`, `views`/`lights` select, and
//! `needs=everything` leaves nothing out.
use diamond_dataset::{Capture, OpenOptions, Selection};
use diamond_reconstruct::{Config, Needs, Reconstruction};
use std::time::Instant;

type Failure = Box<dyn std::error::Error>;

fn psnr(squares: &[f64]) -> f64 {
    squares.iter().map(|s| -10.0 * s.max(1e-12).log10()).sum::<f64>() / squares.len().max(1) as f64
}

fn main() -> Result<(), Failure> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [capture, preset, rest @ ..] = args.as_slice() else {
        return Err("usage: ablation CAPTURE PRESET [key=value …]".into());
    };
    let mut text = format!("base = \"{preset}\"\n");
    let (mut views, mut lights, mut everything) = (Selection::All, Selection::All, false);
    for pair in rest {
        let (key, value) = pair.split_once('=').ok_or("expected key=value")?;
        match key {
            "views" => views = value.parse()?,
            "lights" => lights = value.parse()?,
            "needs" if value == "everything" => everything = true,
            _ => text.push_str(&format!("{key} = {value}\n")),
        }
    }
    let config = Config::parse(&text, "command line")?;
    let capture = Capture::open(capture.as_ref(), &OpenOptions::default())?.select(&views, &lights)?;
    let mut run = match everything {
        true => Reconstruction::with_needs(capture, &config, Needs::everything())?,
        false => Reconstruction::new(capture, &config)?,
    };
    let start = Instant::now();
    let mut recent = 0.0;
    while !run.finished() {
        let report = run.step()?;
        recent += report.psnr / 500.0;
        if run.steps_done().is_multiple_of(500) {
            let terms: Vec<String> = report.terms.iter().map(|t| format!("{} {:.5}", t.name, t.value)).collect();
            eprintln!(
                "{:6} {:7.1} s  train {recent:.2} dB  {} Gaussians ({} visible)  {}",
                run.steps_done(),
                start.elapsed().as_secs_f64(),
                report.gaussians,
                report.visible,
                terms.join("  ")
            );
            recent = 0.0;
        }
    }
    let seconds = start.elapsed().as_secs_f64();
    let capture = run.capture().clone();
    let mut groups: [[Vec<f64>; 2]; 2] = Default::default();
    for view in &capture.test {
        for shot in &view.shots {
            let truth = capture.observation(shot)?;
            let rendering = run.render(&view.camera, &[shot.light])?.remove(0);
            let seen = usize::from(!capture.is_seen_light(&shot.light));
            let (mut all, mut inside, mut count) = (0.0, 0.0, 0.0);
            for (i, (pixel, stored)) in
                rendering.radiance.data().chunks_exact(3).zip(truth.display.chunks_exact(3)).enumerate()
            {
                let error: f64 = pixel
                    .iter()
                    .zip(stored)
                    .map(|(r, t)| {
                        let r = (diamond_image::Transfer::Srgb.encode(*r).clamp(0.0, 1.0) * 255.0).round() as f64;
                        ((r - *t as f64) / 255.0).powi(2)
                    })
                    .sum();
                all += error;
                if truth.mask.as_ref().is_some_and(|m| m.data()[i] > 0.5) {
                    inside += error;
                    count += 3.0;
                }
            }
            groups[seen][0].push(all / rendering.radiance.data().len() as f64);
            groups[seen][1].push(inside / f64::max(count, 1.0));
        }
    }
    for (name, seconds) in run.profile() {
        eprintln!("{name:20} {:8.3} ms/step", 1e3 * seconds / config.steps as f64);
    }
    for (name, count) in run.counters() {
        eprintln!("{name:32} {:12.2} /step", count as f64 / config.steps as f64);
    }
    println!(
        "{preset} {} | seen {:.2} dB (masked {:.2}) | unseen {:.2} dB (masked {:.2}) | {:.2} steps/s | {} Gaussians",
        rest.join(" "),
        psnr(&groups[0][0]),
        psnr(&groups[0][1]),
        psnr(&groups[1][0]),
        psnr(&groups[1][1]),
        config.steps as f64 / seconds,
        run.model()?.len()
    );
    Ok(())
}
