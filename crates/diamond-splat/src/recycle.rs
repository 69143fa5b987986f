//! Buffers that one picture hands on to the next.
//!
//! A training step asks for tens of megabytes and gives them back a moment later. General allocators return such pieces to
//! the system, which then clears and maps every page again: an eighth of the time of a large picture.
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Bytes that a pool keeps at most, unless told otherwise: beyond it, memory matters more than the time to map it.
pub const KEPT_BYTES: usize = 256 << 20;

static KEPT: AtomicUsize = AtomicUsize::new(KEPT_BYTES);

/// How many bytes of buffers the rasteriser keeps, of each of three kinds, from one picture to the next
/// ([`KEPT_BYTES`] unless told otherwise), in this process: with 0 each picture asks the system anew. What comes out does
/// not depend on it.
pub fn keep_buffers(bytes: usize) {
    KEPT.store(bytes, Ordering::Relaxed);
}

/// Empty vectors with capacity.
pub(crate) struct Pool<T> {
    kept: Mutex<Kept<T>>,
}

struct Kept<T> {
    vectors: Vec<Vec<T>>,
    bytes: usize,
}

impl<T> Pool<T> {
    pub const fn new() -> Self {
        Self { kept: Mutex::new(Kept { vectors: Vec::new(), bytes: 0 }) }
    }

    /// An empty vector, with whatever capacity.
    pub fn take(&self) -> Vec<T> {
        // A poisoned lock means that another thread panicked; its vectors are as good as any.
        let mut kept = self.kept.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let vector = kept.vectors.pop().unwrap_or_default();
        kept.bytes -= vector.capacity() * size_of::<T>();
        vector
    }

    /// Keeps a vector for later.
    pub fn give(&self, mut vector: Vec<T>) {
        vector.clear();
        let bytes = vector.capacity() * size_of::<T>();
        let mut kept = self.kept.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        if bytes > 0 && kept.bytes + bytes <= KEPT.load(Ordering::Relaxed) {
            kept.bytes += bytes;
            kept.vectors.push(vector);
        }
    }
}

/// Pixels, and gradients of slots.
pub(crate) static FLOATS: Pool<f32> = Pool::new();
/// Entries of block lists.
pub(crate) static ENTRIES: Pool<u32> = Pool::new();

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vectors_come_back_empty_and_not_without_bound() {
        let pool: Pool<u8> = Pool::new();
        pool.give(vec![1, 2, 3]);
        pool.give(Vec::with_capacity(KEPT_BYTES));
        let taken = pool.take();
        assert!(taken.is_empty() && (3..100).contains(&taken.capacity()));
        assert_eq!(pool.take().capacity(), 0);
        assert_eq!(pool.kept.lock().unwrap().bytes, 0);
    }
}
