//! Making a run fit a limit: first what is held at once is lowered, then the number of Gaussians.
use super::{AtOnce, Moment, moments};
use diamond_reconstruct::{ByteSize, CaptureFacts, Config, Needs};
use serde::Serialize;
use std::fmt;

/// A plan stays this factor below the limit: what the allocator cannot use again, and what the estimate does not know.
const RESERVE: f64 = 1.12;
/// A run with fewer Gaussians than this (or than it may have anyway) is refused rather than planned.
const LEAST_GAUSSIANS: usize = 1000;

/// What a run takes in memory, and what was lowered for it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MemoryPlan {
    /// What the process may take at its peak, bytes.
    pub limit: Option<u64>,
    /// What it is expected to take at its peak with as many Gaussians as it may have, bytes.
    pub peak: u64,
    /// When that is.
    pub peak_in: &'static str,
    /// The same with as many Gaussians as it begins with.
    pub peak_at_first: u64,
    /// Gaussians that it may have, and begins with at most.
    pub gaussians: (usize, usize),
    /// Gaussians that the configuration asks for, where the limit allows fewer.
    pub gaussians_wanted: Option<usize>,
    /// What is held at once.
    pub at_once: AtOnce,
    /// What was lowered without a change of the result, in words.
    pub lowered: Vec<String>,
    /// All moments, with as many Gaussians as there may be.
    pub moments: Vec<Moment>,
}

/// A limit under which the run cannot be made.
#[derive(Debug, Clone, PartialEq)]
pub struct Refused {
    /// The limit, bytes.
    pub limit: u64,
    /// The smallest limit that would do, bytes.
    pub needed: u64,
    /// Gaussians that this would be for.
    pub gaussians: usize,
    /// What takes most of it.
    pub moment: Moment,
}

/// The capture and the configuration that are planned for.
struct Run<'a> {
    config: &'a Config,
    facts: &'a CaptureFacts,
    needs: &'a Needs,
}

impl Run<'_> {
    fn moments(&self, at_once: &AtOnce, gaussians: usize) -> Vec<Moment> {
        moments(self.config, self.facts, self.needs, at_once, gaussians)
    }

    fn largest(&self, at_once: &AtOnce, gaussians: usize) -> Option<Moment> {
        self.moments(at_once, gaussians).into_iter().max_by_key(Moment::bytes)
    }

    fn peak(&self, at_once: &AtOnce, gaussians: usize) -> u64 {
        self.largest(at_once, gaussians).map_or(0, |m| m.bytes())
    }

    /// `at_once` lowered until the peak is at most `usable`, or nothing is left to lower that would help.
    fn lowered(&self, mut at_once: AtOnce, gaussians: usize, usable: u64) -> AtOnce {
        let mut peak = self.peak(&at_once, gaussians);
        while peak > usable {
            let fewer = |bytes: u64| if bytes > 1 << 20 { bytes / 4 } else { 0 };
            let next = [
                AtOnce { pictures: fewer(at_once.pictures), ..at_once.clone() },
                AtOnce { lights: (at_once.lights / 2).max(1), ..at_once.clone() },
                AtOnce { visibility: fewer(at_once.visibility), ..at_once.clone() },
                AtOnce { decode_in_parallel: false, ..at_once.clone() },
                AtOnce { buffers: fewer(at_once.buffers), ..at_once.clone() },
            ];
            // A notch that does not lower the peak by itself may be followed by one that does.
            let helps = |next: &AtOnce| {
                let mut further = next.clone();
                if next.buffers < at_once.buffers {
                    further.buffers = 0;
                }
                if next.pictures < at_once.pictures {
                    further.pictures = 0;
                }
                if next.lights < at_once.lights {
                    further.lights = 1;
                }
                if next.visibility < at_once.visibility {
                    further.visibility = 0;
                }
                self.peak(&further, gaussians) < peak
            };
            match next.into_iter().find(helps) {
                Some(next) => (peak, at_once) = (self.peak(&next, gaussians), next),
                None => break,
            }
        }
        if peak > usable {
            let all = at_once.photographs.min(self.facts.files as u64 * self.facts.stored_bytes);
            let fits = |photographs: u64| self.peak(&AtOnce { photographs, ..at_once.clone() }, gaussians) <= usable;
            match largest_below(0, all, fits) {
                Some(photographs) => at_once.photographs = photographs,
                None => return AtOnce::least(),
            }
        }
        at_once
    }
}

/// The largest number in `low..=high` that `fits`, if one does; where one fits, all smaller ones do.
fn largest_below(low: u64, high: u64, fits: impl Fn(u64) -> bool) -> Option<u64> {
    if !fits(low) {
        return None;
    }
    let (mut yes, mut no) = (low, high + 1);
    while no - yes > 1 {
        let middle = yes + (no - yes) / 2;
        if fits(middle) { yes = middle } else { no = middle }
    }
    Some(yes)
}

impl MemoryPlan {
    /// Plans a run under `config.memory_limit`. Depends on the configuration and the facts alone.
    pub fn new(config: &Config, facts: &CaptureFacts, needs: &Needs) -> Result<Self, Box<Refused>> {
        let run = Run { config, facts, needs };
        let first = match needs.medium.needed {
            true => config.initial_count().max(config.subsurface.seeds.min(config.density.max_gaussians)),
            false => config.initial_count(),
        };
        let wanted = if needs.density.needed { config.density.max_gaussians.max(first) } else { first };
        let whole = AtOnce::of(config);
        let (mut at_once, mut most) = (whole.clone(), wanted);
        if let Some(ByteSize(limit)) = config.memory_limit {
            let usable = (limit as f64 / RESERVE) as u64;
            let fits = |n: u64| run.peak(&AtOnce::least(), n as usize) <= usable;
            let least = LEAST_GAUSSIANS.min(wanted);
            let Some(n) = largest_below(least as u64, wanted as u64, fits) else {
                let moment = run.largest(&AtOnce::least(), least);
                let moment = moment.unwrap_or(Moment { name: "opening", parts: Vec::new() });
                let needed = (moment.bytes() as f64 * RESERVE / f64::from(1 << 20)).ceil() as u64 + 1;
                return Err(Box::new(Refused { limit, needed: needed << 20, gaussians: least, moment }));
            };
            most = n as usize;
            at_once = run.lowered(at_once, most, usable);
        }
        let all = run.moments(&at_once, most);
        let largest = all.iter().max_by_key(|m| m.bytes());
        Ok(Self {
            limit: config.memory_limit.map(|limit| limit.0),
            peak: largest.map_or(0, Moment::bytes),
            peak_in: largest.map_or("", |m| m.name),
            peak_at_first: run.peak(&at_once, first.min(most)),
            gaussians: (most, first.min(most)),
            gaussians_wanted: (most < wanted).then_some(wanted),
            lowered: differences(&whole, &at_once, facts),
            at_once,
            moments: all,
        })
    }

    /// The configuration with which the run is made: fewer Gaussians at most, where the limit says so.
    pub fn apply(&self, config: &mut Config) {
        if self.gaussians_wanted.is_some() {
            config.density.max_gaussians = self.gaussians.0;
        }
    }
}

fn differences(whole: &AtOnce, at_once: &AtOnce, facts: &CaptureFacts) -> Vec<String> {
    let size = |bytes: u64| ByteSize(bytes).rounded();
    let mut out = Vec::new();
    if at_once.photographs < whole.photographs {
        let all = facts.files as u64 * facts.stored_bytes;
        out.push(match at_once.photographs {
            0 => "photographs are read from their files whenever they are needed".into(),
            bytes => format!("{} of {} of photographs are kept, the rest is read again", size(bytes), size(all)),
        });
    }
    if at_once.buffers < whole.buffers {
        out.push(format!("the rasteriser keeps {} of buffers between pictures", size(at_once.buffers)));
    }
    if at_once.lights < whole.lights {
        out.push(format!("{} of {} lights go through a held-out view together", at_once.lights, whole.lights));
    }
    if at_once.pictures < whole.pictures {
        let together = at_once.pictures_together(facts.pixels());
        out.push(format!("{together} pictures of a held-out view are rendered before they are compared"));
    }
    if at_once.visibility < whole.visibility {
        out.push(format!("{} of visibility are kept for the next held-out view", size(at_once.visibility)));
    }
    if whole.decode_in_parallel && !at_once.decode_in_parallel {
        out.push("photographs are checked one after the other".into());
    }
    out
}

/// The parts of a moment, largest first.
fn by_size(moment: &Moment) -> Vec<String> {
    let mut parts: Vec<_> = moment.parts.iter().collect();
    parts.sort_by_key(|p| std::cmp::Reverse(p.bytes));
    parts.iter().map(|p| format!("{} {}", p.name, ByteSize(p.bytes).rounded())).collect()
}

impl fmt::Display for MemoryPlan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let size = |bytes: u64| ByteSize(bytes).rounded();
        let (most, first) = self.gaussians;
        write!(f, "memory: at most {} with {most} Gaussians", size(self.peak))?;
        if first < most {
            write!(f, ", {} with the first {first}", size(self.peak_at_first))?;
        }
        match self.limit {
            Some(limit) => writeln!(f, "; the limit is {}", size(limit))?,
            None => writeln!(f, "; no limit")?,
        }
        for moment in &self.moments {
            let parts = by_size(moment);
            let mark = if moment.name == self.peak_in { '*' } else { ' ' };
            writeln!(f, "{mark} {:<16} {:>8}: {}", moment.name, size(moment.bytes()), parts.join(", "))?;
        }
        for line in &self.lowered {
            writeln!(f, "  lowered, the result is the same: {line}")?;
        }
        if let Some(wanted) = self.gaussians_wanted {
            writeln!(
                f,
                "  lowered, THE RESULT CHANGES: density.max_gaussians = {most} instead of {wanted}, since more do not fit"
            )?;
        }
        Ok(())
    }
}

impl fmt::Display for Refused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mib = |bytes: u64| format!("{} MiB", bytes >> 20);
        write!(
            f,
            "a memory limit of {} is too small for this run: {} would do, with everything lowered and {} Gaussians; most is \
             needed in `{}`: {}. Raise the limit, reduce the photographs, or select fewer with --views",
            ByteSize(self.limit),
            mib(self.needed),
            self.gaussians,
            self.moment.name,
            by_size(&self.moment).join(", ")
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn case(limit: Option<u64>) -> (Config, CaptureFacts, Needs) {
        let mut config = Config::preset("resolved").unwrap();
        config.memory_limit = limit.map(|mib| ByteSize(mib << 20));
        let facts = CaptureFacts {
            views: 30,
            images: 3000,
            files: 3400,
            lights: 100,
            test_views: 4,
            test_images: 400,
            most_test_lights: 100,
            width: (512, 512),
            height: (512, 512),
            stored_bytes: 512 * 512 * 4,
            looked_at: 8,
            masks: 8,
            content: Some(0.4),
            ..Default::default()
        };
        let needs = Needs::decide(&config, &facts);
        (config, facts, needs)
    }

    fn plan(limit: Option<u64>) -> Result<MemoryPlan, Box<Refused>> {
        let (config, facts, needs) = case(limit);
        MemoryPlan::new(&config, &facts, &needs)
    }

    #[test]
    fn what_fits_stays_as_it_is() {
        let free = plan(None).unwrap();
        let roomy = plan(Some(64 << 10)).unwrap();
        assert_eq!((&roomy.at_once, roomy.gaussians, roomy.peak), (&free.at_once, free.gaussians, free.peak));
        assert!(roomy.lowered.is_empty() && roomy.gaussians_wanted.is_none());
        assert_eq!(free.at_once, AtOnce::of(&Config::preset("resolved").unwrap()));
        assert!(free.peak_at_first < free.peak);
    }

    /// What changes no result goes first; then the Gaussians, fewer under a smaller limit; then a refusal whose advice
    /// holds.
    #[test]
    fn the_result_is_changed_last() {
        let free = plan(None).unwrap();
        let mut seen = (false, false);
        let mut last = usize::MAX;
        for limit in (0..400).rev().map(|k| 16 * (k + 1)) {
            match plan(Some(limit)) {
                Ok(plan) => {
                    assert!(plan.peak as f64 * RESERVE <= (limit << 20) as f64 + 1.0, "{plan}");
                    assert!(plan.gaussians.0 <= last && plan.gaussians.0 >= LEAST_GAUSSIANS);
                    last = plan.gaussians.0;
                    seen.0 |= !plan.lowered.is_empty() && plan.gaussians_wanted.is_none();
                    seen.1 |= plan.gaussians_wanted == Some(free.gaussians.0);
                    let (mut config, ..) = case(Some(limit));
                    plan.apply(&mut config);
                    assert_eq!(config.density.max_gaussians.max(config.initial_count()), plan.gaussians.0);
                }
                Err(refused) => {
                    let (least, text) = (refused.needed >> 20, refused.to_string());
                    assert!(least > limit && text.contains(&format!("{least} MiB")), "{text}");
                    assert!(plan(Some(least)).unwrap().gaussians.0 >= LEAST_GAUSSIANS);
                    assert!(plan(Some(least - 4)).is_err());
                }
            }
        }
        assert_eq!(seen, (true, true));
        assert!(plan(Some(1)).is_err());
    }

    #[test]
    fn the_plan_says_what_was_lowered() {
        let limit = (plan(Some(1)).unwrap_err().needed >> 20) + 4;
        let text = plan(Some(limit)).unwrap().to_string();
        let said = format!("the limit is {limit} MiB");
        for expected in [said.as_str(), "the result is the same", "THE RESULT CHANGES", "photographs", "evaluation"] {
            assert!(text.contains(expected), "{expected} in {text}");
        }
    }
}
