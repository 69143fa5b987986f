//! Small dense products on whatever vector unit the machine has.
//!
//! One micro-kernel computes C = init + A·B for row-major f32 matrices: a tile of up to 6 rows × 2 vectors of C is held in
//! registers while the kernel walks along the shared dimension, loading 2 vectors of B and broadcasting 6 values of A per
//! step. It is written against [`Lanes`] and dispatched by `diamond-simd`; the portable instruction set is replaced by plain
//! arrays of four, which every compiler target turns into vectors and which have the same bits.
//!
//! Bits: every element of C is summed along the shared dimension in ascending order by one accumulator, so the result
//! depends neither on the tiling, the number of lanes, nor on how rows are dealt to threads; it does depend on whether the
//! instruction set fuses multiply and add.
use crate::mlp::Activation;
use diamond_simd::{Level, Scalar, Simd, WithSimd};

/// Row strides of every matrix are multiples of this many values, so that every row is a whole number of vectors of any
/// supported width (AVX-512 holds 16).
pub(crate) const ROW_ALIGNMENT: usize = 16;

/// Values and gradients inside the network saturate at ±this. With weights saturated alike, a layer's sums stay below
/// 1e24·width and a weight gradient's below 1e24·rows, far from overflow, so no finite input can produce NaN.
pub(crate) const MAGNITUDE_LIMIT: f32 = 1e12;

/// `width` rounded up to a whole number of the widest vectors.
pub(crate) const fn padded(width: usize) -> usize {
    width.div_ceil(ROW_ALIGNMENT) * ROW_ALIGNMENT
}

/// The vector operations that the kernel needs.
pub(crate) trait Lanes: Copy {
    /// A vector of [`Lanes::COUNT`] values.
    type V: Copy;
    /// Values per vector; divides [`ROW_ALIGNMENT`].
    const COUNT: usize;
    fn splat(self, value: f32) -> Self::V;
    /// a·b + c, fused where the instruction set has it.
    fn mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// 1/(1 + e^−x).
    fn sigmoid(self, x: Self::V) -> Self::V;
    fn vectors(slice: &[f32]) -> &[Self::V];
    fn vectors_mut(slice: &mut [f32]) -> &mut [Self::V];
}

/// Plain arrays of four: what every compiler target can do.
#[derive(Clone, Copy)]
pub(crate) struct Plain;

impl Lanes for Plain {
    type V = [f32; 4];
    const COUNT: usize = 4;
    #[inline(always)]
    fn splat(self, value: f32) -> [f32; 4] {
        [value; 4]
    }
    #[inline(always)]
    fn mul_add(self, a: [f32; 4], b: [f32; 4], c: [f32; 4]) -> [f32; 4] {
        [a[0] * b[0] + c[0], a[1] * b[1] + c[1], a[2] * b[2] + c[2], a[3] * b[3] + c[3]]
    }
    #[inline(always)]
    fn sigmoid(self, mut x: [f32; 4]) -> [f32; 4] {
        for x in &mut x {
            *x = diamond_simd::sigmoid(diamond_simd::Lanes::new(Scalar::new(), *x)).v;
        }
        x
    }
    #[inline(always)]
    fn vectors(slice: &[f32]) -> &[[f32; 4]] {
        slice.as_chunks::<4>().0
    }
    #[inline(always)]
    fn vectors_mut(slice: &mut [f32]) -> &mut [[f32; 4]] {
        slice.as_chunks_mut::<4>().0
    }
}

#[derive(Clone, Copy)]
struct Vectors<S>(S);

impl<S: Simd> Lanes for Vectors<S> {
    type V = S::f32s;
    const COUNT: usize = S::F32_LANES;
    #[inline(always)]
    fn splat(self, value: f32) -> S::f32s {
        self.0.splat_f32s(value)
    }
    #[inline(always)]
    fn mul_add(self, a: S::f32s, b: S::f32s, c: S::f32s) -> S::f32s {
        self.0.mul_add_e_f32s(a, b, c)
    }
    #[inline(always)]
    fn sigmoid(self, x: S::f32s) -> S::f32s {
        diamond_simd::sigmoid(diamond_simd::Lanes::new(self.0, x)).v
    }
    #[inline(always)]
    fn vectors(slice: &[f32]) -> &[S::f32s] {
        S::as_simd_f32s(slice).0
    }
    #[inline(always)]
    fn vectors_mut(slice: &mut [f32]) -> &mut [S::f32s] {
        S::as_mut_simd_f32s(slice).0
    }
}

/// A computation that [`dispatch`] compiles once per instruction set.
pub(crate) trait Kernel {
    fn run<L: Lanes>(self, lanes: L);
}

/// Runs `kernel` with the instruction set of the process.
pub(crate) fn dispatch<K: Kernel>(kernel: K) {
    dispatch_at(Level::current(), kernel);
}

/// Runs `kernel` with this instruction set.
fn dispatch_at<K: Kernel>(level: Level, kernel: K) {
    struct Adapter<K>(K);
    impl<K: Kernel> WithSimd for Adapter<K> {
        type Output = ();
        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) {
            if S::IS_SCALAR || !ROW_ALIGNMENT.is_multiple_of(S::F32_LANES) {
                self.0.run(Plain)
            } else {
                self.0.run(Vectors(simd))
            }
        }
    }
    level.dispatch(Adapter(kernel))
}

/// What C holds before the product is added.
#[derive(Clone, Copy)]
pub(crate) enum Init<'a> {
    /// Zero.
    Zero,
    /// This row (of `c_stride` values) in every row.
    Row(&'a [f32]),
    /// Its own values.
    Accumulate,
}

/// C = init + A·B, or C = init + Aᵀ·B, of row-major matrices. The columns computed are `columns` rounded up to a whole
/// vector, so padding must be there, and where B's padding is zero C's becomes the padding of `init`.
pub(crate) struct Product<'a> {
    /// `rows` × `inner`, or if `transpose_a`, `inner` × `rows`.
    pub a: &'a [f32],
    pub a_stride: usize,
    pub transpose_a: bool,
    /// `inner` × `columns`, stride a multiple of [`ROW_ALIGNMENT`].
    pub b: &'a [f32],
    pub b_stride: usize,
    /// `rows` × `columns`, stride a multiple of [`ROW_ALIGNMENT`].
    pub c: &'a mut [f32],
    pub c_stride: usize,
    pub rows: usize,
    pub inner: usize,
    pub columns: usize,
    pub init: Init<'a>,
}

/// Rows of a register tile: 6 × 2 accumulators, 2 vectors of B and one broadcast fill AVX2's 16 registers.
const TILE_ROWS: usize = 6;

impl Kernel for Product<'_> {
    #[inline(always)]
    fn run<L: Lanes>(self, lanes: L) {
        if self.transpose_a { run_product::<L, true>(lanes, self) } else { run_product::<L, false>(lanes, self) }
    }
}

#[inline(always)]
fn run_product<L: Lanes, const TRANSPOSE_A: bool>(lanes: L, p: Product<'_>) {
    let (b, b_stride, c_stride) = (L::vectors(p.b), p.b_stride / L::COUNT, p.c_stride / L::COUNT);
    let vectors = p.columns.div_ceil(L::COUNT);
    let (row_init, accumulate) = match p.init {
        Init::Zero => (None, false),
        Init::Row(row) => (Some(L::vectors(row)), false),
        Init::Accumulate => (None, true),
    };
    let c = L::vectors_mut(p.c);
    let shared = Shared { lanes, a: p.a, a_stride: p.a_stride, b, b_stride, inner: p.inner, row_init, accumulate };
    let mut row = 0;
    while row < p.rows {
        let c = &mut c[row * c_stride..];
        let height = (p.rows - row).min(TILE_ROWS);
        match height {
            6 => strip::<L, TRANSPOSE_A, 6>(&shared, row, c, c_stride, vectors),
            5 => strip::<L, TRANSPOSE_A, 5>(&shared, row, c, c_stride, vectors),
            4 => strip::<L, TRANSPOSE_A, 4>(&shared, row, c, c_stride, vectors),
            3 => strip::<L, TRANSPOSE_A, 3>(&shared, row, c, c_stride, vectors),
            2 => strip::<L, TRANSPOSE_A, 2>(&shared, row, c, c_stride, vectors),
            _ => strip::<L, TRANSPOSE_A, 1>(&shared, row, c, c_stride, vectors),
        }
        row += height;
    }
}

/// What every tile of one product reads.
struct Shared<'a, L: Lanes> {
    lanes: L,
    a: &'a [f32],
    a_stride: usize,
    b: &'a [L::V],
    b_stride: usize,
    inner: usize,
    row_init: Option<&'a [L::V]>,
    accumulate: bool,
}

/// `M` rows of C, from `row` on, which `c` starts with.
#[inline(always)]
fn strip<L: Lanes, const TRANSPOSE_A: bool, const M: usize>(
    s: &Shared<'_, L>,
    row: usize,
    c: &mut [L::V],
    c_stride: usize,
    vectors: usize,
) {
    let mut v = 0;
    while v + 2 <= vectors {
        tile::<L, TRANSPOSE_A, M, 2>(s, row, v, c, c_stride);
        v += 2;
    }
    if v < vectors {
        tile::<L, TRANSPOSE_A, M, 1>(s, row, v, c, c_stride);
    }
}

/// The register tile: `M` rows × `N` vectors.
#[inline(always)]
fn tile<L: Lanes, const TRANSPOSE_A: bool, const M: usize, const N: usize>(
    s: &Shared<'_, L>,
    row: usize,
    v: usize,
    c: &mut [L::V],
    c_stride: usize,
) {
    let mut acc = [[s.lanes.splat(0.0); N]; M];
    if let Some(init) = s.row_init {
        let init = &init[v..v + N];
        for m in 0..M {
            acc[m].copy_from_slice(init);
        }
    }
    if s.accumulate {
        for m in 0..M {
            acc[m].copy_from_slice(&c[m * c_stride + v..][..N]);
        }
    }
    if TRANSPOSE_A {
        for k in 0..s.inner {
            let b = &s.b[k * s.b_stride + v..][..N];
            let a = &s.a[k * s.a_stride + row..][..M];
            for m in 0..M {
                let value = s.lanes.splat(a[m]);
                for n in 0..N {
                    acc[m][n] = s.lanes.mul_add(value, b[n], acc[m][n]);
                }
            }
        }
    } else {
        let mut rows: [&[f32]; M] = [&[]; M];
        for m in 0..M {
            rows[m] = &s.a[(row + m) * s.a_stride..][..s.inner];
        }
        for k in 0..s.inner {
            let b = &s.b[k * s.b_stride + v..][..N];
            for m in 0..M {
                let value = s.lanes.splat(rows[m][k]);
                for n in 0..N {
                    acc[m][n] = s.lanes.mul_add(value, b[n], acc[m][n]);
                }
            }
        }
    }
    for m in 0..M {
        c[m * c_stride + v..][..N].copy_from_slice(&acc[m]);
    }
}

/// y ← activation(y) in place, padding included; the result saturates at [`MAGNITUDE_LIMIT`].
pub(crate) struct Activate<'a> {
    /// Whole rows of a stride that is a multiple of [`ROW_ALIGNMENT`].
    pub values: &'a mut [f32],
    pub activation: Activation,
}

impl Kernel for Activate<'_> {
    #[inline(always)]
    fn run<L: Lanes>(self, lanes: L) {
        let slope = match self.activation {
            Activation::Sigmoid => {
                for y in L::vectors_mut(self.values) {
                    *y = lanes.sigmoid(*y);
                }
                return;
            }
            Activation::Linear => 1.0,
            Activation::Relu => 0.0,
            Activation::LeakyRelu(slope) => slope,
        };
        for y in self.values.iter_mut() {
            let x = if *y > 0.0 { *y } else { slope * *y };
            *y = x.clamp(-MAGNITUDE_LIMIT, MAGNITUDE_LIMIT);
        }
    }
}

/// Pullback of [`Activate`] from its result: d ← d·activation′ in place (after saturating d at [`MAGNITUDE_LIMIT`]), and the
/// column sums of d are added to `d_bias` row by row.
pub(crate) struct ActivatePull<'a> {
    pub d_values: &'a mut [f32],
    pub values: &'a [f32],
    pub stride: usize,
    pub activation: Activation,
    /// `stride` values.
    pub d_bias: &'a mut [f32],
}

impl Kernel for ActivatePull<'_> {
    #[inline(always)]
    fn run<L: Lanes>(self, _lanes: L) {
        let d_bias = &mut self.d_bias[..self.stride];
        for (d_row, row) in self.d_values.chunks_exact_mut(self.stride).zip(self.values.chunks_exact(self.stride)) {
            match self.activation {
                Activation::Sigmoid => {
                    for ((d, &y), sum) in d_row.iter_mut().zip(row).zip(d_bias.iter_mut()) {
                        *d = d.clamp(-MAGNITUDE_LIMIT, MAGNITUDE_LIMIT) * (y * (1.0 - y));
                        *sum += *d;
                    }
                }
                Activation::Linear => scale_by_slope(d_row, row, d_bias, 1.0),
                Activation::Relu => scale_by_slope(d_row, row, d_bias, 0.0),
                Activation::LeakyRelu(slope) => scale_by_slope(d_row, row, d_bias, slope),
            }
        }
    }
}

#[inline(always)]
fn scale_by_slope(d_row: &mut [f32], row: &[f32], d_bias: &mut [f32], slope: f32) {
    for ((d, &y), sum) in d_row.iter_mut().zip(row).zip(d_bias.iter_mut()) {
        let factor = if y > 0.0 { 1.0 } else { slope };
        *d = d.clamp(-MAGNITUDE_LIMIT, MAGNITUDE_LIMIT) * factor;
        *sum += *d;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(i: usize) -> f32 {
        ((i * 7919 + 13) % 101) as f32 / 50.0 - 1.0
    }

    fn product(rows: usize, inner: usize, columns: usize, transpose_a: bool, init: Init<'_>, level: Level) -> Vec<f32> {
        let a_stride = if transpose_a { padded(rows) } else { padded(inner) };
        let a: Vec<f32> = (0..a_stride * if transpose_a { inner } else { rows }).map(value).collect();
        let stride = padded(columns);
        let b: Vec<f32> = (0..stride * inner).map(|i| value(i + 5)).collect();
        let mut c: Vec<f32> = (0..stride * rows).map(|i| value(i + 9)).collect();
        let p = Product {
            a: &a,
            a_stride,
            transpose_a,
            b: &b,
            b_stride: stride,
            c: &mut c,
            c_stride: stride,
            rows,
            inner,
            columns,
            init,
        };
        dispatch_at(level, p);
        c.chunks(stride).flat_map(|r| r[..columns].to_vec()).collect()
    }

    #[test]
    fn sigmoid_is_accurate_and_the_same_at_every_fused_width() {
        let values: Vec<f32> = (0..64).map(|i| i as f32 * 0.7 - 22.0).collect();
        let mut fused: Option<Vec<f32>> = None;
        for level in Level::testable() {
            let mut got = values.clone();
            dispatch_at(level, Activate { values: &mut got, activation: Activation::Sigmoid });
            for (&x, &y) in values.iter().zip(&got) {
                let expected = 1.0 / (1.0 + (-f64::from(x)).exp());
                assert!((f64::from(y) - expected).abs() < 4e-7 * expected, "{level:?} {x}: {y}");
            }
            if level.is_fused() {
                assert_eq!(*fused.get_or_insert_with(|| got.clone()), got, "{level:?}");
            }
        }
    }

    #[test]
    fn product_matches_the_triple_loop_for_odd_sizes() {
        for (rows, inner, columns) in
            [(1, 1, 1), (5, 3, 7), (6, 16, 16), (13, 42, 33), (64, 64, 64), (17, 1, 50), (3, 0, 4)]
        {
            for transpose_a in [false, true] {
                for mode in 0..3 {
                    let row: Vec<f32> = (0..padded(columns)).map(|i| value(i + 3)).collect();
                    let init = [Init::Zero, Init::Row(&row), Init::Accumulate][mode];
                    let a_stride = if transpose_a { padded(rows) } else { padded(inner) };
                    let mut fused: Option<Vec<f32>> = None;
                    for level in Level::testable() {
                        let got = product(rows, inner, columns, transpose_a, init, level);
                        if level.is_fused() {
                            assert_eq!(*fused.get_or_insert_with(|| got.clone()), got, "{level:?}");
                        }
                        for r in 0..rows {
                            for c in 0..columns {
                                let mut expected = match mode {
                                    0 => 0.0,
                                    1 => f64::from(row[c]),
                                    _ => f64::from(value(r * padded(columns) + c + 9)),
                                };
                                for k in 0..inner {
                                    let a = value(if transpose_a { k * a_stride + r } else { r * a_stride + k });
                                    expected += f64::from(a) * f64::from(value(k * padded(columns) + c + 5));
                                }
                                let found = f64::from(got[r * columns + c]);
                                assert!(
                                    (found - expected).abs() < 1e-4,
                                    "{rows}x{inner}x{columns} transpose {transpose_a} mode {mode} {level:?}: {found} {expected}"
                                );
                            }
                        }
                    }
                }
            }
        }
    }
}
