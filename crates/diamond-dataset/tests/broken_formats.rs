//! Broken captures of the other formats: each gives one text that says what was expected, what was found, where, and what
//! to do. Run with `--nocapture` to read them all.
mod scratch;
use scratch::*;
use serde_json::{Value, json};
use std::path::Path;

fn foreign(name: &str) -> Vec<u8> {
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/fixtures/foreign-captures").join(name))
        .unwrap()
}

/// A COLMAP capture of one PINHOLE camera and one image of 4 × 2 pixels.
fn model(cameras: &str, images: &str) -> Scratch {
    let scratch = Scratch::new();
    scratch.write("sparse/0/cameras.txt", cameras);
    scratch.write("sparse/0/images.txt", images);
    scratch.write("images/a.png", small_png());
    scratch.write("lights.json", r#"{"default": {"position": [0, 0, 2]}}"#);
    scratch
}

const CAMERA: &str = "1 PINHOLE 4 2 5 5 2 1\n";
const IMAGE: &str = "1 1 0 0 0 0 0 4 1 a.png\n\n";

/// A nerfstudio capture of one image of 4 × 2 pixels, whose JSON `change` may break.
fn single(change: impl FnOnce(&mut Value)) -> Scratch {
    let scratch = Scratch::new();
    let frame = json!({"file_path": "images/a.png", "transform_matrix": matrix()});
    let mut root = json!({"fl_x": 5, "fl_y": 5, "cx": 2, "cy": 1, "w": 4, "h": 2, "frames": [frame]});
    change(&mut root);
    scratch.write("transforms.json", root.to_string());
    scratch.write("images/a.png", small_png());
    scratch.write("lights.json", r#"{"default": {"position": [0, 0, 2]}}"#);
    scratch
}

/// The error of opening, or else of loading the first image.
fn refusal(scratch: &Scratch) -> String {
    let error = scratch.open().and_then(|c| c.observation(&c.train[0].shots[0]).map(|_| ()));
    error.expect_err("this capture must be refused").to_string().replace(&scratch.0.display().to_string(), "CAPTURE")
}

#[test]
fn what_is_unbroken_opens() {
    assert_eq!(model(CAMERA, IMAGE).open().unwrap().train.len(), 1);
    assert_eq!(single(|_| {}).open().unwrap().train.len(), 1);
}

#[test]
fn each_broken_file_has_one_clear_text() {
    let mut texts: Vec<(&str, String)> = Vec::new();
    let mut case = |what: &'static str, scratch: Scratch, parts: &[&str]| {
        let text = refusal(&scratch);
        for part in parts {
            assert!(text.contains(part), "{what}: \"{text}\" does not say \"{part}\"");
        }
        texts.push((what, text));
    };
    let empty = Scratch::new();
    empty.write("notes.txt", "nothing");
    case(
        "an empty folder",
        empty,
        &["transforms_train.json", "transforms.json", "COLMAP", "is this the capture's folder"],
    );

    let dark = single(|_| {});
    std::fs::remove_file(dark.0.join("lights.json")).unwrap();
    let snippet =
        ["frame 0, light_position", "no lights.json in CAPTURE", "{\"default\": {\"frame\": \"camera\"", "\"images\""];
    case("images without lights", dark, &snippet);
    let dark = model(CAMERA, IMAGE);
    dark.write("lights.json", r#"{"images": {"b.png": {"position": [0, 0, 2]}}}"#);
    case(
        "an image that lights.json forgets",
        dark,
        &["images.txt, image 1 (\"a.png\")", "neither \"a.png\" nor a default"],
    );
    let bad = model(CAMERA, IMAGE);
    bad.write("lights.json", r#"{"default": {"position": [0, 0]}}"#);
    case("a light with two coordinates", bad, &["lights.json, default.position", "three finite numbers"]);
    let bad = model(CAMERA, IMAGE);
    bad.write("lights.json", "{\"default\": {\"position\": [0, NaN, 1]}}");
    case("NaN in lights.json", bad, &["lights.json, line 1", "no valid JSON"]);

    let fov = model("1 FOV 4 2 5 5 2 1 0.9\n", IMAGE);
    case(
        "a camera model that is not read",
        fov,
        &["cameras.txt, line 1", "FOV", "OPENCV_FISHEYE", "colmap image_undistorter"],
    );
    let short = model("1 PINHOLE 4 2 5 5 2\n", IMAGE);
    case("too few parameters", short, &["cameras.txt, line 1", "4 parameters of PINHOLE", "found 3"]);
    let flat = model("1 PINHOLE 4 2 0 5 2 1\n", IMAGE);
    case("a focal length of 0", flat, &["cameras.txt, line 1", "fx", "focal length > 0"]);
    let other = model(CAMERA, "1 1 0 0 0 0 0 4 7 a.png\n\n");
    case("a camera that is not there", other, &["images.txt, image 1 (\"a.png\")", "number of a camera", "found 7"]);
    let nan = model(CAMERA, "1 nan 0 0 0 0 0 4 1 a.png\n\n");
    case("a pose that is NaN", nan, &["images.txt, line 1", "quaternion", "NaN"]);
    let lines = model(CAMERA, "1 1 0 0 0 0 0 4 1 a.png\n2 1 0 0 0 0 0 4 1 b.png\n");
    case("a missing line of features", lines, &["images.txt, line 2", "two lines"]);
    let lost = model(CAMERA, "1 1 0 0 0 0 0 4 1 lost.png\n\n");
    case("an image that is not there", lost, &["image 1 (\"lost.png\")", "images/lost.png", "exclude_list.txt"]);
    let climbs = model(CAMERA, "1 1 0 0 0 0 0 4 1 ../../a.png\n\n");
    case("an image outside the folder", climbs, &["image 1", "leads out of the capture's folder"]);
    let size = model("1 PINHOLE 8 4 5 5 2 1\n", IMAGE);
    case("an image of another size", size, &["a.png", "4×2", "8×4"]);
    let cut = model(CAMERA, IMAGE);
    for name in ["cameras", "images"] {
        let bytes = foreign(&format!("pycolmap-binary/sparse/0/{name}.bin"));
        cut.write(&format!("sparse/0/{name}.bin"), &bytes[..bytes.len() / 2]);
    }
    case("a binary model cut short", cut, &["cameras.bin, byte", "end of the file", "cut short"]);
    let huge = model(CAMERA, IMAGE);
    huge.write("sparse/0/points3D.txt", "");
    huge.write("sparse/0/cameras.bin", [[0xff; 8], [0; 8]].concat());
    huge.write("sparse/0/images.bin", [0; 8]);
    case("a count beyond the file", huge, &["cameras.bin, byte 0", "18446744073709551615", "8 bytes to the end"]);

    case(
        "a lens that is not read",
        single(|j| j["camera_model"] = json!("EQUIRECTANGULAR")),
        &["transforms.json, camera_model", "OPENCV_FISHEYE", "EQUIRECTANGULAR", "undistort the images first"],
    );
    case("a fourth coefficient", single(|j| j["k4"] = json!(0.1)), &["transforms.json, k4", "programs disagree"]);
    case("a lens of text", single(|j| j["k1"] = json!("0.1")), &["k1", "a finite number", "\"0.1\""]);
    case(
        "a mask that is not there",
        single(|j| j["frames"][0]["mask_path"] = json!("masks/a.png")),
        &["frame 0, file_path", "masks/a.png"],
    );
    case(
        "a mask outside the folder",
        single(|j| j["frames"][0]["mask_path"] = json!("/etc/passwd")),
        &["frame 0", "leads out"],
    );
    case(
        "points outside the folder",
        single(|j| j["ply_file_path"] = json!("../points.ply")),
        &["ply_file_path", "leads out"],
    );
    let background = single(|_| {});
    background.write("images/a.png", png(4, 2, image::ExtendedColorType::Rgb8, &[9; 24]));
    background.write("background.png", png(2, 2, image::ExtendedColorType::Rgb8, &[9; 12]));
    case("a background of another size", background, &["background.png", "2×2 pixels, the image 4×2"]);
    let webp = single(|_| {});
    webp.write("images/a.png", b"RIFF\x10\0\0\0WEBPVP8 ");
    case("an image of another format", webp, &["a.png", "neither PNG, JPEG nor EXR", "export it again"]);
    let exr = single(|_| {});
    let bytes = foreign("images/images/openexr_float_piz.exr");
    exr.write("images/a.png", &bytes[..bytes.len() / 2]);
    case("an EXR cut short", exr, &["a.png", "EXR", "cut short"]);
    let jpeg = single(|_| {});
    jpeg.write("images/a.png", &foreign("images/images/pillow.jpg")[..100]);
    case("a JPEG cut short", jpeg, &["a.png", "JPEG", "export it again"]);

    for (what, text) in &texts {
        println!("{what}:\n    {text}");
    }
    assert_eq!(texts.len(), 26);
}
