//! Training examples from shards of captures: views under many lights, at the size of the network.
use super::base::{Base, Prediction, RelightTarget};
use super::hints::{RelightView, hint_planes};
use super::orientation::Orientation;
use super::predictions::{PredictedView, read_predictions};
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

/// A view under one light, and its picture under another.
#[derive(Debug, Clone)]
pub struct RelightExample {
    /// The view, with its source picture.
    pub view: RelightView,
    /// The other light, and what is predicted for it.
    pub target: RelightTarget,
    /// The picture under it: linear, divided by the light's intensity.
    pub picture: Image,
}

/// What an example tells the network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Told {
    /// For training: anything of the following by chance, or not even the source's light; in any of eight orientations, with exchanged colours and another exposure.
    Anything,
    /// Shape, the estimated one where there is one, and both lights.
    Shape,
    /// What a physical model predicts, besides.
    Medium,
}

/// A batch to train on; pictures have (batch, channels, height, width).
#[derive(Debug, Clone)]
pub struct RelightBatch {
    /// Logarithms of ratios of targets to what is predicted of them, 3 channels.
    pub ratios: Tensor,
    /// What the ControlNet is shown.
    pub hints: Tensor,
    /// Codes of the target lights, (batch, 9).
    pub lights: Tensor,
}

impl RelightBatch {
    /// Of examples of one size.
    pub fn new(examples: &[RelightExample]) -> Result<Self> {
        let Some(first) = examples.first() else {
            return Err(DiffusionError::setting("batch", "at least one example", "none"));
        };
        let (width, height, _) = first.view.source.shape();
        let (mut ratios, mut hints, mut lights) = (Vec::new(), Vec::new(), Vec::new());
        for RelightExample { view, target, picture } in examples {
            if view.source.shape() != (width, height, 3) || picture.shape() != (width, height, 3) {
                return Err(DiffusionError::shape("pictures of a batch", (width, height, 3), picture.shape()));
            }
            let base = Base::of(view, target)?;
            hints.extend(hint_planes(view, target.light, &base)?);
            for c in 0..3 {
                let pairs = base.prediction.target.data().iter().zip(picture.data()).skip(c).step_by(3);
                ratios.extend(pairs.map(|(predicted, picture)| encode_ratio(*predicted, *picture)));
            }
            lights.extend(view_light_code(view, target.light)?);
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
    /// As a physical model has it, pictures in the same order.
    predicted: Option<PredictedView>,
}

/// Views of shards, in memory at one size.
#[derive(Debug)]
pub struct RelightExamples {
    views: Vec<Stored>,
}

pub(super) fn wrong(path: &Path, problem: impl Into<String>) -> DiffusionError {
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

    /// Whether every view comes with what a physical model predicts of it.
    pub fn predicted(&self) -> bool {
        self.views.iter().all(|stored| stored.predicted.is_some())
    }

    /// Lights of the view of example `index`, and which of them are its source's and its target's: pairs of different lights.
    fn choice(&self, seed: u64, index: u64) -> (Noise, &Stored, usize, usize) {
        let mut noise = Noise::new(seed, "relighting", index);
        let stored = &self.views[noise.below(self.views.len())];
        let count = stored.pictures.len();
        let source = noise.below(count);
        let target = (source + 1 + noise.below(count - 1)) % count;
        (noise, stored, source, target)
    }

    /// Example `index` of a fixed order that depends on `seed` alone.
    ///
    /// # Errors
    /// [`Told::Medium`] of views of which nothing is predicted.
    pub fn example(&self, seed: u64, index: u64, told: Told) -> Result<RelightExample> {
        let (mut noise, stored, source, target) = self.choice(seed, index);
        let (mut view, light) = (stored.view.clone(), stored.pictures[target].1);
        view.source = stored.pictures[source].0.clone();
        view.source_light = Some(stored.pictures[source].1);
        let draw = noise.uniform();
        let predicted = stored.predicted.as_ref().filter(|_| told != Told::Anything || draw >= TRUE_SHAPE);
        if let Some(predicted) = predicted {
            (view.depth, view.normals) = (predicted.depth.clone(), predicted.normals.clone());
        }
        let prediction = predicted.filter(|_| match told {
            Told::Anything => draw >= TRUE_SHAPE + ESTIMATED_SHAPE,
            Told::Shape => false,
            Told::Medium => true,
        });
        let prediction =
            prediction.map(|p| Prediction { source: p.pictures[source].clone(), target: p.pictures[target].clone() });
        if told == Told::Medium && prediction.is_none() {
            let expected = "files of predictions beside the shards";
            return Err(DiffusionError::setting("what a physical model predicts", expected, "none"));
        }
        let example = RelightExample {
            view,
            target: RelightTarget { light, prediction },
            picture: stored.pictures[target].0.clone(),
        };
        Ok(if told == Told::Anything { varied(example, &mut noise) } else { example })
    }

    /// The other pictures of the view of example `index`, and where their lights are: without its source and its target.
    pub fn others(&self, seed: u64, index: u64) -> Vec<(&Image, Vec3)> {
        let (_, stored, source, target) = self.choice(seed, index);
        let pictures = stored.pictures.iter().enumerate().filter(|(i, _)| *i != source && *i != target);
        pictures.map(|(_, (image, light))| (image, *light)).collect()
    }

    /// Batch `step` of `count` examples for training.
    pub fn batch(&self, seed: u64, step: u64, count: usize) -> Result<RelightBatch> {
        let examples = (0..count as u64).map(|i| self.example(seed, step * count as u64 + i, Told::Anything));
        RelightBatch::new(&examples.collect::<Result<Vec<_>>>()?)
    }
}

/// Share of training examples that have the true shape, where an estimated one is known…
const TRUE_SHAPE: f32 = 0.15;
/// …and of those that have the estimated one, but nothing that a medium predicts.
const ESTIMATED_SHAPE: f32 = 0.35;
/// One in so many examples without a prediction is not told where the source's light is.
const UNKNOWN_LIGHT: usize = 12;
/// Exposures by which training examples are multiplied.
const EXPOSURES: [f32; 2] = [0.6, 1.5];

/// An example as it might as well have been: turned or mirrored, with exchanged colours, which do not know of each other, and another exposure.
fn varied(example: RelightExample, noise: &mut Noise) -> RelightExample {
    let orientation = Orientation::new(noise.below(8));
    let (first, odd) = (noise.below(3), noise.below(2));
    let colours = [first, (first + 1 + odd) % 3, (first + 2 - odd) % 3];
    let exposure = EXPOSURES[0] + (EXPOSURES[1] - EXPOSURES[0]) * noise.uniform();
    let radiance = |image: &Image| {
        let mut out = orientation.image(image);
        for pixel in out.data_mut().chunks_exact_mut(3) {
            let old = [pixel[0], pixel[1], pixel[2]];
            pixel.iter_mut().zip(colours).for_each(|(to, c)| *to = exposure * old[c]);
        }
        out
    };
    let mut view = orientation.view(&example.view);
    view.source = radiance(&example.view.source);
    let prediction = example.target.prediction;
    if prediction.is_none() && noise.below(UNKNOWN_LIGHT) == 0 {
        view.source_light = None;
    }
    RelightExample {
        view,
        target: RelightTarget {
            light: orientation.place(example.target.light),
            prediction: prediction.map(|p| Prediction { source: radiance(&p.source), target: radiance(&p.target) }),
        },
        picture: radiance(&example.picture),
    }
}

/// A picture of some of a tensor's values.
pub(super) fn image_of(path: &Path, (width, height, channels): (usize, usize, usize), values: &[f32]) -> Result<Image> {
    Image::from_vec(width, height, channels, values.to_vec()).map_err(|e| wrong(path, e.to_string()))
}

/// Values and shape of one tensor of a shard.
pub(super) fn take(
    tensors: &BTreeMap<String, Tensor>,
    path: &Path,
    name: &str,
    rank: usize,
) -> Result<(Vec<f32>, Vec<usize>)> {
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
    let picture = |channels: usize, values: &[f32]| image_of(path, (width, height, channels), values);
    let mut predicted = read_predictions(path, &[views, lights, height, width])?.map(Vec::into_iter);
    let mut stored = Vec::new();
    for v in 0..views {
        let mut predicted = predicted.as_mut().and_then(Iterator::next);
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
        let (mut pictures, mut predictions) = (Vec::new(), Vec::new());
        for l in 0..lights {
            let at = v * lights + l;
            let position = Vec3::from_slice(&positions[at * 3..][..3]);
            let intensity = Vec3::from_slice(&intensities[at * 3..][..3]);
            if intensity.min_element() <= 0.0 || intensity.is_nan() {
                continue;
            }
            let normalized = |image: Image| {
                let mut image = image;
                for (i, value) in image.data_mut().iter_mut().enumerate() {
                    *value = value.max(0.0) / intensity[i % 3];
                }
                image.resize_area(size, size).map_err(|e| wrong(path, e.to_string()))
            };
            pictures.push((normalized(picture(3, &images[at * pixels * 3..][..pixels * 3])?)?, position));
            if let Some(predicted) = &mut predicted {
                predictions.push(normalized(predicted.pictures[l].clone())?);
            }
        }
        let predicted = match predicted {
            Some(PredictedView { depth, normals, .. }) => {
                let small = RelightView { depth, normals, ..view.clone() }.resized(size, size)?;
                Some(PredictedView { depth: small.depth, normals: small.normals, pictures: predictions })
            }
            None => None,
        };
        stored.push(Stored { view: view.resized(size, size)?, pictures, predicted });
    }
    Ok(stored)
}
