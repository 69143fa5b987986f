//! What must hold whatever the scene: agreement costs nothing, disagreement costs more the larger it is, what cannot be
//! compared costs nothing and pulls at nothing, and finite inputs give finite outputs.
//!
//! That the terms do not depend on light needs no test: no type of this crate holds radiance.
use diamond_camera::{Camera, Depth, Intrinsics, Pose};
use diamond_consistency::*;
use diamond_image::Image;
use diamond_testkit::strategies::{extreme, finite, values};
use glam::{Mat3, Vec2, Vec3};
use proptest::prelude::*;

const RANGE: DepthRange = DepthRange { near: 1.0, far: 5.0 };

fn camera(direction: Vec3, distance: f32, size: u32) -> Camera {
    let pose = Pose::look_at(distance * direction.normalize(), Vec3::ZERO, Vec3::Z);
    Camera { intrinsics: Intrinsics::from_fov_x(0.9, size, size), pose }
}

/// A picture of z (or distance) and the silhouette of whatever `hit` gives the distance along a ray to.
fn look(camera: &Camera, kind: DepthKind, hit: impl Fn(Vec3, Vec3) -> Option<f32>) -> (Image, DepthMap) {
    let k = &camera.intrinsics;
    let (w, h) = (k.width as usize, k.height as usize);
    let (mut silhouette, mut map) = (Image::new(w, h, 1), DepthMap::unknown(kind, w, h));
    for i in 0..w * h {
        let pixel = Vec2::new((i % w) as f32 + 0.5, (i / w) as f32 + 0.5);
        let ray = camera.ray(pixel);
        if let Some(distance) = hit(ray.origin, ray.direction) {
            silhouette.data_mut()[i] = 1.0;
            map.values.data_mut()[i] = match kind {
                DepthKind::Z => camera.to_z(pixel, Depth::Distance(distance)),
                DepthKind::Distance => distance,
            };
        }
    }
    (silhouette, map)
}

fn plane(normal: Vec3) -> impl Fn(Vec3, Vec3) -> Option<f32> {
    move |o, d| {
        // In f64, so that what is left is the code's rounding and not the picture's.
        let (n, o, d) = (normal.as_dvec3(), o.as_dvec3(), d.as_dvec3());
        let t = -n.dot(o) / n.dot(d);
        (t > 0.0).then_some(t as f32)
    }
}

fn sphere(radius: f64) -> impl Fn(Vec3, Vec3) -> Option<f32> {
    move |o, d| {
        let (o, d) = (o.as_dvec3(), d.as_dvec3().normalize());
        let b = o.dot(d);
        let under = b * b - o.length_squared() + radius * radius;
        (under > 0.0).then(|| (-b - under.sqrt()) as f32)
    }
}

type Seen = (Image, DepthMap);

fn compare(cameras: [&Camera; 2], seen: [&Seen; 2], options: &ConsistencyOptions) -> (PairValue, PairGrad) {
    let view = |k: usize| ViewGeometry {
        camera: cameras[k],
        silhouette: &seen[k].0,
        depth: DepthSource::Given(&seen[k].1),
        mask: None,
    };
    let pixels = draw_pixels(&view(0), options, 4096, 1);
    let (value, pullback) = pair_consistency(&view(0), &view(1), &pixels, options).unwrap();
    (value, pullback.pull(&PairValueGrad { silhouette: 1.0, depth: 1.0 }))
}

fn all_options() -> Vec<ConsistencyOptions> {
    let mut all = Vec::new();
    for penalty in [SilhouettePenalty::Bce, SilhouettePenalty::L1] {
        for depth_kind in [DepthKind::Z, DepthKind::Distance] {
            all.push(ConsistencyOptions { penalty, depth_kind, ..ConsistencyOptions::new(RANGE) });
        }
    }
    all
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// [eq:depth-sampling] A plane in any position, seen by any two cameras, in both kinds of depth and stored in both.
    #[test]
    fn planes_cost_nothing(
        n in [finite(-0.5..0.5), finite(-0.5..0.5)], a in [finite(-0.6..0.6), finite(-0.6..0.6)],
        b in [finite(-0.6..0.6), finite(-0.6..0.6)], r in [finite(2.5..3.5), finite(2.5..3.5)],
        stored in any::<[bool; 2]>(),
    ) {
        let normal = Vec3::new(n[0], n[1], 1.0).normalize();
        let cameras = [camera(Vec3::new(a[0], a[1], 1.0), r[0], 64), camera(Vec3::new(b[0], b[1], 1.0), r[1], 48)];
        let kind = |d: bool| if d { DepthKind::Distance } else { DepthKind::Z };
        let seen = [look(&cameras[0], kind(stored[0]), plane(normal)), look(&cameras[1], kind(stored[1]), plane(normal))];
        for options in all_options() {
            let (value, _) = compare([&cameras[0], &cameras[1]], [&seen[0], &seen[1]], &options);
            prop_assert!(value.depth_count > 500, "{value:?}");
            prop_assert!(value.depth <= 1e-6 && value.silhouette <= 1e-6, "{value:?}");
        }
    }

    /// Any finite maps and cameras: finite values and gradients.
    #[test]
    fn finite_stays_finite(
        maps in prop::collection::vec(extreme(), 4 * 12), eye in [extreme(), extreme(), extreme()],
        focal in finite(1e-3..1e6), range in [finite(0.0..2.0), finite(1e-6..1e6)], usual in values(4 * 12, 0.0..1.0),
        mixed in 0usize..3,
    ) {
        let size = |f: f32| Intrinsics { fx: f, fy: f, cx: 2.0, cy: 1.5, width: 4, height: 3 };
        let pose = Pose::look_at(Vec3::new(0.3, 0.2, 2.0), Vec3::ZERO, Vec3::Z);
        let from = Camera { intrinsics: size(3.0), pose };
        let other = Pose::look_at(Vec3::from(eye), Vec3::ZERO, Vec3::Z);
        let to = Camera { intrinsics: size(focal), pose: if other.validate().is_ok() && mixed > 0 { other } else { pose } };
        let data = |k: usize| match mixed {
            2 => usual[k * 12..][..12].to_vec(),
            _ => maps[k * 12..][..12].to_vec(),
        };
        let image = |k: usize| Image::from_vec(4, 3, 1, data(k)).unwrap();
        let (s, d, t, e) = (image(0), image(1), image(2), image(3));
        let range = DepthRange { near: range[0], far: range[0] + range[1] };
        let pixels: Vec<u32> = (0..12).collect();
        let given = DepthMap { kind: DepthKind::Distance, values: e.clone() };
        for mut options in all_options() {
            options.range = range;
            options.max_gap = f32::INFINITY;
            options.min_silhouette = 0.0;
            let a = ViewGeometry { camera: &from, silhouette: &s, depth: DepthSource::Rendered(&d), mask: None };
            for depth in [DepthSource::Rendered(&e), DepthSource::Given(&given), DepthSource::Estimated(&given)] {
                let b = ViewGeometry { camera: &to, silhouette: &t, depth, mask: None };
                let (value, pullback) = pair_consistency(&a, &b, &pixels, &options).unwrap();
                prop_assert!(value.silhouette.is_finite() && value.depth.is_finite(), "{value:?}");
                let g = pullback.pull(&PairValueGrad { silhouette: 1.0, depth: 1.0 });
                for map in [&g.from.silhouette, &g.from.depth, &g.to.silhouette, &g.to.depth] {
                    prop_assert!(map.first_non_finite().is_none());
                }
            }
        }
    }
}

/// A camera turned by a quarter about its own axis sees pixel centres on pixel centres: nothing is interpolated, and a
/// sphere costs nothing. Identical cameras all the more.
#[test]
fn spheres_cost_nothing_where_nothing_is_interpolated() {
    let a = camera(Vec3::new(0.4, 0.3, 1.0), 3.0, 64);
    let turn = Mat3::from_cols(Vec3::Y, -Vec3::X, Vec3::Z);
    let turned = Pose { rotation: turn * a.pose.rotation, translation: turn * a.pose.translation };
    for b in [Camera { pose: turned, ..a }, a] {
        for options in all_options() {
            let seen = [&a, &b].map(|c| look(c, DepthKind::Z, sphere(1.0)));
            let (value, _) = compare([&a, &b], [&seen[0], &seen[1]], &options);
            assert!(value.depth_count > 900 && value.depth <= 1e-6 && value.silhouette <= 1e-6, "{value:?}");
        }
    }
}

/// A sphere from two sides: what interpolation leaves falls by four where the surface faces the camera when the resolution
/// doubles. The share of points within a pixel of the other view's outline falls with the root of the pixel only: toward its
/// outline a smooth object turns away from the view.
#[test]
fn spheres_converge() {
    let costs: Vec<[f32; 2]> = [32u32, 64, 128, 256]
        .map(|size| {
            let cameras = [camera(Vec3::new(0.3, 0.0, 1.0), 3.0, size), camera(Vec3::new(-0.2, 0.2, 1.0), 3.0, size)];
            let seen = [0, 1].map(|k| look(&cameras[k], DepthKind::Z, sphere(1.0)));
            let options = ConsistencyOptions { penalty: SilhouettePenalty::L1, ..ConsistencyOptions::new(RANGE) };
            let view = |k: usize| ViewGeometry {
                camera: &cameras[k],
                silhouette: &seen[k].0,
                depth: DepthSource::Given(&seen[k].1),
                mask: None,
            };
            let pixels = draw_pixels(&view(0), &options, usize::MAX, 0);
            let (value, pullback) = pair_consistency(&view(0), &view(1), &pixels, &options).unwrap();
            let eye = cameras[1].pose.centre();
            let facing = |c: &&Correspondence| {
                c.fate == Fate::Seen && c.world.normalize().dot((eye - c.world).normalize()) > 0.5
            };
            let faced: Vec<f32> = pullback.correspondences().iter().filter(facing).map(|c| c.depth_cost).collect();
            [faced.iter().sum::<f32>() / faced.len() as f32, value.silhouette]
        })
        .to_vec();
    for pair in costs.windows(2) {
        assert!((3.5..4.5).contains(&(pair[0][0] / pair[1][0])), "{costs:?}");
    }
    assert!(costs[0][1] / costs[3][1] > 2.4 && costs[3][0] < 1e-5, "{costs:?}");
}

/// Planted errors of growing size: each costs more than the one before, in every form of the terms.
#[test]
fn disagreement_grows() {
    let cameras = [camera(Vec3::new(0.3, 0.1, 1.0), 3.0, 64), camera(Vec3::new(-0.3, 0.2, 1.0), 2.8, 64)];
    let normal = Vec3::new(0.2, -0.1, 1.0).normalize();
    let seen = [0, 1].map(|k| look(&cameras[k], DepthKind::Z, plane(normal)));
    for mut options in all_options() {
        options.max_gap = f32::INFINITY;
        let of = |other: &Seen| compare([&cameras[0], &cameras[1]], [&seen[0], other], &options).0;
        let changed = |f: &dyn Fn(usize, f32) -> f32| {
            let mut other = seen[1].clone();
            other.1.values.data_mut().iter_mut().enumerate().for_each(|(i, v)| *v = f(i, *v));
            of(&other).depth
        };
        let shifts: Vec<f32> = (0..8).map(|k| changed(&|_, v| v + 0.03 * k as f32)).collect();
        let back: Vec<f32> = (0..8).map(|k| changed(&|_, v| v - 0.03 * k as f32)).collect();
        let scales: Vec<f32> = (0..8).map(|k| changed(&|_, v| v * (1.0 + 0.02 * k as f32))).collect();
        let dents: Vec<f32> =
            (0..8).map(|k| changed(&|i, v| if (i % 64).abs_diff(32) < 4 * k { v + 0.1 } else { v })).collect();
        let holes: Vec<f32> = (0..8)
            .map(|k| {
                let mut other = seen[1].clone();
                for (i, s) in other.0.data_mut().iter_mut().enumerate() {
                    if (i % 64).abs_diff(32).max((i / 64).abs_diff(32)) < 3 * k {
                        *s = 0.0;
                    }
                }
                of(&other).silhouette
            })
            .collect();
        let faded: Vec<f32> = (0..8)
            .map(|k| {
                let mut other = seen[1].clone();
                other.0.data_mut().iter_mut().for_each(|s| *s = 1.0 - 0.06 * k as f32);
                of(&other).silhouette
            })
            .collect();
        for (name, costs) in
            [("shift", shifts), ("back", back), ("scale", scales), ("dent", dents), ("hole", holes), ("faded", faded)]
        {
            assert!(costs[0] <= 1e-6 && costs.windows(2).all(|w| w[1] > w[0] + 1e-4), "{name} {options:?}: {costs:?}");
        }
        // Behind the gap a point counts as hidden: there the depth term ends.
        options.max_gap = 0.05;
        let mut far = seen[1].clone();
        far.1.values.data_mut().iter_mut().for_each(|v| *v *= 1.2);
        let (value, grad) = compare([&cameras[0], &cameras[1]], [&seen[0], &far], &options);
        assert!(value.depth == 0.0 && value.depth_count == 0 && value.silhouette_count > 500);
        assert!(grad.to.depth.data().iter().all(|v| *v == 0.0));
    }
}

/// [eq:cross-view-gap] The figure for tables: nothing on a plane, the shift itself where a view is shifted toward the second camera, however
/// far, and nothing from a surface that hides points.
#[test]
fn the_figure_for_tables_is_the_gap() {
    let cameras = [camera(Vec3::new(0.3, 0.1, 1.0), 3.0, 64), camera(Vec3::new(0.3, 0.1, 1.0), 2.8, 64)];
    let seen = [0, 1].map(|k| look(&cameras[k], DepthKind::Z, plane(Vec3::Z)));
    let view = |k: usize, seen: &Seen, f: &mut dyn FnMut(ViewGeometry<'_>)| {
        let depth = DepthSource::Given(&seen.1);
        f(ViewGeometry { camera: &cameras[k], silhouette: &seen.0, depth, mask: None });
    };
    let options = ConsistencyOptions::new(RANGE);
    let of = |other: &Seen| {
        let mut found = Disagreement::default();
        view(0, &seen[0], &mut |from| {
            let pixels = draw_pixels(&from, &options, 4096, 1);
            view(1, other, &mut |to| found = Disagreement::of(&from, &to, &pixels, &options).unwrap());
        });
        found
    };
    let exact = of(&seen[1]);
    assert!(
        exact.mean_gap().unwrap() < 2e-6 && exact.outside_share() == Some(0.0) && exact.compared > 1000,
        "{exact:?}"
    );
    // Farther in the second view, so that points lie before what it shows: beyond 5 % the loss looks away, this does not.
    for shift in [0.05, 0.2, 0.8] {
        let mut far = seen[1].clone();
        far.1.values.data_mut().iter_mut().for_each(|v| *v += shift);
        let gap = of(&far).mean_gap().unwrap();
        assert!((gap - f64::from(shift)).abs() < 1e-5, "{shift}: {gap}");
    }
    // Much nearer: it hides the points, and says nothing about them.
    let mut near = seen[1].clone();
    near.1.values.data_mut().iter_mut().for_each(|v| *v *= 0.7);
    let hidden = of(&near);
    assert!(hidden.compared == 0 && hidden.mean_gap().is_none() && hidden.landed == exact.landed, "{hidden:?}");
    let mut holed = seen[1].clone();
    holed.0.data_mut()[..2048].fill(0.0);
    let share = of(&holed).outside_share().unwrap();
    assert!((0.3..0.7).contains(&share), "{share}");
    assert_eq!(Disagreement::default().outside_share(), None);
}

/// A sphere from two sides far apart: many points that the second view does not show have nearly the depth of what it does show there, and pass the
/// gap. Their surface faces away from it, and that tells them apart. What faces both cameras stays.
#[test]
fn averted_points_are_not_compared() {
    let first = camera(Vec3::new(0.0, 0.3, 1.0), 3.0, 64);
    // Cosines of the true surface of the points that are compared, and how many land.
    let of = |second: Vec3, min_facing: f32| -> (Vec<f32>, usize) {
        let cameras = [first, camera(second, 3.0, 64)];
        let seen = [0, 1].map(|k| look(&cameras[k], DepthKind::Z, sphere(1.0)));
        let options = ConsistencyOptions { min_facing, max_gap: 0.2, ..ConsistencyOptions::new(RANGE) };
        let view = |k: usize| {
            let depth = DepthSource::Given(&seen[k].1);
            ViewGeometry { camera: &cameras[k], silhouette: &seen[k].0, depth, mask: None }
        };
        let pixels = draw_pixels(&view(0), &options, usize::MAX, 0);
        let (value, pullback) = pair_consistency(&view(0), &view(1), &pixels, &options).unwrap();
        let eye = cameras[1].pose.centre();
        let compared = pullback.correspondences().iter().filter(|c| c.fate == Fate::Seen);
        (compared.map(|c| c.world.normalize().dot((eye - c.world).normalize())).collect(), value.silhouette_count)
    };
    let (far, beside) = (Vec3::new(1.0, 0.0, -0.5), Vec3::new(0.2, 0.3, 1.0));
    let (all, landed) = of(far, -1.0);
    let averted = all.iter().filter(|cosine| **cosine < 0.0).count();
    assert!(averted > 100 && 2 * averted > all.len(), "{averted} of {}", all.len());
    let (facing, same) = of(far, 0.0);
    // But for pixels at the outline, where a normal from one side is coarse.
    let wrong = facing.iter().filter(|cosine| **cosine < -0.1).count();
    assert!(20 * wrong <= facing.len(), "{wrong} of {}", facing.len());
    assert!(10 * facing.len() >= 7 * (all.len() - averted), "{} of {}", facing.len(), all.len() - averted);
    assert_eq!(landed, same);
    // The more it asks, the fewer remain.
    let counts = [-1.0, 0.0, 0.3, 0.6, 0.9].map(|cosine| of(beside, cosine).0.len());
    assert!(
        counts[1] * 10 > counts[0] * 9 && counts.windows(2).all(|w| w[1] <= w[0]) && counts[4] < counts[2],
        "{counts:?}"
    );
}

/// Without a valid correspondence: zero, no gradient, no NaN.
#[test]
fn nothing_to_compare_costs_nothing() {
    let a = camera(Vec3::new(0.3, 0.1, 1.0), 3.0, 32);
    let away = Camera { pose: Pose::look_at(Vec3::new(0.0, 0.0, 3.0), Vec3::new(0.0, 0.0, 9.0), Vec3::Y), ..a };
    let aside = Camera { pose: Pose::look_at(Vec3::new(0.0, 0.0, 3.0), Vec3::new(40.0, 0.0, 0.0), Vec3::Y), ..a };
    let seen = look(&a, DepthKind::Z, sphere(1.0));
    let unknown = (seen.0.clone(), DepthMap::unknown(DepthKind::Z, 32, 32));
    let empty = (Image::new(32, 32, 1), seen.1.clone());
    let options = ConsistencyOptions::new(RANGE);
    for (cameras, maps) in [
        ([&a, &away], [&seen, &seen]),
        ([&a, &aside], [&seen, &seen]),
        ([&a, &a], [&unknown, &seen]),
        ([&a, &a], [&empty, &seen]),
    ] {
        let (value, grad) = compare(cameras, maps, &options);
        assert_eq!(value, PairValue::default());
        for map in [&grad.from.silhouette, &grad.from.depth, &grad.to.silhouette, &grad.to.depth] {
            assert!(map.data().iter().all(|v| *v == 0.0));
        }
    }
}

/// What is detached gets no gradient, what is not the same as before.
#[test]
fn detached_views_get_no_gradient() {
    let cameras = [camera(Vec3::new(0.3, 0.1, 1.0), 3.0, 32), camera(Vec3::new(-0.2, 0.3, 1.0), 3.0, 32)];
    let mut seen = [0, 1].map(|k| look(&cameras[k], DepthKind::Distance, sphere(1.0)));
    seen[1].1.values.data_mut().iter_mut().for_each(|v| *v *= 1.01);
    let with = |detach| {
        let options = ConsistencyOptions { detach, ..ConsistencyOptions::new(RANGE) };
        compare([&cameras[0], &cameras[1]], [&seen[0], &seen[1]], &options)
    };
    let (value, both) = with(Detach::None);
    let (same, source) = with(Detach::Source);
    let (also, target) = with(Detach::Target);
    let none = |g: &ViewGeometryGrad| [&g.silhouette, &g.depth].iter().all(|m| m.data().iter().all(|v| *v == 0.0));
    assert!(value == same && value == also && !none(&both.from) && !none(&both.to));
    assert!(none(&source.from) && source.to == both.to);
    assert!(none(&target.to) && target.from == both.from);
}

/// Estimated depth has no gradient, two of them are refused, and so is what does not fit.
#[test]
fn refusals_say_what_to_do() {
    let a = camera(Vec3::new(0.3, 0.1, 1.0), 3.0, 16);
    let (silhouette, map) = look(&a, DepthKind::Z, sphere(1.0));
    let view = |depth| ViewGeometry { camera: &a, silhouette: &silhouette, depth, mask: None };
    let options = ConsistencyOptions::new(RANGE);
    let pixels: Vec<u32> = (0..256).collect();
    let estimated = view(DepthSource::Estimated(&map));
    let error = pair_consistency(&estimated, &estimated, &pixels, &options).unwrap_err();
    assert!(error == ConsistencyError::BothEstimated && error.to_string().contains("render one of them"), "{error}");
    let further = DepthMap { values: map.values.map(|v| 1.01 * v), ..map.clone() };
    let given = view(DepthSource::Given(&further));
    for (i, j) in [(&estimated, &given), (&given, &estimated)] {
        let (value, pullback) = pair_consistency(i, j, &pixels, &options).unwrap();
        let grad = pullback.pull(&PairValueGrad { silhouette: 1.0, depth: 1.0 });
        let zero = |m: &Image| m.data().iter().all(|v| *v == 0.0);
        assert!(
            value.depth > 1e-3
                && zero(&grad.from.depth) == matches!(i.depth, DepthSource::Estimated(_))
                && zero(&grad.to.depth) == matches!(j.depth, DepthSource::Estimated(_))
        );
    }
    let small = Image::new(8, 8, 1);
    let other = ViewGeometry { silhouette: &small, ..given };
    assert!(matches!(pair_consistency(&given, &other, &pixels, &options), Err(ConsistencyError::Shape { .. })));
    assert!(matches!(pair_consistency(&given, &given, &[256], &options), Err(ConsistencyError::Shape { .. })));
    let nan = silhouette.map(|_| f32::NAN);
    let other = ViewGeometry { silhouette: &nan, ..given };
    assert!(matches!(pair_consistency(&other, &given, &pixels, &options), Err(ConsistencyError::NonFinite { .. })));
    for min_facing in [1.0, -1.5, f32::NAN] {
        let wrong = ConsistencyOptions { min_facing, ..options };
        assert!(matches!(pair_consistency(&given, &given, &pixels, &wrong), Err(ConsistencyError::Setting { .. })));
    }
    for range in [
        DepthRange { near: 2.0, far: 2.0 },
        DepthRange { near: -1.0, far: 2.0 },
        DepthRange { near: 1.0, far: f32::NAN },
    ] {
        let wrong = ConsistencyOptions { range, ..options };
        assert!(matches!(pair_consistency(&given, &given, &pixels, &wrong), Err(ConsistencyError::Setting { .. })));
    }
}

/// The same bits on every thread of many.
#[test]
fn threads_do_not_matter() {
    let cameras = [camera(Vec3::new(0.3, 0.1, 1.0), 3.0, 48), camera(Vec3::new(-0.2, 0.3, 1.0), 3.0, 40)];
    let seen = [0, 1].map(|k| look(&cameras[k], DepthKind::Distance, sphere(1.0)));
    let options = ConsistencyOptions::new(RANGE);
    let run = || compare([&cameras[0], &cameras[1]], [&seen[0], &seen[1]], &options);
    let one = run();
    std::thread::scope(|scope| {
        let handles: Vec<_> = (0..8).map(|_| scope.spawn(run)).collect();
        assert!(handles.into_iter().all(|h| h.join().unwrap() == one));
    });
}
