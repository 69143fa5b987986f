//! Closed forms of light transport: what a tracer is judged by, and the approximations that it judges.
//!
//! A half-space of isotropic scatterers has an exact solution (Chandrasekhar 1960). The dipole (Jensen et al. 2001), the diffusion
//! profile fit of Burley (2015) and the albedo inversion of Chiang et al. (2016) are approximations: the dipole is a fifth too dark at
//! albedo 0.9 without a boundary. All in `f64`.
use std::f64::consts::PI;

/// Nodes of the quadrature over the hemisphere.
const NODES: usize = 64;

/// Gauss–Legendre nodes and weights on [0, 1].
fn gauss_legendre() -> [(f64, f64); NODES] {
    std::array::from_fn(|i| {
        let n = NODES as f64;
        let mut x = (PI * (i as f64 + 0.75) / (n + 0.5)).cos();
        let mut slope = 1.0;
        for _ in 0..20 {
            let (mut p, mut before) = (1.0, 0.0);
            for k in 0..NODES {
                let k = k as f64;
                (p, before) = (((2.0 * k + 1.0) * x * p - k * before) / (k + 1.0), p);
            }
            slope = n * (x * p - before) / (x * x - 1.0);
            x -= p / slope;
        }
        (0.5 * (1.0 - x), 1.0 / ((1.0 - x * x) * slope * slope))
    })
}

/// Chandrasekhar's H function of isotropic scattering with the given albedo (0 … 1), at each of `cosines` (0 … 1):
/// 1/H(μ) = √(1 − a) + ½ a ∫ μ′ H(μ′)/(μ + μ′) dμ′.
/// `[eq:chandrasekhar-h]`
pub fn chandrasekhar_h(albedo: f64, cosines: &[f64]) -> Vec<f64> {
    let nodes = gauss_legendre();
    let root = (1.0 - albedo).max(0.0).sqrt();
    let at = |mu: f64, h: &[f64; NODES]| {
        let integral: f64 = nodes.iter().zip(h).map(|((x, w), h)| w * x * h / (mu + x)).sum();
        1.0 / (root + 0.5 * albedo * integral)
    };
    let mut h = [1.0; NODES];
    // The plain iteration converges slowly near albedo 1; averaging two steps makes it contract there too.
    for _ in 0..20_000 {
        let next: [f64; NODES] = std::array::from_fn(|i| 0.5 * (h[i] + at(nodes[i].0, &h)));
        let change = next.iter().zip(&h).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        h = next;
        if change < 1e-14 {
            break;
        }
    }
    cosines.iter().map(|mu| at(*mu, &h)).collect()
}

/// Fraction of light that a half-space of isotropic scatterers returns, for light that arrives at the cosine `mu0`.
/// `[eq:half-space-albedo]`
pub fn half_space_albedo(albedo: f64, mu0: f64) -> f64 {
    1.0 - (1.0 - albedo).max(0.0).sqrt() * chandrasekhar_h(albedo, &[mu0])[0]
}

/// The decay κ/σ_t of light deep in a medium of isotropic scatterers: albedo·artanh(κ)/κ = 1 (Case and Zweifel); 0 at albedo 1.
/// `[eq:asymptotic-attenuation]`
pub fn asymptotic_attenuation(albedo: f64) -> f64 {
    let (mut low, mut high) = (0.0, 1.0);
    // The left side grows from albedo at κ = 0 to infinity at κ = 1.
    for _ in 0..200 {
        let k: f64 = 0.5 * (low + high);
        let left = if k < 1e-9 { albedo } else { albedo * k.atanh() / k };
        if left < 1.0 { low = k } else { high = k }
    }
    0.5 * (low + high)
}

/// (1 + F)/(1 − F) of the mean internal reflectance of a boundary, by the fit of Egan and Hilgeman; 1 without a boundary.
fn boundary_term(eta: f64) -> f64 {
    if eta == 1.0 {
        return 1.0;
    }
    let f = -1.440 / (eta * eta) + 0.710 / eta + 0.668 + 0.0636 * eta;
    (1.0 + f) / (1.0 - f)
}

/// Total diffuse reflectance of the classical dipole: reduced albedo 0 … 1, index of refraction `eta` ≥ 1.
/// `[eq:dipole]`
pub fn dipole_total(reduced_albedo: f64, eta: f64) -> f64 {
    let s = (3.0 * (1.0 - reduced_albedo)).sqrt();
    0.5 * reduced_albedo * (1.0 + (-4.0 / 3.0 * boundary_term(eta) * s).exp()) * (-s).exp()
}

/// Diffuse reflectance of the classical dipole at the distance `r` from where the light enters, in reduced mean free paths;
/// per squared reduced mean free path.
/// `[eq:dipole]`
pub fn dipole_profile(reduced_albedo: f64, eta: f64, r: f64) -> f64 {
    let s = (3.0 * (1.0 - reduced_albedo)).sqrt();
    let source = |z: f64| {
        let d = (r * r + z * z).sqrt();
        z * (s * d + 1.0) * (-s * d).exp() / (d * d * d)
    };
    // Depths of the source and of its image, 2AD apart from the extrapolated boundary with D = 1/3.
    reduced_albedo / (4.0 * PI) * (source(1.0) + source(1.0 + 4.0 / 3.0 * boundary_term(eta)))
}

/// Burley's normalised diffusion: the fraction of light that leaves within `r` shape lengths `d` of where it entered.
/// `[eq:burley]`
pub fn burley_cdf(r: f64) -> f64 {
    1.0 - 0.25 * (-r).exp() - 0.75 * (-r / 3.0).exp()
}

/// Burley's scale s = mean free path/d for surface albedo `a` under a beam at normal incidence.
/// `[eq:burley]`
pub fn burley_scale_searchlight(a: f64) -> f64 {
    1.85 - a + 7.0 * (a - 0.8).abs().powi(3)
}

/// Burley's scale s for surface albedo `a` under diffuse light.
/// `[eq:burley]`
pub fn burley_scale_diffuse(a: f64) -> f64 {
    1.9 - a + 3.5 * (a - 0.8) * (a - 0.8)
}

/// Single-scattering albedo that makes a half-space look like the surface albedo `a` (isotropic, without a boundary); Chiang et
/// al.'s fit.
/// `[eq:albedo-inversion]`
pub fn albedo_from_colour(a: f64) -> f64 {
    1.0 - (-5.09406 * a + 2.61188 * a * a - 4.31805 * a * a * a).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `[eq:chandrasekhar-h]` `[eq:half-space-albedo]` `[eq:asymptotic-attenuation]`: Chandrasekhar's and Case's tables.
    #[test]
    fn exact_solutions_have_their_tabulated_values() {
        assert!((chandrasekhar_h(1.0, &[1.0])[0] - 2.907_810_529).abs() < 1e-5);
        for (a, mu, expected) in
            [(0.5, 1.0, 0.115_225_877_7), (0.9, 0.5, 0.507_938_906_9), (0.999, 1.0, 0.912_845_334_8)]
        {
            assert!((half_space_albedo(a, mu) - expected).abs() < 1e-9, "{a} {mu}");
        }
        for (a, expected) in [(0.5, 0.957_504_024_1), (0.9, 0.525_429_512_7), (0.999, 0.054_750_343_09)] {
            assert!((asymptotic_attenuation(a) - expected).abs() < 1e-9);
        }
        assert!(asymptotic_attenuation(1.0) < 1e-6 && asymptotic_attenuation(0.0) > 1.0 - 1e-6);
    }

    /// `[eq:dipole]` `[eq:burley]` `[eq:albedo-inversion]`
    #[test]
    fn approximations_have_their_published_values() {
        assert!((dipole_total(0.9, 1.5) - 0.274_658_144_9).abs() < 1e-9);
        assert!((dipole_total(0.5, 1.0) - 0.087_807_775_7).abs() < 1e-9);
        assert!((dipole_profile(0.9, 1.3, 1.0) - 0.021_661_665_55).abs() < 1e-10);
        // The profile's integral is the total.
        let n = 200_000;
        let integral: f64 = (0..n)
            .map(|i| {
                let r = 60.0 * ((f64::from(i) + 0.5) / f64::from(n)).powi(2);
                let width = 120.0 * (f64::from(i) + 0.5) / f64::from(n) / f64::from(n);
                dipole_profile(0.9, 1.3, r) * 2.0 * PI * r * width
            })
            .sum();
        assert!((integral - dipole_total(0.9, 1.3)).abs() < 1e-6);
        assert!((burley_cdf(1.0) - 0.370_631_656_8).abs() < 1e-9 && burley_cdf(0.0) == 0.0);
        assert!((burley_scale_searchlight(0.2) - 3.162).abs() < 1e-12);
        assert!((burley_scale_diffuse(0.5) - 1.715).abs() < 1e-12);
        assert!((albedo_from_colour(0.5) - 0.912_298_497_7).abs() < 1e-9);
    }
}
