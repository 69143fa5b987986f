//! Gains of photographs: known ones are found again without harm to the model, they resume to the bit and survive files;
//! the first exposure matches the photographs.
use diamond_dataset::{Capture, Observation, OpenOptions, Selection};
use diamond_reconstruct::random::{Purpose, Random};
use diamond_reconstruct::{
    Config, CpuEngine, Engine, ExposureMode, FirstExposure, Model, Reconstruction, Region, StepPlan, TrainingPair,
};
use std::sync::Arc;

fn capture(views: usize, lights: usize) -> Capture {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/captures/spot-small");
    Capture::open(folder.as_ref(), &OpenOptions::default())
        .and_then(|c| c.select(&Selection::Count(views), &Selection::Count(lights)))
        .expect("the embedded capture opens")
}

fn config(mode: ExposureMode, steps: u64) -> Config {
    let mut config = Config::preset("resolved").expect("a preset");
    config.steps = steps;
    config.subsurface.model = diamond_reconstruct::SubsurfaceModel::Mlp;
    config.initial.count = 1000;
    config.exposure.mode = mode;
    config.density.strategy = diamond_reconstruct::DensityStrategy::None;
    config
}

/// Trains `model` on photographs × gains.
fn train(model: Model, capture: &Capture, gains: &[f32]) -> Model {
    let config = model.config.clone();
    let mut engine = CpuEngine::new(model);
    let shots: Vec<_> =
        capture.train.iter().enumerate().flat_map(|(v, view)| view.shots.iter().map(move |s| (v, s))).collect();
    let observations: Vec<Arc<Observation>> =
        shots.iter().map(|(_, s)| capture.observation(s).expect("an image")).collect();
    let scaled: Vec<_> = observations.iter().zip(gains).map(|(o, g)| o.radiance.map(|v| v * g)).collect();
    let mut order = Vec::new();
    for step in 0..config.steps {
        if order.is_empty() {
            order = Random::new(config.seed, Purpose::Pairs, step).permutation(shots.len());
        }
        let image = order.pop().expect("not empty") as usize;
        let (view, shot) = shots[image];
        let pair = TrainingPair {
            camera: &capture.train[view].camera,
            light: &shot.light,
            radiance: &scaled[image],
            mask: observations[image].mask.as_ref(),
            weight: 1.0,
            believed: None,
            content: Region::of_photograph(&scaled[image], observations[image].mask.as_ref()),
            view,
            image,
            neighbour: None,
            guide: None,
        };
        engine.training_step(step, &StepPlan::new(&config, step), &[pair]).expect("a step");
    }
    engine.model().expect("a model").clone()
}

/// Takes the mean over the images of each light. Images are in order of views, and in each of the `lights` that light all.
fn centre(logs: &mut [f32], lights: usize) {
    let views = logs.len() / lights;
    for l in 0..lights {
        let mean = (0..views).map(|v| logs[v * lights + l]).sum::<f32>() / views as f32;
        (0..views).for_each(|v| logs[v * lights + l] -= mean);
    }
}

/// Gains that are learned together with the model, from images that each have another: the error, in the mean, of gains
/// relative to the others of their light; with and without learning them.
///
/// How good they get is bounded by how well the model explains a photograph: where all true gains are 1 they go off by
/// as much (docs/results.md has the numbers).
#[test]
fn unknown_gains_are_found_together_with_the_model() {
    let (views, lights) = (12, 4);
    let capture = capture(views, lights);
    let mut random = Random::new(3, Purpose::Initial, 0);
    let mut logs: Vec<f32> = (0..views * lights).map(|_| 0.3 * random.normal()).collect();
    centre(&mut logs, lights);
    let gains: Vec<f32> = logs.iter().map(|g| g.exp()).collect();
    let error = |rate: f32, steps: u64| {
        let mut config = config(ExposureMode::PerImage, steps);
        (config.exposure.rate, config.exposure.from, config.exposure.until) = (rate, 0.2, 0.8);
        let start = Reconstruction::new(capture.clone(), &config).expect("starts").model().expect("a model").clone();
        let learned = train(start, &capture, &gains).exposure;
        let mut log: Vec<f32> = (0..gains.len()).map(|i| learned.gain(i).x.ln()).collect();
        let before = log.clone();
        centre(&mut log, lights);
        assert!(log.iter().zip(&before).all(|(a, b)| (a - b).abs() < 1e-4), "each light has a mean of 0");
        log.iter().zip(&logs).map(|(a, b)| ((a - b).exp() - 1.0).abs()).sum::<f32>() / gains.len() as f32
    };
    let (learned, without) = (error(1.0, 900), error(0.0, 50));
    println!("gains: mean error {learned:.4}, without learning them {without:.4}");
    assert!(without > 0.18, "the gains are worth finding: {without}");
    assert!(learned < 0.09, "gains are off by {learned} in the mean");
}

/// A model that was trained on the photographs as they are, and is now held fixed, tells gains from content. (After 300
/// steps instead of 1500 gains are off by 14 % even where all are 1: they take up what the model cannot explain yet.)
#[test]
fn known_gains_are_found_again_where_the_model_is_known() {
    let capture = capture(4, 3);
    let images = 12;
    let mut random = Random::new(3, Purpose::Initial, 0);
    let mut logs: Vec<f32> = (0..images).map(|_| 0.3 * random.normal()).collect();
    centre(&mut logs, 3);
    let gains: Vec<f32> = logs.iter().map(|g| g.exp()).collect();
    let start = config(ExposureMode::PerImage, 1500);
    let mut model = Reconstruction::new(capture.clone(), &start).expect("starts").model().expect("a model").clone();
    model.config.exposure.rate = 0.0;
    let mut model = train(model, &capture, &vec![1.0; images]);
    assert!(model.exposure.log_gains.iter().all(|g| *g == 0.0), "a rate of 0 moves nothing");
    let c = &mut model.config;
    c.steps = 30 * images as u64;
    (c.exposure.rate, c.exposure.from, c.exposure.until) = (1.0, 0.0, 1.0);
    let r = &mut c.rates;
    for rate in [
        &mut r.mean,
        &mut r.mean_final,
        &mut r.scale,
        &mut r.rotation,
        &mut r.opacity,
        &mut r.normal,
        &mut r.material,
        &mut r.visibility_sh,
        &mut r.transfer,
        &mut r.codes,
        &mut r.network,
        &mut r.network_final,
    ] {
        *rate = 0.0;
    }
    c.shading.roughness_unfreeze = 0.0;
    let learned = train(model, &capture, &gains);
    let errors: Vec<f32> =
        gains.iter().enumerate().map(|(i, g)| (learned.exposure.gain(i).x / g - 1.0).abs()).collect();
    let worst = errors.iter().copied().fold(0.0, f32::max);
    let typical = errors.iter().sum::<f32>() / images as f32;
    println!("gains: worst {worst:.4}, mean {typical:.4}");
    assert!(typical < 0.02 && worst < 0.05, "gains are off by {typical} in the mean, {worst} at worst");
}

#[test]
fn gains_resume_with_the_same_bits_and_survive_files() {
    for mode in [ExposureMode::PerView, ExposureMode::PerImage, ExposureMode::Global] {
        let mut config = config(mode, 20);
        (config.exposure.from, config.exposure.until) = (0.0, 1.0);
        let dir = std::env::temp_dir().join(format!("diamond-exposure-{mode:?}-{}", std::process::id()));
        let mut whole = Reconstruction::new(capture(2, 2), &config).expect("starts");
        for step in 0..20 {
            whole.step().expect("a step");
            if step == 8 {
                whole.save_checkpoint(&dir).expect("a checkpoint");
            }
        }
        let mut resumed = Reconstruction::resume(capture(2, 2), &config, &dir).expect("resumes");
        while !resumed.finished() {
            resumed.step().expect("a step");
        }
        let (a, b) = (whole.model().expect("a model").clone(), resumed.model().expect("a model").clone());
        assert!(a.exposure == b.exposure && a.parameters == b.parameters, "{mode:?}: the resumed run differs");
        assert!(a.exposure.log_gains.iter().any(|g| *g != 0.0));
        a.save(&dir).expect("saved");
        let loaded = Model::load(&dir).expect("loaded");
        let view = whole.capture().train[0].clone();
        let render = |m: &Model| m.render(&view.camera, &[view.shots[0].light]).expect("renders").remove(0).radiance;
        let (before, after) = (render(&a), render(&loaded));
        let worst = before.data().iter().zip(after.data()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 1e-6, "{mode:?}: {worst}");
        std::fs::remove_dir_all(dir).expect("removed");
    }
}

/// `[eq:first-exposure]`
#[test]
fn the_first_rendering_is_as_bright_as_the_photographs() {
    let capture = capture(3, 2);
    let mut config = config(ExposureMode::Fixed, 10);
    config.exposure.first = FirstExposure::Mean;
    let mut run = Reconstruction::new(capture.clone(), &config).expect("starts");
    let model = run.model().expect("a model");
    let (mut target, mut rendered) = (0.0, 0.0);
    for view in &capture.train {
        for shot in &view.shots {
            let sum = |image: &diamond_image::Image| image.data().iter().map(|v| f64::from(*v)).sum::<f64>();
            target += sum(&capture.observation(shot).expect("an image").radiance);
            rendered += sum(&model.render(&view.camera, &[shot.light]).expect("renders").remove(0).radiance);
        }
    }
    assert!((rendered / target - 1.0).abs() < 0.01, "{rendered} {target}");
}
