//! Exit walks: energy, reciprocity, a half-space, moments, determinism, and what is refused.
use super::*;
use crate::closed_form::half_space_albedo;
use crate::{Mesh, Rng};
use glam::Vec3;

const ROUGH: Boundary = Boundary::Rough { eta: 1.4, alpha: 0.4 };

fn ball(detail: u32) -> (Geometry, Vec<Patch>) {
    let mesh = Mesh::icosphere(Vec3::new(0.2, -0.1, 0.3), 1.0, detail);
    let patches = mesh.patches(1.0).unwrap();
    (Geometry::from_mesh(mesh).unwrap(), patches)
}

/// Two balls that see each other.
fn pair() -> (Geometry, Vec<Patch>) {
    let mut mesh = Mesh::icosphere(Vec3::new(-0.55, 0.0, 0.0), 0.5, 2);
    let other = Mesh::icosphere(Vec3::new(0.55, 0.0, 0.0), 0.5, 2);
    let first = mesh.positions.len() as u32;
    mesh.positions.extend(&other.positions);
    mesh.triangles.extend(other.triangles.iter().map(|t| t.map(|i| i + first)));
    mesh.normals = None;
    let patches = mesh.patches(1.0).unwrap();
    (Geometry::from_mesh(mesh).unwrap(), patches)
}

fn traced(object: &(Geometry, Vec<Patch>), sigma_t: f32, g: f32, boundary: Boundary, walks: u32) -> ExitWalks {
    let options = ExitWalkOptions { walks, seed: 3, ..Default::default() };
    ExitWalks::trace(&object.0, sigma_t, g, boundary, &object.1, &options, &|_| ()).unwrap()
}

fn lit(patches: &[Patch], directions: &[Vec3]) -> (Vec<f32>, Vec<f32>) {
    let cosines: Vec<f32> =
        patches.iter().flat_map(|p| directions.iter().map(move |d| p.normal.dot(d.normalize()))).collect();
    (cosines.iter().map(|c| 3.0 * c.max(0.0)).collect(), cosines)
}

/// `[eq:exit-walks]`: nothing is created, what is lost is accounted for, and light grows with the albedo.
#[test]
fn energy_is_kept() {
    for (object, convex) in [(ball(2), true), (pair(), false)] {
        for boundary in [Boundary::IndexMatched, Boundary::Smooth { eta: 1.5 }, ROUGH] {
            let walks = traced(&object, 6.0, 0.3, boundary, 64);
            let f = walks.fates();
            let sum = f.refused + f.unscattered + f.left + f.lost + f.cut;
            assert!((sum - 1.0).abs() < 1e-9, "{boundary:?} {f:?}");
            assert!(f.cut == 0.0 && f.left > 0.5, "{f:?}");
            assert!((f.refused == 0.0) == (boundary == Boundary::IndexMatched));
            assert!(boundary == ROUGH || f.lost < 1e-4, "{f:?}");
            let white = walks.collapse(1.0).unwrap();
            let areas: f64 = object.1.iter().map(|p| f64::from(p.area)).sum();
            let mut leaves = 0.0;
            for (k, patch) in object.1.iter().enumerate() {
                let row = &white.weights[white.offsets[k] as usize..white.offsets[k + 1] as usize];
                let sum: f32 = row.iter().sum();
                assert!(!convex || sum <= 1.0 + 1e-5);
                assert!(row.iter().all(|w| *w >= 0.0));
                leaves += f64::from(sum * patch.area) / areas;
            }
            // A walk that meets the object again is recorded each time it comes out.
            assert!(if convex { (leaves - f.left).abs() < 1e-5 } else { leaves > f.left }, "{leaves} {f:?}");
            assert!((walks.diffuse_albedo(1.0) - leaves).abs() < 1e-5);
            let (irradiance, cosines) = lit(&object.1, &[Vec3::new(0.3, 0.2, 1.0), Vec3::NEG_Y]);
            let mut before = vec![0.0f32; irradiance.len()];
            for albedo in [0.0, 0.2, 0.7, 0.95, 0.999, 1.0] {
                let operator = walks.collapse(albedo).unwrap();
                let plain = operator.apply(&irradiance, 2).unwrap();
                assert!(plain.iter().zip(&before).all(|(a, b)| a >= b && a.is_finite()), "{albedo}");
                assert!(albedo > 0.0 || plain.iter().all(|m| *m == 0.0));
                before = plain;
                let radiosity = walks.radiosity(albedo, &irradiance, &cosines).unwrap();
                let total = |v: &[f32]| -> f64 {
                    v.chunks_exact(2).zip(&object.1).map(|(v, p)| f64::from(v[0] * p.area)).sum()
                };
                let (out, received) = (total(&radiosity), total(&irradiance));
                assert!(!convex || out < 1.01 * received, "{boundary:?} {albedo}: {out} {received}");
            }
        }
    }
}

/// Light goes as easily from x to y as from y to x, within what so many walks leave to chance.
#[test]
fn transport_is_reciprocal() {
    let object = pair();
    for boundary in [Boundary::IndexMatched, ROUGH] {
        let walks = traced(&object, 5.0, 0.5, boundary, 1024);
        for albedo in [0.8f32, 1.0] {
            let operator = walks.collapse(albedo).unwrap();
            let part = |p: &Patch| usize::from(p.position.x > 0.0) * 2 + usize::from(p.normal.x > 0.0);
            let mut power = [[0.0f64; 4]; 4];
            let mut variance = [[0.0f64; 4]; 4];
            for (k, patch) in object.1.iter().enumerate() {
                for at in operator.offsets[k] as usize..operator.offsets[k + 1] as usize {
                    let (from, weight) = (part(&object.1[operator.sources[at] as usize]), operator.weights[at]);
                    let value = f64::from(weight * patch.area);
                    power[part(patch)][from] += value;
                    variance[part(patch)][from] += value * f64::from(patch.area) / 1024.0;
                }
            }
            let mut compared = 0;
            for i in 0..4 {
                for j in 0..i {
                    let noise = (variance[i][j] + variance[j][i]).sqrt();
                    let apart = (power[i][j] - power[j][i]).abs();
                    assert!(apart < 4.0 * noise, "{i} {j}: {} {} {noise}", power[i][j], power[j][i]);
                    compared += u32::from(noise < 0.1 * power[i][j]);
                }
            }
            assert!(compared == 6, "{compared}: {power:?}");
        }
    }
}

/// `[eq:exit-walks]` `[eq:angular-exit]`: a half-space returns, from every angle, what Chandrasekhar's H functions say.
#[test]
fn a_half_space_returns_what_it_should() {
    let geometry = Geometry::Slab { bottom: f32::NEG_INFINITY, top: 0.0 };
    let patches = [Patch { position: Vec3::ZERO, normal: Vec3::Z, area: 1.0 }];
    let options = ExitWalkOptions { walks: 100_000, max_events: 2000, seed: 1 };
    let walks = ExitWalks::trace(&geometry, 1.0, 0.0, Boundary::IndexMatched, &patches, &options, &|_| ()).unwrap();
    assert!(walks.fates().cut > 0.0 && walks.lost_by_cutting(0.99) < 1e-9);
    for albedo in [0.3f32, 0.8, 0.95, 0.99] {
        let returned = |mu: f64| half_space_albedo(f64::from(albedo), mu);
        let n = 200;
        let total: f64 = (0..n)
            .map(|k| {
                let mu = (f64::from(k) + 0.5) / f64::from(n);
                returned(mu) * 2.0 * mu / f64::from(n)
            })
            .sum();
        let found = walks.diffuse_albedo(albedo);
        assert!((found - total).abs() < 0.006 * total, "{albedo}: {found} {total}");
        let angular = walks.angular(albedo).unwrap();
        for mu in [0.1f32, 0.3, 0.5, 0.7, 0.9] {
            let expected = returned(f64::from(mu)) / total;
            assert!(
                (f64::from(angular.at(mu)) - expected).abs() < 0.03,
                "{albedo} {mu}: {} {expected}",
                angular.at(mu)
            );
        }
    }
}

/// `[eq:exit-moments]`: powers of the albedo give what the matrix gives, up to the bins.
#[test]
fn moments_agree_with_the_matrix() {
    for boundary in [Boundary::IndexMatched, Boundary::Smooth { eta: 1.4 }] {
        let object = ball(2);
        let walks = traced(&object, 15.0, 0.0, boundary, 200);
        let (irradiance, cosines) = lit(&object.1, &[Vec3::X, Vec3::new(0.5, -1.0, 0.2)]);
        let moments = walks.moments(&irradiance, &cosines).unwrap();
        assert!(moments.exponents.len() < 40 && moments.exponents.is_sorted(), "{:?}", moments.exponents);
        assert_eq!(moments.values.len(), irradiance.len() * moments.exponents.len());
        for albedo in [0.0f32, 0.3, 0.9, 0.99, 0.999, 1.0] {
            let bins = moments.radiosity(albedo);
            let exact = walks.radiosity(albedo, &irradiance, &cosines).unwrap();
            let (a, b): (f32, f32) = (bins.iter().sum(), exact.iter().sum());
            let difference: f32 = bins.iter().zip(&exact).map(|(a, b)| (a - b).abs()).sum();
            // The mean of a product of angular function and place is not the product of the means.
            assert!(
                (a - b).abs() <= 0.006 * b && difference <= 0.05 * b,
                "{boundary:?} {albedo}: {a} {b} {difference}"
            );
            assert!(walks.moment_error(albedo).unwrap() < 0.002, "{albedo} {}", walks.moment_error(albedo).unwrap());
        }
        let factors = moments.exit_factors(0.6);
        assert_eq!(factors.len(), moments.exponents.len());
        assert!(factors.iter().all(|f| *f > 0.2 && *f < 0.6), "{factors:?}");
    }
}

/// The sum over lights is the light of the sum, and rows mean the same whatever else is lit.
#[test]
fn radiosity_is_linear_in_light() {
    let object = ball(1);
    let walks = traced(&object, 4.0, 0.6, ROUGH, 100);
    let (irradiance, cosines) = lit(&object.1, &[Vec3::X, Vec3::Y, Vec3::new(-1.0, 1.0, 0.4)]);
    let all = walks.radiosity(0.9, &irradiance, &cosines).unwrap();
    for light in 0..3 {
        let column = |v: &[f32]| -> Vec<f32> { v.iter().skip(light).step_by(3).copied().collect() };
        let double: Vec<f32> = column(&irradiance).iter().map(|e| 2.0 * e).collect();
        let alone = walks.radiosity(0.9, &double, &column(&cosines)).unwrap();
        assert!(alone.iter().zip(column(&all)).all(|(a, b)| (a - 2.0 * b).abs() <= 1e-6 * a.abs()));
    }
}

#[test]
fn bits_do_not_depend_on_threads() {
    let object = pair();
    let one = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let walks = traced(&object, 5.0, 0.2, ROUGH, 20);
            let (irradiance, cosines) = lit(&object.1, &[Vec3::X]);
            (walks.collapse(0.9).unwrap(), walks.moments(&irradiance, &cosines).unwrap(), walks.fates())
        })
    };
    assert_eq!(one(1), one(3));
}

#[test]
fn what_makes_no_sense_is_refused() {
    let (geometry, patches) = ball(1);
    let options = ExitWalkOptions { walks: 4, ..Default::default() };
    let trace = |sigma_t: f32, g: f32, boundary: Boundary, options: &ExitWalkOptions| {
        ExitWalks::trace(&geometry, sigma_t, g, boundary, &patches, options, &|_| ())
    };
    for sigma_t in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        assert!(trace(sigma_t, 0.0, ROUGH, &options).is_err());
    }
    assert!(trace(1.0, 1.0, ROUGH, &options).is_err());
    assert!(trace(1.0, 0.0, Boundary::Smooth { eta: f32::NAN }, &options).is_err());
    assert!(trace(1.0, 0.0, ROUGH, &ExitWalkOptions { walks: 0, ..options }).is_err());
    assert!(trace(1.0, 0.0, ROUGH, &ExitWalkOptions { max_events: 70_000, ..options }).is_err());
    assert!(ExitWalks::trace(&geometry, 1.0, 0.0, ROUGH, &[], &options, &|_| ()).is_err());
    let mut broken = patches.clone();
    broken[3].position.x = f32::NAN;
    let error = ExitWalks::trace(&geometry, 1.0, 0.0, ROUGH, &broken, &options, &|_| ()).unwrap_err();
    assert!(error.to_string().contains("index 3"), "{error}");
    let walks = trace(1.0, 0.0, ROUGH, &options).unwrap();
    assert!(walks.collapse(1.1).is_err() && walks.angular(f32::NAN).is_err());
    assert!(walks.radiosity(0.5, &[1.0], &[1.0]).is_err() && walks.moments(&[], &[]).is_err());
    // Surfels anywhere, media of any density: finite.
    let mut rng = Rng::new(1, 1);
    for k in 0..20 {
        let patch = |rng: &mut Rng| Patch {
            position: Vec3::new(rng.uniform(), rng.uniform(), rng.uniform()) * 4.0 - 2.0,
            normal: crate::sampling::uniform_sphere(rng),
            area: rng.uniform() + 1e-6,
        };
        let patches: Vec<Patch> = (0..1 + k).map(|_| patch(&mut rng)).collect();
        let options = ExitWalkOptions { walks: 4, max_events: 300, seed: k };
        let sigma_t = 10f32.powi(k as i32 - 10);
        let walks = ExitWalks::trace(&geometry, sigma_t, 0.9, ROUGH, &patches, &options, &|_| ()).unwrap();
        let ones = vec![1.0; patches.len()];
        assert!(walks.radiosity(0.9, &ones, &ones).unwrap().iter().all(|m| m.is_finite() && *m >= 0.0));
    }
}
