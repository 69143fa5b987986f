//! A whole rig in bulk beside one path tracer run per light: what an image of a capture costs at the same noise.
//!
//! The bulk solution is shared by all views and lights, so its cost is spread over a capture of [`VIEWS`] views. Its noise is the
//! difference of two solutions of different seeds; its bias, which a path tracer has not, is told beside it.
use crate::{LIGHTS, RIG, SIDE, Theirs, compare, seconds};
use diamond_camera::Camera;
use diamond_pathtrace::{Bulk, BulkOptions, ReferenceOptions, Scene, render_reference};
use xtask::bench::Table;

/// Views of a capture.
const VIEWS: f64 = 100.0;
/// Paths per pixel of what the bias is measured against.
const TRUTH: u32 = 1024;

/// One scene under a whole rig.
pub fn run(name: &str, scene: &Scene, camera: &Camera, theirs: &[Theirs]) -> Result<Table, String> {
    let columns =
        ["walks", "solve s", "view s", "bias %", "± %", "noise %", "peer", "its s per image", "ours", "better"];
    let context = [("scene", name.to_string()), ("views", VIEWS.to_string()), ("lights", LIGHTS.to_string())];
    let mut table = Table::new(&format!("transport-bulk-{}", name.replace('/', "-")), &columns, &context);
    let some = Scene { lights: scene.lights[..RIG.len()].to_vec(), ..scene.clone() };
    let options = ReferenceOptions { samples: TRUTH, seed: 5, ..Default::default() };
    let truth = render_reference(&some, camera, &options).map_err(|e| e.to_string())?;
    for walks in [64, 256, 1024] {
        let (mut views, mut solve, mut view) = (Vec::new(), 0.0, 0.0);
        for seed in [1, 2] {
            let options = BulkOptions { points: 2000, walks, seed, ..Default::default() };
            let start = seconds();
            let solved = Bulk::solve(scene, &options, &|_| ()).map_err(|e| e.to_string())?;
            solve += 0.5 * (seconds() - start);
            let start = seconds();
            views.push(solved.render(camera, seed).map_err(|e| e.to_string())?);
            view += 0.5 * (seconds() - start);
        }
        let film = f64::from(SIDE * SIDE) * RIG.len() as f64;
        let (mut variance, mut mean, mut sum, mut error) = ([0.0; 3], 0.0, 0.0, 0.0);
        for (l, truth) in truth.lights.iter().enumerate() {
            let (a, b) = (views[0].lights[l].data(), views[1].lights[l].data());
            for (i, (a, b)) in a.iter().zip(b).enumerate() {
                let (a, b) = (f64::from(*a), f64::from(*b));
                variance[i % 3] += 0.5 * (a - b) * (a - b) / film;
                mean += 0.5 * (a + b) / (3.0 * film);
            }
            sum += truth.mean.data().iter().map(|v| f64::from(*v)).sum::<f64>() / (3.0 * film);
            error += truth.standard_error.data().iter().map(|v| f64::from(*v).powi(2)).sum::<f64>();
        }
        let ours = (solve / VIEWS + view) / LIGHTS as f64;
        let noise = (variance.iter().sum::<f64>() / 3.0).sqrt() / sum;
        let own = [
            walks.to_string(),
            format!("{solve:.2}"),
            format!("{view:.2}"),
            format!("{:.2}", 100.0 * (mean / sum - 1.0)),
            format!("{:.2}", 100.0 * error.sqrt() / (3.0 * film) / sum),
            format!("{:.2}", 100.0 * noise),
        ];
        let mut peers = compare(name, theirs);
        if peers.is_empty() {
            peers.push(("–".into(), f64::NAN, [f64::NAN; 3]));
        }
        for (what, time, their_variance) in peers {
            // Samples of a pixel until its variance is ours, in the channel where they are fewest.
            let samples = (0..3).map(|c| their_variance[c] / variance[c]).fold(f64::NAN, f64::min);
            let image = time / LIGHTS as f64 * samples * f64::from(SIDE * SIDE);
            let row = [what, format!("{image:.3}"), format!("{ours:.4}"), format!("{:.1}", image / ours)];
            table.push(own.iter().cloned().chain(row).collect());
        }
    }
    Ok(table)
}
