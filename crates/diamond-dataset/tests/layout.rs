//! Everything that a valid capture may look like.
mod scratch;
use diamond_dataset::*;
use diamond_light::OlatLight;
use glam::{Vec2, Vec3};
use image::ExtendedColorType;
use scratch::*;
use serde_json::json;

#[test]
fn the_example_capture() {
    let capture = Capture::open(&spot_small(), &OpenOptions::default()).unwrap();
    assert_eq!((capture.train.len(), capture.test.len()), (24, 4));
    assert!(capture.train.iter().all(|v| v.shots.len() == 6) && capture.test.iter().all(|v| v.shots.len() == 4));
    assert!(capture.points.is_some() && capture.notes.is_empty(), "{:?}", capture.notes);
    assert_eq!(capture.test[1].name, "r_2");
    assert_eq!(capture.test[1].shots[2].name, "r_2_l_5");
    assert!(capture.alpha_premultiplied(), "RGB over black, multiplied in linear light");

    let scene = capture.scene();
    assert!(scene.centre.length() < 1e-3, "{scene:?}");
    assert!((4.4..5.2).contains(&scene.camera_extent), "the cameras' mean is off the centre: {scene:?}");
    assert!((scene.framed_radius - 4.0 * (0.5 * 0.610_865_2f32).sin()).abs() < 1e-2, "{scene:?}");

    // Test lights 1 and 2 are training lights, 5 and 7 are not.
    let seen: Vec<bool> = capture.test[0].shots.iter().map(|shot| capture.is_seen_light(&shot.light)).collect();
    assert_eq!(seen, [true, true, false, false]);
    let without = capture.select(&Selection::All, &"0,1,2".parse().unwrap()).unwrap();
    let seen: Vec<bool> = capture.test[0].shots.iter().map(|shot| without.is_seen_light(&shot.light)).collect();
    assert_eq!(seen, [true, false, false, false]);

    // One camera alone: the point of its axis nearest to the origin.
    let alone = capture.select(&Selection::Count(1), &Selection::All).unwrap().scene();
    assert!(alone.centre.length() < 1e-2 && (alone.camera_extent - 4.0).abs() < 1e-2, "{alone:?}");

    let shot = &capture.test[2].shots[0];
    let observation = capture.observation(shot).unwrap();
    let file = image::open(&shot.path).unwrap().to_rgb8().into_raw();
    assert_eq!(observation.display, file, "8-bit sRGB over black is its own display picture");
    let mask = observation.mask.as_ref().unwrap();
    assert!(mask.area() > 1000.0);
    assert_eq!(capture.hash().unwrap().len(), 64);
    assert_eq!(capture.hash().unwrap(), without.hash().unwrap());

    // True geometry agrees with the camera: the points seen lie near the unit ball's centre, and face the camera.
    let geometry = capture.test[0].ground_truth_geometry().unwrap().unwrap();
    let camera = &capture.test[0].camera;
    let mut hits = 0;
    for y in 0..128 {
        for x in 0..128 {
            let z = geometry.depth.pixel(x, y)[0];
            if z > 0.0 {
                hits += 1;
                let p = camera.unproject(Vec2::new(x as f32 + 0.5, y as f32 + 0.5), diamond_camera::Depth::Z(z));
                assert!(p.length() < 1.1, "({x}, {y}) at {p}");
                if mask.coverage(x, y) == 1.0 {
                    let n = Vec3::from_slice(geometry.normal.pixel(x, y));
                    assert!(n.length() > 0.2 && n.length() < 1.001);
                }
            }
        }
    }
    assert!(hits > 1000);
    assert!(capture.train[0].ground_truth_geometry().unwrap().is_none());
}

#[test]
fn a_json_file_stands_for_its_folder() {
    let whole = Capture::open(&spot_small(), &OpenOptions::default()).unwrap();
    for name in ["transforms_train.json", "transforms_test.json"] {
        let capture = Capture::open(&spot_small().join(name), &OpenOptions::default()).unwrap();
        assert_eq!((capture.train == whole.train, capture.test == whole.test), (true, true), "{name}");
    }
    let scratch = capture_with(|_| {});
    scratch.write("mine.json", std::fs::read(scratch.0.join("transforms_train.json")).unwrap());
    scratch.write("transforms_test.json", "broken");
    assert!(Capture::open(&scratch.0.join("mine.json"), &OpenOptions::default()).unwrap().test.is_empty());
}

#[test]
fn eval_stands_in_for_test() {
    let scratch = capture_with(|_| {});
    let json = std::fs::read_to_string(scratch.0.join("transforms_train.json")).unwrap();
    scratch.write("transforms_eval.json", json.replace("train/", "eval/").replace("r_0_l_1", "r_0_l_9"));
    scratch.write("eval/r_0_l_0.png", small_png());
    scratch.write("eval/r_0_l_9.png", small_png());
    assert_eq!(scratch.open().unwrap().test[0].shots[1].name, "r_0_l_9");
    scratch.write("transforms_test.json", json.replace("train/r_0_l_0", "eval/r_0_l_0"));
    assert_eq!(scratch.open().unwrap().test[0].shots[1].name, "r_0_l_1");
    let options = OpenOptions { eval_split: EvalSplit::Eval, ..OpenOptions::default() };
    assert_eq!(Capture::open(&scratch.0, &options).unwrap().test[0].shots[1].name, "r_0_l_9");
    // An empty test split is no error, but it is said.
    scratch.write("transforms_test.json", "{\"camera_angle_x\": 1, \"frames\": []}");
    let capture = scratch.open().unwrap();
    assert!(capture.test.is_empty() && capture.notes.iter().any(|n| n.contains("no held-out")));
}

#[test]
fn intrinsics_of_the_frame_of_the_file_and_of_the_image() {
    let open = |change: fn(&mut serde_json::Value)| capture_with(change).open().unwrap().train[0].camera.intrinsics;
    let k = open(|_| {});
    assert_eq!((k.width, k.height, k.cx, k.cy), (4, 2, 2.0, 1.0));
    assert!((k.fx - 2.0 / 0.3f32.tan()).abs() < 1e-5 && k.fx == k.fy);
    let k = open(|j| {
        let frame = &mut j["frames"][0];
        (frame["fl_x"], frame["fl_y"], frame["cx"], frame["cy"]) = (json!(7), json!(8), json!(1.5), json!(-3));
    });
    assert_eq!((k.fx, k.fy, k.cx, k.cy), (7.0, 8.0, 1.5, -3.0));
    let k = open(|j| (j["frames"][0]["width"], j["frames"][0]["height"]) = (json!(null), json!(null)));
    assert_eq!((k.width, k.height), (4, 2));
    let k = open(|j| {
        *j = json!({"fl_x": 9, "cx": 1, "w": 4.0, "h": 2, "frames": [frame()]});
        j["frames"][0].as_object_mut().unwrap().remove("width");
    });
    assert_eq!((k.fx, k.fy, k.cx, k.cy), (9.0, 9.0, 1.0, 1.0));
    // Several cameras in one capture keep their own.
    let capture = capture_with(|j| {
        let mut second = frame();
        second["file_paths"] = json!(["train/r_1_l_0", "train/r_1_l_1"]);
        second["fl_x"] = json!(20);
        j["frames"].as_array_mut().unwrap().push(second);
    });
    capture.write("train/r_1_l_0.png", small_png());
    capture.write("train/r_1_l_1.png", small_png());
    let capture = capture.open().unwrap();
    assert_eq!(capture.train[1].camera.intrinsics.fx, 20.0);
    assert_ne!(capture.train[0].camera.intrinsics.fx, 20.0);
}

#[test]
fn light_positions_are_taken_as_written() {
    let capture = capture_with(|j| {
        j["frames"][0]["light_positions"] = json!([[1, 2, 3], [-4, 5.5, -6]]);
        j["frames"][0]["light_intensities"] = json!([[1, 0.5, 0], 2]);
        j["frames"][0]["rotation"] = json!("unused");
    });
    let shots = &capture.open().unwrap().train[0].shots;
    let at = |x, y, z, intensity| OlatLight::Point { position: Vec3::new(x, y, z), intensity };
    assert_eq!(shots[0].light, at(1.0, 2.0, 3.0, Vec3::new(1.0, 0.5, 0.0)));
    assert_eq!(shots[1].light, at(-4.0, 5.5, -6.0, Vec3::splat(2.0)));
}

#[test]
fn one_image_per_frame_is_grouped_into_views() {
    let scratch = Scratch::new();
    let mut moved = matrix();
    moved[0][3] = json!(1);
    scratch.write(
        "transforms.json",
        json!({"camera_angle_x": 0.6, "k1": 0.1, "frames": [
            {"file_path": "./images/a.png", "light_position": [0, 0, 5], "transform_matrix": matrix()},
            {"file_path": "images/b", "light_position": [1, 0, 5], "transform_matrix": moved},
            {"file_path": "images/c.PNG", "light_direction": [0, 0, 2], "transform_matrix": matrix(),
             "light_intensity": 3, "weight": 0.5, "provenance": "synthetic:relight"},
        ]})
        .to_string(),
    );
    for name in ["a.png", "b.png", "c.PNG"] {
        scratch.write(&format!("images/{name}"), small_png());
    }
    let capture = scratch.open().unwrap();
    assert_eq!(capture.train.len(), 2);
    let names: Vec<&str> = capture.train[0].shots.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(names, ["a", "c"]);
    let shot = &capture.train[0].shots[1];
    assert_eq!(shot.light, OlatLight::Directional { direction: Vec3::Z, irradiance: Vec3::splat(3.0) });
    assert_eq!(shot.provenance, Provenance::Synthetic { method: "relight".into() });
    assert_eq!((shot.weight, shot.light_index), (0.5, 1));
    assert!(capture.notes.iter().any(|n| n.contains("3 of 3 images are undistorted")), "{:?}", capture.notes);
    assert_eq!(capture.format, CaptureFormat::Nerfstudio);
}

#[test]
fn excluded_images_are_left_out_even_if_they_are_gone() {
    let scratch = capture_with(|_| {});
    std::fs::remove_file(scratch.0.join("train/r_0_l_0.png")).unwrap();
    for line in ["r_0_l_0", "r_0_l_0.png", "train/r_0_l_0", "./train/r_0_l_0.PNG  # flare"] {
        scratch.write("exclude_list.txt", format!("\u{feff}# bad ones\r\n{line}\r\n\r\nnobody\n"));
        let capture = scratch.open().unwrap();
        assert_eq!(capture.train[0].shots.len(), 1, "{line}");
        assert_eq!(capture.train[0].shots[0].light_index, 1);
        assert!(capture.notes.iter().any(|n| n.contains("\"nobody\" names no image")), "{:?}", capture.notes);
    }
}

#[test]
fn names_that_collide_are_told_apart() {
    let capture = capture_with(|j| j["frames"][0]["file_paths"] = json!(["a/x", "b/x"]));
    capture.write("a/x.png", small_png());
    capture.write("b/x.png", small_png());
    let capture = capture.open().unwrap();
    let names: Vec<&str> = capture.train[0].shots.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(names, ["a_x", "b_x"]);
    assert_eq!(capture.train[0].name, "view_0");
}

#[test]
fn every_kind_of_png() {
    let observe = |bytes: Vec<u8>, options: OpenOptions| {
        let scratch = capture_with(|_| {});
        scratch.write("train/r_0_l_0.png", bytes);
        let capture = Capture::open(&scratch.0, &options).unwrap();
        (*capture.observation(&capture.train[0].shots[0]).unwrap()).clone()
    };
    let linear = || OpenOptions {
        transfer: TransferChoice::Linear,
        alpha_premultiplied: AlphaPremultiplied::Yes,
        ..OpenOptions::default()
    };
    let bytes = |n: usize| (0..n).map(|i| (i * 9 % 256) as u8).collect::<Vec<u8>>();
    for (colour, channels, wide) in [
        (ExtendedColorType::L8, 1, false),
        (ExtendedColorType::La8, 2, false),
        (ExtendedColorType::Rgb8, 3, false),
        (ExtendedColorType::Rgba8, 4, false),
        (ExtendedColorType::L16, 1, true),
        (ExtendedColorType::La16, 2, true),
        (ExtendedColorType::Rgb16, 3, true),
        (ExtendedColorType::Rgba16, 4, true),
    ] {
        let samples = bytes(8 * channels * if wide { 2 } else { 1 });
        let o = observe(png(4, 2, colour, &samples), linear());
        assert_eq!(o.mask.is_some(), channels % 2 == 0, "{colour:?}");
        let value = |i: usize| match wide {
            false => f32::from(samples[i]) / 255.0,
            true => f32::from(u16::from_ne_bytes([samples[2 * i], samples[2 * i + 1]])) / 65535.0,
        };
        for pixel in 0..8 {
            for c in 0..3 {
                let expected = value(pixel * channels + if channels < 3 { 0 } else { c });
                assert_eq!(o.radiance.data()[pixel * 3 + c], expected, "{colour:?}");
            }
            if let Some(mask) = &o.mask {
                assert_eq!(mask.data()[pixel], value(pixel * channels + channels - 1), "{colour:?}");
            }
        }
        assert_eq!(o.display.len(), 24);
    }
}

#[test]
fn a_palette_is_expanded() {
    // 4 × 2 pixels of 2-bit indices into four colours, the last of them transparent: made with the png format alone.
    let bytes: &[u8] = include_bytes!("palette.png");
    let scratch = capture_with(|_| {});
    scratch.write("train/r_0_l_0.png", bytes);
    let capture = scratch.open().unwrap();
    let o = capture.observation(&capture.train[0].shots[0]).unwrap();
    assert_eq!(o.display[..12], [255, 0, 0, 0, 255, 0, 0, 0, 255, 0, 0, 0]);
    assert_eq!(o.mask.as_ref().unwrap().data()[..4], [1.0, 1.0, 1.0, 0.0]);
}

#[test]
fn without_alpha_there_is_no_mask() {
    let scratch = capture_with(|_| {});
    for name in ["r_0_l_0", "r_0_l_1"] {
        scratch.write(&format!("train/{name}.png"), png(4, 2, ExtendedColorType::Rgb8, &[200; 24]));
    }
    let capture = scratch.open().unwrap();
    let o = capture.observation(&capture.train[0].shots[0]).unwrap();
    assert!(o.mask.is_none() && o.display == [200; 24]);
}

#[test]
fn transfers_are_honoured() {
    let scratch = capture_with(|_| {});
    let value = |transfer| {
        let capture = Capture::open(&scratch.0, &OpenOptions { transfer, ..OpenOptions::default() }).unwrap();
        capture.observation(&capture.train[0].shots[0]).unwrap().radiance.pixel(3, 1)[0]
    };
    let stored = 70.0 / 255.0;
    assert_eq!(value(TransferChoice::Linear), stored);
    assert!((value(TransferChoice::Gamma22) - stored.powf(2.2)).abs() < 1e-6);
    assert!((value(TransferChoice::Srgb) - TransferChoice::Srgb.decode(stored)).abs() < 1e-6);
}

#[test]
fn one_view_or_one_light_is_enough() {
    let capture = capture_with(|j| {
        j["frames"][0]["file_paths"] = json!(["train/r_0_l_0"]);
        j["frames"][0]["light_positions"] = json!([[0, 0, 0]]);
    });
    let capture = capture.open().unwrap();
    let scene = capture.scene();
    assert!(scene.centre.length() < 1e-4 && scene.camera_extent == 4.0, "{scene:?}");
    // A light in the centre of the scene has no direction; it is still itself.
    assert!(capture.is_seen_light(&capture.train[0].shots[0].light));
    let selected = capture.select(&Selection::Count(3), &Selection::Count(3)).unwrap();
    assert_eq!(selected.train, capture.train);
    assert!(capture.observation(&capture.train[0].shots[0]).is_ok());
}

#[test]
fn the_cache_stays_within_its_bound_and_changes_nothing() {
    let image_bytes = 128 * 128 * 4;
    let open = |cache_bytes| {
        let alpha_premultiplied = AlphaPremultiplied::Yes;
        Capture::open(&spot_small(), &OpenOptions { cache_bytes, alpha_premultiplied, ..OpenOptions::default() })
            .unwrap()
    };
    let (tight, roomy, none) = (open(3 * image_bytes), open(1 << 30), open(0));
    let shots: Vec<Shot> = roomy.train[..4].iter().flat_map(|v| v.shots.clone()).collect();
    std::thread::scope(|scope| {
        for offset in 0..3 {
            let (tight, roomy, none, shots) = (&tight, &roomy, &none, &shots);
            scope.spawn(move || {
                for i in 0..shots.len() {
                    let shot = &shots[(i * 5 + offset * 7) % shots.len()];
                    let expected = roomy.observation(shot).unwrap();
                    assert_eq!(*tight.observation(shot).unwrap(), *expected);
                    assert_eq!(*none.observation(shot).unwrap(), *expected);
                    assert!(tight.cached_bytes() <= 3 * image_bytes);
                }
            });
        }
    });
    assert_eq!((none.cached_bytes(), roomy.cached_bytes()), (0, shots.len() * image_bytes));
}
