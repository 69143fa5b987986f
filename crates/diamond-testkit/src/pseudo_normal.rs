//! Naive normals of a depth map: back-project all, difference with a Sobel kernel written out, cross, normalise.
use crate::Real;
use crate::ggx::{dot, normalise};

/// Row-major three-channel normals in world axes, zero where there is none. `pinhole` is `[fx, fy, cx, cy]`, `rotation` the
/// rows of the rotation from world to camera; `covered` says which pixels are surface; `depth` is view-space z.
pub fn pseudo_normals<R: Real>(
    pinhole: [f64; 4],
    rotation: [[f64; 3]; 3],
    width: usize,
    height: usize,
    covered: &[bool],
    depth: &[R],
) -> Vec<R> {
    let [fx, fy, cx, cy] = pinhole;
    let point = |x: usize, y: usize| -> [R; 3] {
        let z = depth[y * width + x];
        [z * R::of((x as f64 + 0.5 - cx) / fx), z * R::of((y as f64 + 0.5 - cy) / fy), z]
    };
    let mut out = vec![R::of(0.0); 3 * width * height];
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            if !(0..9).all(|k| covered[(y + k / 3 - 1) * width + x + k % 3 - 1]) {
                continue;
            }
            let sum = |plus: [(usize, usize); 3], minus: [(usize, usize); 3]| -> [R; 3] {
                let mut s = [R::of(0.0); 3];
                for ((p, m), w) in plus.into_iter().zip(minus).zip([0.125, 0.25, 0.125]) {
                    let (p, m) = (point(p.0, p.1), point(m.0, m.1));
                    for c in 0..3 {
                        s[c] += (p[c] - m[c]) * R::of(w);
                    }
                }
                s
            };
            let a = sum([(x + 1, y - 1), (x + 1, y), (x + 1, y + 1)], [(x - 1, y - 1), (x - 1, y), (x - 1, y + 1)]);
            let b = sum([(x - 1, y + 1), (x, y + 1), (x + 1, y + 1)], [(x - 1, y - 1), (x, y - 1), (x + 1, y - 1)]);
            let cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
            if dot(cross, point(x, y)).value() <= 0.0 {
                continue;
            }
            let n = normalise(cross.map(|c| -c));
            for w in 0..3 {
                let mut s = R::of(0.0);
                for c in 0..3 {
                    s += n[c] * R::of(rotation[c][w]);
                }
                out[3 * (y * width + x) + w] = s;
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wall_ahead_looks_back() {
        let eye = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let n = pseudo_normals([2.0, 2.0, 1.5, 1.5], eye, 3, 3, &[true; 9], &[4.0; 9]);
        assert_eq!(&n[12..15], &[0.0, 0.0, -1.0]);
    }
}
