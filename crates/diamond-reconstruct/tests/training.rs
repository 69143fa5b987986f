//! A training step lowers the objective; two runs, any number of threads, and an interrupted run give the same bits; a
//! gradient of the whole map points the way that the objective falls.
use diamond_dataset::{Capture, OpenOptions, Selection};
use diamond_reconstruct::{Attribute, Config, Model, ReconstructError, Reconstruction};
use std::path::PathBuf;

fn capture(views: usize, lights: usize) -> Capture {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/captures/spot-small");
    Capture::open(folder.as_ref(), &OpenOptions::default())
        .and_then(|c| c.select(&Selection::Count(views), &Selection::Count(lights)))
        .expect("the embedded capture opens")
}

fn short(preset: &str, steps: u64) -> Config {
    let mut config = Config::preset(preset).expect("a preset");
    config.steps = steps;
    config.initial.count = 600;
    config.density.every_steps = 10;
    config.density.from = 0.1;
    config.density.until = 0.8;
    // In so short a run a reset of all opacities would undo everything each few steps.
    config.density.reset_every = 0.0;
    config.visibility.every_steps = 7;
    // A run with a medium begins near its end; see medium.rs.
    config.subsurface.model = diamond_reconstruct::SubsurfaceModel::Mlp;
    config
}

fn folder(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("diamond-training-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&path).expect("a folder");
    path
}

/// All bits that a run ends with.
fn bits(run: &mut Reconstruction) -> Vec<u32> {
    let dir = folder(&format!("bits-{:?}", std::thread::current().id()));
    let path = run.save_checkpoint(&dir).expect("a checkpoint");
    let file = diamond_reconstruct::TensorFile::read(&path).expect("readable");
    std::fs::remove_dir_all(dir).expect("removed");
    file.tensors.values().flat_map(|(_, v)| v.iter().map(|x| x.to_bits())).collect()
}

fn train(config: &Config, threads: usize) -> Vec<u32> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
    pool.install(|| {
        let mut run = Reconstruction::new(capture(3, 2), config).expect("starts");
        while !run.finished() {
            run.step().expect("a step");
        }
        bits(&mut run)
    })
}

#[test]
fn training_lowers_the_objective_with_every_preset() {
    for preset in diamond_reconstruct::PRESETS {
        let mut run = Reconstruction::new(capture(3, 2), &short(preset, 120)).expect("starts");
        let reports: Vec<_> = (0..120).map(|_| run.step().expect("a step")).collect();
        let mean = |r: std::ops::Range<usize>| {
            let n = r.len() as f32;
            reports[r].iter().map(|r| r.terms.iter().find(|t| t.name == "l1").expect("l1").value).sum::<f32>() / n
        };
        let (first, last) = (mean(0..6), mean(114..120));
        assert!(last < 0.75 * first, "{preset}: L1 fell from {first} to {last} only");
        assert!(reports.iter().all(|r| r.gaussians > 0), "{preset}: Gaussians remain");
    }
}

#[test]
fn two_runs_and_any_number_of_threads_give_the_same_bits() {
    let mut config = short("resolved", 40);
    assert!(config.residual.transfer && config.residual.network, "every part of the model takes part");
    let one = train(&config, 1);
    assert!(one == train(&config, 1), "two runs differ");
    assert!(one == train(&config, 2), "one and two threads differ");
    config.seed = 1;
    assert!(one != train(&config, 1), "another seed must give other bits");
}

#[test]
fn a_resumed_run_ends_with_the_same_bits() {
    let config = short("sss-3dgs", 40);
    let mut whole = Reconstruction::new(capture(3, 2), &config).expect("starts");
    let dir = folder("resume");
    for step in 0..40 {
        whole.step().expect("a step");
        if step == 22 {
            whole.save_checkpoint(&dir).expect("a checkpoint");
        }
    }
    let mut resumed = Reconstruction::resume(capture(3, 2), &config, &dir).expect("resumes");
    assert_eq!(resumed.steps_done(), 23);
    while !resumed.finished() {
        resumed.step().expect("a step");
    }
    assert!(bits(&mut whole) == bits(&mut resumed), "the resumed run differs");

    let mut other = config.clone();
    other.loss.mask = 0.2;
    let refused = Reconstruction::resume(capture(3, 2), &other, &dir).err().expect("refused").to_string();
    assert!(refused.contains("another configuration"), "{refused}");
    let refused = Reconstruction::resume(capture(2, 2), &config, &dir).err().expect("refused").to_string();
    assert!(refused.contains("other images"), "{refused}");
    std::fs::remove_dir_all(dir).expect("removed");
}

#[test]
fn a_saved_model_renders_the_same() {
    let mut run = Reconstruction::new(capture(2, 2), &short("resolved", 30)).expect("starts");
    while !run.finished() {
        run.step().expect("a step");
    }
    let view = run.capture().train[0].clone();
    let lights: Vec<_> = view.shots.iter().map(|s| s.light).collect();
    let before = run.render(&view.camera, &lights).expect("renders");
    let dir = folder("model");
    run.model().expect("a model").save(&dir).expect("saved");
    let loaded = Model::load(&dir).expect("loaded");
    let after = loaded.render(&view.camera, &lights).expect("renders");
    for (a, b) in before.iter().zip(&after) {
        assert_eq!(a.radiance, b.radiance);
    }
    // Each light alone gives what it gives among others.
    let alone = loaded.render(&view.camera, &lights[1..2]).expect("renders");
    assert_eq!(alone[0].radiance, after[1].radiance);
    assert!(after[0].radiance != after[1].radiance, "two lights must give two pictures");
    std::fs::remove_dir_all(dir).expect("removed");
}

#[test]
fn absurd_weights_neither_panic_nor_leave_nan_behind() {
    let mut config = short("resolved", 10);
    config.loss.mask = f32::MAX;
    config.loss.l2 = f32::MAX;
    let mut run = Reconstruction::new(capture(2, 1), &config).expect("starts");
    while !run.finished() {
        if let Err(error) = run.step() {
            assert!(matches!(error, ReconstructError::NonFinite { .. }), "{error}");
            break;
        }
    }
    let model = run.model().expect("a model");
    assert!(model.parameters.groups().iter().all(|g| g.values.iter().all(|v| v.is_finite())));
}

#[test]
fn one_view_one_light_and_no_mask_are_valid() {
    for (views, lights) in [(1, 1), (1, 2), (2, 1)] {
        let mut run = Reconstruction::new(capture(views, lights), &short("resolved", 12)).expect("starts");
        while !run.finished() {
            assert!(run.step().expect("a step").objective.is_finite());
        }
        let model = run.model().expect("a model");
        assert!(model.parameters.values(Attribute::Mean).iter().all(|v| v.is_finite()));
    }
}

#[test]
fn without_points_the_hull_of_the_masks_starts_the_model() {
    let mut config = short("resolved", 60);
    config.initial.source = diamond_reconstruct::InitialSource::Hull;
    config.initial.hull_resolution = 48;
    let (scene, points) = diamond_reconstruct::survey(&capture(24, 1), &config).expect("surveys");
    assert!(points.origin.contains("visual hull of 24 masks"), "{}", points.origin);
    // The object lies in the unit ball round the origin.
    assert!(scene.centre().length() < 0.2, "{scene:?}");
    assert!(points.positions.iter().all(|p| p.length() < 1.25));
    let mut run = Reconstruction::new(capture(6, 2), &config).expect("starts");
    let first = run.step().expect("a step").psnr;
    let last = (1..60).map(|_| run.step().expect("a step").psnr).last().expect("steps");
    assert!(last > first + 1.0, "PSNR rose from {first} to {last} only");

    config.initial.source = diamond_reconstruct::InitialSource::Uniform;
    let (_, points) = diamond_reconstruct::survey(&capture(3, 1), &config).expect("surveys");
    assert_eq!(points.positions.len(), config.initial.count);
}
