//! Group normalisation on the CPU with an optional sigmoid linear unit behind it, in one pass over memory each way.
use super::cpu::{Real, slice, with_slices};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

/// The operation as candle's graph knows it: (x, weight, bias) with x (batch, channels, …).
pub(super) struct GroupNormalisation {
    /// Groups of channels; divides their number.
    pub groups: usize,
    /// Added to the variance.
    pub eps: f64,
    /// Whether x·σ(x) follows.
    pub silu: bool,
}

/// Sizes: channels, channels of a group, values of a channel.
struct Sizes {
    channels: usize,
    in_group: usize,
    pixels: usize,
}

impl GroupNormalisation {
    fn sizes(&self, x: &[usize], weight: &[usize], bias: &[usize]) -> Result<Sizes> {
        let [_, channels, rest @ ..] = x else { bail!("group norm: expected (batch, channels, …), found {x:?}") };
        if self.groups == 0 || channels % self.groups != 0 || weight != [*channels] || bias != [*channels] {
            bail!("group norm: {channels} channels in {} groups, weight {weight:?}, bias {bias:?}", self.groups);
        }
        let in_group = channels / self.groups;
        Ok(Sizes { channels: *channels, in_group, pixels: rest.iter().product() })
    }

    /// Mean and 1/√(variance + ε) of a group, summed in double precision.
    fn moments<T: Real>(&self, group: &[T]) -> (T, T) {
        let n = group.len().max(1) as f64;
        let mean = group.iter().map(|v| v.to_f64()).sum::<f64>() / n;
        let variance = group.iter().map(|v| (v.to_f64() - mean) * (v.to_f64() - mean)).sum::<f64>() / n;
        (T::from_f64(mean), T::from_f64(1.0 / (variance + self.eps).sqrt()))
    }

    fn run<T: Real>(&self, s: &Sizes, inputs: [(&CpuStorage, &Layout); 3]) -> Result<CpuStorage> {
        let [x, weight, bias] = inputs;
        let (x, weight, bias) = (slice::<T>(x.0, x.1)?, slice::<T>(weight.0, weight.1)?, slice::<T>(bias.0, bias.1)?);
        let one = T::from_f64(1.0);
        let mut out = vec![T::from_f64(0.0); x.len()];
        let length = (s.in_group * s.pixels).max(1);
        out.par_chunks_mut(length).zip(x.par_chunks(length)).enumerate().for_each(|(i, (out, x))| {
            let first = i % self.groups * s.in_group;
            let (mean, scale) = self.moments(x);
            let channels = out.chunks_mut(s.pixels).zip(x.chunks(s.pixels));
            for ((out, x), (w, b)) in channels.zip(weight[first..].iter().zip(&bias[first..])) {
                let (w, b) = (*w * scale, *b - mean * scale * *w);
                for (out, x) in out.iter_mut().zip(x) {
                    let z = *x * w + b;
                    // e^−z may be infinite, then the quotient is zero as it should be.
                    *out = if self.silu { z / (one + (T::from_f64(0.0) - z).power_of_e()) } else { z };
                }
            }
        });
        Ok(T::to_cpu_storage_owned(out))
    }

    fn pull<T: Real>(
        &self,
        s: &Sizes,
        x: &Tensor,
        weight: &Tensor,
        bias: &Tensor,
        d_out: &Tensor,
    ) -> Result<[Tensor; 3]> {
        let (zero, one) = (T::from_f64(0.0), T::from_f64(1.0));
        let (d_x, d_weight, d_bias) = with_slices::<T, _, 4>([x, weight, bias, d_out], |[x, weight, bias, d_out]| {
            let length = (s.in_group * s.pixels).max(1);
            let mut d_x = vec![zero; x.len()];
            let tasks = d_x.par_chunks_mut(length).zip(x.par_chunks(length)).zip(d_out.par_chunks(length)).enumerate();
            // Per group: for each channel Σ d·x̂ and Σ d.
            let sums: Vec<Vec<(f64, f64)>> = tasks
                .map(|(i, ((d_x, x), d_out))| {
                    let first = i % self.groups * s.in_group;
                    let (mean, scale) = self.moments(x);
                    let mut sums = Vec::with_capacity(s.in_group);
                    let (mut total, mut total_normal) = (0.0, 0.0);
                    for c in 0..s.in_group {
                        let (w, b) = (weight[first + c], bias[first + c]);
                        let range = c * s.pixels..(c + 1) * s.pixels;
                        let (mut with_normal, mut plain) = (0.0, 0.0);
                        let lines = d_x[range.clone()].iter_mut().zip(&x[range.clone()]).zip(&d_out[range]);
                        for ((d_x, x), d_out) in lines {
                            let normal = (*x - mean) * scale;
                            let mut d = *d_out;
                            if self.silu {
                                let z = normal * w + b;
                                let sigmoid = one / (one + (zero - z).power_of_e());
                                d = d * sigmoid * (one + z * (one - sigmoid));
                            }
                            with_normal += (d * normal).to_f64();
                            plain += d.to_f64();
                            *d_x = d * w;
                        }
                        total += plain * w.to_f64();
                        total_normal += with_normal * w.to_f64();
                        sums.push((with_normal, plain));
                    }
                    let n = length as f64;
                    let (total, total_normal) = (T::from_f64(total / n), T::from_f64(total_normal / n));
                    for (d_x, x) in d_x.iter_mut().zip(x) {
                        let normal = (*x - mean) * scale;
                        *d_x = scale * (*d_x - total - normal * total_normal);
                    }
                    sums
                })
                .collect();
            let mut d_weight = vec![0.0; s.channels];
            let mut d_bias = vec![0.0; s.channels];
            for (i, group) in sums.iter().enumerate() {
                for (c, (with_normal, plain)) in group.iter().enumerate() {
                    d_weight[i % self.groups * s.in_group + c] += with_normal;
                    d_bias[i % self.groups * s.in_group + c] += plain;
                }
            }
            let convert = |values: Vec<f64>| values.into_iter().map(T::from_f64).collect::<Vec<T>>();
            Ok((d_x, convert(d_weight), convert(d_bias)))
        })?;
        Ok([
            Tensor::from_vec(d_x, x.shape(), x.device())?,
            Tensor::from_vec(d_weight, s.channels, x.device())?,
            Tensor::from_vec(d_bias, s.channels, x.device())?,
        ])
    }
}

impl CustomOp3 for GroupNormalisation {
    fn name(&self) -> &'static str {
        "group-norm"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        lx: &Layout,
        w: &CpuStorage,
        lw: &Layout,
        b: &CpuStorage,
        lb: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        use candle_core::backend::BackendStorage;
        let sizes = self.sizes(lx.dims(), lw.dims(), lb.dims())?;
        let inputs = [(x, lx), (w, lw), (b, lb)];
        let out = match x.dtype() {
            candle_core::DType::F32 => self.run::<f32>(&sizes, inputs)?,
            candle_core::DType::F64 => self.run::<f64>(&sizes, inputs)?,
            other => bail!("group norm: expected f32 or f64, found {other:?}; convert the tensor first"),
        };
        Ok((out, lx.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        b: &Tensor,
        _: &Tensor,
        d_out: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let sizes = self.sizes(x.dims(), w.dims(), b.dims())?;
        let d_out = d_out.contiguous()?;
        let pull = |s: &Sizes| match x.dtype() {
            candle_core::DType::F32 => self.pull::<f32>(s, x, w, b, &d_out),
            _ => self.pull::<f64>(s, x, w, b, &d_out),
        };
        let [d_x, d_w, d_b] = pull(&sizes)?;
        Ok((Some(d_x), Some(d_w), Some(d_b)))
    }
}
