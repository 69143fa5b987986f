//! Adam (Kingma and Ba 2015), `[eq:adam]`.
//!
//! m ← β₁m + (1−β₁)g, v ← β₂v + (1−β₂)g², x ← x − rate · m̂ / (√v̂ + ε), with m̂ = m/(1−β₁ᵗ), v̂ = v/(1−β₂ᵗ).

use diamond_simd::{Lanes, Level, Simd, WithSimd};
use rayon::prelude::*;

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

/// What is updated at a time: rows of a tensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rows {
    /// All rows.
    All,
    /// Of rows of this width, those whose gradient is not all 0. The others keep values and moments as they are: neither
    /// does the first moment carry them on, nor do the moments decay, until they are seen again.
    Seen {
        /// Values per row, at least 1.
        width: usize,
    },
}

/// Values per parallel task; a whole number of blocks of every width.
const TASK: usize = 1 << 15;

/// Values, first moments, second moments and gradient of a task.
type Part<'a> = (((&'a mut [f32], &'a mut [f32]), &'a mut [f32]), &'a [f32]);

/// One update of `values` along `gradient`; `t` counts updates from 1. All slices have equal lengths. The same bits
/// whatever the number of threads.
pub fn adam_step(values: &mut [f32], moments: &mut Moments, gradient: &[f32], rate: f32, t: u64, rows: Rows) {
    let correction_1 = 1.0 - libm::pow(BETA_1 as f64, t as f64);
    let correction_2 = 1.0 - libm::pow(BETA_2 as f64, t as f64);
    let step = (rate as f64 / correction_1) as f32;
    let scale = (1.0 / correction_2.sqrt()) as f32;
    let level = Level::current();
    let width = match rows {
        Rows::All => 1,
        Rows::Seen { width } => width.max(1),
    };
    let task = TASK / width * width + if TASK < width { width } else { 0 };
    let parts = values.par_chunks_mut(task).zip(moments.first.par_chunks_mut(task));
    let parts = parts.zip(moments.second.par_chunks_mut(task)).zip(gradient.par_chunks(task));
    let run = |(((values, first), second), gradient): Part<'_>| match rows {
        Rows::All => level.dispatch(Update { values, first, second, gradient, step, scale }),
        Rows::Seen { .. } => each_run(gradient, width, |seen| {
            level.dispatch(Update {
                values: &mut values[seen.clone()],
                first: &mut first[seen.clone()],
                second: &mut second[seen.clone()],
                gradient: &gradient[seen],
                step,
                scale,
            })
        }),
    };
    if gradient.len() <= task {
        // A parallel call costs more than this.
        run((((values, &mut moments.first), &mut moments.second), gradient));
    } else {
        parts.for_each(run);
    }
}

/// Calls `f` with each longest run of rows of `width` values that are not all 0.
fn each_run(gradient: &[f32], width: usize, mut f: impl FnMut(std::ops::Range<usize>)) {
    let mut begin = None;
    for (row, g) in gradient.chunks(width).enumerate() {
        let seen = g.iter().fold(0u32, |bits, g| bits | g.to_bits() << 1) != 0;
        match (seen, begin) {
            (true, None) => begin = Some(row * width),
            (false, Some(start)) => {
                f(start..row * width);
                begin = None;
            }
            _ => {}
        }
    }
    if let Some(start) = begin {
        f(start..gradient.len());
    }
}

struct Update<'a> {
    values: &'a mut [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
    gradient: &'a [f32],
    step: f32,
    scale: f32,
}

impl WithSimd for Update<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let w = S::F32_LANES;
        let whole = self.values.len() / w * w;
        let (values, values_rest) = self.values.split_at_mut(whole);
        let (first, first_rest) = self.first.split_at_mut(whole);
        let (second, second_rest) = self.second.split_at_mut(whole);
        let (gradient, gradient_rest) = self.gradient.split_at(whole);
        let rows = values.chunks_exact_mut(w).zip(first.chunks_exact_mut(w));
        for (((x, m), v), g) in rows.zip(second.chunks_exact_mut(w)).zip(gradient.chunks_exact(w)) {
            let state = [Lanes::load(s, x), Lanes::load(s, m), Lanes::load(s, v)];
            let [x2, m2, v2] = update(state, Lanes::load(s, g), self.step, self.scale);
            x2.store(x);
            m2.store(m);
            v2.store(v);
        }
        if !gradient_rest.is_empty() {
            let part = |from: &[f32]| {
                let mut full = [0.0; diamond_simd::BLOCK];
                full[..from.len()].copy_from_slice(from);
                full
            };
            let [x, m, v, g] = [&*values_rest, &*first_rest, &*second_rest, gradient_rest].map(part);
            let state = [Lanes::load(s, &x), Lanes::load(s, &m), Lanes::load(s, &v)];
            let after = update(state, Lanes::load(s, &g), self.step, self.scale);
            for (to, from) in [values_rest, first_rest, second_rest].into_iter().zip(after) {
                let mut full = [0.0; diamond_simd::BLOCK];
                from.store(&mut full);
                to.copy_from_slice(&full[..to.len()]);
            }
        }
    }
}

/// Value, first and second moment after a gradient. `[eq:adam]`
#[inline(always)]
fn update<S: Simd>([x, m, v]: [Lanes<S>; 3], g: Lanes<S>, step: f32, scale: f32) -> [Lanes<S>; 3] {
    let m = m.mul_add(m.same(BETA_1), g * (1.0 - BETA_1));
    let v = v.mul_add(v.same(BETA_2), g * g * (1.0 - BETA_2));
    let x = x - m * step / (v.sqrt() * scale + EPSILON);
    [x, m, v]
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
            adam_step(&mut x, &mut moments, &[g], 0.01, i as u64 + 1, Rows::All);
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
                adam_step(&mut x, &mut moments, &[g], 1e-3, t, Rows::All);
                assert!(x[0].is_finite(), "gradient {g}, step {t}");
            }
        }
    }

    /// Every width, odd lengths, and one and several tasks: the same bits as one value at a time.
    #[test]
    fn widths_and_tasks_change_nothing() {
        let n = 37;
        let g: Vec<f32> = (0..n).map(|i| (i as f32 * 1.3).sin()).collect();
        let start: Vec<f32> = (0..n).map(|i| (i as f32 * 0.3).cos()).collect();
        let mut fused: Option<[Vec<f32>; 3]> = None;
        for level in Level::testable() {
            let mut state = [start.clone(), g.iter().map(|g| 0.5 * g).collect(), g.iter().map(|g| g * g).collect()];
            let [values, first, second] = &mut state;
            level.dispatch(Update { values, first, second, gradient: &g, step: 0.01, scale: 1.5 });
            for i in 0..n {
                let (m, v) = (0.9 * 0.5 * g[i] + 0.1 * g[i], 0.999 * g[i] * g[i] + 0.001 * g[i] * g[i]);
                let x = start[i] - 0.01 * m / (v.sqrt() * 1.5 + 1e-15);
                assert!((state[0][i] - x).abs() < 1e-6 && (state[1][i] - m).abs() < 1e-6, "{level:?}");
            }
            if level.is_fused() {
                assert_eq!(*fused.get_or_insert_with(|| state.clone()), state, "{level:?}");
            }
        }
        let many = 3 * TASK + 11;
        let g: Vec<f32> = (0..many).map(|i| (i as f32 * 1.3).sin()).collect();
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let (mut x, mut moments) = (vec![0.5; many], Moments::zeros(many));
            pool.install(|| adam_step(&mut x, &mut moments, &g, 0.01, 1, Rows::All));
            (x, moments)
        };
        assert!(run(1) == run(2));
    }

    #[test]
    fn sparse_updates_touch_the_rows_that_were_seen_and_agree_there() {
        let (width, rows) = (3, 50);
        let g: Vec<f32> = (0..width * rows)
            .map(|i| if (i / width) % 7 < 4 { 0.0 } else { (i as f32).sin() * if i % width == 1 { 0.0 } else { 1.0 } })
            .collect();
        let start = Moments { first: vec![0.1; g.len()], second: vec![0.2; g.len()] };
        let (mut dense, mut sparse) = (vec![1.0; g.len()], vec![1.0; g.len()]);
        let (mut dense_moments, mut sparse_moments) = (start.clone(), start.clone());
        adam_step(&mut dense, &mut dense_moments, &g, 0.01, 5, Rows::All);
        adam_step(&mut sparse, &mut sparse_moments, &g, 0.01, 5, Rows::Seen { width });
        for i in 0..g.len() {
            if (i / width) % 7 < 4 {
                assert_eq!((sparse[i], sparse_moments.first[i], sparse_moments.second[i]), (1.0, 0.1, 0.2));
            } else {
                assert_eq!((sparse[i], sparse_moments.first[i]), (dense[i], dense_moments.first[i]));
            }
        }
    }
}
