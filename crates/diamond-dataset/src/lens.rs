//! Intrinsics and lens distortion as `transforms*.json` states them.
//!
//! Fields of the frame go before those of the top level, focal lengths (`fl_x fl_y cx cy`, pixels) before angles
//! (`camera_angle_x`, radians). Distortion is `k1 k2 k3 k4 p1 p2` under `camera_model`.
use crate::DatasetError;
use crate::field::Object;
use diamond_camera::{Distortion, Intrinsics};

/// Intrinsics as written; the image size may still be unknown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Lens {
    /// Horizontal field of view.
    FovX {
        /// The angle, radians.
        fov_x: f32,
        /// Principal point x, pixels; the middle where it is not said.
        cx: Option<f32>,
        /// Principal point y, pixels; the middle where it is not said.
        cy: Option<f32>,
    },
    /// Focal lengths.
    Focal {
        /// Along x, pixels.
        fx: f32,
        /// Along y, pixels.
        fy: f32,
        /// Principal point x, pixels; the middle where it is not said.
        cx: Option<f32>,
        /// Principal point y, pixels; the middle where it is not said.
        cy: Option<f32>,
    },
}

impl Lens {
    /// Intrinsics for an image of a size, pixels.
    pub fn intrinsics(&self, width: u32, height: u32) -> Intrinsics {
        let (middle_x, middle_y) = (0.5 * width as f32, 0.5 * height as f32);
        match *self {
            Lens::FovX { fov_x, cx, cy } => {
                let k = Intrinsics::from_fov_x(fov_x, width, height);
                Intrinsics { cx: cx.unwrap_or(k.cx), cy: cy.unwrap_or(k.cy), ..k }
            }
            Lens::Focal { fx, fy, cx, cy } => {
                Intrinsics { fx, fy, cx: cx.unwrap_or(middle_x), cy: cy.unwrap_or(middle_y), width, height }
            }
        }
    }
}

/// Below a thousandth of a pixel nothing can be projected without overflow.
const MIN_FOCAL: f32 = 1e-3;

/// Intrinsics of a frame.
pub(crate) fn parse_lens(top: &Object, frame: &Object) -> Result<Lens, DatasetError> {
    let either = |name: &str| -> Result<Option<f32>, DatasetError> {
        Ok(match frame.number(name)? {
            Some(v) => Some(v as f32),
            None => top.number(name)?.map(|v| v as f32),
        })
    };
    let (cx, cy) = (either("cx")?, either("cy")?);
    let focal = |object: &Object| -> Result<Option<Lens>, DatasetError> {
        let Some(fx) = object.number("fl_x")?.map(|v| v as f32) else { return Ok(None) };
        let fy = object.number("fl_y")?.map_or(fx, |v| v as f32);
        for (name, v) in [("fl_x", fx), ("fl_y", fy)] {
            if v < MIN_FOCAL {
                let expected = "a positive focal length in pixels";
                return Err(object.error(name, expected, v.to_string(), "correct the value"));
            }
        }
        Ok(Some(Lens::Focal { fx, fy, cx, cy }))
    };
    let angle = |object: &Object| -> Result<Option<Lens>, DatasetError> {
        let Some(fov_x) = object.number("camera_angle_x")?.map(|v| v as f32) else { return Ok(None) };
        if !(1e-4..=std::f32::consts::PI - 1e-3).contains(&fov_x) {
            return Err(object.error(
                "camera_angle_x",
                "a horizontal field of view in radians, between 0 and π",
                fov_x.to_string(),
                "convert degrees to radians",
            ));
        }
        Ok(Some(Lens::FovX { fov_x, cx, cy }))
    };
    let lenses = [focal(frame)?, angle(frame)?, focal(top)?, angle(top)?];
    if let Some(lens) = lenses.into_iter().flatten().next() {
        return Ok(lens);
    }
    let advice = "add camera_angle_x (radians) at the top level, or fl_x fl_y cx cy (pixels) to the frame";
    Err(frame.error("camera_angle_x", "a field of view or a focal length", "neither", advice))
}

/// What to do about a lens that is not undistorted here.
pub(crate) const UNDISTORT: &str = "undistort the images first, for instance with \"colmap image_undistorter\", and use \
                                    the cameras that it writes";

/// Lens distortion of a frame.
pub(crate) fn parse_distortion(top: &Object, frame: &Object) -> Result<Distortion, DatasetError> {
    let number = |name: &str| -> Result<f64, DatasetError> {
        Ok(frame.number(name)?.map_or_else(|| top.number(name), |v| Ok(Some(v)))?.unwrap_or(0.0))
    };
    let (object, model) = match (frame.get("camera_model"), top.get("camera_model")) {
        (Some(v), _) => (frame, Some(frame.as_text(v, "camera_model")?)),
        (None, Some(v)) => (top, Some(top.as_text(v, "camera_model")?)),
        (None, None) => (top, None),
    };
    let (k1, k2, k3, k4) = (number("k1")?, number("k2")?, number("k3")?, number("k4")?);
    let (p1, p2) = (number("p1")?, number("p2")?);
    let is_true = |o: &Object| o.get("is_fisheye").and_then(serde_json::Value::as_bool).unwrap_or(false);
    let fisheye = match model {
        Some("OPENCV_FISHEYE") => true,
        None => is_true(frame) || is_true(top),
        Some("OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL") => false,
        Some(other) => {
            let expected = "OPENCV, OPENCV_FISHEYE, RADIAL, SIMPLE_RADIAL, PINHOLE or SIMPLE_PINHOLE";
            return Err(object.error("camera_model", expected, format!("\"{other}\""), UNDISTORT));
        }
    };
    if fisheye {
        return Ok(Distortion::Fisheye { k1, k2, k3, k4 });
    }
    if k4 != 0.0 {
        // OpenCV's fourth coefficient is in a denominator, other programs' multiplies r⁸.
        let expected = "0 for a lens that is no fisheye: programs disagree on what a fourth coefficient means";
        let object = if frame.get("k4").is_some() { frame } else { top };
        return Err(object.error("k4", expected, k4.to_string(), UNDISTORT));
    }
    let lens = Distortion::Brown { k1, k2, k3, p1, p2 };
    Ok(if lens.is_none() { Distortion::None } else { lens })
}
