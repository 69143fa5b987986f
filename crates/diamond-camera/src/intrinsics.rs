//! Pinhole intrinsics.
use crate::CameraError;

/// Pinhole intrinsics in pixels; the principal point may lie anywhere, even outside the image.
///
/// ```
/// use diamond_camera::Intrinsics;
/// let k = Intrinsics::from_fov_x(std::f32::consts::FRAC_PI_2, 640, 480);
/// assert!((k.fx - 320.0).abs() < 1e-3 && k.cx == 320.0 && k.cy == 240.0);
/// k.validate()?;
/// assert_eq!(k.resized(320, 240).cy, 120.0);
/// # Ok::<(), diamond_camera::CameraError>(())
/// ```
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
    /// Square pixels, centred principal point, horizontal field of view `fov_x` in radians (0 … π, both excluded; see
    /// [`Intrinsics::validate`]).
    pub fn from_fov_x(fov_x: f32, width: u32, height: u32) -> Self {
        let f = 0.5 * width as f32 / libm::tanf(0.5 * fov_x);
        Self { fx: f, fy: f, cx: 0.5 * width as f32, cy: 0.5 * height as f32, width, height }
    }

    /// Horizontal angle of view in radians; for off-centre principal points, the angle between the left and the right
    /// border.
    pub fn fov_x(&self) -> f32 {
        libm::atanf(self.cx / self.fx) + libm::atanf((self.width as f32 - self.cx) / self.fx)
    }

    /// `Err` unless the focal lengths are finite and positive, the principal point finite and the size not zero.
    pub fn validate(&self) -> Result<(), CameraError> {
        for (field, v) in [("fx", self.fx), ("fy", self.fy)] {
            if !(v.is_finite() && v > 0.0) {
                let expected = "a finite focal length > 0 in pixels";
                return Err(CameraError::Intrinsics { field, expected, found: format!("{v}") });
            }
        }
        for (field, v) in [("cx", self.cx), ("cy", self.cy)] {
            if !v.is_finite() {
                let expected = "a finite principal point in pixels";
                return Err(CameraError::Intrinsics { field, expected, found: format!("{v}") });
            }
        }
        for (field, v) in [("width", self.width), ("height", self.height)] {
            if v == 0 {
                let expected = "at least one pixel";
                return Err(CameraError::Intrinsics { field, expected, found: format!("{v}") });
            }
        }
        Ok(())
    }

    /// The intrinsics of the same view resampled to `width` × `height` pixels: focal lengths and principal point scale
    /// with the image, per axis. With +0.5 centres a pixel coordinate `u` becomes `u·width/self.width` exactly.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let sx = width as f32 / self.width.max(1) as f32;
        let sy = height as f32 / self.height.max(1) as f32;
        Self { fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy, width, height }
    }

    /// The intrinsics of the part of the image that starts at column `x`, row `y` and is `width` × `height` pixels.
    pub fn cropped(&self, x: u32, y: u32, width: u32, height: u32) -> Self {
        Self { cx: self.cx - x as f32, cy: self.cy - y as f32, width, height, ..*self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: Intrinsics = Intrinsics { fx: 100.0, fy: 90.0, cx: 31.0, cy: 20.0, width: 64, height: 48 };

    #[test]
    fn each_bad_field_is_named() {
        assert!(GOOD.validate().is_ok());
        let bad = [
            ("fx", Intrinsics { fx: 0.0, ..GOOD }),
            ("fx", Intrinsics { fx: f32::NAN, ..GOOD }),
            ("fx", Intrinsics { fx: f32::INFINITY, ..GOOD }),
            ("fy", Intrinsics { fy: -90.0, ..GOOD }),
            ("cx", Intrinsics { cx: f32::NAN, ..GOOD }),
            ("cy", Intrinsics { cy: f32::NEG_INFINITY, ..GOOD }),
            ("width", Intrinsics { width: 0, ..GOOD }),
            ("height", Intrinsics { height: 0, ..GOOD }),
            ("fx", Intrinsics::from_fov_x(f32::NAN, 8, 8)),
            ("fx", Intrinsics::from_fov_x(0.0, 8, 8)),
            ("fx", Intrinsics::from_fov_x(4.0, 8, 8)),
        ];
        for (name, k) in bad {
            match k.validate() {
                Err(CameraError::Intrinsics { field, .. }) => assert_eq!(field, name, "{k:?}"),
                other => panic!("{k:?} gave {other:?}"),
            }
        }
        assert!(Intrinsics { fx: -1.0, ..GOOD }.validate().unwrap_err().to_string().contains("fx: expected a finite"));
        // A principal point outside the image is allowed.
        assert!(Intrinsics { cx: -500.0, ..GOOD }.validate().is_ok());
    }

    #[test]
    fn field_of_view_round_trips() {
        for fov in [0.1f32, 0.7, 1.5, 2.9] {
            assert!((Intrinsics::from_fov_x(fov, 123, 77).fov_x() - fov).abs() < 1e-5);
        }
    }
}
