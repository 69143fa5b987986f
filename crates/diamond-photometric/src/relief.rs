//! Reliefs: an inflated silhouette, and the relief whose normals come nearest to given ones.
//!
//! Both are linear systems on the object's pixels, solved by successive over-relaxation in reading order, so that the bits
//! do not depend on threads.
use crate::object_pixels::{NONE, ObjectPixels};
use glam::Vec3;

/// Sweeps of over-relaxation at most.
const SWEEPS: usize = 600;
/// Sweeps stop when no value changes by more than this share of the largest.
const SETTLED: f32 = 1e-5;
/// Normals that turn away from the camera by more than this cosine are integrated as if they had it: a slope of 4.
const LEAST_FACING: f32 = 0.25;
/// Least weight of an edge, so that no part of the object floats.
const LEAST_WEIGHT: f32 = 0.0025;

/// Solves dᵢ·uᵢ = bᵢ + Σ w·u(neighbour) by over-relaxation, starting from `u`. `weight(i, side)` is 0 where there is no
/// neighbour.
fn relax(
    pixels: &ObjectPixels,
    u: &mut [f32],
    diagonal: &[f32],
    right_side: &[f32],
    weight: impl Fn(usize, usize) -> f32,
    factor: f32,
) {
    for _ in 0..SWEEPS {
        let (mut change, mut largest) = (0f32, 0f32);
        for i in 0..u.len() {
            let mut sum = right_side[i];
            for (side, &j) in pixels.neighbours[i].iter().enumerate() {
                if j != NONE {
                    sum += weight(i, side) * u[j as usize];
                }
            }
            let step = factor * (sum / diagonal[i] - u[i]);
            u[i] += step;
            change = change.max(step.abs());
            largest = largest.max(u[i].abs());
        }
        if change <= SETTLED * largest {
            break;
        }
    }
}

/// `[eq:inflated-silhouette]` The relief √u with Δu = −4 inside the silhouette and u = 0 outside, pixels: the half-sphere
/// over a disc, something round over any silhouette, upright at the outline.
pub(crate) fn inflated(pixels: &ObjectPixels) -> Vec<f32> {
    let n = pixels.len();
    let mut u = vec![0.0; n];
    // Optimal for a disc as wide as the object's area says.
    let width = 2.0 * (n as f32 / std::f32::consts::PI).sqrt();
    let factor = 2.0 / (1.0 + libm::sinf(std::f32::consts::PI / (width + 2.0)));
    relax(pixels, &mut u, &vec![4.0; n], &vec![4.0; n], |_, _| 1.0, factor);
    u.iter().map(|u| u.max(0.0).sqrt()).collect()
}

/// `[eq:relief-from-normals]` The relief h that minimises Σ w·(h_j − h_i − g_ij)² + λ·Σ (h_i − h⁰_i)², over the edges between
/// neighbours, where g is the mean slope that the normals at both ends ask for, and w the smaller squared cosine between
/// normal and ray, so that steps at outlines within the object may tear. Starts from `anchor` = h⁰.
pub(crate) fn integrated(pixels: &ObjectPixels, normals: &[Vec3], anchor: &[f32], anchoring: f32) -> Vec<f32> {
    let n = pixels.len();
    let mut slopes = Vec::with_capacity(n);
    let mut weights = Vec::with_capacity(n);
    for (normal, frame) in normals.iter().zip(&pixels.frames) {
        let local = frame.local(*normal);
        let z = local.z.max(LEAST_FACING);
        slopes.push([-local.x / z * pixels.aspect.x, -local.y / z * pixels.aspect.y]);
        weights.push((local.z * local.z).max(LEAST_WEIGHT));
    }
    let weight = |i: usize, side: usize| {
        let j = pixels.neighbours[i][side];
        if j == NONE { 0.0 } else { weights[i].min(weights[j as usize]) }
    };
    let mut diagonal = vec![anchoring; n];
    let mut right_side: Vec<f32> = anchor.iter().map(|h| anchoring * h).collect();
    for i in 0..n {
        for side in 0..4 {
            let j = pixels.neighbours[i][side];
            if j != NONE {
                let w = weight(i, side);
                let axis = side / 2;
                let g = 0.5 * (slopes[i][axis] + slopes[j as usize][axis]);
                // h_i should be h_j − g to the left of j, h_j + g to its right.
                right_side[i] += if side % 2 == 1 { -w * g } else { w * g };
                diagonal[i] += w;
            }
        }
        // A pixel without neighbours keeps its relief.
        if diagonal[i] <= 0.0 {
            (diagonal[i], right_side[i]) = (1.0, anchor[i]);
        }
    }
    let mut h = anchor.to_vec();
    relax(pixels, &mut h, &diagonal, &right_side, weight, 1.8);
    h
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes;

    /// [eq:inflated-silhouette]: a half-sphere over a disc.
    #[test]
    fn a_disc_inflates_to_half_a_sphere() {
        let sphere = scenes::Ellipsoid::sphere(96);
        let pixels = ObjectPixels::of(&sphere.camera, &sphere.mask());
        let h = inflated(&pixels);
        let radius = (pixels.len() as f32 / std::f32::consts::PI).sqrt();
        let top = h.iter().fold(0f32, |a, b| a.max(*b));
        assert!((top - radius).abs() < 0.02 * radius, "{top} {radius}");
        let mut errors: Vec<f32> = pixels
            .relief_normals(&h)
            .iter()
            .zip(&pixels.rays)
            .map(|(n, r)| n.angle_between(sphere.hit(*r).unwrap().1).to_degrees())
            .collect();
        errors.sort_by(f32::total_cmp);
        assert!(errors[errors.len() / 2] < 2.5, "{}", errors[errors.len() / 2]);
    }

    /// [eq:relief-from-normals]: true normals give back the surface they came from, up to an offset, from a poor start.
    #[test]
    fn true_normals_give_back_the_surface() {
        let scene = scenes::Ellipsoid::tilted(96);
        let pixels = ObjectPixels::of(&scene.camera, &scene.mask());
        let truth: Vec<f32> =
            pixels.rays.iter().map(|r| -libm::logf(scene.hit(*r).unwrap().0 / 3.0) / pixels.angle).collect();
        let normals: Vec<Vec3> = pixels.rays.iter().map(|r| scene.hit(*r).unwrap().1).collect();
        let flat = vec![0.0; pixels.len()];
        let h = integrated(&pixels, &normals, &flat, 1e-5);
        let inner: Vec<usize> = (0..pixels.len()).filter(|&i| pixels.frames[i].local(normals[i]).z > 0.4).collect();
        let offset = inner.iter().map(|&i| h[i] - truth[i]).sum::<f32>() / inner.len() as f32;
        let extent = truth.iter().fold(f32::MIN, |a, b| a.max(*b)) - truth.iter().fold(f32::MAX, |a, b| a.min(*b));
        let worst = inner.iter().map(|&i| (h[i] - truth[i] - offset).abs()).fold(0f32, f32::max);
        assert!(worst < 0.06 * extent, "{worst} px of {extent} px");
    }
}
