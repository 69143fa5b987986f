//! Do the depth terms compare the right points? Against a capture's true geometry:
//! `cargo run --release -p diamond-sss --example seen_in_both -- RUN CAPTURE [MAX_GAP [MIN_FACING]]`, where the capture has the true depth of its training
//! views (`geometry/train_*.exr`).
//!
//! For each pair of training views of the run, each pixel of the first is looked up in the second by rendered depth, as the depth term does it, and by
//! true depth. The term counts a pixel where the rendered depths agree within 5 % (or MAX_GAP); it is *right* where the true point of the pixel is seen in the
//! second view, too, and *wrong* where something hides it there: then the two depths that are pulled together belong to different places. Depths are in
//! per cent of the distance that the true points span.
use diamond_camera::Camera;
use diamond_consistency::{
    ConsistencyOptions, DepthKind, DepthMap, DepthRange, DepthSource, Fate, ViewGeometry, draw_pixels, pair_consistency,
};
use diamond_dataset::{Capture, OpenOptions, Selection};
use diamond_image::Image;
use diamond_reconstruct::{Model, RenderedShape, Renderer};
use diamond_sss::RunRecord;
use std::path::Path;

type Failure = Box<dyn std::error::Error>;

struct Seen {
    camera: Camera,
    rendered: RenderedShape,
    shown: Image,
    truth: DepthMap,
}

impl Seen {
    fn rendered(&self) -> ViewGeometry<'_> {
        let depth = DepthSource::Rendered(&self.rendered.depth);
        ViewGeometry { camera: &self.camera, silhouette: &self.rendered.opacity, depth, mask: None }
    }

    fn truth(&self) -> ViewGeometry<'_> {
        ViewGeometry {
            camera: &self.camera,
            silhouette: &self.shown,
            depth: DepthSource::Given(&self.truth),
            mask: None,
        }
    }

    /// Rendered minus true depth of a pixel.
    fn error(&self, pixel: usize) -> f64 {
        let (z, opacity) = (self.rendered.depth.data()[pixel], self.rendered.opacity.data()[pixel]);
        f64::from(z / opacity) - f64::from(self.truth.values.data()[pixel])
    }
}

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let ([run, capture] | [run, capture, ..]) = arguments.as_slice() else {
        return Err("usage: seen_in_both RUN CAPTURE [MAX_GAP [MIN_FACING]]".into());
    };
    let number = |k: usize, default: f32| arguments.get(k).map_or(Ok(default), |text| text.parse());
    let (max_gap, min_facing) = (number(2, 0.05)?, number(3, -1.0)?);
    let model = Model::load(Path::new(run))?;
    let record = RunRecord::read(Path::new(run))?.ok_or(format!("{run}: no run.json; name the folder of a run"))?;
    let capture = Capture::open(capture.as_ref(), &OpenOptions::default())?
        .select(&record.views.parse::<Selection>()?, &record.lights.parse::<Selection>()?)?;
    let renderer = Renderer::new(&model);
    let mut all = Vec::new();
    for view in &capture.train {
        let geometry = view.ground_truth_geometry()?;
        let geometry = geometry.ok_or(format!("{}: no true depth of this training view in the capture", view.name))?;
        let shown = geometry.depth.map(|z| if z > 0.0 { 1.0 } else { 0.0 });
        let truth = DepthMap { kind: DepthKind::Z, values: geometry.depth };
        all.push(Seen { camera: view.camera, rendered: renderer.shape(&view.camera)?, shown, truth });
    }
    let depths = || all.iter().flat_map(|s| s.truth.values.data().iter().copied()).filter(|z| *z > 0.0);
    let span = f64::from(depths().fold(0.0, f32::max) - depths().fold(f32::INFINITY, f32::min));
    let plain = ConsistencyOptions::new(DepthRange { near: 0.0, far: 1.0 });
    let options = ConsistencyOptions { max_gap, min_facing, ..plain };
    // Pixels counted by the term, its sum of gaps, of errors of depth, and of these with their sign: right, wrong.
    let (mut pixels, mut counts, mut gaps, mut errors) = (0usize, [0usize; 2], [0.0f64; 2], [0.0f64; 2]);
    let mut signed = [0.0f64; 2];
    let mut missed = 0usize;
    for (i, from) in all.iter().enumerate() {
        for to in all.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, to)| to) {
            let drawn = draw_pixels(&from.rendered(), &options, usize::MAX, 0);
            let known: Vec<u32> = drawn.into_iter().filter(|p| from.truth.values.data()[*p as usize] > 0.0).collect();
            let (_, by_model) = pair_consistency(&from.rendered(), &to.rendered(), &known, &options)?;
            // A true point is seen where the true depths agree to a per cent.
            let strict = ConsistencyOptions { max_gap: 0.01, ..plain };
            let (_, by_truth) = pair_consistency(&from.truth(), &to.truth(), &known, &strict)?;
            for (m, t) in by_model.correspondences().iter().zip(by_truth.correspondences()) {
                pixels += 1;
                let seen = t.fate == Fate::Seen;
                if m.fate != Fate::Seen {
                    missed += usize::from(seen);
                    continue;
                }
                let k = usize::from(!seen);
                counts[k] += 1;
                gaps[k] += f64::from((m.z - m.surface_z).abs());
                errors[k] += from.error(m.pixel as usize).abs();
                signed[k] += from.error(m.pixel as usize);
            }
        }
    }
    let share = |n: usize| 100.0 * n as f64 / pixels.max(1) as f64;
    println!(
        "{} views, {pixels} pixels looked up; counted by the term: {:.1} %",
        all.len(),
        share(counts[0] + counts[1])
    );
    for (k, name) in ["right", "wrong"].iter().enumerate() {
        let mean = |sum: f64| 100.0 * sum / span / counts[k].max(1) as f64;
        println!(
            "{name}: {:5.1} % of pixels, mean gap {:.2} %, mean error of depth {:.2} % ({:+.2} %, + is behind the true surface)",
            share(counts[k]),
            mean(gaps[k]),
            mean(errors[k]),
            mean(signed[k])
        );
    }
    println!("truly seen in both and not counted: {:.1} %", share(missed));
    Ok(())
}
