//! Both covariance forms and every strategy of density control: they learn, repeat to the bit, resume, and keep their limits.
use diamond_dataset::{Capture, OpenOptions, Selection};
use diamond_reconstruct::{Attribute, Config, Covariance, DensityStrategy, Model, Reconstruction, TensorFile};
use std::path::PathBuf;

fn capture(views: usize, lights: usize) -> Capture {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/captures/spot-small");
    Capture::open(folder.as_ref(), &OpenOptions::default())
        .and_then(|c| c.select(&Selection::Count(views), &Selection::Count(lights)))
        .expect("the embedded capture opens")
}

fn short(steps: u64) -> Config {
    let mut config = Config::preset("resolved").expect("a preset");
    config.steps = steps;
    config.subsurface.model = diamond_reconstruct::SubsurfaceModel::Mlp;
    config.initial.count = 500;
    config.density.every_steps = 5;
    config.density.from = 0.1;
    config.density.until = 0.9;
    config.density.reset_every = 0.0;
    config.density.gradient_threshold = 1e-4;
    config
}

fn mcmc(steps: u64) -> Config {
    let mut config = short(steps);
    config.density.strategy = DensityStrategy::Mcmc;
    config.density.max_gaussians = 600;
    // Some begin dead, so that every round has somebody to move.
    config.initial.opacity = 0.02;
    config.density.prune_opacity = 0.015;
    config
}

fn folder(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("diamond-density-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&path).expect("a folder");
    path
}

fn bits(run: &mut Reconstruction, name: &str) -> Vec<u32> {
    let dir = folder(name);
    let path = run.save_checkpoint(&dir).expect("a checkpoint");
    let file = TensorFile::read(&path).expect("readable");
    std::fs::remove_dir_all(dir).expect("removed");
    file.tensors.values().flat_map(|(_, v)| v.iter().map(|x| x.to_bits())).collect()
}

fn finish(run: &mut Reconstruction) -> [usize; 3] {
    let mut changes = [0; 3];
    while !run.finished() {
        let report = run.step().expect("a step");
        changes.iter_mut().zip(report.density).for_each(|(a, b)| *a += b);
    }
    changes
}

#[test]
fn a_run_with_factors_and_relocation_resumes_with_the_same_bits() {
    let mut config = mcmc(24);
    config.model.covariance = Covariance::Cholesky;
    let mut whole = Reconstruction::new(capture(2, 2), &config).expect("starts");
    let dir = folder("resume");
    for _ in 0..13 {
        whole.step().expect("a step");
    }
    whole.save_checkpoint(&dir).expect("a checkpoint");
    finish(&mut whole);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a pool");
    let resumed = pool.install(|| {
        let mut run = Reconstruction::resume(capture(2, 2), &config, &dir).expect("resumes");
        finish(&mut run);
        bits(&mut run, "resumed")
    });
    assert!(bits(&mut whole, "whole") == resumed, "the resumed run differs");
    std::fs::remove_dir_all(dir).expect("removed");
}

#[test]
fn relocation_grows_to_the_limit_and_no_further() {
    let config = mcmc(60);
    let mut run = Reconstruction::new(capture(2, 2), &config).expect("starts");
    let [added, split, moved] = finish(&mut run);
    assert_eq!((added, split), (100, 0));
    assert!(moved > 0, "nobody was relocated");
    assert_eq!(run.model().expect("a model").len(), 600);

    let mut frozen = config.clone();
    frozen.density.freeze_count = 0.0;
    let mut run = Reconstruction::new(capture(2, 2), &frozen).expect("starts");
    let [added, _, moved] = finish(&mut run);
    assert!(added == 0 && moved > 0, "{added} {moved}");
    assert_eq!(run.model().expect("a model").len(), 500);
}

#[test]
fn the_limit_is_exact_and_counts_the_first_ones() {
    let mut config = short(40);
    config.density.max_gaussians = 520;
    config.density.prune_opacity = 0.0;
    let mut run = Reconstruction::new(capture(2, 2), &config).expect("starts");
    finish(&mut run);
    assert_eq!(run.model().expect("a model").len(), 520);
    config.density.max_gaussians = 300;
    let mut run = Reconstruction::new(capture(2, 2), &config).expect("starts");
    assert_eq!(run.model().expect("a model").len(), 300);

    for change in
        [|c: &mut Config| c.density.strategy = DensityStrategy::None, |c: &mut Config| c.density.freeze_count = 0.0]
    {
        let mut config = short(40);
        change(&mut config);
        let mut run = Reconstruction::new(capture(2, 2), &config).expect("starts");
        assert_eq!(finish(&mut run), [0, 0, 0]);
    }
}

#[test]
fn too_large_ones_are_dropped_late() {
    let mut config = short(40);
    config.density.gradient_threshold = 1e3;
    config.density.max_screen_radius = 6.0;
    config.density.large_from = 0.5;
    let mut run = Reconstruction::new(capture(2, 2), &config).expect("starts");
    let mut early = 0;
    while run.steps_done() < 20 {
        early += run.step().expect("a step").density[2];
    }
    assert_eq!(early, 0);
    assert!(finish(&mut run)[2] > 0, "nothing was dropped");
}

#[test]
fn a_model_of_factors_survives_its_files() {
    let mut config = short(20);
    config.model.covariance = Covariance::Cholesky;
    let mut run = Reconstruction::new(capture(2, 2), &config).expect("starts");
    let first = run.step().expect("a step").objective;
    finish(&mut run);
    let view = run.capture().train[0].clone();
    let lights = [view.shots[0].light];
    let before = run.render(&view.camera, &lights).expect("renders");
    let dir = folder("model");
    run.model().expect("a model").save(&dir).expect("saved");
    let loaded = Model::load(&dir).expect("loaded");
    assert_eq!(loaded.parameters.values(Attribute::Rotation).len(), 0);
    let after = loaded.render(&view.camera, &lights).expect("renders");
    assert_eq!(before[0].radiance, after[0].radiance);
    assert!(first.is_finite());

    // Other programs find standard deviations and rotations: as the other form they draw the same picture.
    let text = std::fs::read_to_string(dir.join("config.toml")).expect("read");
    let text = text.replace("covariance = \"cholesky\"", "covariance = \"rotation-scale\"");
    std::fs::write(dir.join("config.toml"), text).expect("written");
    let converted = Model::load(&dir).expect("loaded").render(&view.camera, &lights).expect("renders");
    let (a, b) = (before[0].radiance.data(), converted[0].radiance.data());
    let worst = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0f32, f32::max);
    assert!(worst < 2e-3, "the two forms' pictures differ by {worst}");
    std::fs::remove_dir_all(dir).expect("removed");
}
