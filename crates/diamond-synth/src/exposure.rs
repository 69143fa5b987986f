//! How bright photographs are: one factor for all images of a capture, as with a camera whose exposure is locked.
use crate::measure::{bulk_options, lit};
use crate::plan::LIGHTS_PER_SOLUTION;
use crate::{Object, Plan, PlannedView, Recipe, SynthError};
use diamond_camera::Camera;
use diamond_dataset::Split;
use diamond_pathtrace::{Bulk, BulkOptions};

/// The seed is the recipe's with these bits turned.
const EXPOSED: u64 = 0x6578_706f;
/// Points and walks of the solution that finds the exposure.
const EXPOSURE_EFFORT: (u32, u32) = (1000, 64);
/// Views and largest side of its pictures.
const EXPOSURE_VIEWS: usize = 4;
const EXPOSURE_SIDE: u32 = 48;
/// So many of the covered values are above [`BRIGHT`] after exposure.
const BRIGHT_SHARE: f64 = 0.01;
const BRIGHT: f32 = 0.9;

/// What radiance is multiplied by: the recipe's, or one at which the brightest hundredth of covered values in a few small pictures is near white.
///
/// # Errors
/// What the renderer refuses.
pub fn exposure(
    recipe: &Recipe,
    object: &Object,
    plan: &Plan,
    progress: &(dyn Fn(f32) + Sync),
) -> Result<f32, SynthError> {
    if let Some(exposure) = recipe.film.exposure {
        return Ok(exposure);
    }
    let all: Vec<&PlannedView> = plan.views.iter().filter(|v| v.split == Split::Train).collect();
    let chosen = (0..EXPOSURE_VIEWS.min(all.len())).map(|k| all[k * all.len() / EXPOSURE_VIEWS.min(all.len())]);
    let mut values = Vec::new();
    for view in chosen {
        let mut lights = view.lights.clone();
        lights.sort_unstable();
        lights.truncate(LIGHTS_PER_SOLUTION);
        let (points, walks) = EXPOSURE_EFFORT;
        let options = BulkOptions { points, walks, samples_per_axis: 1, ..bulk_options(recipe, recipe.seed ^ EXPOSED) };
        let scene = lit(recipe, object, plan, &lights);
        let bulk = Bulk::solve(&scene, &options, progress)?;
        let picture = bulk.render(&resized(&view.camera, EXPOSURE_SIDE), recipe.seed)?;
        for image in &picture.lights {
            let covered = |(_, c): &(&[f32], &f32)| **c > 0.5;
            let pixels = image.data().chunks_exact(3).zip(picture.coverage.data()).filter(covered);
            values.extend(pixels.flat_map(|(v, _)| v.iter().copied()));
        }
    }
    values.sort_by(f32::total_cmp);
    let at = ((1.0 - BRIGHT_SHARE) * values.len() as f64) as usize;
    let bright = values.get(at).copied().unwrap_or(BRIGHT);
    // An object that is black stays black.
    Ok(if bright > f32::MIN_POSITIVE { BRIGHT / bright } else { 1.0 })
}

/// The same view with `side` pixels along each side, at most as many as it has.
fn resized(camera: &Camera, side: u32) -> Camera {
    let k = &camera.intrinsics;
    let scale = side.min(k.width) as f32 / k.width as f32;
    let mut intrinsics = *k;
    (intrinsics.fx, intrinsics.fy) = (k.fx * scale, k.fy * scale);
    (intrinsics.cx, intrinsics.cy) = (k.cx * scale, k.cy * scale);
    (intrinsics.width, intrinsics.height) = (side.min(k.width), side.min(k.height));
    Camera { intrinsics, pose: camera.pose }
}
