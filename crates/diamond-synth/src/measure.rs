//! How far a recipe's pictures are from the unbiased reference: what is written beside every capture.
//!
//! The comparison is made with the capture's own cameras, pixels, lamps and quality, so that it says something about its images: a highlight
//! that is sharp in a small picture would be lost in the pixels of a smaller one.
use crate::{Object, Plan, Recipe, SynthError};
use diamond_camera::Camera;
use diamond_dataset::Split;
use diamond_light::Falloff;
use diamond_pathtrace::{BulkError, BulkOptions, Light, ReferenceOptions, Scene, measure_bulk};
use std::sync::atomic::{AtomicU32, Ordering};

/// The seed of the measurement is the recipe's with these bits turned.
const MEASURED: u64 = 0x0065_7272_6f72;

/// Lights and views of the comparison at most.
const MEASURED_LIGHTS: usize = 4;
const MEASURED_VIEWS: usize = 2;

/// How a recipe's pictures are solved for.
pub(crate) fn bulk_options(recipe: &Recipe, seed: u64) -> BulkOptions {
    let (quality, default) = (&recipe.quality, BulkOptions::default());
    BulkOptions {
        points: quality.points.unwrap_or(default.points),
        walks: quality.walks.unwrap_or(default.walks),
        samples_per_axis: quality.samples_per_axis.unwrap_or(default.samples_per_axis),
        seed,
        ..default
    }
}

/// A recipe's object under some lights of its plan. Irradiance at the origin is 1.
pub(crate) fn lit(recipe: &Recipe, object: &Object, plan: &Plan, lights: &[usize]) -> Scene {
    let falloff = Falloff::InverseSquare { reference: recipe.rig.light_distance };
    let olat = |l: &usize| Light::Olat { light: plan.lights[*l], falloff };
    Scene {
        geometry: object.geometry.clone(),
        material: recipe.material.material(),
        lights: lights.iter().map(olat).collect(),
    }
}

/// What is compared: a few views of a capture under a few of its lights.
#[derive(Debug)]
pub struct Measurement {
    /// The object and the lights.
    pub scene: Scene,
    /// The views, at the capture's resolution.
    pub cameras: Vec<Camera>,
    /// The capture's quality.
    pub bulk: BulkOptions,
    /// Radiance at which photographs are white.
    pub white: f32,
    /// The reference: as many paths as the recipe's `quality.measured_paths`.
    pub reference: ReferenceOptions,
}

impl Measurement {
    /// Of a recipe and what was made of it: training views and lights that are spread over the rig. `white` is the radiance at which
    /// photographs are white, one over the [`exposure`](crate::exposure()).
    pub fn new(recipe: &Recipe, object: &Object, plan: &Plan, white: f32) -> Self {
        let spread = |n: usize, most: usize| (0..most.min(n)).map(move |k| k * n / most.min(n));
        let views: Vec<_> = plan.views.iter().filter(|v| v.split == Split::Train).collect();
        let cameras = spread(views.len(), MEASURED_VIEWS).map(|k| views[k].camera).collect();
        let lights: Vec<usize> = views
            .first()
            .map_or(Vec::new(), |view| spread(view.lights.len(), MEASURED_LIGHTS).map(|k| view.lights[k]).collect());
        Self {
            scene: lit(recipe, object, plan, &lights),
            cameras,
            bulk: bulk_options(recipe, recipe.seed),
            white,
            reference: ReferenceOptions {
                samples: recipe.quality.measured_paths,
                seed: recipe.seed ^ MEASURED,
                ..ReferenceOptions::default()
            },
        }
    }

    /// Renders both and compares them; `progress` is told the fraction that is done, from any thread.
    ///
    /// # Errors
    /// What the renderer refuses.
    pub fn run(&self, progress: &(dyn Fn(f32) + Sync)) -> Result<BulkError, SynthError> {
        // Fractions of several parts may arrive out of order.
        let most = AtomicU32::new(0);
        let told = |f: f32| {
            if most.fetch_max(f.to_bits(), Ordering::Relaxed) < f.to_bits() {
                progress(f);
            }
        };
        Ok(measure_bulk(&self.scene, &self.bulk, &self.cameras, &self.reference, self.white, &told)?)
    }

    /// What was compared, in words.
    pub fn describe(&self) -> String {
        let side = self.cameras.first().map_or(0, |c| c.intrinsics.width);
        format!(
            "unbiased reference, {} paths per pixel, {} lights, {} views of {side}²; relative to the mean radiance of covered pixels; \
             rmse with values above white as white",
            self.reference.samples,
            self.scene.lights.len(),
            self.cameras.len(),
        )
    }
}
