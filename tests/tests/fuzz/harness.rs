//! A target, its cases, and what is asked of each: an answer in time, within memory, without a panic, that obeys the
//! target's laws.
use super::allocation::{unwatch, watch};
use super::mutate::mutate;
use super::random::Random;
use std::cell::RefCell;
use std::path::PathBuf;
use std::sync::Once;
use std::sync::atomic::{AtomicIsize, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

/// What a reader made of an input.
pub enum Answer {
    /// An error with this message.
    Refused(String),
    /// A value, which obeyed the laws.
    Parsed,
}

impl Answer {
    /// The refusal by an error.
    pub fn refused(error: impl std::fmt::Display) -> Result<Answer, String> {
        Ok(Answer::Refused(error.to_string()))
    }
}

/// Reads bytes and tests what comes out; `Err` says which law was broken.
pub type Check = Box<dyn Fn(&[u8]) -> Result<Answer, String> + Send + Sync>;
/// From the mutated content to the file: compression, checksums.
pub type Wrap = fn(Vec<u8>, &mut Random) -> Vec<u8>;

/// One reader.
pub struct Target {
    /// Its name, without dots.
    pub name: &'static str,
    /// Files that it must accept, before wrapping.
    pub seeds: Vec<Vec<u8>>,
    /// Whether its files are text.
    pub text: bool,
    /// From content to file.
    pub wrap: Wrap,
    /// The reader and its laws.
    pub check: Check,
    /// Most bytes held at once, from the length of the input.
    pub memory: fn(usize) -> usize,
    /// Cases of the short run.
    pub cases: u64,
}

impl Target {
    /// A target with the usual limit of memory and 300 cases.
    pub fn new(
        name: &'static str,
        seeds: Vec<Vec<u8>>,
        check: impl Fn(&[u8]) -> Result<Answer, String> + Send + Sync + 'static,
    ) -> Self {
        let memory = |length: usize| 64 * length + (64 << 20);
        Self { name, seeds, text: false, wrap: |bytes, _| bytes, check: Box::new(check), memory, cases: 300 }
    }

    /// Of text files.
    pub fn text(self) -> Self {
        Self { text: true, ..self }
    }

    /// The input of a case: first the seeds as they are, then mutations.
    pub fn input(&self, seed: u64, case: u64) -> Vec<u8> {
        let mut random = Random::of(seed, self.name, case);
        let at = case as usize;
        let mut content = self.seeds[if at < self.seeds.len() { at } else { random.below(self.seeds.len()) }].clone();
        if at >= self.seeds.len() {
            let other = random.pick(&self.seeds).clone();
            mutate(&mut random, &mut content, &other, self.text);
        }
        (self.wrap)(content, &mut random)
    }
}

/// How long to go on.
#[derive(Debug, Clone, Copy)]
pub enum Budget {
    /// So many cases.
    Cases(u64),
    /// So much time.
    Time(Duration),
}

/// A case that went wrong.
#[derive(Debug, Clone)]
pub struct Failure {
    /// Number of the case.
    pub case: u64,
    /// What went wrong.
    pub what: String,
    /// The file that it went wrong with.
    pub input: Vec<u8>,
}

/// What came of a run.
#[derive(Debug, Default)]
pub struct Tally {
    /// Cases.
    pub cases: u64,
    /// Cases in which the reader gave a value.
    pub parsed: u64,
    /// Cases that went wrong, of different kinds.
    pub failures: Vec<Failure>,
}

/// A case may take so much processor time.
const TIME: Duration = Duration::from_secs(2);
/// Where processor time is not known, so much time by the clock.
const CLOCK: Duration = Duration::from_secs(20);
/// An error message is read by a person.
const LONGEST_MESSAGE: usize = 4096;
/// A target that failed so often is not tried further.
const ENOUGH: usize = 4;

thread_local! {
    /// The last panic of this thread, where it is watched.
    static PANIC: RefCell<Option<Option<String>>> = const { RefCell::new(None) };
}

/// Keeps the panics of watched threads to themselves; others are reported as before.
fn listen_to_panics() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            let kept = PANIC.with(|p| p.borrow_mut().as_mut().map(|last| *last = Some(info.to_string())).is_some());
            if !kept {
                before(info);
            }
        }));
    });
}

/// Tries one input on this thread.
fn try_input(target: &Target, input: &[u8], exceeded: &'static AtomicIsize) -> Result<Answer, String> {
    PANIC.with(|p| *p.borrow_mut() = Some(None));
    watch((target.memory)(input.len()), exceeded);
    let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| (target.check)(input)));
    unwatch();
    let panic = PANIC.with(|p| p.borrow_mut().take()).flatten();
    match result {
        Err(_) => Err(format!("panic: {}", panic.unwrap_or_default().replace('\n', " "))),
        Ok(Ok(Answer::Refused(message))) if message.len() > LONGEST_MESSAGE => Err(format!(
            "an error message of {} bytes: {}…",
            message.len(),
            message.chars().take(200).collect::<String>()
        )),
        Ok(Ok(Answer::Refused(message))) if message.trim().is_empty() => Err("an error without a message".into()),
        Ok(answer) => answer,
    }
}

/// What the worker and who watches it both see.
#[derive(Default)]
struct Board {
    /// The case under way, plus one; 0 between cases.
    case: AtomicU64,
    /// The worker's number in the system; 0 where it is not known.
    thread: AtomicU64,
    exceeded: AtomicIsize,
}

/// What came of a case.
struct Report {
    parsed: bool,
    failure: Option<Failure>,
}

/// Runs a target on a thread of its own and watches it.
pub fn run(target: Target, seed: u64, budget: Budget) -> Tally {
    listen_to_panics();
    let target: &'static Target = Box::leak(Box::new(target));
    let board: &'static Board = Box::leak(Box::default());
    let (to, from) = channel();
    std::thread::Builder::new()
        .name(format!("fuzz {}", target.name))
        .spawn(move || work(target, seed, budget, board, &to))
        .expect("a thread");
    let mut tally = Tally::default();
    let mut seen: Option<(u64, Instant, Option<Duration>)> = None;
    loop {
        match next(&from) {
            Ok(Report { parsed, failure }) => {
                tally.cases += 1;
                tally.parsed += u64::from(parsed);
                if let Some(failure) = failure {
                    let kind = |f: &Failure| f.what.chars().take(60).collect::<String>();
                    if !tally.failures.iter().any(|known| kind(known) == kind(&failure)) {
                        tally.failures.push(failure);
                    }
                    if tally.failures.len() >= ENOUGH {
                        return tally;
                    }
                }
            }
            Err(RecvTimeoutError::Disconnected) => return tally,
            Err(RecvTimeoutError::Timeout) => {
                let Some(case) = board.case.load(Ordering::SeqCst).checked_sub(1) else { continue };
                let held = board.exceeded.load(Ordering::SeqCst);
                if held > 0 {
                    let input = target.input(seed, case);
                    let what = format!("asked for {held} bytes of memory to read {}", input.len());
                    tally.failures.push(Failure { case, what, input });
                    return tally;
                }
                let spent = processor_time(board.thread.load(Ordering::SeqCst));
                match seen {
                    Some((then, begun, before)) if then == case => {
                        let too_long = match (before, spent) {
                            (Some(before), Some(spent)) => spent.saturating_sub(before) > TIME,
                            _ => begun.elapsed() > CLOCK,
                        };
                        if too_long {
                            let (what, input) = ("took longer than 2 s".into(), target.input(seed, case));
                            tally.failures.push(Failure { case, what, input });
                            return tally;
                        }
                    }
                    _ => seen = Some((case, Instant::now(), spent)),
                }
            }
        }
    }
}

fn next(from: &Receiver<Report>) -> Result<Report, RecvTimeoutError> {
    from.recv_timeout(Duration::from_millis(100))
}

fn work(target: &Target, seed: u64, budget: Budget, board: &'static Board, to: &Sender<Report>) {
    board.thread.store(own_number().unwrap_or(0), Ordering::SeqCst);
    let begun = Instant::now();
    for case in 0.. {
        let more = case < target.seeds.len() as u64
            || match budget {
                Budget::Cases(n) => case < n,
                Budget::Time(time) => begun.elapsed() < time,
            };
        if !more {
            return;
        }
        let input = target.input(seed, case);
        board.case.store(case + 1, Ordering::SeqCst);
        let answer = try_input(target, &input, &board.exceeded);
        board.case.store(0, Ordering::SeqCst);
        let (parsed, failure) = match answer {
            Ok(Answer::Parsed) => (true, None),
            Ok(Answer::Refused(message)) if case < target.seeds.len() as u64 => {
                (false, Some(format!("refuses a good file: {message}")))
            }
            Ok(Answer::Refused(_)) => (false, None),
            Err(what) => (false, Some(what)),
        };
        let failure = failure.map(|what| Failure { case, what, input });
        if to.send(Report { parsed, failure }).is_err() {
            return;
        }
    }
}

/// The calling thread's number, where the system tells it.
fn own_number() -> Option<u64> {
    let link = std::fs::read_link("/proc/thread-self").ok()?;
    link.file_name()?.to_str()?.parse().ok()
}

/// Processor time of a thread of this process, where the system tells it.
fn processor_time(thread: u64) -> Option<Duration> {
    let text = std::fs::read_to_string(format!("/proc/self/task/{thread}/schedstat")).ok()?;
    text.split(' ').next()?.parse().ok().map(Duration::from_nanos)
}

/// Where inputs that went wrong are kept.
pub fn failures_folder() -> PathBuf {
    let tmp = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
    tmp.parent().map_or(tmp.clone(), |target| target.join("fuzz-failures"))
}

/// Keeps the input of a failure and says how to see it again.
pub fn keep(name: &str, seed: u64, failure: &Failure) -> String {
    let folder = failures_folder();
    let path = folder.join(format!("{name}.{seed:016x}.{}.bin", failure.case));
    let written = std::fs::create_dir_all(&folder).and_then(|()| std::fs::write(&path, &failure.input));
    let at = match written {
        Ok(()) => path.display().to_string(),
        Err(e) => format!("{} (not written: {e})", path.display()),
    };
    format!(
        "{name}: {}\n  again: DIAMOND_FUZZ_REPLAY={at} cargo test -p diamond-tests --test root fuzz::replay -- \
         --nocapture\n  (seed {seed}, case {})",
        failure.what, failure.case
    )
}
