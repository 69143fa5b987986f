//! A whole run has the same bits on every x86-64 machine where the instruction set is `portable`: reading the capture, the
//! first Gaussians, traced visibility, training with gains and density control, and a rendering, compared with hashes that are
//! written down here. On AArch64 they differ from the first Gaussians on (docs/testing.md).
//!
//! A change of a formula changes them; then the test prints the new ones, and they are replaced by hand.
use diamond_dataset::{Capture, OpenOptions, Selection};
use diamond_reconstruct::{Config, ExposureMode, Model, Reconstruction};
use diamond_simd::InstructionSet;
use sha2::{Digest, Sha256};

/// After the first Gaussians, the first step, and all steps, and of a rendering.
const HASHES: [&str; 4] = ["65801bf246c33af2", "4541f74d2e75524a", "5aa398e27a1c15c0", "32149359461a796b"];
/// Density control three times, and a medium that is fitted twice.
const STEPS: u64 = 30;

fn hash(values: impl Iterator<Item = f32>) -> String {
    let mut hash = Sha256::new();
    values.for_each(|v| hash.update(v.to_bits().to_le_bytes()));
    hash.finalize().iter().take(8).map(|b| format!("{b:02x}")).collect()
}

/// Of all values of Gaussians and gains; the network shows in the rendering.
fn of_model(model: &Model) -> String {
    let groups = model.parameters.groups().iter().flat_map(|g| g.values.iter().copied());
    hash(groups.chain(model.exposure.log_gains.iter().copied()))
}

// Not yet the same elsewhere.
#[cfg_attr(not(target_arch = "x86_64"), ignore = "the bits of x86-64, see docs/testing.md")]
#[test]
fn a_portable_run_has_the_bits_that_are_written_down() {
    diamond_simd::fix(InstructionSet::Portable).expect("every machine has it");
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/captures/spot-small");
    let capture = Capture::open(folder.as_ref(), &OpenOptions::default())
        .and_then(|c| c.select(&Selection::Count(6), &Selection::Count(3)))
        .expect("the embedded capture opens");
    let mut config = Config::preset("resolved").expect("a preset");
    config.steps = STEPS;
    config.initial.count = 1000;
    config.initial.source = diamond_reconstruct::InitialSource::Hull;
    config.initial.hull_resolution = 32;
    config.density.every_steps = 6;
    config.density.gradient_threshold = 1e-5;
    config.density.until = 0.9;
    config.density.reset_every = 0.4;
    config.shading.roughness_unfreeze = 0.3;
    config.visibility.every_steps = 10;
    config.exposure.mode = ExposureMode::PerImage;
    (config.subsurface.from, config.subsurface.refit) = (0.2, vec![0.6]);
    (config.subsurface.surfels, config.subsurface.seeds, config.subsurface.resolution) = (500, 800, 28);
    let mut run = Reconstruction::new(capture, &config).expect("starts");
    let mut found = vec![of_model(run.model().expect("a model"))];
    let first = run.model().expect("a model").len();
    while !run.finished() {
        run.step().expect("a step");
        if run.steps_done() == 1 {
            found.push(of_model(run.model().expect("a model")));
        }
    }
    let view = run.capture().test[0].clone();
    let model = run.model().expect("a model");
    assert_ne!(model.len(), first, "density control took part");
    assert!(model.medium.is_some(), "a medium took part");
    assert!(model.exposure.log_gains.iter().any(|g| *g != 0.0), "gains took part");
    found.push(of_model(model));
    let rendering = model.render(&view.camera, &[view.shots[0].light]).expect("renders").remove(0);
    found.push(hash(rendering.radiance.data().iter().copied()));
    println!("{found:?}");
    assert_eq!(found, HASHES, "first Gaussians, first step, all {STEPS} steps, rendering");
}
