//! Objects that are not what a medium in a surface is made for, rendered by the path tracer: what the user is told of each.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::{Image, Mask};
use diamond_light::{Falloff, OlatLight};
use diamond_medium::{FitImage, FitOptions, Medium, Surface, fit_profile};
use diamond_pathtrace::{Boundary, Bulk, BulkOptions, Facing, Geometry, Light, Material, Mesh, NO_PRIMITIVE, Scene};
use glam::{Vec2, Vec3};

const FALLOFF: Falloff = Falloff::InverseSquare { reference: 3.0 };
const SIDE: usize = 36;

/// An ellipsoid, on which not every place is like every other.
fn mesh() -> Mesh {
    let mut mesh = Mesh::icosphere(Vec3::ZERO, 1.0, 4);
    mesh.positions.iter_mut().for_each(|p| *p *= Vec3::new(1.0, 0.7, 0.55));
    mesh
}

fn cameras() -> Vec<Camera> {
    let intrinsics = Intrinsics::from_fov_x(0.8, SIDE as u32, SIDE as u32);
    let eyes = [Vec3::new(0.4, 0.6, 3.0), Vec3::new(2.6, -1.5, 0.6)];
    eyes.iter().map(|eye| Camera { intrinsics, pose: Pose::look_at(*eye, Vec3::ZERO, Vec3::Y) }).collect()
}

fn lights() -> Vec<OlatLight> {
    let at = [Vec3::new(1.0, 1.5, 2.5), Vec3::new(2.5, -1.0, 0.5), Vec3::new(-2.0, 1.0, 2.0)];
    at.iter().map(|p| OlatLight::Point { position: *p, intensity: Vec3::splat(3.0) }).collect()
}

/// A medium fitted, on the true surface, to photographs of an object of `material`, and the remarks on it; `paint` is a factor on what leaves a place.
fn remarks(material: Material, paint: impl Fn(Vec3) -> f32) -> (Medium, Vec<String>) {
    let geometry = Geometry::from_mesh(mesh()).unwrap();
    let (cameras, lights) = (cameras(), lights());
    let lamps = lights.iter().map(|light| Light::Olat { light: *light, falloff: FALLOFF }).collect();
    let scene = Scene { geometry: geometry.clone(), material, lights: lamps };
    let options = BulkOptions { points: 600, walks: 1024, samples_per_axis: 2, ..Default::default() };
    let bulk = Bulk::solve(&scene, &options, &|_| ()).unwrap();
    let mut shots: Vec<(usize, usize, Image, Mask)> = Vec::new();
    for (c, camera) in cameras.iter().enumerate() {
        let view = bulk.render(camera, c as u64).unwrap();
        let factor = |i: usize| {
            let ray = camera.ray(Vec2::new((i % SIDE) as f32 + 0.5, (i / SIDE) as f32 + 0.5));
            let hit = geometry.closest_hit(ray.origin, ray.direction, f32::INFINITY, Facing::Entering, NO_PRIMITIVE);
            hit.map_or(1.0, |hit| paint(hit.position))
        };
        for (l, picture) in view.lights.iter().enumerate() {
            let mut radiance = picture.clone();
            for (i, pixel) in radiance.data_mut().chunks_exact_mut(3).enumerate() {
                pixel.iter_mut().for_each(|v| *v *= factor(i));
            }
            shots.push((c, l, radiance, Mask::from_channel(&view.coverage, 0).unwrap()));
        }
    }
    let images: Vec<FitImage<'_>> = shots
        .iter()
        .map(|(c, l, radiance, mask)| FitImage {
            camera: &cameras[*c],
            light: &lights[*l],
            radiance,
            mask: Some(mask),
            tint: None,
            known: None,
        })
        .collect();
    let surface = Surface::new(mesh(), 1500).unwrap();
    let options = FitOptions { falloff: FALLOFF, ..FitOptions::default() };
    let seen: Vec<_> = images.iter().map(|image| options.sample(&surface, image, images.len()).unwrap()).collect();
    let found = fit_profile(&surface, &seen, &options).unwrap();
    let remarks = found.remarks(surface.spacing());
    println!("{:?} {} of {} {remarks:?}", found.quality, found.mean_radius(), surface.spacing());
    (found, remarks)
}

fn matched(sigma_t: f32, albedo: Vec3) -> Material {
    Material::index_matched(diamond_pathtrace::Medium { sigma_t: Vec3::splat(sigma_t), albedo, g: 0.0, veins: None })
}

const WAX: Vec3 = Vec3::new(0.99, 0.95, 0.85);

#[test]
fn wax_gets_no_remark() {
    let (found, remarks) = remarks(matched(10.0, WAX), |_| 1.0);
    assert_eq!(found.unfit(), None);
    assert!(remarks.is_empty() && found.quality.unwrap().relative_error < 0.15, "{remarks:?} {:?}", found.quality);
}

#[test]
fn an_opaque_object_is_called_opaque() {
    let (found, remarks) = remarks(matched(150.0, Vec3::new(0.9, 0.8, 0.6)), |_| 1.0);
    assert_eq!(found.unfit(), None);
    assert!(remarks.len() == 1 && remarks[0].contains("opaque"), "{remarks:?}");
}

#[test]
fn a_clear_object_is_explained_badly() {
    let boundary = Boundary::Rough { eta: 1.5, alpha: 0.02 };
    let glass = Material { boundary, ..matched(0.3, Vec3::splat(0.9)) };
    let (_, remarks) = remarks(glass, |_| 1.0);
    assert!(remarks.iter().any(|r| r.contains("explains the photographs badly") && r.contains("clear")), "{remarks:?}");
}

/// Where the mean free path is the object's size, light goes anywhere, and there should be no medium.
#[test]
fn light_that_crosses_is_no_medium() {
    let (found, _) = remarks(matched(0.7, Vec3::splat(0.97)), |_| 1.0);
    assert!(found.unfit().is_some_and(|why| why.contains("crosses")), "{found:?}");
}

/// Wax under stripes of a dye that swallows four fifths of what leaves.
#[test]
fn an_object_of_several_materials_is_called_textured() {
    let stripes = |p: Vec3| if libm::sinf(9.0 * p.x) > 0.0 { 1.0 } else { 0.2 };
    let (_, remarks) = remarks(matched(10.0, WAX), stripes);
    assert!(remarks.iter().any(|r| r.contains("several materials") && r.contains("under all lights")), "{remarks:?}");
}
