//! Shards hold what the capture holds, to the precision of half floats; the same again, and after an interruption.
use diamond_dataset::{Capture, OpenOptions};
use diamond_synth::{Recipe, ShardOptions, export_shards, synthesize};
use half::f16;
use safetensors::{Dtype, SafeTensors};
use std::path::Path;

const RECIPE: &str = r#"
name = "small"
[object]
kind = "solids"
cells = 12
parts = [{ solid = "sphere", centre = [0, 0, 0.1], radius = 0.7 }]
[material]
sigma_t = [6, 8, 12]
albedo = [0.98, 0.9, 0.7]
coat = { roughness = 0.5, f0 = [0.04, 0.05, 0.06] }
[rig]
views = 3
lights = 2
[held_out]
views = 1
seen_lights = 1
unseen_lights = 2
[film]
resolution = 12
points = 20
sixteen_bits = true
[quality]
points = 60
walks = 16
samples_per_axis = 2
measure = false
"#;

fn floats(tensors: &SafeTensors<'_>, name: &str, shape: &[usize]) -> Vec<f32> {
    let tensor = tensors.tensor(name).unwrap();
    assert_eq!(tensor.shape(), shape, "{name}");
    match tensor.dtype() {
        Dtype::F16 => tensor.data().chunks_exact(2).map(|b| f16::from_le_bytes([b[0], b[1]]).to_f32()).collect(),
        Dtype::F32 => tensor.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect(),
        other => panic!("{name}: {other:?}"),
    }
}

#[test]
fn shards_hold_the_capture_and_come_out_the_same() {
    let parent = std::env::temp_dir().join(format!("diamond-shards-{}", std::process::id()));
    let path = parent.join("ball");
    let recipe = Recipe::parse(RECIPE, "small").unwrap();
    synthesize(&recipe, Path::new(""), &path, &|_, _| ()).unwrap();
    let capture = Capture::open(&path, &OpenOptions::default()).unwrap();
    // Two training views fit into a shard.
    let options = ShardOptions { bytes: 2 * 12 * 12 * (6 * 2 + 12) };
    let index = export_shards(std::slice::from_ref(&path), &parent.join("a"), &options, &|_, _| ()).unwrap();
    let shapes: Vec<_> = index.shards.iter().map(|s| (s.split.as_str(), s.first_view, s.shape)).collect();
    assert_eq!(shapes, [("train", 0, [2, 2, 12, 12]), ("train", 2, [1, 2, 12, 12]), ("test", 0, [1, 3, 12, 12])]);

    for entry in &index.shards {
        let bytes = std::fs::read(parent.join("a").join(&entry.file)).unwrap();
        let tensors = SafeTensors::deserialize(&bytes).unwrap();
        let [views, lights, height, width] = entry.shape;
        let images = floats(&tensors, "images", &[views, lights, height, width, 3]);
        let coverage = floats(&tensors, "coverage", &[views, height, width]);
        let depth = floats(&tensors, "depth", &[views, height, width]);
        let normal = floats(&tensors, "normal", &[views, height, width, 3]);
        let poses = floats(&tensors, "world_to_camera", &[views, 3, 4]);
        let intrinsics = floats(&tensors, "intrinsics", &[views, 4]);
        let positions = floats(&tensors, "light_positions", &[views, lights, 3]);
        assert_eq!(floats(&tensors, "light_intensities", &[views, lights, 3]), vec![1.0; 3 * views * lights]);
        assert_eq!(floats(&tensors, "albedo", &[3]), [0.98, 0.9, 0.7]);
        assert_eq!(floats(&tensors, "sigma_t", &[3]), [6.0, 8.0, 12.0]);
        assert_eq!(floats(&tensors, "g", &[1]), [0.0]);
        assert_eq!(floats(&tensors, "coat", &[4]), [0.5, 0.04, 0.05, 0.06]);
        let source = if entry.split == "train" { &capture.train } else { &capture.test };
        let close = |found: &[f32], expected: &[f32]| {
            assert_eq!(found.len(), expected.len());
            for (a, b) in found.iter().zip(expected) {
                assert!((a - b).abs() <= b.abs() / 2048.0 + 1e-7, "{a} {b}");
            }
        };
        for (v, view) in source[entry.first_view..][..views].iter().enumerate() {
            let k = view.camera.intrinsics;
            assert_eq!(intrinsics[4 * v..4 * v + 4], [k.fx, k.fy, k.cx, k.cy]);
            let centre = view.camera.pose.centre();
            for row in 0..3 {
                // The camera's centre is the camera's origin.
                let r = &poses[12 * v + 4 * row..][..4];
                assert!((r[0] * centre.x + r[1] * centre.y + r[2] * centre.z + r[3]).abs() < 1e-5);
            }
            let geometry = view.ground_truth_geometry().unwrap().unwrap();
            assert_eq!(depth[v * 144..][..144], *geometry.depth.data());
            close(&normal[v * 432..][..432], geometry.normal.data());
            for (l, shot) in view.shots.iter().enumerate() {
                let observation = capture.observation(shot).unwrap();
                close(&images[(v * lights + l) * 432..][..432], observation.radiance.data());
                close(&coverage[v * 144..][..144], observation.mask.as_ref().unwrap().data());
                let position = shot.light.position().unwrap().to_array();
                assert_eq!(positions[3 * (v * lights + l)..][..3], position);
            }
        }
        assert!(images.iter().any(|v| *v > 0.1));
    }

    // As after an interruption: one shard is missing, one was cut short, the index is not there.
    let b = parent.join("b");
    let again = export_shards(std::slice::from_ref(&path), &b, &options, &|_, _| ()).unwrap();
    assert_eq!(again, index);
    std::fs::remove_file(b.join(&index.shards[0].file)).unwrap();
    std::fs::remove_file(b.join("index.json")).unwrap();
    let cut = b.join(&index.shards[1].file);
    let bytes = std::fs::read(&cut).unwrap();
    std::fs::write(&cut, &bytes[..bytes.len() - 5]).unwrap();
    let kept = std::fs::metadata(b.join(&index.shards[2].file)).unwrap().modified().unwrap();
    assert_eq!(export_shards(std::slice::from_ref(&path), &b, &options, &|_, _| ()).unwrap(), index);
    assert_eq!(std::fs::metadata(b.join(&index.shards[2].file)).unwrap().modified().unwrap(), kept);
    let twice = export_shards(&[path.clone(), path], &b, &options, &|_, _| ()).unwrap_err().to_string();
    assert!(twice.contains("ball twice"), "{twice}");
    std::fs::remove_dir_all(&parent).unwrap();
}
