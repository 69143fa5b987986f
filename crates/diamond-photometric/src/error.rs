//! What can be wrong with the inputs of photometric stereo.
use diamond_camera::CameraError;
use diamond_light::LightError;
use std::fmt;

/// Why normals cannot be estimated from a view.
#[derive(Debug, Clone, PartialEq)]
pub enum PhotometricError {
    /// An image or mask does not have the camera's size, or images differ in channels.
    Shape {
        /// Which input.
        what: String,
        /// The shape that was expected.
        expected: String,
        /// What was found.
        found: String,
    },
    /// Fewer than three images: a normal has two unknowns, the albedo is a third.
    TooFewLights {
        /// How many were given.
        found: usize,
    },
    /// Every light is behind the object as seen from the camera, so that no visible pixel is lit directly.
    LightsBehind {
        /// How many lights were given.
        lights: usize,
    },
    /// No pixel has a coverage of at least ½.
    EmptyMask,
    /// The images are black where the mask says that there is an object.
    Dark,
    /// A value is NaN or infinite.
    NonFinite {
        /// Which input.
        what: String,
        /// The first such value.
        at: String,
    },
    /// A setting is outside its range.
    Setting {
        /// Which setting.
        what: &'static str,
        /// The range that it must lie in.
        expected: &'static str,
        /// The value that was found.
        found: f32,
    },
    /// The camera is unusable.
    Camera(CameraError),
    /// A light is unusable.
    Light(LightError),
}

impl fmt::Display for PhotometricError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Shape { what, expected, found } => {
                write!(f, "{what}: expected {expected}, found {found}; all images and the mask have the camera's size")
            }
            Self::TooFewLights { found } => write!(
                f,
                "photometric stereo: expected at least 3 images of the view, each under a light of its own, found {found}"
            ),
            Self::LightsBehind { lights } => write!(
                f,
                "photometric stereo: all {lights} lights are behind the object as seen from the camera; add lights on the \
                 camera's side, or leave this view out"
            ),
            Self::EmptyMask => write!(
                f,
                "photometric stereo: no pixel of the mask has a coverage of ½ or more; give the mask of the object in this view"
            ),
            Self::Dark => write!(
                f,
                "photometric stereo: the images are black where the mask shows an object; check exposure and mask"
            ),
            Self::NonFinite { what, at } => {
                write!(
                    f,
                    "{what}: expected finite values, found NaN or infinity at {at}; find the stage that produced it"
                )
            }
            Self::Setting { what, expected, found } => write!(f, "{what}: expected {expected}, found {found}"),
            Self::Camera(e) => e.fmt(f),
            Self::Light(e) => e.fmt(f),
        }
    }
}

impl std::error::Error for PhotometricError {}

impl From<CameraError> for PhotometricError {
    fn from(e: CameraError) -> Self {
        Self::Camera(e)
    }
}

impl From<LightError> for PhotometricError {
    fn from(e: LightError) -> Self {
        Self::Light(e)
    }
}
