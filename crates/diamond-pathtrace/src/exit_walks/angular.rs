//! How light that leaves an object depends on the cosine of its direction: one smooth function for the whole surface.
//!
//! The function is what the boundary lets pass at that cosine, T(μ), times a polynomial. Its coefficients are means, over exits, of
//! polynomials that are orthonormal under 2μ·T(μ): a projection of the distribution itself, without bins. Walks of a few scatterings leave
//! in other directions than deep ones, so there is a function for each class of their number. Transport is reciprocal: starts are
//! distributed as exits are, and both are counted.
use crate::fresnel::dielectric;
use crate::{Boundary, Rng};
use glam::Vec3;

/// Classes of numbers of scatterings: 1, 2, 3 … 4, 5 … 8, 9 and more.
pub(crate) const CLASSES: usize = 5;

/// Powers of the cosine.
const POWERS: usize = 5;

/// Intervals of the tables over the cosine.
const STEPS: usize = 64;

/// Random directions for each cosine in the transmission of a rough boundary.
const DIRECTIONS: u32 = 4096;

/// Coefficients are drawn towards those of diffuse light inside as if so many exits had said so: keeps classes with few exits smooth.
const PRIOR_EXITS: f64 = 64.0;

/// The class of a number of scatterings ≥ 1.
pub(crate) fn class_of(scatterings: u32) -> usize {
    match scatterings {
        0..=1 => 0,
        2 => 1,
        3..=4 => 2,
        5..=8 => 3,
        _ => 4,
    }
}

/// The angular dependence of light that leaves, relative to an ideally diffuse exit; by reciprocity also of light that enters.
#[derive(Debug, Clone, PartialEq)]
pub struct AngularExit {
    /// Values at k/[`STEPS`].
    table: Vec<f32>,
}

impl AngularExit {
    /// The factor A(μ) ≥ 0 for the outer cosine μ, 0 … 1; its mean over the cosine distribution, ∫ A·2μ dμ, is 1. 0 for directions from behind.
    #[inline]
    pub fn at(&self, mu: f32) -> f32 {
        if mu.is_nan() || mu <= 0.0 {
            return 0.0;
        }
        let at = mu.min(1.0) * STEPS as f32;
        let k = (at as usize).min(STEPS - 1);
        let t = at - k as f32;
        self.table[k] * (1.0 - t) + self.table[k + 1] * t
    }

    /// From values at k/[`STEPS`]: none negative, of mean 1.
    fn new(values: impl Iterator<Item = f64>) -> Self {
        let values: Vec<f64> = values.map(|v| if v.is_finite() { v.max(0.0) } else { 0.0 }).collect();
        let mean = mean(&values);
        let scale = if mean > 0.0 { 1.0 / mean } else { 0.0 };
        Self { table: values.iter().map(|v| (v * scale) as f32).collect() }
    }

    /// The mean of functions of mean 1 with weights ≥ 0; the first if no weight is positive.
    pub(crate) fn mixed(parts: &[Self], weights: &[f64]) -> Self {
        let sum: f64 = weights.iter().sum();
        if sum.is_nan() || sum <= 0.0 {
            return parts[0].clone();
        }
        let value = |k: usize| parts.iter().zip(weights).map(|(p, w)| w * f64::from(p.table[k])).sum::<f64>();
        Self::new((0..=STEPS).map(value))
    }
}

/// ∫ f·2μ dμ of the function that is linear between values at k/[`STEPS`].
fn mean(values: &[f64]) -> f64 {
    let h = 1.0 / STEPS as f64;
    let part = |k: usize| {
        let (a, b, mu) = (values[k], values[k + 1], k as f64 * h);
        // ∫ (a + (b − a)t)(μ + ht) dt over 0 … 1.
        h * 2.0 * (mu * 0.5 * (a + b) + h * (a / 6.0 + b / 3.0))
    };
    (0..STEPS).map(part).sum()
}

/// Sums of powers of cosines over exits and starts, for each class; the first counts.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct AngularSums {
    sums: [[f64; POWERS]; CLASSES],
    /// Exits, unweighted.
    counts: [f64; CLASSES],
}

impl AngularSums {
    /// One exit with the cosines outside where the walk started and where it came out.
    #[inline]
    pub fn record(&mut self, scatterings: u32, cos_start: f32, cos_exit: f32) {
        let class = class_of(scatterings);
        self.counts[class] += 1.0;
        for cos in [cos_start, cos_exit] {
            let cos = f64::from(cos.clamp(0.0, 1.0));
            let mut power = 0.5;
            for sum in &mut self.sums[class] {
                *sum += power;
                power *= cos;
            }
        }
    }

    /// Adds another surfel's sums.
    pub fn add(&mut self, other: &Self, weight: f64) {
        for class in 0..CLASSES {
            self.counts[class] += other.counts[class];
            (0..POWERS).for_each(|k| self.sums[class][k] += weight * other.sums[class][k]);
        }
    }
}

/// Polynomials that are orthonormal under 2μ·T(μ).
pub(crate) struct AngularBasis {
    /// T at k/[`STEPS`].
    transmission: Vec<f64>,
    /// Coefficients of the powers, a row for each polynomial.
    rows: [[f64; POWERS]; POWERS],
}

impl AngularBasis {
    pub fn new(boundary: Boundary) -> Self {
        let transmission: Vec<f64> = (0..=STEPS).map(|k| transmission(boundary, k as f32 / STEPS as f32)).collect();
        // Moments ∫ μᵏ T 2μ dμ.
        let moments: Vec<f64> = (0..2 * POWERS - 1)
            .map(|power| {
                let values: Vec<f64> = transmission
                    .iter()
                    .enumerate()
                    .map(|(k, t)| t * (k as f64 / STEPS as f64).powi(power as i32))
                    .collect();
                mean(&values)
            })
            .collect();
        let product = |a: &[f64; POWERS], b: &[f64; POWERS]| -> f64 {
            (0..POWERS).flat_map(|i| (0..POWERS).map(move |j| (i, j))).map(|(i, j)| a[i] * b[j] * moments[i + j]).sum()
        };
        let mut rows = [[0.0; POWERS]; POWERS];
        for n in 0..POWERS {
            let mut row = [0.0; POWERS];
            row[n] = 1.0;
            // Twice: once leaves rounding of the order of what it removes.
            for _ in 0..2 {
                for earlier in &rows[..n] {
                    let along = product(&row, earlier);
                    (0..POWERS).for_each(|k| row[k] -= along * earlier[k]);
                }
            }
            let length = product(&row, &row).max(0.0).sqrt();
            let scale = if length > 0.0 { 1.0 / length } else { 0.0 };
            rows[n] = row.map(|v| v * scale);
        }
        Self { transmission, rows }
    }

    /// The function of a class. `[eq:angular-exit]`
    pub fn exit(&self, sums: &AngularSums, class: usize) -> AngularExit {
        let (sum, count) = (&sums.sums[class], sums.counts[class]);
        let trust = count / (count + PRIOR_EXITS);
        let coefficient = |n: usize| {
            let mean: f64 = self.rows[n].iter().zip(sum).map(|(c, s)| c * s).sum::<f64>() / sum[0];
            if n == 0 { mean } else { trust * mean }
        };
        let coefficients: [f64; POWERS] = match sum[0] > 0.0 {
            true => std::array::from_fn(coefficient),
            false => std::array::from_fn(|n| f64::from(u8::from(n == 0))),
        };
        let value = |k: usize| {
            let mu = k as f64 / STEPS as f64;
            let polynomial = |row: &[f64; POWERS]| row.iter().rev().fold(0.0, |sum, c| sum * mu + c);
            self.transmission[k] * coefficients.iter().zip(&self.rows).map(|(c, row)| c * polynomial(row)).sum::<f64>()
        };
        AngularExit::new((0..=STEPS).map(value))
    }
}

/// Fraction of light that passes a boundary from outside at the cosine μ.
fn transmission(boundary: Boundary, mu: f32) -> f64 {
    match boundary.effective() {
        Boundary::IndexMatched => 1.0,
        Boundary::Smooth { eta } => 1.0 - f64::from(dielectric(mu, eta).0),
        rough => {
            if mu <= 0.0 {
                return 0.0;
            }
            let outside = Vec3::new((1.0 - mu * mu).max(0.0).sqrt(), 0.0, mu);
            // Equal numbers at every cosine: what noise there is, is smooth.
            let mut rng = Rng::new(1, 0);
            let mut sum = 0.0f64;
            for _ in 0..DIRECTIONS {
                if let Some(s) = rough.sample(outside, Vec3::Z, &mut rng)
                    && s.transmitted
                {
                    sum += f64::from(s.weight * s.energy_scale);
                }
            }
            sum / f64::from(DIRECTIONS)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `[eq:angular-exit]`: directions drawn from T times a cubic give that function back.
    #[test]
    fn the_distribution_of_cosines_is_found_again() {
        for boundary in
            [Boundary::IndexMatched, Boundary::Smooth { eta: 1.4 }, Boundary::Rough { eta: 1.4, alpha: 0.5 }]
        {
            let truth = |mu: f32| transmission(boundary, mu) as f32 * (1.0 + 0.8 * mu - 0.5 * mu * mu * mu);
            let table: Vec<f64> = (0..=STEPS).map(|k| f64::from(truth(k as f32 / STEPS as f32))).collect();
            let expected = AngularExit::new(table.iter().copied());
            assert!((mean(&expected.table.iter().map(|v| f64::from(*v)).collect::<Vec<_>>()) - 1.0).abs() < 1e-6);
            let mut sums = AngularSums::default();
            let mut rng = Rng::new(5, 5);
            let mut drawn = 0;
            while drawn < 60_000 {
                // By rejection from the cosine distribution.
                let mu = rng.uniform().sqrt();
                if rng.uniform() * 2.0 < expected.at(mu) {
                    sums.record(7, mu, mu);
                    drawn += 1;
                }
            }
            let mut total = AngularSums::default();
            total.add(&sums, 0.3);
            let found = AngularBasis::new(boundary).exit(&total, class_of(7));
            for k in 2..=20 {
                let mu = k as f32 / 20.0;
                assert!(
                    (found.at(mu) - expected.at(mu)).abs() < 0.04,
                    "{boundary:?} {mu} {} {}",
                    found.at(mu),
                    expected.at(mu)
                );
            }
            assert_eq!((found.at(-0.1), found.at(f32::NAN)), (0.0, 0.0));
            // Without exits: diffuse light inside.
            let none = AngularBasis::new(boundary).exit(&total, 0);
            let ratio = none.at(0.9) / none.at(0.3);
            assert!((ratio - (transmission(boundary, 0.9) / transmission(boundary, 0.3)) as f32).abs() < 0.01);
        }
    }
}
