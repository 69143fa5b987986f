//! Attention on the CPU that never holds the whole matrix of weights: blocks of queries, forward and backward.
use super::cpu::{Matrix, Real, by_type, matmul, slice, with_slices};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

/// Queries that are treated at once.
const BLOCK: usize = 64;

/// Sizes: heads (and pictures), queries, keys, channels of queries and keys, channels of values.
#[derive(Clone, Copy)]
struct Sizes {
    heads: usize,
    queries: usize,
    keys: usize,
    channels: usize,
    values: usize,
}

impl Sizes {
    fn new(q: &[usize], k: &[usize], v: &[usize]) -> Result<Self> {
        match (q, k, v) {
            (&[heads, queries, channels], &[heads_k, keys, channels_k], &[heads_v, keys_v, values])
                if heads == heads_k && heads == heads_v && channels == channels_k && keys == keys_v && keys > 0 =>
            {
                Ok(Self { heads, queries, keys, channels, values })
            }
            _ => bail!("attention: queries {q:?}, keys {k:?} and values {v:?} do not fit"),
        }
    }
}

/// softmax(scale · q·kᵀ) of a block of queries, into `weights` (rows × keys).
fn block_weights<T: Real>(s: &Sizes, q: &[T], k: &[T], scale: T, weights: &mut [T]) {
    let rows = weights.len() / s.keys;
    let (q, k) = (Matrix::rows(q, s.channels), Matrix::rows(k, s.channels));
    matmul((rows, s.channels, s.keys), q, k.t(), weights, s.keys, false);
    for row in weights.chunks_exact_mut(s.keys) {
        let largest = row.iter().fold(row[0], |m, v| if *v > m { *v } else { m });
        let mut sum = 0.0;
        for v in row.iter_mut() {
            *v = ((*v - largest) * scale).power_of_e();
            sum += v.to_f64();
        }
        let scale = T::from_f64(1.0 / sum);
        row.iter_mut().for_each(|v| *v *= scale);
    }
}

/// The operation as candle's graph knows it.
pub(super) struct BlockAttention {
    /// Factor of q·kᵀ; positive.
    pub scale: f64,
}

fn run<T: Real>(s: &Sizes, scale: f64, inputs: [(&CpuStorage, &Layout); 3]) -> Result<CpuStorage> {
    let [q, k, v] = inputs;
    let (q, k, v) = (slice::<T>(q.0, q.1)?, slice::<T>(k.0, k.1)?, slice::<T>(v.0, v.1)?);
    let zero = T::from_f64(0.0);
    let mut out = vec![zero; s.heads * s.queries * s.values];
    let blocks: Vec<(usize, usize, &mut [T])> = out
        .chunks_mut((s.queries * s.values).max(1))
        .enumerate()
        .flat_map(|(head, out)| {
            out.chunks_mut(BLOCK * s.values.max(1)).enumerate().map(move |(i, out)| (head, i * BLOCK, out))
        })
        .collect();
    blocks.into_par_iter().for_each(|(head, first, out)| {
        let rows = out.len() / s.values;
        let mut weights = vec![zero; rows * s.keys];
        let k = &k[head * s.keys * s.channels..][..s.keys * s.channels];
        block_weights(s, &q[(head * s.queries + first) * s.channels..], k, T::from_f64(scale), &mut weights);
        let v = Matrix::rows(&v[head * s.keys * s.values..][..s.keys * s.values], s.values);
        matmul((rows, s.keys, s.values), Matrix::rows(&weights, s.keys), v, out, s.values, false);
    });
    Ok(T::to_cpu_storage_owned(out))
}

fn pull<T: Real>(s: &Sizes, scale: f64, tensors: [&Tensor; 5]) -> Result<[Tensor; 3]> {
    let [q_tensor, k_tensor, v_tensor, ..] = tensors;
    let (d_q, d_k, d_v) = with_slices::<T, _, 5>(tensors, |[q, k, v, out, d_out]| {
        let zero = T::from_f64(0.0);
        let (mut d_q, mut d_k, mut d_v) = (vec![zero; q.len()], vec![zero; k.len()], vec![zero; v.len()]);
        let per_q = (s.queries * s.channels).max(1);
        let (per_k, per_v) = ((s.keys * s.channels).max(1), (s.keys * s.values).max(1));
        let heads = d_q.par_chunks_mut(per_q).zip(d_k.par_chunks_mut(per_k)).zip(d_v.par_chunks_mut(per_v));
        heads.enumerate().for_each(|(head, ((d_q, d_k), d_v))| {
            let (k, v) = (&k[head * per_k..][..per_k], &v[head * per_v..][..per_v]);
            let mut weights = Vec::new();
            let mut d_weights = Vec::new();
            for first in (0..s.queries).step_by(BLOCK) {
                let rows = BLOCK.min(s.queries - first);
                let q = &q[(head * s.queries + first) * s.channels..][..rows * s.channels];
                let out = &out[(head * s.queries + first) * s.values..][..rows * s.values];
                let d_out = &d_out[(head * s.queries + first) * s.values..][..rows * s.values];
                weights.clear();
                weights.resize(rows * s.keys, zero);
                d_weights.clear();
                d_weights.resize(rows * s.keys, zero);
                block_weights(s, q, k, T::from_f64(scale), &mut weights);
                let d_out_matrix = Matrix::rows(d_out, s.values);
                let transposed = Matrix::rows(&weights, s.keys).t();
                matmul((s.keys, rows, s.values), transposed, d_out_matrix, d_v, s.values, true);
                let values = Matrix::rows(v, s.values).t();
                matmul((rows, s.values, s.keys), d_out_matrix, values, &mut d_weights, s.keys, false);
                for (row, (d_row, weights)) in
                    d_weights.chunks_exact_mut(s.keys).zip(weights.chunks_exact(s.keys)).enumerate()
                {
                    let range = row * s.values..(row + 1) * s.values;
                    let dot: f64 = out[range.clone()].iter().zip(&d_out[range]).map(|(a, b)| (*a * *b).to_f64()).sum();
                    let dot = T::from_f64(dot);
                    for (d, w) in d_row.iter_mut().zip(weights) {
                        *d = (*d - dot) * *w * T::from_f64(scale);
                    }
                }
                let d_scores = Matrix::rows(&d_weights, s.keys);
                let d_q = &mut d_q[first * s.channels..][..rows * s.channels];
                matmul((rows, s.keys, s.channels), d_scores, Matrix::rows(k, s.channels), d_q, s.channels, false);
                matmul((s.keys, rows, s.channels), d_scores.t(), Matrix::rows(q, s.channels), d_k, s.channels, true);
            }
        });
        Ok((d_q, d_k, d_v))
    })?;
    Ok([
        Tensor::from_vec(d_q, q_tensor.shape(), q_tensor.device())?,
        Tensor::from_vec(d_k, k_tensor.shape(), q_tensor.device())?,
        Tensor::from_vec(d_v, v_tensor.shape(), q_tensor.device())?,
    ])
}

impl CustomOp3 for BlockAttention {
    fn name(&self) -> &'static str {
        "attention"
    }

    fn cpu_fwd(
        &self,
        q: &CpuStorage,
        lq: &Layout,
        k: &CpuStorage,
        lk: &Layout,
        v: &CpuStorage,
        lv: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        use candle_core::backend::BackendStorage;
        let s = Sizes::new(lq.dims(), lk.dims(), lv.dims())?;
        let out = by_type!(q.dtype(), run(&s, self.scale, [(q, lq), (k, lk), (v, lv)]))?;
        Ok((out, Shape::from((s.heads, s.queries, s.values))))
    }

    fn bwd(
        &self,
        q: &Tensor,
        k: &Tensor,
        v: &Tensor,
        out: &Tensor,
        d_out: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let s = Sizes::new(q.dims(), k.dims(), v.dims())?;
        let d_out = d_out.contiguous()?;
        let [d_q, d_k, d_v] = by_type!(q.dtype(), pull(&s, self.scale, [q, k, v, out, &d_out]))?;
        Ok((Some(d_q), Some(d_k), Some(d_v)))
    }
}
