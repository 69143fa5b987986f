//! Laws of lights and spherical harmonics.
use diamond_light::spherical_harmonics::{COEFFICIENTS, basis};
use diamond_light::{Falloff, LightRig, OlatLight};
use diamond_testkit::strategies::{colour, finite, rotation_matrix, rotation_wxyz, unit_vector, vector};
use glam::Vec3;
use proptest::prelude::*;

/// Nodes and weights of Gauss–Legendre quadrature on [−1, 1] with four nodes: exact for polynomials to degree 7.
const GAUSS_4: [(f64, f64); 4] = [
    (-0.861_136_311_594_052_6, 0.347_854_845_137_453_9),
    (-0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
    (0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
    (0.861_136_311_594_052_6, 0.347_854_845_137_453_9),
];

/// Quadrature over the sphere, exact for polynomials to degree 7: products of two functions of degree 3.
fn quadrature() -> Vec<(Vec3, f64)> {
    let steps = 8;
    let mut nodes = Vec::new();
    for (z, weight) in GAUSS_4 {
        for i in 0..steps {
            let phi = (f64::from(i) + 0.25) * std::f64::consts::TAU / f64::from(steps);
            let r = (1.0 - z * z).sqrt();
            let d = Vec3::new((r * phi.cos()) as f32, (r * phi.sin()) as f32, z as f32);
            nodes.push((d, weight * std::f64::consts::TAU / f64::from(steps)));
        }
    }
    nodes
}

/// [eq:sh-basis]: ∫Yᵢ·Yⱼ dω = δᵢⱼ.
#[test]
fn the_basis_is_orthonormal() {
    let mut gram = [[0.0f64; COEFFICIENTS]; COEFFICIENTS];
    for (d, weight) in quadrature() {
        let y = basis(d);
        for i in 0..COEFFICIENTS {
            for j in 0..COEFFICIENTS {
                gram[i][j] += weight * f64::from(y[i]) * f64::from(y[j]);
            }
        }
    }
    for i in 0..COEFFICIENTS {
        for j in 0..COEFFICIENTS {
            let expected = f64::from(u8::from(i == j));
            assert!((gram[i][j] - expected).abs() < 1e-6, "⟨Y{i}, Y{j}⟩ = {}", gram[i][j]);
        }
    }
}

/// Legendre polynomials 0 … 3.
fn legendre(l: usize, t: f64) -> f64 {
    match l {
        0 => 1.0,
        1 => t,
        2 => 0.5 * (3.0 * t * t - 1.0),
        _ => 0.5 * (5.0 * t * t * t - 3.0 * t),
    }
}

fn rotate(r: &[[f64; 3]; 3], v: Vec3) -> Vec3 {
    Vec3::from([0, 1, 2].map(|i| (0..3).map(|k| r[i][k] * f64::from(v[k])).sum::<f64>() as f32))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    /// [eq:sh-basis], addition theorem: Σₘ Y(l,m)(a)·Y(l,m)(b) = (2l + 1)/4π · P_l(a·b).
    #[test]
    fn addition_theorem(a in unit_vector(), b in unit_vector()) {
        let (a, b) = (Vec3::from(a), Vec3::from(b));
        let (ya, yb) = (basis(a), basis(b));
        for l in 0..4usize {
            let sum: f64 = (l * l..(l + 1) * (l + 1)).map(|i| f64::from(ya[i]) * f64::from(yb[i])).sum();
            let expected = (2 * l + 1) as f64 / (4.0 * std::f64::consts::PI) * legendre(l, f64::from(a.dot(b)));
            prop_assert!((sum - expected).abs() < 2e-6, "degree {l}: {sum} instead of {expected}");
        }
    }

    /// Rotating both directions changes no degree's inner product: each degree is closed under rotation.
    #[test]
    fn degrees_are_rotation_invariant(a in unit_vector(), b in unit_vector(), q in rotation_wxyz()) {
        let r = rotation_matrix(q);
        let (a, b) = (Vec3::from(a), Vec3::from(b));
        let (ya, yb, ra, rb) = (basis(a), basis(b), basis(rotate(&r, a)), basis(rotate(&r, b)));
        for l in 0..4usize {
            let dot = |p: &[f32; 16], q: &[f32; 16]| (l * l..(l + 1) * (l + 1)).map(|i| p[i] * q[i]).sum::<f32>();
            prop_assert!((dot(&ya, &yb) - dot(&ra, &rb)).abs() < 5e-6);
        }
    }

    /// [eq:sh-basis], parity: Y(l,m)(−ω) = (−1)^l·Y(l,m)(ω), to the bit.
    #[test]
    fn parity(d in unit_vector()) {
        let (plus, minus) = (basis(d.into()), basis(-Vec3::from(d)));
        for i in 0..COEFFICIENTS {
            let odd = matches!(i, 1..4 | 9..16);
            prop_assert_eq!(minus[i], if odd { -plus[i] } else { plus[i] });
        }
    }

    /// [eq:light-incidence]: a point light moved to infinity with the reference distance is a directional light; the
    /// gap falls as the distance grows.
    #[test]
    fn far_point_lights_are_directional(to_light in unit_vector(), at in vector(-1.0..1.0), rgb in colour()) {
        let (to_light, at, irradiance) = (Vec3::from(to_light), Vec3::from(at), Vec3::from(rgb));
        let limit = OlatLight::directional(to_light, irradiance).unwrap().incidence(at, Falloff::None);
        for distance in [1e2f32, 1e3, 1e4, 1e5] {
            let light = OlatLight::Point { position: to_light * distance, intensity: irradiance };
            let near = light.incidence(at, Falloff::InverseSquare { reference: distance });
            prop_assert!((near.direction - limit.direction).length() <= 2.0 / distance + 1e-6);
            prop_assert!((near.irradiance - limit.irradiance).length() <= 8.0 / distance + 1e-5);
        }
    }

    /// Falloff: at the reference distance the irradiance is the intensity, at twice it a quarter.
    #[test]
    fn inverse_square(to_light in unit_vector(), reference in finite(0.1..50.0), at in vector(-1.0..1.0)) {
        let (to_light, at) = (Vec3::from(to_light), Vec3::from(at));
        for (times, expected) in [(1.0, 1.0), (2.0, 0.25), (0.5, 4.0)] {
            let light = OlatLight::Point { position: at + to_light * reference * times, intensity: Vec3::ONE };
            let irradiance = light.incidence(at, Falloff::InverseSquare { reference }).irradiance.x;
            prop_assert!((irradiance - expected).abs() <= 3e-5 * expected);
            prop_assert_eq!(light.incidence(at, Falloff::None).irradiance, Vec3::ONE);
        }
    }

    /// Lights turn with the world: rotating light and point rotates the direction and leaves the rest.
    #[test]
    fn incidence_is_equivariant(p in vector(-3.0..3.0), at in vector(-1.0..1.0), q in rotation_wxyz()) {
        let (p, at) = (Vec3::from(p), Vec3::from(at));
        prop_assume!(p.distance(at) > 0.1);
        let r = rotation_matrix(q);
        let falloff = Falloff::InverseSquare { reference: 2.0 };
        let plain = OlatLight::Point { position: p, intensity: Vec3::ONE }.incidence(at, falloff);
        let turned =
            OlatLight::Point { position: rotate(&r, p), intensity: Vec3::ONE }.incidence(rotate(&r, at), falloff);
        prop_assert!((turned.direction - rotate(&r, plain.direction)).length() < 1e-5);
        prop_assert!((turned.distance - plain.distance).abs() < 1e-5);
        prop_assert!((turned.irradiance.x / plain.irradiance.x - 1.0).abs() < 3e-5);
    }

    /// [eq:golden-dome]: a dome of point lights seen from its target is the directional dome.
    #[test]
    fn domes_agree(up in unit_vector(), count in 1usize..40, elevation in finite(-1.5..1.5), distance in finite(0.5..9.0)) {
        let up = Vec3::from(up);
        let near = LightRig::dome(count, Vec3::ZERO, up, distance, elevation, Vec3::ONE).unwrap();
        let far = LightRig::directional_dome(count, up, elevation, Vec3::ONE).unwrap();
        for (a, b) in near.lights.iter().zip(&far.lights) {
            prop_assert!((a.direction_from_origin() - b.direction_from_origin()).length() < 1e-5);
            prop_assert!(a.direction_from_origin().dot(up) >= elevation.sin() - 1e-5);
        }
    }
}
