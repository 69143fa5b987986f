//! Oracle of Gaussian splatting: every pixel looks at every Gaussian, in f64, nearest first, with nothing culled but what
//! the compositing rule culls. The screen covariance is the 3D covariance carried through the Jacobian, and its inverse
//! is a plain 2 × 2 inverse.
use crate::Real;

/// A pinhole camera: `p_camera = rotation · p + translation`.
#[derive(Debug, Clone)]
pub struct SplatCamera {
    /// World → camera, rows.
    pub rotation: [[f64; 3]; 3],
    /// World → camera.
    pub translation: [f64; 3],
    /// Focal lengths, px.
    pub focal: [f64; 2],
    /// Principal point, px.
    pub centre: [f64; 2],
    /// Width and height, px.
    pub size: [usize; 2],
}

/// The compositing rule.
#[derive(Debug, Clone)]
pub struct SplatRules {
    /// Variance added on screen, px².
    pub low_pass: f64,
    /// Upper bound of alpha.
    pub max_alpha: f64,
    /// Alphas below are skipped.
    pub min_alpha: f64,
    /// A pixel stops before its transmittance falls to this.
    pub min_transmittance: f64,
    /// Gaussians at this z or nearer are culled.
    pub near: f64,
    /// Alpha is multiplied by the smoothstep of `(a − min_alpha)/min_alpha`, and pixels never stop.
    pub smooth: bool,
}

/// Numbers per Gaussian in `parameters`: mean 3, scale 3, quaternion x y z w, opacity, then features.
pub const SPLAT_PARAMETERS: usize = 11;

/// The projected mean, conic (xx, xy, yy) and z of the Gaussian with these parameters; `None` where it is culled
/// `[eq:ewa-projection]`.
pub fn project_splat<R: Real>(g: &[R], camera: &SplatCamera, rules: &SplatRules) -> Option<([R; 2], [R; 3], R)> {
    let of = R::of;
    let norm = (g[6] * g[6] + g[7] * g[7] + g[8] * g[8] + g[9] * g[9]).sqrt();
    let [x, y, zq, w] = [g[6] / norm, g[7] / norm, g[8] / norm, g[9] / norm];
    let (one, two) = (of(1.0), of(2.0));
    let q = [
        [one - two * (y * y + zq * zq), two * (x * y - w * zq), two * (x * zq + w * y)],
        [two * (x * y + w * zq), one - two * (x * x + zq * zq), two * (y * zq - w * x)],
        [two * (x * zq - w * y), two * (y * zq + w * x), one - two * (x * x + y * y)],
    ];
    // World covariance, then camera covariance.
    let sum = |f: &dyn Fn(usize) -> R| f(0) + f(1) + f(2);
    let world = |r: usize, c: usize| sum(&|k| q[r][k] * g[3 + k] * g[3 + k] * q[c][k]);
    let world = std::array::from_fn(|r| std::array::from_fn(|c| world(r, c)));
    project_covariance(&g[..3], &world, camera, rules)
}

/// As [`project_splat`], for a Gaussian that is given by its mean and world covariance `[eq:lower-factor]`.
pub fn project_covariance<R: Real>(
    mean: &[R],
    world: &[[R; 3]; 3],
    camera: &SplatCamera,
    rules: &SplatRules,
) -> Option<([R; 2], [R; 3], R)> {
    let of = R::of;
    let p: Vec<R> = (0..3)
        .map(|r| (0..3).fold(of(camera.translation[r]), |sum, c| sum + of(camera.rotation[r][c]) * mean[c]))
        .collect();
    let z = p[2];
    if z.value() <= rules.near {
        return None;
    }
    let sum = |f: &dyn Fn(usize) -> R| f(0) + f(1) + f(2);
    let view =
        |r: usize, c: usize| sum(&|i| sum(&|j| of(camera.rotation[r][i]) * world[i][j] * of(camera.rotation[c][j])));
    // The Jacobian of the perspective map, with the tangent clamped to 15 % of the image beyond its border.
    let jacobian: Vec<[R; 3]> = (0..2)
        .map(|a| {
            let (f, c, side) = (camera.focal[a], camera.centre[a], camera.size[a] as f64);
            let margin = 0.15 * side / f;
            let tangent = (p[a] / z).max(of(-c / f - margin)).min(of((side - c) / f + margin));
            let mut row = [of(0.0); 3];
            row[a] = of(f) / z;
            row[2] = -(of(f) * tangent / z);
            row
        })
        .collect();
    let screen = |a: usize, b: usize| sum(&|r| sum(&|c| jacobian[a][r] * view(r, c) * jacobian[b][c]));
    let (xx, xy, yy) = (screen(0, 0) + of(rules.low_pass), screen(0, 1), screen(1, 1) + of(rules.low_pass));
    let det = xx * yy - xy * xy;
    let mean = [0, 1].map(|a: usize| of(camera.focal[a]) * p[a] / z + of(camera.centre[a]));
    Some((mean, [yy / det, -xy / det, xx / det], z))
}

/// Alpha at an offset from the projected mean `[eq:splat-alpha]`; zero where the rule skips it.
pub fn splat_alpha<R: Real>(conic: &[R; 3], opacity: R, offset: [R; 2], rules: &SplatRules) -> R {
    let of = R::of;
    let [dx, dy] = offset;
    let sigma = of(0.5) * (conic[0] * dx * dx + conic[2] * dy * dy) + conic[1] * dx * dy;
    let a = opacity * (-sigma).exp();
    if a.value() < rules.min_alpha {
        return of(0.0);
    }
    let clamped = a.min(of(rules.max_alpha));
    if !rules.smooth {
        return clamped;
    }
    let t = ((a - of(rules.min_alpha)) / of(rules.min_alpha)).min(of(1.0));
    clamped * t * t * (of(3.0) - of(2.0) * t)
}

/// One projected Gaussian: its index, screen mean (px), conic (1/px²) and view-space z.
pub type ProjectedSplat<R> = (usize, [R; 2], [R; 3], R);

/// The Gaussians of `parameters` (`stride` numbers each) that are in front of the camera, nearest first.
pub fn sorted_splats<R: Real>(
    parameters: &[R],
    stride: usize,
    camera: &SplatCamera,
    rules: &SplatRules,
) -> Vec<ProjectedSplat<R>> {
    let mut splats: Vec<_> = parameters
        .chunks_exact(stride)
        .enumerate()
        .filter_map(|(i, g)| project_splat(g, camera, rules).map(|(mean, conic, z)| (i, mean, conic, z)))
        .collect();
    // Stable, so that ties stay in the order of their indices.
    splats.sort_by(|a, b| a.3.value().total_cmp(&b.3.value()));
    splats
}

/// Features, opacity and depth of the pixel whose centre is at `centre` (px) `[eq:splat-blend]`.
pub fn splat_pixel<'a, R: Real + 'a>(
    splats: impl IntoIterator<Item = &'a ProjectedSplat<R>>,
    parameters: &[R],
    channels: usize,
    centre: [f64; 2],
    rules: &SplatRules,
) -> Vec<R> {
    let of = R::of;
    let stride = SPLAT_PARAMETERS + channels;
    let mut pixel = vec![of(0.0); channels + 2];
    let mut transmittance = of(1.0);
    for (i, mean, conic, z) in splats {
        let g = &parameters[i * stride..(i + 1) * stride];
        let offset = [of(centre[0]) - mean[0], of(centre[1]) - mean[1]];
        let alpha = splat_alpha(conic, g[10], offset, rules);
        if alpha.value() <= 0.0 {
            continue;
        }
        let next = transmittance * (of(1.0) - alpha);
        if !rules.smooth && next.value() <= rules.min_transmittance {
            break;
        }
        let weight = transmittance * alpha;
        for c in 0..channels {
            pixel[c] += weight * g[SPLAT_PARAMETERS + c];
        }
        pixel[channels] += weight;
        pixel[channels + 1] += weight * *z;
        transmittance = next;
    }
    pixel
}

/// Renders `n` Gaussians of `SPLAT_PARAMETERS + channels` numbers each; gives, per pixel, the features, then the opacity,
/// then the depth `[eq:splat-blend]`.
pub fn rasterize_splats<R: Real>(
    parameters: &[R],
    channels: usize,
    camera: &SplatCamera,
    rules: &SplatRules,
) -> Vec<R> {
    let splats = sorted_splats(parameters, SPLAT_PARAMETERS + channels, camera, rules);
    let mut out = Vec::with_capacity(camera.size[0] * camera.size[1] * (channels + 2));
    for y in 0..camera.size[1] {
        for x in 0..camera.size[0] {
            out.extend(splat_pixel(&splats, parameters, channels, [x as f64 + 0.5, y as f64 + 0.5], rules));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_round_gaussian_in_the_middle() {
        let camera = SplatCamera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            focal: [10.0; 2],
            centre: [2.5; 2],
            size: [5, 5],
        };
        let rules = SplatRules {
            low_pass: 0.3,
            max_alpha: 0.99,
            min_alpha: 1.0 / 255.0,
            min_transmittance: 1e-4,
            near: 0.2,
            smooth: false,
        };
        // Standard deviation 0.1 at z = 1 is one pixel: variance 1.3 with the low-pass.
        let g = [0.0, 0.0, 1.0, 0.1, 0.1, 0.1, 0.0, 0.0, 0.0, 2.0, 0.5, 7.0];
        let image = rasterize_splats(&g, 1, &camera, &rules);
        let at = |x: usize, y: usize| &image[(y * 5 + x) * 3..][..3];
        assert!((at(2, 2)[1] - 0.5).abs() < 1e-12 && (at(2, 2)[0] - 3.5).abs() < 1e-12);
        assert!((at(3, 2)[1] - 0.5 * (-0.5f64 / 1.3).exp()).abs() < 1e-12);
        assert!((at(3, 2)[2] - at(3, 2)[1]).abs() < 1e-12, "depth is Σ w z with z = 1");
    }
}
