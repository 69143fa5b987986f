//! Gaussians, features and cotangents as the words of device arrays, and gradients back from them.
use crate::frame::GaussianGrad;
use crate::shape::{Column, Shape};
use diamond_image::Image;
use diamond_splat::{Gaussians, GaussiansGrad, LowerFactor};
use glam::{Vec2, Vec3, Vec4};

/// Means with opacities, and the two halves of the covariances' forms.
pub(crate) fn gaussians(g: &Gaussians) -> [Vec<u32>; 3] {
    let mut out = [const { Vec::new() }; 3];
    for i in 0..g.len() {
        let (mean, opacity) = (g.means[i], g.opacities[i]);
        let (a, b) = match g.factors.get(i) {
            Some(LowerFactor([xx, yx, yy, zx, zy, zz])) => ([*xx, *yx, *yy, *zx], [*zy, *zz, 0.0, 0.0]),
            None => (g.rotations[i].to_array(), g.scales[i].extend(0.0).to_array()),
        };
        for (to, from) in out.iter_mut().zip([mean.extend(opacity).to_array(), a, b]) {
            to.extend(from.map(f32::to_bits));
        }
    }
    out
}

/// Rows of `channels` numbers as pieces of groups of four channels, filled up with zeros.
pub(crate) fn pieces(shape: &Shape, column: Column, rows: &[f32]) -> Vec<u32> {
    let mut out = vec![0u32; shape.words(column) as usize];
    let channels = shape.channels;
    if channels == 0 {
        return out;
    }
    let width = 4 * shape.quads;
    for (i, row) in rows.chunks_exact(channels).enumerate() {
        for (piece, part) in row.chunks(width).enumerate() {
            let first = shape.first(column, piece) as usize + i * width;
            out[first..first + part.len()].copy_from_slice(bytemuck::cast_slice(part));
        }
    }
    out
}

/// The reverse of [`pieces`].
pub(crate) fn rows(shape: &Shape, column: Column, words: &[u32], n: usize) -> Vec<f32> {
    let channels = shape.channels;
    let mut out = vec![0.0; n * channels];
    if channels == 0 {
        return out;
    }
    let width = 4 * shape.quads;
    for (i, row) in out.chunks_exact_mut(channels).enumerate() {
        for (piece, part) in row.chunks_mut(width).enumerate() {
            let first = shape.first(column, piece) as usize + i * width;
            part.copy_from_slice(bytemuck::cast_slice(&words[first..first + part.len()]));
        }
    }
    out
}

/// Cotangents of opacity and depth side by side.
pub(crate) fn d_coverage(opacity: &Image, depth: &Image) -> Vec<u32> {
    opacity.data().iter().zip(depth.data()).flat_map(|(o, d)| [o.to_bits(), d.to_bits()]).collect()
}

/// Gradients of screen positions where the gradient of the Gaussians holds them.
pub(crate) fn d_screen(screen: &[Vec2]) -> Vec<u32> {
    let row = |d: &Vec2| GaussianGrad { screen: [d.x, d.y, 0.0, 0.0], ..Default::default() };
    bytemuck::pod_collect_to_vec(&screen.iter().map(row).collect::<Vec<_>>())
}

/// Gradients as the CPU gives them, and those of screen positions.
pub(crate) fn gradient(words: &[u32], n: usize, factors: bool) -> (GaussiansGrad, Vec<Vec2>) {
    let all: Vec<GaussianGrad> = bytemuck::pod_collect_to_vec(words);
    let mut g = GaussiansGrad::zeros(n);
    let mut screen = vec![Vec2::ZERO; n];
    if factors {
        g.factors = vec![LowerFactor::default(); n];
    }
    for (i, from) in all.iter().take(n).enumerate() {
        let [x, y, z, opacity] = from.mean;
        g.means[i] = Vec3::new(x, y, z);
        g.opacities[i] = opacity;
        screen[i] = Vec2::new(from.screen[0], from.screen[1]);
        let [a, b] = [from.form_a, from.form_b];
        if factors {
            g.factors[i] = LowerFactor([a[0], a[1], a[2], a[3], b[0], b[1]]);
        } else {
            g.rotations[i] = Vec4::from_array(a);
            g.scales[i] = Vec3::new(b[0], b[1], b[2]);
        }
    }
    (g, screen)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_and_rows_are_each_other_s_reverse() {
        for channels in [0, 1, 3, 4, 16, 17, 37] {
            let n = 7;
            let shape = Shape::new(n as u64, [5, 3], channels, 10, 1 << 27).unwrap();
            let data: Vec<f32> = (0..n * channels).map(|v| v as f32).collect();
            let words = pieces(&shape, Column::Features, &data);
            assert_eq!(words.len() as u64, shape.words(Column::Features));
            assert_eq!(rows(&shape, Column::Features, &words, n), data);
        }
    }
}
