//! The report in words.
use super::advice::advice;
use super::counted;
use super::findings::{Findings, Gap, Range, fov_x_degrees};
use diamond_dataset::{Capture, Split, TransferChoice};
use glam::Vec3;
use std::fmt::Write;

/// What there is in a capture, in words: cameras, lights, coverage, exposure, masks, and what is missing and what that
/// means. Ends with a line break. At most 512 images are decoded.
pub fn inspect_text(capture: &Capture) -> String {
    let f = Findings::of(capture);
    let mut out = String::new();
    // Writing to a string cannot fail.
    let _ = report(&mut out, capture, &f);
    out
}

fn report(out: &mut String, capture: &Capture, f: &Findings) -> std::fmt::Result {
    writeln!(out, "Capture   {}", capture.root.display())?;
    writeln!(out, "Format    {}", capture.format)?;
    if let Ok(hash) = capture.hash() {
        writeln!(out, "Hash      {hash}")?;
    }
    writeln!(out, "\nImages")?;
    for (name, views, matrix) in [("training", &capture.train, &f.train), ("held out", &capture.test, &f.test)] {
        let (images, cells) = matrix.filled();
        write!(out, "  {name}  {}", counted(images, "image"))?;
        match cells - images {
            0 if images == 0 => writeln!(out)?,
            0 => writeln!(out, ": {} × {}, complete", counted(views.len(), "view"), counted(matrix.columns, "light"))?,
            n => writeln!(
                out,
                ": {} × {}, {n} of {cells} not there",
                counted(views.len(), "view"),
                counted(matrix.columns, "light")
            )?,
        }
    }
    writeln!(out, "\nCameras")?;
    for (k, count) in &f.intrinsics {
        writeln!(
            out,
            "  {}  {}×{} pixels, field of view {:.2}°, focal {:.2} {:.2}, centre {:.2} {:.2}",
            counted(*count, "view"),
            k.width,
            k.height,
            fov_x_degrees(k),
            k.fx,
            k.fy,
            k.cx,
            k.cy
        )?;
    }
    writeln!(out, "  distance  {} scene units from the centre {}", show(f.camera_distance), point(f.scene.centre))?;
    writeln!(out, "  axes      pass the centre within {:.3}", f.axis_miss)?;
    writeln!(out, "  framed    a sphere of radius {:.3} round the centre is in every image", f.scene.framed_radius)?;
    writeln!(out, "  extent    {:.3} (unit of position learning rates)", f.scene.camera_extent)?;
    writeln!(out, "  widest gap between views   {}", gap(f.camera_gap, f.up))?;
    writeln!(out, "\nLights")?;
    match capture.shared_rig(Split::Train) {
        Some(rig) => writeln!(out, "  one rig of {} for all views", counted(rig.len(), "light"))?,
        None => writeln!(out, "  each view has lights of its own (a turntable)")?,
    }
    if let Some((a, b)) = f.light_distance {
        writeln!(out, "  distance  {} scene units from the centre", show(Some((a, b))))?;
    }
    if f.directional_lights > 0 {
        writeln!(out, "  {} images under directional light", f.directional_lights)?;
    }
    writeln!(
        out,
        "  intensity {}",
        if f.intensities_given { "as the frames say" } else { "1 (the frames say nothing)" }
    )?;
    writeln!(out, "  widest gap between lights  {}", gap(f.light_gap, f.up))?;
    if !capture.test.is_empty() {
        let (seen, unseen) = f.seen_unseen;
        writeln!(out, "  held out  {seen} images under lights seen in training, {unseen} under unseen ones")?;
    }
    writeln!(out, "\nExposure  ({} of {} images, {})", f.examined.0, f.examined.1, transfer(capture))?;
    let (clipped, black) = f.exposure.fractions();
    let what = if f.masked > 0 { "object pixels" } else { "all pixels   " };
    writeln!(out, "  {what}  {}", f.exposure.pixels)?;
    writeln!(out, "  clipped        {:.2} % (a channel at 255)", 100.0 * clipped)?;
    writeln!(out, "  black          {:.2} % (all channels at 2 or below)", 100.0 * black)?;
    writeln!(out, "  histogram      {}  0 to 255", bars(&f.exposure.histogram))?;
    writeln!(out, "\nMasks")?;
    match (f.masked, f.examined.0 - f.masked) {
        (0, _) => writeln!(out, "  none: no image has an alpha channel")?,
        (with, 0) => writeln!(out, "  all {with} images examined have alpha")?,
        (with, without) => writeln!(out, "  {with} images examined have alpha, {without} have none")?,
    }
    if let Some(coverage) = f.coverage {
        writeln!(out, "  the object covers {:.1} % of a picture", 100.0 * coverage)?;
        let straight = "straight; multiplied by alpha when loaded";
        let reading = if capture.alpha_premultiplied() { "already multiplied by alpha" } else { straight };
        writeln!(out, "  RGB is read as {reading}")?;
    }
    writeln!(out, "\nAlso there")?;
    let name = capture.points.as_ref().map(|p| p.strip_prefix(&capture.root).unwrap_or(p).display().to_string());
    writeln!(out, "  point cloud     {}", name.as_deref().unwrap_or("no"))?;
    let with_truth = |split| capture.views(split).iter().filter(|v| v.has_ground_truth_geometry()).count();
    let (train, test) = (with_truth(Split::Train), with_truth(Split::Test));
    writeln!(out, "  true geometry   {train} training and {test} held-out views")?;
    writeln!(out, "  synthetic       {} training images", f.synthetic)?;

    let items = advice(capture, f);
    writeln!(out, "\nWhat is missing, and what that means")?;
    if items.is_empty() {
        writeln!(out, "  nothing")?;
    }
    for item in items {
        writeln!(out, "  - {item}")?;
    }
    Ok(())
}

fn show(range: Range) -> String {
    match range {
        None => "none".into(),
        Some((a, b)) if (b - a).abs() < 1e-3 * b.abs() => format!("{a:.3}"),
        Some((a, b)) => format!("{a:.3} to {b:.3}"),
    }
}

/// A point with three digits and without negative zeros.
fn point(v: Vec3) -> String {
    let [x, y, z] = v.to_array().map(|x| (x * 1000.0).round() / 1000.0 + 0.0);
    format!("({x:.3}, {y:.3}, {z:.3})")
}

/// The gap with its direction as elevation above the horizon.
fn gap(gap: Option<Gap>, up: Vec3) -> String {
    let Some(gap) = gap else { return "unknown".into() };
    let elevation = gap.direction.dot(up).clamp(-1.0, 1.0).asin().to_degrees();
    let side = if elevation >= 0.0 { "above" } else { "below" };
    format!("{:.0}°, at {:.0}° {side} the horizon, toward {}", gap.degrees, elevation.abs(), point(gap.direction))
}

fn transfer(capture: &Capture) -> &'static str {
    match capture.options.transfer {
        TransferChoice::Srgb => "stored as sRGB",
        TransferChoice::Linear => "stored linear",
        TransferChoice::Gamma22 => "stored with gamma 2.2",
    }
}

/// A histogram in one line; neighbours are joined to 32 columns.
fn bars(histogram: &[u64]) -> String {
    const LEVELS: [char; 9] = [' ', '▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
    let joined: Vec<u64> = histogram.chunks(2).map(|c| c.iter().sum()).collect();
    let top = joined.iter().copied().max().unwrap_or(0).max(1);
    // A column that is not empty shows at least the lowest bar.
    joined.iter().map(|&n| LEVELS[((n * 8).div_ceil(top)) as usize]).collect()
}
