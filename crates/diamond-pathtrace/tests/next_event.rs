//! Connections with lamps against chance: a tracer in a few lines that connects nothing finds the same light. And three channels
//! traced together against each of them alone.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_pathtrace::*;
use glam::{DVec3, Mat3, Vec3};

/// Radiance of one path that meets lamps only by chance: no connection, no roulette, no spectral weights (all channels of the medium alike).
fn by_chance(scene: &Scene, mut origin: Vec3, mut direction: Vec3, rng: &mut Rng) -> Vec3 {
    let (geometry, medium) = (&scene.geometry, scene.material.medium);
    let light = &scene.lights[0];
    let (mut throughput, mut inside, mut skip, mut seen) = (Vec3::ONE, false, NO_PRIMITIVE, false);
    let mut coat = Vec3::ZERO;
    for _ in 0..400 {
        if !inside {
            let hit = geometry.closest_hit(origin, direction, f32::INFINITY, Facing::Entering, skip);
            if seen {
                let end = hit.map_or(f32::INFINITY, |h| h.distance);
                if let Some((distance, radiance)) = light.met_by(origin, direction)
                    && distance < end
                {
                    return coat + throughput * radiance;
                }
                if hit.is_none() {
                    let found = light.at_infinity(direction).map_or(Vec3::ZERO, |(radiance, _)| radiance);
                    return coat + throughput * found;
                }
            }
            let Some(hit) = hit else { return coat };
            if !seen && let Some(c) = scene.material.coat {
                let normal = geometry.shading_normal(&hit);
                if let Some((to, weight, _)) = c.sample(-direction, normal, rng)
                    && geometry.closest_hit(hit.position, to, f32::INFINITY, Facing::Entering, hit.primitive).is_none()
                {
                    let met = light.met_by(hit.position, to).map(|(_, radiance)| radiance);
                    coat = weight * met.or(light.at_infinity(to).map(|(r, _)| r)).unwrap_or(Vec3::ZERO);
                }
            }
            seen = true;
            let Some(s) = scene.material.boundary.sample(-direction, hit.normal, rng) else { return coat };
            throughput *= s.weight;
            inside = s.transmitted;
            (origin, direction, skip) = (hit.position, s.direction, hit.primitive);
            continue;
        }
        let length = -(1.0 - rng.uniform()).ln() / medium.sigma_t.x;
        match geometry.closest_hit(origin, direction, length, Facing::Leaving, skip) {
            None => {
                // Analogue absorption.
                if rng.uniform() >= medium.albedo.x {
                    return coat;
                }
                origin += direction * length;
                skip = NO_PRIMITIVE;
                direction = sample_henyey_greenstein(medium.g, direction, rng);
            }
            Some(hit) => {
                let Some(s) = scene.material.boundary.sample(-direction, hit.normal, rng) else { return coat };
                throughput *= s.weight;
                inside = !s.transmitted;
                (origin, direction, skip) = (hit.position, s.direction, hit.primitive);
            }
        }
    }
    coat
}

fn average(paths: u32, mut path: impl FnMut(&mut Rng) -> Vec3) -> (DVec3, DVec3) {
    let mut rng = Rng::new(17, 3);
    let (mut sum, mut square) = (DVec3::ZERO, DVec3::ZERO);
    for _ in 0..paths {
        let value = path(&mut rng).as_dvec3();
        sum += value;
        square += value * value;
    }
    let n = f64::from(paths);
    let mean = sum / n;
    let variance = ((square / n - mean * mean) / n).max(DVec3::ZERO);
    (mean, DVec3::new(variance.x.sqrt(), variance.y.sqrt(), variance.z.sqrt()))
}

/// A picture of the surroundings: dim, with a bright window.
fn sky() -> Light {
    let mut picture = diamond_image::Image::new(8, 4, 3);
    picture.data_mut().fill(0.1);
    for x in 1..3 {
        picture.pixel_mut(x, 1).copy_from_slice(&[6.0, 3.0, 9.0]);
    }
    let rotation = Mat3::from_rotation_x(0.7) * Mat3::from_rotation_z(0.3);
    Light::Environment(Environment::Map(EnvironmentMap::new(picture, rotation).unwrap()))
}

/// `[eq:balance-heuristic]`: discs and pictures of the surroundings, with and without a boundary, from a ball with a dent and a coat.
#[test]
fn connections_find_what_chance_finds() {
    let mut mesh = Mesh::icosphere(Vec3::ZERO, 1.0, 3);
    for p in &mut mesh.positions {
        let near = (*p - Vec3::new(0.3, 0.4, 0.85)).length_squared();
        *p *= 1.0 - 0.4 * (-near / 0.2).exp();
    }
    mesh.normals = None;
    let geometry = Geometry::from_mesh(mesh.with_smooth_normals()).unwrap();
    let radiance = Vec3::new(3.0, 1.0, 0.5);
    let near =
        Light::Disc { centre: Vec3::new(0.2, 0.9, 2.0), normal: Vec3::new(0.0, -0.6, -0.8), radius: 1.2, radiance };
    // Half of it inside the object.
    let cutting = Light::Disc { centre: Vec3::new(0.6, 0.6, 0.0), normal: Vec3::X, radius: 0.8, radiance };
    let coat = Some(Coat { roughness: 0.6, f0: Vec3::splat(0.3) });
    let cases = [
        (near.clone(), Boundary::IndexMatched, coat),
        (sky(), Boundary::IndexMatched, coat),
        (near, Boundary::Rough { eta: 1.4, alpha: 0.5 }, None),
        (sky(), Boundary::Rough { eta: 1.4, alpha: 0.5 }, None),
        (sky(), Boundary::Smooth { eta: 1.3 }, None),
        (cutting, Boundary::IndexMatched, None),
    ];
    for (k, (light, boundary, coat)) in cases.into_iter().enumerate() {
        let material = Material { medium: Medium::gray(3.0, 0.9, 0.3), boundary, coat };
        let scene = Scene { geometry: geometry.clone(), material, lights: vec![light] };
        let tracer = Tracer::new(&scene, PathOptions::default()).unwrap();
        let ray = |rng: &mut Rng| {
            let p = sampling::uniform_disc(rng) * 0.9;
            (Vec3::new(p.x, p.y, 3.0), -Vec3::Z)
        };
        // A disc that the object holds a part of shines inside too; the few lines above do not look for it there.
        let connected = average(150_000, |rng| {
            let (origin, direction) = ray(rng);
            let mut out = [Vec3::ZERO];
            tracer.trace(origin, direction, false, rng, &mut out);
            out[0]
        });
        if k == 5 {
            assert!(connected.0.is_finite() && connected.0.min_element() > 0.0);
            continue;
        }
        let chance = average(400_000, |rng| {
            let (origin, direction) = ray(rng);
            by_chance(&scene, origin, direction, rng)
        });
        for c in 0..3 {
            let error = connected.1[c].hypot(chance.1[c]);
            let apart = (connected.0[c] - chance.0[c]).abs();
            assert!(error < 0.015 * chance.0[c], "case {k}: too noisy to tell: {connected:?} {chance:?}");
            assert!(apart < 4.0 * error, "case {k}: {connected:?} {chance:?}");
        }
    }
}

/// `[eq:spectral-flight]`: a picture with three σ_t is that of three media with one each, pixel by pixel.
#[test]
fn a_chromatic_picture_is_three_monochrome_ones() {
    let camera = Camera {
        intrinsics: Intrinsics::from_fov_x(0.6, 16, 16),
        pose: Pose::look_at(Vec3::new(0.0, 0.8, 3.9), Vec3::ZERO, Vec3::Y),
    };
    for boundary in [Boundary::IndexMatched, Boundary::Rough { eta: 1.4, alpha: 0.4 }] {
        let medium =
            Medium { sigma_t: Vec3::new(1.0, 4.0, 20.0), albedo: Vec3::new(0.97, 0.9, 0.8), g: 0.4, veins: None };
        let render = |medium: Medium, seed: u64| {
            let scene = Scene {
                geometry: Geometry::Sphere { centre: Vec3::ZERO, radius: 1.0 },
                material: Material { medium, boundary, coat: None },
                lights: vec![Light::directional(Vec3::new(0.6, 0.0, 0.8), Vec3::ONE)],
            };
            let samples = 1024;
            let options = ReferenceOptions { samples, seed, ..Default::default() };
            render_reference(&scene, &camera, &options).unwrap().lights.remove(0)
        };
        let chromatic = render(medium, 1);
        for c in 0..3 {
            let alone = render(Medium::gray(medium.sigma_t[c], medium.albedo[c], medium.g), 2 + c as u64);
            let ((a, ea), (b, eb)) = (chromatic.film_mean(), alone.film_mean());
            let error = ea[c].hypot(eb[c]);
            assert!(error < 0.05 * b[c], "too noisy to tell: {error} {b}");
            assert!((a[c] - b[c]).abs() < 4.0 * error, "{boundary:?} {c}: {} {} ± {error}", a[c], b[c]);
            let at = |image: &diamond_image::Image, i: usize| f64::from(image.data()[3 * i + c]);
            let outside = (0..256).filter(|i| {
                let error = at(&chromatic.standard_error, *i).hypot(at(&alone.standard_error, *i));
                (at(&chromatic.mean, *i) - at(&alone.mean, *i)).abs() > 4.0 * error.max(1e-7)
            });
            assert!(outside.count() <= 3, "{boundary:?} {c}");
        }
    }
}
