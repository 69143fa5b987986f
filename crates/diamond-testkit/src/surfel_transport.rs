//! Oracles of light through a translucent surface: profiles, irradiance of surfels, and the plain double sum over them.
use crate::Real;
use crate::light::point_incidence;
use std::f64::consts::PI;

/// exp(−r²/2σ²)/(2πσ²).
pub fn plane_gaussian<R: Real>(radius_squared: R, width: R) -> R {
    let s2 = width * width;
    (-(radius_squared / (R::of(2.0) * s2))).exp() / (R::of(2.0 * PI) * s2)
}

/// Σ_k w_k·[`plane_gaussian`].
pub fn profile<R: Real>(widths: &[R], weights: &[R], radius_squared: R) -> R {
    let each = widths.iter().zip(weights);
    each.fold(R::of(0.0), |sum, (s, w)| sum + *w * plane_gaussian(radius_squared, *s))
}

/// A·(e^(−r/d) + e^(−r/3d))/(8π·d·r), d = ℓ/(1.9 − A + 3.5·(A − 0.8)²).
pub fn normalized_diffusion<R: Real>(albedo: R, mean_free_path: R, radius: R) -> R {
    let a = albedo - R::of(0.8);
    let d = mean_free_path / (R::of(1.9) - albedo + R::of(3.5) * a * a);
    albedo * ((-(radius / d)).exp() + (-(radius / (R::of(3.0) * d))).exp()) / (R::of(8.0 * PI) * d * radius)
}

/// Visibility · max(0, n·l) · (1 − F(n·l)) · irradiance of a point light (intensity 1, `reference` as in [`point_incidence`]), with
/// Schlick's F for `f0`, or F = 0 without one.
pub fn irradiance<R: Real>(
    light: [R; 3],
    reference: Option<R>,
    f0: Option<f64>,
    position: [R; 3],
    normal: [R; 3],
    visibility: R,
) -> R {
    let i = point_incidence(light, [R::of(1.0); 3], position, reference);
    let cosine = normal[0] * i[0] + normal[1] * i[1] + normal[2] * i[2];
    if cosine.value() <= 0.0 {
        return R::of(0.0);
    }
    let passes = match f0 {
        None => R::of(1.0),
        Some(f0) => R::of(1.0) - (R::of(f0) + R::of(1.0 - f0) * (R::of(1.0) - cosine).powf(5.0)),
    };
    visibility * cosine * passes * i[4]
}

/// Σ_j G_k(|x_i − x_j|)·a_j·e_j for each receiver and column: `values` holds `columns` values per source.
pub fn gaussian_sum<R: Real>(
    width: f64,
    receivers: &[[f64; 3]],
    sources: &[[f64; 3]],
    areas: &[f64],
    values: &[R],
    columns: usize,
) -> Vec<R> {
    let mut out = vec![R::of(0.0); receivers.len() * columns];
    for (i, x) in receivers.iter().enumerate() {
        for (j, y) in sources.iter().enumerate() {
            let r2: f64 = (0..3).map(|c| (x[c] - y[c]) * (x[c] - y[c])).sum();
            let g = plane_gaussian(r2, width) * areas[j];
            for c in 0..columns {
                out[i * columns + c] += R::of(g) * values[j * columns + c];
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn profiles_integrate_to_their_reflectance() {
        let (mut gaussian, mut diffusion, step) = (0.0, 0.0, 1e-3);
        for i in 0..20_000 {
            let r = (f64::from(i) + 0.5) * step;
            gaussian += 2.0 * PI * r * step * profile(&[0.3, 1.0], &[0.2, 0.5], r * r);
            diffusion += 2.0 * PI * r * step * normalized_diffusion(0.6, 0.5, r);
        }
        assert!((gaussian - 0.7).abs() < 1e-6 && (diffusion - 0.6).abs() < 1e-5, "{gaussian} {diffusion}");
    }

    #[test]
    fn light_from_behind_does_not_enter() {
        let at = |z: f64| irradiance([0.0, 0.0, z], Some(2.0), Some(0.04), [0.0; 3], [0.0, 0.0, 1.0], 0.5);
        assert_eq!(at(-2.0), 0.0);
        assert!((at(2.0) - 0.48).abs() < 1e-12);
    }
}
