//! Seeded random tensors: one ChaCha8 stream per (seed, name, index).
//!
//! Candle's own generator cannot be seeded on the CPU. Here a draw depends on seed, name and index alone: not on what was drawn
//! before, so a resumed run draws what the uninterrupted one would have drawn.
use crate::error::Result;
use candle_core::{DType, Device, Shape, Tensor};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// Primes of the 64-bit FNV-1a hash, which turns a name into a part of the key.
const FNV: (u64, u64) = (0xcbf2_9ce4_8422_2325, 0x0000_0100_0000_01b3);

/// A seeded stream of random numbers.
///
/// ```
/// use candle_core::Device;
/// use diamond_diffusion::Noise;
/// let a = Noise::new(3, "start", 0).normal_tensor((2, 4), &Device::Cpu)?;
/// let b = Noise::new(3, "start", 0).normal_tensor((2, 4), &Device::Cpu)?;
/// assert_eq!(a.to_vec2::<f32>()?, b.to_vec2::<f32>()?);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Noise(ChaCha8Rng);

impl Noise {
    /// The stream `name` at `index` under `seed`.
    pub fn new(seed: u64, name: &str, index: u64) -> Self {
        let hash = name.bytes().fold(FNV.0, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(FNV.1));
        let mut key = [0u8; 32];
        key[..8].copy_from_slice(&seed.to_le_bytes());
        key[8..16].copy_from_slice(&hash.to_le_bytes());
        key[16..24].copy_from_slice(&index.to_le_bytes());
        key[24..].copy_from_slice(&(name.len() as u64).to_le_bytes());
        Self(ChaCha8Rng::from_seed(key))
    }

    /// Uniform in [0, 1), 24 bits.
    pub fn uniform(&mut self) -> f32 {
        (self.0.next_u32() >> 8) as f32 * (1.0 / (1 << 24) as f32)
    }

    /// Uniform in 0..n (n > 0).
    pub fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.0.next_u64()) * n as u128) >> 64) as usize
    }

    /// Standard normal (Box–Muller).
    pub fn normal(&mut self) -> f32 {
        let radius = (-2.0 * libm::logf(1.0 - self.uniform())).sqrt();
        radius * libm::cosf(std::f32::consts::TAU * self.uniform())
    }

    /// A tensor of standard normals, `f32`, row-major.
    pub fn normal_tensor(&mut self, shape: impl Into<Shape>, device: &Device) -> Result<Tensor> {
        let shape = shape.into();
        let values: Vec<f32> = (0..shape.elem_count()).map(|_| self.normal()).collect();
        Ok(Tensor::from_vec(values, shape, device)?)
    }

    /// A tensor uniform in [−bound, bound) of a given type.
    pub fn uniform_tensor(&mut self, shape: impl Into<Shape>, bound: f32, dtype: DType) -> Result<Tensor> {
        let shape = shape.into();
        let values: Vec<f32> = (0..shape.elem_count()).map(|_| bound * (2.0 * self.uniform() - 1.0)).collect();
        Ok(Tensor::from_vec(values, shape, &Device::Cpu)?.to_dtype(dtype)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_repeat_differ_and_have_the_moments_of_a_normal() {
        let first = |seed, name, index| Noise::new(seed, name, index).uniform();
        assert_eq!(first(1, "a", 2), first(1, "a", 2));
        for other in [first(2, "a", 2), first(1, "b", 2), first(1, "a", 3)] {
            assert_ne!(first(1, "a", 2), other);
        }
        let draws = Noise::new(5, "moments", 0).normal_tensor(20_000, &Device::Cpu).unwrap().to_vec1::<f32>().unwrap();
        let mean = draws.iter().sum::<f32>() / 20_000.0;
        let variance = draws.iter().map(|x| x * x).sum::<f32>() / 20_000.0 - mean * mean;
        assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.05, "mean {mean}, variance {variance}");
    }
}
