//! What a capture lacks: the lights of its rig that a view was not photographed under, and views between the views.
use crate::Target;
use crate::spread::{farthest, sphere};
use diamond_camera::{Camera, Pose};
use diamond_dataset::{Capture, Shot, View, light_direction};
use diamond_light::OlatLight;
use glam::Vec3;
use serde::Serialize;
use std::fmt;

/// How much of what is lacking is wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Wanted {
    /// Lights for each view, at most.
    pub lights: usize,
    /// Views from where nobody photographed for each training view, at most; each gets as many lights.
    pub views: usize,
    /// Whether directions spread over the sphere take the place of the rig where each view has every light of it.
    pub beyond_rig: bool,
}

/// What one training view lacks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ViewLack {
    /// Its name.
    pub name: String,
    /// Lights that it was photographed under.
    pub photographed: usize,
    /// Lights of the rig that it was not photographed under.
    pub missing: usize,
    /// Lights that were chosen to be made.
    pub chosen: usize,
}

/// What a capture lacks, and what of it is to be made.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Lack {
    /// Lights of the rig: those of the capture as opened, whatever is selected.
    pub rig: usize,
    /// Whether lights are directions spread over the sphere, since each view was photographed under every light of the rig.
    pub invented: bool,
    /// The training views, in order.
    pub views: Vec<ViewLack>,
    /// Views from where nobody photographed that are to be made.
    pub new_views: usize,
    /// What is to be made: training views in order, then the new ones; lights of a view one after the other.
    #[serde(skip)]
    pub targets: Vec<Target>,
}

/// Half a degree in radians, squared: lights that are nearer to each other, seen from the scene's centre, are one light. (The same limit as for lights that
/// count as seen.)
const SAME_LIGHT: f32 = 7.6e-5;
/// Directions on the sphere among which lights are chosen where the rig has none left.
const DIRECTIONS: usize = 96;
/// Cosine below which two views are so nearly opposite that nothing lies between them.
const OPPOSITE: f32 = -0.95;
/// A view between two views lies at one of these fractions of the way.
const BETWEEN: [f32; 3] = [0.25, 0.5, 0.75];

impl Lack {
    /// What the selected training part of `capture` lacks of its rig, with targets for what is `wanted` of it.
    ///
    /// Lights of a view are chosen to be far, seen from the scene's centre, from those that it has and from each other, and so that all views together
    /// use the rig evenly. Where each view has every light of the rig, nothing lacks, or, [`Wanted::beyond_rig`], directions of the sphere take its place, at the mean distance of
    /// the lights and with their mean intensity. New views lie between two training views, on the sphere of their distances, far from all others.
    pub fn of(capture: &Capture, wanted: &Wanted) -> Self {
        let centre = capture.scene().centre;
        let rig = capture.rig();
        let directions: Vec<Vec3> = rig.iter().map(|l| light_direction(l, centre)).collect();
        let own: Vec<Vec<Vec3>> = capture
            .train
            .iter()
            .map(|view| view.shots.iter().map(|s| light_direction(&s.light, centre)).collect())
            .collect();
        let new = |own: &[Vec3], d: Vec3| own.iter().all(|o| o.distance_squared(d) > SAME_LIGHT);
        let missing: Vec<usize> = own.iter().map(|own| directions.iter().filter(|d| new(own, **d)).count()).collect();
        let invented = wanted.beyond_rig && missing.iter().all(|n| *n == 0);
        let (lights, directions) = match invented {
            true => around(capture, centre),
            false => (rig.to_vec(), directions),
        };
        let mut used = vec![0u32; lights.len()];
        let (mut views, mut targets) = (Vec::new(), Vec::new());
        for (v, view) in capture.train.iter().enumerate() {
            let open: Vec<usize> = (0..lights.len()).filter(|i| new(&own[v], directions[*i])).collect();
            let candidates: Vec<Vec3> = open.iter().map(|i| directions[*i]).collect();
            let mut times: Vec<u32> = open.iter().map(|i| used[*i]).collect();
            let chosen = farthest(&candidates, &own[v], wanted.lights, &mut times);
            for &k in &chosen {
                used[open[k]] += 1;
                let photograph = (v, nearest_shot(view, candidates[k], centre));
                targets.push(Target { camera: view.camera, light: lights[open[k]], view: Some(v), photograph });
            }
            let (photographed, chosen) = (view.shots.len(), chosen.len());
            views.push(ViewLack { name: view.name.clone(), photographed, missing: missing[v], chosen });
        }
        let cameras = between(&capture.train, centre, wanted.views * capture.train.len());
        for camera in &cameras {
            let toward = (camera.pose.centre() - centre).normalize_or_zero();
            let v = nearest_view(&capture.train, toward, centre);
            for k in farthest(&directions, &[], wanted.lights, &mut used) {
                let photograph = (v, nearest_shot(&capture.train[v], directions[k], centre));
                targets.push(Target { camera: *camera, light: lights[k], view: None, photograph });
            }
        }
        Self { rig: rig.len(), invented, views, new_views: cameras.len(), targets }
    }

    /// Pairs of a training view and a light of the rig that were not photographed.
    pub fn missing(&self) -> usize {
        self.views.iter().map(|v| v.missing).sum()
    }
}

impl fmt::Display for Lack {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let photographed: usize = self.views.iter().map(|v| v.photographed).sum();
        let (views, missing, rig) = (self.views.len(), self.missing(), self.rig);
        write!(f, "{views} views × {rig} lights of the rig: {photographed} pairs photographed, {missing} missing; ")?;
        let chosen: usize = self.views.iter().map(|v| v.chosen).sum();
        let whence = match self.invented {
            true => "under directions of the sphere, since each view has every light of the rig",
            false => "under lights of the rig that a view lacks",
        };
        write!(f, "{} pictures wanted, {chosen} of them {whence}", self.targets.len())?;
        if self.new_views > 0 {
            write!(f, ", the others from {} new views between the views", self.new_views)?;
        }
        Ok(())
    }
}

/// Lights from all around, as far and as bright as those of the training images, and their directions.
fn around(capture: &Capture, centre: Vec3) -> (Vec<OlatLight>, Vec<Vec3>) {
    let shots = || capture.train.iter().flat_map(|v| &v.shots);
    let n = shots().count().max(1) as f32;
    let mean = |f: &dyn Fn(&OlatLight) -> Vec3| shots().map(|s| f(&s.light)).sum::<Vec3>() / n;
    let intensity = mean(&|light| match *light {
        OlatLight::Point { intensity, .. } => intensity,
        OlatLight::Directional { irradiance, .. } => irradiance,
    });
    let distances: Vec<f32> = shots().filter_map(|s| s.light.position()).map(|p| p.distance(centre)).collect();
    let directions = sphere(DIRECTIONS);
    let lights = directions.iter().map(|d| match distances.is_empty() {
        true => OlatLight::Directional { direction: *d, irradiance: intensity },
        false => {
            let distance = distances.iter().sum::<f32>() / distances.len() as f32;
            OlatLight::Point { position: centre + *d * distance, intensity }
        }
    });
    (lights.collect(), directions)
}

fn first_largest(values: impl Iterator<Item = f32>) -> usize {
    let mut best = (0, f32::NEG_INFINITY);
    for (i, v) in values.enumerate() {
        if v > best.1 {
            best = (i, v);
        }
    }
    best.0
}

fn nearest_shot(view: &View, direction: Vec3, centre: Vec3) -> usize {
    first_largest(view.shots.iter().map(|s: &Shot| light_direction(&s.light, centre).dot(direction)))
}

fn nearest_view(views: &[View], toward: Vec3, centre: Vec3) -> usize {
    first_largest(views.iter().map(|v| (v.camera.pose.centre() - centre).normalize_or_zero().dot(toward)))
}

/// At most `count` cameras between those of `views`, looking at `centre`, each far from all others.
fn between(views: &[View], centre: Vec3, count: usize) -> Vec<Camera> {
    let toward: Vec<Vec3> = views.iter().map(|v| (v.camera.pose.centre() - centre).normalize_or_zero()).collect();
    let mut candidates: Vec<(Vec3, Camera)> = Vec::new();
    if count == 0 {
        return Vec::new();
    }
    for i in 0..views.len() {
        for j in i + 1..views.len() {
            let cosine = toward[i].dot(toward[j]);
            if !(OPPOSITE..0.9999).contains(&cosine) {
                continue;
            }
            for t in BETWEEN {
                let (a, b) = (&views[i].camera, &views[j].camera);
                let reach = |c: &Camera| c.pose.centre().distance(centre);
                let angle = libm::acosf(cosine);
                let (wa, wb) = (libm::sinf((1.0 - t) * angle), libm::sinf(t * angle));
                let direction = (toward[i] * wa + toward[j] * wb).normalize_or(toward[i]);
                let eye = centre + direction * (reach(a) * (1.0 - t) + reach(b) * t);
                // The camera's y points down.
                let up = -(a.pose.rotation.row(1) * (1.0 - t) + b.pose.rotation.row(1) * t);
                let intrinsics = if t <= 0.5 { a.intrinsics } else { b.intrinsics };
                candidates.push((direction, Camera { intrinsics, pose: Pose::look_at(eye, centre, up) }));
            }
        }
    }
    let directions: Vec<Vec3> = candidates.iter().map(|c| c.0).collect();
    let mut used = vec![0; candidates.len()];
    farthest(&directions, &toward, count, &mut used).into_iter().map(|k| candidates[k].1).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_dataset::{OpenOptions, Regime};

    fn capture(name: &str, regime: &str) -> Capture {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/captures/");
        let all = Capture::open(format!("{folder}{name}").as_ref(), &OpenOptions::default()).unwrap();
        regime.parse::<Regime>().unwrap().apply(&all, 0).unwrap()
    }

    #[test]
    fn what_was_photographed_is_not_made_again() {
        for (regime, missing) in [("3x3", 9), ("full-one", 40)] {
            let capture = capture("candle-small", regime);
            let lack = Lack::of(&capture, &Wanted { lights: 2, ..Default::default() });
            assert_eq!((lack.rig, lack.missing(), lack.invented), (6, missing, false), "{lack}");
            assert_eq!(lack.targets.len(), 2 * capture.train.len());
            for target in &lack.targets {
                let view = &capture.train[target.view.unwrap()];
                assert!(view.camera == target.camera && view.shots.iter().all(|s| s.light != target.light));
                assert!(capture.rig().contains(&target.light) && target.photograph.0 == target.view.unwrap());
            }
            // Evenly used.
            let times = capture.rig().iter().map(|l| lack.targets.iter().filter(|t| t.light == *l).count());
            let most = times.max().unwrap();
            assert!(most <= capture.train.len().div_ceil(2), "{most} of {}", capture.train.len());
            assert!(lack.to_string().contains("missing"), "{lack}");
        }
    }

    #[test]
    fn more_than_there_is_is_all_there_is() {
        let capture = capture("candle-small", "3x3");
        let lack = Lack::of(&capture, &Wanted { lights: 99, ..Default::default() });
        assert_eq!(lack.targets.len(), lack.missing());
        assert!(Lack::of(&capture, &Wanted::default()).targets.is_empty());
    }

    #[test]
    fn a_complete_capture_gets_directions_of_the_sphere() {
        let capture = capture("candle-small", "full-full");
        let lack = Lack::of(&capture, &Wanted { lights: 3, beyond_rig: true, ..Default::default() });
        assert!(lack.invented && lack.missing() == 0 && lack.targets.len() == 3 * capture.train.len());
        let centre = capture.scene().centre;
        for target in &lack.targets {
            let direction = light_direction(&target.light, centre);
            let own = capture.rig().iter().map(|l| light_direction(l, centre).distance(direction));
            assert!(own.fold(f32::INFINITY, f32::min) > 0.1);
        }
        assert!(lack.to_string().contains("sphere"), "{lack}");
        assert!(Lack::of(&capture, &Wanted { lights: 3, ..Default::default() }).targets.is_empty());
    }

    #[test]
    fn new_views_look_at_the_object_from_between() {
        let capture = capture("candle-small", "3x2");
        let lack = Lack::of(&capture, &Wanted { lights: 2, views: 1, ..Default::default() });
        assert!(lack.new_views > 0 && lack.targets.len() == 2 * (3 + lack.new_views));
        let centre = capture.scene().centre;
        for target in lack.targets.iter().filter(|t| t.view.is_none()) {
            target.camera.validate().unwrap();
            let (pixel, z) = target.camera.project(centre).unwrap();
            let middle = 0.5 * target.camera.intrinsics.width as f32;
            assert!(z > 1.0 && (pixel.x - middle).abs() < 0.1 * middle && (pixel.y - middle).abs() < 0.1 * middle);
            // Up is up: the world's z points upward in the picture.
            let above = target.camera.project(centre + 0.2 * Vec3::Z).unwrap().0;
            assert!(above.y < pixel.y, "{above} {pixel}");
            let nearest = capture.train.iter().map(|v| v.camera.pose.centre().distance(target.camera.pose.centre()));
            assert!(nearest.fold(f32::INFINITY, f32::min) > 0.2);
        }
    }

    #[test]
    fn a_turntable_has_lights_of_its_own_for_each_view() {
        let capture = capture("turntable-small", "full-one");
        let lack = Lack::of(&capture, &Wanted { lights: 4, ..Default::default() });
        assert_eq!((lack.rig, lack.invented), (18, false));
        assert!(lack.views.iter().all(|v| v.photographed == 1 && v.missing >= 15 && v.chosen == 4), "{lack:?}");
    }
}
