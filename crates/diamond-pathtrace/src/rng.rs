//! Random numbers: one stream for each pixel, so that bits depend neither on threads nor on order.
//!
//! A stream is PCG-32 (O'Neill 2014), its state and its sequence number hashed from a seed and a stream number. Equal
//! arguments give equal numbers on any machine.
//!
//! ```
//! use diamond_pathtrace::Rng;
//! let (mut a, mut b) = (Rng::new(7, 3), Rng::new(7, 3));
//! assert!((0..9).all(|_| a.uniform() == b.uniform()));
//! ```
use crate::sobol::DIMENSIONS;
use rand_pcg::Pcg32;
use rand_pcg::rand_core::Rng as _;

/// 2⁻³².
const UNIT: f32 = 1.0 / 4_294_967_296.0;

/// A stream of random numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct Rng {
    pcg: Pcg32,
    /// Numbers that are drawn first, and how many of them have been.
    lead: [u32; DIMENSIONS],
    led: usize,
}

/// The mixing function of SplitMix64 (Steele, Lea and Flood 2014), a bijection of 64 bits.
pub(crate) fn mix(mut z: u64) -> u64 {
    z = z.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

impl Rng {
    /// Stream `stream` of `seed`. Streams are independent for all practical purposes.
    pub fn new(seed: u64, stream: u64) -> Self {
        let state = mix(seed ^ mix(stream));
        Self { pcg: Pcg32::new(state, mix(state ^ stream)), lead: [0; DIMENSIONS], led: DIMENSIONS }
    }

    /// Makes these the next numbers that [`Rng::bits`] returns; what is left of earlier ones is dropped.
    #[inline]
    pub(crate) fn lead_with(&mut self, numbers: [u32; DIMENSIONS]) {
        (self.lead, self.led) = (numbers, 0);
    }

    /// Goes on with random numbers.
    #[inline]
    pub(crate) fn drop_lead(&mut self) {
        self.led = DIMENSIONS;
    }

    /// 32 random bits.
    #[inline]
    pub fn bits(&mut self) -> u32 {
        if let Some(number) = self.lead.get(self.led) {
            self.led += 1;
            return *number;
        }
        self.pcg.next_u32()
    }

    /// Uniform in [0, 1), a multiple of 2⁻²⁴.
    #[inline]
    pub fn uniform(&mut self) -> f32 {
        (self.bits() >> 8) as f32 * (1.0 / 16_777_216.0)
    }

    /// Uniform in (0, 1]: never below 2⁻³³, and fine near 0, as logarithms want it.
    #[inline]
    pub fn positive(&mut self) -> f32 {
        (self.bits() as f32 + 0.5) * UNIT
    }

    /// Exponentially distributed with mean 1, above 0 and at most 22.9, which cuts off 10⁻¹⁰ of the distribution.
    #[inline]
    pub fn exponential(&mut self) -> f32 {
        (-self.positive().ln()).max(f32::MIN_POSITIVE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_stay_in_their_ranges_and_have_the_right_moments() {
        let mut rng = Rng::new(1, 2);
        let n = 200_000;
        let (mut sum, mut square, mut exponential) = (0.0f64, 0.0f64, 0.0f64);
        for _ in 0..n {
            let (u, p, e) = (rng.uniform(), rng.positive(), rng.exponential());
            assert!((0.0..1.0).contains(&u) && p > 0.0 && p <= 1.0 && (0.0..23.0).contains(&e));
            sum += f64::from(u);
            square += f64::from(u) * f64::from(u);
            exponential += f64::from(e);
        }
        let n = f64::from(n);
        assert!((sum / n - 0.5).abs() < 4.0 * (1.0 / 12.0 / n).sqrt());
        assert!((square / n - 1.0 / 3.0).abs() < 4.0 * (4.0 / 45.0 / n).sqrt());
        assert!((exponential / n - 1.0).abs() < 4.0 * (1.0 / n).sqrt());
    }

    #[test]
    fn neighbouring_streams_and_seeds_are_uncorrelated() {
        for (a, b) in [((0, 0), (0, 1)), ((0, 0), (1, 0)), ((5, 5), (6, 6))] {
            let (mut a, mut b) = (Rng::new(a.0, a.1), Rng::new(b.0, b.1));
            let n = 50_000;
            let sum: f64 = (0..n).map(|_| f64::from((a.uniform() - 0.5) * (b.uniform() - 0.5))).sum();
            assert!((sum / f64::from(n)).abs() < 4.0 / 12.0 / f64::from(n).sqrt());
        }
    }
}
