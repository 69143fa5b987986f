//! The rasteriser and its pullback against the naive f64 oracle: values, the adjoint identity with cotangents on features,
//! opacity and depth, and every single derivative of a small scene.
mod raster_scene;

use diamond_splat::Cutoff;
use diamond_testkit::adjoint::{adjoint_gap, relative_l2};
use diamond_testkit::splat::rasterize_splats;
use diamond_testkit::{jvp, vjp};
use raster_scene::{Case, Random};

/// [eq:splat-blend], [eq:splat-alpha], [eq:ewa-projection]: pictures, hard and smooth.
#[test]
fn pictures_agree_with_the_oracle() {
    let mut worst: f64 = 0.0;
    for (seed, channels) in [(1, 1), (2, 3), (3, 5), (4, 14), (5, 24), (6, 0)] {
        for cutoff in [Cutoff::Hard, Cutoff::Smooth] {
            let case = Case::random(seed, 40, channels, cutoff);
            let expected = rasterize_splats(&case.parameters(), channels, &case.oracle_camera(), &case.rules());
            let found = case.render();
            for (i, (a, b)) in found.iter().zip(&expected).enumerate() {
                assert!((a - b).abs() < 2e-6 * (1.0 + b.abs()), "seed {seed} {cutoff:?} value {i}: {a} {b}");
                worst = worst.max((a - b).abs());
            }
            assert!(expected.iter().any(|v| v.abs() > 0.1), "an empty picture proves nothing");
        }
    }
    println!("pictures: worst absolute error {worst:.2e}");
}

/// [eq:splat-blend-pull], [eq:splat-footprint-pull]: ⟨ū, J·ẋ⟩ = ⟨Jᵀ·ū, ẋ⟩ for whole scenes.
#[test]
fn the_pullback_is_the_adjoint() {
    let mut worst: f64 = 0.0;
    for seed in 10..30 {
        for cutoff in [Cutoff::Smooth, Cutoff::Hard] {
            let channels = [1, 3, 14, 24][seed as usize % 4];
            let case = Case::random(seed, 60, channels, cutoff);
            let x = case.parameters();
            let mut random = Random(seed + 1000);
            let tangent: Vec<f64> = x.iter().map(|v| random.signed() * (0.05 + v.abs())).collect();
            let u = case.random_cotangent(&mut random);
            let (camera, rules) = (case.oracle_camera(), case.rules());
            let directional = jvp(|x| rasterize_splats(x, channels, &camera, &rules), &x, &tangent);
            let gap = adjoint_gap(&u, &directional, &case.pull(&u), &tangent);
            worst = worst.max(gap);
            assert!(gap < 1e-6, "seed {seed} {cutoff:?}: gap {gap:.2e}");
        }
    }
    println!("adjoint: worst gap {worst:.2e}");
}

/// Every derivative of a small scene, group by group.
#[test]
fn every_derivative_agrees_with_dual_numbers() {
    let mut worst = [0.0f64; 5];
    for seed in 40..46 {
        let channels = 3;
        let case = Case::random(seed, 12, channels, if seed % 2 == 0 { Cutoff::Smooth } else { Cutoff::Hard });
        let u = case.random_cotangent(&mut Random(seed));
        let (camera, rules) = (case.oracle_camera(), case.rules());
        let expected = vjp(|x| rasterize_splats(x, channels, &camera, &rules), &case.parameters(), &u);
        let found = case.pull(&u);
        for (k, range) in [0..3, 3..6, 6..10, 10..11, 11..14].into_iter().enumerate() {
            let pick = |all: &[f64]| -> Vec<f64> { all.chunks(14).flat_map(|g| g[range.clone()].to_vec()).collect() };
            let error = relative_l2(&pick(&found), &pick(&expected), 1e-12);
            worst[k] = worst[k].max(error);
            assert!(error < 5e-6, "seed {seed} group {k}: {error:.2e}");
        }
    }
    println!("mean, scale, rotation, opacity, features: worst relative L2 {worst:?}");
}

/// The harness must notice a gradient that is off by a hundredth in one group, and a value that is off by 1e-4.
#[test]
fn the_harness_notices_broken_gradients() {
    let case = Case::random(77, 60, 3, Cutoff::Smooth);
    let x = case.parameters();
    let mut random = Random(5);
    let tangent: Vec<f64> = x.iter().map(|v| random.signed() * (0.05 + v.abs())).collect();
    let u = case.random_cotangent(&mut random);
    let (camera, rules) = (case.oracle_camera(), case.rules());
    let directional = jvp(|x| rasterize_splats(x, 3, &camera, &rules), &x, &tangent);
    let gradient = case.pull(&u);
    assert!(adjoint_gap(&u, &directional, &gradient, &tangent) < 1e-6);
    for group in [0..3, 3..6, 6..10, 10..11, 11..14] {
        let mut broken = gradient.clone();
        broken.chunks_mut(14).for_each(|g| g[group.clone()].iter_mut().for_each(|v| *v *= 1.01));
        let gap = adjoint_gap(&u, &directional, &broken, &tangent);
        assert!(gap > 1e-6, "group {group:?} scaled by 1.01 went unnoticed: {gap:.2e}");
    }
}
