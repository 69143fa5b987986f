//! `--memory-limit`: what the process really takes (`VmHWM` of `/proc`), against the plan and against the limit.
use crate::captures::{ball_capture, scratch};
use crate::sessions::{stderr, text};
use diamond_dataset::Selection;
use diamond_sss::{Event, MemoryPlan, PlanOptions, ReconstructOptions, SssError, plan_capture, reconstruct};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Plans are right within this factor, up or down.
const FACTOR: f64 = 1.25;

/// A capture and a configuration of it.
struct Case {
    dir: PathBuf,
}

impl Case {
    /// `views` × `lights` at `side`², the last view under eight lights; so many Gaussians anywhere in the bounds.
    fn new(name: &str, (views, lights, side): (usize, usize, u32), gaussians: usize) -> Self {
        let dir = scratch(name);
        ball_capture(&dir.join("capture"), views, lights, side, 8);
        let config = format!(
            "base = \"resolved\"\nname = \"{name}\"\nsteps = 6\ncheckpoint_steps = 4\n[initial]\nsource = \"uniform\"\n\
             count = {gaussians}\n[density]\nstrategy = \"none\"\nmax_gaussians = {gaussians}\n\
             [subsurface]\nmodel = \"mlp\"\n"
        );
        std::fs::write(dir.join("case.toml"), config).unwrap();
        Self { dir }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.join(name)
    }

    fn plan(&self, limit_mib: Option<u64>) -> Result<MemoryPlan, SssError> {
        let plan = plan_capture(&PlanOptions {
            capture: self.path("capture"),
            preset: text(&self.path("case.toml")).into(),
            settings: Vec::new(),
            views: Selection::All,
            lights: Selection::All,
            memory_limit: limit_mib.map(|mib| format!("{mib} MiB").parse().unwrap()),
        })?;
        Ok(plan.memory)
    }

    fn command(&self, out: &str, extra: &[&str]) -> Command {
        let (capture, out, config) = (self.path("capture"), self.path(out), self.path("case.toml"));
        let mut command = Command::new(env!("CARGO_BIN_EXE_diamond"));
        command.args(["reconstruct", text(&capture), "-o", text(&out), "--preset", text(&config)]).args(extra);
        command
    }

    /// Runs to the end; the high-water mark that the system tells of the process, bytes, and what it said.
    fn run(&self, out: &str, extra: &[&str]) -> (u64, String) {
        // To a file, since nobody reads a pipe meanwhile.
        let said = self.path("stderr.txt");
        let mut command = self.command(out, extra);
        command.stdout(Stdio::null()).stderr(std::fs::File::create(&said).unwrap());
        let mut child = command.spawn().unwrap();
        let status = format!("/proc/{}/status", child.id());
        let mut peak = 0;
        let ended = loop {
            if let Ok(status) = std::fs::read_to_string(&status)
                && let Some(line) = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))
            {
                peak = 1024 * line.trim().trim_end_matches(" kB").parse::<u64>().unwrap();
            }
            if let Some(ended) = child.try_wait().unwrap() {
                break ended;
            }
            std::thread::sleep(Duration::from_millis(2));
        };
        let said = std::fs::read_to_string(said).unwrap();
        assert!(ended.success(), "{said}");
        // A resumed run knows of its earlier sessions.
        if extra.contains(&"--resume") {
            return (peak, said);
        }
        let own = self.json(out, "profile.json")["peak_bytes"].as_u64().unwrap();
        assert!(peak.abs_diff(own) < own / 20, "peak {peak}, of its own account {own}");
        (peak, said)
    }

    fn json(&self, out: &str, name: &str) -> serde_json::Value {
        serde_json::from_str(&std::fs::read_to_string(self.path(out).join(name)).unwrap()).unwrap()
    }

    fn assert_same(&self, a: &str, b: &str) {
        for name in ["model.ply", "network.safetensors", "metrics.csv", "log.csv", "scene.toml"] {
            let read = |out: &str| std::fs::read(self.path(out).join(name)).unwrap();
            assert!(read(a) == read(b), "{name} differs between {a} and {b}");
        }
    }

    fn clear(self) {
        std::fs::remove_dir_all(self.dir).unwrap();
    }
}

fn assert_planned(what: &str, plan: &MemoryPlan, measured: u64) {
    let ratio = plan.peak as f64 / measured as f64;
    println!("{what}: planned {} MiB, measured {} MiB, ratio {ratio:.2}; {plan}", plan.peak >> 20, measured >> 20);
    assert!(ratio < FACTOR && ratio > 1.0 / FACTOR, "{what}: {measured} bytes, but {plan}");
}

fn linux() -> bool {
    let here = Path::new("/proc/self/status").exists();
    if !here {
        eprintln!("not checked: this system has no /proc");
    }
    here
}

/// Many photographs, few Gaussians: what is held at once is enough to lower, and not a bit changes.
#[test]
fn photographs_and_buffers_make_room_without_a_change_of_the_result() {
    if !linux() {
        return;
    }
    let case = Case::new("memory-same", (8, 24, 256), 3000);
    let free = case.plan(None).unwrap();
    let limit = (1..4096).find(|&mib| case.plan(Some(mib)).is_ok_and(|plan| plan.gaussians_wanted.is_none())).unwrap();
    let plan = case.plan(Some(limit)).unwrap();
    assert!(!plan.lowered.is_empty() && plan.gaussians == free.gaussians, "{plan}");
    let (unlimited, _) = case.run("free", &[]);
    assert!(unlimited > limit << 20, "{unlimited} bytes would have been below the limit of {limit} MiB anyway");
    assert_planned("3000 Gaussians at 256²", &free, unlimited);
    let (limited, said) = case.run("limited", &["--memory-limit", &format!("{limit}MiB")]);
    assert!(limited < limit << 20, "limit {limit} MiB, peak {limited} bytes: {said}");
    assert!(said.contains("the result is the same") && !said.contains("RESULT CHANGES"), "{said}");
    assert_planned("the same, limited", &plan, limited);
    case.assert_same("free", "limited");
    case.clear();
}

/// A surface and a medium: found before the first step, kept to the end.
#[test]
fn a_medium_is_planned_for() {
    if !linux() {
        return;
    }
    let case = Case::new("memory-medium", (8, 8, 128), 4000);
    let config = "base = \"resolved\"\nsteps = 6\n[initial]\ncount = 4000\n[density]\nstrategy = \"none\"\nmax_gaussians = 9000\n";
    std::fs::write(case.path("case.toml"), config).unwrap();
    let plan = case.plan(None).unwrap();
    let (measured, said) = case.run("out", &[]);
    assert!(said.contains("medium: profile inside a surface"), "{said}");
    assert!(plan.to_string().contains("fit of the medium"), "{plan}");
    assert_planned("a medium at 128²", &plan, measured);
    case.clear();
}

/// Many Gaussians: fewer of them, and the plan is kept by a resumed run, on other numbers of threads as well.
#[test]
fn gaussians_make_room_and_it_is_said() {
    if !linux() {
        return;
    }
    let case = Case::new("memory-fewer", (6, 4, 128), 40_000);
    let free = case.plan(None).unwrap();
    let limit = 90;
    let plan = case.plan(Some(limit)).unwrap();
    assert_eq!((free.gaussians.0, plan.gaussians_wanted), (40_000, Some(40_000)));
    assert!((1000..30_000).contains(&plan.gaussians.0) && plan.peak < limit << 20, "{plan}");
    let (unlimited, _) = case.run("free", &[]);
    assert!(unlimited > limit << 20, "{unlimited} bytes would have been below the limit of {limit} MiB anyway");
    assert_planned("40000 Gaussians at 128²", &free, unlimited);
    let words = format!("{limit} MiB");
    let (limited, said) = case.run("limited", &["--memory-limit", &words]);
    assert!(limited < limit << 20, "limit {limit} MiB, peak {limited} bytes: {said}");
    let expected = format!("density.max_gaussians = {} instead of 40000", plan.gaussians.0);
    assert!(said.contains(&expected) && said.contains("RESULT CHANGES"), "{said}");
    assert_planned("fewer Gaussians at 128²", &plan, limited);
    assert_eq!(case.json("limited", "metrics.json")["gaussians"], plan.gaussians.0);

    let mut options = ReconstructOptions::new(case.path("capture"), case.path("resumed"));
    options.preset = text(&case.path("case.toml")).into();
    options.memory_limit = Some(words.parse().unwrap());
    let stop = AtomicBool::new(false);
    let mut events = |event: Event<'_>| {
        if let Event::Step { report, .. } = event {
            stop.store(report.step == 3, Ordering::SeqCst);
        }
    };
    assert!(matches!(reconstruct(&options, &mut events, &stop), Err(SssError::Interrupted { step: 4, .. })));
    let refused = case.command("resumed", &["--resume"]).output().unwrap();
    assert!(refused.status.code() == Some(3) && stderr(&refused).contains("another configuration"), "{refused:?}");
    case.run("resumed", &["--resume", "--memory-limit", &words, "--threads", "1"]);
    case.assert_same("limited", "resumed");
    case.clear();
}

#[test]
fn a_limit_that_cannot_be_kept_is_refused_before_the_start() {
    let case = Case::new("memory-refused", (3, 2, 64), 2000);
    let output: Output = case.command("out", &["--memory-limit", "4 MiB"]).output().unwrap();
    let message = stderr(&output);
    assert_eq!(output.status.code(), Some(2), "{message}");
    assert!(message.contains("too small") && message.contains("would do") && message.contains("MiB"), "{message}");
    assert!(!case.path("out").exists());
    let least: u64 = message.split(": ").nth(2).and_then(|t| t.split(" MiB").next()).unwrap().parse().unwrap();
    assert!(case.plan(Some(least)).is_ok() && case.plan(Some(least - 4)).is_err(), "{message}");
    assert_eq!(case.command("out", &["--memory-limit", "much"]).output().unwrap().status.code(), Some(2));
    let capture = case.path("capture");
    let planned = Command::new(env!("CARGO_BIN_EXE_diamond"))
        .args(["plan", text(&capture), "--memory-limit", "100MiB"])
        .output()
        .unwrap();
    let printed = String::from_utf8_lossy(&planned.stdout).into_owned();
    for expected in ["the limit is 100 MiB", "Gaussians: values and two moments", "photographs", "THE RESULT CHANGES"] {
        assert!(printed.contains(expected), "{expected} in {printed}");
    }
    case.clear();
}
