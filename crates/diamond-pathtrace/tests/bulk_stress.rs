//! The bulk renderer at the edges of what numbers can say: every value of every picture is finite.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_light::{Falloff, OlatLight};
use diamond_pathtrace::*;
use glam::Vec3;

/// Two boxes on one wall, not repaired; a sheet; a ball of slivers; an exact sphere.
fn shapes() -> Vec<Geometry> {
    let mut wall = Mesh::cuboid(Vec3::new(-1.0, -1.0, -1.0), Vec3::new(0.0, 1.0, 1.0));
    let other = Mesh::cuboid(Vec3::new(0.0, -1.0, -1.0), Vec3::new(1.0, 1.0, 1.0));
    wall.positions.extend(other.positions);
    wall.triangles.extend(other.triangles.iter().map(|t| t.map(|v| v + 8)));
    let sheet = Mesh::cuboid(Vec3::new(-1.0, -1.0, 0.0), Vec3::new(1.0, 1.0, 1e-5));
    let mut slivers = Mesh::icosphere(Vec3::ZERO, 1.0, 2);
    slivers.positions.iter_mut().for_each(|p| p.x *= 1e-3);
    let mut shapes: Vec<Geometry> = [wall, sheet, slivers].map(|m| Geometry::from_mesh(m).unwrap()).into();
    shapes.push(Geometry::Sphere { centre: Vec3::ZERO, radius: 1.0 });
    shapes
}

/// In the planes of faces, in line with edges, just above the surface, so far that directions are parallel, and grazing.
fn lamps() -> Vec<Light> {
    let places = [
        Vec3::new(3.0, 0.3, 1.0),
        Vec3::new(3.0, 1.0, 1.0),
        Vec3::new(0.0, 0.2, 3.0),
        Vec3::new(0.0, 0.0, 1.001),
        Vec3::splat(1e6),
    ];
    let mut lamps: Vec<Light> = places.map(|p| Light::point(p, Vec3::new(1.0, 0.0, 2.0))).into();
    lamps.extend([Vec3::X, Vec3::Y, Vec3::new(1.0, 1e-6, 0.0).normalize()].map(|d| Light::directional(d, Vec3::ONE)));
    let light = OlatLight::Point { position: Vec3::new(-2.0, 0.1, 1e-5), intensity: Vec3::ONE };
    lamps.push(Light::Olat { light, falloff: Falloff::None });
    lamps
}

fn solved(scene: &Scene, options: &BulkOptions, cameras: &[Camera]) -> (u64, u64) {
    let bulk = Bulk::solve(scene, options, &|_| ()).unwrap();
    let (mut lit, mut all) = (0, 0);
    for camera in cameras {
        let view = bulk.render(camera, 1).unwrap();
        let images = view.lights.iter().chain([&view.coverage, &view.depth, &view.normal]);
        for (l, image) in images.enumerate() {
            let bad = image.data().iter().find(|v| !v.is_finite());
            assert!(bad.is_none(), "{bad:?} of picture {l}: {:?} {:?}", scene.geometry, scene.material);
        }
        for image in &view.lights {
            lit += u64::from(image.data().iter().any(|v| *v > 0.0));
            all += 1;
        }
    }
    (lit, all)
}

#[test]
fn extreme_bulk_scenes_stay_finite() {
    let boundaries = [Boundary::IndexMatched, Boundary::Rough { eta: 1.5, alpha: 0.001 }];
    let sigmas = [Vec3::splat(1e-3), Vec3::ONE, Vec3::splat(1e4), Vec3::new(1e-3, 1.0, 1e4)];
    let albedos = [Vec3::ZERO, Vec3::ONE, Vec3::new(0.0, 0.5, 1.0)];
    // From afar, along a face, and along an edge.
    let eyes = [Vec3::new(1.5, 2.0, 3.0), Vec3::new(4.0, 0.2, 1.0), Vec3::new(4.0, 1.0, 1.0)];
    let cameras = eyes.map(|eye| Camera {
        intrinsics: Intrinsics::from_fov_x(0.7, 5, 5),
        pose: Pose::look_at(eye, Vec3::ZERO, Vec3::Z),
    });
    let base = BulkOptions { points: 16, walks: 3, samples_per_axis: 1, max_events: 100, ..Default::default() };
    let (mut lit, mut all) = (0, 0);
    for (s, geometry) in shapes().into_iter().enumerate() {
        for boundary in boundaries {
            for sigma_t in sigmas {
                for albedo in albedos {
                    for g in [-0.99, 0.99] {
                        let coat = Some(Coat { roughness: 0.0, f0: Vec3::splat(0.04) });
                        let material = Material { medium: Medium { sigma_t, albedo, g, veins: None }, boundary, coat };
                        let scene = Scene { geometry: geometry.clone(), material, lights: lamps() };
                        // Without maps every way is a ray.
                        let visibility = if s % 2 == 0 { 8 } else { 0 };
                        let found = solved(&scene, &BulkOptions { visibility, ..base }, &cameras);
                        (lit, all) = (lit + found.0, all + found.1);
                    }
                }
            }
        }
    }
    assert!(2 * lit > all, "{lit} of {all}");
}

/// Inside the object there is nothing that could be connected: lamps there are refused by name, and one on the surface is either
/// refused or gives finite pictures.
#[test]
fn lamps_inside_are_refused_and_lamps_on_the_surface_stay_finite() {
    let options = BulkOptions { points: 24, walks: 6, samples_per_axis: 2, visibility: 8, ..Default::default() };
    let camera = Camera {
        intrinsics: Intrinsics::from_fov_x(0.7, 5, 5),
        pose: Pose::look_at(Vec3::new(1.5, 2.0, 3.0), Vec3::ZERO, Vec3::Z),
    };
    let cuboid = Geometry::from_mesh(Mesh::cuboid(-Vec3::ONE, Vec3::ONE)).unwrap();
    for geometry in [cuboid, Geometry::Sphere { centre: Vec3::ZERO, radius: 1.0 }] {
        for boundary in [Boundary::IndexMatched, Boundary::Rough { eta: 1.4, alpha: 0.3 }] {
            let material = Material { medium: Medium::gray(5.0, 0.9, 0.5), boundary, coat: None };
            let scene = |p: Vec3| Scene {
                geometry: geometry.clone(),
                material,
                lights: vec![Light::point(Vec3::splat(4.0), Vec3::ONE), Light::point(p, Vec3::ONE)],
            };
            for inside in [Vec3::ZERO, Vec3::new(0.0, 0.0, 0.99), Vec3::new(0.5, -0.5, 0.1)] {
                let error = Bulk::solve(&scene(inside), &options, &|_| ()).map(|_| ()).unwrap_err();
                assert!(matches!(error, PathtraceError::Unreachable { light: 1, .. }), "{error}");
            }
            for on in [Vec3::Z, Vec3::X, Vec3::new(0.6, 0.8, 0.0), Vec3::new(1.0, 1.0, 0.3), Vec3::ONE] {
                let scene = scene(on);
                if Bulk::solve(&scene, &options, &|_| ()).is_ok() {
                    solved(&scene, &options, &[camera]);
                }
            }
        }
    }
}
