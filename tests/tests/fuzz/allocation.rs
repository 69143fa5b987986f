//! How much memory a reader asks for: an allocator that counts what one thread holds.
//!
//! A thread that asks for more than its limit is stopped where it stands: it sleeps for good inside the allocator, and who
//! watches it reads the amount. The memory is never taken, so a reader that wants a terabyte does no harm.
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::atomic::{AtomicIsize, Ordering};
use std::time::Duration;

/// The system's allocator with a counter per thread.
pub struct Counting;

struct Watch {
    held: Cell<isize>,
    limit: Cell<isize>,
    exceeded: Cell<Option<&'static AtomicIsize>>,
}

thread_local! {
    // Constant and without a destructor: reading it allocates nothing and is allowed at any time.
    static WATCH: Watch = const { Watch { held: Cell::new(0), limit: Cell::new(isize::MAX), exceeded: Cell::new(None) } };
}

/// Counts what this thread allocates from now on; at more than `limit` bytes the amount goes to `exceeded`, and the
/// thread stops for good.
pub fn watch(limit: usize, exceeded: &'static AtomicIsize) {
    WATCH.with(|w| {
        w.held.set(0);
        w.exceeded.set(Some(exceeded));
        w.limit.set(isize::try_from(limit).unwrap_or(isize::MAX));
    });
}

/// Ends the counting.
pub fn unwatch() {
    WATCH.with(|w| w.limit.set(isize::MAX));
}

fn count(bytes: isize) {
    let _ = WATCH.try_with(|w| {
        if w.limit.get() == isize::MAX {
            return;
        }
        let held = w.held.get().saturating_add(bytes);
        w.held.set(held);
        if held > w.limit.get()
            && let Some(exceeded) = w.exceeded.get()
        {
            exceeded.store(held, Ordering::SeqCst);
            loop {
                std::thread::sleep(Duration::from_secs(3600));
            }
        }
    });
}

// SAFETY: every call goes to the system's allocator with the arguments as they came; counting touches only constant
// thread-local cells.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size() as isize);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count(layout.size() as isize);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count(-(layout.size() as isize));
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        count(new_size as isize - layout.size() as isize);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.realloc(pointer, layout, new_size) }
    }
}
