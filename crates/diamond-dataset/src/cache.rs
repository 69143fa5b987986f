//! A bounded cache of stored images: least recently used first out.
use crate::stored::StoredImage;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// Stored images by path, at most `limit` bytes of them. What is in the cache never changes what a caller sees.
#[derive(Debug)]
pub(crate) struct ImageCache {
    limit: AtomicUsize,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    images: BTreeMap<PathBuf, (u64, Arc<StoredImage>)>,
    by_use: BTreeMap<u64, PathBuf>,
    bytes: usize,
    clock: u64,
}

impl ImageCache {
    pub(crate) fn new(limit: usize) -> Self {
        Self { limit: AtomicUsize::new(limit), state: Mutex::default() }
    }

    /// The image at `path`, from the cache or from `load`. Loading happens outside the lock, so two threads that ask for
    /// the same missing image may both load it; they get equal images.
    pub(crate) fn get<E>(
        &self,
        path: &Path,
        load: impl FnOnce() -> Result<StoredImage, E>,
    ) -> Result<Arc<StoredImage>, E> {
        if let Some(image) = self.lock().touch(path) {
            return Ok(image);
        }
        let image = Arc::new(load()?);
        let limit = self.limit.load(Ordering::Relaxed);
        if image.bytes() <= limit {
            self.lock().insert(path, &image, limit);
        }
        Ok(image)
    }

    /// Holds at most `limit` bytes from now on; what is beyond is dropped at once.
    pub(crate) fn set_limit(&self, limit: usize) {
        self.limit.store(limit, Ordering::Relaxed);
        self.lock().shrink(limit);
    }

    /// Bytes of samples held now.
    pub(crate) fn bytes(&self) -> usize {
        self.lock().bytes
    }

    /// No operation under the lock can leave the state half-changed in a way that matters, so poison is ignored.
    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn touch(&mut self, path: &Path) -> Option<Arc<StoredImage>> {
        self.clock += 1;
        let (used, image) = self.images.get_mut(path)?;
        self.by_use.remove(used);
        *used = self.clock;
        self.by_use.insert(self.clock, path.to_path_buf());
        Some(Arc::clone(image))
    }

    fn insert(&mut self, path: &Path, image: &Arc<StoredImage>, limit: usize) {
        if self.touch(path).is_some() {
            return;
        }
        self.bytes += image.bytes();
        self.images.insert(path.to_path_buf(), (self.clock, Arc::clone(image)));
        self.by_use.insert(self.clock, path.to_path_buf());
        self.shrink(limit);
    }

    fn shrink(&mut self, limit: usize) {
        while self.bytes > limit {
            let Some((_, oldest)) = self.by_use.pop_first() else { return };
            if let Some((_, image)) = self.images.remove(&oldest) {
                self.bytes -= image.bytes();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::ImageCache;
    use crate::stored::StoredImage;
    use std::path::Path;

    #[test]
    fn stays_within_its_bound_and_drops_the_least_recently_used() {
        let cache = ImageCache::new(100);
        let mut loads = 0;
        let mut get = |name: &str, size: usize| {
            cache
                .get(Path::new(name), || {
                    loads += 1;
                    Ok::<_, ()>(StoredImage::from_bytes(size as u32, 1, 1, vec![7; size]))
                })
                .unwrap();
            assert!(cache.bytes() <= 100);
            loads
        };
        assert_eq!(get("a", 40), 1);
        assert_eq!(get("b", 40), 2);
        assert_eq!(get("a", 40), 2, "a hit");
        assert_eq!(get("c", 40), 3, "drops b");
        assert_eq!(get("a", 40), 3, "still there");
        assert_eq!(get("b", 40), 4, "was dropped");
        assert_eq!(get("huge", 101), 5);
        assert_eq!(get("huge", 101), 6, "never kept");
        assert_eq!(cache.bytes(), 80);
        cache.set_limit(50);
        assert_eq!(cache.bytes(), 40, "the older one was dropped");
        cache.set_limit(0);
        assert_eq!(cache.bytes(), 0);
    }

    #[test]
    fn a_failed_load_is_not_kept() {
        let cache = ImageCache::new(100);
        assert_eq!(cache.get(Path::new("a"), || Err("no")).err(), Some("no"));
        assert!(cache.get(Path::new("a"), || Ok::<_, ()>(StoredImage::from_bytes(1, 1, 1, vec![0]))).is_ok());
    }
}
