//! Laws of the other formats: what is written is read back; damaged files are errors, never panics.
mod scratch;
use diamond_dataset::*;
use diamond_light::OlatLight;
use glam::{Quat, Vec3};
use proptest::prelude::*;
use scratch::*;
use std::path::Path;

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

/// Views with any pose and intrinsics.
fn views() -> impl Strategy<Value = Vec<ViewDescription>> {
    let pose = (prop::array::uniform4(-1.0..1.0f32), vec3(9.0));
    let k = (1.0..3000.0f32, 1.0..3000.0f32, -5.0..9.0f32, -5.0..9.0f32);
    prop::collection::vec((pose, k, prop::collection::vec(light(), 1..3), 1u32..6, 1u32..6), 1..4).prop_map(|all| {
        let views = all.into_iter().enumerate();
        views
            .map(|(i, ((q, t), (fx, fy, cx, cy), lights, w, h))| {
                let mut view = view(i, Vec3::X, &lights, (w, h));
                let q = Quat::from_array(q);
                let q = if q.length() > 0.1 { q } else { Quat::IDENTITY };
                view.camera.pose = diamond_camera::Pose::from_quaternion(q, t).unwrap();
                view.camera.intrinsics = diamond_camera::Intrinsics { fx, fy, cx, cy, width: w, height: h };
                view
            })
            .collect()
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn what_is_written_in_any_format_is_read_back(
        train in views(), test in prop::option::of(views()), format in 0..3usize, points in prop::collection::vec((vec3(5.0), any::<[u8; 3]>()), 0..5),
    ) {
        let scratch = Scratch::new();
        let dir = scratch.0.join("written");
        let mut description = CaptureDescription { train, test: test.unwrap_or_default(), ..Default::default() };
        description.train[0].shots[0].weight = 0.25;
        description.train[0].shots[0].provenance = Provenance::Synthetic { method: "relight σ".into() };
        let (positions, colours) = points.into_iter().unzip();
        let points = ColmapPoints { positions, colours };
        let image = |split: Split, v: usize, s: usize| {
            let views = if split == Split::Train { &description.train } else { &description.test };
            let k = views[v].camera.intrinsics;
            Ok(pixels(v, s, (k.width, k.height)))
        };
        match format {
            0 => write_nerfstudio(&dir, &description, image),
            1 => write_colmap(&dir, &description, ColmapEncoding::Text, &points, image),
            _ => write_colmap(&dir, &description, ColmapEncoding::Binary, &points, image),
        }.unwrap();
        let capture = Capture::open(&dir, &description.open_options()).unwrap();
        for (split, views) in [(Split::Train, &description.train), (Split::Test, &description.test)] {
            prop_assert_eq!(capture.views(split).iter().map(|v| v.shots.len()).sum::<usize>(), views.iter().map(|v| v.shots.len()).sum::<usize>());
            for (v, written) in views.iter().enumerate() {
                for (s, asked) in written.shots.iter().enumerate() {
                    let (view, shot) = capture.views(split).iter().find_map(|w| w.shots.iter().find(|x| x.name == asked.name).map(|x| (w, x))).unwrap();
                    prop_assert_eq!(view.camera.intrinsics, written.camera.intrinsics);
                    let (a, b) = (view.camera.pose, written.camera.pose);
                    prop_assert!(a.rotation.abs_diff_eq(b.rotation, 2e-6), "{:?} {:?}", a, b);
                    prop_assert!(a.translation.abs_diff_eq(b.translation, 2e-5), "{:?} {:?}", a, b);
                    prop_assert_eq!((shot.weight, &shot.provenance), (asked.weight, &asked.provenance));
                    match (shot.light, asked.light) {
                        (OlatLight::Directional { direction: a, irradiance: i }, OlatLight::Directional { direction: b, irradiance: j }) => {
                            prop_assert!(a.abs_diff_eq(b, 1e-6) && i == j);
                        }
                        (a, b) => prop_assert_eq!(a, b),
                    }
                    let o = capture.observation(shot).unwrap();
                    let (radiance, mask) = image(split, v, s).unwrap();
                    prop_assert!(o.mask.as_ref().unwrap().data().iter().zip(mask.unwrap().data()).all(|(a, b)| (a - b).abs() < 0.0021));
                    prop_assert!(o.radiance.data().iter().zip(radiance.data()).all(|(a, b)| (a - b).abs() < 0.006));
                }
            }
        }
        if format > 0 {
            prop_assert_eq!(capture.points.is_some(), !points.positions.is_empty());
            if let Some(path) = &capture.points {
                prop_assert_eq!(read_colmap_points(path).unwrap(), points);
            }
        }
    }
}

/// Cuts off, flips, inserts, and replaces words.
fn damage(bytes: &[u8], edits: &[(prop::sample::Index, u8, u8)]) -> Vec<u8> {
    const WORDS: [&str; 12] =
        ["", "nan", "-1", "1e309", "\"\"", "{}", "[]", "null", "18446744073709551615", "../..", "inf", "0"];
    let mut out = bytes.to_vec();
    for (at, kind, value) in edits {
        if out.is_empty() {
            return out;
        }
        let i = at.index(out.len());
        match kind % 6 {
            0 => out[i] = *value,
            1 => out[i] ^= 1 << (value % 8),
            2 => out.truncate(i),
            3 => {
                let n = (usize::from(*value) % 8 + 1).min(out.len() - i);
                out[i..i + n].fill(0xff);
            }
            _ => {
                let separates = |b: &u8| b" ,:[]{}\n".contains(b);
                let start = out[..i].iter().rposition(separates).map_or(0, |p| p + 1);
                let end = out[i..].iter().position(separates).map_or(out.len(), |p| i + p);
                let word = WORDS[usize::from(*value) % WORDS.len()];
                out.splice(start..end.max(start), word.bytes());
            }
        }
    }
    out
}

fn edits() -> impl Strategy<Value = Vec<(prop::sample::Index, u8, u8)>> {
    prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), any::<u8>()), 1..4)
}

fn foreign(name: &str) -> Vec<u8> {
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/fixtures/foreign-captures").join(name))
        .unwrap()
}

/// The message names the file and is a sentence or two; what is accepted is finite and no larger than the input allows.
fn check<T>(result: Result<T, DatasetError>, path: &Path) -> Option<T> {
    match result {
        Ok(value) => Some(value),
        Err(e) => {
            let text = e.to_string();
            assert!(text.contains(&path.display().to_string()) && text.len() < 2000, "{text}");
            None
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn damaged_transforms(edits in edits()) {
        let path = Path::new("transforms.json");
        let bytes = damage(&foreign("nerfstudio/transforms.json"), &edits);
        if let Some(frames) = check(parse_transforms(path, &bytes), path) {
            for frame in &frames.frames {
                prop_assert!(frame.pose.validate().is_ok() && frame.distortion.validate().is_ok());
                prop_assert!(frame.lens.intrinsics(4, 3).validate().is_ok());
            }
        }
    }

    #[test]
    fn damaged_lights(edits in edits()) {
        let path = Path::new("lights.json");
        check(parse_lights(path, &damage(&foreign("nerfstudio/lights.json"), &edits)), path);
    }

    #[test]
    fn damaged_colmap_models(edits in edits(), binary in any::<bool>()) {
        let (folder, extension, encoding) = match binary {
            true => ("pycolmap-binary", "bin", ColmapEncoding::Binary),
            false => ("pycolmap-text", "txt", ColmapEncoding::Text),
        };
        let bytes = |name: &str| damage(&foreign(&format!("{folder}/sparse/0/{name}.{extension}")), &edits);
        let path = Path::new("model");
        if let Some(cameras) = check(parse_colmap_cameras(path, &bytes("cameras"), encoding), path) {
            prop_assert!(cameras.iter().all(|c| c.intrinsics.validate().is_ok() && c.distortion.validate().is_ok()));
        }
        if let Some(images) = check(parse_colmap_images(path, &bytes("images"), encoding), path) {
            prop_assert!(images.len() < 100 && images.iter().all(|i| i.pose.validate().is_ok() && !i.name.is_empty() || binary));
        }
        if let Some(points) = check(parse_colmap_points(path, &bytes("points3D"), encoding), path) {
            prop_assert!(points.positions.len() == points.colours.len() && points.positions.iter().all(|p| p.is_finite()));
        }
    }

    #[test]
    fn damaged_images(edits in edits(), which in 0..6usize) {
        let name = ["pillow.jpg", "pillow_8.png", "opencv_16.png", "openexr_half_zip.exr", "openexr_float_piz.exr", "openexr_layers.exr"][which];
        let path = Path::new("image");
        let bytes = damage(&foreign(&format!("images/images/{name}")), &edits);
        if let Some((w, h, channels)) = check(decode_image(path, &bytes, 1 << 12), path) {
            prop_assert!(u64::from(w) * u64::from(h) <= 1 << 12 && (1..=4).contains(&channels));
        }
    }

    #[test]
    fn any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..200), magic in 0..4usize) {
        let path = Path::new("any");
        let start: &[u8] = [&b""[..], b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"\x76\x2f\x31\x01\x02\0\0\0"][magic];
        check(decode_image(path, &[start, &bytes].concat(), 1 << 12), path);
        for encoding in [ColmapEncoding::Text, ColmapEncoding::Binary] {
            check(parse_colmap_cameras(path, &bytes, encoding), path);
            check(parse_colmap_images(path, &bytes, encoding), path);
            check(parse_colmap_points(path, &bytes, encoding), path);
        }
        check(parse_transforms(path, &bytes), path);
        check(parse_lights(path, &bytes), path);
    }
}
