//! How much work a run did, and how much it would have been without leaving anything out: plain sums, kept beside the
//! seconds of [`crate::Profile`].

/// Named sums, in order of first appearance.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Counters {
    sums: Vec<(&'static str, u64)>,
}

impl Counters {
    /// Adds `n` to the sum `name`.
    pub fn add(&mut self, name: &'static str, n: usize) {
        match self.sums.iter_mut().find(|(known, _)| *known == name) {
            Some((_, sum)) => *sum += n as u64,
            None => self.sums.push((name, n as u64)),
        }
    }

    /// The sum `name`; 0 if nothing was added.
    pub fn get(&self, name: &str) -> u64 {
        self.sums.iter().find(|(known, _)| *known == name).map_or(0, |(_, sum)| *sum)
    }

    /// All sums.
    pub fn all(&self) -> &[(&'static str, u64)] {
        &self.sums
    }
}
