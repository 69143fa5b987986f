//! Pictures that nobody took in training: who makes them, that photographs decide what is believed, that the bits depend on neither threads,
//! interruptions nor where pictures are kept, and that other sources come in by the same door.
use diamond_augment::{Picture, Source, SourceError, Target};
use diamond_dataset::{Capture, OpenOptions, Provenance, Regime};
use diamond_image::{Image, Mask};
use diamond_reconstruct::{
    Config, CpuEngine, Engine, Model, Reconstruction, StepPlan, StepReport, TensorFile, TrainingPair, survey,
};
use std::path::PathBuf;

fn whole() -> Capture {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/captures/candle-small");
    Capture::open(folder.as_ref(), &OpenOptions::default()).expect("the embedded capture opens")
}

fn capture() -> Capture {
    "3x2".parse::<Regime>().and_then(|r| r.apply(&whole(), 0)).expect("a selection")
}

fn config(model: &str, augmentation: &str) -> Config {
    let text = format!(
        "steps = 12\n[initial]\ncount = 500\n[density]\nevery_steps = 5\nfrom = 0.0\n[subsurface]\nmodel = \"{model}\"\n\
         surfels = 500\nseeds = 800\nresolution = 28\nwidths = 6\n[augmentation]\n{augmentation}"
    );
    Config::parse(&text, "a test").expect("a configuration")
}

const PRIOR: &str = "source = \"prior\"\nfrom = 0.25\nlights = 2\n";

fn scratch(name: &str) -> PathBuf {
    let dir = std::env::temp_dir().join(format!("diamond-augmentation-{name}-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&dir);
    dir
}

fn finish(run: &mut Reconstruction) -> (Vec<String>, Vec<StepReport>) {
    let (mut notes, mut reports) = (Vec::new(), Vec::new());
    while !run.finished() {
        reports.push(run.step().expect("a step"));
        notes.extend(run.take_notes());
    }
    (notes, reports)
}

fn state(run: &mut Reconstruction, name: &str) -> TensorFile {
    let dir = scratch(name);
    let path = run.save_checkpoint(&dir).expect("a checkpoint");
    let file = TensorFile::read(&path).expect("readable");
    std::fs::remove_dir_all(dir).expect("removed");
    file
}

#[test]
fn bits_depend_on_neither_threads_nor_interruptions_nor_the_disk() {
    for model in ["mlp", "profile+mlp"] {
        let config = config(model, PRIOR);
        let run = |threads: usize, folder: Option<&PathBuf>| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
            pool.install(|| {
                let mut run = Reconstruction::new(capture(), &config).expect("starts");
                if let Some(folder) = folder {
                    run.keep_pictures_in(folder);
                }
                let (notes, reports) = finish(&mut run);
                (state(&mut run, &format!("{model}-{threads}")), notes, reports, run.made_pictures().to_vec())
            })
        };
        let (one, notes, reports, frames) = run(1, None);
        // 3 views, 2 of the 4 missing lights each; nine steps after the first quarter, every second of them.
        assert!(notes.iter().any(|n| n.contains("12 missing") && n.contains("6 pictures wanted")), "{notes:?}");
        assert!(notes.iter().any(|n| n.contains("6 pictures by prior: profile, believed to")), "{notes:?}");
        assert!(frames.len() == 6 && frames.iter().all(|f| (0.05..1.0).contains(&f.confidence)));
        let method = "prior: profile".to_owned();
        assert!(frames.iter().all(|f| f.provenance == Provenance::Synthetic { method: method.clone() }));
        let made = reports.iter().filter(|r| r.terms.iter().any(|t| t.name == "made_l1"));
        assert_eq!(made.map(|r| r.step).collect::<Vec<_>>(), [4, 6, 8, 10]);

        let folder = scratch(&format!("{model}-kept"));
        let (two, notes, ..) = run(3, Some(&folder));
        assert!(two == one, "{model}: other threads or pictures on disk, other bits");
        assert!(!notes.iter().any(|n| n.contains("kept from before")));
        assert_eq!(std::fs::read_dir(&folder).expect("a folder").count(), 6);
        let (three, notes, ..) = run(2, Some(&folder));
        assert!(three == one && notes.iter().any(|n| n.contains("6 were kept from before")), "{notes:?}");
        // A damaged picture is made again.
        let victim = std::fs::read_dir(&folder).expect("a folder").next().expect("a file").expect("a file").path();
        let mut bytes = std::fs::read(&victim).expect("read");
        let last = bytes.len() - 1;
        bytes[last] ^= 1;
        std::fs::write(&victim, bytes).expect("written");
        let (four, notes, ..) = run(2, Some(&folder));
        assert!(four == one && notes.iter().any(|n| n.contains("5 were kept from before")), "{notes:?}");

        // Before pictures are made, and after.
        for stop in [2, 3, 8] {
            let mut first = Reconstruction::new(capture(), &config).expect("starts");
            (0..stop).for_each(|_| drop(first.step().expect("a step")));
            let dir = scratch(&format!("{model}-stop-{stop}"));
            first.save_checkpoint(&dir).expect("a checkpoint");
            drop(first);
            let mut second = Reconstruction::resume(capture(), &config, &dir).expect("resumes");
            second.keep_pictures_in(&folder);
            std::fs::remove_dir_all(&dir).expect("removed");
            finish(&mut second);
            assert!(state(&mut second, "resumed") == one, "{model}: resumed after {stop} steps, other bits");
        }
        std::fs::remove_dir_all(folder).expect("removed");
    }
}

/// The photographs that the selection leaves out, wholly believed; those of one view are not its own silhouette.
struct Photographs {
    whole: Capture,
    wrong_view: Option<usize>,
}

impl Source for Photographs {
    fn method(&self) -> String {
        "photographs that were kept back".into()
    }

    fn state(&self) -> String {
        format!("{:?}", self.wrong_view)
    }

    fn pictures(&mut self, _: &Capture, targets: &[Target]) -> Result<Vec<Picture>, SourceError> {
        let picture = |target: &Target| -> Result<Picture, SourceError> {
            let view = self.whole.train.iter().find(|v| v.camera == target.camera).ok_or("no such view")?;
            let shot = view.shots.iter().find(|s| s.light == target.light).ok_or("no such light")?;
            let seen = self.whole.observation(shot)?;
            let (w, h, _) = seen.radiance.shape();
            let mask = if target.view == self.wrong_view { Some(Mask::full(w, h)) } else { seen.mask.clone() };
            Ok(Picture { radiance: seen.radiance.clone(), mask, confidence: Image::filled(w, h, 1, 1.0) })
        };
        targets.iter().map(picture).collect()
    }
}

#[test]
fn other_sources_come_in_by_the_same_door() {
    let settings = |source: &str| config("mlp", &format!("source = \"{source}\"\nlights = 2\nshare = 0.4\n"));
    let source = |wrong_view| Box::new(Photographs { whole: whole(), wrong_view });
    let mut alone = Reconstruction::new(capture(), &settings("none")).expect("starts").with_source(source(None));
    let (notes, reports) = finish(&mut alone);
    assert_eq!(alone.made_pictures().len(), 6);
    assert!(notes.iter().any(|n| n.contains("by photographs that were kept back, believed to 1.00")), "{notes:?}");
    // Four tenths of twelve steps, rounded up since the first is one.
    assert_eq!(reports.iter().filter(|r| r.terms.iter().any(|t| t.name == "made_l1")).count(), 5);

    let mut both = Reconstruction::new(capture(), &settings("prior")).expect("starts").with_source(source(Some(1)));
    let (notes, _) = finish(&mut both);
    let refused = notes.iter().find(|n| n.contains("kept back")).expect("a note");
    assert!(
        refused.contains("4 pictures") && refused.contains("2 refused") && refused.contains("overlaps"),
        "{notes:?}"
    );
    assert_eq!(both.made_pictures().len(), 10);

    // Without a source or with nothing to count, nothing is made.
    let mut off = Reconstruction::new(capture(), &settings("none")).expect("starts");
    let (notes, _) = finish(&mut off);
    assert!(notes.is_empty() && off.made_pictures().is_empty() && !off.needs().made_pictures.needed);
    assert!(off.needs().made_pictures.reason.contains("12 of 18 pairs"), "{}", off.needs().made_pictures.reason);
    let nothing = config("mlp", "source = \"prior\"\nshare = 0.0\n");
    let mut same = Reconstruction::new(capture(), &nothing).expect("starts");
    finish(&mut same);
    assert!(same.made_pictures().is_empty() && same.needs().made_pictures.reason.contains("share = 0"));
    assert!(state(&mut same, "nothing").tensors == state(&mut off, "off").tensors);

    // Unless told otherwise a model with a medium has pictures where lights are missing, and one without has none.
    let asks = |model: &str, capture: Capture| {
        let run = Reconstruction::new(capture, &config(model, "lights = 2\n")).expect("starts");
        (run.needs().made_pictures.needed, run.pictures_due())
    };
    assert_eq!(asks("profile+mlp", capture()), (true, true));
    assert_eq!(asks("mlp", capture()), (false, false));
    assert!(!asks("profile+mlp", whole()).0);
}

/// A picture that is wholly believed and has the weight of a photograph is one; believed by half, its terms are half.
#[test]
fn belief_scales_what_a_picture_says() {
    let config = config("mlp", "");
    let capture = capture();
    let (view, shot) = (&capture.train[0], &capture.train[0].shots[0]);
    let seen = capture.observation(shot).expect("read");
    let (w, h, _) = seen.radiance.shape();
    let step = |believed: Option<&Image>, weight: f32| {
        let (scene, points) = survey(&capture, &config).expect("a scene");
        let mut engine = CpuEngine::new(Model::initial(&config, scene, &points).expect("a model"));
        let pair = TrainingPair {
            camera: &view.camera,
            light: &shot.light,
            radiance: &seen.radiance,
            mask: seen.mask.as_ref(),
            weight,
            believed,
            content: Some(diamond_reconstruct::Region::whole(w, h)),
            view: 0,
            image: 0,
            neighbour: None,
            guide: None,
        };
        engine.training_step(0, &StepPlan::new(&config, 0), &[pair]).expect("a step")
    };
    let term = |report: &StepReport, name: &str| {
        report.terms.iter().find(|t| t.name == name).map(|t| t.weight * t.value).unwrap_or_else(|| panic!("no {name}"))
    };
    let (whole, half) = (Image::filled(w, h, 1, 1.0), Image::filled(w, h, 1, 0.5));
    let photograph = step(None, 1.0);
    let made = step(Some(&whole), 1.0);
    assert!((photograph.objective - made.objective).abs() < 1e-6 * photograph.objective);
    assert!((photograph.psnr - made.psnr).abs() < 1e-3);
    for (of_photograph, of_made) in [("l1", "made_l1"), ("dssim", "made_dssim"), ("mask", "mask")] {
        let all = term(&photograph, of_photograph);
        assert!((term(&made, of_made) - all).abs() < 1e-6 * all);
        let doubt = term(&step(Some(&half), 0.5), of_made);
        let expected = if of_made == "mask" { 0.5 } else { 0.25 };
        assert!((doubt - expected * all).abs() < 1e-5 * all, "{of_made}: {doubt} of {all}");
    }
}
