//! Values and gradients of a pair of views against dual numbers, and the adjoint identity: everywhere, and where things end.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_consistency::*;
use diamond_image::{Image, Mask};
use diamond_testkit::adjoint::{adjoint_gap, relative_l2};
use diamond_testkit::consistency::{self as oracle, Settings};
use diamond_testkit::strategies::{finite, values};
use diamond_testkit::{Dual, jvp, vjp};
use glam::{Vec2, Vec3};
use proptest::prelude::*;

const W: usize = 7;
const H: usize = 6;
const N: usize = W * H;

/// Nearer to a decision or a kink than this, code and oracle may take different sides of it.
const MARGIN: f64 = 1e-3;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Source {
    Rendered,
    GivenZ,
    GivenDistance,
}

#[derive(Debug, Clone)]
struct Case {
    cameras: [Camera; 2],
    silhouettes: [Image; 2],
    depths: [Image; 2],
    sources: [Source; 2],
    mask: Option<Mask>,
    options: ConsistencyOptions,
}

fn intrinsics(f: f32, cx: f32) -> Intrinsics {
    Intrinsics { fx: f, fy: 0.9 * f, cx, cy: 2.7, width: W as u32, height: H as u32 }
}

fn camera(eye: Vec3, f: f32, cx: f32) -> Camera {
    Camera { intrinsics: intrinsics(f, cx), pose: Pose::look_at(eye, Vec3::ZERO, Vec3::Z) }
}

/// Depth of the sphere of radius `radius` about the origin, or of the plane through the origin behind it, plus noise.
fn depth_of(camera: &Camera, radius: f32, noise: &[f32]) -> Vec<f32> {
    (0..N)
        .map(|i| {
            let ray = camera.ray(Vec2::new((i % W) as f32 + 0.5, (i / W) as f32 + 0.5));
            let b = ray.origin.dot(ray.direction);
            let under = b * b - ray.origin.length_squared() + radius * radius;
            let root = under.max(0.0).sqrt();
            // From inside the sphere its far side is seen.
            let t = if -b - root > 0.0 { -b - root } else { -b + root };
            let z = camera.pose.transform_point(ray.at(t.max(0.2))).z;
            z * (1.0 + noise[i])
        })
        .collect()
}

fn options() -> impl Strategy<Value = ConsistencyOptions> {
    any::<[bool; 5]>().prop_map(|[l1, distance, linear, wide, label_gradient]| ConsistencyOptions {
        label_gradient,
        penalty: if l1 { SilhouettePenalty::L1 } else { SilhouettePenalty::Bce },
        depth_kind: if distance { DepthKind::Distance } else { DepthKind::Z },
        sampling: if linear { DepthSampling::Linear } else { DepthSampling::Inverse },
        max_gap: if wide { f32::INFINITY } else { 0.05 },
        ..ConsistencyOptions::new(DepthRange { near: 0.05, far: 4.0 })
    })
}

fn image(data: Vec<f32>) -> Image {
    Image::from_vec(W, H, 1, data).unwrap()
}

fn case(cameras: [Camera; 2]) -> impl Strategy<Value = Case> {
    // Half of them with outlines everywhere, half with few: a depth that counts needs four pixels that show something.
    let silhouette = || prop_oneof![values(N, 0.15..0.98), values(N, 0.46..0.98)];
    let maps = move || (silhouette(), values(N, -0.03..0.03));
    (maps(), maps(), prop::option::of(values(N, 0.0..1.0)), [0usize..3, 0usize..3], options()).prop_map(
        move |(a, b, mask, sources, options)| {
            let sources = sources.map(|k| [Source::Rendered, Source::GivenZ, Source::GivenDistance][k]);
            let depth = |k: usize, silhouette: &[f32], noise: &[f32]| {
                let mut depth = depth_of(&cameras[k], 1.0, noise);
                for (i, d) in depth.iter_mut().enumerate() {
                    let centre = Vec2::new((i % W) as f32 + 0.5, (i / W) as f32 + 0.5);
                    *d *= match sources[k] {
                        Source::Rendered => silhouette[i],
                        Source::GivenZ => 1.0,
                        Source::GivenDistance => cameras[k].pixel_direction(centre).length(),
                    };
                }
                depth
            };
            let depths = [image(depth(0, &a.0, &a.1)), image(depth(1, &b.0, &b.1))];
            Case {
                cameras,
                depths,
                silhouettes: [image(a.0), image(b.0)],
                sources,
                mask: mask.map(|m| Mask::from_vec(W, H, m).unwrap()),
                options,
            }
        },
    )
}

fn wide(v: &[f32]) -> Vec<f64> {
    v.iter().map(|&v| f64::from(v)).collect()
}

impl Case {
    fn settings(&self) -> Settings {
        let o = &self.options;
        Settings {
            bce: o.penalty == SilhouettePenalty::Bce,
            distance: o.depth_kind == DepthKind::Distance,
            inverse: o.sampling == DepthSampling::Inverse,
            near: f64::from(o.range.near),
            far: f64::from(o.range.far),
            min_silhouette: f64::from(o.min_silhouette),
            max_gap: f64::from(o.max_gap),
            label_gradient: o.label_gradient,
        }
    }

    /// The oracle's view `k` of maps that start at `k`·2N in `x`: silhouette, then depth.
    fn view(&self, k: usize, x: &[Dual]) -> oracle::View<Dual> {
        let of = |v: f32| Dual::of(f64::from(v));
        use diamond_testkit::Real;
        let (c, p) = (&self.cameras[k].intrinsics, &self.cameras[k].pose);
        oracle::View {
            pinhole: [c.fx, c.fy, c.cx, c.cy].map(of),
            rotation: [0, 1, 2].map(|r| p.rotation.row(r).to_array().map(of)),
            translation: p.translation.to_array().map(of),
            size: [W, H],
            silhouette: x[2 * k * N..][..N].to_vec(),
            depth: x[(2 * k + 1) * N..][..N].to_vec(),
            rendered: self.sources[k] == Source::Rendered,
            distance: self.sources[k] == Source::GivenDistance,
            mask: self.mask.as_ref().filter(|_| k == 0).map(|m| wide(m.data())),
        }
    }

    fn at(&self) -> Vec<f64> {
        (0..2).flat_map(|k| [wide(self.silhouettes[k].data()), wide(self.depths[k].data())].concat()).collect()
    }

    /// Pixels that are no nearer than `margin` to a decision or a kink.
    fn pixels(&self, margin: f64) -> Vec<u32> {
        let x: Vec<Dual> = self.at().iter().map(|&v| Dual::new(v, 0.0)).collect();
        let (from, to, s) = (self.view(0, &x), self.view(1, &x), self.settings());
        (0..N as u32).filter(|&i| oracle::pixel(&from, &to, i as usize, &s).2 > margin).collect()
    }

    fn maps(&self) -> [Option<DepthMap>; 2] {
        [0, 1].map(|k| match self.sources[k] {
            Source::Rendered => None,
            Source::GivenZ => Some(DepthMap { kind: DepthKind::Z, values: self.depths[k].clone() }),
            Source::GivenDistance => Some(DepthMap { kind: DepthKind::Distance, values: self.depths[k].clone() }),
        })
    }

    /// What the code says: value, and gradient with respect to the maps in the oracle's order.
    fn ours(&self, pixels: &[u32], d: [f32; 2]) -> (PairValue, Vec<f64>, Vec<Fate>) {
        let maps = self.maps();
        let view = |k: usize| ViewGeometry {
            camera: &self.cameras[k],
            silhouette: &self.silhouettes[k],
            depth: maps[k].as_ref().map_or(DepthSource::Rendered(&self.depths[k]), DepthSource::Given),
            mask: self.mask.as_ref().filter(|_| k == 0),
        };
        let (value, pullback) = pair_consistency(&view(0), &view(1), pixels, &self.options).unwrap();
        let grad = pullback.pull(&PairValueGrad { silhouette: d[0], depth: d[1] });
        let all = [&grad.from.silhouette, &grad.from.depth, &grad.to.silhouette, &grad.to.depth];
        let fates = pullback.correspondences().iter().map(|c| c.fate).collect();
        (value, all.iter().flat_map(|g| wide(g.data())).collect(), fates)
    }

    /// Worst relative errors of value, gradient and adjoint identity, over the two terms apart and together; what became
    /// of the pixels.
    fn errors(&self, margin: f64, tangent: &[f32]) -> ([f64; 3], Vec<Fate>) {
        let pixels = self.pixels(margin);
        let settings = self.settings();
        let oracle = |x: &[Dual]| oracle::pair(&self.view(0, x), &self.view(1, x), &pixels, &settings).0.to_vec();
        let at = self.at();
        let constants: Vec<Dual> = at.iter().map(|&v| Dual::new(v, 0.0)).collect();
        let expected: Vec<f64> = oracle(&constants).iter().map(|v| v.v).collect();
        let tangent = wide(tangent);
        let forward = jvp(oracle, &at, &tangent);
        let mut worst = [0.0f64; 3];
        let mut fates = Vec::new();
        for d in [[1.0f32, 0.0], [0.0, 1.0], [0.7, -0.4]] {
            let (value, grad, became) = self.ours(&pixels, d);
            let found = [f64::from(value.silhouette), f64::from(value.depth)];
            let errors = [
                relative_l2(&found, &expected, 1e-2),
                relative_l2(&grad, &vjp(oracle, &at, &wide(&d)), 1e-3),
                adjoint_gap(&wide(&d), &forward, &grad, &tangent),
            ];
            for (w, e) in worst.iter_mut().zip(errors) {
                *w = if e.is_nan() { f64::INFINITY } else { w.max(e) };
            }
            fates = became;
        }
        (worst, fates)
    }

    fn agrees(&self, tangent: &[f32]) -> Result<Vec<Fate>, TestCaseError> {
        let ([value, gradient, adjoint], fates) = self.errors(MARGIN, tangent);
        if std::env::var_os("DIAMOND_PRINT_ERRORS").is_some() {
            println!("{value:.1e} {gradient:.1e} {adjoint:.1e}");
        }
        prop_assert!(value <= 1e-4 && gradient <= 1e-4 && adjoint <= 1e-4, "{value:e} {gradient:e} {adjoint:e}");
        Ok(fates)
    }
}

/// Two cameras around the object; the second may be so near that much lands outside.
fn around() -> impl Strategy<Value = [Camera; 2]> {
    let one = || ([finite(-0.6..0.6), finite(-0.6..0.6)], finite(2.0..3.2), finite(5.0..9.0), finite(1.0..6.0));
    (one(), one())
        .prop_map(|(a, b)| [a, b].map(|([u, v], r, f, cx)| camera(r * Vec3::new(u, v, 1.0).normalize(), f, cx)))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// [eq:silhouette-consistency] [eq:depth-consistency] [eq:reprojection] [eq:visibility-filter] [eq:rendered-depth]
    /// [eq:depth-sampling]: random maps, so that points land on outlines, at the border, outside, behind something; all
    /// penalties, kinds, samplings and sources, with and without a mask.
    #[test]
    fn pairs_agree_with_the_oracle(c in around().prop_flat_map(case), t in values(4 * N, -1.0..1.0)) {
        c.agrees(&t)?;
    }

    /// The second camera inside the object, or with the object behind it.
    #[test]
    fn cameras_inside_and_turned_away_agree(
        p in [finite(-0.6..0.6), finite(-0.6..0.6), finite(-0.6..0.6)], inside in any::<bool>(),
        c in case([camera(Vec3::new(0.3, 0.2, 2.5), 7.0, 3.5); 2]), t in values(4 * N, -1.0..1.0),
    ) {
        let mut c = c;
        let eye = if inside { Vec3::from(p) } else { 3.0 * Vec3::from(p).normalize_or(Vec3::X) };
        c.cameras[1] = camera(eye, 6.0, 3.2);
        if !inside {
            c.cameras[1].pose = Pose::look_at(eye, 2.0 * eye, Vec3::Z);
        }
        let depth = depth_of(&c.cameras[1], 1.0, &[0.0; N]);
        if inside {
            c.depths[1] = image(depth.iter().zip(c.silhouettes[1].data()).map(|(d, s)| d.abs().max(0.1) * s).collect());
            c.sources[1] = Source::Rendered;
        }
        let fates = c.agrees(&t)?;
        prop_assert!(inside || fates.iter().all(|f| matches!(f, Fate::Empty | Fate::Behind)));
    }

    /// Two identical cameras: points land where they come from, whatever their depth, so that places have no derivative and
    /// the kink at pixel centres is none.
    #[test]
    fn identical_cameras_agree(c in case([camera(Vec3::new(0.4, -0.2, 2.4), 7.0, 3.4); 2]), t in values(4 * N, -1.0..1.0)) {
        // Decisions still count; for pixel centres the margin is that of rounding.
        let x: Vec<Dual> = c.at().iter().map(|&v| Dual::new(v, 0.0)).collect();
        let (from, to, s) = (c.view(0, &x), c.view(1, &x), c.settings());
        let close = |i: usize| {
            let (a, b) = (from.silhouette[i].v, to.silhouette[i].v);
            let z = |v: &oracle::View<Dual>, k: usize, i: usize| {
                let centre = Vec2::new((i % W) as f32 + 0.5, (i / W) as f32 + 0.5);
                match c.sources[k] {
                    Source::Rendered => v.depth[i].v / v.silhouette[i].v,
                    Source::GivenZ => v.depth[i].v,
                    Source::GivenDistance => v.depth[i].v / f64::from(c.cameras[k].pixel_direction(centre).length()),
                }
            };
            let gap = (z(&from, 0, i) - z(&to, 1, i)).abs() / z(&from, 0, i);
            let label = from.mask.as_ref().map_or(a, |m| m[i]);
            [a - 0.5, b - 0.5, label - 0.5, label - b, gap, gap - s.max_gap].iter().any(|m| m.abs() < MARGIN)
        };
        // All that rounding may read: a neighbour of a weight of 1e-7 must not decide either.
        let whole = |i: usize| (0..N).all(|k| to.silhouette[k].v > 0.5 || {
            let (dx, dy) = ((k % W).abs_diff(i % W), (k / W).abs_diff(i / W));
            dx > 1 || dy > 1
        });
        let pixels: Vec<u32> = (0..N).filter(|&i| !close(i) && whole(i)).map(|i| i as u32).collect();
        let oracle = |x: &[Dual]| oracle::pair(&c.view(0, x), &c.view(1, x), &pixels, &s).0.to_vec();
        let d = [0.8f32, 0.6];
        let (value, grad, _) = c.ours(&pixels, d);
        let expected: Vec<f64> = oracle(&x).iter().map(|v| v.v).collect();
        let error = relative_l2(&[f64::from(value.silhouette), f64::from(value.depth)], &expected, 1e-2);
        prop_assert!(error <= 1e-4, "value {error:e}");
        let error = relative_l2(&grad, &vjp(oracle, &c.at(), &wide(&d)), 1e-3);
        prop_assert!(error <= 1e-4, "gradient {error:e}");
        prop_assert!(adjoint_gap(&wide(&d), &jvp(oracle, &c.at(), &wide(&t)), &grad, &wide(&t)) <= 1e-4);
    }
}

/// The cases above are what they say: over all of them every fate occurs often.
#[test]
fn random_pairs_meet_every_fate() {
    use proptest::strategy::ValueTree;
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    let mut counts = std::collections::BTreeMap::<Fate, usize>::new();
    for k in 0..60 {
        let mut c = around().prop_flat_map(case).new_tree(&mut runner).unwrap().current();
        if k % 10 == 0 {
            c.cameras[1].pose = Pose::look_at(Vec3::new(0.0, 0.0, 0.5), Vec3::new(0.0, 1.0, 0.4), Vec3::Z);
        }
        if k % 10 == 1 {
            c.depths[0].data_mut()[..20].fill(0.0);
        }
        c.ours(&c.pixels(MARGIN), [1.0, 1.0]).2.into_iter().for_each(|f| *counts.entry(f).or_default() += 1);
    }
    for fate in [Fate::Empty, Fate::NoDepth, Fate::Behind, Fate::Outside, Fate::Hollow, Fate::Hidden, Fate::Seen] {
        assert!(counts.get(&fate).is_some_and(|n| *n >= 20), "{counts:?}");
    }
}

/// The harness notices what it should: one side of the comparison is broken, each time differently.
#[test]
fn planted_errors_are_noticed() {
    use proptest::strategy::ValueTree;
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    let tangent: Vec<f32> = (0..4 * N).map(|i| ((i as f32) * 0.37).sin()).collect();
    let mut noticed = [0; 5];
    for _ in 0..12 {
        let mut c = around().prop_flat_map(case).new_tree(&mut runner).unwrap().current();
        c.options.max_gap = f32::INFINITY;
        (c.sources, c.mask) = ([Source::Rendered; 2], None);
        let pixels = c.pixels(MARGIN);
        let settings = c.settings();
        let plant = |k: usize| {
            let (mut code, mut settings, mut pixels) = (c.clone(), settings, pixels.clone());
            match k {
                0 => {
                    code.options.sampling =
                        if settings.inverse { DepthSampling::Linear } else { DepthSampling::Inverse }
                }
                1 => settings.distance = !settings.distance,
                2 => settings.far += 0.01,
                3 => {
                    // A pixel that counts.
                    let fates = c.ours(&pixels, [0.0; 2]).2;
                    pixels.remove(fates.iter().position(|f| f.has_depth()).unwrap_or(0));
                }
                _ => {}
            }
            let oracle = |x: &[Dual]| oracle::pair(&c.view(0, x), &c.view(1, x), &pixels, &settings).0.to_vec();
            let d = [0.7f32, -0.4];
            let (_, mut grad, _) = code.ours(&c.pixels(MARGIN), d);
            if k == 4 {
                // Forget the way through the point: the first view's depth.
                grad[N..2 * N].fill(0.0);
            }
            let expected = vjp(oracle, &c.at(), &wide(&d));
            relative_l2(&grad, &expected, 1e-3) > 1e-4
                || adjoint_gap(&wide(&d), &jvp(oracle, &c.at(), &wide(&tangent)), &grad, &wide(&tangent)) > 1e-4
        };
        for (k, n) in noticed.iter_mut().enumerate() {
            *n += usize::from(plant(k));
        }
        assert!(c.agrees(&tangent).is_ok());
    }
    assert!(noticed.iter().all(|n| *n >= 6), "{noticed:?}");
}
