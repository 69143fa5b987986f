//! Samplers against the densities that they claim, by Pearson's χ² over the sphere.
use diamond_pathtrace::sampling::*;
use diamond_pathtrace::*;
use glam::Vec3;
use std::f64::consts::TAU;

const RINGS: usize = 20;
const SECTORS: usize = 20;

fn cell(d: Vec3) -> usize {
    let ring = ((0.5 * (1.0 + d.z) * RINGS as f32) as usize).min(RINGS - 1);
    let phi = d.y.atan2(d.x).rem_euclid(TAU as f32);
    ring * SECTORS + ((phi / TAU as f32 * SECTORS as f32) as usize).min(SECTORS - 1)
}

/// How many standard deviations the χ² of `samples` (with `None` for what was absorbed) lies above its mean, by the
/// Wilson–Hilferty transform. Cells with less than five expected samples are pooled.
fn chi_squared(samples: u32, mut sample: impl FnMut(&mut Rng) -> Option<Vec3>, pdf: impl Fn(Vec3) -> f64) -> f64 {
    let mut rng = Rng::new(21, 4);
    let mut counts = vec![0.0f64; RINGS * SECTORS];
    let mut absorbed = 0.0;
    for _ in 0..samples {
        match sample(&mut rng) {
            Some(d) => counts[cell(d)] += 1.0,
            None => absorbed += 1.0,
        }
    }
    // Midpoint rule in (z, φ), in which solid angle is uniform.
    // Lobes about the poles are much narrower in z than in φ.
    let (fine, finer) = (10, 300);
    let mut expected = vec![0.0f64; RINGS * SECTORS];
    let (rows, columns) = (RINGS * finer, SECTORS * fine);
    for i in 0..rows {
        let z = -1.0 + 2.0 * (i as f64 + 0.5) / rows as f64;
        let r = (1.0 - z * z).sqrt();
        for j in 0..columns {
            let phi = TAU * (j as f64 + 0.5) / columns as f64;
            let d = Vec3::new((r * phi.cos()) as f32, (r * phi.sin()) as f32, z as f32);
            expected[i / finer * SECTORS + j / fine] += pdf(d) * 2.0 * TAU / (rows * columns) as f64;
        }
    }
    let n = f64::from(samples);
    let total: f64 = expected.iter().sum();
    let (mut statistic, mut cells) = (0.0, -1.0);
    let mut pool = (absorbed, (1.0 - total).max(0.0) * n);
    for (count, expected) in counts.iter().zip(&expected) {
        if expected * n < 5.0 {
            pool = (pool.0 + count, pool.1 + expected * n);
        } else {
            statistic += (count - expected * n).powi(2) / (expected * n);
            cells += 1.0;
        }
    }
    if pool.1 >= 5.0 {
        statistic += (pool.0 - pool.1).powi(2) / pool.1;
        cells += 1.0;
    } else {
        // Too few to be tested, but they may not be many.
        assert!(pool.0 < 30.0, "{pool:?}");
    }
    let k: f64 = cells;
    ((statistic / k).cbrt() - (1.0 - 2.0 / (9.0 * k))) / (2.0 / (9.0 * k)).sqrt()
}

/// `[eq:uniform-sphere]` `[eq:cosine-hemisphere]`
#[test]
fn uniform_and_cosine_directions() {
    let z = chi_squared(200_000, |rng| Some(uniform_sphere(rng)), |_| f64::from(UNIFORM_SPHERE_PDF));
    assert!(z < 4.0, "{z}");
    let z = chi_squared(200_000, |rng| Some(cosine_hemisphere(rng)), |d| f64::from(cosine_hemisphere_pdf(d.z)));
    assert!(z < 4.0, "{z}");
}

/// `[eq:henyey-greenstein]`, and its mean cosine at every g, up to ±0.99.
#[test]
fn henyey_greenstein_directions() {
    for g in [-0.6, -0.1, 0.0, 0.3, 0.75, 0.85] {
        let from = Vec3::new(0.48, -0.6, 0.64);
        let z = chi_squared(
            200_000,
            |rng| Some(sample_henyey_greenstein(g, from, rng)),
            |d| f64::from(henyey_greenstein(g, from, d)),
        );
        assert!(z < 4.0, "g {g}: {z}");
    }
    for g in [-0.99f32, -0.5, 0.5, 0.99, 0.999] {
        let (mut rng, n) = (Rng::new(1, 1), 200_000);
        let from = Vec3::new(0.0, 0.6, 0.8);
        let cosines: Vec<f64> =
            (0..n).map(|_| f64::from(from.dot(sample_henyey_greenstein(g, from, &mut rng)))).collect();
        let mean = cosines.iter().sum::<f64>() / f64::from(n);
        let spread = cosines.iter().map(|c| (c - mean).powi(2)).sum::<f64>() / f64::from(n);
        let error = (spread / f64::from(n)).sqrt();
        assert!((mean - f64::from(g)).abs() < 4.0 * error + 1e-6, "g {g}: {mean} ± {error}");
    }
}

/// A view at each of some angles from the normal; grazing where the lobe is wide enough for the rule of integration.
fn views(alpha: f32) -> impl Iterator<Item = Vec3> {
    let grazing = if alpha < 0.55 { 0.3 } else { 0.03 };
    [1.0f32, 0.7, grazing].into_iter().map(|z| Vec3::new(0.6, 0.8, 0.0) * (1.0 - z * z).sqrt() + Vec3::Z * z)
}

/// `[eq:ggx-visible-normals]` `[eq:ggx-distribution]` `[eq:ggx-masking]`
#[test]
fn visible_normals() {
    for alpha in [0.15, 0.4, 1.0] {
        for v in views(alpha) {
            let z = chi_squared(
                200_000,
                |rng| Some(ggx::sample_visible_normal(alpha, v, rng)),
                |h| f64::from(ggx::visible_normal_pdf(alpha, v, h)),
            );
            assert!(z < 4.0, "alpha {alpha}, {v}: {z}");
        }
    }
}

/// `[eq:rough-dielectric]`: reflection and refraction, from both sides, into the denser and into the thinner medium; weights
/// are the scattering function over the density.
#[test]
fn rough_dielectric_directions() {
    for (eta, alpha) in [(1.3f32, 0.3), (1.5, 0.6), (0.7, 0.4)] {
        let boundary = Boundary::Rough { eta, alpha };
        for v in views(alpha).flat_map(|v| [v, v * Vec3::new(1.0, 1.0, -1.0)]) {
            let mut worst = 0.0f32;
            let z = chi_squared(
                200_000,
                |rng| {
                    let s = boundary.sample(v, Vec3::Z, rng)?;
                    let (value, pdf) = boundary.evaluate(v, s.direction, Vec3::Z);
                    // Both ways of computing the same numbers; near the critical angle f32 loses the more.
                    if pdf > 1e-3 && v.z.abs() > 0.1 {
                        worst = worst.max((value / pdf / s.weight - 1.0).abs());
                    }
                    Some(s.direction)
                },
                |d| f64::from(boundary.evaluate(v, d, Vec3::Z).1),
            );
            assert!(z < 4.0, "eta {eta}, alpha {alpha}, {v}: {z}");
            assert!(worst < 1e-3, "eta {eta}, alpha {alpha}, {v}: {worst}");
        }
    }
}

/// `[eq:rough-dielectric]`: light that goes the other way meets the same function, but for the squared index of refraction.
#[test]
fn rough_dielectrics_are_reciprocal() {
    let boundary = Boundary::Rough { eta: 1.4, alpha: 0.5 };
    let mut rng = Rng::new(8, 8);
    let mut compared = 0;
    for _ in 0..10_000 {
        let (a, b) = (uniform_sphere(&mut rng), uniform_sphere(&mut rng));
        let (forward, backward) = (boundary.evaluate(a, b, Vec3::Z).0, boundary.evaluate(b, a, Vec3::Z).0);
        // f·|cos of the other|: divide it out. n² of the side where light leaves.
        let index = |d: Vec3| if d.z > 0.0 { 1.0 } else { 1.4f32 * 1.4 };
        let (f, g) = (forward / b.z.abs() * index(b), backward / a.z.abs() * index(a));
        if a.z.abs() > 0.05 && b.z.abs() > 0.05 && f > 1e-4 {
            // Near the critical angle f32 half vectors cancel.
            assert!((f - g).abs() < 1e-2 * f, "{a} {b}: {f} {g}");
            compared += 1;
        }
    }
    assert!(compared > 2000);
}

/// `[eq:coat]`
#[test]
fn coat_directions() {
    for roughness in [0.4, 0.8] {
        let coat = Coat { roughness, f0: Vec3::splat(0.04) };
        for v in views(coat.alpha()) {
            let z = chi_squared(
                200_000,
                |rng| {
                    let (d, weight, pdf) = coat.sample(v, Vec3::Z, rng)?;
                    let (value, again) = coat.evaluate(v, d, Vec3::Z);
                    if pdf > 1e-2 && v.z > 0.1 && d.z > 0.02 {
                        assert!((pdf / again - 1.0).abs() < 1e-3, "{v} {d}");
                        assert!((value.x - weight.x * pdf).abs() < 1e-3 * value.x, "{v} {d}");
                    }
                    Some(d)
                },
                |d| f64::from(coat.evaluate(v, d, Vec3::Z).1),
            );
            assert!(z < 4.0, "roughness {roughness}, {v}: {z}");
        }
    }
}

/// `[eq:balance-heuristic]`: the weights of all ways to draw a sample add up to 1.
#[test]
fn weights_add_up_to_one() {
    for (a, b) in [(1.0, 3.0), (1e-20, 1e20), (f32::INFINITY, 2.0), (0.0, 1.0)] {
        let sum = balance_heuristic(a, b) + if a == f32::INFINITY { 0.0 } else { balance_heuristic(b, a) };
        assert!((sum - 1.0).abs() < 1e-6);
    }
    assert_eq!(balance_heuristic(0.0, 0.0), 0.0);
}

/// The harness notices a density that is off by 3 %, and one that is turned by two degrees.
#[test]
fn a_wrong_density_is_noticed() {
    let from = Vec3::Z;
    let wrong = |d: Vec3| f64::from(henyey_greenstein(0.6, from, d));
    assert!(chi_squared(200_000, |rng| Some(sample_henyey_greenstein(0.62, from, rng)), wrong) > 6.0);
    let turned = Vec3::new(0.035, 0.0, 1.0).normalize();
    assert!(chi_squared(200_000, |rng| Some(sample_henyey_greenstein(0.6, turned, rng)), wrong) > 6.0);
}

/// `[eq:transmittance]` `[eq:spectral-flight]`: whichever channel a flight is drawn for, each channel loses what it should and
/// is scattered with its albedo.
#[test]
fn chromatic_flights_keep_every_channel() {
    let medium = Medium { sigma_t: Vec3::new(0.5, 2.0, 8.0), albedo: Vec3::new(0.9, 0.5, 1.0), g: 0.0, veins: None };
    let throughput = Vec3::new(0.2, 1.0, 0.7);
    let (mut rng, n) = (Rng::new(2, 7), 400_000);
    let mut passed = [0; 2].map(|_| (Vec3::ZERO.as_dvec3(), Vec3::ZERO.as_dvec3()));
    for _ in 0..n {
        let flight = medium.fly(throughput, &mut rng);
        let (k, weight) = match medium.arrive(flight, 0.4) {
            Flight::Scattered { weight, .. } => (0, weight.as_dvec3()),
            Flight::Passed { weight } => (1, weight.as_dvec3()),
        };
        passed[k].0 += weight;
        passed[k].1 += weight * weight;
    }
    let left = medium.transmittance(0.4);
    assert!((left - (-medium.sigma_t * 0.4).exp()).abs().max_element() < 1e-6);
    for ((sum, square), expected) in passed.into_iter().zip([medium.albedo * (Vec3::ONE - left), left]) {
        let mean = sum / f64::from(n);
        let error = ((square / f64::from(n) - mean * mean) / f64::from(n)).map(f64::sqrt);
        let off = (mean - expected.as_dvec3()).abs();
        assert!(off.cmple(4.0 * error).all(), "{mean} {expected} {error}");
    }
}

/// ⟨r²⟩ after n flights of mean free path 1 is 2n + 2 Σ (n − k) gᵏ.
#[test]
fn random_walks_spread_as_they_should() {
    for (g, n, expected) in [(0.0f32, 5, 10.0f64), (0.5, 5, 16.125), (0.9, 20, 241.883_797_8)] {
        let (mut rng, walks) = (Rng::new(3, 3), 200_000);
        let medium = Medium::gray(1.0, 1.0, g);
        let (mut sum, mut square) = (0.0, 0.0);
        for _ in 0..walks {
            let (mut p, mut d) = (Vec3::ZERO, Vec3::Z);
            for k in 0..n {
                if k > 0 {
                    d = sample_henyey_greenstein(g, d, &mut rng);
                }
                p += d * medium.fly(Vec3::ONE, &mut rng).distance;
            }
            let r2 = f64::from(p.length_squared());
            sum += r2;
            square += r2 * r2;
        }
        let mean = sum / f64::from(walks);
        let error = ((square / f64::from(walks) - mean * mean) / f64::from(walks)).sqrt();
        assert!((mean - expected).abs() < 4.0 * error, "g {g}, n {n}: {mean} ± {error}, {expected}");
    }
}
