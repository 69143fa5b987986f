//! Signals of the system that would end the program without a word, turned into something that it can answer. Ctrl-C is
//! not here: it exists on every system.
//!
//! SIGHUP is left alone, or `nohup` would no longer keep a run alive.
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// From now on a write beyond the limit on the size of files (`ulimit -f`) fails with "File too large".
#[cfg(unix)]
pub fn file_limit_is_an_error() {
    // What the handler does is of no interest: that there is one keeps the signal from being deadly.
    let met = Arc::new(AtomicBool::new(false));
    if let Err(e) = signal_hook::flag::register(signal_hook::consts::SIGXFSZ, met) {
        tracing::debug!("the limit on the size of files will end the program: {e}");
    }
}

/// From now on SIGTERM, which schedulers send before they kill, sets `interrupted`; a second one exits with code 130.
#[cfg(unix)]
pub fn terminate_interrupts(interrupted: &Arc<AtomicBool>) {
    use signal_hook::{consts::SIGTERM, flag};
    // In this order: the shutdown must find the flag as the signal before has left it.
    let set = flag::register_conditional_shutdown(SIGTERM, 130, Arc::clone(interrupted))
        .and_then(|_| flag::register(SIGTERM, Arc::clone(interrupted)));
    if let Err(e) = set {
        tracing::debug!("SIGTERM will not write a checkpoint: {e}");
    }
}

/// Other systems have no such limit.
#[cfg(not(unix))]
pub fn file_limit_is_an_error() {}

/// Other systems have no such signal.
#[cfg(not(unix))]
pub fn terminate_interrupts(_: &Arc<AtomicBool>) {}
