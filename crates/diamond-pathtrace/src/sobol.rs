//! Points that fill the unit cube evenly: Sobol's sequence (1967) with the direction numbers of Joe and Kuo (2008), shifted at random.
//!
//! The first numbers that a path draws decide most of what it brings: where in the pixel, how deep, whereto. Taken from such points,
//! a pixel's paths cover these choices evenly. Every bit of a coordinate is flipped or not at random (a digital shift), so each single point is
//! uniform and an average over points has no bias; sets with different shifts are independent.

/// Coordinates of a point.
pub(crate) const DIMENSIONS: usize = 8;

/// Degree, coefficients and first direction numbers of the primitive polynomial of each coordinate but the first.
const POLYNOMIALS: [(usize, u32, [u32; 5]); DIMENSIONS - 1] = [
    (1, 0, [1, 0, 0, 0, 0]),
    (2, 1, [1, 3, 0, 0, 0]),
    (3, 1, [1, 3, 1, 0, 0]),
    (3, 2, [1, 1, 1, 0, 0]),
    (4, 1, [1, 1, 3, 3, 0]),
    (4, 4, [1, 3, 5, 13, 0]),
    (5, 2, [1, 1, 5, 5, 17]),
];

/// For each bit of the index, the numbers that it adds to the coordinates.
const DIRECTIONS: [[u32; DIMENSIONS]; 32] = directions();

const fn directions() -> [[u32; DIMENSIONS]; 32] {
    let mut v = [[0u32; DIMENSIONS]; 32];
    let mut bit = 0;
    while bit < 32 {
        v[bit][0] = 1 << (31 - bit);
        bit += 1;
    }
    let mut d = 1;
    while d < DIMENSIONS {
        let (degree, coefficients, first) = POLYNOMIALS[d - 1];
        let mut i = 0;
        while i < 32 {
            if i < degree {
                v[i][d] = first[i] << (31 - i);
            } else {
                let mut x = v[i - degree][d] ^ (v[i - degree][d] >> degree);
                let mut k = 1;
                while k < degree {
                    if (coefficients >> (degree - 1 - k)) & 1 == 1 {
                        x ^= v[i - k][d];
                    }
                    k += 1;
                }
                v[i][d] = x;
            }
            i += 1;
        }
        d += 1;
    }
    v
}

/// The points, one after the other, in the order of a Gray code.
#[derive(Debug, Clone)]
pub(crate) struct Sobol {
    next: [u32; DIMENSIONS],
    index: u32,
}

impl Sobol {
    /// Starts at the first point.
    pub fn new(shift: [u32; DIMENSIONS]) -> Self {
        Self { next: shift, index: 0 }
    }

    /// The next point, in units of 2⁻³².
    /// `[eq:sobol]`
    #[inline]
    pub fn draw(&mut self) -> [u32; DIMENSIONS] {
        let point = self.next;
        self.index = self.index.wrapping_add(1);
        let row = &DIRECTIONS[self.index.trailing_zeros() as usize & 31];
        for d in 0..DIMENSIONS {
            self.next[d] ^= row[d];
        }
        point
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Rng;

    /// `[eq:sobol]`: 2ᵏ points put one into each of 2ᵏ intervals of every coordinate; the first two put one into each elementary box;
    /// shifts change nothing of that.
    #[test]
    fn points_are_evenly_spread() {
        let mut rng = Rng::new(3, 3);
        for k in 1..=10 {
            let n = 1usize << k;
            let mut sobol = Sobol::new(std::array::from_fn(|_| rng.bits()));
            let points: Vec<_> = (0..n).map(|_| sobol.draw()).collect();
            for d in 0..DIMENSIONS {
                let mut seen = vec![false; n];
                points.iter().for_each(|p| seen[(p[d] >> (32 - k)) as usize] = true);
                assert!(seen.iter().all(|s| *s), "{n} points, coordinate {d}");
            }
            for a in 1..k {
                let mut seen = vec![false; n];
                points.iter().for_each(|p| {
                    seen[((p[0] >> (32 - a)) << (k - a) | p[1] >> (32 - (k - a))) as usize] = true;
                });
                assert!(seen.iter().all(|s| *s), "{n} points, boxes of 2^-{a}");
            }
        }
    }

    /// The mean over shifts is the integral, and the variance is a fraction of that of random points.
    #[test]
    fn averages_have_no_bias_and_little_variance() {
        let f = |x: f64, y: f64, z: f64| (1.0 + (3.0 * x + 2.0 * y).sin()) * (-2.0 * z).exp();
        // ∫∫ sin(3x + 2y) = ∫ (cos 2y − cos(3 + 2y))/3 dy.
        let sine = (2f64.sin() - (5f64.sin() - 3f64.sin())) / 6.0;
        let exact = (1.0 + sine) * (1.0 - (-2f64).exp()) / 2.0;
        let mut rng = Rng::new(1, 9);
        let unit = |b: u32| f64::from(b) / 4_294_967_296.0;
        let (mut sum, mut square, mut random) = (0.0, 0.0, 0.0);
        let rounds = 200;
        for _ in 0..rounds {
            let mut sobol = Sobol::new(std::array::from_fn(|_| rng.bits()));
            let (mut a, mut b) = (0.0, 0.0);
            for _ in 0..256 {
                let p = sobol.draw();
                a += f(unit(p[2]), unit(p[3]), unit(p[6])) / 256.0;
                b += f(unit(rng.bits()), unit(rng.bits()), unit(rng.bits())) / 256.0;
            }
            sum += a - exact;
            square += (a - exact).powi(2);
            random += (b - exact).powi(2);
        }
        let error = (square / f64::from(rounds)).sqrt();
        assert!((sum / f64::from(rounds)).abs() < 4.0 * error / f64::from(rounds).sqrt(), "{sum} {error}");
        assert!(square < 0.15 * random, "{square} {random}");
    }
}
