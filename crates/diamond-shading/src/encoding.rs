//! What the subsurface residual network is told about a Gaussian under a light: one row of 42 + K numbers.
//!
//! | columns | value |
//! |---|---|
//! | 0–23 | positional encoding of the position, normalised by the scene's box to \[−1, 1\] |
//! | 24–27 | rotation quaternion, w x y z |
//! | 28–30 | scale |
//! | 31–33 | direction to the viewer |
//! | 34–36 | direction to the light |
//! | 37–39 | normal |
//! | 40 | visibility of the light |
//! | 41 | distance to the light |
//! | 42… | K values of a learned code of the Gaussian |
//!
//! The encoding is, for each k = 0…3, sin(2^k·π·x) of the three coordinates and then their cosines. It has period 2 in
//! the normalised coordinate, so the two opposite faces of the box look alike to it: leave some margin around the scene.
//! The quaternion enters as it is: q and −q are one rotation but two inputs, and fixing the sign would make the
//! network jump while the optimiser turns a Gaussian smoothly.
use crate::error::{ShadingError, check_length};
use crate::row_chunks::{map_chunks, map_chunks_mut};
use crate::simd::MAGNITUDE_LIMIT;
use diamond_simd::{Lanes, Level, Scalar, Simd, WithSimd, sin_cos_pi};
use glam::{Quat, Vec3};
use std::f32::consts::PI;

/// Frequencies of the positional encoding: 2^0·π … 2^3·π.
pub const ENCODING_FREQUENCIES: usize = 4;

/// Values of the positional encoding of a 3D position: sine and cosine per coordinate and frequency.
pub const ENCODED_POSITION: usize = 6 * ENCODING_FREQUENCIES;

/// Network inputs per row without a learned code.
pub const RESIDUAL_INPUTS: usize = ENCODED_POSITION + 18;

/// The columns that depend on the light: its direction, its visibility, its distance.
pub const LIGHT_COLUMNS: [usize; 5] = [34, 35, 36, 40, 41];

/// Half the side of a scene's box is at least this (scene units): guards the division of a flat or empty box.
const MIN_HALF_EXTENT: f32 = 1e-6;

/// References and scales are at least this before a logarithm or a division, so that gradients stay below 1e33.
const MIN_LENGTH: f32 = 1e-20;

/// A logarithmic scale is divided by this: scales from a reference down to e^−8 of it fill \[−1, 0\].
const LOG_SCALE_RANGE: f32 = 8.0;

/// Rows per parallel task.
const ROWS: usize = 512;

/// sin(2^k·π·x) and cos(2^k·π·x), k = 0…3, of a position normalised to \[−1, 1\]; any finite `x` is valid.
///
/// Order: for each k the sines of x, y, z, then their cosines. Higher frequencies by the double-angle recurrence from
/// an argument reduced exactly by the period; the error stays below 3e-6.
/// `[eq:positional-encoding]`
pub fn positional_encoding(x: Vec3) -> [f32; ENCODED_POSITION] {
    let mut sines = [[0.0; 2]; 3];
    for (sine, x) in sines.iter_mut().zip(x.to_array()) {
        let (sin, cos) = sin_cos_pi(Lanes::new(Scalar::new(), reduce(x)));
        *sine = [sin.v, cos.v];
    }
    harmonics(sines)
}

/// The sines and cosines of all frequencies of the lowest one's, per axis.
fn harmonics(sines: [[f32; 2]; 3]) -> [f32; ENCODED_POSITION] {
    let mut encoded = [0.0; ENCODED_POSITION];
    for (axis, [mut sin, mut cos]) in sines.into_iter().enumerate() {
        for k in 0..ENCODING_FREQUENCIES {
            encoded[6 * k + axis] = sin;
            encoded[6 * k + 3 + axis] = cos;
            (sin, cos) = (2.0 * sin * cos, (cos - sin) * (cos + sin));
        }
    }
    encoded
}

/// `x` less a whole number of periods: in [−1, 1].
fn reduce(x: f32) -> f32 {
    x - 2.0 * (0.5 * x).round()
}

/// sin(π·x) and cos(π·x) of many numbers.
struct Sines<'a> {
    x: &'a [f32],
    sin: &'a mut [f32],
    cos: &'a mut [f32],
}

impl WithSimd for Sines<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let w = S::F32_LANES;
        for ((x, sin), cos) in self.x.chunks(w).zip(self.sin.chunks_mut(w)).zip(self.cos.chunks_mut(w)) {
            let (sines, cosines) = match x.len() == w {
                true => sin_cos_pi(Lanes::load(s, x)),
                false => sin_cos_pi(Lanes::load_partial(s, x)),
            };
            if x.len() == w {
                sines.store(sin);
                cosines.store(cos);
            } else {
                sines.store_partial(sin);
                cosines.store_partial(cos);
            }
        }
    }
}

/// Pullback of [`positional_encoding`]: the cotangent of the normalised position.
/// `[eq:positional-encoding]`
pub fn positional_encoding_pull(x: Vec3, d_encoded: &[f32; ENCODED_POSITION]) -> Vec3 {
    let encoded = positional_encoding(x);
    let mut d_x = [0.0; 3];
    for (axis, d) in d_x.iter_mut().enumerate() {
        for k in 0..ENCODING_FREQUENCIES {
            let (s, c) = (6 * k + axis, 6 * k + 3 + axis);
            *d += PI * (1 << k) as f32 * (d_encoded[s] * encoded[c] - d_encoded[c] * encoded[s]);
        }
    }
    Vec3::from_array(d_x)
}

/// How a Gaussian's scale enters the network.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ScaleInput {
    /// As it is, in scene units. Small numbers where a scene is large against its Gaussians.
    Linear,
    /// ln(scale / reference) / 8: about \[−1, 0\] for scales up to the reference, and independent of the unit of length.
    Logarithmic {
        /// Length that maps to 0, scene units, > 0; for instance half the box's diagonal.
        reference: f32,
    },
}

/// How the distance of the light enters the network.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LightDistanceInput {
    /// As it is, in scene units; 0 for a directional light.
    Linear,
    /// (d − ℓ)/(d + ℓ), in \[−1, 1\]: 0 at the reference ℓ, and 1 for a directional light, which is the limit of a far one.
    Bounded {
        /// ℓ, scene units, > 0; best the usual distance of the capture's lights.
        reference: f32,
    },
}

/// How lengths are made dimensionless.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InputScaling {
    /// Corner of the scene's box with the smallest coordinates, world, scene units; maps to −1 in each coordinate.
    pub bounds_min: Vec3,
    /// The opposite corner; maps to 1. Positions outside are valid (the encoding is periodic).
    pub bounds_max: Vec3,
    /// Scale.
    pub scale: ScaleInput,
    /// Distance of the light.
    pub light_distance: LightDistanceInput,
}

impl InputScaling {
    /// Linear scales, and light distances bounded with the box's diagonal for a reference.
    pub fn of_bounds(bounds_min: Vec3, bounds_max: Vec3) -> Self {
        let reference = bounds_min.distance(bounds_max);
        Self {
            bounds_min,
            bounds_max,
            scale: ScaleInput::Linear,
            light_distance: LightDistanceInput::Bounded { reference },
        }
    }

    /// Centre of the box and 1 / half its sides.
    fn affine(&self) -> (Vec3, Vec3) {
        let half = (0.5 * self.bounds_max - 0.5 * self.bounds_min).max(Vec3::splat(MIN_HALF_EXTENT));
        (0.5 * self.bounds_min + 0.5 * self.bounds_max, half.recip())
    }

    fn normalise(&self, position: Vec3) -> Vec3 {
        let (centre, inverse) = self.affine();
        ((position - centre) * inverse).clamp(Vec3::splat(-MAGNITUDE_LIMIT), Vec3::splat(MAGNITUDE_LIMIT))
    }

    fn scale_input(&self, scale: f32) -> f32 {
        match self.scale {
            ScaleInput::Linear => scale,
            ScaleInput::Logarithmic { reference } => {
                (libm::logf(scale.max(MIN_LENGTH)) - libm::logf(reference.max(MIN_LENGTH))) / LOG_SCALE_RANGE
            }
        }
    }

    fn scale_slope(&self, scale: f32) -> f32 {
        match self.scale {
            ScaleInput::Linear => 1.0,
            ScaleInput::Logarithmic { .. } if scale > MIN_LENGTH => 1.0 / (LOG_SCALE_RANGE * scale),
            ScaleInput::Logarithmic { .. } => 0.0,
        }
    }

    /// [`InputScaling::distance_input`] of finite distances, none below 0.
    #[inline(always)]
    pub(crate) fn distance_input_of<S: Simd>(&self, distance: Lanes<S>) -> Lanes<S> {
        match self.light_distance {
            LightDistanceInput::Linear => distance,
            LightDistanceInput::Bounded { reference } => {
                let reference = distance.same(reference.max(MIN_LENGTH));
                distance.same(1.0) - (reference / (distance + reference)) * 2.0
            }
        }
    }

    pub(crate) fn distance_input(&self, distance: f32) -> f32 {
        match self.light_distance {
            LightDistanceInput::Linear if distance.is_finite() => distance,
            LightDistanceInput::Linear => 0.0,
            LightDistanceInput::Bounded { reference } => {
                let reference = reference.max(MIN_LENGTH);
                1.0 - 2.0 * (reference / (distance.max(0.0) + reference))
            }
        }
    }

    fn distance_slope(&self, distance: f32) -> f32 {
        match self.light_distance {
            LightDistanceInput::Linear if distance.is_finite() => 1.0,
            LightDistanceInput::Bounded { reference } if (0.0..f32::INFINITY).contains(&distance) => {
                let reference = reference.max(MIN_LENGTH);
                2.0 * (reference / (distance + reference)) / (distance + reference)
            }
            _ => 0.0,
        }
    }
}

/// The arrays a batch of network inputs is built from; all have one entry per row.
#[derive(Debug, Clone, Copy)]
pub struct ResidualInputs<'a> {
    /// World positions, scene units.
    pub positions: &'a [Vec3],
    /// Unit quaternions.
    pub rotations: &'a [Quat],
    /// Standard deviations along the Gaussian's axes, scene units, > 0.
    pub scales: &'a [Vec3],
    /// Unit directions to the viewer, world.
    pub view_directions: &'a [Vec3],
    /// Unit directions to the light, world.
    pub light_directions: &'a [Vec3],
    /// Unit normals, world.
    pub normals: &'a [Vec3],
    /// Visibility of the light in \[0, 1\].
    pub visibility: &'a [f32],
    /// Distance to the light, scene units; infinite for a directional light.
    pub light_distances: &'a [f32],
    /// Learned codes `[rows × K]`, row-major; empty for K = 0.
    pub codes: &'a [f32],
    /// K.
    pub code_size: usize,
}

/// Which inputs' gradients [`ResidualInputsPullback::pull`] computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InputGradients {
    /// Normals, visibility and codes; the other vectors stay empty.
    Learned,
    /// All.
    All,
}

/// The gradient of [`ResidualInputs`]. Directions and quaternions are treated as free vectors: pull the gradient through
/// the normalisation that made them.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ResidualInputsGrad {
    /// Per row, or empty.
    pub positions: Vec<Vec3>,
    /// Per row (components of the cotangent, not a rotation), or empty.
    pub rotations: Vec<Quat>,
    /// Per row, or empty.
    pub scales: Vec<Vec3>,
    /// Per row, or empty.
    pub view_directions: Vec<Vec3>,
    /// Per row, or empty.
    pub light_directions: Vec<Vec3>,
    /// Per row.
    pub normals: Vec<Vec3>,
    /// Per row.
    pub visibility: Vec<f32>,
    /// Per row, or empty; 0 for a directional light.
    pub light_distances: Vec<f32>,
    /// `[rows × K]`.
    pub codes: Vec<f32>,
}

/// The reverse of one [`ResidualInputs::assemble`].
#[derive(Debug)]
pub struct ResidualInputsPullback<'a> {
    inputs: ResidualInputs<'a>,
    scaling: InputScaling,
}

impl<'a> ResidualInputs<'a> {
    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.positions.len()
    }

    /// Network inputs per row: 42 + K.
    pub fn width(&self) -> usize {
        RESIDUAL_INPUTS + self.code_size
    }

    /// The matrix `[rows × (42 + K)]`, row-major, and its pullback.
    ///
    /// Errors: [`ShadingError::Shape`] if an array's length is not the number of positions (times K for codes).
    /// `[eq:residual-inputs]`
    pub fn assemble(&self, scaling: &InputScaling) -> Result<(Vec<f32>, ResidualInputsPullback<'a>), ShadingError> {
        let rows = self.rows();
        check_length("ResidualInputs::rotations", rows, self.rotations.len())?;
        check_length("ResidualInputs::scales", rows, self.scales.len())?;
        check_length("ResidualInputs::view_directions", rows, self.view_directions.len())?;
        check_length("ResidualInputs::light_directions", rows, self.light_directions.len())?;
        check_length("ResidualInputs::normals", rows, self.normals.len())?;
        check_length("ResidualInputs::visibility", rows, self.visibility.len())?;
        check_length("ResidualInputs::light_distances", rows, self.light_distances.len())?;
        check_length("ResidualInputs::codes (rows × K)", rows.saturating_mul(self.code_size), self.codes.len())?;
        let width = self.width();
        let mut matrix = vec![0.0; rows * width];
        let level = Level::current();
        map_chunks_mut(&mut matrix, ROWS * width, |chunk, matrix| {
            let first = chunk * ROWS;
            let count = matrix.len() / width;
            let mut x = [0.0; 3 * ROWS];
            for (x, position) in x.as_chunks_mut::<3>().0.iter_mut().zip(&self.positions[first..first + count]) {
                *x = scaling.normalise(*position).to_array().map(reduce);
            }
            let (mut sin, mut cos) = ([0.0; 3 * ROWS], [0.0; 3 * ROWS]);
            let n = 3 * count;
            level.dispatch(Sines { x: &x[..n], sin: &mut sin[..n], cos: &mut cos[..n] });
            for (offset, row) in matrix.chunks_exact_mut(width).enumerate() {
                let sines = std::array::from_fn(|axis| [sin[3 * offset + axis], cos[3 * offset + axis]]);
                self.write_row(first + offset, sines, scaling, row);
            }
        });
        Ok((matrix, ResidualInputsPullback { inputs: *self, scaling: *scaling }))
    }

    /// The columns [`LIGHT_COLUMNS`] of [`ResidualInputs::assemble`]'s matrix, `[rows × 5]`.
    ///
    /// Errors: [`ShadingError::Shape`] if one of the light's arrays has another length than there are positions.
    /// `[eq:residual-inputs]`
    pub fn light_columns(&self, scaling: &InputScaling) -> Result<Vec<f32>, ShadingError> {
        let rows = self.rows();
        check_length("ResidualInputs::light_directions", rows, self.light_directions.len())?;
        check_length("ResidualInputs::visibility", rows, self.visibility.len())?;
        check_length("ResidualInputs::light_distances", rows, self.light_distances.len())?;
        let mut columns = Vec::with_capacity(rows * LIGHT_COLUMNS.len());
        for i in 0..rows {
            columns.extend_from_slice(&self.light_directions[i].to_array());
            columns.extend_from_slice(&[self.visibility[i], scaling.distance_input(self.light_distances[i])]);
        }
        Ok(columns)
    }

    fn write_row(&self, i: usize, sines: [[f32; 2]; 3], scaling: &InputScaling, row: &mut [f32]) {
        let (fixed, code) = row.split_at_mut(RESIDUAL_INPUTS);
        let (encoded, rest) = fixed.split_at_mut(ENCODED_POSITION);
        encoded.copy_from_slice(&harmonics(sines));
        let q = self.rotations[i];
        rest[..4].copy_from_slice(&[q.w, q.x, q.y, q.z]);
        for (to, from) in rest[4..7].iter_mut().zip(self.scales[i].to_array()) {
            *to = scaling.scale_input(from);
        }
        self.view_directions[i].write_to_slice(&mut rest[7..]);
        self.light_directions[i].write_to_slice(&mut rest[10..]);
        self.normals[i].write_to_slice(&mut rest[13..]);
        rest[16] = self.visibility[i];
        rest[17] = scaling.distance_input(self.light_distances[i]);
        code.copy_from_slice(&self.codes[i * self.code_size..][..self.code_size]);
    }
}

impl ResidualInputsPullback<'_> {
    /// Pulls `d_inputs` `[rows × (42 + K)]` back to the arrays.
    ///
    /// Errors: [`ShadingError::Shape`] if `d_inputs` has the wrong length.
    /// `[eq:residual-inputs]`
    pub fn pull(&self, d_inputs: &[f32], wanted: InputGradients) -> Result<ResidualInputsGrad, ShadingError> {
        let (rows, width) = (self.inputs.rows(), self.inputs.width());
        check_length("d_inputs of ResidualInputsPullback::pull (rows × (42 + K))", rows * width, d_inputs.len())?;
        let vec3 = |row: &[f32], column: usize| Vec3::from_slice(&row[column..]);
        let lines = || d_inputs.chunks_exact(width);
        let mut grad = ResidualInputsGrad {
            normals: lines().map(|row| vec3(row, 37)).collect(),
            visibility: lines().map(|row| row[40]).collect(),
            codes: lines().flat_map(|row| &row[RESIDUAL_INPUTS..]).copied().collect(),
            ..Default::default()
        };
        if wanted == InputGradients::All {
            let (_, inverse) = self.scaling.affine();
            let positions = map_chunks(rows.div_ceil(ROWS), |chunk| {
                let chunk = chunk * ROWS..((chunk + 1) * ROWS).min(rows);
                let pull = |i: usize| {
                    let mut d_encoded = [0.0; ENCODED_POSITION];
                    d_encoded.copy_from_slice(&d_inputs[i * width..][..ENCODED_POSITION]);
                    positional_encoding_pull(self.scaling.normalise(self.inputs.positions[i]), &d_encoded) * inverse
                };
                chunk.map(pull).collect::<Vec<_>>()
            });
            grad.positions = positions.concat();
            grad.rotations = lines().map(|row| Quat::from_xyzw(row[25], row[26], row[27], row[24])).collect();
            let slope = |s: &Vec3| Vec3::from_array(s.to_array().map(|s| self.scaling.scale_slope(s)));
            grad.scales = lines().zip(self.inputs.scales).map(|(row, s)| vec3(row, 28) * slope(s)).collect();
            grad.view_directions = lines().map(|row| vec3(row, 31)).collect();
            grad.light_directions = lines().map(|row| vec3(row, 34)).collect();
            let distances = self.inputs.light_distances;
            grad.light_distances =
                lines().zip(distances).map(|(row, &d)| row[41] * self.scaling.distance_slope(d)).collect();
        }
        Ok(grad)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::{Dual, mlp as oracle, vjp};
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// [eq:positional-encoding]
        #[test]
        fn encoding_matches_the_oracle(x in prop::array::uniform3(-1.5f32..1.5), d in prop::collection::vec(-1.0f32..1.0, 24)) {
            let at: Vec<f64> = x.iter().map(|&v| v.into()).collect();
            let expected = oracle::positional_encoding(&at, 4);
            for (found, expected) in positional_encoding(x.into()).iter().zip(&expected) {
                prop_assert!((f64::from(*found) - expected).abs() < 3e-6, "{found} {expected}");
            }
            let cotangent: Vec<f64> = d.iter().map(|&v| v.into()).collect();
            let expected = vjp(|x: &[Dual]| oracle::positional_encoding(x, 4), &at, &cotangent);
            let found = positional_encoding_pull(x.into(), d.as_slice().try_into().unwrap());
            // Against the magnitude of the sum's terms: 24 values of up to 8π each.
            for (found, expected) in found.to_array().iter().zip(&expected) {
                prop_assert!((f64::from(*found) - expected).abs() < 1e-4 * expected.abs().max(8.0), "{found} {expected}");
            }
        }

        #[test]
        fn slopes_match_differences_of_the_formula(value in 1e-3f64..50.0, reference in 0.1f64..20.0) {
            let r = reference as f32;
            let scaling = InputScaling {
                bounds_min: Vec3::NEG_ONE,
                bounds_max: Vec3::ONE,
                scale: ScaleInput::Logarithmic { reference: r },
                light_distance: LightDistanceInput::Bounded { reference: r },
            };
            let v = value as f32;
            prop_assert!((f64::from(scaling.scale_slope(v)) * 8.0 * value - 1.0).abs() < 1e-5);
            let exact = 2.0 * reference / (value + reference).powi(2);
            prop_assert!((f64::from(scaling.distance_slope(v)) / exact - 1.0).abs() < 1e-5);
        }
    }

    #[test]
    fn far_lights_tend_to_directional_ones() {
        let scaling = InputScaling::of_bounds(Vec3::NEG_ONE, Vec3::ONE);
        assert_eq!(scaling.distance_input(f32::INFINITY), 1.0);
        assert_eq!(scaling.distance_slope(f32::INFINITY), 0.0);
        assert!((scaling.distance_input(1e8) - 1.0).abs() < 1e-6);
    }
}
