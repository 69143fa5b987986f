//! Captures in other formats: files of other programs, masks, lights, splits, and conversions between formats.
mod scratch;
use diamond_camera::Distortion;
use diamond_dataset::*;
use diamond_image::Transfer;
use diamond_light::OlatLight;
use glam::Vec3;
use image::ExtendedColorType;
use scratch::*;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

fn foreign(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/fixtures/foreign-captures").join(name)
}

fn all_for_training() -> OpenOptions {
    OpenOptions { hold_out_every: 0, ..OpenOptions::default() }
}

/// Models of pycolmap: each camera projects (with its distortion) to where pycolmap projects.
#[test]
fn models_of_pycolmap_in_text_and_binary() {
    for kind in ["pycolmap-text", "pycolmap-binary"] {
        let capture = Capture::open(&foreign(kind), &all_for_training()).unwrap();
        assert_eq!((capture.format, capture.train.len(), capture.test.len()), (CaptureFormat::Colmap, 6, 0));
        assert!(capture.notes[0].contains("COLMAP") && capture.notes[0].contains("sparse/0"), "{:?}", capture.notes);
        assert!(capture.notes.iter().any(|n| n.contains("4 of 6 images are undistorted")), "{:?}", capture.notes);
        let text = std::fs::read_to_string(foreign(kind).join("expected.json")).unwrap();
        let expected: Value = serde_json::from_str(&text).unwrap();
        let number = |v: &Value| v.as_f64().unwrap();
        let points = read_colmap_points(capture.points.as_ref().unwrap()).unwrap();
        let truth: Vec<[f64; 3]> = expected["points"]
            .as_array()
            .unwrap()
            .iter()
            .map(|p| [number(&p[0]), number(&p[1]), number(&p[2])])
            .collect();
        // The binary file is not in the order of the numbers.
        let find = |p: &[f64; 3]| {
            let near = |q: &&Vec3| q.as_dvec3().distance(glam::DVec3::from(*p)) < 1e-6;
            points.positions.iter().position(|q| near(&q)).unwrap()
        };
        assert_eq!(points.positions.len(), 20);
        for (p, rgb) in truth.iter().zip(expected["colours"].as_array().unwrap()) {
            let colour = points.colours[find(p)].map(f64::from);
            assert_eq!(colour.to_vec(), rgb.as_array().unwrap().iter().map(number).collect::<Vec<_>>());
        }
        let mut worst = 0.0f64;
        for (view, image) in capture.train.iter().zip(expected["images"].as_array().unwrap()) {
            let shot = &view.shots[0];
            assert!(shot.path.ends_with(image["name"].as_str().unwrap()), "{:?}", shot.path);
            let k = view.camera.intrinsics;
            let lens = shot.undistortion.as_ref().map_or(Distortion::None, |u| u.distortion);
            for (p, uv) in truth.iter().zip(image["pixels"].as_array().unwrap()) {
                let c = view.camera.pose.transform_point(Vec3::new(p[0] as f32, p[1] as f32, p[2] as f32)).as_dvec3();
                let [x, y] = lens.distort([c.x / c.z, c.y / c.z]);
                let pixel = [x * f64::from(k.fx) + f64::from(k.cx), y * f64::from(k.fy) + f64::from(k.cy)];
                worst = worst.max((pixel[0] - number(&uv[0])).abs()).max((pixel[1] - number(&uv[1])).abs());
            }
            // A light fixed to the camera.
            let OlatLight::Point { position, intensity } = shot.light else { panic!("{:?}", shot.light) };
            let there = view.camera.pose.transform_point(position);
            assert!(there.distance(Vec3::new(0.1, 0.0, 0.0)) < 1e-6 && intensity == Vec3::splat(2.0));
            let observation = capture.observation(shot).unwrap();
            assert_eq!(observation.radiance.shape(), (16, 12, 3));
            assert!((observation.radiance.pixel(8, 6)[0] - Transfer::Srgb.decode(128.0 / 255.0)).abs() < 0.01);
        }
        assert!(worst < 2e-5, "{kind}: {worst:.1e} px");
        eprintln!("{kind}: pixels differ by at most {worst:.1e}");
    }
}

/// One picture by several programs, read as one radiance.
#[test]
fn images_of_other_programs() {
    let npy = std::fs::read(foreign("images/linear.npy")).unwrap();
    let start = 10 + usize::from(u16::from_le_bytes([npy[8], npy[9]]));
    let linear: Vec<f32> = npy[start..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    let luma = |p: &[f32]| {
        // Pillow weighs encoded values as Rec. 601 does.
        let e: Vec<f32> = p.iter().map(|v| Transfer::Srgb.encode(*v)).collect();
        Transfer::Srgb.decode(0.299 * e[0] + 0.587 * e[1] + 0.114 * e[2])
    };
    let inside = |i: usize| (3..9).contains(&(i / 16)) && (4..12).contains(&(i % 16));
    type Expected<'a> = &'a dyn Fn(usize, &[f32]) -> [f32; 3];
    let same: Expected = &|_, p| [p[0], p[1], p[2]];
    let four: Expected = &|_, p| [4.0 * p[0], 4.0 * p[1], 4.0 * p[2]];
    let four_inside: Expected = &|i, p| if inside(i) { four(i, p) } else { [0.0; 3] };
    let cases: [(&str, Transfer, f32, Expected); 12] = [
        ("pillow_8.png", Transfer::Srgb, 0.5 / 255.0, same),
        ("opencv_16.png", Transfer::Srgb, 0.51 / 65535.0, same),
        ("opencv_linear_16.png", Transfer::Linear, 0.51 / 65535.0, same),
        ("pillow_rgba.png", Transfer::Srgb, 0.5 / 255.0, &|i, p| if inside(i) { same(i, p) } else { [0.0; 3] }),
        ("pillow_grey.png", Transfer::Srgb, 2.0 / 255.0, &|_, p| [luma(p); 3]),
        ("pillow_grey_linear_16.png", Transfer::Linear, 0.51 / 65535.0, &|_, p| [p[0]; 3]),
        ("pillow.jpg", Transfer::Srgb, 9.0 / 255.0, same),
        ("imageio.jpeg", Transfer::Srgb, 20.0 / 255.0, same),
        ("openexr_half_zip.exr", Transfer::Srgb, 1e-3, four),
        ("openexr_float_piz.exr", Transfer::Srgb, 1e-6, four),
        ("openexr_rgba.exr", Transfer::Srgb, 1e-6, four_inside),
        ("openexr_layers.exr", Transfer::Srgb, 1e-6, four),
    ];
    let scratch = Scratch::new();
    for (name, transfer, tolerance, expected) in cases {
        scratch.write(name, std::fs::read(foreign("images/images").join(name)).unwrap());
        let frame = json!({"file_path": name, "light_position": [0, 0, 5], "transform_matrix": matrix()});
        scratch.write("transforms.json", json!({"camera_angle_x": 0.6, "frames": [frame]}).to_string());
        // Straight where there is alpha in a PNG; an EXR is multiplied already, by convention.
        let exr = name.ends_with("exr");
        let alpha_premultiplied = if exr { AlphaPremultiplied::Auto } else { AlphaPremultiplied::No };
        let options = OpenOptions { transfer, alpha_premultiplied, ..all_for_training() };
        let capture = Capture::open(&scratch.0, &options).unwrap();
        let o = capture.observation(&capture.train[0].shots[0]).unwrap();
        let mut worst = 0.0f32;
        for (i, (read, written)) in o.radiance.data().chunks(3).zip(linear.chunks(3)).enumerate() {
            for (a, b) in read.iter().zip(expected(i, written)) {
                // PNG and JPEG round encoded values, EXR linear ones.
                let off =
                    if exr { (a - b).abs() / b.max(1.0) } else { (transfer.encode(*a) - transfer.encode(b)).abs() };
                worst = worst.max(off);
            }
        }
        assert!(worst <= tolerance, "{name}: {worst} > {tolerance}");
        assert_eq!(o.mask.is_some(), name.contains("rgba"), "{name}");
        if let Some(mask) = &o.mask {
            assert_eq!(mask.area(), 48.0, "{name}");
        }
    }
}

#[test]
fn an_exr_may_be_encoded_and_its_data_window_smaller() {
    let scratch = Scratch::new();
    scratch.write("a.exr", std::fs::read(foreign("images/images/openexr_float_piz.exr")).unwrap());
    let frame = json!({"file_path": "a", "light_position": [0, 0, 5], "transform_matrix": matrix()});
    scratch.write("transforms.json", json!({"camera_angle_x": 0.6, "frames": [frame]}).to_string());
    let open = |exr_transfer| {
        let capture = Capture::open(&scratch.0, &OpenOptions { exr_transfer, ..all_for_training() }).unwrap();
        capture.observation(&capture.train[0].shots[0]).unwrap().radiance.pixel(3, 3)[0]
    };
    assert!((open(Transfer::Gamma22) - open(Transfer::Linear).powf(2.2)).abs() < 1e-5);
    // A data window of 2 × 1 at (1, 1) in a display window of 4 × 3.
    use exr::prelude::*;
    let channels = SpecificChannels::rgb(|p: Vec2<usize>| (1.0f32 + p.x() as f32, 0.5f32, -0.25f32));
    let mut image = Image::from_layer(Layer::new(
        (2, 1),
        LayerAttributes { layer_position: Vec2(1, 1), ..LayerAttributes::default() },
        Encoding::UNCOMPRESSED,
        channels,
    ));
    image.attributes.display_window = IntegerBounds::from_dimensions((4, 3));
    image.write().to_file(scratch.0.join("a.exr")).unwrap();
    let capture = Capture::open(&scratch.0, &all_for_training()).unwrap();
    assert_eq!((capture.train[0].camera.intrinsics.width, capture.train[0].camera.intrinsics.height), (4, 3));
    let o = capture.observation(&capture.train[0].shots[0]).unwrap();
    assert_eq!((o.radiance.pixel(1, 1), o.radiance.pixel(2, 1)), (&[1.0, 0.5, 0.0][..], &[2.0, 0.5, 0.0][..]));
    assert_eq!(o.radiance.data().iter().filter(|v| **v != 0.0).count(), 4);
}

#[test]
fn a_folder_in_nerfstudios_layout() {
    let capture = Capture::open(&foreign("nerfstudio"), &OpenOptions::default()).unwrap();
    assert_eq!((capture.format, capture.train.len(), capture.test.len()), (CaptureFormat::Nerfstudio, 3, 0));
    assert!(capture.points.as_ref().unwrap().ends_with("sparse_pc.ply"));
    for part in ["transforms.json", "3 of 3 images are undistorted", "masks: of 3 of 3", "no held-out images"] {
        assert!(capture.notes.iter().any(|n| n.contains(part)), "{part}: {:?}", capture.notes);
    }
    let view = &capture.train[1];
    assert!(view.camera.pose.centre().distance(Vec3::new(3.0 * 0.9f32.cos(), 3.0 * 0.9f32.sin(), 1.0)) < 1e-5);
    assert!(view.camera.pose.transform_point(Vec3::ZERO).distance(Vec3::new(0.0, 0.0, 10f32.sqrt())) < 1e-5);
    let lens = Distortion::Brown { k1: -0.05, k2: 0.01, k3: 0.0, p1: 0.001, p2: -0.002 };
    assert_eq!(view.shots[0].undistortion.as_ref().unwrap().distortion, lens);
    // Written in the world before applied_transform, which swaps x and y and turns z.
    let light = view.shots[0].light;
    assert_eq!(light, OlatLight::Point { position: Vec3::new(2.0, 1.0, -3.0), intensity: Vec3::new(1.0, 0.5, 0.25) });
    let first = &capture.train[0];
    let ahead = first.camera.pose.transform_point(first.shots[0].light.position().unwrap());
    assert!(ahead.distance(Vec3::new(0.0, 0.0, 0.5)) < 1e-5, "{ahead}");
    // The mask and the picture went through the same lens: nothing of the picture is left outside the mask.
    let o = capture.observation(&view.shots[0]).unwrap();
    let mask = o.mask.as_ref().unwrap();
    assert!((75.0..90.0).contains(&mask.area()), "{}", mask.area());
    for (i, rgb) in o.radiance.data().chunks(3).enumerate() {
        assert_eq!(mask.data()[i] == 0.0, rgb == [0.0; 3], "pixel {i}");
    }
    assert_eq!(capture.hash().unwrap().len(), 64);
}

/// A nerfstudio capture of `n` cameras with images of 4 × 2 pixels named `images/i.png`.
fn single_images(n: usize) -> (Scratch, Value) {
    let scratch = Scratch::new();
    let frames: Vec<Value> = (0..n)
        .map(|i| {
            scratch.write(&format!("images/{i}.png"), png(4, 2, ExtendedColorType::Rgb8, &[100; 24]));
            let mut m = matrix();
            m[0][3] = json!(i);
            json!({"file_path": format!("images/{i}.png"), "transform_matrix": m})
        })
        .collect();
    scratch.write("lights.json", r#"{"default": {"direction": [0, 0, 1]}}"#);
    let root = json!({"camera_angle_x": 0.6, "frames": frames});
    scratch.write("transforms.json", root.to_string());
    (scratch, root)
}

#[test]
fn what_is_held_out() {
    let names = |views: &[View]| views.iter().map(|v| v.shots[0].name.clone()).collect::<Vec<_>>().join(" ");
    let (scratch, mut root) = single_images(17);
    let capture = scratch.open().unwrap();
    assert_eq!(names(&capture.test), "7 15");
    assert!(capture.test.iter().all(|v| v.split == Split::Test) && capture.train.len() == 15);
    assert!(capture.notes.iter().any(|n| n.contains("each 8th view is (2 of 17)")), "{:?}", capture.notes);
    assert_eq!(Capture::open(&scratch.0, &all_for_training()).unwrap().train.len(), 17);
    assert_eq!(single_images(7).0.open().unwrap().test.len(), 0, "too few to give any away");
    root["test_filenames"] = json!(["images/3.png", "./images/5"]);
    root["train_filenames"] = json!(["images/0.png", "images/1.png"]);
    scratch.write("transforms.json", root.to_string());
    let capture = scratch.open().unwrap();
    assert_eq!((names(&capture.train).as_str(), names(&capture.test).as_str()), ("0 1", "3 5"));
    let hash = capture.hash().unwrap();
    scratch.write("held_out_list.txt", "# mine\nimages/2\n4.png\nnobody\n");
    let capture = scratch.open().unwrap();
    assert_eq!((capture.train.len(), names(&capture.test).as_str()), (15, "2 4"));
    assert!(capture.notes.iter().any(|n| n.contains("held_out_list.txt: \"nobody\"")), "{:?}", capture.notes);
    assert_ne!(capture.hash().unwrap(), hash);
    // A file of its own goes before all of that.
    scratch.write("transforms_test.json", root.to_string());
    assert_eq!(scratch.open().unwrap().test.len(), 17);
}

#[test]
fn what_the_folder_holds_decides_and_an_option_may() {
    let (scratch, root) = single_images(2);
    let model = foreign("pycolmap-text");
    for name in ["cameras.txt", "images.txt", "points3D.txt"] {
        scratch.write(&format!("sparse/{name}"), std::fs::read(model.join("sparse/0").join(name)).unwrap());
    }
    for i in 0..6 {
        let name = if i == 0 { "set/view 0.jpg".to_string() } else { format!("set/view_{i}.jpg") };
        scratch.write(&format!("images/{name}"), std::fs::read(model.join("images").join(&name)).unwrap());
    }
    let capture = scratch.open().unwrap();
    assert_eq!(capture.format, CaptureFormat::Nerfstudio);
    assert!(capture.notes[0].contains("goes before a COLMAP model"), "{:?}", capture.notes);
    let asked = OpenOptions { format: Some(CaptureFormat::Colmap), ..all_for_training() };
    let capture = Capture::open(&scratch.0, &asked).unwrap();
    assert_eq!((capture.format, capture.train.len()), (CaptureFormat::Colmap, 6));
    let by_file = Capture::open(&scratch.0.join("sparse/cameras.txt"), &all_for_training()).unwrap();
    assert_eq!((by_file.root, by_file.train.len()), (capture.root, 6));
    scratch.write("transforms_train.json", root.to_string());
    assert_eq!(scratch.open().unwrap().format, CaptureFormat::Blender);
    let format = "colmap".parse().unwrap();
    assert!(
        Capture::open(&foreign("nerfstudio"), &OpenOptions { format: Some(format), ..all_for_training() }).is_err()
    );
    assert!("gltf".parse::<CaptureFormat>().unwrap_err().to_string().contains("choose blender, nerfstudio or colmap"));
}

#[test]
fn other_photographs_from_a_camera_that_was_found() {
    let (scratch, _) = single_images(2);
    scratch.write(
        "lights.json",
        json!({"images": {
            "0.png": [{"image": "olat/a", "position": [1, 0, 0]}, {"image": "olat/b.png", "position": [2, 0, 0], "weight": 0.5,
                       "provenance": "synthetic:relight"}],
            "*": {"frame": "camera", "direction": [0, 0, -1]},
        }})
        .to_string(),
    );
    for name in ["a", "b"] {
        scratch.write(&format!("olat/{name}.png"), small_png());
    }
    let capture = scratch.open().unwrap();
    let shots = &capture.train[0].shots;
    assert_eq!((shots.len(), shots[0].name.as_str(), shots[1].name.as_str()), (2, "a", "b"));
    assert_eq!((shots[1].light_index, shots[1].weight), (1, 0.5));
    assert_eq!(shots[1].provenance, Provenance::Synthetic { method: "relight".into() });
    assert_eq!(shots[1].light.position(), Some(Vec3::new(2.0, 0.0, 0.0)));
    assert_eq!(capture.train[1].shots[0].name, "1");
    std::fs::remove_file(scratch.0.join("olat/b.png")).unwrap();
    assert!(scratch.refusal().contains("lights.json, images[\"0.png\"][1]"), "{}", scratch.refusal());
}

#[test]
fn masks_from_files_alpha_and_backgrounds_in_this_order() {
    let (scratch, mut root) = single_images(3);
    let open = || {
        let capture = scratch.open().unwrap();
        let o = capture.observation(&capture.train[0].shots[0]).unwrap();
        (capture.train[0].shots[0].mask.clone(), o.mask.clone(), o.radiance.clone())
    };
    assert_eq!((open().0, open().1), (MaskSource::Alpha, None));
    let grey = |v: [u8; 8]| png(4, 2, ExtendedColorType::L8, &v);
    // A background that differs by noise below the threshold is all background; the alpha goes before it.
    scratch.write("background.png", png(4, 2, ExtendedColorType::Rgb8, &[101; 24]));
    let (source, mask, radiance) = open();
    assert!(matches!(&source, MaskSource::Background(p) if p.ends_with("background.png")));
    assert!(mask.unwrap().area() == 0.0 && radiance.data().iter().all(|v| *v == 0.0));
    scratch.write("background/view_0.jpg", "no image");
    assert!(matches!(open_source(&scratch), MaskSource::Background(p) if p.ends_with("view_0.jpg")));
    std::fs::remove_file(scratch.0.join("background/view_0.jpg")).unwrap();
    scratch.write("images/0.png", png(4, 2, ExtendedColorType::La8, &[80, 255, 80, 0].repeat(4)));
    assert_eq!(open().1.unwrap().area(), 4.0);
    // A mask beside the image, in each of its places; the later go before.
    for (k, place) in
        ["images/masks/0.png", "masks/0.png", "masks/0.png.png", "masks/images/0.png", "images/0_mask.png"]
            .into_iter()
            .enumerate()
    {
        let mut v = [0; 8];
        v[..k + 1].fill(255);
        v[7] = 51;
        scratch.write(place, grey(v));
        let (source, mask, radiance) = open();
        assert!(matches!(source, MaskSource::File(_)), "{place}");
        if place != "masks/0.png.png" {
            assert!((mask.unwrap().area() - (k as f32 + 1.2)).abs() < 1e-6, "{place}");
        }
        // The image is straight under a mask of another file, and its own alpha is not looked at.
        let full = Transfer::Srgb.decode(80.0 / 255.0);
        assert!((radiance.pixel(3, 1)[0] - 0.2 * full).abs() < 1e-6, "{place}: {}", radiance.pixel(3, 1)[0]);
    }
    root["frames"][0]["mask_path"] = json!("named.png");
    scratch.write("named.png", grey([255; 8]));
    scratch.write("transforms.json", root.to_string());
    assert_eq!(open().1.unwrap().area(), 8.0);
    scratch.write("named.png", png(2, 2, ExtendedColorType::L8, &[255; 4]));
    let capture = scratch.open().unwrap();
    let error = capture.observation(&capture.train[0].shots[0]).unwrap_err().to_string();
    assert!(error.contains("named.png") && error.contains("the mask is 2×2 pixels, the image 4×2"), "{error}");
}

fn open_source(scratch: &Scratch) -> MaskSource {
    scratch.open().unwrap().train[0].shots[0].mask.clone()
}

/// The example capture, written in each format, is the same capture.
#[test]
fn the_example_capture_through_every_format() {
    let source = Capture::open(&spot_small(), &OpenOptions::default()).unwrap();
    let scratch = Scratch::new();
    let description = source.describe();
    let points = ColmapPoints { positions: vec![Vec3::ZERO, Vec3::X], colours: vec![[1, 2, 3], [4, 5, 6]] };
    let pixels = |split, v, s| source.pixels_of(split, v, s);
    let at = |name: &str| scratch.0.join(name);
    write_nerfstudio(&at("nerfstudio"), &description, pixels).unwrap();
    write_colmap(&at("text"), &description, ColmapEncoding::Text, &points, pixels).unwrap();
    write_colmap(&at("binary"), &description, ColmapEncoding::Binary, &points, pixels).unwrap();
    // A copy of a copy, through the first format.
    let middle = Capture::open(&at("binary"), &OpenOptions::default()).unwrap();
    write_capture(&at("blender"), &middle.describe(), |split, v, s| middle.pixels_of(split, v, s)).unwrap();
    for name in ["nerfstudio", "text", "binary", "blender"] {
        let copy = Capture::open(&at(name), &OpenOptions::default()).unwrap();
        assert!(copy.points.is_some(), "{name}");
        let mut compared = 0;
        for split in [Split::Train, Split::Test] {
            assert_eq!(copy.views(split).len(), source.views(split).len(), "{name}: {:?}", copy.notes);
            for a in source.views(split) {
                let b = copy.views(split).iter().find(|v| v.name == a.name).unwrap();
                assert_eq!(a.camera.intrinsics, b.camera.intrinsics);
                let (p, q) = (a.camera.pose, b.camera.pose);
                assert!(p.rotation.abs_diff_eq(q.rotation, 1e-6) && p.translation.abs_diff_eq(q.translation, 1e-5));
                assert_eq!(a.shots.len(), b.shots.len());
                for s in &a.shots {
                    let t = b.shots.iter().find(|t| t.name == s.name).unwrap();
                    assert_eq!((s.light, s.weight, &s.provenance), (t.light, t.weight, &t.provenance));
                    if compared % 7 == 0 {
                        assert_eq!(source.observation(s).unwrap(), copy.observation(t).unwrap(), "{name} {}", s.name);
                    }
                    compared += 1;
                }
            }
        }
        assert_eq!(compared, 24 * 6 + 4 * 4, "{name}");
    }
    // The points of the model are read where no point cloud goes before them.
    std::fs::remove_file(at("binary/points3d.ply")).unwrap();
    let model = Capture::open(&at("binary"), &OpenOptions::default()).unwrap();
    assert_eq!(read_colmap_points(model.points.as_ref().unwrap()).unwrap(), points);
}
