//! How much signal and how much noise there is at each timestep.
use crate::error::{DiffusionError, Result};

/// Offset of the cosine schedule, so that the first steps are not too small.
const COSINE_OFFSET: f64 = 0.008;

/// Largest β of the cosine schedule, which would end at 1.
const COSINE_LARGEST: f64 = 0.999;

/// Shares of signal and noise: x_t = signal·x₀ + noise·ε.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Level {
    /// √ᾱ, in [0, 1].
    pub signal: f64,
    /// √(1 − ᾱ), in [0, 1].
    pub noise: f64,
}

impl Level {
    /// No noise.
    pub const CLEAN: Self = Self { signal: 1.0, noise: 0.0 };

    /// Of a variance-preserving process.
    pub fn from_alpha_bar(alpha_bar: f64) -> Self {
        Self { signal: alpha_bar.max(0.0).sqrt(), noise: (1.0 - alpha_bar).max(0.0).sqrt() }
    }

    /// Of the straight line between picture (0) and noise (1).
    pub fn of_flow(time: f64) -> Self {
        Self { signal: 1.0 - time, noise: time }
    }

    /// signal²/noise², infinite without noise.
    pub fn snr(self) -> f64 {
        (self.signal * self.signal) / (self.noise * self.noise)
    }
}

/// ᾱ of each timestep, falling.
///
/// ```
/// use diamond_diffusion::Schedule;
/// let schedule = Schedule::stable_diffusion().with_zero_terminal_snr();
/// assert_eq!(schedule.alpha_bar(999), 0.0);
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    alpha_bar: Vec<f64>,
}

impl Schedule {
    /// β that are linear in their square roots, from `first` to `last` (in (0, 1)) over `steps` (at least 2).
    /// `[eq:scaled-linear]`
    pub fn scaled_linear(steps: usize, first: f64, last: f64) -> Result<Self> {
        if steps < 2 {
            return Err(DiffusionError::setting("steps", "at least 2", steps));
        }
        if !(first > 0.0 && last >= first && last < 1.0) {
            let found = format!("{first} and {last}");
            return Err(DiffusionError::setting("beta", "0 < first ≤ last < 1", found));
        }
        Ok(Self::between(steps, first, last))
    }

    fn between(steps: usize, first: f64, last: f64) -> Self {
        let (a, b) = (first.sqrt(), last.sqrt());
        let beta = |i: usize| a + (b - a) * i as f64 / (steps - 1) as f64;
        Self::from_betas((0..steps).map(|i| beta(i) * beta(i)))
    }

    /// That of Stable Diffusion: 1000 steps from 0.00085 to 0.0120.
    pub fn stable_diffusion() -> Self {
        Self::between(1000, 0.00085, 0.012)
    }

    /// ᾱ that falls as a squared cosine.
    /// `[eq:cosine-schedule]`
    pub fn cosine(steps: usize) -> Result<Self> {
        if steps < 2 {
            return Err(DiffusionError::setting("steps", "at least 2", steps));
        }
        let f = |i: usize| {
            let t = i as f64 / steps as f64;
            let c = libm::cos((t + COSINE_OFFSET) / (1.0 + COSINE_OFFSET) * std::f64::consts::FRAC_PI_2);
            c * c
        };
        Ok(Self::from_betas((0..steps).map(|i| (1.0 - f(i + 1) / f(i)).min(COSINE_LARGEST))))
    }

    fn from_betas(betas: impl Iterator<Item = f64>) -> Self {
        let product = |so_far: &mut f64, beta: f64| {
            *so_far *= 1.0 - beta;
            Some(*so_far)
        };
        Self { alpha_bar: betas.scan(1.0, product).collect() }
    }

    /// √ᾱ shifted and scaled so that the last is 0 and the first stays: sampling then begins from pure noise, as training saw it,
    /// and the brightness of a whole picture can change.
    /// `[eq:zero-snr]`
    #[must_use]
    pub fn with_zero_terminal_snr(&self) -> Self {
        let root: Vec<f64> = self.alpha_bar.iter().map(|a| a.sqrt()).collect();
        let (first, last) = (root[0], root[root.len() - 1]);
        let moved = |s: f64| (s - last) * first / (first - last);
        Self { alpha_bar: root.into_iter().map(|s| moved(s) * moved(s)).collect() }
    }

    /// Number of timesteps.
    pub fn steps(&self) -> usize {
        self.alpha_bar.len()
    }

    /// ᾱ at a timestep; the last one beyond the end.
    pub fn alpha_bar(&self, timestep: usize) -> f64 {
        self.alpha_bar[timestep.min(self.alpha_bar.len() - 1)]
    }

    /// Signal and noise at a timestep.
    pub fn level(&self, timestep: usize) -> Level {
        Level::from_alpha_bar(self.alpha_bar(timestep))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// [eq:scaled-linear]
    #[test]
    fn the_published_schedule_has_its_known_ends() {
        let s = Schedule::stable_diffusion();
        assert!((s.alpha_bar(0) - 0.99915).abs() < 1e-12);
        // Second step by hand: β₁ = (√0.00085 + (√0.012 − √0.00085)/999)².
        let root = 0.00085f64.sqrt() + (0.012f64.sqrt() - 0.00085f64.sqrt()) / 999.0;
        assert!((s.alpha_bar(1) - 0.99915 * (1.0 - root * root)).abs() < 1e-12);
        assert!((s.alpha_bar(999) - 0.004_660).abs() < 1e-6, "{}", s.alpha_bar(999));
        assert!(Schedule::scaled_linear(1, 0.1, 0.2).is_err() && Schedule::scaled_linear(5, 0.3, 0.2).is_err());
    }

    /// [eq:zero-snr]
    #[test]
    fn the_last_signal_is_nothing_and_the_first_is_as_it_was() {
        for schedule in [Schedule::stable_diffusion(), Schedule::cosine(50).unwrap()] {
            let s = schedule.with_zero_terminal_snr();
            assert_eq!(s.alpha_bar(s.steps() - 1), 0.0);
            assert!((s.alpha_bar(0) - schedule.alpha_bar(0)).abs() < 1e-15);
            assert!((1..s.steps()).all(|t| s.alpha_bar(t) < s.alpha_bar(t - 1)));
            assert_eq!(s.level(s.steps() - 1).snr(), 0.0);
        }
    }

    /// [eq:cosine-schedule]
    #[test]
    fn the_cosine_is_half_way_down_in_the_middle() {
        let s = Schedule::cosine(1000).unwrap();
        let f = |t: f64| ((t + 0.008) / 1.008 * std::f64::consts::FRAC_PI_2).cos().powi(2);
        assert!((s.alpha_bar(499) - f(0.5) / f(0.0)).abs() < 1e-12);
        assert!(s.alpha_bar(499) > 0.45 && s.alpha_bar(499) < 0.5 && s.alpha_bar(999) < 1e-4);
    }
}
