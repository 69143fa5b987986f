//! View walks: against the path tracer pixel for pixel, and their laws.
use super::*;
use crate::{Light, Material, Medium, Mesh, PathOptions, Rng, Scene, Tracer};

const ROUGH: Boundary = Boundary::Rough { eta: 1.4, alpha: 0.5 };

fn lamps() -> Vec<Light> {
    [Vec3::new(0.2, 0.4, 1.0), Vec3::new(1.0, 0.1, -0.2), Vec3::new(0.2, 0.5, -1.0)]
        .map(|d| Light::directional(d.normalize(), Vec3::ONE))
        .to_vec()
}

fn ball() -> Geometry {
    let mut mesh = Mesh::icosphere(Vec3::ZERO, 1.0, 4);
    mesh.normals = None;
    Geometry::from_mesh(mesh).unwrap()
}

/// Radiance by the path tracer and its standard error, without what a black object shows.
fn traced(geometry: &Geometry, medium: Medium, boundary: Boundary, start: &WalkStart, paths: u32) -> Vec<(f64, f64)> {
    let estimate = |medium: Medium| {
        let material = Material { medium, boundary, coat: None };
        let scene = Scene { geometry: geometry.clone(), material, lights: lamps() };
        let tracer = Tracer::new(&scene, PathOptions::default()).unwrap();
        let mut rng = Rng::new(77, 0);
        let mut out = vec![Vec3::ZERO; 3];
        let mut sums = [(0.0f64, 0.0f64); 3];
        let direction = start.direction.unwrap();
        for _ in 0..paths {
            tracer.trace(start.position + direction * 3.0, -direction, false, &mut rng, &mut out);
            for (sum, v) in sums.iter_mut().zip(&out) {
                sum.0 += f64::from(v.x);
                sum.1 += f64::from(v.x) * f64::from(v.x);
            }
        }
        let n = f64::from(paths);
        sums.map(|(s, q)| (s / n, (q / n - s / n * (s / n)).max(0.0) / n))
    };
    let (all, black) = (estimate(medium), estimate(Medium { albedo: Vec3::ZERO, ..medium }));
    all.iter().zip(&black).map(|(a, b)| (a.0 - b.0, (a.1 + b.1).sqrt())).collect()
}

/// `[eq:view-walks]`: what the path tracer sees, in every direction, from all lamps, at several albedos of the same walks.
#[test]
fn radiance_is_that_of_the_path_tracer() {
    let geometry = ball();
    for (sigma_t, g, boundary, tolerance) in
        [(8.0, 0.0, Boundary::IndexMatched, 0.02), (3.0, 0.7, Boundary::IndexMatched, 0.02), (8.0, 0.3, ROUGH, 0.06)]
    {
        let position = geometry
            .closest_hit(Vec3::new(0.2, 0.3, 3.0), Vec3::NEG_Z, 9.0, crate::Facing::Entering, crate::NO_PRIMITIVE)
            .unwrap();
        let toward = |d: Vec3| WalkStart {
            position: position.position,
            normal: position.normal,
            direction: Some(d.normalize()),
        };
        let starts = [toward(Vec3::Z), toward(Vec3::new(1.0, -0.3, 0.3))];
        let options = ViewWalkOptions { walks: 60_000, ..Default::default() };
        let walks = ViewWalks::trace(&geometry, sigma_t, g, boundary, &starts, &options, &|_| ()).unwrap();
        let moments = walks.moments(&lamps()).unwrap();
        for albedo in [0.6f32, 0.95] {
            let found = moments.radiance(albedo);
            for (s, start) in starts.iter().enumerate() {
                let truth = traced(&geometry, Medium::gray(sigma_t, albedo, g), boundary, start, 60_000);
                let largest = truth.iter().map(|t| t.0).fold(0.0, f64::max);
                for (l, (mean, noise)) in truth.iter().enumerate() {
                    let value = f64::from(found[3 * s + l]);
                    // Walks are about as noisy as paths.
                    let allowed = tolerance * mean + 6.0 * noise + 2e-3 * largest;
                    assert!((value - mean).abs() < allowed, "{boundary:?} {albedo} {s} {l}: {value} {mean} ± {noise}");
                    assert!(*noise < 0.05 * mean + 0.01 * largest, "{noise} of {mean} says nothing");
                }
            }
        }
    }
}

#[test]
fn laws() {
    let geometry = ball();
    let start = |z: f32, direction| WalkStart {
        position: Vec3::new((1.0 - z * z).sqrt(), 0.0, z) * 0.995,
        normal: Vec3::new((1.0 - z * z).sqrt(), 0.0, z),
        direction,
    };
    let starts: Vec<WalkStart> = (0..20).map(|k| start(0.9 - 0.09 * k as f32, None)).collect();
    for boundary in [Boundary::IndexMatched, ROUGH] {
        let options = ViewWalkOptions { walks: 60, entrances: 500, ..Default::default() };
        let one = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let walks = ViewWalks::trace(&geometry, 6.0, 0.2, boundary, &starts, &options, &|_| ()).unwrap();
                assert!(walks.bytes() > 0 && walks.lost_by_cutting(0.999) == 0.0);
                walks.moments(&lamps()).unwrap()
            })
        };
        let moments = one(1);
        assert_eq!(moments, one(3));
        assert_eq!(moments.values.len(), 20 * 3 * moments.exponents.len());
        assert!(moments.radiance(0.0).iter().all(|v| *v == 0.0));
        let total = |albedo: f32| moments.radiance(albedo).iter().sum::<f32>();
        assert!(total(0.5) > 0.0 && total(0.9) > total(0.5) && total(1.0) > total(0.9));
        // One lamp alone is what it is among others.
        let walks = ViewWalks::trace(&geometry, 6.0, 0.2, boundary, &starts, &options, &|_| ()).unwrap();
        let alone = walks.moments(&lamps()[1..2]).unwrap().radiance(0.8);
        let all: Vec<f32> = moments.radiance(0.8).into_iter().skip(1).step_by(3).collect();
        assert_eq!(alone, all);
        assert!(walks.moments(&[]).unwrap().values.is_empty());
        assert!(walks.moments(&[Light::point(Vec3::splat(0.1), Vec3::ONE)]).is_err());
        assert!(walks.moments(&[Light::disc_towards(Vec3::ZERO, Vec3::Z * 3.0, 0.1, Vec3::ONE)]).is_err());
    }
    let trace = |sigma_t: f32, start: WalkStart, options: ViewWalkOptions| {
        ViewWalks::trace(&geometry, sigma_t, 0.0, ROUGH, &[start], &options, &|_| ()).map(|_| ())
    };
    let good = ViewWalkOptions { walks: 2, entrances: 50, ..Default::default() };
    assert!(trace(1.0, start(0.5, None), good).is_ok());
    assert!(trace(f32::NAN, start(0.5, None), good).is_err());
    assert!(trace(1.0, start(0.5, Some(Vec3::ZERO)), good).is_err());
    assert!(trace(1.0, start(f32::NAN, None), good).is_err());
    assert!(trace(1.0, start(0.5, None), ViewWalkOptions { connections: 0.0, ..good }).is_err());
    let slab = Geometry::Slab { bottom: 0.0, top: 1.0 };
    assert!(ViewWalks::trace(&slab, 1.0, 0.0, ROUGH, &[start(0.5, None)], &good, &|_| ()).is_err());
}
