//! What must hold for every scene: bits that do not depend on threads or on invisible Gaussians, conservation of light,
//! order, and finite answers to degenerate questions.
mod raster_scene;

use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::Image;
use diamond_splat::{
    Cutoff, Features, Gaussians, RasterConfig, RasterGrad, RasterPull, SplatError, project, rasterize,
    rasterize_projected,
};
use glam::{Quat, Vec3};
use proptest::prelude::*;
use raster_scene::{Case, Random};

fn camera(width: u32, height: u32) -> Camera {
    Camera { intrinsics: Intrinsics::from_fov_x(0.9, width, height), pose: Pose::IDENTITY }
}

fn bits(pull: &RasterPull) -> Vec<u32> {
    let g = &pull.gaussians;
    let mut all: Vec<f32> = g.means.iter().chain(&g.scales).flat_map(|v| v.to_array()).collect();
    all.extend(g.rotations.iter().flat_map(|v| v.to_array()));
    all.extend(g.opacities.iter().chain(&pull.features));
    all.extend(pull.screen.iter().flat_map(|v| v.to_array()));
    all.into_iter().map(f32::to_bits).collect()
}

/// Renders and pulls a cotangent of ones and halves; everything must be finite.
fn round_trip(g: &Gaussians, f: &Features, camera: &Camera, config: &RasterConfig) -> (Image, Image, RasterPull) {
    let (raster, pullback) = rasterize(g, f, camera, config).unwrap();
    let (w, h) = (raster.opacity.width(), raster.opacity.height());
    let mut d = RasterGrad::zeros(w, h, f.channels);
    d.features.data_mut().fill(1.0);
    d.opacity.data_mut().fill(-0.5);
    d.depth.data_mut().fill(0.5);
    let pull = pullback.pull(&d).unwrap();
    for image in [&raster.features, &raster.opacity, &raster.depth] {
        assert_eq!(image.first_non_finite(), None);
    }
    assert!(bits(&pull).iter().all(|&b| f32::from_bits(b).is_finite()), "{g:?} {camera:?}: {pull:?} is not finite");
    (raster.features, raster.opacity, pull)
}

fn one(mean: Vec3, scale: Vec3, opacity: f32) -> (Gaussians, Features) {
    let mut g = Gaussians::default();
    g.push(mean, scale, Quat::IDENTITY, opacity);
    (g, Features { channels: 1, data: vec![1.0] })
}

#[test]
fn bits_do_not_depend_on_the_number_of_threads() {
    let case = Case::random(3, 3000, 5, Cutoff::Hard);
    let mut case = case;
    case.camera.intrinsics = Intrinsics { fx: 90.0, fy: 90.0, cx: 40.0, cy: 52.0, width: 93, height: 101 };
    let u = case.random_cotangent(&mut Random(9));
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let picture: Vec<u64> = case.render().into_iter().map(f64::to_bits).collect();
            (picture, bits(&case.pull_images(&u)))
        })
    };
    let reference = run(1);
    for threads in [2, 3, 7] {
        assert!(run(threads) == reference, "{threads} threads give other bits than one");
    }
}

#[test]
fn invisible_gaussians_change_nothing_and_their_features_are_never_read() {
    let case = Case::random(8, 80, 3, Cutoff::Hard);
    let projection = project(&case.gaussians, &case.camera, &case.config).unwrap();
    let visible = projection.visible();
    assert!(!visible.is_empty() && visible.len() < 80, "the scene must have both kinds");
    let mut masked = Features { channels: 3, data: vec![f32::NAN; 240] };
    for &i in visible {
        masked.row_mut(i as usize).copy_from_slice(case.features.row(i as usize));
    }
    let (a, _) = rasterize(&case.gaussians, &case.features, &case.camera, &case.config).unwrap();
    let (b, _) = rasterize_projected(&projection, &case.gaussians, &masked).unwrap();
    assert_eq!(a, b);
    for i in 0..80 {
        assert_eq!(projection.radii()[i] > 0.0, visible.contains(&(i as u32)));
        assert_eq!(projection.footprint(i).is_some(), visible.contains(&(i as u32)));
    }
}

#[test]
fn degenerate_gaussians_give_finite_answers() {
    let config = RasterConfig::default();
    let ahead = Vec3::new(0.0, 0.0, 2.0);
    let cases = [
        ("scale zero", one(ahead, Vec3::ZERO, 0.5)),
        ("flat", one(ahead, Vec3::new(0.3, 0.0, 0.2), 0.5)),
        ("opacity zero", one(ahead, Vec3::splat(0.1), 0.0)),
        ("opacity one", one(ahead, Vec3::splat(0.1), 1.0)),
        ("behind", one(-ahead, Vec3::splat(0.1), 0.5)),
        ("on the camera", one(Vec3::ZERO, Vec3::splat(0.1), 0.5)),
        ("at the near plane", one(Vec3::new(0.0, 0.0, 0.2), Vec3::splat(0.1), 0.5)),
        ("just beyond the near plane", one(Vec3::new(0.01, 0.0, 0.200_001), Vec3::splat(5.0), 0.9)),
        ("camera inside", one(Vec3::new(0.1, 0.0, 0.5), Vec3::splat(3.0), 0.9)),
        ("huge", one(ahead, Vec3::splat(1e6), 0.9)),
        ("absurd", one(ahead, Vec3::splat(1e30), 0.9)),
        ("very far", one(Vec3::new(0.0, 0.0, 1e20), Vec3::splat(1e18), 0.9)),
        ("farthest", one(Vec3::splat(3e38), Vec3::splat(3e38), 0.9)),
        ("sideways", one(Vec3::new(1e6, -1e6, 0.3), Vec3::splat(1e5), 0.9)),
        ("needle", one(ahead, Vec3::new(50.0, 1e-9, 1e-9), 0.9)),
        ("tiny", one(ahead, Vec3::splat(1e-30), 0.9)),
    ];
    for (name, (mut g, f)) in cases {
        for rotation in [Quat::IDENTITY, Quat::from_xyzw(0.0, 0.0, 0.0, 0.0), Quat::from_xyzw(1e-20, 0.0, 0.0, 0.0)] {
            g.rotations[0] = rotation;
            for (w, h) in [(1, 1), (17, 9), (64, 64)] {
                for cutoff in [Cutoff::Hard, Cutoff::Smooth] {
                    let (_, opacity, _) = round_trip(&g, &f, &camera(w, h), &RasterConfig { cutoff, ..config });
                    let largest = opacity.data().iter().copied().fold(0.0f32, f32::max);
                    assert!((0.0..=1.0).contains(&largest), "{name}: opacity {largest}");
                    if matches!(name, "behind" | "on the camera" | "at the near plane" | "opacity zero") {
                        assert_eq!(largest, 0.0, "{name} must be culled");
                    }
                    if matches!(name, "huge" | "camera inside" | "opacity one") {
                        assert!(largest > 0.5, "{name} must be seen, found {largest}");
                    }
                }
            }
        }
    }
}

#[test]
fn no_gaussians_and_no_channels() {
    let (g, f) = (Gaussians::default(), Features { channels: 2, data: vec![] });
    let (features, opacity, pull) = round_trip(&g, &f, &camera(20, 10), &RasterConfig::default());
    assert_eq!(features.shape(), (20, 10, 2));
    assert!(opacity.data().iter().chain(features.data()).all(|&v| v == 0.0));
    assert!(pull.gaussians.is_empty() && pull.features.is_empty() && pull.screen.is_empty());
    let (g, _) = one(2.0 * Vec3::Z, Vec3::splat(0.2), 0.7);
    let (_, opacity, pull) = round_trip(&g, &Features::zeros(1, 0), &camera(20, 10), &RasterConfig::default());
    assert!(opacity.pixel(10, 5)[0] > 0.5 && pull.gaussians.opacities[0] != 0.0 && pull.features.is_empty());
}

#[test]
fn a_hundred_thousand_gaussians_at_one_depth_are_blended_by_index() {
    let n = 100_000;
    let mut g = Gaussians::default();
    let mut f = Features { channels: 1, data: vec![0.0; n] };
    for i in 0..n {
        let (x, y) = ((i % 317) as f32 / 317.0 - 0.5, (i / 317) as f32 / 317.0 - 0.5);
        g.push(Vec3::new(x, y, 2.0), Vec3::splat(0.02), Quat::IDENTITY, 0.9);
        f.data[i] = 1.0;
    }
    let (features, opacity, _) = round_trip(&g, &f, &camera(48, 48), &RasterConfig::default());
    assert!(opacity.pixel(24, 24)[0] > 0.99 && (features.pixel(24, 24)[0] - opacity.pixel(24, 24)[0]).abs() < 1e-6);
    // Two at the same place: the lower index is in front.
    let mut g = Gaussians::default();
    (0..2).for_each(|_| g.push(Vec3::Z, Vec3::splat(0.3), Quat::IDENTITY, 0.9));
    let f = Features { channels: 2, data: vec![1.0, 0.0, 0.0, 1.0] };
    let (features, ..) = round_trip(&g, &f, &camera(9, 9), &RasterConfig::default());
    assert!(features.pixel(4, 4)[0] > 0.85 && features.pixel(4, 4)[1] < 0.1);
}

#[test]
fn nonsense_is_refused_and_named() {
    let config = RasterConfig::default();
    let (good, f) = one(Vec3::Z, Vec3::splat(0.1), 0.5);
    let cam = camera(8, 8);
    let refuse = |g: &Gaussians, f: &Features, cam: &Camera, config: &RasterConfig| rasterize(g, f, cam, config).err();
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut g = good.clone();
        g.means[0].x = bad;
        assert!(matches!(refuse(&g, &f, &cam, &config), Some(SplatError::NonFinite { what: "Gaussians::means", .. })));
        let mut g = good.clone();
        g.rotations[0] = Quat::from_xyzw(0.0, bad, 0.0, 1.0);
        assert!(matches!(refuse(&g, &f, &cam, &config), Some(SplatError::NonFinite { .. })));
        let nan = Features { channels: 1, data: vec![bad] };
        assert!(matches!(refuse(&good, &nan, &cam, &config), Some(SplatError::NonFinite { .. })));
        let mut c = cam;
        c.intrinsics.cx = bad;
        assert!(refuse(&good, &f, &c, &config).is_some());
        c = cam;
        c.intrinsics.fx = bad;
        assert!(refuse(&good, &f, &c, &config).is_some());
        assert!(refuse(&good, &f, &cam, &RasterConfig { low_pass: bad, ..config }).is_some());
    }
    let mut g = good.clone();
    g.scales[0].y = -1.0;
    assert!(matches!(refuse(&g, &f, &cam, &config), Some(SplatError::Range { what: "Gaussians::scales", .. })));
    assert!(matches!(refuse(&good, &Features::zeros(2, 1), &cam, &config), Some(SplatError::Shape { .. })));
    assert!(refuse(&good, &f, &camera(0, 4), &config).is_some());
    let (_, pullback) = rasterize(&good, &f, &cam, &config).unwrap();
    assert!(matches!(pullback.pull(&RasterGrad::zeros(8, 7, 1)), Err(SplatError::Shape { .. })));
    let mut d = RasterGrad::zeros(8, 8, 1);
    d.depth.data_mut()[5] = f32::NAN;
    assert_eq!(pullback.pull(&d).err(), Some(SplatError::NonFinite { what: "RasterGrad::depth", index: 5 }));
    let projection = project(&good, &cam, &config).unwrap();
    let other = Gaussians::default();
    assert!(matches!(rasterize_projected(&projection, &other, &f), Err(SplatError::Shape { .. })));
}

#[test]
fn a_gaussian_that_is_not_seen_has_no_gradient() {
    let mut g = Gaussians::default();
    g.push(Vec3::new(0.0, 0.0, 1.0), Vec3::splat(0.2), Quat::IDENTITY, 0.5);
    g.push(Vec3::new(0.0, 0.0, -1.0), Vec3::splat(0.2), Quat::IDENTITY, 0.5);
    g.push(Vec3::new(90.0, 0.0, 1.0), Vec3::splat(0.2), Quat::IDENTITY, 0.5);
    let f = Features { channels: 1, data: vec![1.0; 3] };
    let (.., pull) = round_trip(&g, &f, &camera(32, 32), &RasterConfig::default());
    assert_ne!(pull.gaussians.means[0], Vec3::ZERO);
    for i in 1..3 {
        assert_eq!((pull.gaussians.means[i], pull.gaussians.opacities[i], pull.features[i]), (Vec3::ZERO, 0.0, 0.0));
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    /// Σ w is what a feature of 1 gives, lies in [0, 1), and Σ w z lies between the extremes of z.
    #[test]
    fn weights_are_a_partition(seed in 0u64..1 << 40, n in 1usize..120) {
        let mut case = Case::random(seed, n, 1, Cutoff::Hard);
        case.features.data.fill(1.0);
        let (raster, pullback) = rasterize(&case.gaussians, &case.features, &case.camera, &case.config).unwrap();
        let projection = pullback.projection();
        let z: Vec<f32> = (0..n).filter_map(|i| projection.footprint(i)).map(|f| f.depth).collect();
        let (near, far) = z.iter().fold((f32::MAX, 0.0f32), |(a, b), &v| (a.min(v), b.max(v)));
        for i in 0..raster.opacity.pixels() {
            let (o, one, d) = (raster.opacity.data()[i], raster.features.data()[i], raster.depth.data()[i]);
            prop_assert!((0.0..1.0).contains(&o) && (o - one).abs() < 1e-6);
            prop_assert!(d >= o * near * 0.999_99 && d <= o * far * 1.000_01, "{} {} {} {}", d, o, near, far);
        }
    }

    /// Renumbering the Gaussians permutes the gradient and leaves the picture.
    #[test]
    fn order_of_storage_does_not_matter(seed in 0u64..1 << 40) {
        let n = 50;
        let case = Case::random(seed, n, 2, Cutoff::Hard);
        let mut reversed = Case::random(seed, n, 2, Cutoff::Hard);
        reversed.gaussians.means.reverse();
        reversed.gaussians.scales.reverse();
        reversed.gaussians.rotations.reverse();
        reversed.gaussians.opacities.reverse();
        reversed.features.data = (0..n).rev().flat_map(|i| case.features.row(i).to_vec()).collect();
        prop_assert_eq!(case.render(), reversed.render());
        let u = case.random_cotangent(&mut Random(seed));
        let (a, b) = (case.pull_images(&u), reversed.pull_images(&u));
        for i in 0..n {
            prop_assert_eq!(a.gaussians.means[i], b.gaussians.means[n - 1 - i]);
            prop_assert_eq!(a.gaussians.rotations[i], b.gaussians.rotations[n - 1 - i]);
            prop_assert_eq!(a.screen[i], b.screen[n - 1 - i]);
        }
    }

    /// A cyclic change of world axes moves Gaussians and camera together: the same picture.
    #[test]
    fn the_world_frame_does_not_matter(seed in 0u64..1 << 40) {
        let case = Case::random(seed, 30, 2, Cutoff::Smooth);
        let turn = Quat::from_xyzw(0.5, 0.5, 0.5, 0.5);
        let mut turned = Case::random(seed, 30, 2, Cutoff::Smooth);
        for i in 0..30 {
            turned.gaussians.means[i] = turn * case.gaussians.means[i];
            turned.gaussians.rotations[i] = turn * case.gaussians.rotations[i].normalize();
        }
        let back = glam::Mat3::from_quat(turn.conjugate());
        turned.camera.pose.rotation = case.camera.pose.rotation * back;
        for (a, b) in case.render().iter().zip(turned.render()) {
            prop_assert!((a - b).abs() < 2e-5, "{} {}", a, b);
        }
    }
}
