//! What operations on the CPU share: the two number types, contiguous slices of tensors, the matrix product.
use candle_core::{CpuStorage, Layout, Result, Storage, Tensor, WithDType, bail};

/// `f32` or `f64` on the CPU.
pub(crate) trait Real: WithDType {
    /// e to the power of `self`, the same bits on every machine.
    fn power_of_e(self) -> Self;
}

impl Real for f32 {
    fn power_of_e(self) -> Self {
        libm::expf(self)
    }
}

impl Real for f64 {
    fn power_of_e(self) -> Self {
        libm::exp(self)
    }
}

/// The values of a contiguous storage.
pub(crate) fn slice<'a, T: Real>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [T]> {
    let values = T::cpu_storage_as_slice(storage)?;
    match layout.contiguous_offsets() {
        Some((from, to)) => Ok(&values[from..to]),
        None => bail!("expected a contiguous tensor, found strides {:?}", layout.stride()),
    }
}

/// Calls `f` with the values of contiguous tensors on the CPU, all of one type.
pub(crate) fn with_slices<T: Real, R, const N: usize>(
    tensors: [&Tensor; N],
    f: impl FnOnce([&[T]; N]) -> Result<R>,
) -> Result<R> {
    let guards = tensors.map(Tensor::storage_and_layout);
    let mut slices: [&[T]; N] = [&[]; N];
    for (slot, (storage, layout)) in slices.iter_mut().zip(&guards) {
        let Storage::Cpu(storage) = &**storage else { bail!("expected a tensor on the CPU") };
        *slot = slice(storage, layout)?;
    }
    f(slices)
}

/// Runs a generic function for the type of a storage; other types are an error.
macro_rules! by_type {
    ($storage:expr, $function:ident ( $($argument:expr),* )) => {
        match $storage {
            candle_core::DType::F32 => $function::<f32>($($argument),*),
            candle_core::DType::F64 => $function::<f64>($($argument),*),
            other => candle_core::bail!("expected f32 or f64, found {other:?}; convert the tensor first"),
        }
    };
}
pub(crate) use by_type;

/// A matrix inside a slice: its values and the distances between rows and between columns.
#[derive(Clone, Copy)]
pub(crate) struct Matrix<'a, T> {
    /// From the first element on.
    pub values: &'a [T],
    /// Distance of neighbours in a column.
    pub row_stride: usize,
    /// Distance of neighbours in a row.
    pub column_stride: usize,
}

impl<'a, T> Matrix<'a, T> {
    /// Rows one after the other, `columns` apart.
    pub fn rows(values: &'a [T], columns: usize) -> Self {
        Self { values, row_stride: columns, column_stride: 1 }
    }

    /// The transpose.
    pub fn t(self) -> Self {
        Self { values: self.values, row_stride: self.column_stride, column_stride: self.row_stride }
    }
}

/// `c = a·b`, or `c + a·b` with `add`, on one thread: `a` is m × k, `b` k × n, `c` m × n with rows `c_stride` apart.
pub(crate) fn matmul<T: Real>(
    (m, k, n): (usize, usize, usize),
    a: Matrix<'_, T>,
    b: Matrix<'_, T>,
    c: &mut [T],
    c_stride: usize,
    add: bool,
) {
    if m == 0 || n == 0 || k == 0 {
        return;
    }
    let last = |rows: usize, columns: usize, matrix: &Matrix<'_, T>| {
        (rows - 1) * matrix.row_stride + (columns - 1) * matrix.column_stride
    };
    assert!(last(m, k, &a) < a.values.len() && last(k, n, &b) < b.values.len());
    assert!((m - 1) * c_stride + n - 1 < c.len() && n <= c_stride);
    let one = T::from_f64(1.0);
    // SAFETY: the farthest element of each matrix was just checked to be inside its slice, rows of c do not overlap.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            c.as_mut_ptr(),
            1,
            c_stride as isize,
            add,
            a.values.as_ptr(),
            a.column_stride as isize,
            a.row_stride as isize,
            b.values.as_ptr(),
            b.column_stride as isize,
            b.row_stride as isize,
            one,
            one,
            false,
            false,
            false,
            gemm::Parallelism::None,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_with_strides_and_transposes_are_those_by_hand() {
        let a = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let b = [1.0, -1.0, 0.5, 2.0, 1.0, 3.0];
        // (2 × 3) · (3 × 2), then the same from transposed copies, added.
        let mut c = [0.0f64; 4];
        matmul((2, 3, 2), Matrix::rows(&a, 3), Matrix::rows(&b, 2), &mut c, 2, false);
        assert_eq!(c, [5.0, 12.0, 12.5, 24.0]);
        let a_t = [1.0, 4.0, 2.0, 5.0, 3.0, 6.0];
        matmul((2, 3, 2), Matrix::rows(&a_t, 2).t(), Matrix::rows(&b, 2), &mut c, 2, true);
        assert_eq!(c, [10.0, 24.0, 25.0, 48.0]);
    }
}
