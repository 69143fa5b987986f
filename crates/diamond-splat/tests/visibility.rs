//! Ray-traced visibility: against a brute-force f64 oracle, its laws, and what it does to a sphere of splats.
use diamond_light::OlatLight;
use diamond_splat::{GaussianBvh, Gaussians, LightGrid, MAX_OCCLUDER_ALPHA, MIN_OCCLUDER_ALPHA, VisibilityConfig};
use diamond_testkit::visibility as oracle;
use glam::{Quat, Vec3};
use proptest::prelude::*;

const ALPHAS: (f64, f64) = (MIN_OCCLUDER_ALPHA as f64, MAX_OCCLUDER_ALPHA as f64);

fn vec3(range: std::ops::Range<f32>) -> impl Strategy<Value = Vec3> {
    [range.clone(), range.clone(), range].prop_map(Vec3::from)
}

fn gaussians(count: std::ops::Range<usize>) -> impl Strategy<Value = Gaussians> {
    let one = (vec3(-1.0..1.0), vec3(-5.0..-0.5), [-1.0f32..1.0, -1.0..1.0, -1.0..1.0, -1.0..1.0], 0.0f32..1.0);
    prop::collection::vec(one, count).prop_map(|all| {
        let mut gaussians = Gaussians::default();
        for (mean, log_scale, rotation, opacity) in all {
            let rotation = Quat::from_array(rotation);
            let rotation = if rotation.length() < 1e-2 { Quat::IDENTITY } else { rotation };
            gaussians.push(mean, log_scale.exp(), rotation, opacity);
        }
        gaussians
    })
}

fn to_oracle(gaussians: &Gaussians) -> Vec<oracle::Occluder> {
    (0..gaussians.len())
        .map(|i| {
            let r = gaussians.rotations[i].as_dquat();
            oracle::Occluder {
                mean: gaussians.means[i].as_dvec3().to_array(),
                scale: gaussians.scales[i].as_dvec3().to_array(),
                rotation: [r.w, r.x, r.y, r.z],
                opacity: gaussians.opacities[i] as f64,
            }
        })
        .collect()
}

/// Largest error of a ray from `a` to `b`, or `None` where a peak is so near an end that rounding decides.
fn compare(gaussians: &Gaussians, bvh: &GaussianBvh, a: Vec3, b: Vec3, oracle_end: f64) -> Option<f64> {
    let occluders = to_oracle(gaussians);
    let (origin, direction) = (a.as_dvec3().to_array(), (b - a).as_dvec3().to_array());
    for o in &occluders {
        let (t, _) = oracle::peak(o, origin, direction, ALPHAS.0, ALPHAS.1);
        if t.abs() < 1e-3 || (t - 1.0).abs() < 1e-3 {
            return None;
        }
    }
    let expected = oracle::transmittance(&occluders, origin, direction, (0.0, oracle_end), ALPHAS);
    Some((bvh.transmittance(a, b - a, 0.0, 1.0) as f64 - expected).abs())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 192, failure_persistence: None, ..ProptestConfig::default() })]

    /// [eq:ray-transmittance], [eq:gaussian-bounds]: a box that is too small would lose occluders.
    #[test]
    fn equals_the_oracle(gaussians in gaussians(0..80), a in vec3(-2.0..2.0), b in vec3(-2.0..2.0)) {
        prop_assume!((b - a).length() > 0.1);
        let bvh = GaussianBvh::build(&gaussians).unwrap();
        if let Some(error) = compare(&gaussians, &bvh, a, b, 1.0) {
            // Rays are abandoned at 1e-4.
            prop_assert!(error < 1.2e-4, "{error}");
        }
    }

    #[test]
    fn refitting_equals_building(gaussians in gaussians(1..60), shift in vec3(-0.5..0.5), a in vec3(-2.0..2.0), b in vec3(-2.0..2.0)) {
        prop_assume!((b - a).length() > 0.1);
        let mut moved = gaussians.clone();
        for i in 0..moved.len() {
            moved.means[i] += shift * (i % 3) as f32;
            moved.scales[i] *= 1.3;
            // Some appear, some vanish.
            moved.opacities[i] = 1.0 - moved.opacities[i];
        }
        let mut bvh = GaussianBvh::build(&gaussians).unwrap();
        bvh.refit(&moved).unwrap();
        let built = GaussianBvh::build(&moved).unwrap();
        let (x, y) = (bvh.transmittance(a, b - a, 0.0, 1.0), built.transmittance(a, b - a, 0.0, 1.0));
        // Another order of factors, and perhaps another place to give up.
        prop_assert!((x - y).abs() <= 1e-5 || x.max(y) < 1e-4, "{x} {y}");
    }

    #[test]
    fn transmittance_is_a_share_and_falls_with_every_occluder(gaussians in gaussians(1..40), a in vec3(-2.0..2.0), b in vec3(-2.0..2.0)) {
        prop_assume!(a != b);
        let mut last = 1.0;
        for n in 0..=gaussians.len() {
            let mut some = gaussians.clone();
            some.means.truncate(n);
            some.scales.truncate(n);
            some.rotations.truncate(n);
            some.opacities.truncate(n);
            let t = GaussianBvh::build(&some).unwrap().transmittance(a, b - a, 0.0, 1.0);
            prop_assert!((0.0..=1.0).contains(&t));
            prop_assert!(t <= last + 1e-6 || t < 1e-4, "{t} after {last}");
            last = t;
        }
    }

    /// Splitting a ray at a point splits the product.
    #[test]
    fn transmittance_is_multiplicative_along_the_ray(gaussians in gaussians(0..40), a in vec3(-2.0..2.0), b in vec3(-2.0..2.0), at in 0.1f32..0.9) {
        prop_assume!((b - a).length() > 0.1);
        let bvh = GaussianBvh::build(&gaussians).unwrap();
        let whole = bvh.transmittance(a, b - a, 0.0, 1.0);
        let parts = bvh.transmittance(a, b - a, 0.0, at) * bvh.transmittance(a, b - a, at, 1.0);
        prop_assert!((whole - parts).abs() < 1.2e-4);
    }

    #[test]
    fn any_finite_scene_gives_a_finite_share(
        numbers in prop::collection::vec(prop_oneof![any::<f32>(), -2.0f32..2.0, Just(0.0)], 12 * 6),
        a in vec3(-2.0..2.0),
    ) {
        let mut gaussians = Gaussians::default();
        for n in numbers.chunks_exact(12) {
            let scale = Vec3::new(n[3], n[4], n[5]).abs();
            gaussians.push(Vec3::new(n[0], n[1], n[2]), scale, Quat::from_xyzw(n[6], n[7], n[8], n[9]), n[10]);
        }
        let bvh = GaussianBvh::build(&gaussians).unwrap();
        let t = bvh.transmittance(a, -a, 0.0, f32::INFINITY);
        prop_assert!((0.0..=1.0).contains(&t), "{t}");
        for light in [sun(Vec3::Z), lamp(a), lamp(gaussians.means[0])] {
            for v in bvh.visibility_to_light(&gaussians, None, &light, &VisibilityConfig::default()).unwrap() {
                prop_assert!((0.0..=1.0).contains(&v), "{v}");
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 128, failure_persistence: None, ..ProptestConfig::default() })]

    /// [eq:ray-transmittance] A light's grid gives what rays through the tree give, for all and for some receivers, with
    /// and without normals, from lamps and from suns; a cell that lacks an occluder would be noticed.
    #[test]
    fn a_grid_of_a_light_equals_the_tree(
        gaussians in gaussians(1..120), at in vec3(-1.0..1.0), far in 3.0f32..9.0, at_infinity in any::<bool>(),
        with_normals in any::<bool>(),
    ) {
        let direction = at.try_normalize().unwrap_or(Vec3::X);
        let light = if at_infinity { sun(direction) } else { lamp(far * direction) };
        let normals: Vec<Vec3> = gaussians.means.iter().map(|m| m.try_normalize().unwrap_or(Vec3::Z)).collect();
        let normals = with_normals.then_some(normals.as_slice());
        let all: Vec<u32> = (0..gaussians.len() as u32).collect();
        let config = VisibilityConfig::default();
        let expected = GaussianBvh::build(&gaussians).unwrap().visibility_to_light(&gaussians, normals, &light, &config);
        let grid = LightGrid::new(&gaussians, normals, &config).unwrap();
        let found = grid.visibility(&light, &all).unwrap();
        if let Some(found) = &found {
            for (a, b) in expected.unwrap().iter().zip(found) {
                prop_assert!((a - b).abs() <= 1.1e-4, "{a} {b}");
                prop_assert!(a.min(*b) < 1e-4 || (a - b).abs() <= 5e-5, "{a} {b}");
            }
            let some: Vec<u32> = all.iter().copied().filter(|i| i % 3 == 1).collect();
            let few = grid.visibility(&light, &some).unwrap().unwrap();
            for (&i, v) in some.iter().zip(few) {
                prop_assert_eq!(v.to_bits(), found[i as usize].to_bits());
            }
        }
        // Gaussians of at most e^-0.5 reach 3.33 deviations: beyond 4 + 2.1 a lamp has them all in front of it.
        prop_assert!(found.is_some() || (!at_infinity && far < 6.5), "no grid");
    }
}

#[test]
fn a_light_among_the_gaussians_has_no_grid() {
    let (gaussians, normals) = sphere(300, 1.0, 0.2, 0.9);
    let config = VisibilityConfig::default();
    let grid = LightGrid::new(&gaussians, Some(&normals), &config).unwrap();
    let of = |light: &OlatLight| grid.visibility(light, &[0, 5]).unwrap();
    assert!(of(&lamp(Vec3::new(0.2, 0.1, 0.0))).is_none());
    assert!(of(&lamp(Vec3::new(4.0, 0.1, 0.0))).is_some() && of(&sun(Vec3::X)).is_some());
    assert!(grid.visibility(&sun(Vec3::X), &[300]).is_err());
    assert!(LightGrid::new(&gaussians, Some(&normals[1..]), &config).is_err());
    let nothing = LightGrid::new(&Gaussians::default(), None, &config).unwrap();
    assert_eq!(nothing.visibility(&sun(Vec3::X), &[]).unwrap(), Some(vec![]));
}

/// The comparison above must notice an occluder beyond the light.
#[test]
fn the_comparison_notices_a_broken_side() {
    let mut gaussians = Gaussians::default();
    gaussians.push(Vec3::Z * 2.0, Vec3::splat(0.2), Quat::IDENTITY, 0.5);
    let bvh = GaussianBvh::build(&gaussians).unwrap();
    assert!(compare(&gaussians, &bvh, Vec3::ZERO, Vec3::Z, 1.0).unwrap() < 1e-6);
    assert!(compare(&gaussians, &bvh, Vec3::ZERO, Vec3::Z, f64::INFINITY).unwrap() > 0.4);
    let mut tampered = gaussians.clone();
    tampered.opacities[0] = 0.52;
    assert!(compare(&tampered, &bvh, Vec3::ZERO, Vec3::Z * 4.0, 1.0).unwrap() > 0.01);
}

fn sun(direction: Vec3) -> OlatLight {
    OlatLight::Directional { direction, irradiance: Vec3::ONE }
}

fn lamp(position: Vec3) -> OlatLight {
    OlatLight::Point { position, intensity: Vec3::ONE }
}

#[test]
fn only_what_lies_between_receiver_and_light_occludes() {
    let mut gaussians = Gaussians::default();
    gaussians.push(Vec3::ZERO, Vec3::splat(0.01), Quat::IDENTITY, 0.9);
    gaussians.push(Vec3::Z, Vec3::splat(0.1), Quat::IDENTITY, 0.75);
    let bvh = GaussianBvh::build(&gaussians).unwrap();
    let config = VisibilityConfig::default();
    let seen = |light: &OlatLight| bvh.visibility_to_light(&gaussians, None, light, &config).unwrap();
    // The lamp beyond the occluder, between, on the other side, and at infinity.
    let near = |a: &[f32], b: [f32; 2]| assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6), "{a:?} {b:?}");
    near(&seen(&lamp(Vec3::Z * 2.0)), [0.25, 1.0]);
    near(&seen(&lamp(Vec3::Z * 0.5)), [1.0, 1.0]);
    near(&seen(&lamp(Vec3::Z * -2.0)), [1.0, 0.1]);
    near(&seen(&sun(Vec3::Z)), [0.25, 1.0]);
    near(&seen(&sun(Vec3::X)), [1.0, 1.0]);
    // A lamp at the receiver itself.
    near(&seen(&lamp(Vec3::ZERO)), [1.0, 1.0]);
    let subset = bvh.visibility_subset(&gaussians, None, &sun(Vec3::Z), &config, &[1, 0, 1]).unwrap();
    assert_eq!(subset.len(), 3);
    near(&subset[..2], [1.0, 0.25]);
}

#[test]
fn shapes_are_checked() {
    let mut gaussians = Gaussians::default();
    gaussians.push(Vec3::ZERO, Vec3::ONE, Quat::IDENTITY, 0.9);
    let mut bvh = GaussianBvh::build(&gaussians).unwrap();
    let config = VisibilityConfig::default();
    assert!(bvh.visibility_to_light(&gaussians, Some(&[]), &sun(Vec3::Z), &config).is_err());
    assert!(bvh.visibility_subset(&gaussians, None, &sun(Vec3::Z), &config, &[1]).is_err());
    let mut more = gaussians.clone();
    more.push(Vec3::ZERO, Vec3::ONE, Quat::IDENTITY, 0.9);
    assert!(bvh.visibility_to_light(&more, None, &sun(Vec3::Z), &config).is_err());
    assert!(bvh.refit(&more).is_err());
    more.opacities.pop();
    assert!(GaussianBvh::build(&more).is_err());
    let empty = GaussianBvh::build(&Gaussians::default()).unwrap();
    assert!(empty.is_empty() && empty.transmittance(Vec3::ZERO, Vec3::X, 0.0, f32::INFINITY) == 1.0);
    assert_eq!(empty.visibility_to_light(&Gaussians::default(), None, &sun(Vec3::Z), &config), Ok(vec![]));
}

/// A unit sphere of `n` Gaussians on a Fibonacci lattice with outward normals. `flatness` is the scale along the normal relative to
/// the others, which are `spread` times the spacing of the lattice.
fn sphere(n: usize, spread: f32, flatness: f32, opacity: f32) -> (Gaussians, Vec<Vec3>) {
    let mut gaussians = Gaussians::default();
    let mut normals = Vec::new();
    let spacing = (4.0 * std::f32::consts::PI / n as f32).sqrt();
    for i in 0..n {
        let z = 1.0 - (2.0 * i as f32 + 1.0) / n as f32;
        let phi = i as f32 * 2.399_963_2;
        let normal = Vec3::new((1.0 - z * z).sqrt() * phi.cos(), (1.0 - z * z).sqrt() * phi.sin(), z);
        let scale = spread * spacing * Vec3::new(1.0, 1.0, flatness);
        gaussians.push(normal, scale, Quat::from_rotation_arc(Vec3::Z, normal), opacity);
        normals.push(normal);
    }
    (gaussians, normals)
}

/// Mean visibility and its minimum and maximum over the Gaussians whose cosine to the light lies in a range.
fn over(v: &[f32], normals: &[Vec3], light: Vec3, range: std::ops::Range<f32>) -> (f32, f32, f32) {
    let chosen: Vec<f32> =
        v.iter().zip(normals).filter(|(_, n)| range.contains(&n.dot(light))).map(|(v, _)| *v).collect();
    let fold = |f: fn(f32, f32) -> f32, from| chosen.iter().copied().fold(from, f);
    (chosen.iter().sum::<f32>() / chosen.len() as f32, fold(f32::min, 1.0), fold(f32::max, 0.0))
}

/// What the offsets are for: neighbours on the same surface must not black out the side that faces the light, and
/// the far side must stay dark, for thin discs and for the balls that an optimisation begins with.
#[test]
fn a_sphere_of_splats_is_lit_on_one_side() {
    let light = Vec3::new(0.3, -0.5, 0.8).normalize();
    let cosines = |(gaussians, normals): &(Gaussians, Vec<Vec3>), with_normals: bool| {
        let bvh = GaussianBvh::build(gaussians).unwrap();
        let given = with_normals.then_some(normals.as_slice());
        bvh.visibility_to_light(gaussians, given, &sun(light), &VisibilityConfig::default()).unwrap()
    };
    for (spread, flatness) in [(0.7, 0.1), (1.0, 0.1), (1.0, 0.3), (1.0, 1.0)] {
        let scene = sphere(4000, spread, flatness, 0.95);
        let v = cosines(&scene, true);
        let (mean, min, _) = over(&v, &scene.1, light, 0.2..1.01);
        assert!(mean > 0.99 && min > 0.95, "spread {spread}, flatness {flatness}: lit side {mean}, at least {min}");
        let (mean, min, _) = over(&v, &scene.1, light, 0.0..0.2);
        assert!(mean > 0.9 && min > 0.7, "spread {spread}, flatness {flatness}: grazing {mean}, at least {min}");
        let (_, _, max) = over(&v, &scene.1, light, -1.01..-0.5);
        assert!(max < 0.01, "spread {spread}, flatness {flatness}: far side at most {max}");
        // Without normals, flat splats still work; balls lose the light that grazes, which is why normals are wanted.
        let v = cosines(&scene, false);
        let lit_from = if flatness < 0.5 { 0.2 } else { 0.8 };
        let (_, min, _) = over(&v, &scene.1, light, lit_from..1.01);
        assert!(min > 0.98, "spread {spread}, flatness {flatness}, no normals: lit side at least {min}");
        let (_, _, max) = over(&v, &scene.1, light, -1.01..-0.2);
        assert!(max < 0.02, "spread {spread}, flatness {flatness}, no normals: far side at most {max}");
    }
    // The reason for the offset: from the means themselves the lit side is dark.
    let scene = sphere(4000, 1.0, 0.3, 0.95);
    let none = VisibilityConfig { normal_offset: 0.0, light_offset: 0.0 };
    let bvh = GaussianBvh::build(&scene.0).unwrap();
    let v = bvh.visibility_to_light(&scene.0, Some(&scene.1), &sun(light), &none).unwrap();
    assert!(over(&v, &scene.1, light, 0.2..0.8).0 < 0.5);
}

/// A shadow across a gap: a disc of splats above a plane darkens what is under it and nothing else.
#[test]
fn an_occluder_casts_its_shadow() {
    let mut gaussians = Gaussians::default();
    let flat = Vec3::new(0.05, 0.05, 0.005);
    for x in -20..=20 {
        for y in -20..=20 {
            gaussians.push(Vec3::new(x as f32, y as f32, 0.0) * 0.05, flat, Quat::IDENTITY, 0.95);
        }
    }
    let plane = gaussians.len();
    for x in -5..=5 {
        for y in -5..=5 {
            gaussians.push(Vec3::new(x as f32 * 0.05, y as f32 * 0.05, 0.5), flat, Quat::IDENTITY, 0.95);
        }
    }
    let normals = vec![Vec3::Z; gaussians.len()];
    let bvh = GaussianBvh::build(&gaussians).unwrap();
    let v = bvh.visibility_to_light(&gaussians, Some(&normals), &sun(Vec3::Z), &VisibilityConfig::default()).unwrap();
    for i in 0..gaussians.len() {
        let m = gaussians.means[i];
        let reach = m.x.abs().max(m.y.abs());
        match i < plane {
            true if reach < 0.2 => assert!(v[i] < 0.01, "{m}: {}", v[i]),
            true if reach < 0.45 => {}
            _ => assert!(v[i] > 0.99, "{m}: {}", v[i]),
        }
    }
}

#[test]
fn thread_counts_do_not_change_a_bit() {
    let (gaussians, normals) = sphere(3000, 1.0, 0.2, 0.6);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let bvh = GaussianBvh::build(&gaussians).unwrap();
            let light = lamp(Vec3::new(2.0, 1.0, -1.0));
            bvh.visibility_to_light(&gaussians, Some(&normals), &light, &VisibilityConfig::default()).unwrap()
        })
    };
    let one: Vec<u32> = run(1).iter().map(|v| v.to_bits()).collect();
    for threads in [2, 5] {
        assert_eq!(one, run(threads).iter().map(|v| v.to_bits()).collect::<Vec<_>>());
    }
}

/// Milliseconds of this thread: processor time where the system tells, so that a busy machine does not blur it.
fn thread_ms(start: std::time::Instant) -> f64 {
    let read = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let nanoseconds = read.and_then(|s| s.split_whitespace().next()?.parse::<f64>().ok());
    nanoseconds.map_or_else(|| start.elapsed().as_secs_f64() * 1e3, |ns| ns * 1e-6)
}

/// Times on one thread, for whoever changes the hierarchy:
/// `cargo test -p diamond-splat --test visibility -- --ignored --nocapture`.
#[test]
#[ignore = "a measurement, not a test"]
fn timing() {
    let begin = std::time::Instant::now();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    for (n, flatness, opacity) in [(10_000, 0.1, 0.95), (10_000, 1.0, 0.95), (10_000, 0.1, 0.1), (100_000, 0.1, 0.95)] {
        pool.install(|| {
            let (gaussians, normals) = sphere(n, 1.0, flatness, opacity);
            let mean = |f: &mut dyn FnMut()| {
                let start = thread_ms(begin);
                (0..20).for_each(|_| f());
                (thread_ms(begin) - start) / 20.0
            };
            let mut bvh = GaussianBvh::build(&gaussians).unwrap();
            let build = mean(&mut || bvh = GaussianBvh::build(&gaussians).unwrap());
            let refit = mean(&mut || bvh.refit(&gaussians).unwrap());
            let light = sun(Vec3::new(0.3, -0.5, 0.8).normalize());
            let config = VisibilityConfig::default();
            let trace = mean(&mut || {
                bvh.visibility_to_light(&gaussians, Some(&normals), &light, &config).unwrap();
            });
            let all: Vec<u32> = (0..n as u32).collect();
            let new = || LightGrid::new(&gaussians, Some(&normals), &config).unwrap();
            let mut grid = new();
            let prepare = mean(&mut || grid = new());
            let by_grid = mean(&mut || {
                grid.visibility(&light, &all).unwrap().unwrap();
            });
            println!(
                "{n} splats, flatness {flatness}, opacity {opacity}: tree {build:.2} ms, refitted {refit:.2}, light \
                 {trace:.2}; without tree: prepare {prepare:.2}, light {by_grid:.2}"
            );
        });
    }
}
