//! The largest value of each window: candle's own has a quarter of the gradient or none.
use super::cpu::{Real, by_type, slice, with_slices};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};

/// Windows of `kernel` × `kernel`, `stride` apart, all inside the picture.
struct Windows {
    kernel: usize,
    stride: usize,
}

impl Windows {
    fn out(&self, dims: &[usize]) -> Result<(usize, usize, usize, usize, usize)> {
        let &[batch, channels, height, width] = dims else {
            bail!("pooling: expected (batch, channels, height, width), found {dims:?}");
        };
        if self.kernel == 0 || self.stride == 0 || height < self.kernel || width < self.kernel {
            bail!("pooling: a window of {} does not fit into a picture of {width}×{height}", self.kernel);
        }
        let count = |side: usize| (side - self.kernel) / self.stride + 1;
        Ok((batch * channels, height, width, count(height), count(width)))
    }

    /// For each output value, where its maximum is; the first of equal ones in reading order.
    fn winners<T: Real>(&self, x: &[T], dims: &[usize]) -> Result<Vec<usize>> {
        let (planes, height, width, out_height, out_width) = self.out(dims)?;
        let mut winners = Vec::with_capacity(planes * out_height * out_width);
        for plane in 0..planes {
            for y in 0..out_height {
                for column in 0..out_width {
                    let first = (plane * height + y * self.stride) * width + column * self.stride;
                    let mut best = first;
                    for at in (0..self.kernel).flat_map(|i| (0..self.kernel).map(move |j| first + i * width + j)) {
                        if x[at] > x[best] {
                            best = at;
                        }
                    }
                    winners.push(best);
                }
            }
        }
        Ok(winners)
    }
}

fn run<T: Real>(windows: &Windows, x: &CpuStorage, layout: &Layout) -> Result<CpuStorage> {
    let x = slice::<T>(x, layout)?;
    Ok(T::to_cpu_storage_owned(windows.winners(x, layout.dims())?.into_iter().map(|at| x[at]).collect::<Vec<T>>()))
}

fn pull<T: Real>(windows: &Windows, x: &Tensor, d_out: &Tensor) -> Result<Tensor> {
    let d_x = with_slices::<T, _, 2>([x, d_out], |[values, d_out]| {
        let mut d_x = vec![T::from_f64(0.0); values.len()];
        for (at, d) in windows.winners(values, x.dims())?.into_iter().zip(d_out) {
            d_x[at] += *d;
        }
        Ok(d_x)
    })?;
    Tensor::from_vec(d_x, x.shape(), x.device())
}

impl CustomOp1 for Windows {
    fn name(&self) -> &'static str {
        "max-pool"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        use candle_core::backend::BackendStorage;
        let (_, _, _, height, width) = self.out(layout.dims())?;
        let out = by_type!(x.dtype(), run(self, x, layout))?;
        Ok((out, Shape::from((layout.dims()[0], layout.dims()[1], height, width))))
    }

    fn bwd(&self, x: &Tensor, _: &Tensor, d_out: &Tensor) -> Result<Option<Tensor>> {
        let d_out = d_out.contiguous()?;
        Ok(Some(by_type!(x.dtype(), pull(self, x, &d_out))?))
    }
}

/// The largest value of each window of (batch, channels, height, width). The gradient goes to the first of equal values.
/// On the CPU only.
pub fn max_pool2d(x: &Tensor, kernel: usize, stride: usize) -> Result<Tensor> {
    x.contiguous()?.apply_op1(Windows { kernel, stride })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradient_check::{check, variable};

    #[test]
    fn windows_that_overlap_and_that_do_not_have_their_gradient() {
        let x = variable("x", &[2, 3, 5, 7]);
        for (kernel, stride) in [(2, 2), (3, 2), (3, 1)] {
            check(&format!("pooling {kernel} by {stride}"), &[&x], || max_pool2d(&x, kernel, stride));
        }
        let rows = Tensor::new(&[[[[1.0f32, 5.0, 2.0], [4.0, 3.0, 6.0]]]], &candle_core::Device::Cpu).unwrap();
        assert_eq!(max_pool2d(&rows, 2, 1).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap(), [5.0, 6.0]);
        assert!(max_pool2d(&rows, 3, 2).is_err());
    }
}
