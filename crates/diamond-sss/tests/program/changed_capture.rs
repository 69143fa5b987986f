//! The capture changes while a run uses it, or between two sessions: the run stops with an error that names the file and
//! its frame, and keeps what it has done. It never goes on with other data.
use crate::sessions::{Bench, assert_whole, signal, stderr, step_of, text, wait};
use std::path::Path;

/// Puts other content in the place of a file at once, as a careful program does.
fn replace(path: &Path, content: &[u8]) {
    let beside = path.with_extension("new");
    std::fs::write(&beside, content).unwrap();
    std::fs::rename(beside, path).unwrap();
}

fn larger(path: &Path) -> Vec<u8> {
    let picture = image::open(path).unwrap().resize_exact(40, 40, image::imageops::FilterType::Nearest);
    let mut out = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut out, image::ImageFormat::Png).unwrap();
    out.into_inner()
}

#[test]
fn during_a_run() {
    // Longer than anyone waits: these runs end by what is done to them.
    let bench = Bench::new("changed-run", 1_000_000, 3);
    let image = bench.capture.join("train/r_1_l_0.png");
    let good = std::fs::read(&image).unwrap();
    let other = std::fs::read(bench.capture.join("train/r_0_l_1.png")).unwrap();
    type Damage<'a> = (&'a str, &'a str, Box<dyn Fn() + 'a>);
    let damages: [Damage; 4] = [
        ("content", "changed while it was in use", Box::new(|| replace(&image, &other))),
        ("size", "changed while it was in use", Box::new(|| replace(&image, &larger(&image)))),
        ("cut short", "changed while it was in use", Box::new(|| replace(&image, &good[..good.len() / 2]))),
        ("deleted", "No such file", Box::new(|| std::fs::remove_file(&image).unwrap())),
    ];
    let out = bench.dir.join("out");
    let mut reached = 0;
    for (name, words, damage) in damages {
        let child = bench.start(&out, &["--resume"], reached);
        damage();
        let (code, message) = wait(child);
        assert_eq!(code, Some(3), "{name}: {message}");
        for word in [words, "frame 1", "file_paths[0]", "steps are kept", "--resume"] {
            assert!(message.contains(word), "{name}: {word:?} is not in: {message}");
        }
        if name != "deleted" {
            assert!(message.contains("r_1_l_0.png"), "{message}");
        }
        assert_eq!(assert_whole(&out), 0);
        let kept = step_of(&out).unwrap();
        assert!(kept > reached && message.contains(&format!("{kept} steps are kept")), "{message}");
        reached = kept;
        replace(&image, &good);
    }
    let child = bench.start(&out, &["--resume"], reached);
    signal(&child, "INT");
    let (code, message) = wait(child);
    assert!(code == Some(130) && message.contains(&format!("continuing after step {reached}")), "{message}");
    bench.clear();
}

#[test]
fn between_two_sessions() {
    let bench = Bench::new("changed-between", 150, 4);
    let (whole, out) = (bench.dir.join("whole"), bench.dir.join("out"));
    bench.finish(&whole, &[]);
    let child = bench.start(&out, &[], 0);
    signal(&child, "INT");
    assert_eq!(wait(child).0, Some(130));
    let frames = bench.capture.join("transforms_train.json");
    let mut moved_light: serde_json::Value = serde_json::from_slice(&std::fs::read(&frames).unwrap()).unwrap();
    moved_light["frames"][0]["light_positions"][0][2] = 2.5.into();
    let others: [(&str, Vec<u8>, &[&str]); 3] = [
        ("train/r_1_l_0.png", std::fs::read(bench.capture.join("train/r_0_l_1.png")).unwrap(), &["frame 1"]),
        ("test/r_3_l_0.png", std::fs::read(bench.capture.join("train/r_0_l_1.png")).unwrap(), &["frame 0"]),
        ("transforms_train.json", moved_light.to_string().into_bytes(), &[]),
    ];
    for (name, content, words) in others {
        let path = bench.capture.join(name);
        let good = std::fs::read(&path).unwrap();
        replace(&path, &content);
        let output = bench.command(&out, &["--resume"]).output().unwrap();
        let message = stderr(&output);
        assert_eq!(output.status.code(), Some(3), "{name}: {message}");
        for word in [name, "has other content", "start anew"].iter().chain(words) {
            assert!(message.contains(word), "{name}: {word:?} is not in: {message}");
        }
        assert_eq!(assert_whole(&out), 0);
        replace(&path, &good);
    }
    // Where the capture lies does not matter.
    let elsewhere = bench.dir.join("elsewhere");
    std::fs::rename(&bench.capture, &elsewhere).unwrap();
    let mut arguments = bench.arguments(&out, &["--resume"]);
    arguments[1] = text(&elsewhere).to_owned();
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_diamond")).args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    bench.assert_same(&whole, &out);
    bench.clear();
}
