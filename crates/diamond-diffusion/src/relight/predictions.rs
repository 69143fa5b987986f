//! What a physical model says of the views of a shard: a file beside it, `NAME.prior.safetensors`.
//!
//! A shard holds true shapes; in a reconstruction shapes are estimated. Such a file holds the estimated ones, and pictures that the fitted medium
//! predicts under the lights of the shard, so that training sees what there will be at use.
use super::examples::{image_of, take, wrong};
use crate::error::{DiffusionError, Result};
use crate::weights::{NumberType, read_weights, write_weights};
use candle_core::{Device, Tensor};
use diamond_image::Image;
use std::path::{Path, PathBuf};

/// A view as a physical model shows it.
#[derive(Debug, Clone, PartialEq)]
pub struct PredictedView {
    /// View-space z of the estimated surface, 0 where nothing is.
    pub depth: Image,
    /// Its normals in world axes, 0 where nothing is.
    pub normals: Image,
    /// Linear radiance over black under each of the view's lights, with the lights' intensities.
    pub pictures: Vec<Image>,
}

/// The file beside a shard.
pub fn prediction_path(shard: &Path) -> PathBuf {
    shard.with_extension("prior.safetensors")
}

/// Writes what is predicted of all views of a shard, in its order, as half floats: half of a thousandth of the distance is less than what an
/// estimated surface is wrong by. `of` names the shard's contents; it becomes the metadata entry "note".
///
/// # Errors
/// No view, views of different sizes or numbers of lights; values that half floats cannot hold; the system's.
pub fn write_predictions(shard: &Path, views: &[PredictedView], of: &str) -> Result<()> {
    let path = prediction_path(shard);
    let Some(first) = views.first() else {
        return Err(DiffusionError::setting("predicted views", "at least one", "none"));
    };
    let ((width, height, _), lights) = (first.depth.shape(), first.pictures.len());
    let (mut images, mut depth, mut normals) = (Vec::new(), Vec::new(), Vec::new());
    for view in views {
        let fits = view.depth.shape() == (width, height, 1) && view.normals.shape() == (width, height, 3);
        if !fits || view.pictures.len() != lights || view.pictures.iter().any(|p| p.shape() != (width, height, 3)) {
            return Err(wrong(&path, format!("expected views of {width} × {height} pixels with {lights} lights")));
        }
        depth.extend_from_slice(view.depth.data());
        normals.extend_from_slice(view.normals.data());
        view.pictures.iter().for_each(|picture| images.extend_from_slice(picture.data()));
    }
    let n = views.len();
    let tensor = |values: Vec<f32>, shape: &[usize]| Tensor::from_vec(values, shape, &Device::Cpu);
    let tensors = [
        ("depth", tensor(depth, &[n, height, width])?),
        ("images", tensor(images, &[n, lights, height, width, 3])?),
        ("normal", tensor(normals, &[n, height, width, 3])?),
    ];
    write_weights(&path, tensors.iter().map(|(name, t)| (*name, t)), NumberType::F16, of)
}

/// What is predicted of the views of a shard whose `images` have this shape; none where there is no such file.
pub(super) fn read_predictions(shard: &Path, shape: &[usize; 4]) -> Result<Option<Vec<PredictedView>>> {
    let path = prediction_path(shard);
    if !path.exists() {
        return Ok(None);
    }
    let tensors = read_weights(&path)?;
    let [views, lights, height, width] = *shape;
    let sized = |name: &str, expected: &[usize]| -> Result<Vec<f32>> {
        let (values, found) = take(&tensors, &path, name, expected.len())?;
        match found == expected {
            true => Ok(values),
            false => Err(wrong(&path, format!("{name}: expected {expected:?} as in the shard, found {found:?}"))),
        }
    };
    let images = sized("images", &[views, lights, height, width, 3])?;
    let depth = sized("depth", &[views, height, width])?;
    let normals = sized("normal", &[views, height, width, 3])?;
    let pixels = width * height;
    let picture = |channels: usize, values: &[f32], i: usize| {
        let n = pixels * channels;
        image_of(&path, (width, height, channels), &values[i * n..][..n])
    };
    let view = |v: usize| {
        Ok(PredictedView {
            depth: picture(1, &depth, v)?,
            normals: picture(3, &normals, v)?,
            pictures: (0..lights).map(|l| picture(3, &images, v * lights + l)).collect::<Result<_>>()?,
        })
    };
    (0..views).map(view).collect::<Result<Vec<_>>>().map(Some)
}
