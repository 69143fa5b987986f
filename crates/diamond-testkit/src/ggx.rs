//! Naive microfacet BRDF: textbook forms, scalar by scalar, over any [`Real`].
//!
//! Directions need not have unit length: every function that takes them normalises them, so that derivatives have no
//! part along a direction.
use crate::Real;
use std::f64::consts::PI;

/// Variants of the masking term, as in the crate under test.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Masking {
    /// G₁·G₁ with Smith's Λ.
    SmithSeparable,
    /// 1/(1 + Λ + Λ).
    SmithCorrelated,
    /// Schlick with k = (r + 1)²/8.
    SchlickRoughness,
    /// Schlick with k = r²/2.
    SchlickHalfAlpha,
}

/// Variants of the Fresnel term.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fresnel {
    /// Fifth power.
    Schlick,
    /// Base-2 spherical Gaussian.
    SphericalGaussian,
}

/// Variants of the diffuse lobe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Diffuse {
    /// (1 − m)·c/π.
    Lambert,
    /// (1 − F)·0.96·(1 − m)·c/π.
    FresnelWeighted,
    /// None.
    Omitted,
}

/// A combination of the three.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Model {
    /// Masking.
    pub masking: Masking,
    /// Fresnel.
    pub fresnel: Fresnel,
    /// Diffuse.
    pub diffuse: Diffuse,
}

/// Dot product.
pub fn dot<R: Real>(a: [R; 3], b: [R; 3]) -> R {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// a/|a|.
pub fn normalise<R: Real>(a: [R; 3]) -> [R; 3] {
    let length = dot(a, a).sqrt();
    a.map(|x| x / length)
}

/// `[n·l, n·v, v·h, n·h]`.
pub fn angles<R: Real>(n: [R; 3], v: [R; 3], l: [R; 3]) -> [R; 4] {
    let (n, v, l) = (normalise(n), normalise(v), normalise(l));
    let h = normalise([v[0] + l[0], v[1] + l[1], v[2] + l[2]]);
    [dot(n, l), dot(n, v), dot(v, h), dot(n, h)]
}

/// D = α²/(π·((n·h)²(α²−1)+1)²).
pub fn distribution<R: Real>(alpha: R, cos_theta_h: R) -> R {
    let a2 = alpha * alpha;
    let t = cos_theta_h * cos_theta_h * (a2 - R::of(1.0)) + R::of(1.0);
    a2 / (R::of(PI) * t * t)
}

/// Smith's Λ of GGX: (−1 + √(1 + α²·tan²θ))/2.
fn lambda<R: Real>(alpha: R, cosine: R) -> R {
    let tan2 = (R::of(1.0) - cosine * cosine) / (cosine * cosine);
    ((R::of(1.0) + alpha * alpha * tan2).sqrt() - R::of(1.0)) * R::of(0.5)
}

/// G.
pub fn masking<R: Real>(kind: Masking, roughness: R, cos_theta_o: R, cos_theta_i: R) -> R {
    let one = R::of(1.0);
    let alpha = roughness * roughness;
    let schlick = |k: R| {
        let g1 = |c: R| c / (c * (one - k) + k);
        g1(cos_theta_o) * g1(cos_theta_i)
    };
    match kind {
        Masking::SmithSeparable => one / (one + lambda(alpha, cos_theta_o)) / (one + lambda(alpha, cos_theta_i)),
        Masking::SmithCorrelated => one / (one + lambda(alpha, cos_theta_o) + lambda(alpha, cos_theta_i)),
        Masking::SchlickRoughness => schlick((roughness + one) * (roughness + one) / R::of(8.0)),
        Masking::SchlickHalfAlpha => schlick(alpha * R::of(0.5)),
    }
}

/// F of one channel.
pub fn fresnel<R: Real>(kind: Fresnel, f0: R, cos_theta_d: R) -> R {
    let weight = match kind {
        Fresnel::Schlick => (R::of(1.0) - cos_theta_d).powf(5.0),
        Fresnel::SphericalGaussian => {
            let exponent = (R::of(-5.55473) * cos_theta_d - R::of(6.98316)) * cos_theta_d;
            (exponent * R::of(2f64.ln())).exp()
        }
    };
    f0 + (R::of(1.0) - f0) * weight
}

/// The BRDF of one colour channel from `[n·l, n·v, v·h, n·h]`, no cosine, no horizon test.
pub fn evaluate_at<R: Real>(model: Model, base: R, roughness: R, metalness: R, angles: [R; 4]) -> R {
    let one = R::of(1.0);
    let [ci, co, cd, ch] = angles;
    let f0 = R::of(0.04) * (one - metalness) + base * metalness;
    let f = fresnel(model.fresnel, f0, cd);
    let g = masking(model.masking, roughness, co, ci);
    let d = distribution(roughness * roughness, ch);
    let specular = d * g * f / (R::of(4.0) * co * ci);
    let lambert = (one - metalness) * base / R::of(PI);
    let diffuse = match model.diffuse {
        Diffuse::Lambert => lambert,
        Diffuse::FresnelWeighted => (one - f) * R::of(0.96) * lambert,
        Diffuse::Omitted => R::of(0.0),
    };
    diffuse + specular
}

/// Reflected radiance of one channel: irradiance·f·n·l, 0 where n·l or n·v is not positive.
pub fn reflect<R: Real>(
    model: Model,
    base: R,
    roughness: R,
    metalness: R,
    n: [R; 3],
    v: [R; 3],
    l: [R; 3],
    irradiance: R,
) -> R {
    let a = angles(n, v, l);
    if a[0].value() <= 0.0 || a[1].value() <= 0.0 {
        return R::of(0.0);
    }
    irradiance * evaluate_at(model, base, roughness, metalness, a) * a[0]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_distribution_is_normalised_over_projected_area() {
        // ∫ D cos θ dω = 1.
        for alpha in [0.05, 0.3, 1.0] {
            let n = 20_000;
            let sum: f64 = (0..n)
                .map(|i| {
                    let c = (i as f64 + 0.5) / n as f64;
                    distribution(alpha, c) * c * 2.0 * PI / n as f64
                })
                .sum();
            assert!((sum - 1.0).abs() < 1e-3, "{alpha}: {sum}");
        }
    }

    #[test]
    fn a_perfectly_rough_normal_view_is_known_in_closed_form() {
        // α = 1, n = v = l: D = 1/π, G = 1, F = F0, f = (F0/4 + c·0.96·(1 − 0.04))/π.
        let model =
            Model { masking: Masking::SmithSeparable, fresnel: Fresnel::Schlick, diffuse: Diffuse::FresnelWeighted };
        let z = [0.0, 0.0, 1.0];
        let f = reflect(model, 0.5, 1.0, 0.0, z, z, z, PI);
        assert!((f - (0.01 + 0.5 * 0.96 * 0.96)).abs() < 1e-12, "{f}");
    }
}
