//! What a person sees while waiting: a bar on a terminal, a line every few seconds elsewhere.
use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;
use std::time::{Duration, Instant};

/// Without a terminal, a line is printed no more often than this.
const QUIET: Duration = Duration::from_secs(5);

/// Progress toward a known number.
pub struct Counter {
    what: &'static str,
    bar: Option<ProgressBar>,
    begun: Instant,
    said: Instant,
    first: Option<u64>,
}

impl Counter {
    /// Nothing done yet.
    pub fn new(what: &'static str) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(0);
            if let Ok(style) =
                ProgressStyle::with_template("{prefix} {bar:30} {pos}/{len}  {elapsed} (left {eta})  {msg}")
            {
                bar.set_style(style);
            }
            bar.set_prefix(what);
            bar
        });
        let now = Instant::now();
        Self { what, bar, begun: now, said: now, first: None }
    }

    /// `done` of `all` are done.
    pub fn show(&mut self, done: usize, all: usize) {
        self.show_with(done as u64, all as u64, String::new);
    }

    /// `done` of `all` are done; `message` is asked only when something is printed.
    pub fn show_with(&mut self, done: u64, all: u64, message: impl FnOnce() -> String) {
        let first = *self.first.get_or_insert(done.saturating_sub(1));
        match &self.bar {
            Some(bar) => {
                if bar.length() != Some(all) {
                    bar.set_length(all);
                    bar.reset_eta();
                }
                bar.set_position(done);
                bar.set_message(message());
            }
            None if self.said.elapsed() >= QUIET || done == all => {
                self.said = Instant::now();
                let elapsed = self.begun.elapsed().as_secs_f64();
                let left = elapsed / (done - first).max(1) as f64 * (all - done) as f64;
                super::complain(&format!(
                    "{} {done}/{all}  {elapsed:.0} s (left {left:.0} s)  {}",
                    self.what,
                    message()
                ));
            }
            None => {}
        }
    }

    /// A line beside the bar.
    pub fn say(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| tracing::info!("{text}")),
            None => tracing::info!("{text}"),
        }
    }

    /// Removes the bar.
    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
