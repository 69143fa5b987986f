//! Adam (Kingma and Ba 2015), `[eq:adam]`.
//!
//! m ← β₁m + (1−β₁)g, v ← β₂v + (1−β₂)g², x ← x − rate · m̂ / (√v̂ + ε), with m̂ = m/(1−β₁ᵗ), v̂ = v/(1−β₂ᵗ).

/// First-moment decay.
const BETA_1: f32 = 0.9;
/// Second-moment decay.
const BETA_2: f32 = 0.999;
/// Keeps the division finite where a gradient has always been 0; so small because gradients of a mean over an image are
/// themselves of order 1e-7.
const EPSILON: f32 = 1e-15;

/// Values with their Adam moments.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Moments {
    /// Mean of the gradient.
    pub first: Vec<f32>,
    /// Mean of the squared gradient.
    pub second: Vec<f32>,
}

impl Moments {
    /// Zero moments for `n` values.
    pub fn zeros(n: usize) -> Self {
        Self { first: vec![0.0; n], second: vec![0.0; n] }
    }
}

/// One update of `values` along `gradient`; `t` counts updates from 1. All slices have equal lengths.
pub fn adam_step(values: &mut [f32], moments: &mut Moments, gradient: &[f32], rate: f32, t: u64) {
    let correction_1 = 1.0 - (BETA_1 as f64).powf(t as f64);
    let correction_2 = 1.0 - (BETA_2 as f64).powf(t as f64);
    let step = (rate as f64 / correction_1) as f32;
    let scale = (1.0 / correction_2.sqrt()) as f32;
    let rows = values.iter_mut().zip(&mut moments.first).zip(&mut moments.second).zip(gradient);
    for (((x, m), v), &g) in rows {
        *m = BETA_1 * *m + (1.0 - BETA_1) * g;
        *v = BETA_2 * *v + (1.0 - BETA_2) * (g * g);
        *x -= step * *m / (v.sqrt() * scale + EPSILON);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `[eq:adam]` against the formula written out in f64.
    #[test]
    fn follows_the_formula() {
        let gradients = [0.5f32, -0.25, 3.0, 1e-9, 0.0];
        let (mut x, mut moments) = (vec![1.0f32], Moments::zeros(1));
        let (mut x64, mut m, mut v) = (1.0f64, 0.0f64, 0.0f64);
        for (i, &g) in gradients.iter().enumerate() {
            adam_step(&mut x, &mut moments, &[g], 0.01, i as u64 + 1);
            let (g, t) = (g as f64, i as i32 + 1);
            m = 0.9 * m + 0.1 * g;
            v = 0.999 * v + 0.001 * g * g;
            x64 -= 0.01 * (m / (1.0 - 0.9f64.powi(t))) / ((v / (1.0 - 0.999f64.powi(t))).sqrt() + 1e-15);
            assert!((x[0] as f64 - x64).abs() < 1e-6, "step {t}: {} against {x64}", x[0]);
        }
    }

    #[test]
    fn extreme_gradients_stay_finite() {
        for g in [0.0f32, 1e-38, 1e-30, 1e18, -1e18] {
            let (mut x, mut moments) = (vec![0.0f32], Moments::zeros(1));
            for t in 1..50 {
                adam_step(&mut x, &mut moments, &[g], 1e-3, t);
                assert!(x[0].is_finite(), "gradient {g}, step {t}");
            }
        }
    }
}
