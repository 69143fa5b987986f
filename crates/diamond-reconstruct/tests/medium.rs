//! A medium in training: when it is fitted, that the bits do not depend on threads or interruptions, that pictures are linear in the light,
//! and that a run whose surface cannot be found goes on.
use diamond_dataset::{Capture, OpenOptions, Selection};
use diamond_light::OlatLight;
use diamond_medium::Transport;
use diamond_reconstruct::{
    Config, ExposureMode, Model, Reconstruction, Renderer, SubsurfaceModel, TensorFile, medium_of, surface_of,
};

fn capture() -> Capture {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/captures/spot-small");
    Capture::open(folder.as_ref(), &OpenOptions::default())
        .and_then(|c| c.select(&Selection::Count(3), &Selection::Count(2)))
        .expect("the embedded capture opens")
}

fn config(model: SubsurfaceModel) -> Config {
    let text = format!(
        "steps = 12\n[initial]\ncount = 500\n[density]\nevery_steps = 5\nfrom = 0.0\n[subsurface]\nmodel = \"{}\"\nfrom = 0.25\nrefit = [0.6]\n\
         surfels = 500\nseeds = 800\nresolution = 28\nwidths = 6\n",
        match model {
            SubsurfaceModel::Mlp => "mlp",
            SubsurfaceModel::Profile => "profile",
            SubsurfaceModel::Walk => "walk",
            SubsurfaceModel::ProfileMlp => "profile+mlp",
            SubsurfaceModel::WalkMlp => "walk+mlp",
        }
    );
    Config::parse(&text, "a test").expect("a configuration")
}

fn finish(run: &mut Reconstruction) -> Vec<String> {
    let mut notes = Vec::new();
    while !run.finished() {
        run.step().expect("a step");
        notes.extend(run.take_notes());
    }
    notes
}

fn state(run: &mut Reconstruction, name: &str) -> TensorFile {
    let dir = std::env::temp_dir().join(format!("diamond-medium-{name}-{}", std::process::id()));
    let path = run.save_checkpoint(&dir).expect("a checkpoint");
    let file = TensorFile::read(&path).expect("readable");
    std::fs::remove_dir_all(dir).expect("removed");
    file
}

#[test]
fn bits_do_not_depend_on_threads_or_interruptions() {
    let config = config(SubsurfaceModel::ProfileMlp);
    let whole = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| {
            let mut run = Reconstruction::new(capture(), &config).expect("starts");
            let notes = finish(&mut run);
            (state(&mut run, &format!("threads-{threads}")), notes)
        })
    };
    let (one, notes) = whole(1);
    assert_eq!(notes.iter().filter(|n| n.contains("inside a surface of")).count(), 2, "{notes:?}");
    assert!(one.metadata.contains_key("medium"));
    assert!(whole(3).0 == one, "another number of threads, other bits");

    // Before the first fit, between the fits, after both.
    for stop in [2, 5, 9] {
        let mut first = Reconstruction::new(capture(), &config).expect("starts");
        (0..stop).for_each(|_| drop(first.step().expect("a step")));
        let dir = std::env::temp_dir().join(format!("diamond-medium-stop-{stop}-{}", std::process::id()));
        first.save_checkpoint(&dir).expect("a checkpoint");
        drop(first);
        let mut second = Reconstruction::resume(capture(), &config, &dir).expect("resumes");
        std::fs::remove_dir_all(&dir).expect("removed");
        finish(&mut second);
        assert!(state(&mut second, &format!("resumed-{stop}")) == one, "resumed after {stop} steps, other bits");
    }
}

#[test]
fn pictures_are_linear_in_the_light_and_survive_the_files() {
    for model in [SubsurfaceModel::Profile, SubsurfaceModel::WalkMlp] {
        let config = config(model);
        let mut run = Reconstruction::new(capture(), &config).expect("starts");
        finish(&mut run);
        let dir = std::env::temp_dir().join(format!("diamond-medium-files-{model:?}-{}", std::process::id()));
        run.model().expect("a model").save(&dir).expect("saved");
        let read = Model::load(&dir).expect("read");
        std::fs::remove_dir_all(&dir).expect("removed");
        let model = run.model().expect("a model");
        let camera = capture().test[0].camera;
        let OlatLight::Point { position, intensity } = capture().test[0].shots[0].light else {
            panic!("a point light")
        };
        let of = |factor: f32| OlatLight::Point { position, intensity: intensity * factor };
        let pictures = Renderer::new(model).radiance(&camera, &[of(1.0), of(2.0)]).expect("rendered");
        let again = Renderer::new(&read).radiance(&camera, &[of(1.0)]).expect("rendered");
        let largest = pictures[0].data().iter().copied().fold(0.0, f32::max);
        assert!(largest > 0.01);
        for (one, two) in pictures[0].data().iter().zip(pictures[1].data()) {
            assert!((2.0 * one - two).abs() <= 1e-6 * largest, "{one} {two}");
        }
        assert!(pictures[0].data() == again[0].data(), "the model that was read shows something else");
    }
}

/// Photographs that are taken to be twice as bright as the light was show a medium that sends out half as much.
#[test]
fn a_fit_knows_the_gains_of_photographs() {
    let mut config = config(SubsurfaceModel::Profile);
    config.exposure.mode = ExposureMode::PerImage;
    let run = Reconstruction::new(capture(), &config);
    let mut model = run.expect("starts").model().expect("a model").clone();
    let surface = surface_of(&model, &capture()).expect("a surface");
    let mut fitted = |gain: f32| {
        model.exposure.log_gains.fill(gain.ln());
        match medium_of(&model, &capture(), &surface).expect("a medium").transport {
            Transport::Profile { weights, local, .. } => [weights, vec![local]].concat().concat(),
            Transport::Walk { .. } => panic!("a profile was asked for"),
        }
    };
    let (plain, bright) = (fitted(1.0), fitted(2.0));
    let largest = plain.iter().copied().fold(0.0, f32::max);
    assert!(largest > 0.1);
    for (a, b) in plain.iter().zip(&bright) {
        assert!((a - 2.0 * b).abs() <= 1e-3 * largest, "{plain:?} {bright:?}");
    }
}

#[test]
fn without_a_medium_nothing_is_fitted_and_without_a_surface_the_run_goes_on() {
    let mut run = Reconstruction::new(capture(), &config(SubsurfaceModel::Mlp)).expect("starts");
    assert!(finish(&mut run).is_empty() && run.model().expect("a model").medium.is_none());
    assert!(!run.needs().medium.needed && !run.needs().residual_pull.needed);

    // A medium alone reads the visibility of lights even where nothing else does.
    let mut alone = config(SubsurfaceModel::Profile);
    (alone.shading.surface_visibility, alone.loss.visibility) = (false, 0.0);
    let run = Reconstruction::new(capture(), &alone).expect("starts");
    assert!(run.needs().traced_visibility.needed, "{}", run.needs().traced_visibility.reason);

    let mut config = config(SubsurfaceModel::ProfileMlp);
    config.subsurface.surface = Some("/no/such/mesh.ply".into());
    let mut run = Reconstruction::new(capture(), &config).expect("starts");
    let notes = finish(&mut run);
    assert!(
        notes.len() == 2 && notes[0].contains("no medium was fitted") && notes[0].contains("mesh.ply"),
        "{notes:?}"
    );
    assert!(run.model().expect("a model").medium.is_none() && run.needs().medium.needed);
    // It goes on as if none had been asked for.
    let mut plain = Reconstruction::new(capture(), &self::config(SubsurfaceModel::Mlp)).expect("starts");
    finish(&mut plain);
    assert!(
        state(&mut run, "failed").tensors == state(&mut plain, "plain").tensors,
        "a medium that is not there shows"
    );
}
