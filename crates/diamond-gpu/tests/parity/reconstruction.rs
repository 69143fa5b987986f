//! A small reconstruction whose steps are made on the device, against one on the CPU alone.
use diamond_dataset::{Capture, OpenOptions, Selection};
use diamond_gpu::{Device, DeviceStepper};
use diamond_image::Transfer;
use diamond_metrics::psnr;
use diamond_reconstruct::{Config, Model, Reconstruction, SubsurfaceModel};
use std::sync::Arc;

/// dB by which the two may differ.
const TOLERANCE: f64 = 0.1;

fn capture() -> Result<Capture, String> {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/captures/spot-small");
    Capture::open(folder.as_ref(), &OpenOptions::default())
        .and_then(|c| c.select(&Selection::Count(4), &Selection::Count(2)))
        .map_err(|error| error.to_string())
}

/// The model after so many steps, and the PSNR of held-out images, display sRGB, before and after.
fn train(capture: &Capture, steps: u64, device: Option<&Arc<Device>>) -> Result<(Model, [f64; 2]), String> {
    let text = |error: diamond_reconstruct::ReconstructError| error.to_string();
    let mut config = Config::preset("resolved").map_err(text)?;
    config.steps = steps;
    config.initial.count = 600;
    // A medium takes longer to fit than all these steps; parity of its parts is tested with the others'.
    config.subsurface.model = SubsurfaceModel::Mlp;
    let mut run = Reconstruction::new(capture.clone(), &config).map_err(text)?;
    if let Some(device) = device {
        let stepper = DeviceStepper::new(device.clone()).map_err(|error| error.to_string())?;
        if let Some(lacking) = run.step_by(Box::new(stepper)) {
            return Err(format!("the device lacks {lacking}"));
        }
    }
    let before = held_out(capture, &mut run)?;
    while !run.finished() {
        run.step().map_err(text)?;
    }
    let made = run.counters().iter().find(|(name, _)| *name == "steps on the device").map_or(0, |(_, n)| *n);
    if device.is_some() && made != steps {
        return Err(format!("{made} of {steps} steps were made on the device: {:?}", run.take_notes()));
    }
    let quality = [before, held_out(capture, &mut run)?];
    Ok((run.model().map_err(text)?.clone(), quality))
}

fn held_out(capture: &Capture, run: &mut Reconstruction) -> Result<f64, String> {
    let display = |image: &diamond_image::Image| image.map(|v| Transfer::Srgb.encode(v).clamp(0.0, 1.0));
    let (mut sum, mut count) = (0.0, 0);
    for view in capture.test.iter().take(1) {
        for shot in view.shots.iter().take(2) {
            let photograph = capture.observation(shot).map_err(|error| error.to_string())?;
            let lights = [shot.light];
            let rendered = run.render(&view.camera, &lights).map_err(|error| error.to_string())?;
            sum += psnr(&display(&rendered[0].radiance), &display(&photograph.radiance), 1.0)
                .map_err(|error| error.to_string())?;
            count += 1;
        }
    }
    if count == 0 { Err("the capture has no held-out image".into()) } else { Ok(sum / f64::from(count)) }
}

/// Both runs come to the same quality, better than they began, and a run on the device has the same bits again.
pub fn agrees(device: &Arc<Device>) -> Result<(), String> {
    let capture = capture()?;
    let (_, [before, cpu]) = train(&capture, 15, None)?;
    let (_, [_, gpu]) = train(&capture, 15, Some(device))?;
    println!("parity: reconstruction: {before:.3} dB before, {cpu:.3} dB on the CPU, {gpu:.3} dB on the device");
    if (cpu - gpu).abs() > TOLERANCE || cpu < before + 1.0 {
        return Err(format!("{before:.3} dB before, {cpu:.3} dB on the CPU, {gpu:.3} dB on the device"));
    }
    let (first, _) = train(&capture, 2, Some(device))?;
    let (second, _) = train(&capture, 2, Some(device))?;
    if first.parameters != second.parameters {
        return Err("the second run on the device has other bits".into());
    }
    Ok(())
}
