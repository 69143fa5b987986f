//! A whole capture, small: it opens as captures do, is the same again, goes on after an interruption, and knows its error.
use diamond_dataset::{Capture, OpenOptions};
use diamond_synth::{Recipe, Stage, synthesize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

const RECIPE: &str = r#"
name = "small"
seed = 7
[object]
kind = "solids"
cells = 20
blend = 0.2
parts = [
  { solid = "sphere", centre = [0, 0, -0.2], radius = 0.6 },
  { solid = "sphere", centre = [0.2, 0, 0.5], radius = 0.3 },
]
[material]
sigma_t = [6, 8, 12]
albedo = [0.98, 0.9, 0.7]
coat = { roughness = 0.4, f0 = [0.04, 0.04, 0.04] }
[rig]
views = 3
lights = 3
[held_out]
views = 1
seen_lights = 1
unseen_lights = 1
[film]
resolution = 16
points = 50
exr = true
[quality]
points = 150
walks = 64
samples_per_axis = 2
"#;

fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut all = BTreeMap::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => folders.push(path),
                false => {
                    let bytes = std::fs::read(&path).unwrap();
                    all.insert(path.strip_prefix(folder).unwrap().to_path_buf(), bytes);
                }
            }
        }
    }
    all
}

#[test]
fn a_capture_is_made_opened_made_again_and_continued() {
    let parent = std::env::temp_dir().join(format!("diamond-synthesize-{}", std::process::id()));
    let recipe = Recipe::parse(RECIPE, "small").unwrap();
    let first = synthesize(&recipe, Path::new(""), &parent.join("a"), &|_, _| ()).unwrap();
    assert_eq!((first.images, first.rendered), (3 * 3 + 2, 11));
    let error = first.error.unwrap();
    assert!(error.bias.abs() < 0.25 && error.noise_db > 15.0, "{error:?}");

    let capture = Capture::open(&parent.join("a"), &OpenOptions::default()).unwrap();
    assert_eq!((capture.train.len(), capture.test.len(), capture.test[0].shots.len()), (3, 1, 2));
    let geometry = capture.train[0].ground_truth_geometry().unwrap().unwrap();
    assert!(geometry.depth.data().iter().any(|z| (3.0..4.5).contains(z)));
    let files_a = files(&parent.join("a"));
    assert!(files_a.keys().any(|f| f.starts_with("exr")) && files_a.contains_key(Path::new("points3d.ply")));
    let json: serde_json::Value = serde_json::from_slice(&files_a[Path::new("capture.json")]).unwrap();
    assert_eq!(json["recipe_hash"], recipe.hash());
    assert!(json["error"]["bias"].is_number());

    // On one thread, and interrupted after the second view.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let again = parent.join("b");
    let stopped = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
        pool.install(|| {
            synthesize(&recipe, Path::new(""), &again, &|stage, _| {
                let enough = matches!(stage, Stage::Images(done, _) if done >= 6);
                assert!(!enough, "interrupted here");
            })
        })
    }));
    assert!(stopped.is_err() && !again.exists());
    let solved = AtomicUsize::new(0);
    let record = pool
        .install(|| {
            synthesize(&recipe, Path::new(""), &again, &|stage, _| {
                if let Stage::Solve(..) = stage {
                    solved.fetch_add(1, Ordering::Relaxed);
                }
            })
        })
        .unwrap();
    assert_eq!(record.rendered, 3 + 2, "two views were there");
    assert!(files_a == files(&again), "the same recipe gives the same bytes");
    assert!(synthesize(&recipe, Path::new(""), &again, &|_, _| ()).is_err(), "it is there");
    std::fs::remove_dir_all(&parent).unwrap();
}
