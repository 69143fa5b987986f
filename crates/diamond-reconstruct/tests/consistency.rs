//! Geometric consistency in training: when it is computed, that it costs nothing when it is not, and that it does not depend
//! on threads or interruptions.
use diamond_dataset::{Capture, OpenOptions, Selection};
use diamond_reconstruct::{CaptureFacts, Config, Needs, Reconstruction, SettingDetach, TensorFile};

fn capture(views: usize) -> Capture {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/captures/spot-small");
    Capture::open(folder.as_ref(), &OpenOptions::default())
        .and_then(|c| c.select(&Selection::Count(views), &Selection::Count(2)))
        .expect("the embedded capture opens")
}

fn config(weight: f32) -> Config {
    let mut config = Config::preset("resolved").expect("a preset");
    (config.steps, config.initial.count) = (24, 500);
    // The first round of density control is after step 8, of which nothing is compared before.
    (config.density.every_steps, config.density.from) = (8, 0.0);
    (config.loss.silhouette_consistency, config.loss.depth_consistency) = (weight, 0.6 * weight);
    (config.consistency.every_steps, config.initial.opacity) = (2, 0.9);
    // Resets of opacity would leave nothing above the threshold.
    config.density.reset_every = 0.0;
    config
}

fn counter(run: &Reconstruction, name: &str) -> u64 {
    run.counters().iter().find(|(known, _)| *known == name).map_or(0, |(_, n)| *n)
}

const TERMS: [&str; 2] = ["silhouette_consistency", "depth_consistency"];

/// After the first round of density control, at every second step; never with weights of 0 or a single view, and then
/// nothing is rasterised for it either.
#[test]
fn views_are_compared_when_it_is_due_and_never_for_nothing() {
    let run = |config: &Config, views: usize| {
        let mut run = Reconstruction::new(capture(views), config).expect("starts");
        let mut listed = Vec::new();
        while !run.finished() {
            let report = run.step().expect("a step");
            listed.push(TERMS.iter().filter(|t| report.terms.iter().any(|v| v.name == **t)).count());
        }
        (run, listed)
    };
    let (compared, listed) = run(&config(0.5), 3);
    let expected: Vec<usize> = (1..=24).map(|done| if done > 8 && done % 2 == 0 { 2 } else { 0 }).collect();
    assert_eq!(listed, expected);
    for term in TERMS {
        assert_eq!(counter(&compared, term), 8, "{term}");
    }
    assert!(counter(&compared, "consistency pixels") > 1000 && compared.profile().iter().any(|p| p.0 == "consistency"));

    let mut half = config(0.5);
    half.loss.depth_consistency = 0.0;
    let (half, _) = run(&half, 3);
    assert_eq!((counter(&half, TERMS[0]), counter(&half, TERMS[1])), (8, 0));

    let mut never = config(0.5);
    never.consistency.until = 0.1;
    for (config, views, reason) in [
        (config(0.0), 3, "loss.depth_consistency = 0"),
        (config(0.5), 1, "one training view"),
        (never, 3, "no step of the run"),
    ] {
        let (nothing, _) = run(&config, views);
        for name in TERMS.into_iter().chain(["consistency pixels", "consistency pixels seen in both"]) {
            assert_eq!(counter(&nothing, name), 0, "{name}: {reason}");
        }
        assert!(nothing.profile().iter().all(|part| part.0 != "consistency"), "{reason}");
        let row = nothing.needs().depth_consistency.clone();
        assert!(!row.needed && row.reason.contains(reason), "{}", row.reason);
    }
    // Nothing is known of the capture: it may have more views.
    assert!(Needs::decide(&config(0.5), &CaptureFacts::default()).silhouette_consistency.needed);
}

fn state(run: &mut Reconstruction, name: &str) -> TensorFile {
    let dir = std::env::temp_dir().join(format!("diamond-consistency-{name}-{}", std::process::id()));
    let path = run.save_checkpoint(&dir).expect("a checkpoint");
    let file = TensorFile::read(&path).expect("readable");
    std::fs::remove_dir_all(dir).expect("removed");
    file
}

/// The same bits on one thread, on three, and after an interruption; others than without the terms.
#[test]
fn threads_and_interruptions_do_not_matter() {
    let config_on = config(0.5);
    let on = |threads: usize, config: &Config| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| {
            let mut run = Reconstruction::new(capture(3), config).expect("starts");
            while !run.finished() {
                run.step().expect("a step");
            }
            state(&mut run, &format!("threads-{threads}")).tensors
        })
    };
    let one = on(1, &config_on);
    assert!(one == on(3, &config_on), "threads");
    let without = on(2, &config(0.0));
    assert!(one != without, "the terms change something");
    // Either view alone is a way for the gradient, of either term.
    for detach in [SettingDetach::Source, SettingDetach::Target] {
        for depth in [false, true] {
            let mut half = config(0.5);
            half.consistency.detach = detach;
            *(if depth { &mut half.loss.silhouette_consistency } else { &mut half.loss.depth_consistency }) = 0.0;
            assert!(on(2, &half) != without, "{detach:?} {depth}");
        }
    }
    let dir = std::env::temp_dir().join(format!("diamond-consistency-resume-{}", std::process::id()));
    let mut run = Reconstruction::new(capture(3), &config_on).expect("starts");
    (0..13).for_each(|_| assert!(run.step().is_ok()));
    run.save_checkpoint(&dir).expect("a checkpoint");
    let mut run = Reconstruction::resume(capture(3), &config_on, &dir).expect("resumes");
    while !run.finished() {
        run.step().expect("a step");
    }
    std::fs::remove_dir_all(dir).expect("removed");
    assert!(one == state(&mut run, "resumed").tensors, "an interruption");
}
