//! The bulk renderer against the reference, and its laws.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_light::LightRig;
use diamond_pathtrace::{
    Boundary, Bulk, BulkError, BulkOptions, Coat, Geometry, Light, Material, Medium, Mesh, PathtraceError,
    ReferenceOptions, Scene, Veins, measure_bulk, reference_pairs, render_reference,
};
use glam::Vec3;

fn camera(eye: Vec3, side: u32) -> Camera {
    Camera { intrinsics: Intrinsics::from_fov_x(0.55, side, side), pose: Pose::look_at(eye, Vec3::ZERO, Vec3::Y) }
}

fn sphere() -> Geometry {
    Geometry::Sphere { centre: Vec3::ZERO, radius: 1.0 }
}

fn lamps(directions: &[Vec3]) -> Vec<Light> {
    directions.iter().map(|d| Light::directional(d.normalize(), Vec3::splat(3.0))).collect()
}

/// A ball with a hollow, which shadows itself and sees itself.
fn dented() -> Geometry {
    let mut mesh = Mesh::icosphere(Vec3::ZERO, 1.0, 3);
    for p in &mut mesh.positions {
        let near = (*p - Vec3::new(0.3, 0.4, 0.85)).length_squared();
        *p *= 1.0 - 0.45 * (-near / 0.15).exp();
    }
    mesh.normals = None;
    Geometry::from_mesh(mesh.with_smooth_normals()).unwrap()
}

const OBLIQUE: [Vec3; 3] = [Vec3::new(0.3, 0.5, 1.0), Vec3::new(1.0, 0.2, -0.1), Vec3::new(-0.2, 0.4, -1.0)];

fn measured(scene: &Scene, options: &BulkOptions, side: u32, samples: u32) -> BulkError {
    let reference = ReferenceOptions { samples, seed: 5, ..Default::default() };
    measure_bulk(scene, options, &[camera(Vec3::new(0.0, 0.5, 3.9), side)], &reference, f32::INFINITY, &|_| ()).unwrap()
}

fn assert_small(error: &BulkError, rmse: f64) {
    let standard_error = error.bias_standard_error.hypot(error.bias_noise);
    assert!(standard_error < 0.02, "too noisy to tell: {error:?}");
    assert!(error.bias.abs() < 0.01 + 2.0 * standard_error, "{error:?}");
    // So few walks are mostly noise; the rest is what points and directions cannot express, in pixels that are a tenth of the object.
    assert!(error.rmse < rmse, "{error:?}");
}

#[test]
fn an_index_matched_sphere_agrees_with_the_reference() {
    let medium = Medium { sigma_t: Vec3::new(5.0, 8.0, 12.0), albedo: Vec3::new(0.95, 0.9, 0.8), g: 0.0, veins: None };
    let scene = Scene { geometry: sphere(), material: Material::index_matched(medium), lights: lamps(&OBLIQUE) };
    let options = BulkOptions { points: 800, walks: 400, connections: 1.0, samples_per_axis: 8, ..Default::default() };
    assert_small(&measured(&scene, &options, 14, 1500), 0.1);
}

/// `[eq:single-scattering]`: of a thin, dark object hardly anything else is seen.
#[test]
fn a_dented_ball_with_forward_scattering_and_a_coat_agrees_with_the_reference() {
    let medium = Medium { sigma_t: Vec3::new(4.0, 6.0, 9.0), albedo: Vec3::new(0.7, 0.6, 0.4), g: 0.6, veins: None };
    let coat = Some(Coat { roughness: 0.5, f0: Vec3::splat(0.05) });
    let material = Material { medium, boundary: Boundary::IndexMatched, coat };
    let scene = Scene { geometry: dented(), material, lights: lamps(&OBLIQUE) };
    let options = BulkOptions { points: 600, walks: 600, connections: 1.0, samples_per_axis: 8, ..Default::default() };
    assert_small(&measured(&scene, &options, 14, 1500), 0.2);
}

/// `[eq:veins]`: in both media of the bulk renderer, and not what the same medium without veins sends out.
#[test]
fn a_veined_sphere_agrees_with_the_reference() {
    let veins = Some(Veins { frequency: 1.5, width: 0.3, factor: Vec3::new(0.5, 0.7, 0.9), seed: 4 });
    let medium = Medium { sigma_t: Vec3::new(5.0, 8.0, 12.0), albedo: Vec3::new(0.98, 0.95, 0.9), g: 0.0, veins };
    for (boundary, rmse) in [(Boundary::IndexMatched, 0.12), (Boundary::Rough { eta: 1.4, alpha: 0.6 }, 0.17)] {
        let material = Material { medium, boundary, coat: None };
        let scene = Scene { geometry: sphere(), material, lights: lamps(&OBLIQUE) };
        let options = BulkOptions { points: 600, walks: 400, connections: 1.0, ..Default::default() };
        assert_small(&measured(&scene, &options, 10, 2000), rmse);
        let mean = |scene: &Scene| -> f64 {
            let bulk = Bulk::solve(scene, &options, &|_| ()).unwrap();
            let view = bulk.render(&camera(Vec3::new(3.0, 1.0, 0.5), 10), 4).unwrap();
            view.lights.iter().map(|image| f64::from(image.mean())).sum()
        };
        let mut plain = scene.clone();
        plain.material.medium.veins = None;
        let (with, without) = (mean(&scene), mean(&plain));
        assert!(with < 0.8 * without, "{with} {without}");
    }
}

#[test]
fn a_refracting_sphere_agrees_with_the_reference() {
    let medium = Medium { sigma_t: Vec3::new(6.0, 9.0, 14.0), albedo: Vec3::new(0.97, 0.9, 0.8), g: 0.0, veins: None };
    let material = Material { medium, boundary: Boundary::Rough { eta: 1.4, alpha: 0.6 }, coat: None };
    let scene = Scene { geometry: sphere(), material, lights: lamps(&OBLIQUE) };
    let options = BulkOptions { points: 500, walks: 500, ..Default::default() };
    assert_small(&measured(&scene, &options, 10, 4000), 0.15);
}

/// What is beyond white does not count, and what is below counts as before.
#[test]
fn errors_are_those_of_what_film_shows() {
    let coat = Some(Coat { roughness: 0.05, f0: Vec3::splat(0.04) });
    let material = Material { coat, ..Material::index_matched(Medium::gray(8.0, 0.8, 0.0)) };
    let scene = Scene { geometry: sphere(), material, lights: lamps(&OBLIQUE[..1]) };
    let options = BulkOptions { points: 60, walks: 64, samples_per_axis: 2, ..Default::default() };
    let reference = ReferenceOptions { samples: 32, seed: 5, ..Default::default() };
    let cameras = [camera(Vec3::new(0.0, 0.5, 3.9), 16)];
    let references = reference_pairs(&scene, &cameras, &reference).unwrap();
    let error = |white| BulkError::against(&scene, &options, &cameras, &references, white, &|_| ()).unwrap();
    let (all, some, none) = (error(f32::INFINITY), error(0.5), error(0.0));
    assert_eq!(all.rmse, all.rmse_beyond_white);
    assert_eq!((some.rmse_beyond_white, some.bias), (all.rmse_beyond_white, all.bias));
    assert!(0.0 < some.rmse && some.rmse < 0.8 * all.rmse, "{some:?}");
    assert_eq!(none.rmse, 0.0);
}

/// A white object in light from everywhere is as bright as the light, if nothing shines through; in bulk as in nature.
#[test]
fn a_white_object_does_not_exceed_the_furnace() {
    let count = 100;
    let rig = LightRig::directional_dome(
        count,
        Vec3::Y,
        -std::f32::consts::FRAC_PI_2,
        Vec3::splat(4.0 * std::f32::consts::PI / count as f32),
    )
    .unwrap();
    let lights: Vec<Light> = rig.lights.iter().map(|light| Light::from(*light)).collect();
    let material = Material::index_matched(Medium::gray(6.0, 1.0, 0.0));
    let scene = Scene { geometry: sphere(), material, lights };
    let options = BulkOptions { points: 120, walks: 800, connections: 1.0, samples_per_axis: 5, ..Default::default() };
    let bulk = Bulk::solve(&scene, &options, &|_| ()).unwrap();
    let view = bulk.render(&camera(Vec3::new(0.0, 0.5, 3.9), 12), 0).unwrap();
    let (mut worst, mut sum, mut n) = (0.0f32, 0.0f32, 0);
    for i in 0..view.coverage.pixels() {
        let value: f32 = view.lights.iter().map(|image| image.data()[3 * i]).sum();
        worst = worst.max(value - view.coverage.data()[i]);
        // Near outlines light shines through.
        let (x, y) = (i % 12, i / 12);
        if (4..8).contains(&x) && (4..8).contains(&y) {
            sum += value;
            n += 1;
        }
    }
    // Pixels have noise, most near outlines.
    assert!(worst < 0.15, "{worst}");
    let total: f32 = view.lights.iter().map(|image| image.mean()).sum();
    assert!(total < 1.005 * view.coverage.mean(), "{total}");
    assert!((sum / n as f32 - 1.0).abs() < 0.025, "{}", sum / n as f32);
}

#[test]
fn bits_depend_neither_on_threads_nor_on_the_other_lights() {
    for boundary in [Boundary::IndexMatched, Boundary::Rough { eta: 1.5, alpha: 0.3 }] {
        let medium =
            Medium { sigma_t: Vec3::new(4.0, 6.0, 9.0), albedo: Vec3::new(0.9, 0.8, 0.7), g: 0.4, veins: None };
        let coat = Some(Coat { roughness: 0.4, f0: Vec3::splat(0.04) });
        let material = Material { medium, boundary, coat };
        let scene = Scene { geometry: dented(), material, lights: lamps(&OBLIQUE) };
        let options = BulkOptions { points: 120, walks: 20, visibility: 64, ..Default::default() };
        let camera = camera(Vec3::new(0.0, 0.5, 3.9), 12);
        let render = |scene: &Scene, threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| Bulk::solve(scene, &options, &|_| ()).unwrap().render(&camera, 3).unwrap())
        };
        let one = render(&scene, 1);
        assert_eq!(one, render(&scene, 3));
        for (l, light) in scene.lights.iter().enumerate() {
            let alone = Scene { lights: vec![light.clone()], ..scene.clone() };
            assert_eq!(one.lights[l], render(&alone, 2).lights[0]);
        }
    }
}

#[test]
fn coverage_depth_and_normals_are_those_of_the_object() {
    let material = Material::index_matched(Medium::gray(5.0, 0.5, 0.0));
    let scene = Scene { geometry: sphere(), material, lights: lamps(&OBLIQUE) };
    let options = BulkOptions { points: 50, walks: 4, ..Default::default() };
    let camera = camera(Vec3::new(0.0, 0.0, 4.0), 33);
    let view = Bulk::solve(&scene, &options, &|_| ()).unwrap().render(&camera, 0).unwrap();
    assert!((view.depth.pixel(16, 16)[0] - 3.0).abs() < 1e-3);
    assert!((Vec3::from_slice(view.normal.pixel(16, 16)) - Vec3::Z).length() < 1e-3);
    assert_eq!(view.coverage.pixel(0, 0)[0], 0.0);
    assert_eq!(view.coverage.pixel(16, 16)[0], 1.0);
    let reference = render_reference(&scene, &camera, &ReferenceOptions { samples: 64, ..Default::default() }).unwrap();
    assert!((view.coverage.mean() - reference.coverage.mean()).abs() < 0.004);
}

#[test]
fn what_bulk_cannot_do_is_said() {
    let material = Material::index_matched(Medium::gray(5.0, 0.5, 0.0));
    let scene = |lights| Scene { geometry: sphere(), material, lights };
    let options = BulkOptions { points: 50, walks: 2, ..Default::default() };
    let refused = |scene: &Scene, options: &BulkOptions| Bulk::solve(scene, options, &|_| ()).map(|_| ()).unwrap_err();
    let disc = scene(vec![Light::disc_towards(Vec3::ZERO, Vec3::Z * 3.0, 0.1, Vec3::ONE)]);
    assert!(matches!(refused(&disc, &options), PathtraceError::Unreachable { light: 0, .. }));
    let inside = scene(vec![Light::point(Vec3::splat(0.1), Vec3::ONE)]);
    assert!(matches!(refused(&inside, &options), PathtraceError::Unreachable { light: 0, .. }));
    let good = scene(lamps(&OBLIQUE));
    for bad in [
        BulkOptions { points: 0, ..options },
        BulkOptions { walks: 0, ..options },
        BulkOptions { connections: f32::NAN, ..options },
        BulkOptions { samples_per_axis: 0, ..options },
    ] {
        assert!(matches!(refused(&good, &bad), PathtraceError::Value { .. }));
    }
    let slab = Scene { geometry: Geometry::Slab { bottom: 0.0, top: 1.0 }, ..good.clone() };
    assert!(matches!(refused(&slab, &options), PathtraceError::Mesh { .. }));
    let bulk = Bulk::solve(&good, &options, &|_| ()).unwrap();
    assert!(bulk.render(&camera(Vec3::new(0.0, 0.0, 0.1), 8), 0).is_err());
}
