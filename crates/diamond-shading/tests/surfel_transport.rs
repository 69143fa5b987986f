//! Laws of transport between surfels: linear in light, energy, reciprocity, the adjoint identity of the whole map from normals,
//! positions and weights to radiosity, and the same bits on any number of threads.
use diamond_light::{Falloff, OlatLight};
use diamond_shading::{
    Balance, Entry, GAUSSIAN_SUM_TOLERANCE, RadialProfile, Receivers, SurfelLighting, SurfelTransport, Surfels,
};
use diamond_testkit::adjoint::adjoint_gap;
use diamond_testkit::{Dual, Real, jvp, surfel_transport as oracle};
use glam::Vec3;
use proptest::prelude::*;

const WIDTHS: [f32; 4] = [0.12, 0.3, 0.7, 1.6];

/// Even points on an ellipsoid of these half axes, with the areas of its patches; normals.
fn ellipsoid(count: usize, axes: Vec3) -> (Surfels, Vec<Vec3>) {
    let golden = std::f32::consts::PI * (3.0 - 5f32.sqrt());
    let (mut positions, mut areas, mut normals) = (Vec::new(), Vec::new(), Vec::new());
    for i in 0..count {
        let z = 1.0 - (2.0 * i as f32 + 1.0) / count as f32;
        let (r, phi) = ((1.0 - z * z).sqrt(), golden * i as f32);
        let on_sphere = Vec3::new(r * phi.cos(), r * phi.sin(), z);
        let gradient = on_sphere / axes;
        positions.push(on_sphere * axes);
        normals.push(gradient.normalize());
        areas.push(4.0 * std::f32::consts::PI / count as f32 * axes.element_product() * gradient.length());
    }
    (Surfels { positions, areas }, normals)
}

fn profile(weights: &[f32]) -> RadialProfile {
    let each = weights.chunks_exact(3).map(Vec3::from_slice).collect();
    RadialProfile::new(WIDTHS.to_vec(), each).unwrap()
}

fn transport(surfels: &Surfels, balance: Balance) -> SurfelTransport {
    SurfelTransport::new(surfels.clone(), WIDTHS.to_vec(), balance).unwrap()
}

fn wide(v: &[f32]) -> Vec<f64> {
    v.iter().map(|v| f64::from(*v)).collect()
}

fn exitance(receivers: &Receivers<'_>, profile: &RadialProfile, irradiance: &[f32]) -> Vec<f32> {
    receivers.exitance(profile, irradiance).unwrap().0
}

/// Error of the fast sum against the plain double sum, relative to the largest radiosity; `broken` plants a mistake.
fn error_against_double_sum(count: usize, broken: bool) -> f64 {
    let (surfels, _) = ellipsoid(count, Vec3::new(1.0, 0.6, 0.3));
    let irradiance: Vec<f32> = surfels.positions.iter().flat_map(|p| [p.x.max(0.0), p.y.max(0.0), 1.0]).collect();
    let weights: Vec<f32> = (0..12).map(|i| 0.05 + 0.02 * i as f32).collect();
    let places: Vec<Vec3> = surfels.positions.iter().step_by(7).copied().collect();
    let transport = transport(&surfels, Balance::Plain);
    let mut found = exitance(&transport.receivers(&places).unwrap(), &profile(&weights), &irradiance);
    if broken {
        found.iter_mut().skip(2).step_by(3).for_each(|v| *v *= 1.03);
    }
    let list = |v: &[Vec3]| v.iter().map(|p| p.to_array().map(f64::from)).collect::<Vec<_>>();
    let (x, y) = (list(&places), list(&surfels.positions));
    let mut expected = vec![0.0; found.len()];
    for (k, width) in WIDTHS.iter().enumerate() {
        let sums = oracle::gaussian_sum(f64::from(*width), &x, &y, &wide(&surfels.areas), &wide(&irradiance), 3);
        expected.iter_mut().zip(sums).enumerate().for_each(|(i, (e, s))| *e += f64::from(weights[3 * k + i % 3]) * s);
    }
    let largest = expected.iter().fold(0.0f64, |m, v| m.max(*v));
    found.iter().zip(&expected).map(|(f, e)| (f64::from(*f) - e).abs()).fold(0.0, f64::max) / largest
}

/// `[eq:surfel-transport]`: against the plain double sum, and the comparison notices three per cent in one channel.
#[test]
fn the_fast_sum_is_the_double_sum() {
    for count in [300, 2000] {
        let error = error_against_double_sum(count, false);
        assert!(error <= f64::from(GAUSSIAN_SUM_TOLERANCE), "{count}: {error}");
    }
    assert!(error_against_double_sum(300, true) > 3.0 * f64::from(GAUSSIAN_SUM_TOLERANCE));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    /// `[eq:transport-balance]`: energy is never created on closed surfaces, thin ones included, by a profile of at most 1; and
    /// none is lost by one of exactly 1.
    #[test]
    fn no_more_leaves_than_enters(
        thin in 0.02f32..1.0, long in 0.5f32..2.0, weights in prop::collection::vec(0.0f32..1.0, 12), lit in 0usize..120,
    ) {
        let (surfels, _) = ellipsoid(120, Vec3::new(long, 0.8, thin));
        let mut irradiance = vec![0.0; 360];
        irradiance[3 * lit..3 * lit + 3].fill(1.0);
        let profile = profile(&weights.iter().map(|w| w + 0.3).collect::<Vec<_>>()).within_energy();
        let transport = transport(&surfels, Balance::Conserving);
        let receivers = transport.receivers(&surfels.positions).unwrap();
        let out = exitance(&receivers, &profile, &irradiance);
        let enters = f64::from(surfels.areas[lit]);
        for c in 0..3 {
            let leaves: f64 = out.chunks_exact(3).zip(&surfels.areas).map(|(m, a)| f64::from(m[c] * a)).sum();
            prop_assert!(leaves <= enters * (1.0 + 1e-4), "{leaves} of {enters}");
            prop_assert!(leaves >= enters * f64::from(profile.reflectance()[c]) * 0.9, "{leaves} of {enters}");
        }
    }

    /// Reciprocity: from a to b as from b to a, plain and balanced.
    #[test]
    fn light_goes_both_ways_alike(thin in 0.05f32..1.0, a in 0usize..120, b in 0usize..120) {
        let (surfels, _) = ellipsoid(120, Vec3::new(1.2, 0.8, thin));
        let profile = profile(&[0.2; 12]);
        for (balance, tolerance) in [(Balance::Plain, 1e-5), (Balance::Conserving, 0.02)] {
            let transport = transport(&surfels, balance);
            let receivers = transport.receivers(&surfels.positions).unwrap();
            let to = |from: usize, to: usize| {
                let mut irradiance = vec![0.0; 360];
                irradiance[3 * from] = 1.0 / surfels.areas[from];
                f64::from(exitance(&receivers, &profile, &irradiance)[3 * to])
            };
            let (there, back) = (to(a, b), to(b, a));
            prop_assert!((there - back).abs() <= tolerance * there.max(back) + 1e-6, "{balance:?} {there} {back}");
        }
    }

    /// Linear in light to rounding: two lights at once are the sum of both, whichever column group they are in.
    #[test]
    fn it_is_linear_in_light(first in prop::collection::vec(0.0f32..2.0, 360), factor in 0.1f32..3.0) {
        let (surfels, _) = ellipsoid(120, Vec3::new(1.0, 0.7, 0.4));
        let second: Vec<f32> = first.iter().rev().copied().collect();
        let both: Vec<f32> = first.iter().zip(&second).map(|(a, b)| a + factor * b).collect();
        let profile = profile(&[0.1; 12]);
        let transport = transport(&surfels, Balance::Conserving);
        let receivers = transport.receivers(&surfels.positions).unwrap();
        // Seven lights in one call: 21 columns.
        let rows = |i: usize| [&first, &second, &both, &first, &second, &both, &both].map(|v| [v[3 * i], v[3 * i + 1], v[3 * i + 2]]);
        let all: Vec<f32> = (0..120).flat_map(|i| rows(i).concat()).collect();
        let out = exitance(&receivers, &profile, &all);
        for row in out.chunks_exact(21) {
            for c in 0..3 {
                let sum = row[c] + factor * row[3 + c];
                prop_assert!((row[6 + c] - sum).abs() <= 2e-6 * sum.abs());
                prop_assert_eq!(row[c].to_bits(), row[9 + c].to_bits());
                prop_assert_eq!(row[6 + c].to_bits(), row[18 + c].to_bits());
            }
        }
        // The parts of the basis, with the weights, are the whole.
        let basis = receivers.basis(&first).unwrap();
        let plain = exitance(&receivers, &profile, &first);
        for (i, m) in plain.iter().enumerate() {
            let sum: f32 = basis.iter().map(|b| 0.1 * b[i]).sum();
            prop_assert!((m - sum).abs() <= 1e-5 * m.abs() + 1e-7);
        }
    }

    /// `[eq:surfel-transport]` `[eq:surfel-irradiance]`: the adjoint identity of the whole map, from the weights and the surfels' positions
    /// (in the irradiance) and normals to radiosity under two lights; J·ẋ by dual numbers through the plain double sum.
    #[test]
    fn the_whole_map_has_its_adjoint(
        tangent in prop::collection::vec(-1.0f64..1.0, 4 + 6 * 24), cotangent in prop::collection::vec(-1.0f32..1.0, 24 * 6),
        fresnel in any::<bool>(),
    ) {
        let (surfels, normals) = ellipsoid(24, Vec3::new(1.0, 0.7, 0.5));
        let lights = [Vec3::new(4.0, 0.5, 1.0), Vec3::new(-1.0, 3.0, -2.0)];
        let olat = lights.map(|position| OlatLight::Point { position, intensity: Vec3::ONE });
        let lighting = SurfelLighting {
            positions: &surfels.positions, normals: &normals, visibility: &[0.75; 48], lights: &olat,
            falloff: Falloff::InverseSquare { reference: 4.0 },
            entry: if fresnel { Entry::Fresnel { f0: 0.04 } } else { Entry::Full },
        };
        let weights = [0.3f32, 0.2, 0.15, 0.25];
        let all: Vec<f32> = weights.iter().flat_map(|w| [*w; 3]).collect();
        let (irradiance, profile) = (lighting.irradiance().unwrap(), profile(&all));
        let transport = transport(&surfels, Balance::Plain);
        let receivers = transport.receivers(&surfels.positions).unwrap();
        let (_, pullback) = receivers.exitance(&profile, &irradiance).unwrap();
        let grad = pullback.pull(&cotangent).unwrap();
        let geometry = lighting.pull(&grad.irradiance).unwrap();
        let mut vjp: Vec<f64> = grad.weights.iter().map(|w| f64::from(w.element_sum())).collect();
        for (p, n) in geometry.positions.iter().zip(&geometry.normals) {
            vjp.extend(p.to_array().iter().chain(&n.to_array()).map(|v| f64::from(*v)));
        }
        let mut x = wide(&weights);
        for (p, n) in surfels.positions.iter().zip(&normals) {
            x.extend(p.to_array().iter().chain(&n.to_array()).map(|v| f64::from(*v)));
        }
        let fixed: Vec<[f64; 3]> = surfels.positions.iter().map(|p| p.to_array().map(f64::from)).collect();
        let map = |x: &[Dual]| {
            let (w, geometry) = x.split_at(4);
            let mut columns = Vec::new();
            for g in geometry.chunks_exact(6) {
                for light in lights {
                    let e = oracle::irradiance(
                        light.to_array().map(|v| Dual::of(f64::from(v))), Some(Dual::of(4.0)), fresnel.then_some(f64::from(0.04f32)),
                        [g[0], g[1], g[2]], [g[3], g[4], g[5]], Dual::of(0.75));
                    columns.extend([e; 3]);
                }
            }
            let mut out = vec![Dual::of(0.0); cotangent.len()];
            for (k, width) in WIDTHS.iter().enumerate() {
                let sums = oracle::gaussian_sum(f64::from(*width), &fixed, &fixed, &wide(&surfels.areas), &columns, 6);
                out.iter_mut().zip(sums).for_each(|(o, s)| *o += w[k] * s);
            }
            out
        };
        let forward = jvp(map, &x, &tangent);
        let gap = adjoint_gap(&wide(&cotangent), &forward, &vjp, &tangent);
        prop_assert!(gap <= 5e-4, "{gap:e}");
    }
}

/// Balance matters where it is meant to: a thin sheet returns at most what enters, the plain sum nearly twice as much.
#[test]
fn a_thin_sheet_does_not_shine_twice() {
    let (surfels, _) = ellipsoid(1000, Vec3::new(1.0, 1.0, 0.02));
    let profile = RadialProfile::new(vec![0.2], vec![Vec3::ONE]).unwrap();
    let irradiance: Vec<f32> = surfels.positions.iter().flat_map(|p| [f32::from(u8::from(p.z > 0.0)); 3]).collect();
    let mut returned = Vec::new();
    for balance in [Balance::Plain, Balance::Conserving] {
        let transport = SurfelTransport::new(surfels.clone(), vec![0.2], balance).unwrap();
        let receivers = transport.receivers(&surfels.positions).unwrap();
        let out = exitance(&receivers, &profile, &irradiance);
        let sum = |v: &[f32]| v.chunks_exact(3).zip(&surfels.areas).map(|(m, a)| f64::from(m[0] * a)).sum::<f64>();
        returned.push(sum(&out) / sum(&irradiance));
    }
    assert!(returned[0] > 1.6 && (0.97..1.0001).contains(&returned[1]), "{returned:?}");
}

/// One thread and several: the same bits, forward and reverse.
#[cfg(feature = "parallel")]
#[test]
fn threads_do_not_change_bits() {
    let (surfels, _) = ellipsoid(300, Vec3::new(1.0, 0.7, 0.4));
    let irradiance: Vec<f32> = (0..300 * 21).map(|i| (i % 17) as f32 * 0.1).collect();
    let run = |threads: usize| {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
            let profile = profile(&[0.1; 12]);
            let transport = transport(&surfels, Balance::Conserving);
            let receivers = transport.receivers(&surfels.positions).unwrap();
            let (out, pullback) = receivers.exitance(&profile, &irradiance).unwrap();
            (pullback.pull(&out).unwrap(), out)
        })
    };
    assert_eq!(run(1), run(5));
}

/// White light in one column has the bits of the same light in three, for few lights and for many.
#[test]
fn white_light_is_three_equal_channels() {
    let (surfels, _) = ellipsoid(90, Vec3::new(1.0, 0.7, 0.4));
    let transport = transport(&surfels, Balance::Plain);
    let receivers = transport.receivers(&surfels.positions).unwrap();
    let profile = profile(&(0..12).map(|i| 0.05 + 0.03 * i as f32).collect::<Vec<_>>());
    for lights in [1, 5, 19] {
        let white: Vec<f32> = (0..90 * lights).map(|i| (i * 37 % 23) as f32).collect();
        let coloured: Vec<f32> = white.iter().flat_map(|e| [*e; 3]).collect();
        let found = receivers.white_exitance(&profile, &white).unwrap();
        assert_eq!(found, exitance(&receivers, &profile, &coloured), "{lights}");
        assert!(found.chunks_exact(3).any(|rgb| rgb[0] < 0.9 * rgb[2]));
    }
    let other = RadialProfile::new(vec![0.1], vec![Vec3::ONE]).unwrap();
    assert!(receivers.white_exitance(&other, &[1.0; 90]).is_err());
    assert!(receivers.white_exitance(&profile, &[1.0; 91]).is_err());
}

#[test]
fn what_cannot_be_transported_is_refused() {
    let (surfels, _) = ellipsoid(20, Vec3::ONE);
    let new = |surfels: Surfels| SurfelTransport::new(surfels, WIDTHS.to_vec(), Balance::Conserving);
    assert!(new(Surfels { areas: vec![1.0], ..surfels.clone() }).is_err());
    assert!(new(Surfels { areas: vec![0.0; 20], ..surfels.clone() }).is_err());
    assert!(new(Surfels { areas: vec![f32::NAN; 20], ..surfels.clone() }).is_err());
    assert!(new(Surfels { positions: vec![Vec3::NAN; 20], ..surfels.clone() }).is_err());
    let transport = new(surfels.clone()).unwrap();
    assert!(transport.receivers(&[Vec3::INFINITY]).is_err());
    let receivers = transport.receivers(&surfels.positions).unwrap();
    assert!(receivers.basis(&[1.0; 21]).is_err() && receivers.basis(&[]).is_err());
    let other = RadialProfile::new(vec![0.1], vec![Vec3::ONE]).unwrap();
    assert!(receivers.exitance(&other, &[1.0; 60]).is_err());
    let (narrow, irradiance) = (profile(&[0.1; 12]), [1.0; 60]);
    let (out, pullback) = receivers.exitance(&narrow, &irradiance).unwrap();
    assert!(pullback.pull(&out[1..]).is_err());
    // Far from everything there is no light, and no NaN.
    let far = [Vec3::splat(1e30)];
    assert_eq!(exitance(&transport.receivers(&far).unwrap(), &narrow, &irradiance), vec![0.0; 3]);
}
