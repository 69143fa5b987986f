//! Pinhole intrinsics.

/// Pinhole intrinsics in pixels; the principal point may lie anywhere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    /// Focal length along x, pixels.
    pub fx: f32,
    /// Focal length along y, pixels.
    pub fy: f32,
    /// Principal point x, pixels (pixel centres at +0.5).
    pub cx: f32,
    /// Principal point y, pixels.
    pub cy: f32,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
}

impl Intrinsics {
    /// Square pixels, centred principal point, horizontal field of view `fov_x` in radians.
    pub fn from_fov_x(fov_x: f32, width: u32, height: u32) -> Self {
        let f = 0.5 * width as f32 / (0.5 * fov_x).tan();
        Self { fx: f, fy: f, cx: 0.5 * width as f32, cy: 0.5 * height as f32, width, height }
    }
}
