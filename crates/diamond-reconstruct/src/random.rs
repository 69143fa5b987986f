//! Seeded random numbers: one independent ChaCha8 stream per (seed, purpose, step), so that a resumed run draws what an
//! uninterrupted one would have drawn without any generator state in the checkpoint.
use glam::{Quat, Vec3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// What a stream of random numbers is for; streams of different purposes are independent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u64)]
pub enum Purpose {
    /// First positions and normals.
    Initial = 1,
    /// First weights of the networks.
    Network = 2,
    /// Order of the (view, light) pairs.
    Pairs = 3,
    /// Offsets of split Gaussians.
    Split = 4,
    /// Gaussians on which SH visibility is compared.
    VisibilitySamples = 5,
    /// Who is relocated where.
    Relocation = 6,
    /// Noise on the means.
    Noise = 7,
    /// Which other view a view is compared with, and at which pixels.
    Consistency = 8,
    /// Where and how the residual is asked to be nothing.
    ResidualPull = 9,
    /// Order of the pictures that nobody took.
    Made = 10,
}

/// A seeded stream of random numbers.
pub struct Random(ChaCha8Rng);

impl Random {
    /// The stream for `purpose` at `step` under `seed`.
    pub fn new(seed: u64, purpose: Purpose, step: u64) -> Self {
        let mut key = [0u8; 32];
        key[..8].copy_from_slice(&seed.to_le_bytes());
        key[8..16].copy_from_slice(&(purpose as u64).to_le_bytes());
        key[16..24].copy_from_slice(&step.to_le_bytes());
        Self(ChaCha8Rng::from_seed(key))
    }

    /// Uniform in [0, 1), 24 bits.
    pub fn uniform(&mut self) -> f32 {
        (self.0.next_u32() >> 8) as f32 * (1.0 / (1 << 24) as f32)
    }

    /// Uniform in [0, 1), 53 bits.
    pub fn uniform64(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Uniform in 0..n (n > 0; the bias of the multiplication is below n / 2⁶⁴).
    pub fn below(&mut self, n: usize) -> usize {
        ((self.0.next_u64() as u128 * n as u128) >> 64) as usize
    }

    /// Standard normal (Box–Muller).
    pub fn normal(&mut self) -> f32 {
        let radius = (-2.0 * libm::logf(1.0 - self.uniform())).sqrt();
        radius * libm::cosf(std::f32::consts::TAU * self.uniform())
    }

    /// Three independent standard normals.
    pub fn normal3(&mut self) -> Vec3 {
        Vec3::new(self.normal(), self.normal(), self.normal())
    }

    /// Uniform on the unit sphere.
    pub fn direction(&mut self) -> Vec3 {
        let z = 1.0 - 2.0 * self.uniform();
        let phi = std::f32::consts::TAU * self.uniform();
        let r = (1.0 - z * z).max(0.0).sqrt();
        Vec3::new(r * libm::cosf(phi), r * libm::sinf(phi), z)
    }

    /// A rotation that takes +z to `axis` (unit), with a random spin about it.
    pub fn rotation_with_axis(&mut self, axis: Vec3) -> Quat {
        let (sin, cos) = libm::sincosf(std::f32::consts::PI * self.uniform());
        Quat::from_rotation_arc(Vec3::Z, axis) * Quat::from_xyzw(0.0, 0.0, sin, cos)
    }

    /// A random order of 0..n (Fisher–Yates).
    pub fn permutation(&mut self, n: usize) -> Vec<u32> {
        let mut order: Vec<u32> = (0..n as u32).collect();
        for i in (1..n).rev() {
            order.swap(i, self.below(i + 1));
        }
        order
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_repeat_and_differ() {
        let draw = |seed, purpose, step| Random::new(seed, purpose, step).uniform();
        assert_eq!(draw(1, Purpose::Pairs, 2), draw(1, Purpose::Pairs, 2));
        assert_ne!(draw(1, Purpose::Pairs, 2), draw(1, Purpose::Pairs, 3));
        assert_ne!(draw(1, Purpose::Pairs, 2), draw(1, Purpose::Split, 2));
        assert_ne!(draw(1, Purpose::Pairs, 2), draw(2, Purpose::Pairs, 2));
    }

    #[test]
    fn moments_and_permutation() {
        let mut random = Random::new(7, Purpose::Initial, 0);
        let n = 20_000;
        let (mut mean, mut square) = (0.0, 0.0);
        for _ in 0..n {
            let x = random.normal() as f64;
            mean += x / n as f64;
            square += x * x / n as f64;
        }
        assert!(mean.abs() < 0.03 && (square - 1.0).abs() < 0.05, "mean {mean}, variance {square}");
        let mut order = random.permutation(100);
        assert_ne!(order, (0..100).collect::<Vec<u32>>());
        order.sort_unstable();
        assert_eq!(order, (0..100).collect::<Vec<u32>>());
    }
}
