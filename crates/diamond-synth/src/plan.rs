//! Which images a recipe asks for: cameras, lights, and who is seen under which.
use crate::{Recipe, RigKind, SynthError};
use diamond_camera::{Camera, CameraRig, Intrinsics, Pose};
use diamond_dataset::Split;
use diamond_light::{LightRig, OlatLight};
use glam::{Quat, Vec3};

/// Lights that share a solution at most: bounds its memory.
pub(crate) const LIGHTS_PER_SOLUTION: usize = 128;
/// Turns held-out cameras and lights away from those of training, radians: no multiple of the golden angle is near it.
const HELD_OUT_TURN: f32 = 1.0;

/// A view and the lights under which it is seen.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedView {
    /// Training or held out.
    pub split: Split,
    /// Number within its split.
    pub number: usize,
    /// The camera.
    pub camera: Camera,
    /// Its lights, by [`Plan::lights`].
    pub lights: Vec<usize>,
}

impl PlannedView {
    /// Name of an image, without extension.
    pub fn image_name(&self, light: usize) -> String {
        format!("r_{}_l_{light}", self.number)
    }
}

/// All images of a capture.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// All lights. Irradiance 1 at the origin on a plane that faces the light, with inverse-square falloff.
    pub lights: Vec<OlatLight>,
    /// Training views, then held-out ones.
    pub views: Vec<PlannedView>,
}

impl Plan {
    /// Of a recipe.
    ///
    /// # Errors
    /// [`SynthError::Recipe`] where a rig cannot be built.
    pub fn new(recipe: &Recipe) -> Result<Self, SynthError> {
        recipe.check(&recipe.name)?;
        let rig = &recipe.rig;
        let fail =
            |e: &dyn std::fmt::Display| SynthError::Recipe { origin: recipe.name.clone(), detail: e.to_string() };
        let side = recipe.film.resolution;
        let intrinsics = Intrinsics::from_fov_x(rig.angle_of_view.to_radians(), side, side);
        let cameras = |count: u32| -> Result<Vec<Camera>, SynthError> {
            let (n, elevation) = (count as usize, rig.camera_elevation.to_radians());
            let rig = match rig.kind {
                RigKind::Dome => CameraRig::dome(n, intrinsics, Vec3::ZERO, Vec3::Z, rig.camera_distance, elevation),
                RigKind::Turntable => {
                    CameraRig::orbit(n, intrinsics, Vec3::ZERO, Vec3::Z, rig.camera_distance, elevation)
                }
            };
            Ok(rig.map_err(|e| fail(&e))?.cameras)
        };
        let lights = |count: u32| -> Result<Vec<OlatLight>, SynthError> {
            let elevation = rig.light_elevation.to_radians();
            let dome = LightRig::dome(count as usize, Vec3::ZERO, Vec3::Z, rig.light_distance, elevation, Vec3::ONE);
            Ok(dome.map_err(|e| fail(&e))?.lights)
        };
        let train_cameras = cameras(rig.views)?;
        let turn = Quat::from_rotation_z(HELD_OUT_TURN);
        let test_cameras: Vec<Camera> = cameras(recipe.held_out.views)?.iter().map(|c| turned(c, turn)).collect();
        let lamps = lights(rig.lights)?;
        let unseen: Vec<OlatLight> =
            lights(recipe.held_out.unseen_lights)?.iter().map(|l| turned_light(l, turn)).collect();
        let seen = recipe.held_out.seen_lights as usize;
        // Spread over the training lights.
        let spread: Vec<usize> = (0..seen).map(|k| k * lamps.len() / seen.max(1)).collect();
        let mut plan = Plan { lights: Vec::new(), views: Vec::new() };
        if rig.kind == RigKind::Dome {
            plan.lights.extend(&lamps);
            plan.lights.extend(&unseen);
        }
        let splits = [(Split::Train, &train_cameras), (Split::Test, &test_cameras)];
        for (split, cameras) in splits {
            for (number, camera) in cameras.iter().enumerate() {
                let lights: Vec<usize> = match (rig.kind, split) {
                    (RigKind::Dome, Split::Train) => (0..lamps.len()).collect(),
                    (RigKind::Dome, Split::Test) => {
                        spread.iter().copied().chain(lamps.len()..lamps.len() + unseen.len()).collect()
                    }
                    (RigKind::Turntable, _) => {
                        // Seen from the object, the lights turn with the camera.
                        let about = azimuth(camera);
                        let first = plan.lights.len();
                        let used: Vec<OlatLight> = match split {
                            Split::Train => lamps.clone(),
                            Split::Test => spread.iter().map(|&k| lamps[k]).chain(unseen.iter().copied()).collect(),
                        };
                        plan.lights.extend(used.iter().map(|l| turned_light(l, Quat::from_rotation_z(about))));
                        (first..plan.lights.len()).collect()
                    }
                };
                plan.views.push(PlannedView { split, number, camera: *camera, lights });
            }
        }
        Ok(plan)
    }

    /// Number of images.
    pub fn images(&self) -> usize {
        self.views.iter().map(|view| view.lights.len()).sum()
    }

    /// Views that share a solution of transport: of one split, in order, with at most `most` different lights together (or
    /// one view's, if it has more). Each group names its views and its lights, ascending.
    pub fn groups(&self, most: usize) -> Vec<(Vec<usize>, Vec<usize>)> {
        let mut groups: Vec<(Vec<usize>, Vec<usize>)> = Vec::new();
        for (v, view) in self.views.iter().enumerate() {
            let joined =
                groups.last().filter(|(views, _)| self.views[views[0]].split == view.split).map(|(_, lights)| {
                    let mut all = lights.clone();
                    all.extend(&view.lights);
                    all.sort_unstable();
                    all.dedup();
                    all
                });
            match (joined.filter(|all| all.len() <= most), groups.last_mut()) {
                (Some(all), Some(group)) => {
                    group.0.push(v);
                    group.1 = all;
                }
                _ => {
                    let mut lights = view.lights.clone();
                    lights.sort_unstable();
                    groups.push((vec![v], lights));
                }
            }
        }
        groups
    }
}

/// Where a camera stands around the z axis, radians.
fn azimuth(camera: &Camera) -> f32 {
    let eye = camera.pose.centre();
    eye.y.atan2(eye.x)
}

fn turned(camera: &Camera, turn: Quat) -> Camera {
    let eye = turn * camera.pose.centre();
    Camera { intrinsics: camera.intrinsics, pose: Pose::look_at(eye, Vec3::ZERO, Vec3::Z) }
}

fn turned_light(light: &OlatLight, turn: Quat) -> OlatLight {
    match *light {
        OlatLight::Point { position, intensity } => OlatLight::Point { position: turn * position, intensity },
        OlatLight::Directional { direction, irradiance } => {
            OlatLight::Directional { direction: turn * direction, irradiance }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recipe(kind: &str) -> Recipe {
        let text = format!(
            "name = \"x\"\n[object]\nkind = \"random\"\nseed = 1\n[material]\nsigma_t = [1, 1, 1]\nalbedo = [0.5, 0.5, 0.5]\n\
             [rig]\nkind = \"{kind}\"\nviews = 5\nlights = 8\ncamera_elevation = 20\n[held_out]\nviews = 2\nseen_lights = 2\n\
             unseen_lights = 3\n"
        );
        Recipe::parse(&text, "x").unwrap()
    }

    #[test]
    fn a_dome_has_one_set_of_lights_and_holds_some_out() {
        let plan = Plan::new(&recipe("dome")).unwrap();
        assert_eq!((plan.lights.len(), plan.views.len(), plan.images()), (11, 7, 5 * 8 + 2 * 5));
        assert_eq!(plan.views[5].lights, [0, 4, 8, 9, 10]);
        assert_eq!((plan.views[6].number, plan.views[6].image_name(9).as_str()), (1, "r_1_l_9"));
        for (i, a) in plan.lights.iter().enumerate() {
            for b in &plan.lights[..i] {
                assert!((a.position().unwrap() - b.position().unwrap()).length() > 0.05, "two lights in one place");
            }
        }
        assert_eq!(plan.groups(128).len(), 2, "training and held-out images have solutions of their own");
        assert_eq!(plan.groups(4).len(), 7);
    }

    /// Seen from the camera, a turntable's lights stay where they are.
    #[test]
    fn a_turntables_lights_turn_with_the_camera() {
        let plan = Plan::new(&recipe("turntable")).unwrap();
        assert_eq!(plan.lights.len(), plan.images());
        let seen = |v: usize, k: usize| {
            let view = &plan.views[v];
            view.camera.pose.transform_point(plan.lights[view.lights[k]].position().unwrap())
        };
        for v in 1..5 {
            for k in 0..8 {
                assert!((seen(v, k) - seen(0, k)).length() < 1e-4, "view {v}, light {k}");
            }
        }
        let (first, second) = (plan.lights[plan.views[0].lights[0]], plan.lights[plan.views[1].lights[0]]);
        assert!((first.position().unwrap() - second.position().unwrap()).length() > 0.01);
        assert_eq!(plan.groups(16).len(), 3 + 1);
    }
}
