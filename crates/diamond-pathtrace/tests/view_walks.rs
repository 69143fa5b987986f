//! What view walks are for: the medium of an object from pictures of it.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_pathtrace::{
    Boundary, Facing, Geometry, Light, Material, Medium, Mesh, NO_PRIMITIVE, ReferenceOptions, Scene, ViewWalkOptions,
    ViewWalks, WalkStart, render_reference,
};
use glam::{Vec2, Vec3};

/// Squared difference of `values` (Σ_b α^n_b·h_b) from `truth` at an albedo, and at the best one.
fn best_albedo(exponents: &[f32], h: &[f32], truth: &[f32]) -> (f32, f64) {
    let bins = exponents.len();
    let cost = |albedo: f32| -> f64 {
        let powers: Vec<f32> = exponents.iter().map(|n| albedo.powf(*n)).collect();
        h.chunks_exact(bins)
            .zip(truth)
            .map(|(h, t)| {
                let value: f32 = h.iter().zip(&powers).map(|(h, p)| h * p).sum();
                f64::from(value - t).powi(2)
            })
            .sum()
    };
    // Golden sections in ln(1 − α).
    let (mut low, mut high) = ((1.0f32 - 0.05).ln(), (1.0f32 - 0.999).ln());
    let ratio = 0.618_034;
    for _ in 0..40 {
        let (a, b) = (high + (low - high) * ratio, low + (high - low) * ratio);
        if cost(1.0 - a.exp()) < cost(1.0 - b.exp()) { high = b } else { low = a }
    }
    let albedo = 1.0 - (0.5 * (low + high)).exp();
    (albedo, cost(albedo))
}

/// `[eq:view-walks]`: one walk for each σ_t, a search over the albedo in it, and the true medium is found.
#[test]
fn a_medium_is_found_from_pictures() {
    let geometry = Geometry::from_mesh(Mesh::icosphere(Vec3::ZERO, 1.0, 4)).unwrap();
    let truth = Medium { sigma_t: Vec3::splat(8.0), albedo: Vec3::new(0.98, 0.9, 0.6), g: 0.0, veins: None };
    let lights: Vec<Light> = [Vec3::new(0.3, 0.4, 1.0), Vec3::new(1.0, 0.3, -0.4)]
        .map(|d| Light::directional(d.normalize(), Vec3::ONE))
        .to_vec();
    let material = Material { medium: truth, boundary: Boundary::IndexMatched, coat: None };
    let scene = Scene { geometry: geometry.clone(), material, lights: lights.clone() };
    let side = 20;
    let pose = Pose::look_at(Vec3::new(0.2, 0.3, 4.0), Vec3::ZERO, Vec3::Y);
    let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.6, side, side), pose };
    let options = ReferenceOptions { samples: 256, seed: 5, ..Default::default() };
    let pictures = render_reference(&scene, &camera, &options).unwrap();
    // Pixels that are all object, each by the ray of its centre.
    let (mut starts, mut seen) = (Vec::new(), Vec::new());
    for i in (0..(side * side) as usize).filter(|i| pictures.coverage.data()[*i] >= 1.0) {
        let ray = camera.ray(Vec2::new((i % side as usize) as f32 + 0.5, (i / side as usize) as f32 + 0.5));
        let hit = geometry.closest_hit(ray.origin, ray.direction, f32::INFINITY, Facing::Entering, NO_PRIMITIVE);
        let hit = hit.unwrap();
        starts.push(WalkStart { position: hit.position, normal: hit.normal, direction: Some(-ray.direction) });
        seen.push(i);
    }
    assert!(starts.len() > 80, "{}", starts.len());
    let values = |c: usize| -> Vec<f32> {
        seen.iter().flat_map(|i| pictures.lights.iter().map(move |l| l.mean.data()[3 * i + c])).collect()
    };
    let truths = [0, 1, 2].map(values);
    let candidates = [4.0f32, 6.0, 8.0, 11.0, 16.0];
    let fits = candidates.map(|sigma_t| {
        let options = ViewWalkOptions { walks: 256, ..Default::default() };
        let walks =
            ViewWalks::trace(&geometry, sigma_t, 0.0, Boundary::IndexMatched, &starts, &options, &|_| ()).unwrap();
        let moments = walks.moments(&lights).unwrap();
        let each = [0, 1, 2].map(|c| best_albedo(&moments.exponents, &moments.values, &truths[c]));
        (Vec3::from(each.map(|e| e.0)), each.iter().map(|e| e.1).sum::<f64>())
    });
    let best = (0..5).min_by(|a, b| fits[*a].1.total_cmp(&fits[*b].1)).unwrap();
    assert_eq!(candidates[best], 8.0, "{fits:?}");
    let found = fits[best].0;
    // In 1 − α, which is what one sees of it; a ball of 8 mean free paths says little about the first.
    let off = ((Vec3::ONE - found) / (Vec3::ONE - truth.albedo) - 1.0).abs().max_element();
    assert!(off < 0.12, "{found}: {off}");
}
