//! Readers of what this program writes: configurations, records, models, checkpoints, logs; and words of the command
//! line.
use super::harness::{Answer, Target};
use super::random::Random;
use super::{folder_in, law, small_config_text};
use crate::captures::tiny_capture;
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_dataset::{Capture, OpenOptions, Selection};
use diamond_light::OlatLight;
use diamond_reconstruct::{Config, Model, PRESETS, Reconstruction, TensorFile};
use diamond_sss::{RunRecord, StoredCamera, StoredLight, TrainingLog, parse_cameras, parse_mix, parse_vec3};
use glam::Vec3;
use std::path::{Path, PathBuf};

/// All of them.
/// Folders are made in `dir`.
pub fn targets(dir: &Path) -> Vec<Target> {
    let mut out = vec![config(), record(), cameras(), words(), log(dir), tensors()];
    let (folder, state) = trained(dir);
    for file in ["model.ply", "config.toml", "scene.toml", "network.safetensors"] {
        out.push(model(dir, file, &folder));
    }
    out.push(resume(dir, &folder, state));
    out
}

fn name() -> &'static Path {
    Path::new("input")
}

fn config() -> Target {
    let mut seeds: Vec<Vec<u8>> =
        PRESETS.iter().map(|p| Config::preset(p).unwrap().to_toml().unwrap().into_bytes()).collect();
    seeds.push(small_config_text().into_bytes());
    let check = |bytes: &[u8]| {
        let Ok(text) = std::str::from_utf8(bytes) else { return Answer::refused("not UTF-8") };
        let config = match Config::parse(text, "input") {
            Err(e) => return Answer::refused(e),
            Ok(config) => config,
        };
        let written = config.to_toml().map_err(|e| format!("cannot be written: {e}"))?;
        if let Some(line) = written.lines().find(|l| [" = nan", " = inf", " = -inf"].iter().any(|w| l.ends_with(w))) {
            return Err(format!("accepts {line}"));
        }
        match Config::parse(&written, "written") {
            Ok(again) if again == config => Ok(Answer::Parsed),
            Ok(_) => Err("changes in being written and read".into()),
            Err(e) => Err(format!("what it writes is refused: {e}")),
        }
    };
    Target { cases: 600, ..Target::new("config", seeds, check).text() }
}

fn camera() -> Camera {
    let pose = Pose::look_at(Vec3::new(3.0, 0.5, 1.0), Vec3::ZERO, Vec3::Z);
    Camera { intrinsics: Intrinsics::from_fov_x(0.8, 16, 12), pose }
}

fn light() -> OlatLight {
    OlatLight::Point { position: Vec3::new(1.0, 4.0, 2.0), intensity: Vec3::ONE }
}

fn record() -> Target {
    let seed = RunRecord {
        version: "0.1.0".into(),
        command: "diamond reconstruct".into(),
        capture: "capture".into(),
        capture_hash: "00".into(),
        views: "all".into(),
        lights: "3".into(),
        preset: "resolved".into(),
        steps: 10,
        seed: 1,
        threads: 2,
        instruction_set: "portable".into(),
        training_images: 4,
        up: [0.0, 0.0, 1.0],
        cameras: vec![StoredCamera::of("r_0", &camera())],
        rig: vec![StoredLight::of(&light())],
        seconds: None,
        peak_bytes: Some(7),
    };
    let check = |bytes: &[u8]| {
        let record = match RunRecord::parse(name(), bytes) {
            Err(e) => return Answer::refused(e),
            Ok(record) => record,
        };
        for camera in record.cameras.iter().filter_map(|c| c.camera(name()).ok()) {
            law("camera", camera.validate())?;
        }
        for light in record.rig.iter().filter_map(|l| l.light(name()).ok()) {
            law("light", light.validate())?;
        }
        let written = serde_json::to_vec(&record).map_err(|e| e.to_string())?;
        match RunRecord::parse(name(), &written) {
            Ok(again) if again == record => Ok(Answer::Parsed),
            Ok(_) => Err("changes in being written and read".into()),
            Err(e) => Err(format!("what it writes is refused: {e}")),
        }
    };
    let seed = serde_json::to_vec_pretty(&seed).unwrap();
    Target { cases: 1000, ..Target::new("run_record", vec![seed], check).text() }
}

fn cameras() -> Target {
    let one = serde_json::to_value(StoredCamera::of("a", &camera())).unwrap();
    let mut angle = one.clone();
    angle.as_object_mut().unwrap().retain(|k, _| !["fl_x", "fl_y", "cx", "cy"].contains(&k.as_str()));
    angle["camera_angle_x"] = 0.7.into();
    let seeds = [serde_json::json!([one, one]), serde_json::json!({"frames": [angle]}), one];
    let check = |bytes: &[u8]| match parse_cameras(name(), bytes) {
        Err(e) => Answer::refused(e),
        Ok(cameras) => {
            for camera in &cameras {
                law("camera", camera.validate())?;
                let k = &camera.intrinsics;
                if u64::from(k.width) * u64::from(k.height) > 1 << 26 {
                    return Err(format!("a picture of {}×{}", k.width, k.height));
                }
            }
            Ok(Answer::Parsed)
        }
    };
    let seeds = seeds.iter().map(|v| v.to_string().into_bytes()).collect();
    Target { cases: 1000, ..Target::new("cameras", seeds, check).text() }
}

fn words() -> Target {
    let seeds = ["3", "0,5,7", "0-7", "2,", "all", "1,-2,3.5", "4,0,2:1,0.6,0.3;-4,0,2:0.3,0.6,1"];
    let check = |bytes: &[u8]| {
        let text = String::from_utf8_lossy(bytes);
        let selection = text.parse::<Selection>();
        if let Ok(selection) = &selection
            && selection.to_string().parse::<Selection>().ok().as_ref() != Some(selection)
        {
            return Err(format!("{selection} does not read back"));
        }
        let (vector, mix) = (parse_vec3(&text), parse_mix(&text));
        if vector.as_ref().is_ok_and(|v| !v.is_finite())
            || mix.as_ref().is_ok_and(|m| m.iter().any(|(p, c)| !p.is_finite() || !c.is_finite()))
        {
            return Err("infinite".into());
        }
        match (selection, vector, mix) {
            (Err(e), Err(_), Err(_)) => Answer::refused(e),
            _ => Ok(Answer::Parsed),
        }
    };
    Target { cases: 2000, ..Target::new("words", seeds.map(|s| s.as_bytes().to_vec()).to_vec(), check).text() }
}

fn log(dir: &Path) -> Target {
    let seed = b"step,objective,psnr,gaussians,l1,ssim\n1,0.5,20.25,100,0.25,0.125\n2,0.4,21,101,0.2,0.1\n".to_vec();
    let path = dir.join("log.csv");
    let check = move |bytes: &[u8]| {
        std::fs::write(&path, bytes).map_err(|e| e.to_string())?;
        let log = TrainingLog::read_until(&path, 10, 1_000_000);
        let _ = log.to_csv();
        let _ = log.running_psnr();
        let finite = |v: &f64| v.is_finite();
        match log.rows.iter().all(|r| finite(&r.objective) && finite(&r.psnr) && r.terms.iter().all(finite)) {
            true => Ok(Answer::Parsed),
            false => Err("a row is not finite".into()),
        }
    };
    Target { cases: 300, ..Target::new("log", vec![seed], check).text() }
}

/// Between the header and the data of a tensor file before it is wrapped.
const DATA: &[u8] = b"\n== data ==\n";

/// A tensor file as its header and its data, so that both can be mutated as what they are.
fn unwrapped(file: &[u8]) -> Vec<u8> {
    let length = u64::from_le_bytes(file[..8].try_into().unwrap()) as usize;
    [&file[8..8 + length], DATA, &file[8 + length..]].concat()
}

/// The file of a header and data; mostly with the checksum that belongs to them.
fn tensor_file(content: Vec<u8>, random: &mut Random) -> Vec<u8> {
    let Some(at) = content.windows(DATA.len()).position(|w| w == DATA) else { return content };
    let (header, data) = (&content[..at], &content[at + DATA.len()..]);
    let mut header = header.to_vec();
    if !random.one_in(8)
        && let Ok(serde_json::Value::Object(mut map)) = serde_json::from_slice(&header)
    {
        let mut tensors = std::collections::BTreeMap::new();
        for (name, entry) in map.iter().filter(|(name, _)| *name != "__metadata__") {
            let offset = |k: usize| entry["data_offsets"][k].as_u64().unwrap_or(0) as usize;
            tensors.insert(name.clone(), data.get(offset(0)..offset(1)).unwrap_or_default());
        }
        let sum = diamond_reconstruct::tensor_digest(tensors.iter().map(|(n, d)| (n, *d)));
        if let Some(serde_json::Value::Object(metadata)) = map.get_mut("__metadata__") {
            metadata.insert("sha256".into(), sum.into());
        }
        header = serde_json::to_vec(&map).unwrap_or_default();
    }
    [&(header.len() as u64).to_le_bytes()[..], &header, data].concat()
}

fn tensors() -> Target {
    let mut file = TensorFile::default();
    file.insert("a", &[2, 3], vec![1.0, -2.0, 3.5, 0.0, 1e-30, 1e30]);
    file.insert("empty", &[0], vec![]);
    file.metadata.insert("step".into(), "12".into());
    let seed = unwrapped(&file.to_bytes(name()).unwrap());
    let check = |bytes: &[u8]| {
        let file = match TensorFile::parse(name(), bytes) {
            Err(e) => return Answer::refused(e),
            Ok(file) => file,
        };
        if file.tensors.values().any(|(shape, v)| shape.iter().product::<usize>() != v.len()) {
            return Err("a shape that is not that of the values".into());
        }
        if file.tensors.values().any(|(_, v)| v.iter().any(|v| !v.is_finite())) {
            return Err("accepts values that are not finite".into());
        }
        let written = file.to_bytes(name()).map_err(|e| e.to_string())?;
        match TensorFile::parse(name(), &written) {
            Ok(again) if again == file => Ok(Answer::Parsed),
            Ok(_) => Err("changes in being written and read".into()),
            Err(e) => Err(format!("what it writes is refused: {e}")),
        }
    };
    Target { wrap: tensor_file, cases: 1000, ..Target::new("tensors", vec![seed], check).text() }
}

fn small_config() -> Config {
    Config::parse(&small_config_text(), "small").unwrap()
}

/// A folder with a capture, a model and a checkpoint, and the checkpoint's bytes.
fn trained(dir: &Path) -> (PathBuf, Vec<u8>) {
    let dir = folder_in(dir, "trained");
    tiny_capture(&dir.join("capture"), 2, 2);
    let capture = Capture::open(&dir.join("capture"), &OpenOptions::default()).unwrap();
    let mut run = Reconstruction::new(capture, &small_config()).unwrap();
    run.step().unwrap();
    let state = run.save_checkpoint(&dir.join("checkpoint")).unwrap();
    run.model().unwrap().save(&dir.join("model")).unwrap();
    (dir, std::fs::read(state).unwrap())
}

/// A model's folder in which one file is bad.
fn model(dir: &Path, file: &'static str, trained: &Path) -> Target {
    let target = match file {
        "model.ply" => "model_ply",
        "config.toml" => "model_config",
        "scene.toml" => "model_scene",
        _ => "model_network",
    };
    let folder = folder_in(dir, target);
    for entry in std::fs::read_dir(trained.join("model")).unwrap() {
        let path = entry.unwrap().path();
        std::fs::copy(&path, folder.join(path.file_name().unwrap())).unwrap();
    }
    let seed = std::fs::read(folder.join(file)).unwrap();
    let check = move |bytes: &[u8]| {
        std::fs::write(folder.join(file), bytes).map_err(|e| e.to_string())?;
        let model = match Model::load(&folder) {
            Err(e) => return Answer::refused(e),
            Ok(model) => model,
        };
        match model.render(&camera(), &[light()]) {
            Err(e) => Answer::refused(e),
            Ok(pictures) if pictures.iter().any(|p| p.radiance.data().iter().any(|v| !v.is_finite())) => {
                Err("a picture that is not finite".into())
            }
            Ok(_) => Ok(Answer::Parsed),
        }
    };
    let out = Target::new(target, vec![seed.clone()], check);
    match file {
        "network.safetensors" => {
            Target { seeds: vec![unwrapped(&seed)], wrap: tensor_file, text: true, cases: 60, ..out }
        }
        "model.ply" => Target { cases: 60, ..out },
        _ => Target { text: true, cases: 60, ..out },
    }
}

/// A checkpoint to go on from.
fn resume(dir: &Path, trained: &Path, state: Vec<u8>) -> Target {
    let capture = Capture::open(&trained.join("capture"), &OpenOptions::default()).unwrap();
    let (folder, config) = (folder_in(dir, "resume"), small_config());
    let check = move |bytes: &[u8]| {
        std::fs::write(folder.join("state.safetensors"), bytes).map_err(|e| e.to_string())?;
        let mut run = match Reconstruction::resume(capture.clone(), &config, &folder) {
            Err(e) => return Answer::refused(e),
            Ok(run) => run,
        };
        if run.finished() {
            return Ok(Answer::Parsed);
        }
        match run.step() {
            Err(e) => Answer::refused(e),
            Ok(report) if !report.objective.is_finite() => Err(format!("objective {}", report.objective)),
            Ok(_) => Ok(Answer::Parsed),
        }
    };
    let out = Target::new("resume", vec![unwrapped(&state)], check);
    Target { wrap: tensor_file, text: true, cases: 60, ..out }
}
