//! The dense network against the dual-number oracle, its determinism, and that it learns.
use diamond_shading::{Activation, CHUNK_ROWS, Mlp, MlpShape, ShadingError};
use diamond_testkit::adjoint::{adjoint_gap, relative_l2};
use diamond_testkit::mlp::{Nonlinearity, dense_network};
use diamond_testkit::{Dual, jvp, vjp};
use proptest::prelude::*;

/// Uniform numbers in [0, 1) (a 64-bit multiplicative congruence).
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

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

fn nonlinearity(activation: Activation) -> Nonlinearity {
    match activation {
        Activation::Linear => Nonlinearity::Linear,
        Activation::Relu => Nonlinearity::Leaky(0.0),
        Activation::LeakyRelu(slope) => Nonlinearity::Leaky(slope.into()),
        Activation::Sigmoid => Nonlinearity::Sigmoid,
    }
}

fn network(widths: &[usize], hidden: Activation, output: Activation, seed: u64) -> Mlp {
    let shape = MlpShape { widths: widths.to_vec(), hidden, output };
    Mlp::initialise(shape, false, &mut generator(seed)).unwrap()
}

const ACTIVATIONS: [Activation; 4] =
    [Activation::Linear, Activation::Relu, Activation::LeakyRelu(0.01), Activation::Sigmoid];

/// The oracle's outputs of a whole batch as a function of parameters followed by inputs.
fn oracle(mlp: &Mlp, batch: usize) -> impl Fn(&[Dual]) -> Vec<Dual> {
    let shape = mlp.shape.clone();
    move |x| {
        let (parameters, inputs) = x.split_at(shape.parameter_count());
        let (hidden, output) = (nonlinearity(shape.hidden), nonlinearity(shape.output));
        let rows = (0..batch).map(|row| &inputs[row * shape.inputs()..][..shape.inputs()]);
        rows.flat_map(|row| dense_network(&shape.widths, hidden, output, parameters, row)).collect()
    }
}

/// Parameters, then inputs, in f64.
fn point(mlp: &Mlp, inputs: &[f32]) -> Vec<f64> {
    wide(&[mlp.parameters.as_slice(), inputs].concat())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, failure_persistence: None, ..Default::default() })]

    /// [eq:mlp] against dual numbers, for every pair of activations and odd sizes.
    #[test]
    fn values_and_gradients_match_dual_numbers(
        widths in prop::collection::vec(1usize..11, 2..5),
        hidden in prop::sample::select(ACTIVATIONS.to_vec()),
        output in prop::sample::select(ACTIVATIONS.to_vec()),
        batch in 1usize..9,
        seed in 0u64..1000,
    ) {
        let mlp = network(&widths, hidden, output, seed);
        let inputs = numbers(batch * mlp.shape.inputs(), seed + 1);
        let d_outputs = numbers(batch * mlp.shape.outputs(), seed + 2);
        let (outputs, pullback) = mlp.forward(&inputs, batch).unwrap();
        let expected: Vec<f64> = jvp(|x| oracle(&mlp, batch)(x).iter().map(|y| Dual::new(0.0, y.v)).collect(),
            &point(&mlp, &inputs), &vec![0.0; mlp.parameters.len() + inputs.len()]);
        prop_assert!(relative_l2(&wide(&outputs), &expected, 1e-3) < 1e-5);
        let grad = pullback.pull(&d_outputs, true).unwrap();
        let found = wide(&[grad.parameters.as_slice(), &grad.inputs.unwrap()].concat());
        let expected = vjp(oracle(&mlp, batch), &point(&mlp, &inputs), &wide(&d_outputs));
        let error = relative_l2(&found, &expected, 1e-3);
        prop_assert!(error < 1e-5, "relative error {error}");
        // The same parameters' gradient when no input gradient is wanted.
        let alone = pullback.pull(&d_outputs, false).unwrap();
        prop_assert_eq!(alone.inputs, None);
        prop_assert_eq!(bits(&alone.parameters), bits(&grad.parameters));
    }
}

/// [eq:mlp] ⟨ū, J·ẋ⟩ = ⟨Jᵀ·ū, ẋ⟩ at the sizes in use, for batches around a chunk.
#[test]
fn adjoint_identity_at_the_sizes_in_use() {
    let mut worst = 0.0f64;
    for (widths, hidden) in [
        (vec![42, 64, 32, 32], Activation::LeakyRelu(0.01)),
        (vec![42, 64, 64, 64, 64, 3], Activation::Relu),
        (vec![17, 33, 1, 5], Activation::Sigmoid),
        (vec![1, 1], Activation::Linear),
    ] {
        for batch in [1, CHUNK_ROWS - 1, CHUNK_ROWS, CHUNK_ROWS + 1] {
            let mlp = network(&widths, hidden, Activation::Linear, 3);
            let inputs = numbers(batch * mlp.shape.inputs(), 4);
            let d_outputs = numbers(batch * mlp.shape.outputs(), 5);
            let tangent = wide(&numbers(mlp.parameters.len() + inputs.len(), 6));
            let grad = mlp.forward(&inputs, batch).unwrap().1.pull(&d_outputs, true).unwrap();
            let vjp = wide(&[grad.parameters.as_slice(), &grad.inputs.unwrap()].concat());
            let jvp = jvp(oracle(&mlp, batch), &point(&mlp, &inputs), &tangent);
            let gap = adjoint_gap(&wide(&d_outputs), &jvp, &vjp, &tangent);
            worst = worst.max(gap);
            assert!(gap < 1e-5, "{widths:?} batch {batch}: {gap}");
        }
    }
    println!("worst adjoint gap {worst:e}");
}

/// Self-test of the harness: a first layer whose gradient is 2 % too small is noticed.
#[test]
fn a_broken_gradient_is_noticed() {
    let mlp = network(&[42, 64, 32, 32], Activation::LeakyRelu(0.01), Activation::Linear, 3);
    let (inputs, d_outputs) = (numbers(50 * 42, 4), numbers(50 * 32, 5));
    let tangent = wide(&numbers(mlp.parameters.len() + inputs.len(), 6));
    let grad = mlp.forward(&inputs, 50).unwrap().1.pull(&d_outputs, true).unwrap();
    let mut vjp = wide(&[grad.parameters.as_slice(), &grad.inputs.unwrap()].concat());
    vjp[..42 * 64].iter_mut().for_each(|d| *d *= 0.98);
    let jvp = jvp(oracle(&mlp, 50), &point(&mlp, &inputs), &tangent);
    let gap = adjoint_gap(&wide(&d_outputs), &jvp, &vjp, &tangent);
    assert!(gap > 1e-5, "{gap}");
}

/// A row's outputs and input gradient do not depend on its batch, to the bit; parameter gradients add up.
#[test]
fn rows_are_independent_of_their_batch() {
    let mlp = network(&[42, 64, 32, 5], Activation::LeakyRelu(0.01), Activation::Sigmoid, 1);
    let (all_inputs, all_d) = (numbers(1000 * 42, 2), numbers(1000 * 5, 3));
    let (outputs, pullback) = mlp.forward(&all_inputs, 1000).unwrap();
    let all = pullback.pull(&all_d, true).unwrap();
    let d_inputs = all.inputs.unwrap();
    for batch in [0, 1, 63, 64, 65, 95, 96, 97, 193] {
        let (inputs, d) = (&all_inputs[..batch * 42], &all_d[..batch * 5]);
        let (part, pullback) = mlp.forward(inputs, batch).unwrap();
        let grad = pullback.pull(d, true).unwrap();
        assert_eq!(bits(&part), bits(&outputs[..batch * 5]));
        assert_eq!(bits(&grad.inputs.unwrap()), bits(&d_inputs[..batch * 42]));
        assert_eq!(grad.parameters.len(), mlp.parameters.len());
        if batch == 0 {
            assert!(grad.parameters.iter().all(|&g| g == 0.0));
        }
    }
    let halves: Vec<Vec<f32>> = [0..500, 500..1000]
        .map(|rows| {
            let inputs = &all_inputs[rows.start * 42..rows.end * 42];
            mlp.forward(inputs, 500).unwrap().1.pull(&all_d[rows.start * 5..rows.end * 5], false).unwrap().parameters
        })
        .into();
    let sum: Vec<f64> = halves[0].iter().zip(&halves[1]).map(|(&a, &b)| f64::from(a) + f64::from(b)).collect();
    assert!(relative_l2(&wide(&all.parameters), &sum, 0.0) < 1e-6);
}

#[cfg(feature = "parallel")]
#[test]
fn the_number_of_threads_does_not_change_a_bit() {
    let batch = CHUNK_ROWS * diamond_shading::GRADIENT_GROUPS * 2 + 17;
    let mlp = network(&[42, 64, 64, 3], Activation::Relu, Activation::Sigmoid, 8);
    let (inputs, d_outputs) = (numbers(batch * 42, 9), numbers(batch * 3, 10));
    let run = |threads: usize| {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
            let (outputs, pullback) = mlp.forward(&inputs, batch).unwrap();
            let grad = pullback.pull(&d_outputs, true).unwrap();
            (bits(&outputs), bits(&grad.parameters), bits(&grad.inputs.unwrap()))
        })
    };
    let one = run(1);
    assert!(one == run(2) && one == run(5));
}

#[test]
fn any_finite_input_gives_finite_results() {
    let extreme = [f32::MAX, -f32::MAX, 0.0, -0.0, f32::MIN_POSITIVE, 1e-45, 1e20, -1e20, 1.0];
    let pick = |count: usize, step: usize| -> Vec<f32> { (0..count).map(|i| extreme[i * step % 9]).collect() };
    for hidden in ACTIVATIONS {
        for output in ACTIVATIONS {
            for extreme_parameters in [false, true] {
                let mut mlp = network(&[9, 20, 7, 3], hidden, output, 2);
                if extreme_parameters {
                    mlp.parameters = pick(mlp.parameters.len(), 5);
                }
                let inputs = pick(100 * 9, 4);
                let (outputs, pullback) = mlp.forward(&inputs, 100).unwrap();
                let grad = pullback.pull(&pick(300, 7), true).unwrap();
                for values in [&outputs, &grad.parameters, &grad.inputs.unwrap()] {
                    assert!(values.iter().all(|v| v.is_finite()), "{hidden:?} {output:?} {extreme_parameters}");
                }
            }
        }
    }
}

#[test]
fn wrong_shapes_and_settings_are_refused() {
    let mut mlp = network(&[3, 4, 2], Activation::Relu, Activation::Linear, 1);
    assert!(matches!(mlp.forward(&[0.0; 5], 2), Err(ShadingError::Shape { .. })));
    assert!(matches!(mlp.forward(&[0.0; 6], 2).unwrap().1.pull(&[0.0; 3], true), Err(ShadingError::Shape { .. })));
    mlp.parameters.pop();
    assert!(matches!(mlp.forward(&[0.0; 6], 2), Err(ShadingError::Shape { .. })));
    for (widths, hidden) in
        [(vec![3], Activation::Relu), (vec![3, 0, 1], Activation::Relu), (vec![3, 1], Activation::LeakyRelu(-0.1))]
    {
        let shape = MlpShape { widths, hidden, output: Activation::Linear };
        assert!(matches!(Mlp::initialise(shape, false, &mut || 0.5), Err(ShadingError::Setting { .. })));
    }
}

#[test]
fn initialisation_fills_its_range_and_can_zero_the_last_layer() {
    let shape = MlpShape { widths: vec![16, 400, 3], hidden: Activation::Relu, output: Activation::Linear };
    let mlp = Mlp::initialise(shape, true, &mut generator(1)).unwrap();
    let (first, last) = mlp.parameters.split_at(mlp.shape.layer_offset(1));
    let largest = first.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    assert!(largest <= 0.25 && largest > 0.249);
    let variance = first.iter().map(|v| v * v).sum::<f32>() / first.len() as f32;
    assert!((variance - 0.25 * 0.25 / 3.0).abs() < 1e-3);
    assert!(last.iter().all(|&v| v == 0.0) && last.len() == 400 * 3 + 3);
}

/// Gradient steps with momentum fit sin(3x)·y: the loss falls more than a hundredfold.
#[test]
fn it_learns() {
    let batch = 512;
    let mut mlp = network(&[2, 32, 32, 1], Activation::LeakyRelu(0.01), Activation::Linear, 5);
    let inputs = numbers(2 * batch, 6);
    let targets: Vec<f32> = inputs.chunks(2).map(|x| (3.0 * x[0]).sin() * x[1]).collect();
    let (mut first, mut second) = (vec![0.0f32; mlp.parameters.len()], vec![0.0f32; mlp.parameters.len()]);
    let mut losses = Vec::new();
    for step in 1..=1500 {
        let (outputs, pullback) = mlp.forward(&inputs, batch).unwrap();
        let d: Vec<f32> = outputs.iter().zip(&targets).map(|(y, t)| 2.0 * (y - t) / batch as f32).collect();
        losses.push(outputs.iter().zip(&targets).map(|(y, t)| (y - t).powi(2)).sum::<f32>() / batch as f32);
        let grad = pullback.pull(&d, false).unwrap().parameters;
        let (c1, c2) = (1.0 - 0.9f32.powi(step), 1.0 - 0.999f32.powi(step));
        for (((p, g), m), v) in mlp.parameters.iter_mut().zip(grad).zip(&mut first).zip(&mut second) {
            *m = 0.9 * *m + 0.1 * g;
            *v = 0.999 * *v + 0.001 * g * g;
            *p -= 5e-3 * (*m / c1) / ((*v / c2).sqrt() + 1e-8);
        }
    }
    let (start, end) = (losses[0], losses[losses.len() - 1]);
    println!("loss {start} → {end}");
    assert!(end < 0.01 * start, "loss {start} → {end}");
}
