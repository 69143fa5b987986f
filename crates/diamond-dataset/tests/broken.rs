//! Broken captures: each gives an error that names the file, the frame and the field, and none a panic.
mod scratch;
use diamond_dataset::*;
use scratch::*;
use serde_json::{Value, json};

/// The error contains each of `parts`.
fn says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "\"{message}\" does not say \"{part}\"");
    }
}

fn refused(change: impl FnOnce(&mut Value), parts: &[&str]) {
    says(&capture_with(change).refusal(), parts);
}

/// The error of loading the first image of a capture that opens.
fn image_refused(scratch: &Scratch, parts: &[&str]) {
    let capture = scratch.open().unwrap();
    says(&capture.observation(&capture.train[0].shots[0]).unwrap_err().to_string(), parts);
}

#[test]
fn the_unbroken_capture_opens() {
    let capture = capture_with(|_| {}).open().unwrap();
    assert_eq!((capture.train.len(), capture.train[0].shots.len(), capture.test.len()), (1, 2, 0));
    assert!(capture.notes.iter().any(|n| n.contains("no held-out images")));
}

#[test]
fn missing_folder_json_or_image() {
    let message = Capture::open(std::path::Path::new("/no/such/folder"), &OpenOptions::default()).unwrap_err();
    says(&message.to_string(), &["/no/such/folder"]);
    says(&Scratch::new().refusal(), &["transforms_train.json", "folder"]);
    let scratch = capture_with(|_| {});
    std::fs::remove_file(scratch.0.join("train/r_0_l_1.png")).unwrap();
    says(
        &scratch.refusal(),
        &["transforms_train.json, frame 0, file_paths[1]", "train/r_0_l_1.png", "exclude_list.txt"],
    );
    let scratch = capture_with(|_| {});
    let capture = scratch.open().unwrap();
    std::fs::remove_file(scratch.0.join("train/r_0_l_0.png")).unwrap();
    says(
        &capture.observation(&capture.train[0].shots[0]).unwrap_err().to_string(),
        &["file_paths[0]", "open the image"],
    );
    assert!(capture.hash().is_err());
}

#[test]
fn text_that_is_no_json() {
    for text in ["", "{", "{\"frames\": [NaN]}", "\u{1}", "[[[["] {
        let scratch = capture_with(|_| {});
        scratch.write("transforms_train.json", text);
        says(&scratch.refusal(), &["transforms_train.json, line", "no valid JSON"]);
    }
    let scratch = capture_with(|_| {});
    scratch.write("transforms_train.json", [0xff, 0xfe, 0x00]);
    says(&scratch.refusal(), &["transforms_train.json", "utf-8"]);
    scratch.write("transforms_train.json", "[".repeat(100_000));
    says(&scratch.refusal(), &["recursion"]);
}

#[test]
fn wrong_types_name_their_field() {
    refused(|j| *j = json!([1]), &["transforms_train.json", "expected an object", "[1]"]);
    refused(|j| j["frames"] = json!("x"), &["frames", "an array", "\"x\""]);
    refused(|j| *j = json!({"camera_angle_x": 0.6}), &["frames", "nothing"]);
    refused(|j| j["frames"] = json!([7]), &["frame 0", "an object", "7"]);
    refused(|j| j["camera_angle_x"] = json!("0.6"), &["camera_angle_x", "a finite number", "\"0.6\""]);
    refused(|j| j["camera_angle_x"] = json!(35), &["camera_angle_x", "radians", "degrees"]);
    refused(|j| j["camera_angle_x"] = json!(null), &["camera_angle_x", "neither", "fl_x"]);
    refused(|j| j["frames"][0]["fl_x"] = json!(-3), &["frame 0, fl_x", "positive"]);
    refused(|j| j["frames"][0]["cx"] = json!([2]), &["frame 0, cx", "a finite number"]);
    refused(|j| j["frames"][0]["width"] = json!(4.5), &["frame 0, width", "whole number", "4.5"]);
    refused(|j| j["frames"][0]["height"] = json!(0), &["frame 0, height", "whole number"]);
    refused(|j| j["frames"][0]["file_paths"] = json!("train/r_0_l_0"), &["frame 0, file_paths", "an array"]);
    refused(|j| j["frames"][0]["file_paths"][1] = json!(3), &["frame 0, file_paths[1]", "quotes"]);
    refused(|j| j["frames"][0]["light_positions"][1] = json!("x"), &["frame 0, light_positions[1]", "three finite"]);
    refused(|j| j["frames"][0]["light_positions"][1] = json!([1, 2]), &["frame 0, light_positions[1]"]);
    refused(
        |j| j["frames"][0]["light_intensities"] = json!([[1, 1, 1], [1, -1, 1]]),
        &["light_intensities[1]", "at least 0"],
    );
    refused(|j| j["frames"][0]["weights"] = json!([1, -1]), &["weights[1]", "at least 0"]);
    refused(|j| j["frames"][0]["provenances"] = json!(["photograph", "dream"]), &["provenances[1]", "synthetic:"]);
}

#[test]
fn array_lengths_that_differ() {
    refused(
        |j| j["frames"][0]["light_positions"] = json!([[0, 0, 5]]),
        &["frame 0, light_positions", "2 entries", "found 1"],
    );
    refused(
        |j| j["frames"][0]["light_intensities"] = json!([[1, 1, 1]]),
        &["light_intensities", "2 entries", "found 1"],
    );
}

#[test]
fn positions_that_are_not_finite() {
    // JSON has no NaN; these are how it gets in: a number that overflows, a null, a string.
    for bad in [json!([0, null, 5]), json!([0, "NaN", 5]), json!([0, 1e300, 5]), json!([0, -1e20, 5])] {
        refused(|j| j["frames"][0]["light_positions"][0] = bad, &["frame 0, light_positions[0]", "finite"]);
    }
}

#[test]
fn poses_that_are_no_poses() {
    let field = "frame 0, transform_matrix";
    refused(|j| j["frames"][0]["transform_matrix"] = json!(null), &[field, "4×4", "nothing"]);
    refused(|j| j["frames"][0]["transform_matrix"][1][2] = json!(null), &[field, "row 1, column 2"]);
    refused(|j| j["frames"][0]["transform_matrix"][1][2] = json!("NaN"), &[field, "row 1, column 2"]);
    refused(|j| j["frames"][0]["transform_matrix"][1][3] = json!(1e39), &[field, "row 1, column 3"]);
    refused(|j| j["frames"][0]["transform_matrix"][1] = json!([1, 2]), &[field, "row 1"]);
    refused(|j| j["frames"][0]["transform_matrix"] = json!([[1, 0, 0, 0]]), &[field, "1 rows"]);
    refused(|j| j["frames"][0]["transform_matrix"][0][0] = json!(-1), &[field, "mirrored"]);
    refused(|j| j["frames"][0]["transform_matrix"] = json!(vec![vec![0; 4]; 4]), &[field]);
    refused(|j| j["frames"][0]["transform_matrix"][0][1] = json!(0.5), &[field, "orthonormal"]);
}

#[test]
fn lights_that_are_missing() {
    refused(
        |j| j["frames"][0]["light_positions"] = json!(null),
        &["frame 0, light_positions[0]", "one-light-at-a-time"],
    );
    refused(
        |j| {
            j["frames"][0]["light_positions"] = json!(null);
            j["frames"][0]["light_directions"] = json!([[0, 0, 1], [0, 0, 0]]);
        },
        &["light_directions[1]", "not zero"],
    );
    refused(|j| j["frames"][0]["file_paths"] = json!(null), &["frame 0, file_paths", "nothing"]);
}

#[test]
fn no_frames_or_no_images() {
    refused(|j| j["frames"] = json!([]), &["transforms_train.json, frames", "at least one image"]);
    let empty = |j: &mut Value| {
        j["frames"][0]["file_paths"] = json!([]);
        j["frames"][0]["light_positions"] = json!([]);
    };
    refused(empty, &["at least one image", "no frames, no images"]);
    // Beside a frame that has images, one that has none is left out, with a note.
    let capture = capture_with(|j| {
        let mut second = frame();
        second["file_paths"] = json!([]);
        second["light_positions"] = json!([]);
        j["frames"].as_array_mut().unwrap().push(second);
    });
    let capture = capture.open().unwrap();
    assert_eq!(capture.train.len(), 1);
    assert!(capture.notes.iter().any(|n| n.contains("frame 1: no images")), "{:?}", capture.notes);
}

#[test]
fn paths_that_climb_out_of_the_folder() {
    for path in
        ["../../etc/passwd", "../r_0_l_0", "train/../../x", "/etc/passwd", "\\\\server\\x", "C:\\x", "", "a\u{0}b"]
    {
        refused(|j| j["frames"][0]["file_paths"][0] = json!(path), &["frame 0, file_paths[0]"]);
    }
    refused(|j| j["frames"][0]["file_paths"][1] = json!("../../etc/passwd"), &["leads out", "etc/passwd"]);
}

#[cfg(unix)]
#[test]
fn links_that_lead_out_of_the_folder() {
    let (scratch, outside) = (capture_with(|_| {}), Scratch::new());
    outside.write("secret.png", small_png());
    let link = scratch.0.join("train/r_0_l_1.png");
    std::fs::remove_file(&link).unwrap();
    std::os::unix::fs::symlink(outside.0.join("secret.png"), &link).unwrap();
    says(&scratch.refusal(), &["frame 0, file_paths[1]", "leads out"]);
    // A link to the folder itself is the folder, and links inside it are fine.
    std::fs::remove_file(&link).unwrap();
    scratch.write("elsewhere/x.png", small_png());
    std::os::unix::fs::symlink(scratch.0.join("elsewhere/x.png"), &link).unwrap();
    let alias = outside.0.join("alias");
    std::os::unix::fs::symlink(&scratch.0, &alias).unwrap();
    assert!(Capture::open(&alias, &OpenOptions::default()).is_ok());
}

#[test]
fn an_image_named_twice() {
    refused(
        |j| j["frames"][0]["file_paths"][1] = json!("./train/r_0_l_0.png"),
        &["file_paths[1]", "already named by", "file_paths[0]"],
    );
    // In both splits it is a note, since a reader may want just that.
    let scratch = capture_with(|_| {});
    std::fs::copy(scratch.0.join("transforms_train.json"), scratch.0.join("transforms_test.json")).unwrap();
    let capture = scratch.open().unwrap();
    assert!(capture.notes.iter().any(|n| n.contains("2 images are in both")), "{:?}", capture.notes);
}

#[test]
fn images_that_are_cut_short_or_no_png() {
    let png = small_png();
    for length in [0, 4, 20, 33, png.len() / 2, png.len() - 20] {
        let scratch = capture_with(|_| {});
        scratch.write("train/r_0_l_0.png", &png[..length]);
        image_refused(&scratch, &["r_0_l_0.png", "frame 0, file_paths[0]", "PNG"]);
    }
    let scratch = capture_with(|_| {});
    scratch.write("train/r_0_l_0.png", b"\xff\xd8\xff\xe0 a JPEG");
    image_refused(&scratch, &["PNG", "export it again"]);
    // Without a size in the frame, the header is read when the capture is opened.
    let scratch = capture_with(|j| j["frames"][0]["width"] = json!(null));
    scratch.write("train/r_0_l_0.png", &png[..20]);
    says(&scratch.refusal(), &["r_0_l_0.png", "header"]);
}

/// A PNG header that promises `side`² pixels, followed by nothing much.
fn huge_header(side: u32) -> Vec<u8> {
    let mut ihdr = b"IHDR".to_vec();
    ihdr.extend(side.to_be_bytes());
    ihdr.extend(side.to_be_bytes());
    ihdr.extend([8, 6, 0, 0, 0]);
    let crc = |bytes: &[u8]| {
        let mut crc = u32::MAX;
        for &byte in bytes {
            crc ^= u32::from(byte);
            for _ in 0..8 {
                crc = if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 };
            }
        }
        !crc
    };
    let mut out = b"\x89PNG\r\n\x1a\n\0\0\0\x0d".to_vec();
    out.extend(&ihdr);
    out.extend(crc(&ihdr).to_be_bytes());
    out.extend(b"\0\0\0\x04IDAT\x78\x9c\x63\x00");
    out.extend(crc(b"IDAT\x78\x9c\x63\x00").to_be_bytes());
    out.extend(b"\0\0\0\0IEND\xae\x42\x60\x82");
    out
}

#[test]
fn headers_that_promise_too_much() {
    let scratch = capture_with(|_| {});
    scratch.write("train/r_0_l_0.png", huge_header(30_000));
    image_refused(&scratch, &["r_0_l_0.png", "frame 0, file_paths[0]", "30000×30000", "limit", "max_pixels"]);
    // The same where the frame agrees with it, or leaves the size to the image.
    let scratch =
        capture_with(|j| (j["frames"][0]["width"], j["frames"][0]["height"]) = (json!(30_000), json!(30_000)));
    says(&scratch.refusal(), &["frame 0, width, height", "30000×30000"]);
    let scratch = capture_with(|j| j["frames"][0]["width"] = json!(null));
    scratch.write("train/r_0_l_0.png", huge_header(30_000));
    says(&scratch.refusal(), &["30000×30000"]);
    // Below the limit, but more than the file can hold: nothing is allocated for it either.
    let scratch = capture_with(|j| j["frames"][0]["width"] = json!(null));
    scratch.write("train/r_0_l_0.png", huge_header(8000));
    image_refused(&scratch, &["more than a file of"]);
    // The limit is the user's.
    let options = OpenOptions { max_pixels: 7, ..OpenOptions::default() };
    let error = Capture::open(&capture_with(|_| {}).0, &options).unwrap_err().to_string();
    says(&error, &["4×2 = 8 pixels", "limit is 7"]);
}

#[test]
fn an_image_of_another_size_than_its_frame() {
    let scratch = capture_with(|j| j["frames"][0]["width"] = json!(5));
    image_refused(&scratch, &["4×2", "5×2", "correct width and height"]);
}

#[test]
fn geometry_that_is_broken() {
    let scratch = capture_with(|_| {});
    scratch.write("geometry/train_r_0.exr", b"not an EXR");
    let capture = scratch.open().unwrap();
    says(&capture.train[0].ground_truth_geometry().unwrap_err().to_string(), &["train_r_0.exr", "EXR"]);
    let scratch = capture_with(|_| {});
    let source = spot_small().join("geometry/test_r_0.exr");
    scratch.write("geometry/train_r_0.exr", std::fs::read(source).unwrap());
    let capture = scratch.open().unwrap();
    says(&capture.train[0].ground_truth_geometry().unwrap_err().to_string(), &["128×128", "4×2"]);
}

#[test]
fn selections_that_make_no_sense() {
    let capture = capture_with(|_| {}).open().unwrap();
    let fails = |v: &str, l: &str, parts: &[&str]| {
        let error = capture.select(&v.parse().unwrap(), &l.parse().unwrap()).unwrap_err().to_string();
        says(&error, parts);
    };
    fails("5,", "all", &["views", "index 5", "there are 1"]);
    fails("all", "0-2", &["lights", "index 2", "there are 2"]);
    assert!(capture.select(&Selection::Count(0), &Selection::All).is_err());
    assert!(capture.select(&Selection::All, &Selection::Count(0)).is_err());
    assert!(capture.select(&Selection::List(vec![]), &Selection::All).is_err());
}

#[test]
fn what_cannot_be_written() {
    let scratch = Scratch::new();
    let size = (4, 2);
    let light = diamond_light::OlatLight::Point { position: glam::Vec3::Z, intensity: glam::Vec3::ONE };
    let good =
        || CaptureDescription { train: vec![view(0, glam::Vec3::X * 4.0, &[light], size)], ..Default::default() };
    let fails = |description: &CaptureDescription, image: (u32, u32), parts: &[&str]| {
        let dir = scratch.0.join("out");
        let error = write_capture(&dir, description, |_, v, s| Ok(pixels(v, s, image))).unwrap_err().to_string();
        says(&error, parts);
        assert_eq!(std::fs::read_dir(&scratch.0).unwrap().count(), 0, "a failed attempt leaves nothing behind");
    };
    fails(&CaptureDescription::default(), size, &["no training image"]);
    fails(&good(), (3, 2), &["expected 4×2×3", "found 3×2×3"]);
    for name in ["../x", "a/b", "", ".hidden"] {
        let mut bad = good();
        bad.train[0].shots[0].name = name.into();
        fails(&bad, size, &["file name"]);
    }
    let mut bad = good();
    let twice = bad.train[0].shots[0].clone();
    bad.train[0].shots.push(twice);
    fails(&bad, size, &["two images"]);
    let mut bad = good();
    bad.train[0].shots[0].weight = f32::NAN;
    fails(&bad, size, &["weight"]);
    std::fs::create_dir(scratch.0.join("out")).unwrap();
    let error = write_capture(&scratch.0.join("out"), &good(), |_, v, s| Ok(pixels(v, s, size))).unwrap_err();
    says(&error.to_string(), &["exists already"]);
}
