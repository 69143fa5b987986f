//! The visual hull of a sphere, and bounds from its masks.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::Mask;
use diamond_splat::{HullConfig, scene_bounds_from_masks, visual_hull};
use glam::{Vec2, Vec3};

const CENTRE: Vec3 = Vec3::new(0.1, -0.2, 0.3);
const RADIUS: f32 = 0.7;
const BOUNDS: (Vec3, Vec3) = (Vec3::splat(-1.2), Vec3::splat(1.2));

/// The twelve corners of an icosahedron.
fn icosahedron() -> Vec<Vec3> {
    let g = 0.5 * (1.0 + 5f32.sqrt());
    let mut corners = Vec::new();
    for a in [-1.0, 1.0] {
        for b in [-g, g] {
            corners.extend([Vec3::new(0.0, a, b), Vec3::new(a, b, 0.0), Vec3::new(b, 0.0, a)]);
        }
    }
    corners
}

fn fibonacci(n: usize) -> Vec<Vec3> {
    (0..n)
        .map(|i| {
            let z = 1.0 - (2.0 * i as f32 + 1.0) / n as f32;
            let phi = i as f32 * 2.399_963_2;
            Vec3::new((1.0 - z * z).sqrt() * phi.cos(), (1.0 - z * z).sqrt() * phi.sin(), z)
        })
        .collect()
}

/// Cameras in these directions that look at the origin, beside which the sphere lies, and antialiased masks.
fn views(directions: &[Vec3]) -> (Vec<Camera>, Vec<Mask>) {
    let intrinsics = Intrinsics::from_fov_x(0.7, 128, 128);
    let cameras: Vec<Camera> = directions
        .iter()
        .map(|d| Camera { intrinsics, pose: Pose::look_at(d.normalize() * 4.0, Vec3::ZERO, Vec3::Z) })
        .collect();
    let masks = cameras.iter().map(mask).collect();
    (cameras, masks)
}

fn mask(camera: &Camera) -> Mask {
    let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
    let mut coverage = vec![0.0; width * height];
    for y in 0..height {
        for x in 0..width {
            for sub in 0..16 {
                let offset = Vec2::new((sub % 4) as f32 + 0.5, (sub / 4) as f32 + 0.5) / 4.0;
                let ray = camera.ray(Vec2::new(x as f32, y as f32) + offset);
                let across = (CENTRE - ray.origin).cross(ray.direction).length();
                coverage[y * width + x] += (across < RADIUS) as u32 as f32 / 16.0;
            }
        }
    }
    Mask::from_vec(width, height, coverage).unwrap()
}

/// [eq:hull-coverage] The hull contains the sphere, and exceeds it by what twelve silhouettes leave open; [eq:hull-normal].
#[test]
fn the_hull_of_a_sphere_encloses_it() {
    // A surface point that is φ from the nearest silhouette circle is covered to RADIUS/cos φ.
    for (directions, worst_excess, mean_excess) in [(icosahedron(), 0.06, 0.006), (fibonacci(60), 0.008, 0.002)] {
        let (cameras, masks) = views(&directions);
        let masks: Vec<&Mask> = masks.iter().collect();
        let hull = visual_hull(&cameras, &masks, BOUNDS, &HullConfig { resolution: 64, min_views: 2 }).unwrap();
        assert!(hull.points.len() > 3000 && hull.points.len() == hull.normals.len());
        let (mut worst, mut mean, mut least, mut facing) = (0.0f32, 0.0, f32::INFINITY, 0.0);
        for (p, n) in hull.points.iter().zip(&hull.normals) {
            let excess = (*p - CENTRE).length() - RADIUS;
            worst = worst.max(excess);
            least = least.min(excess);
            mean += excess / hull.points.len() as f32;
            let cosine = n.dot((*p - CENTRE).normalize());
            facing += cosine / hull.points.len() as f32;
            assert!(cosine > 0.7 && (n.length() - 1.0).abs() < 1e-5, "normal at cosine {cosine}");
        }
        println!(
            "{} views: {} points, excess {least}..{worst}, mean {mean}, facing {facing}",
            directions.len(),
            hull.points.len()
        );
        // Inward, masks are exact to a fraction of a pixel (0.02 at this distance).
        assert!(least > -0.005, "{least} inside the sphere");
        assert!(worst < worst_excess && mean < mean_excess, "excess {worst}, mean {mean}");
        assert!(facing > 0.97, "{facing}");
        let volume = hull.occupied as f32 * hull.voxel_size.powi(3);
        let sphere = 4.0 / 3.0 * std::f32::consts::PI * RADIUS.powi(3);
        assert!((0.99..1.2).contains(&(volume / sphere)), "volume ratio {}", volume / sphere);
    }
}

#[test]
fn bounds_from_masks_are_conservative_and_tight() {
    for directions in [icosahedron(), fibonacci(30), vec![Vec3::X, Vec3::Y, Vec3::new(1.0, 1.0, 1.0)]] {
        let (cameras, masks) = views(&directions);
        let masks: Vec<&Mask> = masks.iter().collect();
        let (low, high) = scene_bounds_from_masks(&cameras, &masks).unwrap().unwrap();
        assert!(low.cmple(CENTRE - RADIUS).all() && high.cmpge(CENTRE + RADIUS).all(), "{low} {high}");
        let excess = (high - low).max_element() / (2.0 * RADIUS);
        let allowed = if directions.len() > 3 { 1.35 } else { 2.2 };
        assert!(excess < allowed, "{} views: {excess} times too large", directions.len());
    }
}

#[test]
fn what_says_nothing_gives_nothing() {
    let (cameras, masks) = views(&[Vec3::X, Vec3::Y]);
    let refs: Vec<&Mask> = masks.iter().collect();
    let empty = Mask::from_vec(128, 128, vec![0.0; 128 * 128]).unwrap();
    // One camera, two at the same place, none, an empty mask.
    assert_eq!(scene_bounds_from_masks(&cameras[..1], &refs[..1]), Ok(None));
    assert_eq!(scene_bounds_from_masks(&[cameras[0]; 2], &[refs[0]; 2]), Ok(None));
    assert_eq!(scene_bounds_from_masks(&[], &[]), Ok(None));
    assert_eq!(scene_bounds_from_masks(&cameras, &[refs[0], &empty]), Ok(None));
    let config = HullConfig { resolution: 16, ..HullConfig::default() };
    assert_eq!(visual_hull(&cameras, &[refs[0], &empty], BOUNDS, &config).unwrap().points, []);
    assert_eq!(visual_hull(&[], &[], BOUNDS, &config).unwrap().occupied, 0);
    // A single camera carves a cone; a full mask carves nothing.
    let one = visual_hull(&cameras[..1], &refs[..1], BOUNDS, &config).unwrap();
    assert!(one.occupied > 0 && one.normals.iter().all(|n| n.is_finite()));
    let full = Mask::full(128, 128);
    let all = visual_hull(&cameras[..1], &[&full], (Vec3::splat(-0.2), Vec3::splat(0.2)), &config).unwrap();
    assert_eq!(all.occupied, 16 * 16 * 16);
    assert!(visual_hull(&cameras, &refs[..1], BOUNDS, &config).is_err());
    assert!(visual_hull(&cameras, &refs, (Vec3::ONE, Vec3::ONE), &config).is_err());
    assert!(visual_hull(&cameras, &refs, (Vec3::ZERO, Vec3::splat(f32::NAN)), &config).is_err());
    assert!(visual_hull(&cameras, &refs, BOUNDS, &HullConfig { resolution: 0, min_views: 1 }).is_err());
    let small = Mask::full(4, 4);
    assert!(visual_hull(&cameras[..1], &[&small], BOUNDS, &config).is_err());
}

#[test]
fn thread_counts_do_not_change_a_bit() {
    let (cameras, masks) = views(&icosahedron());
    let masks: Vec<&Mask> = masks.iter().collect();
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let bounds = scene_bounds_from_masks(&cameras, &masks).unwrap().unwrap();
            visual_hull(&cameras, &masks, bounds, &HullConfig { resolution: 32, ..HullConfig::default() }).unwrap()
        })
    };
    assert_eq!(run(1), run(3));
}
