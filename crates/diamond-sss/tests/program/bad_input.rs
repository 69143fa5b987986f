//! Whatever is wrong with a capture: exit code 3 and a message that names file and field, or documented behaviour; never
//! a panic.
use crate::captures::{scratch, small_config, tiny_capture};
use serde_json::{Value, json};
use std::path::Path;
use std::process::{Command, Output};

fn reconstruct(dir: &Path, steps: &str) -> Output {
    Command::new(env!("CARGO_BIN_EXE_diamond"))
        .arg("reconstruct")
        .arg(dir.join("capture"))
        .arg("-o")
        .arg(dir.join("out"))
        .arg("--preset")
        .arg(small_config(dir))
        .args(["--steps", steps])
        .output()
        .unwrap()
}

/// Damages a tiny capture and checks the answer: `words` must be in the message.
fn refused(name: &str, words: &[&str], damage: impl FnOnce(&Path)) {
    let dir = scratch(name);
    tiny_capture(&dir.join("capture"), 2, 2);
    damage(&dir.join("capture"));
    let output = reconstruct(&dir, "2");
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!message.contains("panicked"), "{name}: {message}");
    assert_eq!(output.status.code(), Some(3), "{name}: {message}");
    words.iter().for_each(|word| assert!(message.contains(word), "{name}: {word:?} is not in: {message}"));
    assert!(!dir.join("out/model.ply").exists());
    std::fs::remove_dir_all(dir).unwrap();
}

/// Changes a tiny capture in a way that is documented to work.
fn accepted(name: &str, views: usize, lights: usize, change: impl FnOnce(&Path)) {
    let dir = scratch(name);
    tiny_capture(&dir.join("capture"), views, lights);
    change(&dir.join("capture"));
    let output = reconstruct(&dir, "2");
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success() && !message.contains("panicked"), "{name}: {message}");
    assert!(dir.join("out/report.html").is_file());
    std::fs::remove_dir_all(dir).unwrap();
}

fn edit(capture: &Path, change: impl FnOnce(&mut Value)) {
    let path = capture.join("transforms_train.json");
    let mut value: Value = serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
    change(&mut value);
    std::fs::write(path, value.to_string()).unwrap();
}

/// Stores every image of the capture anew.
fn convert(capture: &Path, to: impl Fn(image::DynamicImage) -> image::DynamicImage) {
    for folder in ["train", "test"] {
        for entry in std::fs::read_dir(capture.join(folder)).unwrap() {
            let path = entry.unwrap().path();
            to(image::open(&path).unwrap()).save(&path).unwrap();
        }
    }
}

#[test]
fn missing_and_damaged_files() {
    refused("missing-image", &["r_1_l_0.png", "file_paths"], |c| {
        std::fs::remove_file(c.join("train/r_1_l_0.png")).unwrap()
    });
    refused("missing-json", &["transforms_train.json"], |c| {
        std::fs::remove_file(c.join("transforms_train.json")).unwrap();
    });
    for (name, path) in [("truncated", "train/r_0_l_1.png"), ("truncated-test", "test/r_2_l_0.png")] {
        refused(name, &[&path[6..], "file_paths"], |c| {
            let bytes = std::fs::read(c.join(path)).unwrap();
            std::fs::write(c.join(path), &bytes[..bytes.len() / 2]).unwrap();
        });
    }
    refused("no-png", &["r_0_l_0.png"], |c| std::fs::write(c.join("train/r_0_l_0.png"), "not a picture").unwrap());
    refused("huge-header", &["r_0_l_0.png", "30000×30000"], |c| {
        let path = c.join("train/r_0_l_0.png");
        let mut bytes = std::fs::read(&path).unwrap();
        bytes[16..24].copy_from_slice(&[0, 0, 0x75, 0x30, 0, 0, 0x75, 0x30]);
        let sum = crc(&bytes[12..29]);
        bytes[29..33].copy_from_slice(&sum.to_be_bytes());
        std::fs::write(path, bytes).unwrap();
    });
}

/// The checksum of a PNG chunk.
fn crc(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |sum, b| {
        (0..8).fold(sum ^ u32::from(*b), |s, _| if s & 1 == 1 { (s >> 1) ^ 0xEDB8_8320 } else { s >> 1 })
    })
}

#[test]
fn wrong_fields() {
    refused("nan-pose", &["transforms_train.json"], |c| {
        let path = c.join("transforms_train.json");
        edit(c, |v| v["frames"][1]["transform_matrix"][0][3] = json!("MARK"));
        let text = std::fs::read_to_string(&path).unwrap().replace("\"MARK\"", "NaN");
        std::fs::write(path, text).unwrap();
    });
    refused("infinite-pose", &["transform_matrix", "frame 1"], |c| {
        edit(c, |v| v["frames"][1]["transform_matrix"][0][3] = json!(1e300));
    });
    refused("wrong-type", &["light_positions", "frame 0"], |c| {
        edit(c, |v| v["frames"][0]["light_positions"] = json!("here"))
    });
    refused("frames-type", &["frames"], |c| edit(c, |v| v["frames"] = json!(7)));
    refused("zero-lights", &["transforms_train.json"], |c| {
        edit(c, |v| {
            for frame in v["frames"].as_array_mut().unwrap() {
                frame["light_positions"] = json!([]);
                frame["file_paths"] = json!([]);
            }
        });
    });
    refused("climbing", &["../../etc/passwd", "file_paths"], |c| {
        edit(c, |v| v["frames"][0]["file_paths"][0] = json!("../../etc/passwd"));
    });
}

#[test]
fn few_images_and_other_pixel_formats_work() {
    accepted("one-view", 1, 2, |_| {});
    accepted("one-light", 2, 1, |_| {});
    accepted("no-alpha", 2, 2, |c| convert(c, |i| i.to_rgb8().into()));
    accepted("grey", 2, 2, |c| convert(c, |i| i.to_luma8().into()));
    accepted("sixteen-bit", 2, 2, |c| convert(c, |i| i.to_rgba16().into()));
    accepted("no-test", 2, 2, |c| std::fs::remove_file(c.join("transforms_test.json")).unwrap());
}

#[test]
fn wrong_options_and_configurations() {
    let dir = scratch("options");
    tiny_capture(&dir.join("capture"), 2, 2);
    let capture = dir.join("capture");
    let run = |extra: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_diamond"))
            .arg("reconstruct")
            .arg(&capture)
            .arg("-o")
            .arg(dir.join("out"))
            .args(extra)
            .output()
            .unwrap();
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!message.contains("panicked"), "{message}");
        (output.status.code(), message)
    };
    let wrong = dir.join("wrong.toml");
    std::fs::write(&wrong, "[loss]\nmaks = 1.0\n").unwrap();
    let (code, message) = run(&["--preset", wrong.to_str().unwrap()]);
    assert!(code == Some(3) && message.contains("maks") && message.contains("wrong.toml"), "{message}");
    let (code, message) = run(&["--preset", "no-such-file.toml"]);
    assert!(code == Some(3) && message.contains("no-such-file.toml"), "{message}");
    for extra in [["--views", "9,"], ["--lights", "x"], ["--steps", "0"], ["--threads", "0"], ["--views", "0"]] {
        let (code, message) = run(&extra);
        assert!(code == Some(2), "{extra:?}: {message}");
    }
    let (code, message) = run(&["--force", "--resume"]);
    assert!(code == Some(2), "{message}");
    std::fs::remove_dir_all(dir).unwrap();
}
