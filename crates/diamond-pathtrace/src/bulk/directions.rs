//! How light at a point of the surface depends on direction: a few functions of the direction relative to the normal, and the least
//! squares that fit them to walks.
//!
//! Directions are unit and point outward. They are carried from one normal to another by the shortest turn, so that a direction keeps
//! its angle to the normal: towards outlines everything depends on that.
use crate::Frame;
use glam::{Quat, Vec3};

/// Functions for light that leaves an index-matched object, a full hemisphere. The last four are optional.
pub(crate) const HEMISPHERE: usize = 9;

/// Functions for light behind a refracting boundary, where only a cone is seen.
pub(crate) const CONE: usize = 4;

/// Mean μ over the hemisphere, weighted by the cosine.
pub(crate) const HEMISPHERE_MEAN: f32 = 2.0 / 3.0;

/// A direction relative to a frame: 1, μ − m, t₁, t₂, μ² − ½, t₁² − t₂², t₁t₂, μt₁, μt₂ with μ = cos of the angle to the normal, at least 0,
/// and its mean m over the directions in question: all but the first are 0 in the mean.
/// `[eq:direction-fit]`
#[inline]
pub(crate) fn basis<const N: usize>(local: Vec3, mean: f32) -> [f32; N] {
    let (x, y, mu) = (local.x, local.y, local.z.max(0.0));
    let all = [1.0, mu - mean, x, y, mu * mu - 0.5, x * x - y * y, x * y, mu * x, mu * y];
    std::array::from_fn(|k| all[k])
}

/// `direction` at a place with the unit normal `from`, in the frame of another place.
#[inline]
pub(crate) fn carried(direction: Vec3, from: Vec3, frame: Frame) -> Vec3 {
    if from == frame.z {
        return frame.to_local(direction);
    }
    frame.to_local(Quat::from_rotation_arc(from, frame.z) * direction)
}

/// Matrix that takes coefficients that belong to the frame `from` to those of the same function, carried, in the frame `to`.
pub(crate) fn turned<const N: usize>(from: Frame, to: Frame) -> [[f32; N]; N] {
    let axis = carried(to.x, to.z, from);
    let (cos, sin) = (axis.x, axis.y);
    let (cos2, sin2) = (cos * cos - sin * sin, 2.0 * cos * sin);
    let mut matrix = [[0.0; N]; N];
    for (k, row) in matrix.iter_mut().enumerate() {
        match k {
            2 | 7 if k + 1 < N => (row[k], row[k + 1]) = (cos, sin),
            3 | 8 => (row[k - 1], row[k]) = (-sin, cos),
            5 if k + 1 < N => (row[k], row[k + 1]) = (cos2, 0.5 * sin2),
            6 => (row[k - 1], row[k]) = (-2.0 * sin2, cos2),
            _ => row[k] = 1.0,
        }
    }
    matrix
}

/// Sums of products of the functions over the directions of walks.
#[derive(Debug, Clone)]
pub(crate) struct Moments<const N: usize> {
    sums: [[f64; N]; N],
}

/// What is added to the diagonal of normal equations, relative to it.
const RIDGE: f64 = 1e-5;

impl<const N: usize> Moments<N> {
    pub fn new() -> Self {
        Self { sums: [[0.0; N]; N] }
    }

    /// One more direction.
    #[inline]
    pub fn add(&mut self, values: &[f32; N], weight: f64) {
        for i in 0..N {
            for j in 0..=i {
                self.sums[i][j] += weight * f64::from(values[i] * values[j]);
            }
        }
    }

    /// The inverse of the matrix of sums, through its Cholesky factor. Functions that no direction has distinguished get none of
    /// the result.
    pub fn inverse(&self) -> [[f32; N]; N] {
        let mut l = [[0.0f64; N]; N];
        for i in 0..N {
            for j in 0..=i {
                let dot: f64 = (0..j).map(|k| l[i][k] * l[j][k]).sum();
                let rest = self.sums[i][j] - dot;
                if i == j {
                    l[i][i] = (rest + RIDGE * self.sums[i][i]).max(0.0).sqrt();
                } else {
                    l[i][j] = if l[j][j] > 0.0 { rest / l[j][j] } else { 0.0 };
                }
            }
        }
        let mut inverse = [[0.0f32; N]; N];
        for column in 0..N {
            let mut x = [0.0f64; N];
            for i in 0..N {
                let dot: f64 = (0..i).map(|k| l[i][k] * x[k]).sum();
                x[i] = if l[i][i] > 0.0 { (f64::from(u8::from(i == column)) - dot) / l[i][i] } else { 0.0 };
            }
            for i in (0..N).rev() {
                let dot: f64 = (i + 1..N).map(|k| l[k][i] * x[k]).sum();
                x[i] = if l[i][i] > 0.0 { (x[i] - dot) / l[i][i] } else { 0.0 };
            }
            (0..N).for_each(|i| inverse[i][column] = x[i] as f32);
        }
        inverse
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Rng, sampling::cosine_hemisphere};

    /// `[eq:direction-fit]`: what is made of the functions is found again, also behind a turn of the normal.
    #[test]
    fn least_squares_find_the_coefficients() {
        let mut rng = Rng::new(4, 4);
        let truth: [f32; HEMISPHERE] = [1.0, 0.5, -0.2, 0.3, 0.7, 0.1, -0.4, 0.2, 0.6];
        let mut moments = Moments::<HEMISPHERE>::new();
        let mut right = [0.0f32; HEMISPHERE];
        for _ in 0..2000 {
            let b = basis::<HEMISPHERE>(cosine_hemisphere(&mut rng), HEMISPHERE_MEAN);
            let value: f32 = (0..HEMISPHERE).map(|k| b[k] * truth[k]).sum();
            moments.add(&b, 1.0);
            (0..HEMISPHERE).for_each(|k| right[k] += b[k] * value);
        }
        let inverse = moments.inverse();
        for i in 0..HEMISPHERE {
            let found: f32 = (0..HEMISPHERE).map(|k| inverse[i][k] * right[k]).sum();
            assert!((found - truth[i]).abs() < 0.01, "{i}: {found} {}", truth[i]);
        }
        let (a, b) = (Vec3::new(0.2, 0.3, 0.9).normalize(), Vec3::new(-0.1, 0.4, 0.8).normalize());
        let direction = Vec3::new(0.7, 0.1, 0.3).normalize();
        assert!((carried(direction, a, Frame::new(b)).z - a.dot(direction)).abs() < 1e-6);
        // Another frame around the same normal.
        let (from, to) = (Frame::new(a), Frame { x: Frame::new(a).y, y: -Frame::new(a).x, z: a });
        let matrix = turned::<HEMISPHERE>(from, to);
        let value = |c: &[f32; HEMISPHERE], frame: Frame| -> f32 {
            let b = basis::<HEMISPHERE>(frame.to_local(direction), HEMISPHERE_MEAN);
            b.iter().zip(c).map(|(b, c)| b * c).sum()
        };
        let moved = std::array::from_fn(|i| (0..HEMISPHERE).map(|j| matrix[i][j] * truth[j]).sum());
        assert!((value(&truth, from) - value(&moved, to)).abs() < 1e-5);
        let oblique = Frame { x: 0.6 * from.x + 0.8 * from.y, y: 0.6 * from.y - 0.8 * from.x, z: a };
        let matrix = turned::<HEMISPHERE>(from, oblique);
        let moved = std::array::from_fn(|i| (0..HEMISPHERE).map(|j| matrix[i][j] * truth[j]).sum());
        assert!((value(&truth, from) - value(&moved, oblique)).abs() < 1e-5);
    }
}
