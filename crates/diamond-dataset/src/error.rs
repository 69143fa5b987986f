//! What can be wrong with a capture: each error names the file, the frame and the field, and says what to do.
use std::path::{Path, PathBuf};

/// Where in a capture something was found: a file, and the frame and field in it where that makes sense.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Place {
    /// The file.
    pub file: PathBuf,
    /// Index of the frame in `frames[]`, from 0.
    pub frame: Option<usize>,
    /// The field, for instance `light_positions[3]`.
    pub field: Option<String>,
}

impl Place {
    /// A whole file.
    pub fn file(path: &Path) -> Self {
        Self { file: path.to_path_buf(), frame: None, field: None }
    }
}

impl std::fmt::Display for Place {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.file.display())?;
        if let Some(frame) = self.frame {
            write!(f, ", frame {frame}")?;
        }
        if let Some(field) = &self.field {
            write!(f, ", {field}")?;
        }
        Ok(())
    }
}

/// Why a capture cannot be opened, read, selected from or written.
#[derive(Debug)]
pub enum DatasetError {
    /// The operating system refused to read or write a file.
    Io {
        /// Where the file is named, or the file itself.
        place: Box<Place>,
        /// What was being done, for instance "open the image".
        action: &'static str,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file that must be JSON is not.
    Json {
        /// The file.
        path: PathBuf,
        /// Line of the mistake, from 1.
        line: usize,
        /// Column of the mistake, from 1.
        column: usize,
        /// The parser's reason.
        reason: String,
    },
    /// A field is missing, has the wrong type, length or value.
    Field {
        /// File, frame and field.
        place: Box<Place>,
        /// What the field must be.
        expected: String,
        /// What is there.
        found: String,
        /// What to do about it.
        advice: &'static str,
    },
    /// A path leads out of the capture's folder: `..`, an absolute path, or a link.
    Outside {
        /// File, frame and field that name the path.
        place: Box<Place>,
        /// The path as written.
        path: String,
    },
    /// An image or geometry file cannot be decoded or has the wrong size.
    Image {
        /// The image file.
        path: PathBuf,
        /// The frame and field that name it.
        named_by: Box<Place>,
        /// What is wrong.
        reason: String,
        /// What to do about it.
        advice: &'static str,
    },
    /// An image's header promises more pixels than the limit.
    TooLarge {
        /// The image file.
        path: PathBuf,
        /// The frame and field that name it.
        named_by: Box<Place>,
        /// Width in the header, pixels.
        width: u32,
        /// Height in the header, pixels.
        height: u32,
        /// The limit, pixels.
        max_pixels: u64,
    },
    /// A selection of views or lights makes no sense for this capture.
    Selection {
        /// `views` or `lights`.
        what: &'static str,
        /// What is wrong.
        reason: String,
    },
    /// What was asked to be written is inconsistent, or the place is taken.
    Write {
        /// The folder or file.
        path: PathBuf,
        /// What is wrong and what to do.
        reason: String,
    },
}

impl std::fmt::Display for DatasetError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            DatasetError::Io { place, action, source } => {
                write!(f, "{place}: cannot {action}: {source}")?;
                if source.kind() == std::io::ErrorKind::NotFound {
                    write!(f, "; restore the file, or list its name in exclude_list.txt to leave it out")?;
                }
                Ok(())
            }
            DatasetError::Json { path, line, column, reason } => write!(
                f,
                "{}, line {line}, column {column}: no valid JSON: {reason}; NaN and Infinity are not JSON numbers, \
                 and a file cut short ends early: write it again",
                path.display()
            ),
            DatasetError::Field { place, expected, found, advice } => {
                write!(f, "{place}: expected {expected}, found {found}; {advice}")
            }
            DatasetError::Outside { place, path } => write!(
                f,
                "{place}: \"{path}\" leads out of the capture's folder; copy the file into the folder and name it \
                 relative to the folder"
            ),
            DatasetError::Image { path, named_by, reason, advice } => {
                write!(f, "{} ({named_by}): {reason}; {advice}", path.display())
            }
            DatasetError::TooLarge { path, named_by, width, height, max_pixels } => write!(
                f,
                "{} ({named_by}): the header says {width}×{height} = {} pixels, the limit is {max_pixels}; reduce the \
                 image, or raise OpenOptions::max_pixels",
                path.display(),
                u64::from(*width) * u64::from(*height)
            ),
            DatasetError::Selection { what, reason } => write!(f, "{what}: {reason}"),
            DatasetError::Write { path, reason } => write!(f, "{}: {reason}", path.display()),
        }
    }
}

impl std::error::Error for DatasetError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            DatasetError::Io { source, .. } => Some(source),
            _ => None,
        }
    }
}

impl DatasetError {
    /// An error of the operating system about a file.
    pub(crate) fn io(path: &Path, action: &'static str, source: std::io::Error) -> Self {
        DatasetError::Io { place: Box::new(Place::file(path)), action, source }
    }
}
