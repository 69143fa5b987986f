//! What can go wrong in this crate: one enum that says what was expected, what was found, and what to do.

/// Errors of `diamond-shading`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ShadingError {
    /// Two things that belong together differ in length or shape.
    Shape {
        /// What was being checked.
        what: &'static str,
        /// The shape that was expected.
        expected: String,
        /// The shape that was found.
        found: String,
    },
    /// A setting lies outside its range.
    Setting {
        /// The setting, as `Type::field`.
        what: &'static str,
        /// What it may be.
        expected: String,
        /// What it was.
        found: String,
    },
}

impl std::fmt::Display for ShadingError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            ShadingError::Shape { what, expected, found } => {
                write!(
                    f,
                    "{what}: expected {expected}, found {found}; pass arrays or images that describe the same rows or pixels"
                )
            }
            ShadingError::Setting { what, expected, found } => {
                write!(f, "{what}: expected {expected}, found {found}; change the setting")
            }
        }
    }
}

impl std::error::Error for ShadingError {}

/// `Ok` if `found == expected` elements, else [`ShadingError::Shape`].
pub(crate) fn check_length(what: &'static str, expected: usize, found: usize) -> Result<(), ShadingError> {
    if expected == found {
        Ok(())
    } else {
        Err(ShadingError::Shape { what, expected: format!("{expected} values"), found: format!("{found} values") })
    }
}

/// `Ok` if `image` has the shape `(width, height, channels)`, else [`ShadingError::Shape`].
pub(crate) fn check_image(
    what: &'static str,
    image: &diamond_image::Image,
    expected: (usize, usize, usize),
) -> Result<(), ShadingError> {
    if image.shape() == expected {
        return Ok(());
    }
    let show = |(w, h, c): (usize, usize, usize)| format!("{w}×{h} pixels of {c} channels");
    Err(ShadingError::Shape { what, expected: show(expected), found: show(image.shape()) })
}
