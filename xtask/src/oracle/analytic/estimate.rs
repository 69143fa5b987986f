//! Estimates by tracing, and closed forms.

use super::row::{Incidence, Layer, Quantity};
use diamond_pathtrace::sampling::{cosine_hemisphere, uniform_disc};
use diamond_pathtrace::{
    Boundary, Environment, Geometry, Light, Material, Medium, PathOptions, Rng, Scene, Tracer, closed_form, ggx,
    sample_henyey_greenstein,
};
use glam::Vec3;
use rayon::prelude::*;

/// Paths of one chunk, and chunks of the first round.
const CHUNK: u64 = 4096;
const FIRST: u64 = 8;
/// Rounds double; more paths than this are not traced.
const MOST: u64 = 1 << 19;

/// A mean and its standard error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Mean.
    pub mean: f64,
    /// Standard error of the mean.
    pub error: f64,
}

/// Averages samples until the standard error is at most `target`. The chunks, and with them the bits, do not depend on threads.
fn average(target: f64, sample: impl Fn(&mut Rng) -> f64 + Sync) -> Estimate {
    let (mut sum, mut square, mut done) = (0.0, 0.0, 0u64);
    loop {
        let next = if done == 0 { FIRST } else { 2 * done };
        let parts: Vec<(f64, f64)> = (done..next)
            .into_par_iter()
            .map(|chunk| {
                let mut rng = Rng::new(0x5eed, chunk);
                (0..CHUNK).map(|_| sample(&mut rng)).fold((0.0, 0.0), |(s, q), v| (s + v, q + v * v))
            })
            .collect();
        for (s, q) in parts {
            sum += s;
            square += q;
        }
        done = next;
        let n = (done * CHUNK) as f64;
        let mean = sum / n;
        let error = ((square / n - mean * mean).max(0.0) / n).sqrt();
        if error <= target || done >= MOST || !error.is_finite() {
            return Estimate { mean, error };
        }
    }
}

fn boundary(eta: f32) -> Boundary {
    if eta == 1.0 { Boundary::IndexMatched } else { Boundary::Smooth { eta } }
}

fn layer_scene(layer: &Layer, lights: Vec<Light>) -> Scene {
    Scene {
        geometry: Geometry::Slab { bottom: -layer.tau, top: 0.0 },
        material: Material {
            medium: Medium::gray(1.0, layer.albedo, layer.g),
            boundary: boundary(layer.eta),
            coat: None,
        },
        lights,
    }
}

fn hemisphere(axis: Vec3) -> Light {
    Light::Environment(Environment::Hemisphere { axis, radiance: Vec3::ONE })
}

/// Red radiance along rays that `start` draws.
fn traced(scene: &Scene, target: f64, start: impl Fn(&mut Rng) -> (Vec3, Vec3) + Sync) -> Estimate {
    let Ok(tracer) = Tracer::new(scene, PathOptions::default()) else {
        return Estimate { mean: f64::NAN, error: f64::NAN };
    };
    average(target, |rng| {
        let (origin, direction) = start(rng);
        let mut radiance = [Vec3::ZERO];
        tracer.trace(origin, direction, false, rng, &mut radiance);
        f64::from(radiance[0].x)
    })
}

fn downward(cos: f32) -> Vec3 {
    Vec3::new((1.0 - cos * cos).max(0.0).sqrt(), 0.0, -cos)
}

/// The light of a hemisphere that a layer sends along the way that light would take backwards: by reciprocity what it does with a
/// beam that arrives there.
fn layer_albedo(layer: &Layer, incidence: Incidence, side: Vec3, target: f64) -> Estimate {
    let scene = layer_scene(layer, vec![hemisphere(side)]);
    traced(&scene, target, |rng| match incidence {
        Incidence::Beam(mu) => (Vec3::Z, downward(mu)),
        Incidence::Lambert => (Vec3::Z, -cosine_hemisphere(rng)),
    })
}

/// The value where there is a formula for it.
pub fn closed_form(quantity: &Quantity) -> Option<f64> {
    Some(match *quantity {
        Quantity::Attenuation(a) => closed_form::asymptotic_attenuation(a),
        Quantity::H(mu, a) => closed_form::chandrasekhar_h(a, &[mu])[0],
        Quantity::DipoleTotal(a, eta) => closed_form::dipole_total(a, eta),
        Quantity::DipoleProfile(a, eta, r) => closed_form::dipole_profile(a, eta, r),
        Quantity::BurleyCdf(r) => closed_form::burley_cdf(r),
        Quantity::BurleySearchlight(a) => closed_form::burley_scale_searchlight(a),
        Quantity::BurleyDiffuse(a) => closed_form::burley_scale_diffuse(a),
        Quantity::AlbedoInversion(a) => closed_form::albedo_from_colour(a),
        _ => return None,
    })
}

/// The value by tracing, to a standard error of at most `target` where that takes no more than 2·10⁹ paths.
pub fn estimate(quantity: &Quantity, target: f64) -> Estimate {
    match *quantity {
        Quantity::Reflectance(ref layer, incidence) => layer_albedo(layer, incidence, Vec3::Z, target),
        Quantity::Transmittance(ref layer, incidence) => layer_albedo(layer, incidence, -Vec3::Z, target),
        Quantity::Brdf(ref layer, mu0, mu) => {
            // Irradiance 1 on the layer itself; light from the other azimuth.
            let to_light = Vec3::new((1.0 - mu0 * mu0).max(0.0).sqrt(), 0.0, mu0);
            let light = Light::directional(to_light, Vec3::splat(1.0 / mu0));
            traced(&layer_scene(layer, vec![light]), target, |_| (Vec3::Z, downward(mu)))
        }
        Quantity::AbsorbingSphere(depth) => {
            let scene = Scene {
                geometry: Geometry::Sphere { centre: Vec3::ZERO, radius: 1.0 },
                material: Material::index_matched(Medium::gray(depth, 0.0, 0.0)),
                lights: vec![Light::Environment(Environment::Constant { radiance: Vec3::ONE })],
            };
            traced(&scene, target, |rng| (uniform_disc(rng).extend(3.0), -Vec3::Z))
        }
        Quantity::Furnace(ref layer) => {
            let scene = Scene {
                geometry: Geometry::Sphere { centre: Vec3::ZERO, radius: 1.0 },
                material: Material {
                    medium: Medium::gray(layer.tau, layer.albedo, layer.g),
                    boundary: boundary(layer.eta),
                    coat: None,
                },
                lights: vec![Light::Environment(Environment::Constant { radiance: Vec3::ONE })],
            };
            traced(&scene, target, |rng| (uniform_disc(rng).extend(3.0), -Vec3::Z))
        }
        Quantity::MeanSquare(flights, g) => {
            let medium = Medium::gray(1.0, 1.0, g);
            average(target, |rng| {
                let (mut point, mut direction) = (Vec3::ZERO, Vec3::Z);
                for k in 0..flights {
                    if k > 0 {
                        direction = sample_henyey_greenstein(g, direction, rng);
                    }
                    point += direction * medium.fly(Vec3::ONE, rng).distance;
                }
                f64::from(point.length_squared())
            })
        }
        Quantity::GgxAlbedo { alpha, cos, correlated } => {
            let v = -downward(cos) * Vec3::new(-1.0, 1.0, 1.0);
            average(target, |rng| {
                let h = ggx::sample_visible_normal(alpha, v, rng);
                let l = h * (2.0 * v.dot(h)) - v;
                let weight = match correlated {
                    true => ggx::masking_correlated(alpha, v, l) / ggx::masking(alpha, v),
                    false => ggx::masking(alpha, l),
                };
                if l.z > 0.0 { f64::from(weight) } else { 0.0 }
            })
        }
        // Closed forms are not traced.
        _ => Estimate { mean: f64::NAN, error: f64::NAN },
    }
}
