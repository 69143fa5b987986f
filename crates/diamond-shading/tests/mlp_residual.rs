//! The subsurface residual network with its inputs, and the light-linear transfer, against the dual-number oracle.
use diamond_shading::{
    CHUNK_ROWS, InputGradients, InputScaling, LightDistanceInput, Mlp, RESIDUAL_INPUTS, ResidualInputs,
    ResidualNetwork, ResidualNetworkConfig, ScaleInput, ShadingError, TransferActivation, TransferConfig,
    transfer_radiance,
};
use diamond_testkit::adjoint::{adjoint_gap, relative_l2};
use diamond_testkit::mlp::{self as oracle, LengthScales, Nonlinearity, ResidualRow};
use diamond_testkit::{Dual, Real, jvp, vjp};
use glam::{Quat, Vec3};
use proptest::prelude::*;

fn generator(seed: u64) -> impl FnMut() -> f32 {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / 16_777_216.0
    }
}

fn numbers(count: usize, seed: u64) -> Vec<f32> {
    let mut uniform = generator(seed);
    (0..count).map(|_| 2.0 * uniform() - 1.0).collect()
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| v.into()).collect()
}

#[cfg(feature = "parallel")]
fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

/// Owned arrays of a batch.
struct Rows {
    positions: Vec<Vec3>,
    rotations: Vec<Quat>,
    scales: Vec<Vec3>,
    view_directions: Vec<Vec3>,
    light_directions: Vec<Vec3>,
    normals: Vec<Vec3>,
    visibility: Vec<f32>,
    light_distances: Vec<f32>,
    codes: Vec<f32>,
    code_size: usize,
}

impl Rows {
    fn random(rows: usize, code_size: usize, seed: u64) -> Self {
        let mut uniform = generator(seed);
        let mut vectors = |low: f32, high: f32| -> Vec<Vec3> {
            let mut number = || low + (high - low) * uniform();
            (0..rows).map(|_| Vec3::new(number(), number(), number())).collect()
        };
        let unit = |v: Vec<Vec3>| v.into_iter().map(|v| v.normalize_or(Vec3::Z)).collect();
        Self {
            positions: vectors(-1.4, 1.9),
            scales: vectors(0.01, 0.5),
            view_directions: unit(vectors(-1.0, 1.0)),
            light_directions: unit(vectors(-1.0, 1.0)),
            normals: unit(vectors(-1.0, 1.0)),
            rotations: vectors(-1.0, 1.0).into_iter().map(|v| Quat::from_scaled_axis(3.0 * v)).collect(),
            visibility: vectors(0.0, 1.0).into_iter().map(|v| v.x).collect(),
            light_distances: vectors(0.5, 6.0).into_iter().map(|v| v.x).collect(),
            codes: numbers(rows * code_size, seed + 77),
            code_size,
        }
    }

    fn inputs(&self) -> ResidualInputs<'_> {
        ResidualInputs {
            positions: &self.positions,
            rotations: &self.rotations,
            scales: &self.scales,
            view_directions: &self.view_directions,
            light_directions: &self.light_directions,
            normals: &self.normals,
            visibility: &self.visibility,
            light_distances: &self.light_distances,
            codes: &self.codes,
            code_size: self.code_size,
        }
    }

    /// Per row 3 + 4 + 3 + 3 + 3 + 3 + 1 + 1 + K values, as [`oracle_row`] reads them.
    fn flat(&self) -> Vec<f64> {
        let v3 = |v: Vec3| v.to_array();
        let flat = (0..self.positions.len()).flat_map(|i| {
            let q = self.rotations[i];
            let mut row = v3(self.positions[i]).to_vec();
            row.extend([q.w, q.x, q.y, q.z]);
            row.extend(v3(self.scales[i]));
            row.extend(v3(self.view_directions[i]));
            row.extend(v3(self.light_directions[i]));
            row.extend(v3(self.normals[i]));
            row.extend([self.visibility[i], self.light_distances[i]]);
            row.extend(&self.codes[i * self.code_size..][..self.code_size]);
            row
        });
        flat.map(f64::from).collect()
    }
}

const RAW: usize = 21;

fn oracle_row<T: Real>(x: &[T]) -> ResidualRow<T> {
    let three = |i: usize| [x[i], x[i + 1], x[i + 2]];
    ResidualRow {
        position: three(0),
        rotation: [x[3], x[4], x[5], x[6]],
        scale: three(7),
        view: three(10),
        light: three(13),
        normal: three(16),
        visibility: x[19],
        light_distance: x[20],
        code: x[RAW..].to_vec(),
    }
}

/// The two ways to make lengths dimensionless, for the crate and for the oracle.
fn scalings() -> [(InputScaling, LengthScales); 2] {
    let (low, high) = (Vec3::new(-1.0, -2.0, -1.5), Vec3::new(1.5, 1.0, 2.5));
    let wide3 = |v: Vec3| v.to_array().map(f64::from);
    [(None, None), (Some(1.75), Some(2.5))].map(|(scale, distance): (Option<f32>, Option<f32>)| {
        let scaling = InputScaling {
            bounds_min: low,
            bounds_max: high,
            scale: scale.map_or(ScaleInput::Linear, |reference| ScaleInput::Logarithmic { reference }),
            light_distance: distance
                .map_or(LightDistanceInput::Linear, |reference| LightDistanceInput::Bounded { reference }),
        };
        let lengths = LengthScales {
            bounds_min: wide3(low),
            bounds_max: wide3(high),
            log_scale_reference: scale.map(f64::from),
            distance_reference: distance.map(f64::from),
        };
        (scaling, lengths)
    })
}

fn dense<T: Real>(mlp: &Mlp, parameters: &[T], x: &[T]) -> Vec<T> {
    let nonlinearity = |activation| match activation {
        diamond_shading::Activation::Linear => Nonlinearity::Linear,
        diamond_shading::Activation::Relu => Nonlinearity::Leaky(0.0),
        diamond_shading::Activation::LeakyRelu(slope) => Nonlinearity::Leaky(slope.into()),
        diamond_shading::Activation::Sigmoid => Nonlinearity::Sigmoid,
    };
    let (hidden, output) = (nonlinearity(mlp.shape.hidden), nonlinearity(mlp.shape.output));
    oracle::dense_network(&mlp.shape.widths, hidden, output, parameters, x)
}

/// From all parameters and all rows' raw values to [residual of all rows, incident of all rows].
fn oracle_network<'a>(
    network: &'a ResidualNetwork,
    lengths: &'a LengthScales,
    code_size: usize,
) -> impl Fn(&[Dual]) -> Vec<Dual> + 'a {
    move |x| {
        let (trunk, x) = x.split_at(network.trunk.parameters.len());
        let (residual_head, x) = x.split_at(network.residual_head.parameters.len());
        let (incident_head, x) = x.split_at(network.incident_head.as_ref().map_or(0, |h| h.parameters.len()));
        let (mut residual, mut incident) = (Vec::new(), Vec::new());
        for row in x.chunks(RAW + code_size) {
            let features = dense(&network.trunk, trunk, &oracle::residual_inputs(&oracle_row(row), lengths));
            residual.extend(dense(&network.residual_head, residual_head, &features));
            if let Some(head) = &network.incident_head {
                incident.extend(dense(head, incident_head, &features));
            }
        }
        residual.extend(incident);
        residual
    }
}

fn config(paper: bool, code_size: usize) -> ResidualNetworkConfig {
    let preset = if paper { ResidualNetworkConfig::paper() } else { ResidualNetworkConfig::sss_3dgs() };
    // A bright start, so that the incident head's rectifier passes gradients.
    ResidualNetworkConfig { code_size, incident_bias: 1.0, ..preset }
}

/// [eq:residual-network] [eq:residual-inputs] ⟨ū, J·ẋ⟩ = ⟨Jᵀ·ū, ẋ⟩ from Gaussians' attributes, codes and all parameters
/// to residual and incident light.
#[test]
fn adjoint_identity_from_attributes_to_residual() {
    let mut worst = (0.0f64, 0.0f64);
    for (paper, code_size) in [(false, 0), (false, 5), (true, 0), (true, 3)] {
        for (scaling, lengths) in scalings() {
            for rows in [1, CHUNK_ROWS + 1] {
                let data = Rows::random(rows, code_size, 11);
                let network = ResidualNetwork::initialise(&config(paper, code_size), &mut generator(5)).unwrap();
                let inputs = data.inputs();
                let (matrix, input_pullback) = inputs.assemble(&scaling).unwrap();
                assert_eq!(matrix.len(), rows * (RESIDUAL_INPUTS + code_size));
                let (output, pullback) = network.forward(&matrix, rows).unwrap();
                let (d_residual, d_incident) = (numbers(3 * rows, 6), numbers(output.incident.len(), 7));
                let grad = pullback.pull(&d_residual, &d_incident, true).unwrap();
                let g = input_pullback.pull(grad.inputs.as_ref().unwrap(), InputGradients::All).unwrap();
                let learned = input_pullback.pull(grad.inputs.as_ref().unwrap(), InputGradients::Learned).unwrap();
                assert!(learned.normals == g.normals && learned.codes == g.codes && learned.positions.is_empty());

                let incident_parameters = network.incident_head.as_ref().map(|h| h.parameters.clone());
                let mut point = wide(&network.trunk.parameters);
                point.extend(wide(&network.residual_head.parameters));
                point.extend(wide(&incident_parameters.unwrap_or_default()));
                point.extend(data.flat());
                let mut vjp = wide(&[grad.trunk, grad.residual_head, grad.incident_head.unwrap_or_default()].concat());
                let pulled = Rows {
                    positions: g.positions,
                    rotations: g.rotations,
                    scales: g.scales,
                    view_directions: g.view_directions,
                    light_directions: g.light_directions,
                    normals: g.normals,
                    visibility: g.visibility,
                    light_distances: g.light_distances,
                    codes: g.codes,
                    code_size,
                };
                vjp.extend(pulled.flat());

                let f = oracle_network(&network, &lengths, code_size);
                let tangent = wide(&numbers(point.len(), 8));
                let dual: Vec<Dual> = point.iter().zip(&tangent).map(|(&v, &d)| Dual::new(v, d)).collect();
                let expected = f(&dual);
                let values: Vec<f64> = expected.iter().map(|y| y.v).collect();
                let jvp: Vec<f64> = expected.iter().map(|y| y.d).collect();
                let error = relative_l2(&wide(&[output.residual, output.incident].concat()), &values, 0.0);
                let cotangent = wide(&[d_residual, d_incident].concat());
                let gap = adjoint_gap(&cotangent, &jvp, &vjp, &tangent);
                worst = (worst.0.max(error), worst.1.max(gap));
                assert!(error < 1e-5 && gap < 1e-5, "paper {paper} K {code_size} rows {rows}: {error} {gap}");

                // Self-test: without the incident head's part of the trunk's gradient the identity fails.
                if !paper && rows > 1 {
                    let partial = pullback.pull(&cotangent_f32(&cotangent[..3 * rows]), &[], false).unwrap();
                    for (v, p) in vjp.iter_mut().zip(&partial.trunk) {
                        *v = f64::from(*p);
                    }
                    assert!(adjoint_gap(&cotangent, &jvp, &vjp, &tangent) > 1e-4, "a blocked gradient went unnoticed");
                }
            }
        }
    }
    println!("worst value error {:e}, adjoint gap {:e}", worst.0, worst.1);
}

fn cotangent_f32(values: &[f64]) -> Vec<f32> {
    values.iter().map(|&v| v as f32).collect()
}

/// [eq:residual-inputs] every column, and each attribute's gradient, against dual numbers.
#[test]
fn inputs_match_the_oracle_column_by_column() {
    for (scaling, lengths) in scalings() {
        let data = Rows::random(40, 2, 3);
        let (matrix, pullback) = data.inputs().assemble(&scaling).unwrap();
        let d = numbers(matrix.len(), 4);
        let g = pullback.pull(&d, InputGradients::All).unwrap();
        for (i, raw) in data.flat().chunks(RAW + 2).enumerate() {
            let expected = oracle::residual_inputs(&oracle_row(raw), &lengths);
            let found = &matrix[i * 44..][..44];
            for (column, (found, expected)) in found.iter().zip(&expected).enumerate() {
                let gap = (f64::from(*found) - expected).abs();
                assert!(gap < 1e-5, "row {i} column {column}: {found} {expected}");
            }
            let cotangent = wide(&d[i * 44..][..44]);
            let expected = vjp(|x: &[Dual]| oracle::residual_inputs(&oracle_row(x), &lengths), raw, &cotangent);
            let found: Vec<f64> = wide(
                &[
                    g.positions[i].to_array().as_slice(),
                    &[g.rotations[i].w, g.rotations[i].x, g.rotations[i].y, g.rotations[i].z],
                    &g.scales[i].to_array(),
                    &g.view_directions[i].to_array(),
                    &g.light_directions[i].to_array(),
                    &g.normals[i].to_array(),
                    &[g.visibility[i], g.light_distances[i], g.codes[2 * i], g.codes[2 * i + 1]],
                ]
                .concat(),
            );
            for (k, (found, expected)) in found.iter().zip(&expected).enumerate() {
                assert!(
                    (found - expected).abs() < 1e-4 * expected.abs().max(1.0),
                    "row {i} value {k}: {found} {expected}"
                );
            }
        }
    }
}

#[test]
fn extreme_inputs_stay_finite() {
    let extreme = [f32::MAX, -f32::MAX, 0.0, 1e-45, 1e20, 1.0, f32::MIN_POSITIVE];
    let rows = 70;
    let at = |i: usize| extreme[i % 7];
    let vectors =
        |step: usize| -> Vec<Vec3> { (0..rows).map(|i| Vec3::new(at(i), at(i * step + 1), at(i + step))).collect() };
    let data = Rows {
        positions: vectors(3),
        rotations: vectors(2).iter().map(|v| Quat::from_xyzw(v.x, v.y, v.z, v.x)).collect(),
        scales: vectors(4),
        view_directions: vectors(5),
        light_directions: vectors(6),
        normals: vectors(1),
        visibility: (0..rows).map(at).collect(),
        light_distances: (0..rows).map(|i| if i % 8 == 7 { f32::INFINITY } else { at(i) }).collect(),
        codes: (0..rows).map(at).collect(),
        code_size: 1,
    };
    for (mut scaling, _) in scalings() {
        for bounds in
            [(Vec3::ZERO, Vec3::ZERO), (Vec3::splat(-f32::MAX), Vec3::splat(f32::MAX)), (Vec3::NEG_ONE, Vec3::ONE)]
        {
            (scaling.bounds_min, scaling.bounds_max) = bounds;
            let network = ResidualNetwork::initialise(&config(false, 1), &mut generator(5)).unwrap();
            let inputs = data.inputs();
            let (matrix, input_pullback) = inputs.assemble(&scaling).unwrap();
            let (output, pullback) = network.forward(&matrix, rows).unwrap();
            let d: Vec<f32> = (0..3 * rows).map(at).collect();
            let grad = pullback.pull(&d, &d[..rows], true).unwrap();
            let g = input_pullback.pull(grad.inputs.as_ref().unwrap(), InputGradients::All).unwrap();
            let flat = |v: &[Vec3]| v.iter().flat_map(|v| v.to_array()).collect::<Vec<_>>();
            for values in [
                &matrix,
                &output.residual,
                &output.incident,
                &grad.trunk,
                &grad.residual_head,
                &flat(&g.positions),
                &flat(&g.scales),
                &flat(&g.normals),
                &g.visibility,
                &g.light_distances,
                &g.codes,
            ] {
                assert!(values.iter().all(|v| v.is_finite()), "{bounds:?}");
            }
        }
    }
    for activation in [TransferActivation::Linear, TransferActivation::Softplus { sharpness: 20.0 }] {
        let config = TransferConfig { degree: 3, activation };
        let transfer: Vec<f32> = (0..rows * 48).map(|i| at(i * 5)).collect();
        let (radiance, pullback) = transfer_radiance(&transfer, &data.light_directions, config).unwrap();
        let d: Vec<f32> = (0..3 * rows).map(at).collect();
        let grad = pullback.pull(&d, true).unwrap();
        assert!(radiance.iter().chain(&grad.transfer).all(|v| v.is_finite()));
        assert!(grad.light_directions.unwrap().iter().all(|v| v.is_finite()));
    }
}

#[test]
fn empty_batches_are_valid() {
    let network = ResidualNetwork::initialise(&config(false, 0), &mut generator(5)).unwrap();
    let data = Rows::random(0, 0, 1);
    let inputs = data.inputs();
    let (matrix, input_pullback) = inputs.assemble(&scalings()[0].0).unwrap();
    let (output, pullback) = network.forward(&matrix, 0).unwrap();
    assert!(output.residual.is_empty() && output.incident.is_empty());
    let grad = pullback.pull(&[], &[], true).unwrap();
    assert_eq!(grad.trunk.len(), network.trunk.parameters.len());
    assert_eq!(grad.inputs, Some(vec![]));
    assert!(input_pullback.pull(&[], InputGradients::All).unwrap().positions.is_empty());
}

#[test]
fn shapes_are_checked() {
    let mut data = Rows::random(4, 0, 1);
    data.normals.pop();
    assert!(matches!(
        data.inputs().assemble(&scalings()[0].0),
        Err(ShadingError::Shape { what: "ResidualInputs::normals", .. })
    ));
    let network = ResidualNetwork::initialise(&config(true, 0), &mut generator(5)).unwrap();
    let inputs = vec![0.0; 42];
    let (_, pullback) = network.forward(&inputs, 1).unwrap();
    assert!(matches!(pullback.pull(&[0.0; 3], &[0.0], true), Err(ShadingError::Shape { .. })));
    let config = TransferConfig { degree: 4, activation: TransferActivation::Linear };
    assert!(matches!(transfer_radiance(&[], &[], config), Err(ShadingError::Setting { .. })));
    let config = TransferConfig { degree: 1, activation: TransferActivation::Softplus { sharpness: 0.0 } };
    assert!(matches!(transfer_radiance(&[], &[], config), Err(ShadingError::Setting { .. })));
}

#[cfg(feature = "parallel")]
#[test]
fn the_number_of_threads_does_not_change_a_bit() {
    let rows = 4001;
    let data = Rows::random(rows, 2, 9);
    let network = ResidualNetwork::initialise(&config(false, 2), &mut generator(5)).unwrap();
    let transfer = numbers(rows * 48, 10);
    let (d_residual, d_incident) = (numbers(3 * rows, 6), numbers(rows, 7));
    let run = |threads: usize| {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
            let (matrix, input_pullback) = data.inputs().assemble(&scalings()[1].0).unwrap();
            let (output, pullback) = network.forward(&matrix, rows).unwrap();
            let grad = pullback.pull(&d_residual, &d_incident, true).unwrap();
            let g = input_pullback.pull(grad.inputs.as_ref().unwrap(), InputGradients::All).unwrap();
            let positions: Vec<f32> = g.positions.iter().flat_map(|v| v.to_array()).collect();
            let config = TransferConfig { degree: 3, activation: TransferActivation::Softplus { sharpness: 30.0 } };
            let (radiance, pullback) = transfer_radiance(&transfer, &data.light_directions, config).unwrap();
            let t = pullback.pull(&d_residual, true).unwrap();
            let parts = [
                output.residual,
                output.incident,
                grad.trunk,
                grad.incident_head.unwrap(),
                positions,
                radiance,
                t.transfer,
            ];
            parts.map(|p| bits(&p))
        })
    };
    let one = run(1);
    assert!(one == run(2) && one == run(3));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..Default::default() })]

    /// [eq:light-transfer] value and both gradients against dual numbers.
    #[test]
    fn transfer_matches_dual_numbers(
        degree in 0usize..4,
        sharpness in prop::option::of(1.0f32..60.0),
        seed in 0u64..1000,
        rows in 1usize..4,
    ) {
        let activation = sharpness.map_or(TransferActivation::Linear, |sharpness| TransferActivation::Softplus { sharpness });
        let config = TransferConfig { degree, activation };
        let size = 3 * config.coefficients();
        let transfer = numbers(rows * size, seed);
        let lights: Vec<Vec3> = numbers(3 * rows, seed + 1).chunks(3).map(|v| Vec3::from_slice(v).normalize_or(Vec3::X)).collect();
        let d = numbers(3 * rows, seed + 2);
        let (radiance, pullback) = transfer_radiance(&transfer, &lights, config).unwrap();
        let grad = pullback.pull(&d, true).unwrap();
        let beta = sharpness.map(f64::from);
        for i in 0..rows {
            let mut point = wide(&transfer[i * size..][..size]);
            point.extend(wide(&lights[i].to_array()));
            // The oracle's functions hold on the unit sphere: compare along it by normalising inside.
            let f = |x: &[Dual]| {
                let (t, l) = x.split_at(size);
                let length = (l[0] * l[0] + l[1] * l[1] + l[2] * l[2]).sqrt();
                oracle::transfer_radiance(t, [l[0] / length, l[1] / length, l[2] / length], degree, beta)
            };
            let expected = jvp(|x| f(x).iter().map(|y| Dual::new(0.0, y.v)).collect(), &point, &vec![0.0; size + 3]);
            let found = wide(&radiance[3 * i..][..3]);
            prop_assert!(relative_l2(&found, &expected, 1e-2) < 1e-5, "{found:?} {expected:?}");
            let expected = vjp(f, &point, &wide(&d[3 * i..][..3]));
            let free = grad.light_directions.as_ref().unwrap()[i];
            let tangential = free - lights[i] * lights[i].dot(free);
            let found = wide(&[&grad.transfer[i * size..][..size], tangential.to_array().as_slice()].concat());
            let error = relative_l2(&found, &expected, 1e-2);
            prop_assert!(error < 2e-5, "{error}");
        }
    }

    /// [eq:light-transfer] the linear transfer adds over coefficients; softplus is positive and above it by at most ln 2/β.
    #[test]
    fn transfer_is_linear_and_softplus_bounds_it(seed in 0u64..1000, sharpness in 1.0f32..60.0) {
        let (a, b) = (numbers(48, seed), numbers(48, seed + 1));
        let light = [Vec3::from_slice(&numbers(3, seed + 2)).normalize_or(Vec3::X)];
        let sum: Vec<f32> = a.iter().zip(&b).map(|(a, b)| a + b).collect();
        let linear = TransferConfig { degree: 3, activation: TransferActivation::Linear };
        let soft = TransferConfig { degree: 3, activation: TransferActivation::Softplus { sharpness } };
        let run = |t: &[f32], config| transfer_radiance(t, &light, config).unwrap().0;
        for c in 0..3 {
            let (x, y) = (run(&sum, linear)[c], run(&sum, soft)[c]);
            prop_assert!((run(&a, linear)[c] + run(&b, linear)[c] - x).abs() < 1e-5);
            prop_assert!(y >= 0.0 && y >= x - 1e-6 && y <= x.max(0.0) + std::f32::consts::LN_2 / sharpness + 1e-6);
        }
    }
}
