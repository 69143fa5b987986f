//! Density control by relocation: transparent Gaussians move to where opaque ones are, and share their work.
//!
//! Gaussians are seen as samples of a distribution that training explores (Kheradmand et al. 2024, "3D Gaussian Splatting
//! as Markov Chain Monte Carlo"). A dead sample, one that is almost transparent, is of no use where it is; it is put on
//! top of a live one, drawn with probability ∝ opacity. N Gaussians then stand where one stood, and their opacity and
//! size are chosen so that the picture hardly changes: a change that training need not undo.
use crate::SplatError;

/// More copies than this on one spot count as this many: by then each is so faint that the next changes nothing.
pub const MAX_COPIES: u32 = 51;
/// Opacities are kept this far from 0 and 1, where the formulas lose all digits.
const OPACITY_MARGIN: f64 = 1e-7;

/// Opacity, and factor on the standard deviations, of each of `copies` Gaussians that together replace one of `opacity`.
///
/// `[eq:relocation]` o' = 1 − (1 − o)^(1/N), so that the centre composites to the same opacity, and
/// σ'/σ = o / Σ_{k=1..N} C(N, k)·(−1)^(k−1)·o'^k/√k, so that the composited profile along any line through the centre,
/// 1 − (1 − o'·e^(−x²/2σ'²))^N, has the integral of o·e^(−x²/2σ²). (The published double sum over i and k
/// is this one, by Σ_i C(i−1, k) = C(N, k+1).)
pub fn relocated(opacity: f32, copies: u32) -> (f32, f32) {
    let n = copies.clamp(1, MAX_COPIES);
    if n == 1 {
        return (opacity, 1.0);
    }
    let o = f64::from(opacity).clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
    // 1 − (1 − o)^(1/N) without cancellation.
    let each = -libm::expm1(libm::log1p(-o) / f64::from(n));
    let (mut sum, mut term) = (0.0, -1.0);
    for k in 1..=n {
        term *= -each * f64::from(n - k + 1) / f64::from(k);
        sum += term / f64::from(k).sqrt();
    }
    (each as f32, (o / sum) as f32)
}

/// Who moves where.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Relocation {
    /// For each Gaussian of the new set the one of the old set whose parameters it takes: itself if it is alive. The
    /// first are the old ones in order, then those that were added.
    pub sources: Vec<u32>,
    /// For each Gaussian of the old set how many of the new set stand in its place: 0 for the dead, 1 where nothing
    /// came, more where [`relocated`] applies to all of them.
    pub copies: Vec<u32>,
    /// Number of dead Gaussians that moved.
    pub moved: usize,
    /// Number of Gaussians that were added.
    pub added: usize,
}

/// Moves every Gaussian of opacity `dead` or less onto a live one drawn with probability ∝ opacity, and adds as many as
/// are missing to `grow_to`, drawn the same way. `uniform` gives numbers in [0, 1); one is taken per Gaussian that moves
/// or is added, in order. Without a live Gaussian nothing moves.
///
/// # Errors
/// An opacity outside [0, 1].
pub fn relocate(
    opacities: &[f32],
    dead: f32,
    grow_to: usize,
    uniform: &mut dyn FnMut() -> f64,
) -> Result<Relocation, SplatError> {
    if let Some(index) = opacities.iter().position(|o| !(0.0..=1.0).contains(o)) {
        let found = opacities[index];
        return Err(SplatError::Range { what: "relocate, opacities", index, expected: "[0, 1]", found });
    }
    let n = opacities.len();
    let alive = |i: usize| opacities[i] > dead;
    // Cumulative weights in f64, so that a draw is a binary search and the same on every machine.
    let mut cumulative = Vec::with_capacity(n);
    let mut total = 0.0f64;
    for (i, &o) in opacities.iter().enumerate() {
        total += if alive(i) { f64::from(o) } else { 0.0 };
        cumulative.push(total);
    }
    let mut out = Relocation { sources: (0..n as u32).collect(), copies: vec![1; n], ..Default::default() };
    if total <= 0.0 {
        return Ok(out);
    }
    let last_alive = (0..n).rev().find(|&i| alive(i)).unwrap_or(0);
    let mut draw = || {
        let target = uniform() * total;
        cumulative.partition_point(|&c| c <= target).min(last_alive)
    };
    for i in (0..n).filter(|&i| !alive(i)) {
        let source = draw();
        out.sources[i] = source as u32;
        out.copies[i] = 0;
        out.copies[source] += 1;
        out.moved += 1;
    }
    for _ in n..grow_to {
        let source = draw();
        out.sources.push(source as u32);
        out.copies[source] += 1;
        out.added += 1;
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The published double sum, as it stands: σ'²/σ² = o² / (Σ_i Σ_k C(i−1, k) (−1)^k o'^(k+1)/√(k+1))².
    fn published(opacity: f64, n: u32) -> (f64, f64) {
        let each = 1.0 - (1.0 - opacity).powf(1.0 / f64::from(n));
        let binomial = |n: u32, k: u32| (0..k).fold(1.0, |c, j| c * f64::from(n - j) / f64::from(j + 1));
        let mut sum = 0.0;
        for i in 1..=n {
            for k in 0..i {
                let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
                sum += binomial(i - 1, k) * sign * each.powi(k as i32 + 1) / f64::from(k + 1).sqrt();
            }
        }
        (each, (opacity * opacity / (sum * sum)).sqrt())
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 128, failure_persistence: None, ..ProptestConfig::default() })]

        /// [eq:relocation]: the formula against its published form, and against what it is for: by quadrature the
        /// composite of N copies has the peak and the integral of the original, and its profile is near.
        #[test]
        fn copies_composite_to_the_original(opacity in 0.006f32..0.999, copies in 1u32..=MAX_COPIES) {
            let (each, ratio) = relocated(opacity, copies);
            let o = f64::from(opacity);
            let (each64, ratio64) = published(o, copies);
            prop_assert!((f64::from(each) - each64).abs() < 1e-5 * each64, "{each} {each64}");
            prop_assert!((f64::from(ratio) - ratio64).abs() < 1e-5 * ratio64, "{ratio} {ratio64}");
            let composite = |x: f64| {
                1.0 - (1.0 - f64::from(each) * (-0.5 * (x / f64::from(ratio)).powi(2)).exp()).powi(copies as i32)
            };
            let original = |x: f64| o * (-0.5 * x * x).exp();
            let (step, reach) = (0.01, 16.0);
            let steps = (reach / step) as i32;
            let sum = |f: &dyn Fn(f64) -> f64| (-steps..=steps).map(|i| f(f64::from(i) * step) * step).sum::<f64>();
            prop_assert!((composite(0.0) - o).abs() < 1e-5);
            let (a, b) = (sum(&composite), sum(&original));
            prop_assert!((a - b).abs() < 1e-5 * b, "{a} {b}");
            let difference = sum(&|x| (composite(x) - original(x)).abs()) / b;
            // Only very opaque Gaussians get flanks that are noticeably steeper.
            prop_assert!(difference < 0.02 + 0.35 * o.powi(4), "{difference}");
        }

        /// Nobody is lost, the dead stand on the living, and counts are what they say.
        #[test]
        fn relocations_are_consistent(
            opacities in prop::collection::vec(prop_oneof![Just(0.0f32), 0.0f32..0.01, 0.0f32..1.0], 0..60),
            grow in 0usize..90,
            seed in 1u64..1000,
        ) {
            let mut state = seed;
            let mut uniform = || {
                state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                (state >> 11) as f64 / (1u64 << 53) as f64
            };
            let plan = relocate(&opacities, 0.005, grow, &mut uniform).unwrap();
            let dead = opacities.iter().filter(|o| **o <= 0.005).count();
            if dead == opacities.len() {
                prop_assert_eq!((plan.moved, plan.added, plan.sources.len()), (0, 0, opacities.len()));
                return Ok(());
            }
            prop_assert_eq!(plan.moved, dead);
            prop_assert_eq!(plan.sources.len(), opacities.len().max(grow));
            for (i, &s) in plan.sources.iter().enumerate() {
                prop_assert!(opacities[s as usize] > 0.005);
                prop_assert!(i >= opacities.len() || opacities[i] <= 0.005 || s as usize == i);
            }
            for (i, &n) in plan.copies.iter().enumerate() {
                prop_assert_eq!(n as usize, plan.sources.iter().filter(|&&s| s as usize == i).count());
            }
        }
    }

    #[test]
    fn draws_follow_the_opacities_and_extremes_stay_finite() {
        let opacities = [0.9f32, 0.0, 0.3, 0.6];
        let mut state = 0u64;
        let mut uniform = || {
            state += 1;
            (state as f64 * 0.618_033_988_749_895).fract()
        };
        let plan = relocate(&opacities, 0.005, 18_004, &mut uniform).unwrap();
        for (i, share) in [(0, 0.5), (2, 1.0 / 6.0), (3, 1.0 / 3.0)] {
            let found = f64::from(plan.copies[i] - 1) / 18_001.0;
            assert!((found - share).abs() < 0.002, "{i}: {found}");
        }
        for opacity in [0.0, 1e-30, 0.5, 1.0] {
            for copies in [0, 1, 2, 50, 51, 52, u32::MAX] {
                let (o, ratio) = relocated(opacity, copies);
                assert!(
                    (0.0..=1.0).contains(&o) && ratio.is_finite() && ratio > 0.0,
                    "{opacity} {copies}: {o} {ratio}"
                );
            }
        }
        assert!(relocate(&[0.5, f32::NAN], 0.005, 2, &mut || 0.0).is_err());
        assert_eq!(relocate(&[0.0; 3], 0.005, 5, &mut || 0.0).unwrap().sources, [0, 1, 2]);
    }
}
