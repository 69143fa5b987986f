//! What is known of a capture before anything is computed: numbers of views and lights, sizes, masks, how much of the
//! pictures is filled.
use crate::ReconstructError;
use crate::region::Region;
use diamond_augment::{Lack, Wanted};
use diamond_dataset::{Capture, Shot, Split};
use diamond_light::OlatLight;
use serde::Serialize;
use std::collections::BTreeSet;

/// Images that are decoded to learn whether there are masks and how much of a picture is filled.
const LOOK_AT: usize = 8;

/// Facts of a capture's selected training part.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct CaptureFacts {
    /// Training views.
    pub views: usize,
    /// Training images.
    pub images: usize,
    /// Training images of the view that has most.
    pub most_view_images: usize,
    /// Different lights of the training images.
    pub lights: usize,
    /// Whether every view has the same lights.
    pub shared_rig: bool,
    /// Different lights of the training images as the capture was opened, selected or not: the rig.
    pub rig_lights: usize,
    /// Pairs of a training view and a light of the rig that are not among the training images.
    pub missing_pairs: usize,
    /// Lights at infinity among the lights.
    pub directional_lights: usize,
    /// Held-out views.
    pub test_views: usize,
    /// Held-out images.
    pub test_images: usize,
    /// Most images of a held-out view.
    pub most_test_lights: usize,
    /// Least and greatest width, pixels.
    pub width: (u32, u32),
    /// Least and greatest height, pixels.
    pub height: (u32, u32),
    /// Whether the capture has a point cloud.
    pub points: bool,
    /// Images whose weight in the photometric terms is not 1.
    pub weighted_images: usize,
    /// Images of the capture as opened, selected or not, held out or not.
    pub files: usize,
    /// How samples are kept in memory, among the images that were looked at: `8-bit RGBA` and the like.
    pub stored_as: String,
    /// Most bytes that the samples of one of them take.
    pub stored_bytes: u64,
    /// Images that were decoded for the facts above and below.
    pub looked_at: usize,
    /// Images with a mask among them.
    pub masks: usize,
    /// Mean share of the picture that the rectangle of everything that is not black or masked in takes, among them.
    pub content: Option<f64>,
}

impl CaptureFacts {
    /// The facts of the training part of `capture`. Decodes at most eight images.
    pub fn of(capture: &Capture) -> Result<Self, ReconstructError> {
        let shots: Vec<&Shot> = capture.train.iter().flat_map(|v| &v.shots).collect();
        let mut lights: Vec<OlatLight> = Vec::new();
        for shot in &shots {
            if !lights.contains(&shot.light) {
                lights.push(shot.light);
            }
        }
        let range = |f: fn(&Shot) -> u32| {
            let values = || shots.iter().map(|s| f(s));
            (values().min().unwrap_or(0), values().max().unwrap_or(0))
        };
        let looked_at = shots.len().min(LOOK_AT);
        let (mut masks, mut content) = (0, 0.0);
        let (mut stored_as, mut stored_bytes) = (BTreeSet::new(), 0);
        for i in 0..looked_at {
            let shot = shots[i * shots.len() / looked_at];
            let stored = capture.stored_form(shot)?;
            let channels = ["", "grey", "grey and alpha", "RGB", "RGBA"][stored.channels.min(4)];
            stored_as.insert(format!("{} {channels}", stored.sample));
            stored_bytes = stored.bytes.max(stored_bytes);
            let observation = capture.observation(shot)?;
            masks += usize::from(observation.mask.is_some());
            let (width, height, _) = observation.radiance.shape();
            let region = Region::of_photograph(&observation.radiance, observation.mask.as_ref());
            content += region.map_or(0.0, |r| r.fraction(width, height));
        }
        Ok(Self {
            views: capture.train.len(),
            images: shots.len(),
            most_view_images: capture.train.iter().map(|v| v.shots.len()).max().unwrap_or(0),
            shared_rig: capture.shared_rig(Split::Train).is_some(),
            directional_lights: lights.iter().filter(|l| matches!(l, OlatLight::Directional { .. })).count(),
            rig_lights: capture.rig().len(),
            missing_pairs: Lack::of(capture, &Wanted::default()).missing(),
            lights: lights.len(),
            test_views: capture.test.len(),
            test_images: capture.test.iter().map(|v| v.shots.len()).sum(),
            most_test_lights: capture.test.iter().map(|v| v.shots.len()).max().unwrap_or(0),
            width: range(|s| s.width),
            height: range(|s| s.height),
            points: capture.points.is_some(),
            weighted_images: shots.iter().filter(|s| s.weight != 1.0).count(),
            files: capture.image_files(),
            stored_as: stored_as.into_iter().collect::<Vec<_>>().join(", "),
            stored_bytes,
            looked_at,
            masks,
            content: (looked_at > 0).then(|| content / looked_at as f64),
        })
    }

    /// Pixels of the largest image.
    pub fn pixels(&self) -> u64 {
        u64::from(self.width.1) * u64::from(self.height.1)
    }
}
