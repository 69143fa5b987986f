//! From a recipe to a capture: transport is solved once per group of views, images are written as they come, and what
//! the error is, is measured and written beside them.
//!
//! Whoever is interrupted goes on: images that are there are not rendered again, and the bytes are the same in the end.
//! Held-out images come from a solution with random numbers of its own, so that what training images have in common with
//! each other they do not have in common with them.
use crate::exposure::exposure;
use crate::measure::{Measurement, bulk_options, lit};
use crate::object::points_ply;
use crate::plan::LIGHTS_PER_SOLUTION;
use crate::{Object, Plan, PlannedView, Recipe, SynthError};
use diamond_dataset::{
    BitDepth, CaptureDescription, CaptureInProgress, DatasetError, Geometry, Provenance, ShotDescription, Split,
    ViewDescription, encode_exr,
};
use diamond_image::{Mask, Transfer};
use diamond_light::OlatLight;
use diamond_pathtrace::{Bulk, BulkError, BulkView, RepairReport};
use rayon::prelude::*;
use serde_json::{Value, json};
use std::path::Path;

/// The seed of held-out images is the recipe's with these bits turned.
const HELD_OUT: u64 = 0x7465_7374;

/// What is being done, for progress bars.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Stage {
    /// Finding the exposure.
    Exposure,
    /// Solving transport: group of views, and how many there are.
    Solve(usize, usize),
    /// Rendering and writing images: done, and how many there are.
    Images(usize, usize),
    /// Comparing with the reference.
    Measure,
}

/// What was made.
#[derive(Debug, Clone)]
pub struct CaptureRecord {
    /// SHA-256 of the recipe.
    pub recipe_hash: String,
    /// Radiance was multiplied by this.
    pub exposure: f32,
    /// Which form of solution was chosen, and why.
    pub form: &'static str,
    /// Repairs of the mesh.
    pub repairs: RepairReport,
    /// Errors against the reference, if they were measured.
    pub error: Option<BulkError>,
    /// Images in the capture.
    pub images: usize,
    /// Of those, rendered by this call; the others were there.
    pub rendered: usize,
}

/// Progress: a stage and the fraction of it that is done.
pub type Progress<'a> = dyn Fn(Stage, f32) + Sync + 'a;

struct Job<'a> {
    recipe: &'a Recipe,
    plan: Plan,
    object: Object,
}

/// Makes the capture `dir`, which must not exist; `folder` is where the recipe's paths are relative to.
///
/// # Errors
/// Recipes, meshes and folders that cannot be used. What is done so far stays beside `dir` for the next call.
pub fn synthesize(
    recipe: &Recipe,
    folder: &Path,
    dir: &Path,
    progress: &Progress<'_>,
) -> Result<CaptureRecord, SynthError> {
    let plan = Plan::new(recipe)?;
    let object = Object::new(recipe, folder)?;
    let job = Job { recipe, plan, object };
    let hash = recipe.hash();
    // Two meshes under one name are two captures.
    let identity = format!("{hash} {:?}", job.object.mesh.bounds());
    let capture = CaptureInProgress::open(dir, job.description(), &identity)?;
    let exposure = exposure(recipe, &job.object, &job.plan, &|f| progress(Stage::Exposure, f))?;
    let (mut done, mut rendered, mut form) = (0, 0, "");
    let groups = job.plan.groups(LIGHTS_PER_SOLUTION);
    for (g, (views, lights)) in groups.iter().enumerate() {
        let missing: Vec<usize> = views.iter().copied().filter(|&v| !job.is_written(&capture, v)).collect();
        done += job.images(views.iter().filter(|v| !missing.contains(v)));
        let Some(&first) = missing.first() else { continue };
        let scene = lit(recipe, &job.object, &job.plan, lights);
        let split = job.plan.views[first].split;
        let seed = split_seed(recipe, split);
        let options = bulk_options(recipe, seed.wrapping_add((g as u64) << 32));
        let stage = Stage::Solve(g + 1, groups.len());
        let bulk = Bulk::solve(&scene, &options, &|f| progress(stage, f))?;
        form = bulk.form();
        for v in missing {
            let view = &job.plan.views[v];
            let picture = bulk.render(&view.camera, seed ^ v as u64)?;
            job.write(&capture, view, lights, &picture, exposure)?;
            let images = view.lights.len();
            (done, rendered) = (done + images, rendered + images);
            progress(Stage::Images(done, job.plan.images()), done as f32 / job.plan.images() as f32);
        }
    }
    let points = job.object.surface_points(recipe.film.points as usize, recipe.seed);
    capture.write_file("points3d.ply", &points_ply(&points))?;
    let error = match recipe.quality.measure {
        true => Some(job.measurement(exposure).run(&|f| progress(Stage::Measure, f))?),
        false => None,
    };
    let record = CaptureRecord {
        recipe_hash: hash,
        exposure,
        form,
        repairs: job.object.repairs,
        error,
        images: job.plan.images(),
        rendered,
    };
    capture.write_file("capture.json", format!("{:#}\n", job.json(&record)).as_bytes())?;
    capture.finish()?;
    Ok(record)
}

impl Job<'_> {
    fn description(&self) -> CaptureDescription {
        let views = |split: Split| {
            let shot = |view: &PlannedView, light: usize| ShotDescription {
                name: view.image_name(light),
                light: self.plan.lights[light],
                provenance: Provenance::Photograph,
                weight: 1.0,
            };
            let view = |view: &PlannedView| ViewDescription {
                camera: view.camera,
                shots: view.lights.iter().map(|&light| shot(view, light)).collect(),
            };
            self.plan.views.iter().filter(|v| v.split == split).map(view).collect()
        };
        let depth = if self.recipe.film.sixteen_bits { BitDepth::Sixteen } else { BitDepth::Eight };
        let (train, test) = (views(Split::Train), views(Split::Test));
        CaptureDescription { train, test, points: None, transfer: Transfer::Srgb, depth }
    }

    fn images<'v>(&self, views: impl Iterator<Item = &'v usize>) -> usize {
        views.map(|&v| self.plan.views[v].lights.len()).sum()
    }

    fn is_written(&self, capture: &CaptureInProgress, v: usize) -> bool {
        let view = &self.plan.views[v];
        let last = capture.folder().join(geometry_name(view));
        last.exists() && (0..view.lights.len()).all(|s| capture.has(view.split, view.number, s))
    }

    fn write(
        &self,
        capture: &CaptureInProgress,
        view: &PlannedView,
        solved: &[usize],
        picture: &BulkView,
        exposure: f32,
    ) -> Result<(), SynthError> {
        let mask = Mask::from_channel(&picture.coverage, 0)
            .map_err(|e| DatasetError::Write { path: capture.folder().into(), reason: e.to_string() })?;
        let shots: Vec<(usize, usize)> = view.lights.iter().copied().enumerate().collect();
        shots.par_iter().try_for_each(|&(s, light)| -> Result<(), SynthError> {
            let Ok(at) = solved.binary_search(&light) else { return Ok(()) };
            let radiance = &picture.lights[at];
            if self.recipe.film.exr {
                let channel = |c: usize| radiance.data().iter().skip(c).step_by(3).copied().collect();
                let channels = [("R", channel(0)), ("G", channel(1)), ("B", channel(2))];
                let bytes = encode_exr(radiance.width(), radiance.height(), channels)?;
                capture.write_file(&format!("exr/{}_{}.exr", split_name(view), view.image_name(light)), &bytes)?;
            }
            let exposed = radiance.map(|v| v * exposure);
            Ok(capture.write(view.split, view.number, s, &(exposed, Some(mask.clone())))?)
        })?;
        let geometry = Geometry { depth: picture.depth.clone(), normal: picture.normal.clone() };
        Ok(capture.write_file(&geometry_name(view), &geometry.encode()?)?)
    }

    fn measurement(&self, exposure: f32) -> Measurement {
        Measurement::new(self.recipe, &self.object, &self.plan, 1.0 / exposure)
    }

    fn json(&self, record: &CaptureRecord) -> Value {
        let measured = record.error.map(|e| {
            json!({
                "bias": e.bias, "bias_standard_error": e.bias_standard_error, "rmse": e.rmse,
                "rmse_beyond_white": e.rmse_beyond_white,
                "rmse_of_root_mean_square": e.rmse_of_rms, "noise": e.noise, "noise_db": e.noise_db,
                "bias_noise": e.bias_noise, "systematic": e.systematic(), "against": self.measurement(record.exposure).describe(),
            })
        });
        let lights: Vec<Value> =
            self.plan.lights.iter().filter_map(OlatLight::position).map(|p| json!(p.to_array())).collect();
        json!({
            "renderer": concat!("diamond-pathtrace ", env!("CARGO_PKG_VERSION"), ", bulk"),
            "recipe": serde_json::to_value(self.recipe).unwrap_or_default(),
            "recipe_hash": record.recipe_hash,
            "exposure": record.exposure,
            "falloff": "inverse square, irradiance 1 at the origin before exposure",
            "light_positions": lights,
            "solution": record.form,
            "repairs": record.repairs.to_string(),
            "triangles": self.object.mesh.triangles.len(),
            "error": measured,
        })
    }
}

/// The seed of a split's images.
fn split_seed(recipe: &Recipe, split: Split) -> u64 {
    recipe.seed ^ if split == Split::Test { HELD_OUT } else { 0 }
}

fn split_name(view: &PlannedView) -> &'static str {
    if view.split == Split::Train { "train" } else { "test" }
}

fn geometry_name(view: &PlannedView) -> String {
    format!("geometry/{}_r_{}.exr", split_name(view), view.number)
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_image::Image;

    /// Over many recipe seeds, what a training solution and a held-out one are off by in the same picture has no correlation; of two pictures from
    /// one solution it has, so the measure would notice.
    #[test]
    fn held_out_images_have_noise_of_their_own() {
        let text = r#"
            name = "noise"
            object = { kind = "solids", cells = 16, parts = [{ solid = "sphere", centre = [0, 0, 0], radius = 0.8 }] }
            material = { sigma_t = [6, 8, 12], albedo = [0.98, 0.9, 0.7] }
            rig = { views = 2, lights = 2 }
            held_out = { views = 1, seen_lights = 1, unseen_lights = 1 }
            film = { resolution = 12 }
            quality = { points = 120, walks = 16, samples_per_axis = 2 }
        "#;
        let base = Recipe::parse(text, "noise").unwrap();
        let (object, plan) = (Object::new(&base, Path::new("")).unwrap(), Plan::new(&base).unwrap());
        let scene = lit(&base, &object, &plan, &[0, 1]);
        let camera = plan.views[0].camera;
        let all = |view: BulkView| -> Vec<f32> { view.lights.iter().flat_map(Image::data).copied().collect() };
        let rounds = 12;
        // Training, held out, and training once more with the same solution.
        let mut pictures: [Vec<Vec<f32>>; 3] = Default::default();
        for seed in 0..rounds {
            let recipe = Recipe { seed, ..base.clone() };
            let [train, test] = [Split::Train, Split::Test].map(|split| split_seed(&recipe, split));
            let solve = |seed| Bulk::solve(&scene, &bulk_options(&recipe, seed), &|_| ()).unwrap();
            let (a, b) = (solve(train), solve(test));
            pictures[0].push(all(a.render(&camera, train).unwrap()));
            pictures[1].push(all(b.render(&camera, test).unwrap()));
            pictures[2].push(all(a.render(&camera, train ^ 5).unwrap()));
        }
        let deviations = pictures.map(|list| {
            let mean = |i: usize| list.iter().map(|p| p[i]).sum::<f32>() / rounds as f32;
            let means: Vec<f32> = (0..list[0].len()).map(mean).collect();
            list.iter().flat_map(|p| p.iter().zip(&means).map(|(v, m)| f64::from(v - m))).collect::<Vec<f64>>()
        });
        let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let correlation = |a: &[f64], b: &[f64]| product(a, b) / (product(a, a) * product(b, b)).sqrt();
        let [train, test, again] = &deviations;
        assert!(correlation(train, again) > 0.8, "{}", correlation(train, again));
        assert!(correlation(train, test).abs() < 0.15, "{}", correlation(train, test));
    }
}
