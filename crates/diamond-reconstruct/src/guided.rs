//! Sources of pictures that are made when pictures are due, of what is known by then: the surface, and the medium.
use diamond_augment::{Source, SourceError};
use diamond_light::Falloff;
use diamond_medium::{Medium, Surface};

/// What a run knows when pictures that nobody took are due.
#[derive(Debug, Clone, Copy)]
pub struct Guidance<'a> {
    /// The object's surface.
    pub surface: &'a Surface,
    /// The medium that was fitted in it.
    pub medium: &'a Medium,
    /// Falloff of lights.
    pub falloff: Falloff,
    /// Error, in display values, at which a pixel is believed by half.
    pub half_error: f32,
    /// What names surface, medium and photographs: part of the state of a source that uses them.
    pub state: &'a str,
}

/// Makes a [`Source`] of what a run knows.
pub trait GuidedSource {
    /// The source.
    ///
    /// # Errors
    /// Whatever keeps it from being made.
    fn source(&self, guidance: Guidance<'_>) -> Result<Box<dyn Source>, SourceError>;
}
