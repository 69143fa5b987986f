//! Running the program and stopping it: what the tests of robustness have in common.
use crate::captures::{scratch, tiny_capture};
use diamond_reconstruct::TensorFile;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// Longest wait for anything; a machine under load is slow.
const PATIENCE: Duration = Duration::from_secs(120);

/// A tiny capture and a configuration; runs of it go to folders beside them.
pub struct Bench {
    /// The folder of everything.
    pub dir: PathBuf,
    /// The capture.
    pub capture: PathBuf,
    config: PathBuf,
    steps: String,
}

impl Bench {
    /// Runs of `steps` steps with a checkpoint every `every`; images are read anew at each step.
    pub fn new(name: &str, steps: u64, every: u64) -> Self {
        let dir = scratch(name);
        let (capture, config) = (dir.join("capture"), dir.join("often.toml"));
        tiny_capture(&capture, 3, 2);
        let text = format!(
            "base = \"resolved\"\nname = \"often\"\ncheckpoint_steps = {every}\n[input]\ncache_bytes = 1\n[initial]\n\
             count = 100\nhull_resolution = 16\n[residual]\nhidden = [16, 16]\n[density]\nevery_steps = 10\n\
             max_gaussians = 200\n"
        );
        std::fs::write(&config, text).unwrap();
        Self { dir, capture, config, steps: steps.to_string() }
    }

    /// The words of `diamond reconstruct` into `out`.
    pub fn arguments(&self, out: &Path, extra: &[&str]) -> Vec<String> {
        let words = ["reconstruct", text(&self.capture), "-o", text(out), "--preset", text(&self.config), "--steps"];
        words.iter().chain([&self.steps.as_str()]).chain(extra).map(|s| (*s).to_owned()).collect()
    }

    /// The command `diamond reconstruct` into `out`.
    pub fn command(&self, out: &Path, extra: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_diamond"));
        command.args(self.arguments(out, extra));
        command
    }

    /// Runs to the end.
    pub fn finish(&self, out: &Path, extra: &[&str]) {
        let output = self.command(out, extra).output().unwrap();
        assert!(output.status.success(), "{extra:?}: {}", stderr(&output));
    }

    /// Starts a run and waits for a checkpoint later than step `after`.
    pub fn start(&self, out: &Path, extra: &[&str], after: u64) -> Child {
        let mut child = self.command(out, extra).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        let begun = Instant::now();
        while step_of(out).unwrap_or(0) <= after {
            if child.try_wait().unwrap().is_some() || begun.elapsed() > PATIENCE {
                let output = child.wait_with_output().unwrap();
                panic!("no checkpoint after step {after}: {:?}: {}", output.status, stderr(&output));
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        child
    }

    /// Compares what two finished runs came to, bit for bit.
    pub fn assert_same(&self, a: &Path, b: &Path) {
        for name in ["model.ply", "network.safetensors", "metrics.csv", "log.csv", "scene.toml", "config.toml"] {
            let read = |out: &Path| std::fs::read(out.join(name)).unwrap();
            assert!(read(a) == read(b), "{name} differs");
        }
    }

    /// Removes everything.
    pub fn clear(self) {
        std::fs::remove_dir_all(self.dir).unwrap();
    }
}

/// A path as text.
pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// What a process said beside its results.
pub fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// The file of the checkpoint.
pub fn state_of(out: &Path) -> PathBuf {
    out.join("checkpoint/state.safetensors")
}

/// Steps of the checkpoint; `None` where there is none. A broken one is a failure.
pub fn step_of(out: &Path) -> Option<u64> {
    let path = state_of(out);
    path.is_file().then(|| TensorFile::read(&path).unwrap().metadata_value(&path, "step").unwrap())
}

/// Sends a signal (`INT`, `TERM`).
#[cfg(unix)]
pub fn signal(child: &Child, name: &str) {
    let sent = Command::new("kill").args([&format!("-{name}"), &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
}

/// Waits for the end of a process: exit code and everything that it said.
pub fn wait(mut child: Child) -> (Option<i32>, String) {
    let begun = Instant::now();
    while child.try_wait().unwrap().is_none() && begun.elapsed() < PATIENCE {
        std::thread::sleep(Duration::from_millis(5));
    }
    child.kill().unwrap();
    let output = child.wait_with_output().unwrap();
    let message = stderr(&output);
    assert!(!message.contains("panicked"), "{message}");
    (output.status.code(), message)
}

/// Reads what the process says until a line holds `word`.
pub fn wait_for_line(lines: &mut BufReader<impl Read>, word: &str) {
    let mut line = String::new();
    while !line.contains(word) {
        line.clear();
        assert!(lines.read_line(&mut line).unwrap() > 0, "{word:?} was never said");
    }
}

/// Checks that every file of a run's folder is whole: it parses as what its name says. Returns the number of temporary
/// files, which a killed process may leave and a later one removes.
pub fn assert_whole(folder: &Path) -> usize {
    let mut temporary = 0;
    for entry in std::fs::read_dir(folder).into_iter().flatten() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if path.is_dir() {
            temporary += assert_whole(&path);
            continue;
        }
        if name.starts_with('.') && name.ends_with(".tmp") {
            temporary += 1;
            continue;
        }
        let content = || std::fs::read_to_string(&path).unwrap();
        match path.extension().and_then(|e| e.to_str()) {
            Some("json") => drop(serde_json::from_str::<serde_json::Value>(&content()).expect(&name)),
            Some("toml") => drop(content().parse::<toml::Table>().expect(&name)),
            Some("safetensors") => drop(TensorFile::read(&path).expect(&name)),
            Some("ply") => assert!(diamond_splat::read_ply(&path).expect(&name).len > 0),
            Some("png") => drop(image::open(&path).expect(&name)),
            Some("html") => assert!(content().trim_end().ends_with("</html>"), "{name}"),
            Some("csv") => {
                let content = content();
                let cells: Vec<usize> = content.lines().map(|line| line.split(',').count()).collect();
                assert!(content.ends_with('\n') && cells.iter().all(|c| *c == cells[0]), "{name}: {content}");
            }
            _ => panic!("{}: nobody knows this file", path.display()),
        }
    }
    temporary
}
