//! How much is held at once where less would do: time depends on it, results do not.
use diamond_reconstruct::{Config, LIGHTS_TOGETHER, Model, PICTURE_BYTES, Renderer};
use serde::Serialize;

/// Bytes of traced visibility that are kept from one view to the next, unless told otherwise: 112 lights of 150,000
/// Gaussians.
const VISIBILITY_BYTES: u64 = 64 << 20;

/// How much is held at once.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct AtOnce {
    /// Bytes of photographs that are kept decoded.
    pub photographs: u64,
    /// Bytes of each kind of the rasteriser's buffers that are kept from one picture to the next.
    pub buffers: u64,
    /// Lights of a view that are blended together.
    pub lights: usize,
    /// Bytes of pictures of one view that are rendered before the first is looked at.
    pub pictures: u64,
    /// Bytes of traced visibility that are kept from one view to the next.
    pub visibility: u64,
    /// Whether the photographs are all decoded at the start on as many threads as there are, or on one.
    pub decode_in_parallel: bool,
}

impl Default for AtOnce {
    fn default() -> Self {
        Self {
            photographs: 0,
            buffers: diamond_splat::KEPT_BYTES as u64,
            lights: LIGHTS_TOGETHER,
            pictures: PICTURE_BYTES as u64,
            visibility: VISIBILITY_BYTES,
            decode_in_parallel: true,
        }
    }
}

impl AtOnce {
    /// What a configuration asks for where memory does not matter.
    pub fn of(config: &Config) -> Self {
        Self { photographs: config.input.cache_bytes as u64, ..Self::default() }
    }

    /// As little as possible.
    pub fn least() -> Self {
        Self { photographs: 0, buffers: 0, lights: 1, pictures: 0, visibility: 0, decode_in_parallel: false }
    }

    /// Pictures of so many pixels that are rendered before the first is looked at, at least one.
    pub fn pictures_together(&self, pixels: u64) -> usize {
        ((self.pictures / (12 * pixels).max(1)) as usize).clamp(1, self.lights.max(1))
    }

    /// A renderer that holds no more at once.
    pub fn renderer<'m>(&self, model: &'m Model) -> Renderer<'m> {
        Renderer::new(model)
            .with_lights_together(self.lights)
            .with_picture_bytes(self.pictures as usize)
            .with_kept_visibility(self.visibility as usize)
    }
}
