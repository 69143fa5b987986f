//! Captures as safetensors shards of half floats: what a training loop of another program reads without decoding pictures.
//!
//! A shard holds consecutive views of one split of one capture as tensors; docs/captures.md has the layout. Shards that are there are kept, so
//! that an interrupted export goes on; the same captures give the same bytes.
use crate::SynthError;
use diamond_dataset::{Capture, DatasetError, OpenOptions, Split, View};
use diamond_light::OlatLight;
use half::f16;
use rayon::prelude::*;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use std::collections::{BTreeSet, HashMap};
use std::io::Write;
use std::path::{Path, PathBuf};

/// The form of shards; part of each one's identity.
const FORMAT: &str = "diamond-shard 1";

/// The key of a shard's metadata. One key with JSON in it: several would be written in any order.
const METADATA: &str = "diamond";

/// The file that lists the shards.
const INDEX: &str = "index.json";

/// How shards are cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ShardOptions {
    /// Bytes of a shard at most; a view with all its lights is never cut.
    pub bytes: u64,
}

impl Default for ShardOptions {
    fn default() -> Self {
        Self { bytes: 64 << 20 }
    }
}

/// A shard in the index.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ShardEntry {
    /// File beside the index.
    pub file: String,
    /// Name of the capture's folder.
    pub capture: String,
    /// `train` or `test`.
    pub split: String,
    /// First view within its split.
    pub first_view: usize,
    /// Views, lights of each, height and width of its images: the shape of `images` but for the three channels.
    pub shape: [usize; 4],
    /// Size of the file.
    pub bytes: u64,
    /// Of the file, hexadecimal.
    pub sha256: String,
}

/// What an export consists of: the contents of `index.json`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ShardIndex {
    /// The form of the shards.
    pub format: String,
    /// In the order of the captures, training views first.
    pub shards: Vec<ShardEntry>,
}

/// Bytes of half and whole floats, little-endian.
#[derive(Default)]
struct Tensors(Vec<(&'static str, Dtype, Vec<usize>, Vec<u8>)>);

impl Tensors {
    fn whole(&mut self, name: &'static str, shape: &[usize], values: impl IntoIterator<Item = f32>) {
        let bytes = values.into_iter().flat_map(f32::to_le_bytes).collect();
        self.0.push((name, Dtype::F32, shape.to_vec(), bytes));
    }

    fn half(&mut self, name: &'static str, shape: &[usize], values: impl IntoIterator<Item = f32>) {
        let bytes = values.into_iter().flat_map(|v| f16::from_f32(v).to_le_bytes()).collect();
        self.0.push((name, Dtype::F16, shape.to_vec(), bytes));
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

fn refuse(path: &Path, detail: impl Into<String>) -> SynthError {
    SynthError::Recipe { origin: path.display().to_string(), detail: detail.into() }
}

/// Writes a file whole or not at all.
fn put(path: &Path, bytes: &[u8]) -> Result<(), SynthError> {
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(".partial");
    let temporary = PathBuf::from(temporary);
    let written = std::fs::File::create(&temporary)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_all()))
        .and_then(|()| std::fs::rename(&temporary, path));
    written.map_err(|e| {
        let _ = std::fs::remove_file(&temporary);
        SynthError::Dataset(DatasetError::Write { path: path.into(), reason: e.to_string() })
    })
}

/// A run of views that make one shard.
struct Chunk<'a> {
    split: &'static str,
    first: usize,
    views: &'a [View],
}

/// Size and number of lights: views of one shard agree in them.
fn form(view: &View) -> (usize, u32, u32) {
    (view.shots.len(), view.camera.intrinsics.width, view.camera.intrinsics.height)
}

fn chunks(capture: &Capture, bytes: u64) -> Vec<Chunk<'_>> {
    let mut all = Vec::new();
    for (split, name) in [(Split::Train, "train"), (Split::Test, "test")] {
        let mut first = 0;
        for same in capture.views(split).chunk_by(|a, b| form(a) == form(b)) {
            let (lights, width, height) = form(&same[0]);
            let pixels = u64::from(width) * u64::from(height);
            // Images, coverage, depth, normals.
            let size = pixels * (6 * lights as u64 + 2 + 4 + 6);
            let most = (bytes / size.max(1)).max(1) as usize;
            for views in same.chunks(most) {
                all.push(Chunk { split: name, first, views });
                first += views.len();
            }
        }
    }
    all
}

/// What `capture.json` says of a synthetic capture; null where there is none.
fn record(capture: &Capture) -> Value {
    let text = std::fs::read(capture.root.join("capture.json")).unwrap_or_default();
    serde_json::from_slice(&text).unwrap_or(Value::Null)
}

fn tensors(capture: &Capture, chunk: &Chunk<'_>, record: &Value) -> Result<Tensors, SynthError> {
    let (lights, width, height) = form(&chunk.views[0]);
    let (width, height, views) = (width as usize, height as usize, chunk.views.len());
    let pixels = width * height;
    let mut tensors = Tensors::default();
    let shots: Vec<_> = chunk.views.iter().flat_map(|view| &view.shots).collect();
    let images: Vec<Vec<u8>> = shots
        .par_iter()
        .map(|shot| {
            let observation = capture.observation(shot)?;
            let values = observation.radiance.data();
            if let Some(v) = values.iter().find(|v| !f16::from_f32(**v).is_finite()) {
                return Err(refuse(
                    &shot.path,
                    format!("expected radiance that half floats can hold, at most 65504, found {v}"),
                ));
            }
            Ok(values.iter().flat_map(|v| f16::from_f32(*v).to_le_bytes()).collect())
        })
        .collect::<Result<_, SynthError>>()?;
    tensors.0.push(("images", Dtype::F16, vec![views, lights, height, width, 3], images.concat()));
    let (mut coverage, mut depth, mut normal) = (Vec::new(), Vec::new(), Vec::new());
    let has_geometry = chunk.views.iter().all(View::has_ground_truth_geometry);
    for view in chunk.views {
        match &capture.observation(&view.shots[0])?.mask {
            Some(mask) => coverage.extend_from_slice(mask.data()),
            None => coverage.resize(coverage.len() + pixels, 1.0),
        }
        if let Some(geometry) = view.ground_truth_geometry()?.filter(|_| has_geometry) {
            depth.extend_from_slice(geometry.depth.data());
            normal.extend_from_slice(geometry.normal.data());
        }
    }
    tensors.half("coverage", &[views, height, width], coverage);
    if has_geometry {
        tensors.whole("depth", &[views, height, width], depth);
        tensors.half("normal", &[views, height, width, 3], normal);
    }
    let intrinsics = chunk.views.iter().map(|view| &view.camera.intrinsics);
    tensors.whole("intrinsics", &[views, 4], intrinsics.flat_map(|k| [k.fx, k.fy, k.cx, k.cy]));
    let rows = |view: &View| {
        let (r, t) = (view.camera.pose.rotation, view.camera.pose.translation);
        (0..3).flat_map(move |i| [r.row(i).x, r.row(i).y, r.row(i).z, t[i]]).collect::<Vec<f32>>()
    };
    tensors.whole("world_to_camera", &[views, 3, 4], chunk.views.iter().flat_map(rows));
    let mut positions = Vec::new();
    for shot in &shots {
        let OlatLight::Point { position, .. } = shot.light else {
            return Err(refuse(
                &shot.path,
                "expected a point light, found a direction; shards hold positions of lights",
            ));
        };
        positions.extend(position.to_array());
    }
    tensors.whole("light_positions", &[views, lights, 3], positions);
    tensors.whole(
        "light_intensities",
        &[views, lights, 3],
        shots.iter().flat_map(|shot| shot.light.intensity().to_array()),
    );
    let material = &record["recipe"]["material"];
    let numbers = |value: &Value| -> Option<Vec<f32>> {
        let list = value.as_array().cloned().unwrap_or_else(|| vec![value.clone()]);
        list.iter().map(|v| v.as_f64().map(|v| v as f32)).collect()
    };
    for (name, value, count) in
        [("sigma_t", &material["sigma_t"], 3), ("albedo", &material["albedo"], 3), ("g", &material["g"], 1)]
    {
        if let Some(values) = numbers(value).filter(|v| v.len() == count) {
            tensors.whole(name, &[count], values);
        }
    }
    let coat = &material["coat"];
    if let (Some(roughness), Some(f0)) = (numbers(&coat["roughness"]), numbers(&coat["f0"])) {
        let values: Vec<f32> = roughness.into_iter().chain(f0).collect();
        if values.len() == 4 {
            tensors.whole("coat", &[4], values);
        }
    }
    Ok(tensors)
}

/// The metadata of a shard's bytes.
fn metadata(bytes: &[u8]) -> Option<Value> {
    let (_, header) = SafeTensors::read_metadata(bytes).ok()?;
    serde_json::from_str(header.metadata().as_ref()?.get(METADATA)?).ok()
}

/// Writes captures as shards into the folder `dir`, with an `index.json`. `progress` is told how many shards are done, and of how many.
///
/// # Errors
/// Captures that cannot be read, have directional lights or values beyond half floats; two captures whose folders have one name; the
/// system's.
pub fn export_shards(
    captures: &[PathBuf],
    dir: &Path,
    options: &ShardOptions,
    progress: &dyn Fn(usize, usize),
) -> Result<ShardIndex, SynthError> {
    let mut opened = Vec::new();
    let mut names = BTreeSet::new();
    for path in captures {
        let capture = Capture::open(path, &OpenOptions { cache_bytes: 0, ..OpenOptions::default() })?;
        let name = capture.root.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        if !names.insert(name.clone()) {
            return Err(refuse(
                path,
                format!("expected captures with different names, found {name} twice; rename one"),
            ));
        }
        opened.push((name, capture));
    }
    std::fs::create_dir_all(dir)
        .map_err(|e| SynthError::Dataset(DatasetError::Write { path: dir.into(), reason: e.to_string() }))?;
    let all: usize = opened.iter().map(|(_, capture)| chunks(capture, options.bytes).len()).sum();
    let mut shards = Vec::new();
    for (name, capture) in &opened {
        let hash = capture.hash()?;
        let record = record(capture);
        for chunk in chunks(capture, options.bytes) {
            let (lights, width, height) = form(&chunk.views[0]);
            let shape = [chunk.views.len(), lights, height as usize, width as usize];
            let identity = format!("{FORMAT} {hash} {} {} {}", chunk.split, chunk.first, chunk.views.len());
            let identity = hex(&Sha256::digest(identity.as_bytes()));
            let file = format!("{name}-{}-{:04}.safetensors", chunk.split, chunk.first);
            let path = dir.join(&file);
            let there = std::fs::read(&path).ok();
            let kept = there.filter(|bytes| {
                SafeTensors::deserialize(bytes).is_ok() && metadata(bytes).is_some_and(|m| m["identity"] == identity)
            });
            let bytes = match kept {
                Some(bytes) => bytes,
                None => {
                    let about = json!({
                        "format": FORMAT, "identity": identity, "capture": name, "capture_sha256": hash, "split": chunk.split,
                        "first_view": chunk.first, "name": record["recipe"]["name"], "recipe_hash": record["recipe_hash"],
                        "exposure": record["exposure"], "error": record["error"],
                        "falloff": record["falloff"],
                        "radiance": "linear sRGB primaries, multiplied by the exposure and by coverage",
                    });
                    let tensors = tensors(capture, &chunk, &record)?;
                    let views = tensors.0.iter().map(|(name, dtype, shape, bytes)| {
                        Ok((
                            *name,
                            TensorView::new(*dtype, shape.clone(), bytes).map_err(|e| refuse(&path, e.to_string()))?,
                        ))
                    });
                    let views: Vec<_> = views.collect::<Result<_, SynthError>>()?;
                    let about = HashMap::from([(METADATA.to_string(), about.to_string())]);
                    let bytes = safetensors::serialize(views, Some(about)).map_err(|e| refuse(&path, e.to_string()))?;
                    put(&path, &bytes)?;
                    bytes
                }
            };
            shards.push(ShardEntry {
                file,
                capture: name.clone(),
                split: chunk.split.into(),
                first_view: chunk.first,
                shape,
                bytes: bytes.len() as u64,
                sha256: hex(&Sha256::digest(&bytes)),
            });
            progress(shards.len(), all);
        }
    }
    let index = ShardIndex { format: FORMAT.into(), shards };
    let text = serde_json::to_string_pretty(&index).map_err(|e| refuse(dir, e.to_string()))?;
    put(&dir.join(INDEX), format!("{text}\n").as_bytes())?;
    Ok(index)
}
