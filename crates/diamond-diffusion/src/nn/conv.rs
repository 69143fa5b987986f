//! The convolution layer, and what proves the operation under it.
use super::conv_op::conv2d;
use super::variables::{Init, Scope};
use crate::error::{DiffusionError, Result};
use candle_core::Tensor;

/// A convolution with a bias; the kernel is square.
#[derive(Debug, Clone)]
pub struct Conv2d {
    weight: Tensor,
    bias: Tensor,
    stride: usize,
    padding: usize,
}

impl Conv2d {
    /// Kernel k × k, stride 1, padding that keeps the size (k odd).
    pub fn new(scope: &Scope<'_>, c_in: usize, c_out: usize, kernel: usize) -> Result<Self> {
        Self::strided(scope, c_in, c_out, kernel, 1, kernel / 2)
    }

    /// With a stride and a padding.
    pub fn strided(
        scope: &Scope<'_>,
        c_in: usize,
        c_out: usize,
        kernel: usize,
        stride: usize,
        padding: usize,
    ) -> Result<Self> {
        let fan_in = Init::FanIn(c_in * kernel * kernel);
        let weight = scope.weight("weight", (c_out, c_in, kernel, kernel), fan_in)?;
        Ok(Self { weight, bias: scope.weight("bias", c_out, fan_in)?, stride, padding })
    }

    /// With weight and bias zero, stride 1, padding that keeps the size.
    pub fn zeros(scope: &Scope<'_>, c_in: usize, c_out: usize, kernel: usize) -> Result<Self> {
        let weight = scope.weight("weight", (c_out, c_in, kernel, kernel), Init::Zeros)?;
        Ok(Self { weight, bias: scope.weight("bias", c_out, Init::Zeros)?, stride: 1, padding: kernel / 2 })
    }

    /// `x` is (batch, channels, height, width).
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let c_in = self.weight.dims()[1];
        if x.rank() != 4 || x.dims()[1] != c_in {
            let expected = format!("[batch, {c_in}, height, width]");
            return Err(DiffusionError::shape("input of a convolution", expected, x.dims()));
        }
        let y = conv2d(x, &self.weight, self.stride, self.padding)?;
        Ok(y.broadcast_add(&self.bias.reshape((1, (), 1, 1))?)?)
    }
}

#[cfg(test)]
mod tests {
    use super::super::variables::{Source, VariablesBuilder};
    use super::*;
    use crate::gradient_check::{check, check_layer, variable, weighed_sum};
    use candle_core::{DType, Var};

    /// (kernel, stride, padding, height, width): several tiles, blocks and borders, 1 × 1, strides, an even kernel.
    const CASES: [(usize, usize, usize, usize, usize); 7] = [
        (3, 1, 1, 5, 7),
        (1, 1, 0, 4, 6),
        (3, 2, 1, 7, 6),
        (5, 1, 2, 3, 4),
        (2, 2, 0, 6, 6),
        (1, 2, 0, 5, 5),
        (3, 1, 0, 30, 40),
    ];

    /// [eq:convolution]: against differences, and against candle's own, forward and backward.
    #[test]
    fn the_operation_and_its_pullback_agree_with_differences_and_with_candle() {
        for (kernel, stride, padding, height, width) in CASES {
            let x = variable("x", &[2, 19, height, width]);
            let w = variable("w", &[3, 19, kernel, kernel]);
            let what = format!("convolution {kernel}×{kernel}, stride {stride}, padding {padding}");
            let small = Var::from_tensor(&x.narrow(1, 0, 2).unwrap().contiguous().unwrap()).unwrap();
            let small_w = Var::from_tensor(&w.narrow(1, 0, 2).unwrap().contiguous().unwrap()).unwrap();
            check(&what, &[&small, &small_w], || conv2d(&small, &small_w, stride, padding));
            let ours = conv2d(&x, &w, stride, padding).unwrap();
            let native = x.conv2d(&w, padding, stride, 1, 1).unwrap();
            let difference = |a: &Tensor, b: &Tensor| {
                let worst = (a - b).unwrap().abs().unwrap().max_all().unwrap();
                worst.to_dtype(DType::F64).unwrap().to_scalar::<f64>().unwrap()
            };
            assert!(difference(&ours, &native) < 1e-10, "{what}");
            let ours = weighed_sum(&ours).unwrap().backward().unwrap();
            // Candle's backward pass fails where the stride leaves pixels over: differences alone speak for those.
            let exact = [height, width].iter().all(|side| (side + 2 * padding - kernel).is_multiple_of(stride));
            let native = weighed_sum(&native).unwrap().backward();
            assert_eq!(native.is_ok(), exact, "{what}");
            for var in [&x, &w].into_iter().filter(|_| exact) {
                let native = native.as_ref().unwrap();
                let (a, b) = (ours.get(var).unwrap(), native.get(var).unwrap());
                assert!(difference(a, b) < 1e-10, "{what}: a gradient");
            }
            // In f32, to rounding.
            let single = |t: &Var| Var::from_tensor(&t.to_dtype(DType::F32).unwrap()).unwrap();
            let (x32, w32) = (single(&x), single(&w));
            let out = conv2d(&x32, &w32, stride, padding).unwrap();
            let gradients = weighed_sum(&out).unwrap().backward().unwrap();
            for (var32, var) in [(&x32, &x), (&w32, &w)] {
                let a = gradients.get(var32).unwrap().to_dtype(DType::F64).unwrap();
                let b = ours.get(var).unwrap();
                let scale = b.abs().unwrap().max_all().unwrap().to_scalar::<f64>().unwrap();
                assert!(difference(&a, b) < 1e-5 * scale, "{what}: a gradient in f32");
            }
        }
    }

    #[test]
    fn threads_do_not_change_bits() {
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let single = |t: Var| Var::from_tensor(&t.to_dtype(DType::F32).unwrap()).unwrap();
                let (x, w) = (single(variable("x", &[2, 40, 40, 40])), single(variable("w", &[8, 40, 3, 3])));
                let out = conv2d(&x, &w, 1, 1).unwrap();
                let gradients = out.sqr().unwrap().sum_all().unwrap().backward().unwrap();
                let bits = |t: &Tensor| -> Vec<u32> {
                    t.flatten_all().unwrap().to_vec1::<f32>().unwrap().into_iter().map(f32::to_bits).collect()
                };
                [bits(&out), bits(gradients.get(&x).unwrap()), bits(gradients.get(&w).unwrap())]
            })
        };
        assert_eq!(run(1), run(3));
    }

    #[test]
    fn the_layer_has_gradients_and_refuses_what_does_not_fit() {
        let builder = VariablesBuilder::new(Source::Seed(2)).dtype(DType::F64);
        let layer = Conv2d::strided(&builder.root(), 2, 3, 3, 2, 1).unwrap();
        let (variables, _) = builder.finish();
        let x = variable("x", &[2, 2, 5, 4]);
        check_layer("convolution layer", &variables, &[&x], || Ok(layer.forward(&x).unwrap()));
        assert!(layer.forward(&variable("y", &[2, 3, 5, 4])).is_err());
        assert!(conv2d(&variable("z", &[1, 2, 1, 1]), &variable("w", &[1, 2, 3, 3]), 1, 0).is_err());
        assert!(conv2d(&x, &variable("w", &[1, 2, 3, 3]), 0, 1).is_err());
    }
}
