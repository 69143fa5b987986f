//! Normal and albedo of one pixel from its brightness under several lights.
//!
//! Brightness over irradiance is ρ·f(n·ω): albedo times the response to the cosine. For any normal the best albedo is known in
//! closed form, so that two unknowns are left, the normal's two directions; they are found by Gauss–Newton steps
//! on the sphere, first with all lights alike, then with each light's say falling with its residual, so that shadows and
//! highlights lose theirs.
use crate::response::lambert;
use glam::{Mat3, Vec3};

/// Steps with all lights alike, and as many with robust weights.
const STEPS: usize = 12;
/// Longest step, radians: the response bends.
const LONGEST_STEP: f32 = 0.4;
/// Least Σ f²: a normal that no light reaches has no albedo.
const LEAST_RESPONSE: f32 = 1e-4;
/// Least albedo that residuals are divided by.
const LEAST_ALBEDO: f32 = 1e-6;
/// A residual of this many times the root of the median square has half its say.
const ROBUST_WIDTH: f32 = 1.5;
/// Added to that: residuals relative to the albedo below this are noise, not outliers.
const ROBUST_FLOOR: f32 = 0.03;
/// What is too bright is down-weighted as if its residual were this share: light from neighbours makes most places too
/// bright under lights that they do not face, and those lights are right in being dim.
const TOO_BRIGHT: f32 = 0.5;

/// What one pixel shows: unit directions to the lights, brightness over irradiance, and how much each light is believed.
pub(crate) struct Shown<'a> {
    /// Unit directions from the surface to the lights.
    pub directions: &'a [Vec3],
    /// Brightness over irradiance, of the order of 1.
    pub brightness: &'a [f32],
    /// Trust in each, in [0, 1].
    pub trust: &'a [f32],
}

/// What the fit found at a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Fitted {
    /// Unit normal, world.
    pub normal: Vec3,
    /// Root of the mean weighted square of the residuals over the albedo.
    pub residual: f32,
    /// Information that the lights hold about the normal's less certain direction, per light: the smaller eigenvalue of the
    /// weighted Fisher matrix on the tangent plane, for a residual of 1.
    pub information: f32,
}

/// Median of `values`, whose order is lost; 0 of none.
pub(crate) fn median(values: &mut [f32]) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

/// `[eq:robust-normal]` Minimises Σ ω·(I − ρ·f(n·l))²/ρ² + pull·‖n − n⁰‖² over the unit normal n and ρ, from `start`; ω are
/// Cauchy's weights of the residuals in the second half of the steps. `pull` is in units of one light's information.
pub(crate) fn fit_normal(shown: &Shown<'_>, start: Vec3, prior: Vec3, pull: f32) -> Fitted {
    let lights = shown.directions.len();
    let share = 1.0 / lights as f32;
    let mut weights = shown.trust.to_vec();
    let mut squares = vec![0.0; lights];
    let mut responses = vec![(0.0, 0.0); lights];
    let mut n = start;
    let mut out = Fitted::default();
    for step in 0..=2 * STEPS {
        let (mut ff, mut fi) = (0f32, 0f32);
        for l in 0..lights {
            responses[l] = lambert(n.dot(shown.directions[l]));
            ff += weights[l] * responses[l].0 * responses[l].0;
            fi += weights[l] * responses[l].0 * shown.brightness[l];
        }
        let ff = ff.max(LEAST_RESPONSE);
        let albedo = (fi / ff).max(LEAST_ALBEDO);
        let residual = |l: usize, responses: &[(f32, f32)]| {
            ((shown.brightness[l] - albedo * responses[l].0) / albedo).clamp(-1e6, 1e6)
        };
        if step >= STEPS {
            for l in 0..lights {
                let r = residual(l, &responses);
                squares[l] = r * r;
            }
            let width = ROBUST_WIDTH * median(&mut squares).sqrt() + ROBUST_FLOOR;
            for l in 0..lights {
                let r = residual(l, &responses);
                let r = if r > 0.0 { TOO_BRIGHT * r } else { r } / width;
                weights[l] = shown.trust[l] / (1.0 + r * r);
            }
        }
        // Rows of the Jacobian on the tangent plane, less what a change of albedo does as well.
        let mut along = Vec3::ZERO;
        for l in 0..lights {
            let row = shown.directions[l] * responses[l].1;
            along += (row - n * row.dot(n)) * (weights[l] * responses[l].0);
        }
        along /= ff;
        let mut matrix = Mat3::ZERO;
        let mut gradient = Vec3::ZERO;
        let mut weighted = 0.0;
        for l in 0..lights {
            let row = shown.directions[l] * responses[l].1;
            let row = row - n * row.dot(n) - along * responses[l].0;
            let r = residual(l, &responses);
            let w = weights[l] * share;
            matrix += Mat3::from_cols(row * (row.x * w), row * (row.y * w), row * (row.z * w));
            gradient += row * (r * w);
            weighted += w * r * r;
        }
        if step == 2 * STEPS {
            out = Fitted { normal: n, residual: weighted.sqrt(), information: smaller_eigenvalue(&matrix) };
            break;
        }
        let prior_weight = pull * share;
        gradient += (prior - n) * prior_weight;
        let matrix = matrix + Mat3::from_diagonal(Vec3::splat(prior_weight + 1e-9));
        let mut change = matrix.inverse() * gradient;
        if !change.is_finite() {
            break;
        }
        change = change.clamp_length_max(LONGEST_STEP);
        n = (n + change).try_normalize().unwrap_or(n);
        out.normal = n;
    }
    out
}

/// The middle eigenvalue of a matrix that has 0 as one: the smaller on the tangent plane.
fn smaller_eigenvalue(m: &Mat3) -> f32 {
    let trace = m.x_axis.x + m.y_axis.y + m.z_axis.z;
    let minors = (m.x_axis.x * m.y_axis.y - m.x_axis.y * m.y_axis.x)
        + (m.x_axis.x * m.z_axis.z - m.x_axis.z * m.z_axis.x)
        + (m.y_axis.y * m.z_axis.z - m.y_axis.z * m.z_axis.y);
    // Roots of λ² − trace·λ + minors.
    (0.5 * (trace - (trace * trace - 4.0 * minors).max(0.0).sqrt())).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::strategies::unit_vector;
    use proptest::prelude::*;

    fn dome() -> Vec<Vec3> {
        (0..9)
            .map(|k| {
                let (s, c) = (k as f32 * 2.4).sin_cos();
                Vec3::new(0.7 * s, 0.7 * c, if k == 0 { 3.0 } else { 0.6 }).normalize()
            })
            .collect()
    }

    fn shine(n: Vec3, directions: &[Vec3], albedo: f32) -> Vec<f32> {
        directions.iter().map(|l| albedo * lambert(n.dot(*l)).0).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// [eq:robust-normal]: what was put in comes out, from the wrong start, whatever the albedo.
        #[test]
        fn the_normal_comes_back(n in unit_vector(), albedo in 0.1f32..2.0) {
            let n = Vec3::new(n[0], n[1], n[2].abs() + 0.6).normalize();
            let directions = dome();
            let brightness = shine(n, &directions, albedo);
            let shown = Shown { directions: &directions, brightness: &brightness, trust: &[1.0; 9] };
            let found = fit_normal(&shown, Vec3::Z, Vec3::Z, 1e-6);
            prop_assert!(found.normal.angle_between(n).to_degrees() < 0.2, "{} {n}", found.normal);
            prop_assert!(found.residual < 1e-2 && found.information > 1e-3, "{found:?}");
        }

        #[test]
        fn anything_finite_gives_a_unit_normal(
            n in unit_vector(), brightness in prop::collection::vec(0.0f32..1e6, 4), trust in 0.0f32..1.0,
        ) {
            let directions = [Vec3::from(n), Vec3::from(n), -Vec3::from(n), Vec3::Z];
            let shown = Shown { directions: &directions, brightness: &brightness, trust: &[trust; 4] };
            let found = fit_normal(&shown, Vec3::Z, Vec3::from(n), 0.1);
            prop_assert!((found.normal.length() - 1.0).abs() < 1e-4);
            prop_assert!(found.residual.is_finite() && found.information.is_finite());
        }
    }

    /// One light in shadow, one with a highlight.
    #[test]
    fn outliers_lose_their_say() {
        let directions = dome();
        let n = Vec3::new(0.2, -0.1, 1.0).normalize();
        let mut brightness = shine(n, &directions, 0.8);
        brightness[2] = 0.0;
        brightness[5] = 1.6;
        let shown = Shown { directions: &directions, brightness: &brightness, trust: &[1.0; 9] };
        let robust = fit_normal(&shown, Vec3::Z, Vec3::Z, 1e-6).normal.angle_between(n).to_degrees();
        assert!(robust < 2.0, "{robust}°");
    }

    /// Without information the prior decides, and the information says so.
    #[test]
    fn lights_from_one_side_leave_the_prior() {
        let directions = [Vec3::X; 5];
        let prior = Vec3::new(0.3, 0.9, 0.4).normalize();
        let shown = Shown { directions: &directions, brightness: &[0.3; 5], trust: &[1.0; 5] };
        let found = fit_normal(&shown, prior, prior, 0.1);
        assert!(found.normal.angle_between(prior) < 1e-3 && found.information < 1e-6, "{found:?}");
    }
}
