//! Scale and shift of a depth that was estimated from a single picture.
//!
//! An estimator that sees one picture cannot know how large the world is. Its depth, or more often its inverse depth, is
//! right up to a factor and an offset, and these two are fitted to what is known at some pixels.
use crate::error::expect_map;
use crate::select::SplitMix;
use crate::{ConsistencyError, DepthKind, DepthMap};
use diamond_image::Image;

/// What an estimator's numbers are, up to scale and shift.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum EstimateForm {
    /// Depth.
    Depth,
    /// One over depth.
    #[default]
    InverseDepth,
}

/// How strongly pixels that do not fit may pull.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum AlignmentFit {
    /// Least squares.
    LeastSquares,
    /// Reweighted least squares with Tukey's biweight at 4.685 times the deviation that the median residual stands for, from
    /// the line of least median residual: wrong pixels have no say as long as they are less than half.
    #[default]
    Robust,
}

/// Depth = scale·estimate + shift, or its inverse.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Alignment {
    /// What the estimate is multiplied by.
    pub scale: f64,
    /// What is added.
    pub shift: f64,
    /// Pixels that were compared.
    pub count: usize,
    /// Median of |aligned − reference| over the reference, in the space of the fit.
    pub residual: f64,
}

/// Rounds of reweighting: the weights settle in five or so.
const ROUNDS: usize = 20;
/// Tukey's constant for 95 % efficiency on normal noise.
const TUKEY: f64 = 4.685;
/// From the median of |r| to a standard deviation, for normal noise.
const MEDIAN_TO_DEVIATION: f64 = 1.4826;

/// `[eq:depth-alignment]` Aligns `estimate` (one channel) to `reference` by the scale and shift that fit best where both are
/// known, weighted by `weight` where it is given (a silhouette, or what is trusted): the aligned map, of the reference's
/// kind, and how it was aligned. Pixels where the aligned depth is not above 0 become unknown (0).
///
/// The reference may be rendered or sparse: zero, negative, infinite and NaN values mean unknown, in the estimate only
/// infinite and NaN ones do.
///
/// # Errors
/// Other sizes; fewer than two pixels to compare; an estimate that does not vary where it is compared.
pub fn align_depth(
    estimate: &Image,
    form: EstimateForm,
    reference: &DepthMap,
    weight: Option<&Image>,
    fit: AlignmentFit,
) -> Result<(DepthMap, Alignment), ConsistencyError> {
    let size = (reference.values.width(), reference.values.height());
    expect_map(&reference.values, size, "reference depth")?;
    expect_map(estimate, size, "estimated depth")?;
    if let Some(weight) = weight {
        expect_map(weight, size, "weight of the alignment")?;
    }
    let target = |depth: f64| match form {
        EstimateForm::Depth => depth,
        EstimateForm::InverseDepth => 1.0 / depth,
    };
    let mut points = Vec::new();
    for (i, (&e, &d)) in estimate.data().iter().zip(reference.values.data()).enumerate() {
        let w = weight.map_or(1.0, |w| f64::from(w.data()[i]));
        if e.is_finite() && d.is_finite() && d > 0.0 && w.is_finite() && w > 0.0 {
            points.push([f64::from(e), target(f64::from(d)), w]);
        }
    }
    let mut line = weighted_line(&points, |_| 1.0)?;
    let mut residuals = Vec::with_capacity(points.len());
    let mut median = |line: [f64; 2], relative: bool| {
        residuals.clear();
        residuals
            .extend(points.iter().map(|[e, t, _]| (line[0] * e + line[1] - t).abs() / if relative { *t } else { 1.0 }));
        let middle = residuals.len() / 2;
        *residuals.select_nth_unstable_by(middle, f64::total_cmp).1
    };
    if fit == AlignmentFit::Robust {
        line = first_line(&points).unwrap_or(line);
        for _ in 0..ROUNDS {
            let cut = TUKEY * MEDIAN_TO_DEVIATION * median(line, false);
            if cut <= 0.0 {
                break;
            }
            let biweight = |[e, t, _]: &[f64; 3]| {
                let r = (line[0] * e + line[1] - t) / cut;
                if r.abs() < 1.0 { (1.0 - r * r) * (1.0 - r * r) } else { 0.0 }
            };
            match weighted_line(&points, biweight) {
                Ok(next) => line = next,
                Err(_) => break,
            }
        }
    }
    let residual = median(line, true);
    let aligned = estimate.map(|e| {
        let v = line[0] * f64::from(e) + line[1];
        let depth = match form {
            EstimateForm::Depth => v,
            EstimateForm::InverseDepth => 1.0 / v,
        } as f32;
        if depth.is_finite() && depth > 0.0 { depth } else { 0.0 }
    });
    let alignment = Alignment { scale: line[0], shift: line[1], count: points.len(), residual };
    Ok((DepthMap { kind: reference.kind, values: aligned }, alignment))
}

/// Scale and shift by least squares.
fn weighted_line(points: &[[f64; 3]], factor: impl Fn(&[f64; 3]) -> f64) -> Result<[f64; 2], ConsistencyError> {
    let fail = |reason: String| Err(ConsistencyError::Alignment { reason });
    if points.len() < 2 {
        return fail(format!(
            "expected at least 2 pixels where estimate and reference are known, found {}; give a reference that overlaps",
            points.len()
        ));
    }
    let (mut weight, mut mean) = (0.0, [0.0; 2]);
    for p in points {
        let w = p[2] * factor(p);
        weight += w;
        mean[0] += w * p[0];
        mean[1] += w * p[1];
    }
    let mean = mean.map(|m| m / weight);
    let (mut variance, mut covariance) = (0.0, 0.0);
    for p in points {
        let (w, e) = (p[2] * factor(p), p[0] - mean[0]);
        variance += w * e * e;
        covariance += w * e * (p[1] - mean[1]);
    }
    // Below this the estimate is constant to the precision that it is stored in.
    let least = weight * (1e-7 * mean[0]).powi(2);
    if !(variance > least && variance.is_finite() && covariance.is_finite()) {
        return fail(
            "the estimate does not vary where it is compared, so that scale and shift cannot be told apart; compare more \
             of the picture"
                .into(),
        );
    }
    let scale = covariance / variance;
    Ok([scale, mean[1] - scale * mean[0]])
}

/// Lines through two points that are tried for a start, and points that they are judged by. With a third of the points
/// wrong, 256 pairs miss a good one with a probability of 10⁻⁶⁵.
const TRIES: usize = 256;
const JUDGES: usize = 512;

/// A first line that outliers do not move: of lines through two points each the one with the least median residual.
fn first_line(points: &[[f64; 3]]) -> Option<[f64; 2]> {
    let judges: Vec<&[f64; 3]> = points.iter().step_by(points.len().div_ceil(JUDGES).max(1)).collect();
    let mut random = SplitMix(0);
    let mut residuals = Vec::with_capacity(judges.len());
    let mut best: Option<(f64, [f64; 2])> = None;
    for _ in 0..TRIES {
        let [a, b] = [points[random.below(points.len())], points[random.below(points.len())]];
        let scale = (b[1] - a[1]) / (b[0] - a[0]);
        if !scale.is_finite() {
            continue;
        }
        let shift = a[1] - scale * a[0];
        residuals.clear();
        residuals.extend(judges.iter().map(|[e, t, _]| (scale * e + shift - t).abs()));
        let middle = residuals.len() / 2;
        let median = *residuals.select_nth_unstable_by(middle, f64::total_cmp).1;
        if best.is_none_or(|(least, _)| median < least) {
            best = Some((median, [scale, shift]));
        }
    }
    best.map(|(_, line)| line)
}

/// A constant map of unknown depth, for references that are filled in where they are known.
impl DepthMap {
    /// A map of which nothing is known yet.
    pub fn unknown(kind: DepthKind, width: usize, height: usize) -> Self {
        Self { kind, values: Image::new(width, height, 1) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Depths from 2 to 3.5 in some disorder.
    fn reference() -> DepthMap {
        let values = (0..400).map(|i| 2.0 + 1.5 * ((i as f32 * 0.618_034).fract())).collect();
        DepthMap { kind: DepthKind::Z, values: Image::from_vec(20, 20, 1, values).unwrap() }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// [eq:depth-alignment]: whatever scale and shift were taken off come back, by either fit, in either form.
        #[test]
        fn scale_and_shift_come_back(scale in 0.2f32..5.0, shift in -0.05f32..0.5) {
            let reference = reference();
            for (form, fit) in [
                (EstimateForm::Depth, AlignmentFit::LeastSquares),
                (EstimateForm::InverseDepth, AlignmentFit::LeastSquares),
                (EstimateForm::Depth, AlignmentFit::Robust),
                (EstimateForm::InverseDepth, AlignmentFit::Robust),
            ] {
                let estimate = reference.values.map(|d| {
                    let t = if form == EstimateForm::Depth { d } else { 1.0 / d };
                    (t - shift) / scale
                });
                let (aligned, how) = align_depth(&estimate, form, &reference, None, fit).unwrap();
                for (a, b) in aligned.values.data().iter().zip(reference.values.data()) {
                    prop_assert!((a - b).abs() <= 2e-5 * b, "{form:?} {fit:?}: {a} {b}");
                }
                prop_assert!((how.scale - f64::from(scale)).abs() <= 1e-4 * f64::from(scale) && how.count == 400);
            }
        }
    }

    /// A third of the pixels wrong, as where the estimator takes the background for the object.
    #[test]
    fn the_robust_fit_ignores_what_is_wrong_and_the_other_does_not() {
        let reference = reference();
        let mut estimate = reference.values.map(|d| (d - 0.3) / 2.0);
        estimate.data_mut().iter_mut().step_by(3).for_each(|v| *v += 3.0);
        let scale = |fit| align_depth(&estimate, EstimateForm::Depth, &reference, None, fit).unwrap().1.scale;
        assert!((scale(AlignmentFit::Robust) - 2.0).abs() < 1e-5, "{}", scale(AlignmentFit::Robust));
        assert!((scale(AlignmentFit::LeastSquares) - 2.0).abs() > 0.5);
        // Known beforehand, they may be left out instead.
        let mut weight = Image::filled(20, 20, 1, 1.0);
        weight.data_mut().iter_mut().step_by(3).for_each(|v| *v = 0.0);
        let (_, how) =
            align_depth(&estimate, EstimateForm::Depth, &reference, Some(&weight), AlignmentFit::LeastSquares).unwrap();
        assert!((how.scale - 2.0).abs() < 1e-5 && how.count == 266);
    }

    #[test]
    fn what_cannot_be_aligned_is_said() {
        let reference = reference();
        let estimate = Image::filled(20, 20, 1, 0.7);
        let align = |estimate: &Image, reference: &DepthMap| {
            align_depth(estimate, EstimateForm::Depth, reference, None, AlignmentFit::Robust)
        };
        assert!(align(&estimate, &reference).unwrap_err().to_string().contains("does not vary"));
        let mut sparse = DepthMap::unknown(DepthKind::Z, 20, 20);
        assert!(align(&reference.values, &sparse).unwrap_err().to_string().contains("at least 2 pixels"));
        sparse.values.data_mut()[3] = 2.5;
        sparse.values.data_mut()[77] = 3.0;
        sparse.values.data_mut()[99] = f32::NAN;
        assert_eq!(align(&reference.values, &sparse).unwrap().1.count, 2);
        assert!(matches!(align(&Image::new(4, 4, 1), &reference), Err(ConsistencyError::Shape { .. })));
        // Where the fitted depth is negative nothing is known.
        let mut far = reference.values.clone();
        far.data_mut()[0] = -100.0;
        assert_eq!(align(&far, &reference).unwrap().0.values.data()[0], 0.0);
    }
}
