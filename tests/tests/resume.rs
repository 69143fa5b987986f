//! Interrupted and resumed: the same bits as uninterrupted.
use crate::captures::{scratch, small_config, tiny_capture};
use diamond_sss::{Event, ReconstructOptions, SssError, reconstruct};
use std::sync::atomic::{AtomicBool, Ordering};

#[test]
fn an_interrupted_run_resumes_bit_for_bit() {
    let dir = scratch("resume");
    let capture = dir.join("capture");
    tiny_capture(&capture, 3, 2);
    let mut options = ReconstructOptions::new(&capture, dir.join("whole"));
    options.preset = small_config(&dir).to_str().unwrap().to_owned();
    options.steps = Some(24);
    let never = AtomicBool::new(false);
    reconstruct(&options, &mut |_| {}, &never).unwrap();

    options.output = dir.join("parts");
    options.resume = true;
    let mut notes = String::new();
    for stop_after in [3u64, 13] {
        let interrupt = AtomicBool::new(false);
        let outcome = reconstruct(
            &options,
            &mut |event| match event {
                Event::Step { report, .. } if report.step + 1 == stop_after => interrupt.store(true, Ordering::SeqCst),
                Event::Note(text) => notes += &text,
                _ => {}
            },
            &interrupt,
        );
        match outcome {
            Err(e @ SssError::Interrupted { step, .. }) => {
                assert_eq!(step, stop_after);
                assert_eq!(e.exit_code(), 130);
                assert!(e.to_string().contains("--resume"));
            }
            other => panic!("expected an interruption, found {other:?}"),
        }
    }
    assert!(notes.contains("starting anew"), "the first --resume had no checkpoint and must say so");
    let first = reconstruct(&options, &mut |_| {}, &never).unwrap();
    assert!(first.seconds > 0.0);
    for name in ["model.ply", "network.safetensors", "metrics.csv"] {
        let (a, b) = (std::fs::read(dir.join("whole").join(name)), std::fs::read(dir.join("parts").join(name)));
        assert!(a.unwrap() == b.unwrap(), "{name} differs after resuming");
    }

    // Another configuration or another choice of images cannot be resumed.
    options.seed = Some(99);
    let error = reconstruct(&options, &mut |_| {}, &never).unwrap_err();
    assert_eq!(error.exit_code(), 3);
    assert!(error.to_string().contains("another configuration"), "{error}");
    std::fs::remove_dir_all(dir).unwrap();
}
