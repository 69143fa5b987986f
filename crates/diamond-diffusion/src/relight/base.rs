//! What is known of a view under two lights before any network looks at it: pictures by shading, or by whoever knows the medium.
use super::hints::RelightView;
use crate::error::{DiffusionError, Result};
use diamond_image::Image;
use glam::Vec3;

/// Pictures of a view that somebody predicts: under the source picture's light and under the target's. Linear, divided by the lights' intensities as
/// the source picture is, of the view's size.
#[derive(Debug, Clone, PartialEq)]
pub struct Prediction {
    /// Under the light of the source picture.
    pub source: Image,
    /// Under the target light.
    pub target: Image,
}

/// A light to relight a view to, and what is predicted for it.
#[derive(Debug, Clone, PartialEq)]
pub struct RelightTarget {
    /// Position in the world.
    pub light: Vec3,
    /// The prediction of a physical model, where there is one; shading stands in otherwise.
    pub prediction: Option<Prediction>,
}

impl RelightTarget {
    /// A light for which nothing is predicted.
    pub fn lit(light: Vec3) -> Self {
        Self { light, prediction: None }
    }
}

/// What the network corrects: its ratios are over these pictures.
#[derive(Debug, Clone, PartialEq)]
pub struct Base {
    /// The pictures.
    pub prediction: Prediction,
    /// Whether a physical model made them, and not shading.
    pub physical: bool,
}

impl Base {
    /// The target's prediction, or [`shading`].
    ///
    /// # Errors
    /// A prediction of another size than the view's, or one that is not finite.
    pub fn of(view: &RelightView, target: &RelightTarget) -> Result<Self> {
        let Some(prediction) = &target.prediction else {
            return Ok(Self { prediction: shading(view, target.light), physical: false });
        };
        for (what, image) in [("prediction of the source", &prediction.source), ("prediction", &prediction.target)] {
            if image.shape() != view.source.shape() {
                return Err(DiffusionError::shape(what, view.source.shape(), image.shape()));
            }
            if let Some((x, y, _)) = image.first_non_finite() {
                return Err(DiffusionError::NonFinite { what: format!("{what}, pixel ({x}, {y})") });
            }
        }
        Ok(Self { prediction: prediction.clone(), physical: true })
    }

    /// The same at another size, by means over areas.
    pub(super) fn resized(&self, width: usize, height: usize) -> Result<Self> {
        let resize = |image: &Image| {
            image
                .resize_area(width, height)
                .map_err(|e| DiffusionError::shape("resized prediction", "at least 1 × 1", e))
        };
        let prediction =
            Prediction { source: resize(&self.prediction.source)?, target: resize(&self.prediction.target)? };
        Ok(Self { prediction, physical: self.physical })
    }
}

/// Functions of n·l that shading is a sum of.
const BASES: usize = 3;

/// Share of a pixel that the object must cover for the pixel to say something about its shading.
const COVERED: f32 = 0.5;

/// n·l where it is positive; ((1 + n·l)/2)², light that goes around; and 1, light that comes from everywhere.
/// `[eq:shading-bases]`
fn bases(cosine: f32) -> [f64; BASES] {
    let around = 0.5 * (1.0 + f64::from(cosine));
    [f64::from(cosine.max(0.0)), around * around, 1.0]
}

/// The best shading of the source picture, applied to the target light: per channel a·max(n·l, 0) + b·((1 + n·l)/2)² + c with the factors that fit the
/// source picture best, none negative, times coverage. Where the source's light is unknown both pictures are the source.
pub fn shading(view: &RelightView, target: Vec3) -> Prediction {
    let Some(light) = view.source_light else {
        return Prediction { source: view.source.clone(), target: view.source.clone() };
    };
    let (width, height, _) = view.source.shape();
    let cosine = |i: usize, light: Vec3| {
        let point = view.point(i % width, i / width)?;
        Some(Vec3::from_slice(view.normals.pixel(i % width, i / width)).dot((light - point).normalize_or_zero()))
    };
    let (mut matrix, mut right) = ([[0.0; BASES]; BASES], [[0.0; BASES]; 3]);
    for i in (0..width * height).filter(|i| view.coverage.data()[*i] >= COVERED) {
        let Some(values) = cosine(i, light).map(bases) else { continue };
        for (j, a) in values.iter().enumerate() {
            for (k, b) in values.iter().enumerate() {
                matrix[j][k] += a * b;
            }
            for (c, right) in right.iter_mut().enumerate() {
                right[j] += a * f64::from(view.source.data()[3 * i + c]);
            }
        }
    }
    let factors = right.map(|right| nonnegative(&matrix, &right));
    let picture = |light: Vec3| {
        let mut image = Image::new(width, height, 3);
        for i in 0..width * height {
            // A covered pixel without a known shape has the light that comes from everywhere.
            let values = cosine(i, light).map_or([0.0, 0.0, 1.0], bases);
            let coverage = view.coverage.data()[i];
            for (c, factors) in factors.iter().enumerate() {
                let sum: f64 = factors.iter().zip(values).map(|(f, v)| f * v).sum();
                image.data_mut()[3 * i + c] = coverage * sum as f32;
            }
        }
        image
    };
    Prediction { source: picture(light), target: picture(target) }
}

/// Added to the diagonal, relative to it, so that equal bases share what they explain.
const RIDGE: f64 = 1e-9;

/// The x ≥ 0 with the least xᵀAx − 2bᵀx, by trying which entries are zero.
fn nonnegative(matrix: &[[f64; BASES]; BASES], right: &[f64; BASES]) -> [f64; BASES] {
    let (mut best, mut least) = ([0.0; BASES], 0.0);
    for chosen in 1..1usize << BASES {
        let among: Vec<usize> = (0..BASES).filter(|i| chosen >> i & 1 == 1).collect();
        let Some(part) = solve(matrix, right, &among) else { continue };
        if part.iter().any(|x| *x < 0.0) {
            continue;
        }
        let mut x = [0.0; BASES];
        among.iter().zip(&part).for_each(|(i, value)| x[*i] = *value);
        let squares: f64 = (0..BASES).map(|i| (0..BASES).map(|j| x[i] * matrix[i][j] * x[j]).sum::<f64>()).sum();
        let value = squares - 2.0 * x.iter().zip(right).map(|(x, b)| x * b).sum::<f64>();
        if value < least {
            (best, least) = (x, value);
        }
    }
    best
}

/// Gauss' elimination of the chosen rows and columns; the matrix has a positive diagonal after the ridge, or there is nothing to solve.
fn solve(matrix: &[[f64; BASES]; BASES], right: &[f64; BASES], among: &[usize]) -> Option<Vec<f64>> {
    let n = among.len();
    let mut rows: Vec<Vec<f64>> = among
        .iter()
        .map(|i| {
            let mut row: Vec<f64> = among.iter().map(|j| matrix[*i][*j]).collect();
            row.push(right[*i]);
            row
        })
        .collect();
    for (k, i) in among.iter().enumerate() {
        rows[k][k] += RIDGE * matrix[*i][*i];
    }
    for k in 0..n {
        let (done, rest) = rows.split_at_mut(k + 1);
        let pivot = &done[k];
        if pivot[k] <= 0.0 || pivot[k].is_nan() {
            return None;
        }
        for row in rest {
            let factor = row[k] / pivot[k];
            row.iter_mut().zip(pivot).skip(k).for_each(|(to, from)| *to -= factor * from);
        }
    }
    let mut x = vec![0.0; n];
    for k in (0..n).rev() {
        let known: f64 = (k + 1..n).map(|j| rows[k][j] * x[j]).sum();
        x[k] = (rows[k][n] - known) / rows[k][k];
    }
    x.iter().all(|x| x.is_finite()).then_some(x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn factors_are_the_best_that_are_not_negative() {
        let rows: Vec<[f64; 3]> = (0..40).map(|i| bases(-1.0 + i as f32 / 20.0)).collect();
        let normal = |values: &dyn Fn(&[f64; 3]) -> f64| {
            let (mut matrix, mut right) = ([[0.0; 3]; 3], [0.0; 3]);
            for row in &rows {
                for j in 0..3 {
                    (0..3).for_each(|k| matrix[j][k] += row[j] * row[k]);
                    right[j] += row[j] * values(row);
                }
            }
            (matrix, right)
        };
        let (matrix, right) = normal(&|r| 0.7 * r[0] + 0.2 * r[1] + 0.05);
        let found = nonnegative(&matrix, &right);
        for (found, expected) in found.iter().zip([0.7, 0.2, 0.05]) {
            assert!((found - expected).abs() < 1e-5, "{found} {expected}");
        }
        // A negative factor would be best: it becomes none, and no neighbour that is not negative is better.
        let (matrix, right) = normal(&|r| 0.7 * r[0] - 0.3 * r[1] + 0.1);
        let found = nonnegative(&matrix, &right);
        assert!(found.iter().all(|x| *x >= 0.0) && found[1] == 0.0, "{found:?}");
        let error = |x: &[f64; 3]| -> f64 {
            let of = |r: &[f64; 3]| 0.7 * r[0] - 0.3 * r[1] + 0.1 - r.iter().zip(x).map(|(r, x)| r * x).sum::<f64>();
            rows.iter().map(|r| of(r) * of(r)).sum()
        };
        for i in 0..3 {
            for step in [-1e-3, 1e-3] {
                let mut near = found;
                near[i] += step;
                assert!(near[i] < 0.0 || error(&near) >= error(&found), "{i} {step}");
            }
        }
        assert_eq!(nonnegative(&[[0.0; 3]; 3], &[0.0; 3]), [0.0; 3]);
    }
}
