//! Laws of photometric stereo: what must hold whatever the scene.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::{Image, Mask};
use diamond_light::{Falloff, OlatLight};
use diamond_photometric::*;
use diamond_testkit::strategies::unit_vector;
use glam::{Vec2, Vec3};
use proptest::prelude::*;

const SIDE: usize = 48;

struct Scene {
    camera: Camera,
    mask: Mask,
    images: Vec<Image>,
    lights: Vec<OlatLight>,
    normals: Vec<Option<Vec3>>,
}

impl Scene {
    /// An ellipsoid under a ring of lights, all turned into another world by `pose`: (eye, up).
    fn new(half_axes: Vec3, eye: Vec3, up: Vec3, count: usize, glow: f32) -> Self {
        let camera = Camera {
            intrinsics: Intrinsics::from_fov_x(0.9, SIDE as u32, SIDE as u32),
            pose: Pose::look_at(eye, Vec3::ZERO, up),
        };
        let rows = camera.pose.rotation;
        let (right, down, ahead) = (rows.row(0), rows.row(1), rows.row(2));
        let lights: Vec<OlatLight> = (0..count)
            .map(|k| {
                let (s, c) = (k as f32 * 2.4).sin_cos();
                let tilt = 0.3 + 0.6 * (k as f32 * 0.37).fract();
                let direction = (right * (tilt * s) + down * (tilt * c) - ahead * 0.7).normalize();
                OlatLight::Point { position: 4.0 * direction, intensity: Vec3::ONE }
            })
            .collect();
        // Axes of the ellipsoid turn with the camera.
        let local = |v: Vec3| Vec3::new(v.dot(right), v.dot(down), v.dot(ahead)) / half_axes;
        let hit = |i: usize| {
            let ray = camera.ray(Vec2::new((i % SIDE) as f32 + 0.5, (i / SIDE) as f32 + 0.5));
            let (o, d) = (local(ray.origin), local(ray.direction));
            let (a, b, c) = (d.length_squared(), o.dot(d), o.length_squared() - 1.0);
            let under = b * b - a * c;
            (under > 0.0).then(|| {
                let at = ray.origin + ray.direction * ((-b - under.sqrt()) / a);
                let n = local(at) / half_axes;
                (at, (right * n.x + down * n.y + ahead * n.z).normalize())
            })
        };
        let hits: Vec<_> = (0..SIDE * SIDE).map(hit).collect();
        let mask = Mask::from_vec(SIDE, SIDE, hits.iter().map(|h| f32::from(h.is_some())).collect()).unwrap();
        let images = lights
            .iter()
            .map(|light| {
                let shade = |h: &Option<(Vec3, Vec3)>| {
                    h.map_or([0.0; 3], |(at, n)| {
                        let i = light.incidence(at, Falloff::InverseSquare { reference: 4.0 });
                        let t = n.dot(i.direction);
                        [0.2, 0.5, 0.8].map(|g| i.irradiance.x * (t.max(0.0) + glow * g * (1.0 + t)))
                    })
                };
                Image::from_vec(SIDE, SIDE, 3, hits.iter().flat_map(shade).collect()).unwrap()
            })
            .collect();
        Self { camera, mask, images, lights, normals: hits.iter().map(|h| h.map(|h| h.1)).collect() }
    }

    fn found(&self) -> Result<PhotometricStereo, PhotometricError> {
        let images: Vec<&Image> = self.images.iter().collect();
        let view = PhotometricView {
            camera: &self.camera,
            mask: &self.mask,
            images: &images,
            lights: &self.lights,
            falloff: Falloff::InverseSquare { reference: 4.0 },
            distance: self.camera.pose.centre().length(),
        };
        photometric_stereo(&view, &PhotometricOptions::default())
    }

    fn median_error(&self) -> f32 {
        let found = self.found().unwrap();
        let mut errors: Vec<f32> = self
            .normals
            .iter()
            .enumerate()
            .filter_map(|(i, n)| {
                n.map(|n| n.angle_between(Vec3::from_slice(&found.normals.data()[3 * i..])).to_degrees())
            })
            .collect();
        errors.sort_by(f32::total_cmp);
        errors[errors.len() / 2]
    }
}

fn standard(count: usize, glow: f32) -> Scene {
    Scene::new(Vec3::new(0.9, 0.6, 0.5), Vec3::new(0.0, -3.0, 0.5), Vec3::Z, count, glow)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    /// Exposure is nobody's business: normals, confidence and depth stay.
    #[test]
    fn brightness_does_not_matter(exposure in 0.05f32..20.0) {
        let scene = standard(6, 0.1);
        let mut brighter = standard(6, 0.1);
        brighter.images.iter_mut().for_each(|i| *i = i.map(|v| v * exposure));
        let (a, b) = (scene.found().unwrap(), brighter.found().unwrap());
        for (p, q) in a.normals.data().iter().zip(b.normals.data()) {
            prop_assert!((p - q).abs() < 2e-2, "{p} {q}");
        }
    }

    /// The whole scene turned: the normals turn along.
    #[test]
    fn the_world_has_no_direction_of_its_own(eye in unit_vector()) {
        let eye = Vec3::from(eye);
        let up = eye.any_orthonormal_vector();
        let turned = Scene::new(Vec3::new(0.9, 0.6, 0.5), 3.0 * eye, up, 8, 0.1);
        let error = turned.median_error();
        let plain = Scene::new(Vec3::new(0.9, 0.6, 0.5), 3.0 * Vec3::Y, Vec3::Z, 8, 0.1).median_error();
        prop_assert!((error - plain).abs() < 0.5, "{error} {plain}");
    }

    /// Whatever the pictures hold, the result is finite, unit, and confidence is in [0, 1].
    #[test]
    fn any_pictures_give_unit_normals(values in prop::collection::vec(0.0f32..1e4, 12), sparse in 0usize..9) {
        let mut scene = standard(4, 0.0);
        for (k, image) in scene.images.iter_mut().enumerate() {
            for (i, v) in image.data_mut().iter_mut().enumerate() {
                *v = if i % 9 < sparse { 0.0 } else { values[(i * 7 + k) % 12] };
            }
        }
        match scene.found() {
            Ok(found) => {
                for (i, n) in scene.normals.iter().enumerate() {
                    let normal = Vec3::from_slice(&found.normals.data()[3 * i..]);
                    let (c, z) = (found.confidence.data()[i], found.depth.data()[i]);
                    if n.is_some() {
                        prop_assert!((normal.length() - 1.0).abs() < 1e-4 && (0.0..=1.0).contains(&c));
                        prop_assert!(z.is_finite() && z > 0.0);
                        let toward = scene.camera.ray(Vec2::new((i % SIDE) as f32 + 0.5, (i / SIDE) as f32 + 0.5)).direction;
                        prop_assert!(normal.dot(-toward) > -0.8);
                    } else {
                        prop_assert!(normal == Vec3::ZERO && c == 0.0 && z == 0.0);
                    }
                }
            }
            Err(e) => prop_assert_eq!(e, PhotometricError::Dark),
        }
    }
}

#[test]
fn a_matte_ellipsoid_is_found_and_a_glowing_one_nearly() {
    let matte = standard(12, 0.0).median_error();
    let ball = Scene::new(Vec3::splat(0.9), Vec3::new(0.0, -3.0, 0.5), Vec3::Z, 12, 0.0).median_error();
    let few = standard(3, 0.0).median_error();
    let glowing = standard(12, 0.3).median_error();
    println!("ball {ball:.2}°, matte {matte:.2}°, under three lights {few:.2}°, glowing {glowing:.2}°");
    assert!(ball < 2.0 && matte < 2.5 && few < 12.0 && glowing < 8.0, "{ball} {matte} {few} {glowing}");
}

#[test]
fn the_same_bits_again() {
    let scene = standard(7, 0.2);
    assert_eq!(scene.found().unwrap(), scene.found().unwrap());
}

#[test]
fn what_cannot_be_used_is_said() {
    let message = |change: &dyn Fn(&mut Scene)| {
        let mut scene = standard(4, 0.0);
        change(&mut scene);
        scene.found().unwrap_err().to_string()
    };
    let few = message(&|s| {
        s.images.truncate(2);
        s.lights.truncate(2);
    });
    assert!(few.contains("at least 3") && few.contains("found 2"), "{few}");
    let behind = message(&|s| {
        let eye = s.camera.pose.centre();
        s.lights.iter_mut().for_each(|l| *l = OlatLight::Point { position: -eye, intensity: Vec3::ONE });
    });
    assert!(behind.contains("all 4 lights are behind"), "{behind}");
    assert!(
        message(&|s| s.mask = Mask::from_vec(SIDE, SIDE, vec![0.0; SIDE * SIDE]).unwrap()).contains("coverage of ½")
    );
    assert!(message(&|s| s.mask = Mask::full(3, 3)).contains("mask: expected 48×48, found 3×3"));
    assert!(message(&|s| s.lights.truncate(3)).contains("expected 4 lights, found 3 lights"));
    assert!(message(&|s| s.images[2] = Image::new(SIDE, SIDE, 2)).contains("image 2: expected 48×48×3"));
    assert!(message(&|s| s.images[1].pixel_mut(4, 5)[2] = f32::NAN).contains("image 1"));
    assert!(message(&|s| s.images.iter_mut().for_each(|i| *i = i.map(|_| 0.0))).contains("black"));
    assert!(
        message(&|s| s.lights[0] = OlatLight::Point { position: Vec3::NAN, intensity: Vec3::ONE }).contains("position")
    );
}
