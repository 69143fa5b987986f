//! Laws of captures: what is written is read back, any damage is an error and no panic, selections are selections.
mod scratch;
use diamond_dataset::*;
use diamond_image::Transfer;
use diamond_light::OlatLight;
use glam::Vec3;
use proptest::prelude::*;
use scratch::*;

fn vec3(range: f32) -> impl Strategy<Value = Vec3> {
    [-range..range, -range..range, -range..range].prop_map(Vec3::from)
}

fn light() -> impl Strategy<Value = OlatLight> {
    prop_oneof![
        (vec3(6.0), vec3(2.0)).prop_map(|(position, i)| OlatLight::Point { position, intensity: i.abs() }),
        (vec3(1.0), vec3(2.0)).prop_map(|(d, i)| OlatLight::Directional {
            direction: d.try_normalize().unwrap_or(Vec3::Z),
            irradiance: i.abs(),
        }),
    ]
}

/// A few views with a few lights each, no two views alike in number.
fn views() -> impl Strategy<Value = Vec<ViewDescription>> {
    let eye = vec3(5.0).prop_map(|e| e + e.try_normalize().unwrap_or(Vec3::X));
    prop::collection::vec((eye, prop::collection::vec(light(), 1..4), 1u32..6, 1u32..6), 1..4).prop_map(|all| {
        all.into_iter().enumerate().map(|(i, (eye, lights, w, h))| view(i, eye, &lights, (w, h))).collect()
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn what_is_written_is_read_back(
        train in views(),
        test in prop::option::of(views()),
        masked in any::<bool>(),
        sixteen in any::<bool>(),
        transfer in prop::sample::select(vec![Transfer::Srgb, Transfer::Linear, Transfer::Gamma22]),
        synthetic in any::<bool>(),
    ) {
        let scratch = Scratch::new();
        let dir = scratch.0.join("written");
        let mut description = CaptureDescription { train, test: test.unwrap_or_default(), transfer, ..Default::default() };
        description.depth = if sixteen { BitDepth::Sixteen } else { BitDepth::Eight };
        if synthetic {
            let shot = &mut description.train[0].shots[0];
            shot.provenance = Provenance::Synthetic { method: "relight v1: σ".into() };
            shot.weight = 0.5;
        }
        let image = |description: &CaptureDescription, split: Split, v: usize, s: usize| {
            let views = if split == Split::Train { &description.train } else { &description.test };
            let k = views[v].camera.intrinsics;
            let (radiance, mask) = pixels(v, s, (k.width, k.height));
            (radiance, mask.filter(|_| masked))
        };
        write_capture(&dir, &description, |split, v, s| Ok(image(&description, split, v, s))).unwrap();
        let capture = Capture::open(&dir, &description.open_options()).unwrap();
        let mut compared = 0;
        for (split, views) in [(Split::Train, &description.train), (Split::Test, &description.test)] {
            prop_assert_eq!(capture.views(split).len(), views.len());
            for (v, (read, written)) in capture.views(split).iter().zip(views).enumerate() {
                prop_assert_eq!(read.camera.intrinsics, written.camera.intrinsics);
                let (a, b) = (read.camera.pose, written.camera.pose);
                prop_assert!(a.rotation.abs_diff_eq(b.rotation, 1e-6), "{:?} {:?}", a, b);
                prop_assert!(a.translation.abs_diff_eq(b.translation, 1e-5), "{:?} {:?}", a, b);
                prop_assert_eq!(read.shots.len(), written.shots.len());
                for (s, (shot, asked)) in read.shots.iter().zip(&written.shots).enumerate() {
                    prop_assert_eq!((&shot.name, &shot.provenance, shot.weight), (&asked.name, &asked.provenance, asked.weight));
                    match (shot.light, asked.light) {
                        (OlatLight::Directional { direction: a, irradiance: i }, OlatLight::Directional { direction: b, irradiance: j }) => {
                            prop_assert!(a.abs_diff_eq(b, 1e-6) && i == j);
                        }
                        (a, b) => prop_assert_eq!(a, b),
                    }
                    let (radiance, mask) = image(&description, split, v, s);
                    let observation = capture.observation(shot).unwrap();
                    let steps = if sixteen { 65535.0 } else { 255.0 };
                    for (a, b) in observation.radiance.data().iter().zip(radiance.data()) {
                        let off = (transfer.encode(*a) - transfer.encode(*b)).abs();
                        prop_assert!(off <= 0.501 / steps, "{} {}", a, b);
                    }
                    prop_assert_eq!(observation.mask.is_some(), mask.is_some());
                    if let (Some(a), Some(b)) = (&observation.mask, &mask) {
                        prop_assert!(a.data().iter().zip(b.data()).all(|(a, b)| (a - b).abs() <= 0.501 / steps));
                    }
                    prop_assert_eq!(&observation.display, &to_display(&observation.radiance));
                    compared += 1;
                }
            }
        }
        prop_assert!(compared > 0);
        // A copy of a copy is the same capture.
        let copy = scratch.0.join("copy");
        let second = CaptureDescription { depth: description.depth, ..capture.describe() };
        write_capture(&copy, &second, |split, v, s| capture.pixels_of(split, v, s)).unwrap();
        let again = Capture::open(&copy, &second.open_options()).unwrap();
        for (a, b) in capture.train.iter().zip(&again.train) {
            for (a, b) in a.shots.iter().zip(&b.shots) {
                prop_assert_eq!(capture.observation(a).unwrap(), again.observation(b).unwrap());
            }
        }
    }

    #[test]
    fn selections_are_evenly_spread_and_repeatable(views in 1usize..30, lights in 1usize..12) {
        let capture = Capture::open(&spot_small(), &OpenOptions::default()).unwrap();
        let chosen = capture.select(&Selection::Count(views), &Selection::Count(lights)).unwrap();
        prop_assert_eq!(chosen.train.len(), views.min(24));
        prop_assert!(chosen.train.iter().all(|view| view.shots.len() == lights.min(6)));
        prop_assert_eq!(&chosen.test, &capture.test);
        let light_indices = |view: &View| view.shots.iter().map(|shot| shot.light_index).collect::<Vec<_>>();
        let first = light_indices(&chosen.train[0]);
        prop_assert!(chosen.train.iter().all(|view| light_indices(view) == first), "the rig is shared");
        let again = capture.select(&Selection::Count(views), &Selection::Count(lights)).unwrap();
        prop_assert_eq!(&again.train, &chosen.train);
        // What a count chose can be asked for by list.
        let list = Selection::List(chosen.train.iter().map(|view| view.index).collect());
        let by_list = capture.select(&list, &Selection::List(first)).unwrap();
        prop_assert_eq!(&by_list.train, &chosen.train);
        // Farthest points: any two that were chosen are at least as far apart as any other is from the nearest chosen.
        if views < 24 && views > 1 {
            let centre = capture.scene().centre;
            let direction = |view: &View| (view.camera.pose.centre() - centre).normalize();
            let kept: Vec<Vec3> = chosen.train.iter().map(direction).collect();
            let mut apart = f32::INFINITY;
            for (i, a) in kept.iter().enumerate() {
                for b in &kept[..i] {
                    apart = apart.min(a.distance(*b));
                }
            }
            let nearest = |d: Vec3| kept.iter().map(|k| k.distance(d)).fold(f32::INFINITY, f32::min);
            let uncovered = capture.train.iter().map(|view| nearest(direction(view))).fold(0.0, f32::max);
            prop_assert!(uncovered <= apart + 1e-4);
        }
    }
}

/// What opens and what loads of a capture; any error will do.
fn exercise(scratch: &Scratch) {
    let options = OpenOptions { max_pixels: 1 << 16, cache_bytes: 1 << 16, ..OpenOptions::default() };
    let Ok(capture) = Capture::open(&scratch.0, &options) else { return };
    for shot in capture.train.iter().chain(&capture.test).flat_map(|view| &view.shots) {
        if let Ok(observation) = capture.observation(shot) {
            assert!(observation.radiance.pixels() <= 1 << 16);
            assert!(observation.radiance.first_non_finite().is_none());
        }
        capture.is_seen_light(&shot.light);
    }
    let scene = capture.scene();
    assert!(
        scene.centre.is_finite() && scene.camera_extent.is_finite() && scene.framed_radius.is_finite(),
        "{scene:?}"
    );
    assert!(scene.camera_extent > 0.0 && scene.framed_radius > 0.0, "{scene:?}");
    let _ = capture.select(&Selection::Count(2), &Selection::Count(1));
    for view in &capture.train {
        let _ = view.ground_truth_geometry();
    }
    assert!(capture.cached_bytes() <= 1 << 16);
}

/// Replaces, inserts or removes a few bytes, or cuts the rest off.
fn damage(bytes: &[u8], edits: &[(prop::sample::Index, u8, u8)]) -> Vec<u8> {
    let mut out = bytes.to_vec();
    for (at, kind, value) in edits {
        if out.is_empty() {
            return out;
        }
        let i = at.index(out.len());
        match kind % 5 {
            0 => out[i] = *value,
            1 => out[i] ^= 1 << (value % 8),
            2 => out.insert(i, *value),
            3 => drop(out.remove(i)),
            _ => out.truncate(i.max(8)),
        }
    }
    out
}

fn edits() -> impl Strategy<Value = Vec<(prop::sample::Index, u8, u8)>> {
    // Digits, brackets, minus and exponent turn JSON into other JSON more often than random bytes do.
    let value = prop_oneof![any::<u8>(), prop::sample::select(b"0123456789-+.eE[]{},:\"n".to_vec())];
    prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), value), 1..5)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn damaged_json_is_an_error_and_no_panic(edits in edits()) {
        let scratch = capture_with(|j| {
            j["frames"][0]["light_intensities"] = serde_json::json!([[1, 2, 3], [1, 1, 1]]);
            j["frames"][0]["fl_x"] = serde_json::json!(6.5);
        });
        let text = std::fs::read(scratch.0.join("transforms_train.json")).unwrap();
        scratch.write("transforms_train.json", damage(&text, &edits));
        exercise(&scratch);
    }

    #[test]
    fn a_damaged_png_is_an_error_and_no_panic(edits in edits(), sized in any::<bool>(), repair in any::<bool>()) {
        let scratch = capture_with(|j| if !sized { j["frames"][0]["width"] = serde_json::Value::Null });
        let mut bytes = damage(&small_png(), &edits);
        if repair && bytes.len() > 33 {
            // With its checksum mended, a damaged header reaches the decoder.
            let crc = crc32(&bytes[12..29]);
            bytes[29..33].copy_from_slice(&crc.to_be_bytes());
        }
        scratch.write("train/r_0_l_0.png", bytes);
        exercise(&scratch);
    }

    #[test]
    fn a_damaged_exr_is_an_error_and_no_panic(edits in edits()) {
        let scratch = capture_with(|_| {});
        let mut bytes = std::fs::read(spot_small().join("geometry/test_r_2.exr")).unwrap();
        // Only the header and the first blocks: this is where sizes and offsets stand.
        bytes.truncate(4096);
        scratch.write("geometry/train_r_0.exr", damage(&bytes, &edits));
        exercise(&scratch);
    }

    #[test]
    fn any_json_is_an_error_and_no_panic(value in json_value()) {
        let scratch = capture_with(|j| j["frames"][0]["light_positions"] = value);
        exercise(&scratch);
    }
}

fn json_value() -> impl Strategy<Value = serde_json::Value> {
    use serde_json::Value;
    let number = prop_oneof![any::<f64>().prop_map(Value::from), (-1e20..1e20f64).prop_map(Value::from)];
    let leaf = prop_oneof![Just(Value::Null), any::<bool>().prop_map(Value::from), number, ".*".prop_map(Value::from)];
    leaf.prop_recursive(3, 12, 3, |inner| prop::collection::vec(inner, 0..4).prop_map(Value::from))
}

fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |c, _| if c & 1 == 1 { (c >> 1) ^ 0xEDB8_8320 } else { c >> 1 })
    })
}

/// The comparison above can fail: with one value of one image changed it must.
#[test]
fn the_round_trip_notices_a_changed_pixel() {
    let scratch = Scratch::new();
    let light = OlatLight::Point { position: Vec3::Z * 5.0, intensity: Vec3::ONE };
    let description =
        CaptureDescription { train: vec![view(0, Vec3::X * 4.0, &[light], (4, 3))], ..Default::default() };
    let (a, b) = (scratch.0.join("a"), scratch.0.join("b"));
    write_capture(&a, &description, |_, v, s| Ok(pixels(v, s, (4, 3)))).unwrap();
    write_capture(&b, &description, |_, v, s| {
        let mut changed = pixels(v, s, (4, 3));
        changed.0.pixel_mut(2, 1)[1] += 0.02;
        Ok(changed)
    })
    .unwrap();
    let open = |dir: &std::path::Path| Capture::open(dir, &description.open_options()).unwrap();
    let (a, b) = (open(&a), open(&b));
    let load = |c: &Capture| c.observation(&c.train[0].shots[0]).unwrap();
    let differing = load(&a).radiance.data().iter().zip(load(&b).radiance.data()).filter(|(x, y)| x != y).count();
    assert_eq!(differing, 1);
    assert_ne!(a.hash().unwrap(), b.hash().unwrap());
    assert_eq!(a.hash().unwrap(), open(&a.root).hash().unwrap());
}

/// On a turntable each view has lights of its own; a choice is then made per view.
#[test]
fn a_turntable_chooses_lights_view_by_view() {
    let scratch = Scratch::new();
    let lights = |turn: f32| -> Vec<OlatLight> {
        let at = |a: f32| Vec3::new((turn + a).cos() * 5.0, (turn + a).sin() * 5.0, 1.0);
        (0..8).map(|i| OlatLight::Point { position: at(i as f32 * 0.785), intensity: Vec3::ONE }).collect()
    };
    let train = (0..5).map(|v| view(v, Vec3::new(4.0, 0.0, 0.2 * v as f32), &lights(0.3 * v as f32), (2, 2))).collect();
    let description = CaptureDescription { train, ..Default::default() };
    let dir = scratch.0.join("turntable");
    write_capture(&dir, &description, |_, v, s| Ok(pixels(v, s, (2, 2)))).unwrap();
    let capture = Capture::open(&dir, &description.open_options()).unwrap();
    let chosen = capture.select(&Selection::All, &Selection::Count(2)).unwrap();
    assert!(chosen.train.iter().all(|view| view.shots.len() == 2));
    let by_list = capture.select(&Selection::All, &"7,".parse().unwrap()).unwrap();
    assert!(by_list.train.iter().all(|view| view.shots.len() == 1 && view.shots[0].light_index == 7));
    // An incomplete grid: the view that lacks the light is left out.
    std::fs::write(dir.join("exclude_list.txt"), "r_2_l_7\n").unwrap();
    let capture = Capture::open(&dir, &description.open_options()).unwrap();
    let by_list = capture.select(&Selection::All, &"7,".parse().unwrap()).unwrap();
    assert_eq!(by_list.train.len(), 4);
    assert!(capture.select(&Selection::All, &"8,".parse().unwrap()).is_err());
}
