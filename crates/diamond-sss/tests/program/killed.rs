//! Stopped at any moment, by `kill -9` or Ctrl-C: nothing lost, nothing half-written, and the same bits in the end.
use crate::sessions::{Bench, assert_whole, stderr, step_of, wait};
use std::process::Stdio;
use std::time::Duration;

/// A number in 0 .. `below` from a sequence that is the same in every run (SplitMix64).
fn draw(state: &mut u64, below: u64) -> u64 {
    *state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    (z ^ (z >> 31)) % below
}

/// Kills one run `kills` times, most of them while it takes steps and writes, some while it starts, the last few while it
/// writes its results; then lets it finish.
fn kill_repeatedly(name: &str, kills: u64, steps: u64, seed: u64) {
    let bench = Bench::new(name, steps, 2);
    let (whole, killed) = (bench.dir.join("whole"), bench.dir.join("killed"));
    bench.finish(&whole, &[]);
    let mut random = seed;
    let (mut reached, mut leftovers, mut while_starting) = (0, 0, 0);
    for kill in 0..kills {
        let at_start = draw(&mut random, 4) == 0;
        let delay = Duration::from_micros(draw(&mut random, if at_start { 200_000 } else { 60_000 }));
        let mut child = if at_start || reached >= steps {
            while_starting += 1;
            let mut command = bench.command(&killed, &["--resume"]);
            command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
        } else {
            bench.start(&killed, &["--resume"], reached)
        };
        std::thread::sleep(delay);
        // SIGKILL: nothing in the program can answer it.
        child.kill().unwrap();
        let output = child.wait_with_output().unwrap();
        assert!(!stderr(&output).contains("panicked"), "kill {kill}: {}", stderr(&output));
        leftovers += assert_whole(&killed);
        let step = step_of(&killed).unwrap_or(0);
        assert!(step >= reached, "kill {kill}: the checkpoint went back from step {reached} to {step}");
        reached = step;
    }
    println!(
        "{kills} kills ({while_starting} without waiting for a step), {reached} of {steps} steps then done, {leftovers} \
         temporary files seen"
    );
    bench.finish(&killed, &["--resume"]);
    assert_eq!(assert_whole(&killed), 0, "the next run removes what a killed one left");
    bench.assert_same(&whole, &killed);
    bench.clear();
}

#[test]
fn killed_five_times() {
    kill_repeatedly("kill-5", 5, 60, 1);
}

#[test]
#[ignore = "long: a minute of kills"]
fn killed_thirty_times() {
    kill_repeatedly("kill-30", 30, 240, 20_261_122);
}

#[cfg(unix)]
#[test]
fn ctrl_c_and_terminate_write_a_checkpoint() {
    use crate::sessions::signal;
    let bench = Bench::new("ctrl-c", 200, 4);
    let (whole, stopped) = (bench.dir.join("whole"), bench.dir.join("stopped"));
    bench.finish(&whole, &[]);
    let mut reached = 0;
    for name in ["INT", "TERM"] {
        let child = bench.start(&stopped, &["--resume"], reached);
        signal(&child, name);
        let (code, message) = wait(child);
        // The last step may have been done when the signal came; the figures are then what is interrupted.
        assert_eq!(code, Some(130), "{name}: {message}");
        assert!(message.contains("--resume"), "{message}");
        assert_eq!(assert_whole(&stopped), 0);
        reached = step_of(&stopped).unwrap();
        assert!(message.contains(&format!("after step {reached};")), "{message}");
    }
    bench.finish(&stopped, &["--resume"]);
    bench.assert_same(&whole, &stopped);
    bench.clear();
}

#[cfg(unix)]
#[test]
fn the_second_ctrl_c_stops_at_once() {
    use crate::sessions::{signal, wait_for_line};
    use std::io::BufReader;
    let bench = Bench::new("ctrl-c-twice", 40, 4);
    // An image that never comes: the program waits where it does not look at the first Ctrl-C.
    let image = bench.capture.join("train/r_0_l_1.png");
    std::fs::remove_file(&image).unwrap();
    std::fs::remove_file(bench.capture.join("transforms_test.json")).unwrap();
    let made = std::process::Command::new("mkfifo").arg(&image).status().unwrap();
    assert!(made.success());
    let mut child = bench.command(&bench.dir.join("out"), &[]).stderr(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap());
    wait_for_line(&mut lines, "held-out");
    signal(&child, "INT");
    wait_for_line(&mut lines, "press Ctrl-C again");
    assert!(child.try_wait().unwrap().is_none());
    signal(&child, "INT");
    let (code, _) = wait(child);
    assert_eq!(code, Some(130));
    bench.clear();
}

/// A terminal that is gone must not take the run with it.
#[cfg(target_os = "linux")]
#[test]
fn nobody_listening_is_no_error() {
    let bench = Bench::new("deaf", 6, 4);
    let full = || Stdio::from(std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap());
    let out = bench.dir.join("out");
    let status = bench.command(&out, &["--resume"]).stdout(full()).stderr(full()).status().unwrap();
    assert!(status.success(), "{status:?}");
    assert_eq!(assert_whole(&out), 0);
    let status = bench.command(&bench.dir.join("often.toml"), &[]).stderr(full()).status().unwrap();
    assert_eq!(status.code(), Some(2), "an error that nobody hears keeps its exit code");
    bench.clear();
}
