//! The order in which (view, light) pairs are visited: every pair once per epoch, shuffled by the seed.
use crate::random::{Purpose, Random};

/// Visits `count` pairs in a seeded order that depends on the position alone, so that a resumed run continues it.
#[derive(Debug, Clone)]
pub struct PairOrder {
    seed: u64,
    purpose: Purpose,
    count: usize,
    epoch: u64,
    order: Vec<u32>,
}

impl PairOrder {
    /// An order over `count` pairs (at least 1).
    pub fn new(seed: u64, count: usize) -> Self {
        Self::of(seed, Purpose::Pairs, count)
    }

    /// An order of its own for another purpose.
    pub fn of(seed: u64, purpose: Purpose, count: usize) -> Self {
        let mut order = Self { seed, purpose, count: count.max(1), epoch: 0, order: Vec::new() };
        order.shuffle(0);
        order
    }

    fn shuffle(&mut self, epoch: u64) {
        self.epoch = epoch;
        self.order = Random::new(self.seed, self.purpose, epoch).permutation(self.count);
    }

    /// The pair at a position in the endless sequence (position = step × accumulate + index in the batch).
    pub fn at(&mut self, position: u64) -> usize {
        let epoch = position / self.count as u64;
        if epoch != self.epoch {
            self.shuffle(epoch);
        }
        self.order[(position % self.count as u64) as usize] as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pair_once_per_epoch_whatever_the_start() {
        let mut order = PairOrder::new(5, 7);
        let first: Vec<usize> = (0..21).map(|p| order.at(p)).collect();
        for epoch in first.chunks(7) {
            let mut sorted = epoch.to_vec();
            sorted.sort_unstable();
            assert_eq!(sorted, (0..7).collect::<Vec<usize>>());
        }
        assert_ne!(first[..7], first[7..14]);
        let mut resumed = PairOrder::new(5, 7);
        assert_eq!((10..21).map(|p| resumed.at(p)).collect::<Vec<usize>>(), first[10..]);
        assert_eq!(PairOrder::new(1, 0).at(3), 0);
    }
}
