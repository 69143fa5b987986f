//! Gradient noise (Perlin 2002): smooth, without a period, the same on every machine.
use crate::rng::mix;
use glam::Vec3;

/// The slope at a corner of the lattice: one of twelve directions, by hash.
fn slope(x: i32, y: i32, z: i32, seed: u64) -> Vec3 {
    let lattice = (x as u32 as u64) | ((y as u32 as u64) << 32);
    let hash = mix(mix(lattice ^ seed) ^ (z as u32 as u64));
    let s = |bit: u32| if hash >> bit & 1 == 0 { 1.0 } else { -1.0 };
    match (hash >> 8) % 3 {
        0 => Vec3::new(s(0), s(1), 0.0),
        1 => Vec3::new(0.0, s(0), s(1)),
        _ => Vec3::new(s(1), 0.0, s(0)),
    }
}

/// Noise of unit frequency in about [−1, 1], twice continuously differentiable, zero at lattice points.
pub(crate) fn gradient_noise(p: Vec3, seed: u64) -> f32 {
    let p = p.clamp(Vec3::splat(-1e6), Vec3::splat(1e6));
    let base = p.floor();
    let f = p - base;
    let fade = f * f * f * (f * (f * 6.0 - 15.0) + 10.0);
    let [x, y, z] = base.to_array().map(|v| v as i32);
    let corner =
        |i: i32, j: i32, k: i32| slope(x + i, y + j, z + k, seed).dot(f - Vec3::new(i as f32, j as f32, k as f32));
    let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let row = |j: i32, k: i32| lerp(corner(0, j, k), corner(1, j, k), fade.x);
    let plane = |k: i32| lerp(row(0, k), row(1, k), fade.y);
    lerp(plane(0), plane(1), fade.z)
}

/// A sum of octaves, each twice as fine and half as high, in [−1, 1].
pub(crate) fn fractal_noise(p: Vec3, octaves: u32, seed: u64) -> f32 {
    let (mut sum, mut weight, mut total, mut frequency) = (0.0, 1.0, 0.0, 1.0);
    for octave in 0..octaves.clamp(1, 8) {
        sum += weight * gradient_noise(p * frequency, seed.wrapping_add(u64::from(octave)));
        total += weight;
        weight *= 0.5;
        frequency *= 2.0;
    }
    (sum / total).clamp(-1.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Rng;

    #[test]
    fn noise_is_continuous_bounded_and_moves() {
        let mut rng = Rng::new(1, 1);
        let (mut sum, mut square) = (0.0, 0.0);
        for _ in 0..20_000 {
            let p = Vec3::new(rng.uniform(), rng.uniform(), rng.uniform()) * 40.0 - 20.0;
            let (a, b) = (fractal_noise(p, 3, 5), fractal_noise(p + 1e-4, 3, 5));
            assert!(a.abs() <= 1.0 && (a - b).abs() < 2e-3);
            sum += a;
            square += a * a;
        }
        assert!((sum / 20_000.0).abs() < 0.02 && square / 20_000.0 > 0.02);
        assert_eq!(gradient_noise(Vec3::new(3.0, -2.0, 7.0), 9), 0.0);
        assert!(gradient_noise(Vec3::splat(0.4), 1) != gradient_noise(Vec3::splat(0.4), 2));
    }
}
