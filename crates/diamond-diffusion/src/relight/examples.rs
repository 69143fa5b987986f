//! Training examples from shards of captures: views under many lights, at the size of the network.
use super::hints::{RelightView, hint_planes};
use super::ratio::encode_ratio;
use crate::error::{DiffusionError, Result};
use crate::light_code::light_code;
use crate::noise::Noise;
use crate::unet::LIGHT_CHANNELS;
use crate::weights::read_weights;
use candle_core::{Device, Tensor};
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::Image;
use glam::{Mat3, Vec3};
use std::collections::BTreeMap;
use std::path::Path;

/// A batch to train on; pictures have (batch, channels, height, width).
#[derive(Debug, Clone)]
pub struct RelightBatch {
    /// Logarithms of ratios of target to source, 3 channels.
    pub ratios: Tensor,
    /// What the ControlNet is shown.
    pub hints: Tensor,
    /// Codes of the target lights, (batch, 9).
    pub lights: Tensor,
}

impl RelightBatch {
    /// Of views with their target pictures (linear, divided by the light's intensity) and target lights; all of one size.
    pub fn new(examples: &[(&RelightView, &Image, Vec3)]) -> Result<Self> {
        let Some((first, ..)) = examples.first() else {
            return Err(DiffusionError::setting("batch", "at least one example", "none"));
        };
        let (width, height, _) = first.source.shape();
        let (mut ratios, mut hints, mut lights) = (Vec::new(), Vec::new(), Vec::new());
        for (view, target, light) in examples {
            if view.source.shape() != (width, height, 3) || target.shape() != (width, height, 3) {
                return Err(DiffusionError::shape("pictures of a batch", (width, height, 3), target.shape()));
            }
            hints.extend(hint_planes(view, *light)?);
            for c in 0..3 {
                let pairs = view.source.data().iter().zip(target.data()).skip(c).step_by(3);
                ratios.extend(pairs.map(|(source, target)| encode_ratio(*source, *target)));
            }
            lights.extend(view_light_code(view, *light)?);
        }
        let (batch, device) = (examples.len(), &Device::Cpu);
        Ok(Self {
            ratios: Tensor::from_vec(ratios, (batch, 3, height, width), device)?,
            hints: Tensor::from_vec(hints, (batch, super::HINTS, height, width), device)?,
            lights: Tensor::from_vec(lights, (batch, LIGHT_CHANNELS), device)?,
        })
    }
}

/// The light's code as seen from the object's centre.
pub(super) fn view_light_code(view: &RelightView, light: Vec3) -> Result<[f32; LIGHT_CHANNELS]> {
    let centre = view.centre_and_radius().map_or(Vec3::ZERO, |(centre, _)| centre);
    light_code(light - centre, &view.camera.pose)
}

/// A view with its pictures under all lights.
#[derive(Debug)]
struct Stored {
    view: RelightView,
    pictures: Vec<(Image, Vec3)>,
}

/// Views of shards, in memory at one size.
#[derive(Debug)]
pub struct RelightExamples {
    views: Vec<Stored>,
}

fn wrong(path: &Path, problem: impl Into<String>) -> DiffusionError {
    DiffusionError::File { path: path.display().to_string(), problem: problem.into() }
}

impl RelightExamples {
    /// The views of one split (`train` or `test`) of the shards that `folder`'s index.json lists, at `size` × `size` pixels.
    pub fn open(folder: &Path, split: &str, size: usize) -> Result<Self> {
        let index = folder.join("index.json");
        let text =
            std::fs::read(&index).map_err(|e| wrong(&index, format!("cannot be read: {e}; see `diamond shards`")))?;
        let json: serde_json::Value =
            serde_json::from_slice(&text).map_err(|e| wrong(&index, format!("no index of shards: {e}")))?;
        if json["format"] != "diamond-shard 1" {
            return Err(wrong(&index, format!("expected format \"diamond-shard 1\", found {}", json["format"])));
        }
        let mut views = Vec::new();
        for shard in json["shards"].as_array().into_iter().flatten().filter(|shard| shard["split"] == split) {
            let name = shard["file"].as_str().filter(|name| !name.contains(['/', '\\']) && *name != "..");
            let name = name.ok_or_else(|| wrong(&index, "a shard without a plain file name"))?;
            views.extend(read_shard(&folder.join(name), size)?);
        }
        views.retain(|stored: &Stored| stored.pictures.len() > 1 && stored.view.validate().is_ok());
        if views.is_empty() {
            return Err(wrong(&index, format!("no view of the split {split} has two lights and something in it")));
        }
        Ok(Self { views })
    }

    /// Number of views.
    pub fn len(&self) -> usize {
        self.views.len()
    }

    /// Never: [`RelightExamples::open`] refuses that.
    pub fn is_empty(&self) -> bool {
        self.views.is_empty()
    }

    /// Example `index` of a fixed order that depends on `seed` alone: the view with its source picture, the target and its light.
    pub fn example(&self, seed: u64, index: u64) -> (RelightView, &Image, Vec3) {
        let mut noise = Noise::new(seed, "relighting", index);
        let stored = &self.views[noise.below(self.views.len())];
        let count = stored.pictures.len();
        let source = noise.below(count);
        // Another light than the source's.
        let target = (source + 1 + noise.below(count - 1)) % count;
        let mut view = stored.view.clone();
        view.source = stored.pictures[source].0.clone();
        // One time in four the network is not told where the source's light is.
        view.source_light = (noise.below(4) > 0).then_some(stored.pictures[source].1);
        (view, &stored.pictures[target].0, stored.pictures[target].1)
    }

    /// Batch `step` of `count` examples.
    pub fn batch(&self, seed: u64, step: u64, count: usize) -> Result<RelightBatch> {
        let examples: Vec<_> = (0..count as u64).map(|i| self.example(seed, step * count as u64 + i)).collect();
        let borrowed: Vec<_> = examples.iter().map(|(view, target, light)| (view, *target, *light)).collect();
        RelightBatch::new(&borrowed)
    }
}

/// Values and shape of one tensor of a shard.
fn take(tensors: &BTreeMap<String, Tensor>, path: &Path, name: &str, rank: usize) -> Result<(Vec<f32>, Vec<usize>)> {
    let tensor = tensors.get(name).ok_or_else(|| wrong(path, format!("no tensor {name}: not a shard")))?;
    if tensor.rank() != rank {
        return Err(wrong(path, format!("{name}: expected {rank} dimensions, found {:?}", tensor.dims())));
    }
    Ok((tensor.flatten_all()?.to_vec1()?, tensor.dims().to_vec()))
}

fn read_shard(path: &Path, size: usize) -> Result<Vec<Stored>> {
    let tensors = read_weights(path)?;
    let (images, dims) = take(&tensors, path, "images", 5)?;
    let [views, lights, height, width, 3] = dims[..] else {
        return Err(wrong(path, format!("images: expected [views, lights, height, width, 3], found {dims:?}")));
    };
    let pixels = width * height;
    let sized = |name: &str, rank: usize, expected: Vec<usize>| -> Result<Vec<f32>> {
        let (values, dims) = take(&tensors, path, name, rank)?;
        if dims != expected {
            Err(wrong(path, format!("{name}: expected {expected:?}, found {dims:?}")))
        } else {
            Ok(values)
        }
    };
    let coverage = sized("coverage", 3, vec![views, height, width])?;
    let depth = sized("depth", 3, vec![views, height, width])?;
    let normals = sized("normal", 4, vec![views, height, width, 3])?;
    let intrinsics = sized("intrinsics", 2, vec![views, 4])?;
    let poses = sized("world_to_camera", 3, vec![views, 3, 4])?;
    let positions = sized("light_positions", 3, vec![views, lights, 3])?;
    let intensities = sized("light_intensities", 3, vec![views, lights, 3])?;
    let picture = |channels: usize, values: &[f32]| {
        Image::from_vec(width, height, channels, values.to_vec()).map_err(|e| wrong(path, e.to_string()))
    };
    let mut stored = Vec::new();
    for v in 0..views {
        let k = &intrinsics[v * 4..][..4];
        let intrinsics =
            Intrinsics { fx: k[0], fy: k[1], cx: k[2], cy: k[3], width: width as u32, height: height as u32 };
        let p = &poses[v * 12..][..12];
        let row = |i: usize| Vec3::new(p[4 * i], p[4 * i + 1], p[4 * i + 2]);
        let rotation = Mat3::from_cols(row(0), row(1), row(2)).transpose();
        let pose = Pose::new(rotation, Vec3::new(p[3], p[7], p[11])).map_err(|e| wrong(path, e.to_string()))?;
        let camera = Camera { intrinsics, pose };
        camera.validate().map_err(|e| wrong(path, e.to_string()))?;
        let view = RelightView {
            camera,
            source: Image::new(width, height, 3),
            coverage: picture(1, &coverage[v * pixels..][..pixels])?,
            depth: picture(1, &depth[v * pixels..][..pixels])?,
            normals: picture(3, &normals[v * pixels * 3..][..pixels * 3])?,
            source_light: None,
        };
        let mut pictures = Vec::new();
        for l in 0..lights {
            let at = v * lights + l;
            let position = Vec3::from_slice(&positions[at * 3..][..3]);
            let intensity = Vec3::from_slice(&intensities[at * 3..][..3]);
            if !(intensity.min_element() > 0.0) {
                continue;
            }
            let mut image = picture(3, &images[at * pixels * 3..][..pixels * 3])?;
            for (i, value) in image.data_mut().iter_mut().enumerate() {
                *value = value.max(0.0) / intensity[i % 3];
            }
            let image = image.resize_area(size, size).map_err(|e| wrong(path, e.to_string()))?;
            pictures.push((image, position));
        }
        stored.push(Stored { view: view.resized(size, size)?, pictures });
    }
    Ok(stored)
}
