//! Central differences in `f64` against candle's backward pass.
//!
//! The rest of the workspace has dual numbers for this. Candle's tensors cannot hold them, but run in `f64`, where central
//! differences with a step of 1e-5 have errors of 1e-9 or so: enough to show a missing factor on a small term.
use crate::nn::Variables;
use crate::noise::Noise;
use candle_core::{DType, Result, Tensor, Var};

/// Largest error allowed, relative to the largest entry of the gradient.
const TOLERANCE: f64 = 2e-6;

/// What rounding leaves in a difference: it is not held against a gradient.
const ROUNDING: f64 = 1e-9;

/// Half the distance of the two points of a difference.
const STEP: f64 = 1e-5;

/// Entries of a variable that are checked at most.
const ENTRIES: usize = 24;

/// An `f64` variable with normal entries.
pub fn variable(name: &str, shape: &[usize]) -> Var {
    let values = Noise::new(11, name, 0).normal_tensor(shape, &candle_core::Device::Cpu).unwrap();
    Var::from_tensor(&values.to_dtype(DType::F64).unwrap()).unwrap()
}

/// Weighs all entries of a result differently, so that no mistake cancels.
pub fn weighed_sum(out: &Tensor) -> Result<Tensor> {
    let weights = Noise::new(12, "weights", 0).normal_tensor(out.shape(), out.device()).unwrap();
    out.to_dtype(DType::F64)?.mul(&weights.to_dtype(DType::F64)?)?.sum_all()
}

/// The largest error of the gradients of [`weighed_sum`] of `f`, relative to each gradient's largest entry. A variable that `f`
/// uses and whose gradient is missing counts as an error of 1.
pub fn worst_error(vars: &[&Var], f: impl Fn() -> Result<Tensor>) -> f64 {
    let gradients = weighed_sum(&f().unwrap()).unwrap().backward().unwrap();
    let value = || weighed_sum(&f().unwrap()).unwrap().to_scalar::<f64>().unwrap();
    let mut worst = 0.0f64;
    for var in vars {
        let start = var.as_tensor().copy().unwrap();
        let flat: Vec<f64> = start.flatten_all().unwrap().to_vec1().unwrap();
        let Some(gradient) = gradients.get(var.as_tensor()) else { return 1.0 };
        let gradient: Vec<f64> = gradient.flatten_all().unwrap().to_vec1().unwrap();
        let largest = gradient.iter().fold(0.0f64, |m, g| m.max(g.abs()));
        assert!(largest > 0.0, "a gradient of nothing but zeros");
        for i in (0..flat.len()).step_by(flat.len().div_ceil(ENTRIES)) {
            let at = |step: f64| {
                let mut moved = flat.clone();
                moved[i] += step;
                var.set(&Tensor::from_vec(moved, start.shape(), start.device()).unwrap()).unwrap();
                value()
            };
            let difference = (at(STEP) - at(-STEP)) / (2.0 * STEP);
            worst = worst.max(((difference - gradient[i]).abs() - ROUNDING) / largest);
        }
        var.set(&start).unwrap();
    }
    worst
}

/// Checks the gradient of `f` with respect to each variable.
pub fn check(what: &str, vars: &[&Var], f: impl Fn() -> Result<Tensor>) {
    let worst = worst_error(vars, f);
    assert!(worst < TOLERANCE, "{what}: the gradient is off by {worst:e} of its largest entry");
}

/// Checks the gradients of all variables of a layer.
pub fn check_layer(what: &str, variables: &Variables, inputs: &[&Var], f: impl Fn() -> Result<Tensor>) {
    let vars: Vec<&Var> = inputs.iter().copied().chain(variables.vars().map(|(_, var)| var)).collect();
    check(what, &vars, f);
}

#[test]
fn a_wrong_backward_pass_is_noticed() {
    let x = variable("x", &[2, 3]);
    check("the square", &[&x], || x.sqr());
    // Half of the product's gradient is cut.
    assert!(worst_error(&[&x], || x.mul(&x.detach())) > 0.1);
    // A factor of a thousandth on a small term.
    let y = variable("y", &[2, 3]);
    assert!(worst_error(&[&x], || x.sqr()? + (x.mul(&y)? * 1e-3)?.detach()) > 1e-5);
}

/// Candle's operations that this crate must not use still have the defects for which they are avoided: when this fails, they
/// can be used.
#[test]
#[allow(clippy::disallowed_methods)]
fn what_is_avoided_is_still_wrong() {
    let x = variable("x", &[1, 2, 4, 4]);
    // The branch through the upsampling is the second to write; it overwrites the first.
    let twice = || x.upsample_nearest2d(8, 8)?.sum_all()?.broadcast_add(&x.as_tensor().clone());
    assert!(worst_error(&[&x], twice) > 1e-3);
    assert!(x.upsample_bilinear2d(8, 8, false).and_then(|y| y.sum_all()?.backward()).is_err());
    assert!(worst_error(&[&x], || x.max_pool2d(2)) > 1e-3);
}
