//! Walks at one albedo: a sparse matrix from the irradiance of surfels to their radiosity.
use super::angular::{AngularExit, CLASSES, class_of};
use super::{ExitWalks, powers};
use crate::PathtraceError;
use rayon::prelude::*;

/// Radiosity = matrix · (irradiance times the angular factor). Rows are surfels that light leaves, compressed and sorted.
#[derive(Debug, Clone, PartialEq)]
pub struct WalkOperator {
    /// Start of each row, and the end of the last.
    pub offsets: Vec<u32>,
    /// Surfels where light enters, ascending in each row.
    pub sources: Vec<u32>,
    /// What of their irradiance leaves, ≥ 0; a row's sum is at most 1 where no walk meets the object again.
    pub weights: Vec<f32>,
    /// How it enters and leaves.
    pub angular: AngularExit,
}

impl ExitWalks {
    /// The matrix at an albedo 0 … 1. Exits into one surfel are merged.
    ///
    /// Errors: an albedo out of range; more than 2³² exits.
    /// `[eq:exit-walks]`
    pub fn collapse(&self, albedo: f32) -> Result<WalkOperator, PathtraceError> {
        Self::check_albedo(albedo)?;
        if u32::try_from(self.exits.len()).is_err() {
            return Err(PathtraceError::Shape {
                what: "exits of walks",
                expected: "fewer than 2³²".into(),
                found: format!("{}", self.exits.len()),
            });
        }
        let powers = powers(f64::from(albedo), self.histogram.len());
        let walks = f64::from(self.options.walks);
        let rows: Vec<Vec<(u32, f32)>> = (0..self.surfels())
            .into_par_iter()
            .with_min_len(16)
            .map(|k| {
                let (exits, scatterings) = self.row(k);
                let mut row = Vec::new();
                let mut at = 0;
                while at < exits.len() {
                    let surfel = exits[at];
                    let mut sum = 0.0;
                    while at < exits.len() && exits[at] == surfel {
                        sum += powers[usize::from(scatterings[at])];
                        at += 1;
                    }
                    row.push((surfel, (sum / walks) as f32));
                }
                row
            })
            .collect();
        let total = rows.iter().map(Vec::len).sum();
        let mut operator = WalkOperator {
            offsets: vec![0],
            sources: Vec::with_capacity(total),
            weights: Vec::with_capacity(total),
            angular: self.angular(albedo)?,
        };
        for row in rows {
            operator.sources.extend(row.iter().map(|(surfel, _)| *surfel));
            operator.weights.extend(row.iter().map(|(_, weight)| *weight));
            operator.offsets.push(operator.sources.len() as u32);
        }
        Ok(operator)
    }

    /// The angular dependence at an albedo 0 … 1: that of each number of scatterings, by how much light it brings.
    pub fn angular(&self, albedo: f32) -> Result<AngularExit, PathtraceError> {
        Self::check_albedo(albedo)?;
        let mut weights = [0.0; CLASSES];
        let powers = powers(f64::from(albedo), self.histogram.len());
        for (n, (p, h)) in powers.iter().zip(&self.histogram).enumerate() {
            weights[class_of(n as u32)] += p * h;
        }
        Ok(AngularExit::mixed(&self.angular, &weights))
    }

    /// Radiosity of every surfel under every light at an albedo 0 … 1: surfels × lights. `irradiance` (≥ 0, visibility and cosine
    /// included) and `cosines` (of the angle between normal and lamp) are surfels × lights. Radiance toward the outer cosine
    /// μ_o is the result times A(μ_o)/π, A = [`ExitWalks::angular`].
    ///
    /// Errors: an albedo out of range; lists that do not fit.
    /// `[eq:exit-walks]`
    pub fn radiosity(&self, albedo: f32, irradiance: &[f32], cosines: &[f32]) -> Result<Vec<f32>, PathtraceError> {
        self.collapse(albedo)?.radiosity(irradiance, cosines)
    }
}

/// Number of lights of lists that have a row for each surfel.
pub(crate) fn lights(surfels: usize, irradiance: &[f32], cosines: &[f32]) -> Result<usize, PathtraceError> {
    let fits = irradiance.len().is_multiple_of(surfels) && !irradiance.is_empty() && irradiance.len() == cosines.len();
    if fits {
        return Ok(irradiance.len() / surfels);
    }
    Err(PathtraceError::Shape {
        what: "irradiance and cosines of surfels",
        expected: format!("a row for each of {surfels} surfels, a column for each light, both alike"),
        found: format!("{} and {} values", irradiance.len(), cosines.len()),
    })
}

impl WalkOperator {
    /// Number of surfels.
    pub fn surfels(&self) -> usize {
        self.offsets.len() - 1
    }

    /// See [`ExitWalks::radiosity`].
    pub fn radiosity(&self, irradiance: &[f32], cosines: &[f32]) -> Result<Vec<f32>, PathtraceError> {
        let lights = lights(self.surfels(), irradiance, cosines)?;
        let entering: Vec<f32> = irradiance.iter().zip(cosines).map(|(e, mu)| e * self.angular.at(*mu)).collect();
        self.apply(&entering, lights)
    }

    /// The matrix alone, on surfels × columns.
    pub fn apply(&self, values: &[f32], columns: usize) -> Result<Vec<f32>, PathtraceError> {
        if values.len() != self.surfels() * columns {
            return Err(PathtraceError::Shape {
                what: "values of surfels",
                expected: format!("{} × {columns}", self.surfels()),
                found: format!("{}", values.len()),
            });
        }
        let mut out = vec![0.0f32; values.len()];
        if columns == 0 {
            return Ok(out);
        }
        out.par_chunks_exact_mut(columns).with_min_len(64).enumerate().for_each(|(k, row)| {
            for at in self.offsets[k] as usize..self.offsets[k + 1] as usize {
                let from = self.sources[at] as usize * columns;
                let weight = self.weights[at];
                row.iter_mut().zip(&values[from..from + columns]).for_each(|(o, v)| *o += weight * v);
            }
        });
        Ok(out)
    }
}
