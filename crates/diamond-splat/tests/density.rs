//! Density control: what is cloned, split and pruned, and that a new set follows from the plan alone.
use diamond_splat::density::{
    DensityConfig, DensityPlan, DensityStats, Origin, OriginKind, plan, reset_opacity, reset_opacity_logit, split_child,
};
use diamond_splat::{Gaussians, SplatError};
use glam::{DQuat, DVec3, Quat, Vec2, Vec3};
use proptest::prelude::*;

const EXTENT: f32 = 10.0;

/// Gaussians with a largest scale, an opacity, a mean gradient and a screen radius each.
fn scene(rows: &[(f32, f32, f32, f32)]) -> (Gaussians, DensityStats) {
    let mut gaussians = Gaussians::default();
    let mut stats = DensityStats::new(rows.len());
    for (i, &(scale, opacity, gradient, radius)) in rows.iter().enumerate() {
        gaussians.push(Vec3::splat(i as f32), Vec3::new(0.1 * scale, scale, 0.5 * scale), Quat::IDENTITY, opacity);
        (stats.gradient_sum[i], stats.views[i], stats.max_radius[i]) = (4.0 * gradient, 4, radius);
    }
    (gaussians, stats)
}

fn kinds(plan: &DensityPlan) -> Vec<(u32, OriginKind)> {
    plan.origins.iter().map(|&Origin { source, kind }| (source, kind)).collect()
}

use OriginKind::{Clone as Cloned, Kept, SplitChild};

#[test]
fn each_rule_takes_its_gaussians() {
    let rows = [
        (0.05, 0.5, 1e-4, 5.0),          // calm
        (0.05, 0.5, 3e-4, 5.0),          // small and pulled: cloned
        (0.20, 0.5, 3e-4, 5.0),          // large and pulled: split
        (0.05, 0.004, 9e-4, 5.),         // transparent
        (0.01 * EXTENT, 0.5, 2e-4, 5.0), // at both thresholds: cloned
        (2.00, 0.5, 0.0, 50.0),          // huge, kept without limits
        (0.05, 0.5, 3e-4, 50.0),         // small, pulled, large on screen
        (0.20, 0.5, 3e-4, 50.0),         // large, pulled, large on screen
        (2.00, 0.5, 3e-4, 50.0),         // huge and pulled
    ];
    let (gaussians, stats) = scene(&rows);
    let free = plan(&gaussians, &stats, &DensityConfig::default(), EXTENT).unwrap();
    let expected = [
        (0, Kept),
        (1, Kept),
        (4, Kept),
        (5, Kept),
        (6, Kept),
        (1, Cloned),
        (4, Cloned),
        (6, Cloned),
        (2, SplitChild),
        (2, SplitChild),
        (7, SplitChild),
        (7, SplitChild),
        (8, SplitChild),
        (8, SplitChild),
    ];
    assert_eq!(kinds(&free), expected);
    assert_eq!((free.cloned, free.split, free.pruned), (3, 3, 1));
    // With limits: 5 and 6 go; 7 is split instead; the children of 8 would be too large still.
    let config =
        DensityConfig { max_screen_radius: Some(20.0), max_world_scale: Some(0.1), ..DensityConfig::default() };
    let limited = plan(&gaussians, &stats, &config, EXTENT).unwrap();
    let expected = [
        (0, Kept),
        (1, Kept),
        (4, Kept),
        (1, Cloned),
        (4, Cloned),
        (2, SplitChild),
        (2, SplitChild),
        (7, SplitChild),
        (7, SplitChild),
    ];
    assert_eq!(kinds(&limited), expected);
    assert_eq!((limited.cloned, limited.split, limited.pruned), (2, 2, 4));
}

#[test]
fn where_room_is_short_the_largest_gradients_win() {
    let rows = [
        (0.05, 0.5, 3e-4, 1.0),
        (0.05, 0.5, 5e-4, 1.0),
        (0.2, 0.5, 5e-4, 1.0),
        (0.2, 0.5, 4e-4, 1.0),
        (0.05, 0.0, 9e-4, 1.0),
    ];
    let (gaussians, stats) = scene(&rows);
    let with = |max| {
        let config = DensityConfig { max_gaussians: Some(max), ..DensityConfig::default() };
        kinds(&plan(&gaussians, &stats, &config, EXTENT).unwrap())
    };
    let kept = [(0, Kept), (1, Kept), (2, Kept), (3, Kept)];
    assert_eq!(with(0), kept);
    assert_eq!(with(4), kept);
    assert_eq!(with(5), [(0, Kept), (1, Kept), (2, Kept), (3, Kept), (1, Cloned)]);
    assert_eq!(with(6), [(0, Kept), (1, Kept), (3, Kept), (1, Cloned), (2, SplitChild), (2, SplitChild)]);
    assert_eq!(with(8).len(), 8);
    assert_eq!(with(8), with(1000));
}

#[test]
fn diverged_gaussians_are_pruned_and_bad_shapes_refused() {
    let (mut gaussians, mut stats) = scene(&[(0.05, 0.5, 3e-4, 1.0); 6]);
    gaussians.means[0].x = f32::NAN;
    gaussians.scales[1].y = f32::INFINITY;
    gaussians.rotations[2] = Quat::from_xyzw(f32::NAN, 0.0, 0.0, 1.0);
    gaussians.opacities[3] = f32::NAN;
    stats.views[4] = 0;
    let plan_now = |g: &Gaussians, s: &DensityStats| plan(g, s, &DensityConfig::default(), EXTENT);
    assert_eq!(kinds(&plan_now(&gaussians, &stats).unwrap()), [(4, Kept), (5, Kept), (5, Cloned)]);
    assert!(matches!(plan_now(&gaussians, &DensityStats::new(5)), Err(SplatError::Shape { .. })));
    gaussians.opacities.pop();
    assert!(matches!(plan_now(&gaussians, &stats), Err(SplatError::Shape { .. })));
    assert!(stats.record(&[Vec2::ZERO], &[1.0], 8, 8).is_err());
    assert_eq!(plan_now(&Gaussians::default(), &DensityStats::default()).unwrap(), DensityPlan::default());
}

/// [eq:density-gradient] The same picture at twice the resolution has half the gradient per pixel.
#[test]
fn gradients_are_counted_per_normalised_device_unit() {
    let mut stats = DensityStats::new(3);
    let gradients = [Vec2::new(3e-3, 0.0), Vec2::new(0.0, 4e-3), Vec2::new(f32::NAN, 0.0)];
    stats.record(&gradients, &[2.0, 0.0, 1.0], 200, 100).unwrap();
    stats.record(&[Vec2::new(3e-3, 4e-3); 3], &[1.0, 7.0, 1.0], 200, 100).unwrap();
    let both = Vec2::new(0.3, 0.2).length();
    for (i, expected) in [(0.3 + both) / 2.0, both, both / 2.0].into_iter().enumerate() {
        assert!((stats.mean_gradient(i) - expected).abs() < 1e-6);
    }
    assert_eq!((&stats.views[..], &stats.max_radius[..]), (&[2, 1, 2][..], &[2.0, 7.0, 1.0][..]));
    let mut fine = DensityStats::new(3);
    fine.record(&gradients.map(|g| g / 2.0), &[2.0, 0.0, 1.0], 400, 200).unwrap();
    assert!((fine.mean_gradient(0) - 0.3).abs() < 1e-6);
    assert_eq!(DensityStats::new(1).mean_gradient(0), 0.0);
}

/// [eq:opacity-reset]
#[test]
fn a_reset_only_lowers() {
    let sigmoid = |v: f32| 1.0 / (1.0 + (-v).exp());
    for logit in [-20.0, -5.0, -4.0, 0.0, 3.0, 40.0] {
        let reset = reset_opacity_logit(logit, 0.01);
        assert!((sigmoid(reset) - reset_opacity(sigmoid(logit), 0.01)).abs() < 1e-8);
        assert!(reset <= logit);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 128, failure_persistence: None, ..ProptestConfig::default() })]

    /// [eq:density-split] in f64.
    #[test]
    fn children_are_samples_of_their_parent(
        mean in [-5.0f32..5.0, -5.0f32..5.0, -5.0f32..5.0],
        scale in [1e-3f32..2.0, 1e-3f32..2.0, 1e-3f32..2.0],
        q in [-2.0f32..2.0, -2.0f32..2.0, -2.0f32..2.0, -2.0f32..2.0],
        z in [-3.0f32..3.0, -3.0f32..3.0, -3.0f32..3.0],
    ) {
        let rotation = Quat::from_array(q);
        prop_assume!(rotation.length() > 0.05);
        let (child, child_scale) = split_child(mean.into(), scale.into(), rotation, z.into(), 1.6);
        let r = DQuat::from_array(q.map(f64::from)).normalize();
        let expected = DVec3::from(mean.map(f64::from)) + r * DVec3::from_array(std::array::from_fn(|i| scale[i] as f64 * z[i] as f64));
        prop_assert!((child.as_dvec3() - expected).length() < 1e-5);
        prop_assert!((child_scale * 1.6 - Vec3::from(scale)).length() < 1e-6);
    }

    #[test]
    fn plans_are_consistent(
        rows in prop::collection::vec((0.0f32..2.0, 0.0f32..0.05, 0.0f32..6e-4, 0.0f32..40.0), 0..60),
        max in prop::option::of(0usize..100),
        screen in prop::option::of(5.0f32..40.0),
        world in prop::option::of(0.01f32..0.2),
    ) {
        let (gaussians, stats) = scene(&rows);
        let config = DensityConfig { max_gaussians: max, max_screen_radius: screen, max_world_scale: world, ..DensityConfig::default() };
        let p = plan(&gaussians, &stats, &config, EXTENT).unwrap();
        let count = |kind| p.origins.iter().filter(|o| o.kind == kind).count();
        prop_assert_eq!((count(Cloned), count(SplitChild)), (p.cloned, 2 * p.split));
        prop_assert_eq!(count(Kept) + p.split + p.pruned, rows.len());
        // Growth respects the limit; pruning alone never depends on it.
        let grown = p.cloned + p.split;
        if let Some(max) = max { prop_assert!(grown == 0 || p.origins.len() <= max); }
        for o in &p.origins {
            let (scale, opacity, _, radius) = rows[o.source as usize];
            prop_assert!(opacity >= config.prune_opacity);
            let final_scale = if o.kind == SplitChild { scale / 1.6 } else { scale };
            prop_assert!(world.is_none_or(|w| final_scale <= w * EXTENT));
            prop_assert!(o.kind == SplitChild || screen.is_none_or(|s| radius <= s));
        }
        // Each group is in order of the source, and a clone's source is kept.
        for kind in [Kept, Cloned] {
            let sources: Vec<u32> = p.origins.iter().filter(|o| o.kind == kind).map(|o| o.source).collect();
            prop_assert!(sources.windows(2).all(|w| w[0] < w[1]));
        }
        for o in p.origins.iter().filter(|o| o.kind == Cloned) {
            let source = Origin { kind: Kept, ..*o };
            prop_assert!(p.origins.contains(&source));
        }
    }
}
