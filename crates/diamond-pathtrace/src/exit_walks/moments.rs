//! Walks under given lights, for every albedo: radiosity as a sum of powers of it.
use super::angular::{AngularExit, class_of};
use super::operator::lights;
use super::{ExitWalks, powers};
use crate::{PathtraceError, error::check};
use rayon::prelude::*;

/// Numbers of scatterings up to this one have a bin of their own.
const SINGLE: u32 = 8;

/// Above, a bin's last number is so many times that of the one before.
const RATIO: f64 = 1.3;

/// Radiosity M = Σ_b α^n_b·h_b of every surfel under every light. With α the albedo, 0 … 1, M grows with it and is what [`ExitWalks::collapse`]
/// gives, up to two things: α^n_b stands for the mean of αⁿ over a bin, too small by at most 0.4 % of what the bin brings (and by less than
/// 0.2 % of the sum on all objects in the tests); and each class of n enters with its own angular function, where the matrix has their mean.
#[derive(Debug, Clone, PartialEq)]
pub struct ExitMoments {
    /// Exponents n_b, ascending: the mean number of scatterings in each bin.
    pub exponents: Vec<f32>,
    /// h: surfels × lights × bins, ≥ 0.
    pub values: Vec<f32>,
    /// For each bin, which of `angular` light of that bin leaves with.
    pub class: Vec<u8>,
    /// Angular functions.
    pub angular: Vec<AngularExit>,
}

impl ExitMoments {
    /// M at an albedo 0 … 1: surfels × lights. `[eq:exit-moments]`
    pub fn radiosity(&self, albedo: f32) -> Vec<f32> {
        let bins = self.exponents.len();
        let weights: Vec<f32> = self.exponents.iter().map(|n| albedo.clamp(0.0, 1.0).powf(*n)).collect();
        self.values.chunks_exact(bins.max(1)).map(|h| h.iter().zip(&weights).map(|(h, w)| h * w).sum()).collect()
    }

    /// For each bin the factor A_b(μ_o)/π that makes radiance toward the outer cosine μ_o of its part of the radiosity.
    pub fn exit_factors(&self, mu: f32) -> Vec<f32> {
        let factor = |class: &u8| self.angular[usize::from(*class)].at(mu) * std::f32::consts::FRAC_1_PI;
        self.class.iter().map(factor).collect()
    }
}

/// Bins of numbers of scatterings.
#[derive(Debug, Clone)]
pub(crate) struct Bins {
    /// Last number of each.
    pub ends: Vec<u32>,
    /// Mean number in each.
    pub exponents: Vec<f32>,
    /// Which one holds a number.
    pub of: Vec<u32>,
}

impl Bins {
    /// For a histogram of numbers of scatterings, from 0 on; 0 itself is not wanted.
    pub fn new(histogram: &[f64]) -> Self {
        let most = histogram.len().saturating_sub(1).max(1) as u32;
        let mut ends: Vec<u32> = (1..=SINGLE.min(most)).collect();
        while let Some(last) = ends.last().filter(|end| **end < most) {
            ends.push((f64::from(*last) * RATIO).ceil() as u32);
        }
        let of: Vec<u32> = (0..=most).map(|n| ends.partition_point(|end| *end < n) as u32).collect();
        let mut sums = vec![(0.0f64, 0.0f64); ends.len()];
        for (n, h) in histogram.iter().enumerate().skip(1) {
            let bin = &mut sums[of[n] as usize];
            bin.0 += h * n as f64;
            bin.1 += h;
        }
        let mean = |((sum, count), end): (&(f64, f64), &u32)| if *count > 0.0 { sum / count } else { f64::from(*end) };
        let exponents = sums.iter().zip(&ends).map(mean).map(|n| n as f32).collect();
        Self { ends, exponents, of }
    }
}

impl ExitWalks {
    /// What every surfel gets under every light from walks of each bin of scatterings: what a fit of the albedo reads. Arguments as in
    /// [`ExitWalks::radiosity`].
    ///
    /// Errors: lists that do not fit.
    /// `[eq:exit-moments]`
    pub fn moments(&self, irradiance: &[f32], cosines: &[f32]) -> Result<ExitMoments, PathtraceError> {
        let lights = lights(self.surfels(), irradiance, cosines)?;
        let bins = Bins::new(&self.histogram);
        let count = bins.ends.len();
        // Light as it enters, for each class of walks.
        let entering: Vec<Vec<f32>> = self
            .angular
            .iter()
            .map(|a| irradiance.iter().zip(cosines).map(|(e, mu)| e * a.at(*mu)).collect())
            .collect();
        let scale = 1.0 / self.options.walks as f32;
        let mut values = vec![0.0f32; self.surfels() * lights * count];
        values.par_chunks_exact_mut(lights * count).with_min_len(16).enumerate().for_each(|(k, h)| {
            let (exits, scatterings) = self.row(k);
            for (surfel, n) in exits.iter().zip(scatterings) {
                let (bin, class) = (bins.of[usize::from(*n)] as usize, class_of(u32::from(*n)));
                let from = &entering[class][*surfel as usize * lights..][..lights];
                h[bin..].iter_mut().step_by(count).zip(from).for_each(|(h, e)| *h += scale * e);
            }
        });
        Ok(ExitMoments {
            exponents: bins.exponents,
            values,
            class: bins.ends.iter().map(|end| class_of(*end) as u8).collect(),
            angular: self.angular.to_vec(),
        })
    }

    /// The largest error of [`ExitMoments`]' exponents at an albedo 0 … 1, relative to all light that leaves, for the walks as they are.
    pub fn moment_error(&self, albedo: f32) -> Result<f64, PathtraceError> {
        check("albedo", albedo, "a number from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
        let Bins { ends, .. } = Bins::new(&self.histogram);
        let powers = powers(f64::from(albedo), self.histogram.len());
        let (mut error, mut total) = (0.0, 0.0);
        let mut first = 0usize;
        for end in ends {
            let last = (end as usize + 1).min(self.histogram.len());
            let part = first.min(last)..last;
            let count: f64 = self.histogram[part.clone()].iter().sum();
            let sum: f64 = part.clone().map(|n| self.histogram[n] * powers[n]).sum();
            let mean: f64 = part.map(|n| self.histogram[n] * n as f64).sum::<f64>() / count.max(f64::MIN_POSITIVE);
            total += sum;
            error += (sum - count * f64::from(albedo).powf(mean)).abs();
            first = last;
        }
        Ok(if total > 0.0 { error / total } else { 0.0 })
    }
}
