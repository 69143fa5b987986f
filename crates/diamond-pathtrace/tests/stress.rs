//! Scenes at the edges of what numbers can say: everything stays finite.
use diamond_light::{Falloff, OlatLight};
use diamond_pathtrace::sampling::uniform_sphere;
use diamond_pathtrace::*;
use glam::Vec3;

/// Two boxes on one wall, not repaired; a box with a thickness of 10⁻⁵; a ball with needles; exact shapes.
fn shapes() -> Vec<Geometry> {
    let mut wall = Mesh::cuboid(Vec3::new(-1.0, -1.0, -1.0), Vec3::new(0.0, 1.0, 1.0));
    let other = Mesh::cuboid(Vec3::new(0.0, -1.0, -1.0), Vec3::new(1.0, 1.0, 1.0));
    wall.positions.extend(other.positions);
    wall.triangles.extend(other.triangles.iter().map(|t| t.map(|v| v + 8)));
    let sheet = Mesh::cuboid(Vec3::new(-1.0, -1.0, 0.0), Vec3::new(1.0, 1.0, 1e-5));
    let mut needles = Mesh::icosphere(Vec3::ZERO, 1.0, 2);
    needles.positions.iter_mut().for_each(|p| p.x *= 1e-4);
    let mut shapes: Vec<Geometry> =
        [wall, sheet, needles, Mesh::icosphere(Vec3::ZERO, 1.0, 2)].map(|m| Geometry::from_mesh(m).unwrap()).into();
    shapes.push(Geometry::Sphere { centre: Vec3::ZERO, radius: 1.0 });
    shapes.push(Geometry::Slab { bottom: f32::NEG_INFINITY, top: 0.0 });
    shapes
}

/// Lamps inside, at the centre, on faces, edges and corners, far away, and cut by the surface.
fn lamps() -> Vec<Light> {
    let places =
        [Vec3::ZERO, Vec3::new(0.5, 0.5, 0.5), Vec3::Z, Vec3::ONE, Vec3::new(0.0, 0.0, 1e-5), Vec3::splat(1e6)];
    let mut lamps: Vec<Light> = places.map(|p| Light::point(p, Vec3::new(1.0, 0.0, 2.0))).into();
    let light = OlatLight::Point { position: Vec3::new(0.0, 1.0, 0.0), intensity: Vec3::ONE };
    lamps.push(Light::Olat { light, falloff: Falloff::None });
    lamps.push(Light::directional(Vec3::X, Vec3::ONE));
    for centre in [Vec3::ZERO, Vec3::new(0.0, 0.0, 1.0), Vec3::new(0.0, 3.0, 0.0)] {
        lamps.push(Light::Disc { centre, normal: Vec3::NEG_Z, radius: 0.7, radiance: Vec3::ONE });
    }
    lamps.push(Light::Environment(Environment::Constant { radiance: Vec3::ONE }));
    let mut picture = diamond_image::Image::new(8, 4, 3);
    picture.pixel_mut(5, 1).fill(1000.0);
    lamps.push(Light::Environment(Environment::Map(EnvironmentMap::new(picture, glam::Mat3::IDENTITY).unwrap())));
    lamps
}

/// A ray from outside: at random, in a face's plane, along an edge, at a corner.
fn ray(k: u32, rng: &mut Rng) -> (Vec3, Vec3) {
    match k % 6 {
        0 => (Vec3::new(-3.0, 0.2, 1.0), Vec3::X),
        1 => (Vec3::new(-3.0, 1.0, 1.0), Vec3::X),
        2 => (Vec3::splat(2.0), Vec3::splat(-1.0).normalize()),
        3 => (Vec3::new(-3.0, 0.2, 1.0 + 1e-6), Vec3::new(1.0, 0.0, -1e-6).normalize()),
        _ => {
            let origin = uniform_sphere(rng) * 3.0;
            (origin, (uniform_sphere(rng) * 0.9 - origin).normalize())
        }
    }
}

#[test]
fn extreme_scenes_stay_finite() {
    let boundaries = [
        Boundary::IndexMatched,
        Boundary::Rough { eta: 1.5, alpha: 0.001 },
        Boundary::Rough { eta: 0.3, alpha: 1.0 },
        Boundary::Smooth { eta: 1.33 },
    ];
    let sigmas = [Vec3::ZERO, Vec3::splat(1e-3), Vec3::splat(1e4), Vec3::new(1e-3, 1.0, 1e4)];
    let albedos = [Vec3::ZERO, Vec3::ONE, Vec3::new(0.0, 0.5, 1.0)];
    let options = PathOptions { max_events: 500, show_lights: true };
    let (mut rng, mut lit, mut traced) = (Rng::new(5, 6), 0u64, 0u64);
    for geometry in shapes() {
        for boundary in boundaries {
            for sigma_t in sigmas {
                for albedo in albedos {
                    for g in [-0.99, 0.0, 0.99] {
                        let coat = Some(Coat { roughness: 0.0, f0: Vec3::splat(0.04) });
                        let material = Material { medium: Medium { sigma_t, albedo, g, veins: None }, boundary, coat };
                        let mut lights = lamps();
                        if matches!(boundary, Boundary::Smooth { .. }) {
                            lights.retain(|light| !light.is_delta());
                        }
                        let scene = Scene { geometry: geometry.clone(), material, lights };
                        let tracer = Tracer::new(&scene, options).unwrap();
                        let mut out = vec![Vec3::ZERO; scene.lights.len()];
                        for k in 0..12 {
                            let (origin, direction) = ray(k, &mut rng);
                            tracer.trace(origin, direction, false, &mut rng, &mut out);
                            for (l, v) in out.iter().enumerate() {
                                let fine = v.is_finite() && v.min_element() >= 0.0;
                                assert!(
                                    fine,
                                    "{v} of lamp {l}: {geometry:?} {material:?} from {origin} to {direction}"
                                );
                            }
                            lit += u64::from(out.iter().any(|v| *v != Vec3::ZERO));
                            traced += 1;
                        }
                    }
                }
            }
        }
    }
    assert!(2 * lit > traced, "{lit} of {traced}");
}

/// What cannot be traced is refused with a reason.
#[test]
fn scenes_that_cannot_be_right_are_refused() {
    let scene =
        |material, lights| Scene { geometry: Geometry::Sphere { centre: Vec3::ZERO, radius: 1.0 }, material, lights };
    let smooth = Material { medium: Medium::gray(1.0, 0.5, 0.0), boundary: Boundary::Smooth { eta: 1.3 }, coat: None };
    let sun = vec![Light::directional(Vec3::Z, Vec3::ONE)];
    let error = scene(smooth, sun.clone()).validate().unwrap_err();
    assert!(matches!(error, PathtraceError::Unreachable { light: 0, .. }), "{error}");
    assert!(error.to_string().contains("rough"));
    // Inside, nothing bends on the way.
    scene(smooth, vec![Light::point(Vec3::ZERO, Vec3::ONE)]).validate().unwrap();
    for (medium, boundary) in [
        (Medium::gray(-1.0, 0.5, 0.0), Boundary::IndexMatched),
        (Medium::gray(f32::NAN, 0.5, 0.0), Boundary::IndexMatched),
        (Medium::gray(1.0, 1.1, 0.0), Boundary::IndexMatched),
        (Medium::gray(1.0, 0.5, 1.0), Boundary::IndexMatched),
        (Medium::gray(1.0, 0.5, 0.0), Boundary::Rough { eta: 9.0, alpha: 0.5 }),
        (Medium::gray(1.0, 0.5, 0.0), Boundary::Rough { eta: 1.3, alpha: 0.0 }),
    ] {
        assert!(scene(Material { medium, boundary, coat: None }, sun.clone()).validate().is_err());
    }
    let broken = Mesh { positions: vec![Vec3::ZERO; 3], triangles: vec![[0, 1, 9]], normals: None, uvs: None };
    assert!(Geometry::from_mesh(broken).is_err());
}

/// On a mesh, lengths inside agree with walks from surface to surface, and never leak: rays through edges and corners too.
#[test]
fn lengths_inside_a_mesh_agree_with_the_sphere_and_nothing_leaks() {
    let mesh = Geometry::from_mesh(Mesh::icosphere(Vec3::ZERO, 1.0, 6)).unwrap();
    let Geometry::Mesh(inner) = &mesh else { unreachable!() };
    let corners = inner.mesh().positions.clone();
    let mut rng = Rng::new(9, 1);
    for k in 0..20_000 {
        let start = uniform_sphere(&mut rng) * 0.9 * rng.uniform();
        // Half of the rays aim exactly at corners.
        let target = if k % 2 == 0 { corners[k % corners.len()] } else { uniform_sphere(&mut rng) };
        let direction = (target - start).normalize();
        let hit = mesh.closest_hit(start, direction, f32::INFINITY, Facing::Leaving, NO_PRIMITIVE);
        let hit = hit.unwrap_or_else(|| panic!("ray {k} leaked"));
        let length = mesh.inside_length(start, direction, f32::INFINITY, true, NO_PRIMITIVE);
        assert!((length - hit.distance).abs() < 1e-5, "ray {k}: {length} {}", hit.distance);
        let exact = Geometry::Sphere { centre: Vec3::ZERO, radius: 1.0 };
        let sphere = exact.inside_length(start, direction, f32::INFINITY, true, NO_PRIMITIVE);
        assert!((length - sphere).abs() < 2e-3);
        assert!(mesh.contains(start) && !mesh.contains(start + direction * (hit.distance + 1e-3)));
        assert!(mesh.clearance(start) <= hit.distance);
    }
}
