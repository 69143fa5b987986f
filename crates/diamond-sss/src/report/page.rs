//! The page: figures, pictures, curves, maps and the light control, put together into one file.
use super::chart::{chart, smooth};
use super::light_control::light_control;
use super::maps::{data_uri, map_pictures};
use crate::metrics_file::save_images;
use crate::picture::{encode_png_linear, encode_png_rgb, heat_bytes};
use crate::{AtOnce, Metrics, RunRecord, SssError, TrainingLog, render_lights, write_output};
use diamond_dataset::{Capture, Shot, View};
use diamond_image::Image;
use diamond_metrics::{FlipOptions, flip_ldr};
use diamond_reconstruct::{CaptureFacts, Model, Needs};
use std::fmt::Write;
use std::path::Path;

/// Held-out images shown.
const SHOWN: usize = 6;
/// Points of a curve.
const CURVE_POINTS: usize = 160;

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Writes `report.html` in the run's folder: self-contained, opens without a network. The held-out images that it shows go to
/// `images/` beside it, as `diamond evaluate --save-images` writes all of them.
pub fn write_report(
    folder: &Path,
    model: &Model,
    capture: &Capture,
    metrics: &Metrics,
    record: &RunRecord,
    log: &TrainingLog,
    at_once: &AtOnce,
) -> Result<(), SssError> {
    let (views, held_out) = if capture.test.is_empty() { (&capture.train, false) } else { (&capture.test, true) };
    let Some(view) = views.first() else { return Err(SssError::Internal("a capture without views".into())) };
    let mut body = String::new();
    headline(&mut body, metrics);
    let rig = rig_for(capture, view);
    let control = light_control(model, at_once, &view.camera, &rig)?;
    body += include_str!("light_control.html");
    body += &comparisons(folder, model, at_once, capture, views, held_out)?;
    body += "<section><h2>Course of the run</h2><div class=\"charts\">";
    let curve = |f: &dyn Fn(&crate::LogRow) -> f64| -> Vec<(f64, f64)> {
        smooth(&log.rows.iter().map(|r| (r.step as f64, f(r))).collect::<Vec<_>>(), CURVE_POINTS)
    };
    body += &chart("PSNR of training images", "dB, against step", &curve(&|r| r.psnr), false);
    body += &chart("Objective", "against step", &curve(&|r| r.objective), true);
    body += &chart("Gaussians", "against step", &curve(&|r| r.gaussians as f64), true);
    body += "</div></section>";
    body += &maps(model, view)?;
    facts(&mut body, metrics, record, model);
    needs(&mut body, &Needs::decide(&model.config, &CaptureFacts::of(capture)?));
    let data = serde_json::to_string(&control).map_err(|e| SssError::Internal(e.to_string()))?;
    let title = capture.root.file_name().map_or("capture".into(), |n| n.to_string_lossy().into_owned());
    let page = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"><title>{title} · DIAMOND-SSS</title>\
         <style>{css}</style></head><body><main><header><h1>{title}</h1>\
         <p>Relightable reconstruction from {images} photographs, each under one light</p></header>{body}</main>\
         <script type=\"application/json\" id=\"olat\">{data}</script><script>{js}</script></body></html>\n",
        title = escape(&title),
        css = include_str!("report.css"),
        js = include_str!("report.js"),
        images = record.training_images,
        data = data.replace("</", "<\\/"),
    );
    write_output(&folder.join("report.html"), page.as_bytes())
}

/// The lights for the control: the whole rig where views share it, else the view's own.
fn rig_for(capture: &Capture, view: &View) -> Vec<diamond_light::OlatLight> {
    match capture.shared_rig(diamond_dataset::Split::Train) {
        Some(rig) => rig,
        None => {
            let nearest = capture.train.iter().min_by(|a, b| {
                let distance = |v: &View| v.camera.pose.centre().distance(view.camera.pose.centre());
                distance(a).total_cmp(&distance(b))
            });
            nearest.unwrap_or(view).shots.iter().map(|s| s.light).collect()
        }
    }
}

fn headline(out: &mut String, metrics: &Metrics) {
    // Writing to a string cannot fail.
    let _ = write!(out, "<section class=\"tiles\">");
    let size = metrics.resolution().map_or("several sizes".to_owned(), |(w, h)| format!("{w} × {h}"));
    type Keep = fn(&crate::ImageScore) -> bool;
    let groups: [(&str, Keep); 3] = [
        ("All held-out images", |_| true),
        ("Lights seen in training", |s| s.seen_light),
        ("Lights never photographed", |s| !s.seen_light),
    ];
    for (name, keep) in groups {
        let Some(s) = metrics.summary(false, keep) else { continue };
        let masked = metrics.summary(true, keep).map_or(String::new(), |m| {
            format!("inside the mask {:.2} dB · {:.4} · {:.4}", m.mean.psnr, m.mean.ssim, m.mean.flip)
        });
        let _ = write!(
            out,
            "<div class=\"tile\"><h3>{name}</h3><p class=\"big\">{:.2}<small> dB PSNR</small></p>\
             <p>SSIM {:.4} · FLIP {:.4}</p><p class=\"quiet\">{masked}</p>\
             <p class=\"quiet\">{} images, {size} pixels</p></div>",
            s.mean.psnr, s.mean.ssim, s.mean.flip, s.images
        );
    }
    if metrics.scores.is_empty() {
        out.push_str(
            "<div class=\"tile\"><h3>No held-out images</h3><p>The capture has none, so nothing is measured here.</p></div>",
        );
    }
    out.push_str("</section>");
}

/// A few images spread over all: first and last view, seen and unseen lights.
fn spread(views: &[View]) -> Vec<(&View, Vec<&Shot>)> {
    let all: Vec<(usize, usize)> =
        views.iter().enumerate().flat_map(|(v, view)| (0..view.shots.len()).map(move |s| (v, s))).collect();
    let n = all.len().min(SHOWN);
    let mut out: Vec<(usize, Vec<&Shot>)> = Vec::new();
    for i in 0..n {
        let (v, s) = all[if n > 1 { i * (all.len() - 1) / (n - 1) } else { 0 }];
        match out.iter_mut().find(|(view, _)| *view == v) {
            Some((_, shots)) => shots.push(&views[v].shots[s]),
            None => out.push((v, vec![&views[v].shots[s]])),
        }
    }
    out.into_iter().map(|(v, shots)| (&views[v], shots)).collect()
}

fn comparisons(
    folder: &Path,
    model: &Model,
    at_once: &AtOnce,
    capture: &Capture,
    views: &[View],
    held_out: bool,
) -> Result<String, SssError> {
    let kind = if held_out { "held-out images" } else { "training images (there are no held-out ones)" };
    let mut out = format!(
        "<section><h2>Photograph and render</h2><p>Some {kind}. The error map is FLIP: the difference that an observer \
         sees, black for none, pale yellow for 1.</p><div class=\"rows\">"
    );
    let renderer = at_once.renderer(model);
    for (view, shots) in spread(views) {
        let lights: Vec<_> = shots.iter().map(|s| s.light).collect();
        render_lights(&renderer, &view.camera, &lights, |i, radiance| {
            let shot = shots[i];
            let observation = capture.observation(shot)?;
            let (width, height) = (shot.width as usize, shot.height as usize);
            let image = |bytes: &[u8]| {
                Image::from_vec(width, height, 3, bytes.iter().map(|b| f32::from(*b) / 255.0).collect())
                    .map_err(|e| SssError::Internal(e.to_string()))
            };
            let render = diamond_dataset::to_display(radiance);
            let (a, b) = (image(&observation.display)?, image(&render)?);
            let flip = flip_ldr(&a, &b, FlipOptions::default())?;
            let psnr = diamond_metrics::psnr(&a, &b, 1.0)?.min(crate::PSNR_CAP);
            let seen = if capture.is_seen_light(&shot.light) { "seen light" } else { "unseen light" };
            save_images(folder, &shot.name, [&render, &observation.display], &flip.map)?;
            let picture = |png: Vec<u8>, caption: &str| {
                format!(
                    "<figure><img alt=\"{caption}\" src=\"{}\"><figcaption>{caption}</figcaption></figure>",
                    data_uri(&png)
                )
            };
            out += &format!(
                "<div class=\"row\">{}{}{}<p><b>{}</b><br>{seen}<br>{psnr:.2} dB<br>FLIP {:.4}</p></div>",
                picture(encode_png_rgb(&observation.display, width, height)?, "photograph"),
                picture(encode_png_linear(radiance)?, "render"),
                picture(encode_png_rgb(&heat_bytes(&flip.map, 1.0), width, height)?, "FLIP"),
                escape(&shot.name),
                flip.mean
            );
            Ok(())
        })?;
    }
    Ok(out + "</div></section>")
}

fn maps(model: &Model, view: &View) -> Result<String, SssError> {
    let mut out = format!("<section><h2>What {} is made of</h2><div class=\"maps\">", escape(&view.name));
    let lights: Vec<_> = view.shots.iter().take(1).map(|s| s.light).collect();
    for rendering in model.render(&view.camera, &lights)? {
        for (name, remark, png) in map_pictures(&rendering)? {
            out += &format!(
                "<figure><img alt=\"{name}\" src=\"{}\"><figcaption>{name} <span>{remark}</span></figcaption></figure>",
                data_uri(&png)
            );
        }
    }
    Ok(out + "</div></section>")
}

/// What was computed and what was not, with reasons.
fn needs(out: &mut String, needs: &Needs) {
    let skipped = needs.skipped().count();
    out.push_str(&format!(
        "<section><h2>What was computed</h2><p>{skipped} of {} things were left out, since this configuration and this \
         capture do not need them. Counts of the work are in profile.json.</p><details><summary>All decisions</summary>\
         <table class=\"facts\">",
        needs.rows().len()
    ));
    for row in needs.rows() {
        let (mark, saved) = match row.decision.needed {
            true => ("computed", String::new()),
            false => ("left out", format!("; saves {}", row.saves)),
        };
        let reason = escape(&row.decision.reason);
        out.push_str(&format!("<tr><th>{}</th><td>{mark}: {reason}{saved}</td></tr>", row.name));
    }
    out.push_str("</table></details></section>");
}

fn facts(out: &mut String, metrics: &Metrics, record: &RunRecord, model: &Model) {
    let seconds = metrics.seconds.map_or("not known".into(), |s| match s {
        s if s < 90.0 => format!("{s:.1} seconds"),
        s => format!("{:.0} minutes {:02.0} seconds", (s / 60.0).floor(), s % 60.0),
    });
    let peak = metrics.peak_bytes.map_or("not known".into(), |b| format!("{:.0} MiB", b as f64 / f64::from(1 << 20)));
    out.push_str("<section><h2>How it was made</h2><table class=\"facts\">");
    for (name, value) in [
        ("Command", if record.command.is_empty() { "library call".into() } else { record.command.clone() }),
        ("Capture", record.capture.display().to_string()),
        ("Capture hash", record.capture_hash.clone()),
        ("Training views, lights", format!("{}, {} ({} images)", record.views, record.lights, record.training_images)),
        ("Preset", record.preset.clone()),
        ("Steps", record.steps.to_string()),
        ("Seed", record.seed.to_string()),
        ("Gaussians", model.len().to_string()),
        ("Shape in held-out views", metrics.shape.sentence()),
        ("Gain of held-out images", metrics.gain_sentence()),
        ("Time", seconds),
        ("Peak memory", peak),
        ("Threads", record.threads.to_string()),
        ("Instruction set", record.instruction_set.clone()),
        ("Version", record.version.clone()),
    ] {
        let _ = write!(out, "<tr><th>{name}</th><td>{}</td></tr>", escape(&value));
    }
    out.push_str(
        "</table><p class=\"quiet\">PSNR has peak 1 over all pixels of 8-bit sRGB images; SSIM an 11×11 window, \
         zero-padded; FLIP 67 pixels per degree. All figures with standard deviations are in metrics.json.</p></section>",
    );
}
