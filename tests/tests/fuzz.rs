//! Every reader against files that are broken on purpose. See docs/testing.md, "Robustness".
//!
//! A case passes when the reader answers, with a value or an error, without a panic, within two seconds and within its
//! memory; when what it accepts is finite and valid; and, where there is a writer, when what it accepts reads back the
//! same after it is written.
mod allocation;
mod captures;
mod harness;
mod meshes;
mod models;
mod mutate;
mod random;
mod splats;

use harness::{Answer, Budget, Failure, Tally, Target, failures_folder, keep, run};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

#[global_allocator]
static ALLOCATOR: allocation::Counting = allocation::Counting;

/// Of the short run; the long one draws its own unless `DIAMOND_FUZZ_SEED` says otherwise.
const SHORT_SEED: u64 = 1;
/// Of the long run over all targets, unless `DIAMOND_FUZZ_SECONDS` says otherwise.
const LONG_SECONDS: u64 = 240;

/// A file of the repository's assets.
fn asset(path: &str) -> Vec<u8> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../assets").join(path);
    std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// A configuration whose steps take milliseconds.
fn small_config_text() -> String {
    "base = \"resolved\"\nname = \"small\"\nsteps = 4\n[initial]\ncount = 24\nhull_resolution = 12\n[residual]\n\
     hidden = [8, 8]\n[density]\nevery_steps = 10\nmax_gaussians = 48\n"
        .into()
}

/// A law that a value must obey.
fn law<E: std::fmt::Display>(what: &str, holds: Result<(), E>) -> Result<(), String> {
    holds.map_err(|e| format!("accepts a {what} that is refused later: {e}"))
}

/// Every target. Those that read folders make theirs in `folder`.
fn targets(folder: &Path) -> Vec<Target> {
    let mut out = captures::targets(folder);
    out.extend(models::targets(folder));
    out.extend(splats::targets());
    out.extend(meshes::targets());
    out
}

/// A folder that is removed in the end.
struct Scratch(PathBuf);

impl Scratch {
    fn new() -> Self {
        static NEXT: AtomicUsize = AtomicUsize::new(0);
        let name = format!("fuzz-{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
        std::fs::create_dir_all(&folder).unwrap();
        Self(folder)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// A new folder inside another.
fn folder_in(folder: &Path, name: &str) -> PathBuf {
    let out = folder.join(name);
    std::fs::create_dir_all(&out).unwrap();
    out
}

fn variable(name: &str) -> Option<u64> {
    std::env::var(name).ok().and_then(|text| text.parse().ok())
}

/// Runs the targets whose names begin as `DIAMOND_FUZZ_ONLY` says (all without it), and says what came of each.
fn fuzz(seed: u64, budget: impl Fn(&Target, usize) -> Budget) {
    let scratch = Scratch::new();
    let only = std::env::var("DIAMOND_FUZZ_ONLY").unwrap_or_default();
    let targets: Vec<Target> = targets(&scratch.0).into_iter().filter(|t| t.name.starts_with(&only)).collect();
    let (count, mut cases, mut messages) = (targets.len(), 0, Vec::new());
    for target in targets {
        let (name, budget) = (target.name, budget(&target, count));
        let begun = Instant::now();
        let tally = run(target, seed, budget);
        println!(
            "{name:24} {:7} cases in {:5.1} s, {:6} accepted, {} failures",
            tally.cases,
            begun.elapsed().as_secs_f64(),
            tally.parsed,
            tally.failures.len()
        );
        cases += tally.cases;
        messages.extend(tally.failures.iter().map(|f| keep(name, seed, f)));
    }
    println!("{cases} cases, seed {seed}");
    assert!(messages.is_empty(), "{} failures\n{}", messages.len(), messages.join("\n"));
}

fn named(targets: Vec<Target>, name: &str) -> Target {
    targets.into_iter().find(|t| t.name == name).unwrap_or_else(|| panic!("there is no target {name}"))
}

#[test]
fn a_few_cases_of_every_reader() {
    fuzz(SHORT_SEED, |target, _| Budget::Cases(target.cases));
}

#[test]
#[ignore = "long: DIAMOND_FUZZ_SECONDS (240) over all readers"]
fn minutes_of_every_reader() {
    let clock = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0, |t| t.as_nanos() as u64);
    let seed = variable("DIAMOND_FUZZ_SEED").unwrap_or(clock);
    let seconds = variable("DIAMOND_FUZZ_SECONDS").unwrap_or(LONG_SECONDS);
    fuzz(seed, |_, count| Budget::Time(Duration::from_secs(seconds) / count.max(1) as u32));
}

/// Replays one kept input: `DIAMOND_FUZZ_REPLAY=target/fuzz-failures/….bin`.
#[test]
fn replay() {
    let Ok(path) = std::env::var("DIAMOND_FUZZ_REPLAY") else { return };
    let path = PathBuf::from(path);
    let input = std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let name = file.split('.').next().unwrap_or_default();
    let scratch = Scratch::new();
    match (named(targets(&scratch.0), name).check)(&input) {
        Ok(Answer::Parsed) => println!("{name}: accepted, and obeys the laws"),
        Ok(Answer::Refused(message)) => println!("{name}: refused: {message}"),
        Err(what) => panic!("{name}: {what}"),
    }
}

/// Inputs that once went wrong: `assets/fixtures/fuzz/TARGET.WHAT.bin`.
#[test]
fn inputs_that_once_went_wrong() {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../assets/fixtures/fuzz");
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder).into_iter().flatten().map(|e| e.unwrap().path()).collect();
    files.retain(|f| f.extension().is_some_and(|e| e == "bin"));
    files.sort();
    let scratch = Scratch::new();
    let mut targets = targets(&scratch.0);
    let mut failures = Vec::new();
    while let Some(target) = targets.pop() {
        let own = format!("{}.", target.name);
        let inputs: Vec<&PathBuf> =
            files.iter().filter(|f| f.file_name().is_some_and(|n| n.to_string_lossy().starts_with(&own))).collect();
        if inputs.is_empty() {
            continue;
        }
        let seeds = inputs.iter().map(|file| std::fs::read(file).unwrap()).collect();
        let tally = run(Target { wrap: |bytes, _| bytes, seeds, ..target }, 0, Budget::Cases(0));
        // They need not be accepted.
        let wrong = |f: &&Failure| !f.what.starts_with("refuses a good file");
        let message = |f: &Failure| format!("{}: {}", inputs[f.case as usize].display(), f.what);
        failures.extend(tally.failures.iter().filter(wrong).map(message));
    }
    assert!(failures.is_empty(), "\n{}", failures.join("\n"));
}

/// The harness notices what it is there for: planted readers with one fault each.
#[test]
fn planted_faults_are_noticed() {
    static NOTICED: AtomicBool = AtomicBool::new(false);
    let seeds = || vec![b"count 12\n".to_vec(), b"count 7 of 9\n".to_vec()];
    let number = |bytes: &[u8]| -> Option<u64> {
        String::from_utf8_lossy(bytes).split_whitespace().find_map(|word| word.parse().ok())
    };
    let planted = |name, check: fn(&[u8], u64) -> Result<Answer, String>| -> Tally {
        let target = Target::new(name, seeds(), move |bytes| match number(bytes) {
            None => Answer::refused("no number"),
            Some(n) => check(bytes, n),
        });
        run(target.text(), 5, Budget::Cases(400))
    };
    let said = |tally: &Tally, word: &str| {
        assert!(tally.failures.iter().any(|f| f.what.contains(word)), "{word:?}: {:?}", tally.failures);
    };
    let sound = planted("planted_sound", |_, _| Ok(Answer::Parsed));
    assert!(sound.failures.is_empty() && sound.cases == 400 && (100..400).contains(&sound.parsed), "{sound:?}");
    said(
        &planted("planted_panic", |_, n| if n > 1000 { panic!("planted {n}") } else { Ok(Answer::Parsed) }),
        "planted",
    );
    let greedy = planted("planted_greed", |_, n| {
        let room: Vec<u8> = Vec::with_capacity(n.min(1 << 46) as usize);
        if room.capacity() > 1 << 40 { Answer::refused("never") } else { Ok(Answer::Parsed) }
    });
    said(&greedy, "bytes of memory");
    let slow = planted("planted_loop", |_, n| {
        while n > 1000 && !NOTICED.load(Ordering::SeqCst) {
            std::hint::spin_loop();
        }
        Ok(Answer::Parsed)
    });
    NOTICED.store(true, Ordering::SeqCst);
    said(&slow, "longer than 2 s");
    let lawless = planted("planted_law", |_, n| if n == 0 { Err("zero".into()) } else { Ok(Answer::Parsed) });
    said(&lawless, "zero");
    let verbose = planted("planted_words", |_, n| match n > 1000 {
        true => Answer::refused("w".repeat(5000)),
        false => Ok(Answer::Parsed),
    });
    said(&verbose, "an error message of 5000 bytes");
    let strict = planted("planted_strict", |_, n| if n == 7 { Answer::refused("not 7") } else { Ok(Answer::Parsed) });
    said(&strict, "refuses a good file");
    let failure = &slow.failures[0];
    let message = keep("planted_loop", 5, failure);
    let file = failures_folder().join(format!("planted_loop.{:016x}.{}.bin", 5, failure.case));
    assert!(message.contains("DIAMOND_FUZZ_REPLAY=") && message.contains(file.to_str().unwrap()), "{message}");
    std::fs::remove_file(file).unwrap();
}
