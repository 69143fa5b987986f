//! Work dealt to threads in fixed pieces.

/// `f(0), f(1), …, f(count − 1)` in that order, on whatever threads there are: the same bits on any number of them.
pub(crate) fn map_pixels<T: Send>(count: usize, f: impl Fn(usize) -> T + Send + Sync) -> Vec<T> {
    #[cfg(feature = "parallel")]
    {
        use rayon::prelude::*;
        (0..count).into_par_iter().with_min_len(64).map(f).collect()
    }
    #[cfg(not(feature = "parallel"))]
    {
        (0..count).map(f).collect()
    }
}
