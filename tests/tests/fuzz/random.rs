//! Random numbers that depend on nothing but what they are asked for.

/// SplitMix64: every state is good, and streams of different names do not meet in practice.
#[derive(Debug, Clone)]
pub struct Random(u64);

impl Random {
    /// The stream of one case of one target.
    pub fn of(seed: u64, target: &str, case: u64) -> Self {
        let mut out = Self(seed);
        for word in target.bytes().map(u64::from).chain([case]) {
            out.0 ^= word.wrapping_mul(0xD6E8_FEB8_6659_FD93);
            out.0 = out.next();
        }
        out
    }

    /// 64 bits.
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// A number below `n`; 0 where `n` is 0.
    pub fn below(&mut self, n: usize) -> usize {
        (self.next() % (n as u64).max(1)) as usize
    }

    /// True once in `n` times.
    pub fn one_in(&mut self, n: usize) -> bool {
        self.below(n) == 0
    }

    /// One of a list.
    pub fn pick<'a, T>(&mut self, of: &'a [T]) -> &'a T {
        &of[self.below(of.len())]
    }
}
