//! The built program, from the outside: files, exit codes, messages, and a real `kill -9`.
mod bad_input;
mod captures;
#[cfg(unix)]
mod changed_capture;
#[cfg(unix)]
mod disk;
mod exposure;
mod killed;
mod medium;
#[cfg(unix)]
mod memory_limit;
mod sessions;

use captures::{scratch, small_config, tiny_capture};
use std::path::Path;
use std::process::{Command, Output};

fn diamond(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_diamond")).args(arguments).output().unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn succeed(arguments: &[&str]) -> Output {
    let output = diamond(arguments);
    assert!(output.status.success(), "{arguments:?}: {}", stderr(&output));
    output
}

#[test]
fn devices_are_listed_with_the_cpu_first() {
    let output = succeed(&["devices"]);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(text.starts_with("cpu ") && (text.contains("gpu:0") || text.contains("no GPU")), "{text}");
}

#[test]
fn a_device_that_is_not_there_is_a_wrong_option() {
    let dir = scratch("device");
    let (capture, out) = (dir.join("capture"), dir.join("out"));
    tiny_capture(&capture, 2, 1);
    for (device, word) in [("gpu:99", "--device cpu"), ("tpu", "gpu:N")] {
        let wrong = diamond(&["reconstruct", text(&capture), "-o", text(&out), "--device", device]);
        assert_eq!(wrong.status.code(), Some(2), "{}", stderr(&wrong));
        assert!(stderr(&wrong).contains(word) && !out.exists(), "{device}: {}", stderr(&wrong));
    }
}

#[test]
fn from_capture_to_report_and_pictures() {
    let dir = scratch("end-to-end");
    let (capture, out, config) = (dir.join("capture"), dir.join("out"), small_config(&dir));
    tiny_capture(&capture, 3, 2);
    let run = ["reconstruct", text(&capture), "-o", text(&out), "--preset", text(&config), "--steps", "6"];
    let first = succeed(&run);
    assert!(String::from_utf8_lossy(&first.stdout).contains("report.html"));
    for name in [
        "model.ply",
        "config.toml",
        "scene.toml",
        "network.safetensors",
        "metrics.json",
        "metrics.csv",
        "report.html",
        "log.csv",
        "profile.json",
        "run.json",
        "selection.json",
        "checkpoint/state.safetensors",
    ] {
        assert!(out.join(name).is_file(), "{name}");
    }
    // The same images by name: the same model. A regime keeps fewer.
    let (selection, again, few) = (out.join("selection.json"), dir.join("again"), dir.join("few"));
    let run = ["reconstruct", text(&capture), "-o", text(&again), "--preset", text(&config), "--steps", "6"];
    succeed(&[&run[..], &["--selection", text(&selection)]].concat());
    assert!(std::fs::read(again.join("model.ply")).unwrap() == std::fs::read(out.join("model.ply")).unwrap());
    let run = ["reconstruct", text(&capture), "-o", text(&few), "--preset", text(&config), "--steps", "6"];
    succeed(&[&run[..], &["--regime", "2x1"]].concat());
    let kept: serde_json::Value = serde_json::from_slice(&std::fs::read(few.join("selection.json")).unwrap()).unwrap();
    assert_eq!(kept["train"].as_array().map(|views| views.len()), Some(2));
    assert!(kept["train"][0]["images"].as_array().is_some_and(|images| images.len() == 1));
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(!page.contains("http://") || !page.contains("src=\"http"), "the report must need no network");
    let log = std::fs::read_to_string(out.join("log.csv")).unwrap();
    assert_eq!(log.lines().count(), 7);

    let refused = diamond(&run);
    assert_eq!(refused.status.code(), Some(2));
    assert!(stderr(&refused).contains("--resume") && stderr(&refused).contains("--force"));
    succeed(&[&run[..], &["--force"]].concat());
    succeed(&[&run[..], &["--resume"]].concat());

    let printed = succeed(&["evaluate", text(&out), text(&capture), "--save-images"]);
    assert!(String::from_utf8_lossy(&printed.stdout).contains("unseen lights"));
    assert_eq!(std::fs::read_dir(out.join("images")).unwrap().count(), 6);
    let metrics: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(out.join("metrics.json")).unwrap()).unwrap();
    for group in [&metrics, &metrics["masked"], &metrics["seen_lights"], &metrics["unseen_lights"]] {
        for key in ["psnr", "ssim", "flip", "psnr_std", "ssim_std", "flip_std"] {
            assert!(group[key].is_number(), "{key} in {group}");
        }
        assert!(group["lpips_vgg"].is_null() && group["lpips_alex"].is_null());
    }
    for key in ["images", "seconds", "peak_bytes", "seed"] {
        assert!(metrics[key].is_number(), "{key}");
    }
    assert_eq!(metrics["images"], 2);
    let shape = &metrics["geometry"];
    assert!(shape["silhouette_iou"].as_f64().is_some_and(|iou| (0.0..=1.0).contains(&iou)), "{shape}");
    // This capture has no true depth.
    assert!(shape["depth_error"].is_null() && metrics["absent"]["geometry.depth_error"].is_string(), "{shape}");
    assert_eq!(shape["extent_of"], "cameras");
    assert!(shape["per_view"].as_array().is_some_and(|views| !views.is_empty()), "{shape}");
    assert_eq!(metrics["resolution"], serde_json::json!([32, 32]));
    assert!(metrics["absent"]["lpips_vgg"].is_string());
    assert_eq!(metrics["capture_hash"].as_str().unwrap().len(), 64);

    let picture = dir.join("a.png");
    succeed(&["render", text(&out), "-o", text(&picture), "--light", "-1,2,3", "--size", "40x24"]);
    assert_eq!(image::image_dimensions(&picture).unwrap(), (40, 24));
    succeed(&["render", text(&out), "-o", text(&dir.join("film")), "--orbit", "3", "--direction", "0,0,1"]);
    assert_eq!(std::fs::read_dir(dir.join("film")).unwrap().count(), 3);
    succeed(&["render", text(&out), "-o", text(&dir.join("rig")), "--capture", text(&capture), "--lights", "4"]);
    assert_eq!(std::fs::read_dir(dir.join("rig")).unwrap().count(), 4);
    succeed(&["render", text(&out), "-o", text(&dir.join("m.exr")), "--linear", "--mix", "0,0,4:1,0,0;4,0,0:0,1,0"]);
    let too_many = diamond(&["render", text(&out), "-o", text(&picture), "--orbit", "3"]);
    assert_eq!(too_many.status.code(), Some(2));
    succeed(&["export", text(&out), "-o", text(&dir.join("x.ply")), "--materials"]);
    assert!(std::fs::read(dir.join("x.ply")).unwrap().starts_with(b"ply\n"));
    for name in ["x.splat", "x.spz", "x.glb", "x.gltf"] {
        let printed = succeed(&["export", text(&out), "-o", text(&dir.join(name)), "--turn", "x:180"]);
        let printed = String::from_utf8_lossy(&printed.stdout).into_owned();
        assert!(printed.contains("no light baked in") && printed.contains("not in the file: materials"), "{printed}");
    }
    assert_eq!(diamond(&["export", text(&out), "-o", text(&dir.join("x.glb")), "--materials"]).status.code(), Some(2));
    assert_eq!(diamond(&["export", text(&out), "-o", text(&dir.join("x.obj"))]).status.code(), Some(2));
    succeed(&["convert", text(&dir.join("x.glb")), text(&dir.join("y.ply"))]);
    let printed = succeed(&["inspect", text(&dir.join("y.ply")), "-o", text(&dir.join("y.png"))]);
    assert!(String::from_utf8_lossy(&printed.stdout).contains("colour of degree 0, linear"));
    assert_eq!(image::image_dimensions(dir.join("y.png")).unwrap(), (1200, 400));
    std::fs::write(dir.join("broken.spz"), b"NGSP").unwrap();
    assert_eq!(diamond(&["inspect", text(&dir.join("broken.spz"))]).status.code(), Some(3));
    let again = dir.join("from-splats");
    let words = ["reconstruct", text(&capture), "-o", text(&again), "--preset", text(&config), "--steps", "2"];
    let printed = succeed(&[&words[..], &["--initial", text(&dir.join("x.glb"))]].concat());
    assert!(String::from_utf8_lossy(&printed.stderr).contains("Gaussians of "), "{printed:?}");
    succeed(&["inspect", text(&capture), "-o", text(&dir.join("overview.png"))]);
    succeed(&["presets", "paper"]);
    assert_eq!(diamond(&["presets", "no-such"]).status.code(), Some(3));
    assert_eq!(diamond(&["reconstruct"]).status.code(), Some(2));
    assert_eq!(diamond(&["evaluate", text(&dir.join("nothing")), text(&capture)]).status.code(), Some(3));
    std::fs::remove_dir_all(dir).unwrap();
}
