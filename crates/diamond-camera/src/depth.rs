//! Depth, with its kind in the type.

/// Depth of a point seen by a camera, in scene units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Depth {
    /// View-space z.
    Z(f32),
    /// Euclidean distance from the camera centre.
    Distance(f32),
}
