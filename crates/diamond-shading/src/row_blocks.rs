//! A dense network on sixteen rows at once, one row per lane: forward only.
//!
//! A block of sixteen rows holds column after column, so that a layer multiplies whole vectors of rows by single weights.
//! Nothing is padded but the last block: a layer of five inputs does five products, one of three outputs three. A tile of
//! outputs stays in registers while its sums run over the inputs, and passes its activation on the way to memory.
//!
//! Bits: a row's numbers depend neither on its lane nor on the other rows of its block.
use crate::mlp::{Activation, Mlp};
use crate::simd::MAGNITUDE_LIMIT;
use diamond_simd::{BLOCK, Lanes, Simd, sigmoid};

/// One column of a block.
pub(crate) type Column = [f32; BLOCK];

/// Outputs of a tile at most: with two vectors of rows, twelve sums fill AVX2's registers.
const TILE: usize = 6;

/// Outputs of the next tile of as many that remain: no tile of one or two beside full ones, which would wait for its own
/// sums.
const fn tile_of(remaining: usize) -> usize {
    match remaining {
        7 | 8 => 4,
        r if r < TILE => r,
        _ => TILE,
    }
}

/// One layer, its weights in the order in which they are read; saturated at ±[`MAGNITUDE_LIMIT`].
#[derive(Debug, Clone)]
struct Layer {
    inputs: usize,
    outputs: usize,
    activation: Activation,
    /// Tile after tile, in it input after input.
    weights: Vec<f32>,
    /// `[outputs]`.
    bias: Vec<f32>,
}

/// A network ready for blocks of rows.
#[derive(Debug, Clone)]
pub(crate) struct BlockNetwork {
    layers: Vec<Layer>,
}

fn saturate(value: f32) -> f32 {
    value.clamp(-MAGNITUDE_LIMIT, MAGNITUDE_LIMIT)
}

impl BlockNetwork {
    /// Of a network that passed [`Mlp::check`].
    pub(crate) fn new(mlp: &Mlp) -> Self {
        let mut rest = mlp.parameters.as_slice();
        let layers = mlp.shape.widths.windows(2).enumerate().map(|(l, w)| {
            let (inputs, outputs) = (w[0], w[1]);
            let (matrix, after) = rest.split_at(inputs * outputs);
            let (bias, after) = after.split_at(outputs);
            rest = after;
            let mut weights = Vec::with_capacity(matrix.len());
            let mut first = 0;
            while first < outputs {
                let tile = tile_of(outputs - first);
                for i in 0..inputs {
                    weights.extend((first..first + tile).map(|o| saturate(matrix[o * inputs + i])));
                }
                first += tile;
            }
            let bias = bias.iter().copied().map(saturate).collect();
            Layer { inputs, outputs, activation: mlp.shape.activation(l), weights, bias }
        });
        Self { layers: layers.collect() }
    }

    /// Columns of the widest output.
    pub(crate) fn widest(&self) -> usize {
        self.layers.iter().map(|l| l.outputs).max().unwrap_or(0)
    }

    /// All layers of a block whose columns are `x`; `sums` replace the first layer's bias. Two buffers of
    /// [`BlockNetwork::widest`] columns are written by turns; the last layer's outputs are the beginning of the returned one.
    /// `[eq:mlp]`
    #[inline(always)]
    pub(crate) fn forward<'b, S: Simd, const N: usize>(
        &self,
        s: S,
        x: &[Column],
        sums: Option<&[Column]>,
        buffers: [&'b mut [Column]; 2],
    ) -> &'b mut [Column] {
        let [mut to, mut other] = buffers;
        for (l, layer) in self.layers.iter().enumerate() {
            if l == 0 {
                layer.forward::<S, N>(s, x, sums, to);
            } else {
                layer.forward::<S, N>(s, other, None, to);
            }
            std::mem::swap(&mut to, &mut other);
        }
        other
    }
}

impl Layer {
    #[inline(always)]
    fn forward<S: Simd, const N: usize>(&self, s: S, x: &[Column], sums: Option<&[Column]>, y: &mut [Column]) {
        let x = &x[..self.inputs];
        let (mut weights, mut first) = (self.weights.as_slice(), 0);
        while first < self.outputs {
            let tile = tile_of(self.outputs - first);
            let (own, rest) = weights.split_at(tile * self.inputs);
            let start = Start { bias: &self.bias[first..first + tile], sums: sums.map(|s| &s[first..first + tile]) };
            let y = &mut y[first..first + tile];
            match tile {
                6 => self.tile::<S, N, 6>(s, own, x, start, y),
                5 => self.tile::<S, N, 5>(s, own, x, start, y),
                4 => self.tile::<S, N, 4>(s, own, x, start, y),
                3 => self.tile::<S, N, 3>(s, own, x, start, y),
                2 => self.tile::<S, N, 2>(s, own, x, start, y),
                _ => self.tile::<S, N, 1>(s, own, x, start, y),
            }
            (weights, first) = (rest, first + tile);
        }
    }

    /// `M` outputs: sums in ascending order of the inputs, one accumulator each.
    #[inline(always)]
    fn tile<S: Simd, const N: usize, const M: usize>(
        &self,
        s: S,
        weights: &[f32],
        x: &[Column],
        start: Start<'_>,
        y: &mut [Column],
    ) {
        let w = S::F32_LANES;
        let mut sums = [[Lanes::splat(s, 0.0); N]; M];
        for m in 0..M {
            for n in 0..N {
                sums[m][n] = match start.sums {
                    Some(sums) => Lanes::load(s, &sums[m][n * w..]),
                    None => Lanes::splat(s, start.bias[m]),
                };
            }
        }
        for (weights, x) in weights.as_chunks::<M>().0.iter().zip(x) {
            let mut vectors = [Lanes::splat(s, 0.0); N];
            for n in 0..N {
                vectors[n] = Lanes::load(s, &x[n * w..]);
            }
            for m in 0..M {
                let weight = Lanes::splat(s, weights[m]);
                for n in 0..N {
                    sums[m][n] = weight.mul_add(vectors[n], sums[m][n]);
                }
            }
        }
        for m in 0..M {
            for n in 0..N {
                activate(self.activation, sums[m][n]).store(&mut y[m][n * w..]);
            }
        }
    }
}

/// What a tile's sums begin with.
struct Start<'a> {
    bias: &'a [f32],
    sums: Option<&'a [Column]>,
}

#[inline(always)]
fn activate<S: Simd>(activation: Activation, x: Lanes<S>) -> Lanes<S> {
    let leak = match activation {
        Activation::Sigmoid => return sigmoid(x),
        Activation::Linear => 1.0,
        Activation::Relu => 0.0,
        Activation::LeakyRelu(slope) => slope,
    };
    x.gt(x.same(0.0)).select(x, x * leak).clamp(-MAGNITUDE_LIMIT, MAGNITUDE_LIMIT)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mlp::MlpShape;
    use diamond_simd::{Level, WithSimd, with_lanes};

    struct Run<'a> {
        network: &'a BlockNetwork,
        x: &'a [Column],
    }

    impl WithSimd for Run<'_> {
        type Output = Vec<Column>;
        #[inline(always)]
        fn with_simd<S: Simd>(self, s: S) -> Vec<Column> {
            with_lanes!(s: S, run(self.network, self.x))
        }
    }

    #[inline(always)]
    fn run<S: Simd, const N: usize>(s: S, network: &BlockNetwork, x: &[Column]) -> Vec<Column> {
        let mut buffers = [vec![[0.0; BLOCK]; network.widest()], vec![[0.0; BLOCK]; network.widest()]];
        let [a, b] = &mut buffers;
        network.forward::<S, N>(s, x, None, [a, b]).to_vec()
    }

    /// [eq:mlp] What the network itself gives, for every size of tile, activation and instruction set.
    #[test]
    fn blocks_agree_with_rows() {
        let mut state = 11u32;
        let mut uniform = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / 16_777_216.0
        };
        let activations = [Activation::Linear, Activation::Relu, Activation::LeakyRelu(0.01), Activation::Sigmoid];
        for (k, outputs) in (1..=16).enumerate() {
            let shape = MlpShape {
                widths: vec![5, outputs, 7, 3],
                hidden: activations[k % 4],
                output: activations[(k + 1) % 4],
            };
            let mlp = Mlp::initialise(shape, false, &mut uniform).unwrap();
            let rows: Vec<f32> = (0..5 * BLOCK).map(|_| 4.0 * uniform() - 2.0).collect();
            let x: Vec<Column> = (0..5).map(|c| std::array::from_fn(|r| rows[5 * r + c])).collect();
            let (expected, _) = mlp.forward(&rows, BLOCK).unwrap();
            let network = BlockNetwork::new(&mlp);
            let mut fused: Option<Vec<Column>> = None;
            for level in Level::testable() {
                let found = level.dispatch(Run { network: &network, x: &x });
                for r in 0..BLOCK {
                    for c in 0..3 {
                        let (a, b) = (expected[3 * r + c], found[c][r]);
                        assert!((a - b).abs() <= 2e-6 * (1.0 + a.abs()), "{outputs} {level:?}: {a} {b}");
                    }
                }
                if level.is_fused() {
                    assert_eq!(fused.get_or_insert_with(|| found[..3].to_vec()), &found[..3], "{level:?}");
                }
            }
        }
    }
}
