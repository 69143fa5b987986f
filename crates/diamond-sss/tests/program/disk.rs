//! Disks that are full or may not be written to: an error that names the file and says what to do, and what was there
//! before stays whole.
use crate::sessions::{Bench, assert_whole, signal, state_of, stderr, step_of, text, wait};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

/// A run that was interrupted after its first checkpoint, beside one that was not.
fn interrupted(bench: &Bench) -> (PathBuf, PathBuf) {
    let (whole, out) = (bench.dir.join("whole"), bench.dir.join("out"));
    bench.finish(&whole, &[]);
    interrupt(bench, &out);
    (whole, out)
}

fn interrupt(bench: &Bench, out: &Path) {
    let child = bench.start(out, &["--resume"], 0);
    signal(&child, "INT");
    let (code, message) = wait(child);
    assert_eq!(code, Some(130), "{message}");
}

fn assert_failed(output: &Output, code: i32, words: &[&str]) {
    let message = stderr(output);
    assert!(!message.contains("panicked"), "{message}");
    assert_eq!(output.status.code(), Some(code), "{message}");
    words.iter().for_each(|word| assert!(message.contains(word), "{word:?} is not in: {message}"));
}

/// Runs as root do what they like; what they may not do is then tried as nobody.
fn unprivileged(program: &Path, arguments: &[String]) -> Option<Command> {
    let root = Command::new("id").arg("-u").output().unwrap().stdout.starts_with(b"0\n");
    let mut command = match root {
        false => Command::new(program),
        true => {
            let mut command = Command::new("setpriv");
            command.args(["--reuid", "65534", "--regid", "65534", "--clear-groups"]).arg(program);
            command
        }
    };
    command.args(arguments);
    let works = match root {
        false => true,
        true => Command::new("setpriv")
            .args(["--reuid", "65534", "--regid", "65534", "--clear-groups", "true"])
            .stderr(Stdio::null())
            .status()
            .is_ok_and(|s| s.success()),
    };
    works.then_some(command)
}

/// A small file system of our own at `at`; `None` without the right to make one.
struct SmallDisk<'a>(&'a Path);

impl<'a> SmallDisk<'a> {
    fn mount(at: &'a Path, options: &str) -> Option<Self> {
        std::fs::create_dir_all(at).unwrap();
        let mut command = Command::new("mount");
        command.args(["-t", "tmpfs", "-o", options, "diamond-test"]).arg(at).stderr(Stdio::null());
        command.status().is_ok_and(|s| s.success()).then_some(Self(at))
    }

    fn change(&self, options: &str) {
        let changed = Command::new("mount").args(["-o", &format!("remount,{options}")]).arg(self.0).status().unwrap();
        assert!(changed.success());
    }
}

impl Drop for SmallDisk<'_> {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(self.0).status();
    }
}

#[test]
fn files_that_grow_too_large() {
    let bench = Bench::new("file-limit", 150, 4);
    let (whole, out) = interrupted(&bench);
    let before = std::fs::read(state_of(&out)).unwrap();
    // The limit is in blocks of 512 or 1024 bytes; the checkpoint is larger than 64 KiB, the log is smaller than 32.
    assert!(before.len() > 66 << 10, "{}", before.len());
    let limited = Command::new("sh")
        .args(["-c", "ulimit -f 64; exec \"$@\"", "sh", env!("CARGO_BIN_EXE_diamond")])
        .args(bench.arguments(&out, &["--resume"]))
        .output()
        .unwrap();
    assert_failed(&limited, 1, &["state.safetensors", "File too large", "ulimit -f", "--resume"]);
    assert!(std::fs::read(state_of(&out)).unwrap() == before, "the checkpoint must be the one before");
    assert_eq!(assert_whole(&out), 0);
    bench.finish(&out, &["--resume"]);
    bench.assert_same(&whole, &out);
    bench.clear();
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_device() {
    let bench = Bench::new("full-device", 4, 4);
    let out = bench.dir.join("out");
    bench.finish(&out, &[]);
    // By links of our own, so that a mistake would replace them and not the machine's devices.
    let link = |name: &str, device: &str| {
        std::os::unix::fs::symlink(device, bench.dir.join(name)).unwrap();
        bench.dir.join(name)
    };
    let (full, none) = (link("full.png", "/dev/full"), link("none.png", "/dev/null"));
    let diamond = |words: &[&str]| Command::new(env!("CARGO_BIN_EXE_diamond")).args(words).output().unwrap();
    let render = diamond(&["render", text(&out), "-o", text(&full), "--direction", "0,0,1"]);
    assert_failed(&render, 1, &["full.png", "No space left", "free some space"]);
    let inspect = diamond(&["inspect", text(&bench.capture), "-o", text(&full)]);
    assert_failed(&inspect, 1, &["full.png", "No space left", "free some space"]);
    let render = diamond(&["render", text(&out), "-o", text(&none), "--direction", "0,0,1"]);
    assert!(render.status.success(), "{}", stderr(&render));
    assert!(full.is_symlink() && none.is_symlink());
    assert_eq!(assert_whole(&out), 0);
    bench.clear();
}

#[test]
fn a_full_disk_and_one_that_is_read_only() {
    let bench = Bench::new("full-disk", 150, 4);
    let (whole, other) = interrupted(&bench);
    let state = std::fs::metadata(state_of(&other)).unwrap().len();
    let small = bench.dir.join("small");
    // Room for one checkpoint and a half.
    let Some(disk) = SmallDisk::mount(&small, &format!("size={}k", (state + state / 2) / 1024 + 24)) else {
        eprintln!("not tested: mounting a small disk needs root");
        return bench.clear();
    };
    let out = small.join("out");
    let failed = bench.command(&out, &[]).output().unwrap();
    assert_failed(&failed, 1, &["state.safetensors", "No space left", "free some space", "--resume"]);
    assert!(step_of(&out) >= Some(4) && assert_whole(&out) == 0, "the checkpoint before stays");
    disk.change("size=64m,ro");
    let failed = bench.command(&out, &["--resume"]).output().unwrap();
    assert_failed(&failed, 1, &[text(&out), "Read-only file system", "name another place"]);
    disk.change("size=64m,rw");
    bench.finish(&out, &["--resume"]);
    bench.assert_same(&whole, &out);
    drop(disk);
    bench.clear();
}

#[test]
fn places_that_cannot_be_written_to() {
    use std::os::unix::fs::PermissionsExt;
    let bench = Bench::new("read-only", 4, 4);
    let file = bench.dir.join("a-file");
    std::fs::write(&file, "mine").unwrap();
    for out in [file.clone(), file.join("below"), file.join("far/below")] {
        assert_failed(&bench.command(&out, &[]).output().unwrap(), 2, &["a-file is a file", "-o"]);
    }
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "mine");

    let locked = bench.dir.join("locked");
    std::fs::create_dir(&locked).unwrap();
    std::fs::set_permissions(&locked, std::fs::Permissions::from_mode(0o555)).unwrap();
    // The program is built where nobody else may look.
    let program = bench.dir.join("diamond");
    std::fs::copy(env!("CARGO_BIN_EXE_diamond"), &program).unwrap();
    for out in [locked.clone(), locked.join("below")] {
        let Some(mut command) = unprivileged(&program, &bench.arguments(&out, &[])) else {
            eprintln!("not tested: root may write everywhere, and setpriv is not there to be somebody else");
            break;
        };
        assert_failed(&command.output().unwrap(), 1, &["locked", "Permission denied", "name another place"]);
    }
    assert_eq!(std::fs::read_dir(&locked).unwrap().count(), 0);
    std::fs::set_permissions(&locked, std::fs::Permissions::from_mode(0o755)).unwrap();
    bench.clear();
}
