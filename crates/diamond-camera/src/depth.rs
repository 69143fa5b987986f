//! Depth, with its kind in the type.

/// Depth of a point seen by a camera, in scene units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Depth {
    /// View-space z.
    Z(f32),
    /// Euclidean distance from the camera centre.
    Distance(f32),
}

impl Depth {
    /// The number, whatever its kind.
    pub fn value(self) -> f32 {
        match self {
            Depth::Z(v) | Depth::Distance(v) => v,
        }
    }
}
