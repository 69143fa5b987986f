//! Least squares with unknowns that may not be negative, from few numbers per photograph.
//!
//! Rows of Σ_k a_k·x_k ≈ b are not kept: what the solution needs are the products Σ a_j·a_k, Σ a_k·b and Σ b², in `f64`, added up
//! row by row or image by image. [`NormalEquations::solve`] finds the x ≥ 0 of least error by the active-set method of
//! Lawson and Hanson ("Solving Least Squares Problems", 1974): it ends, and where it ends the conditions of a minimum hold.
//!
//! ```
//! use diamond_shading::{NormalEquations, SolveOptions};
//! let mut equations = NormalEquations::new(2);
//! equations.add(&[1.0, 0.0], 2.0, 1.0);
//! equations.add(&[0.0, 1.0], -3.0, 1.0);
//! assert_eq!(equations.solve(&SolveOptions { ridge: 0.0 }), vec![2.0, 0.0]);
//! ```
use crate::error::{ShadingError, check_length};

/// A gradient below this fraction of the largest right-hand side counts as zero: sums of thousands of rows round that much.
const GRADIENT_TOLERANCE: f64 = 1e-10;

/// A pivot below this fraction of its diagonal element is no new direction; the unknown stays 0.
const MIN_PIVOT: f64 = 1e-12;

/// Sums of products of weighted rows.
#[derive(Debug, Clone, PartialEq)]
pub struct NormalEquations {
    unknowns: usize,
    /// Σ w·a_j·a_k, row-major, both triangles.
    gram: Vec<f64>,
    /// Σ w·a_k·b.
    right: Vec<f64>,
    /// Σ w·b².
    energy: f64,
    /// Σ w.
    weight: f64,
}

/// How normal equations are solved.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SolveOptions {
    /// Added to each diagonal element, as a fraction of it: pulls unknowns that the rows hardly tell apart toward sharing.
    pub ridge: f64,
}

impl Default for SolveOptions {
    fn default() -> Self {
        Self { ridge: 1e-9 }
    }
}

impl NormalEquations {
    /// No rows yet.
    pub fn new(unknowns: usize) -> Self {
        let gram = vec![0.0; unknowns * unknowns];
        Self { unknowns, gram, right: vec![0.0; unknowns], energy: 0.0, weight: 0.0 }
    }

    /// Number of unknowns.
    pub fn unknowns(&self) -> usize {
        self.unknowns
    }

    /// Σ of the weights of the rows.
    pub fn weight(&self) -> f64 {
        self.weight
    }

    /// Adds the row Σ a_k·x_k ≈ b with a weight ≥ 0. A row of another length, or with a number that is not finite, is left out.
    /// `[eq:normal-equations]`
    pub fn add(&mut self, row: &[f64], b: f64, weight: f64) {
        let n = self.unknowns;
        if row.len() != n
            || !(weight >= 0.0 && weight.is_finite() && b.is_finite() && row.iter().all(|a| a.is_finite()))
        {
            return;
        }
        for (j, a) in row.iter().enumerate().filter(|(_, a)| **a != 0.0) {
            let scaled = weight * a;
            self.gram[j * n..(j + 1) * n].iter_mut().zip(row).for_each(|(g, a)| *g += scaled * a);
            self.right[j] += scaled * b;
        }
        self.energy += weight * b * b;
        self.weight += weight;
    }

    /// Adds the rows of `other`. Errors where it has another number of unknowns.
    pub fn merge(&mut self, other: &Self) -> Result<(), ShadingError> {
        check_length("unknowns of normal equations", self.unknowns, other.unknowns)?;
        self.gram.iter_mut().zip(&other.gram).for_each(|(a, b)| *a += b);
        self.right.iter_mut().zip(&other.right).for_each(|(a, b)| *a += b);
        self.energy += other.energy;
        self.weight += other.weight;
        Ok(())
    }

    /// Σ w·(Σ_k a_k·x_k − b)² of all rows, at least 0. An `x` that is too short is continued by zeros.
    /// `[eq:normal-equations]`
    pub fn error(&self, x: &[f64]) -> f64 {
        let n = self.unknowns.min(x.len());
        let mut sum = self.energy;
        for j in 0..n {
            let row: f64 = (0..n).map(|k| self.gram[j * self.unknowns + k] * x[k]).sum();
            sum += x[j] * (row - 2.0 * self.right[j]);
        }
        sum.max(0.0)
    }

    /// Half of the downhill gradient of the error: Σ a·(b − Σ a·x), with the ridge.
    fn downhill(&self, x: &[f64], ridge: f64) -> Vec<f64> {
        let n = self.unknowns;
        (0..n)
            .map(|j| {
                let row = &self.gram[j * n..(j + 1) * n];
                let sum: f64 = row.iter().zip(x).map(|(g, x)| g * x).sum();
                self.right[j] - sum - ridge * row[j] * x[j]
            })
            .collect()
    }

    /// Least squares over the unknowns `free` by Cholesky factorisation, the others 0; `None` where one of them depends on those
    /// before it.
    fn unconstrained(&self, free: &[usize], ridge: f64) -> Option<Vec<f64>> {
        let (n, m) = (self.unknowns, free.len());
        let mut l = vec![0.0; m * m];
        for i in 0..m {
            for j in 0..=i {
                let mut sum = self.gram[free[i] * n + free[j]];
                if i == j {
                    sum *= 1.0 + ridge;
                }
                for k in 0..j {
                    sum -= l[i * m + k] * l[j * m + k];
                }
                if i == j {
                    let diagonal = self.gram[free[i] * n + free[i]];
                    // Written so that NaN fails it.
                    if !(sum > MIN_PIVOT * diagonal && diagonal > 0.0) {
                        return None;
                    }
                    l[i * m + i] = sum.sqrt();
                } else {
                    l[i * m + j] = sum / l[j * m + j];
                }
            }
        }
        let mut y = vec![0.0; m];
        for i in 0..m {
            let sum: f64 = (0..i).map(|k| l[i * m + k] * y[k]).sum();
            y[i] = (self.right[free[i]] - sum) / l[i * m + i];
        }
        for i in (0..m).rev() {
            let sum: f64 = (i + 1..m).map(|k| l[k * m + i] * y[k]).sum();
            y[i] = (y[i] - sum) / l[i * m + i];
        }
        Some(y)
    }

    /// The x ≥ 0 of least error. Unknowns that no row mentions, or that are indistinguishable from others, are 0.
    /// `[eq:nonnegative-least-squares]`
    pub fn solve(&self, options: &SolveOptions) -> Vec<f64> {
        let n = self.unknowns;
        let largest = self.right.iter().fold(0.0f64, |m, r| m.max(r.abs()));
        let mut x = vec![0.0; n];
        let mut free: Vec<usize> = Vec::new();
        // Unknowns that cannot enter now; cleared by each success.
        let mut refused = vec![false; n];
        // Each round adds an unknown or refuses one; the bound is never met by systems that rounding has not spoilt.
        for _ in 0..16 * n + 16 {
            let slope = self.downhill(&x, options.ridge);
            let candidates = (0..n).filter(|k| !free.contains(k) && !refused[*k]);
            let best = candidates.fold(None, |best: Option<usize>, k| match best {
                Some(b) if slope[b] >= slope[k] => best,
                _ => Some(k),
            });
            let Some(entering) = best.filter(|k| slope[*k] > GRADIENT_TOLERANCE * largest) else { break };
            free.push(entering);
            let mut accepted = false;
            while let Some(y) = self.unconstrained(&free, options.ridge) {
                if !accepted && y[y.len() - 1] <= 0.0 && free[free.len() - 1] == entering {
                    // Rounding promised a gain that is none.
                    break;
                }
                accepted = true;
                let blocked = free.iter().zip(&y).filter(|(_, y)| **y <= 0.0);
                let step = blocked.map(|(k, y)| x[*k] / (x[*k] - y)).fold(1.0f64, f64::min);
                free.iter().zip(&y).for_each(|(k, y)| x[*k] += step * (y - x[*k]));
                if step >= 1.0 {
                    break;
                }
                let kept: Vec<bool> = free.iter().zip(&y).map(|(k, y)| *y > 0.0 || x[*k] > 1e-14 * y.abs()).collect();
                let before = free.len();
                let mut keep = kept.iter();
                free.retain(|k| {
                    let stays = *keep.next().unwrap_or(&true);
                    if !stays {
                        x[*k] = 0.0;
                    }
                    stays
                });
                if free.len() == before {
                    break;
                }
            }
            if accepted {
                refused.fill(false);
            } else {
                free.retain(|k| *k != entering);
                refused[entering] = true;
            }
        }
        x.iter().map(|x| x.max(0.0)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// All 2ⁿ sets of free unknowns: the least error among those whose solution is ≥ 0.
    fn by_enumeration(equations: &NormalEquations) -> f64 {
        let n = equations.unknowns();
        let mut best = equations.error(&vec![0.0; n]);
        for set in 1u32..1 << n {
            let free: Vec<usize> = (0..n).filter(|k| set >> k & 1 == 1).collect();
            if let Some(y) = equations.unconstrained(&free, 0.0).filter(|y| y.iter().all(|y| *y >= 0.0)) {
                let mut x = vec![0.0; n];
                free.iter().zip(&y).for_each(|(k, y)| x[*k] = *y);
                best = best.min(equations.error(&x));
            }
        }
        best
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]

        /// `[eq:nonnegative-least-squares]` `[eq:normal-equations]`: the least error of all subsets, and the conditions of a minimum.
        #[test]
        fn the_solution_is_the_best_of_all_subsets(
            rows in prop::collection::vec(([-1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0], -1.0f64..1.0), 8..20),
        ) {
            let mut equations = NormalEquations::new(5);
            rows.iter().for_each(|(row, b)| equations.add(row, *b, 1.0));
            let x = equations.solve(&SolveOptions { ridge: 0.0 });
            prop_assert!(x.iter().all(|x| *x >= 0.0));
            let plain: f64 = rows.iter().map(|(row, b)| (row.iter().zip(&x).map(|(a, x)| a * x).sum::<f64>() - b).powi(2)).sum();
            prop_assert!((plain - equations.error(&x)).abs() <= 1e-9);
            prop_assert!(equations.error(&x) <= by_enumeration(&equations) + 1e-9);
            for (x, slope) in x.iter().zip(equations.downhill(&x, 0.0)) {
                let over = if *x > 0.0 { slope.abs() } else { slope };
                prop_assert!(over <= 1e-8);
            }
        }
    }

    #[test]
    fn what_rows_cannot_tell_apart_ends_all_the_same() {
        let mut equations = NormalEquations::new(3);
        for b in [1.0, 2.0, 3.0] {
            equations.add(&[b, b, 0.0], 2.0 * b, 1.0);
        }
        equations.add(&[f64::NAN, 0.0, 0.0], 1.0, 1.0);
        equations.add(&[1.0], 1.0, 1.0);
        for ridge in [0.0, 1e-9] {
            let x = equations.solve(&SolveOptions { ridge });
            assert!((x[0] + x[1] - 2.0).abs() < 1e-6 && x[2] == 0.0, "{x:?}");
        }
        assert_eq!(NormalEquations::new(2).solve(&SolveOptions::default()), vec![0.0, 0.0]);
        let mut twice = equations.clone();
        twice.merge(&equations).unwrap();
        assert!((twice.error(&[1.0]) - 2.0 * equations.error(&[1.0])).abs() < 1e-12);
        assert!(twice.merge(&NormalEquations::new(2)).is_err());
    }
}
