//! Rows of a batch dealt to threads in fixed chunks.
//!
//! The chunk boundaries depend on the number of rows only, so a result that is computed chunk by chunk, and reduced in
//! the order of chunks, has the same bits on any number of threads, and without the feature `parallel`.

/// `f(0), f(1), …, f(count − 1)`, in that order, computed on whatever threads there are.
pub(crate) fn map_chunks<T: Send>(count: usize, f: impl Fn(usize) -> T + Send + Sync) -> Vec<T> {
    #[cfg(feature = "parallel")]
    {
        use rayon::prelude::*;
        (0..count).into_par_iter().with_max_len(1).map(f).collect()
    }
    #[cfg(not(feature = "parallel"))]
    {
        (0..count).map(f).collect()
    }
}

/// `f(i, chunk i of values)` in the order of chunks, where a chunk is `length` values and the last may be shorter.
pub(crate) fn map_chunks_mut<U: Send, T: Send>(
    values: &mut [U],
    length: usize,
    f: impl Fn(usize, &mut [U]) -> T + Sync,
) -> Vec<T> {
    #[cfg(feature = "parallel")]
    {
        use rayon::prelude::*;
        values.par_chunks_mut(length.max(1)).with_max_len(1).enumerate().map(|(i, chunk)| f(i, chunk)).collect()
    }
    #[cfg(not(feature = "parallel"))]
    {
        values.chunks_mut(length.max(1)).enumerate().map(|(i, chunk)| f(i, chunk)).collect()
    }
}

thread_local! {
    static SCRATCH: std::cell::Cell<Vec<f32>> = const { std::cell::Cell::new(Vec::new()) };
}

/// Calls `f` with `length` values of this thread's scratch memory, of which `f` may assume nothing. The memory stays with
/// the thread (some 100 kB), because handing it back to the system and touching it again costs more than the work on it.
pub(crate) fn with_scratch<T>(length: usize, f: impl FnOnce(&mut [f32]) -> T) -> T {
    SCRATCH.with(|cell| {
        // A nested call finds an empty vector and makes its own.
        let mut memory = cell.take();
        if memory.len() < length {
            memory.resize(length, 0.0);
        }
        let result = f(&mut memory[..length]);
        cell.set(memory);
        result
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What `parallel` returns is what plain loops over the same chunks return, in the same order.
    #[test]
    fn chunks_come_in_order_whatever_the_threads() {
        let square = |i: usize| i * i;
        assert_eq!(map_chunks(1000, square), (0..1000).map(square).collect::<Vec<_>>());
        let mut values: Vec<usize> = (0..1003).collect();
        let mut expected = values.clone();
        let f = |i: usize, chunk: &mut [usize]| {
            chunk.iter_mut().for_each(|v| *v += i);
            (i, chunk.len())
        };
        let found = map_chunks_mut(&mut values, 10, f);
        let plain: Vec<_> = expected.chunks_mut(10).enumerate().map(|(i, chunk)| f(i, chunk)).collect();
        assert_eq!((found, values), (plain, expected));
        assert!(map_chunks_mut(&mut [0.0f32; 0], 0, |_, _| ()).is_empty());
    }

    #[test]
    fn scratch_memory_may_be_asked_for_again_inside() {
        let length = with_scratch(10, |outer| with_scratch(20, |inner| outer.len() + inner.len()));
        assert_eq!(length, 30);
    }
}
