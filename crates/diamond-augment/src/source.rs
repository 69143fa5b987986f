//! The door: what is asked for, and who answers.
use diamond_camera::Camera;
use diamond_dataset::Capture;
use diamond_image::{Image, Mask};
use diamond_light::OlatLight;

/// A picture that is asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Target {
    /// From where.
    pub camera: Camera,
    /// Under which light.
    pub light: OlatLight,
    /// Index of the training view that has this camera; `None` where nobody photographed from.
    pub view: Option<usize>,
    /// The photograph that is most like it, by view and then by light: indices of a training view and of a shot in it.
    pub photograph: (usize, usize),
}

/// What a source makes of a target.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Linear RGB over black, of the camera's size, ≥ 0.
    pub radiance: Image,
    /// Coverage, where the source knows it.
    pub mask: Option<Mask>,
    /// How much of each pixel is believed, one channel: 0 not at all … 1 like a photograph.
    pub confidence: Image,
}

/// Why a source could not make pictures.
pub type SourceError = Box<dyn std::error::Error + Send + Sync>;

/// Makes pictures that nobody took.
///
/// The same targets give the same bits, whatever was asked for before, in which batches, and on how many threads; what varies is part of
/// [`Source::state`] or of the target.
pub trait Source {
    /// What made a picture, for its [`Provenance`](diamond_dataset::Provenance): `prior: profile`.
    fn method(&self) -> String;

    /// Everything of the source that its pictures depend on, as text of any length: weights, fitted numbers, seeds. Pictures that were kept are used
    /// again where it is the same.
    fn state(&self) -> String;

    /// The pictures of `targets`, in their order. `capture` holds the photographs that `targets` name; whatever is held out is not looked at.
    ///
    /// # Errors
    /// Whatever keeps the source from it.
    fn pictures(&mut self, capture: &Capture, targets: &[Target]) -> Result<Vec<Picture>, SourceError>;
}
