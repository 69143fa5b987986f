//! Which format a file has, and one door in and one out for all of them.
use crate::error::malformed;
use crate::{ColorSpace, SplatCloud, SplatFileError, compressed_ply, gltf, plain_ply, splat_rows, spz};
use diamond_splat::{ply_layout, replace_file};
use std::path::Path;

/// Formats of splat files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SplatFormat {
    /// PLY with a property per value.
    Ply,
    /// PLY packed in chunks, as SuperSplat writes it; read only.
    CompressedPly,
    /// Rows of 32 bytes.
    Splat,
    /// Niantic's format.
    Spz,
    /// Binary glTF with `KHR_gaussian_splatting`.
    Glb,
    /// The same as JSON.
    Gltf,
}

/// A file as read.
#[derive(Debug, Clone, PartialEq)]
pub struct SplatFile {
    /// Its splats.
    pub cloud: SplatCloud,
    /// Its format.
    pub format: SplatFormat,
    /// What in it was not read or read in a special way, a sentence each.
    pub notes: Vec<String>,
}

/// Choices in writing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WriteOptions {
    /// Version of SPZ, 3 or 4.
    pub spz_version: u32,
}

impl Default for WriteOptions {
    /// SPZ version 3, which most programs read.
    fn default() -> Self {
        Self { spz_version: 3 }
    }
}

impl SplatFormat {
    /// Every format.
    pub const ALL: [SplatFormat; 6] = [Self::Ply, Self::CompressedPly, Self::Splat, Self::Spz, Self::Glb, Self::Gltf];

    /// The name that people use, which is the extension but for compressed PLY.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::CompressedPly => "compressed.ply",
            Self::Splat => "splat",
            Self::Spz => "spz",
            Self::Glb => "glb",
            Self::Gltf => "gltf",
        }
    }

    /// The format of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|f| f.name().eq_ignore_ascii_case(name.trim_start_matches('.')))
    }

    /// The format that the file's name says.
    pub fn from_path(path: impl AsRef<Path>) -> Result<Self, SplatFileError> {
        let path = path.as_ref();
        let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        // The longest extension first: compressed PLY also ends as PLY does.
        let mut all = Self::ALL;
        all.sort_by_key(|f| std::cmp::Reverse(f.name().len()));
        all.into_iter().find(|f| name.ends_with(&format!(".{}", f.name()))).ok_or_else(|| {
            let found = path.extension().map_or("no extension".into(), |e| format!(".{}", e.to_string_lossy()));
            malformed(
                "splat file",
                "name",
                ".ply, .splat, .spz, .glb or .gltf",
                found,
                "rename the file or say its format",
            )
            .in_file(path)
        })
    }

    /// The format that the bytes say; `None` for `.splat`, which has no mark, and for what is none of them.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        if bytes.starts_with(b"ply") {
            let compressed = ply_layout(bytes).is_ok_and(|layout| compressed_ply::looks_like(&layout));
            Some(if compressed { Self::CompressedPly } else { Self::Ply })
        } else if spz::looks_like(bytes) {
            Some(Self::Spz)
        } else if bytes.starts_with(b"glTF") {
            Some(Self::Glb)
        } else if gltf::looks_like(bytes) {
            Some(Self::Gltf)
        } else {
            None
        }
    }

    /// Whether the PLY header in `bytes` is one of splats rather than of a point cloud or a mesh.
    pub fn is_splat_ply(bytes: &[u8]) -> bool {
        ply_layout(bytes).is_ok_and(|l| compressed_ply::looks_like(&l) || plain_ply::looks_like(&l))
    }
}

/// Reads bytes of a format. A `.gltf` with buffers in files of their own needs [`read`].
pub fn parse(bytes: &[u8], format: SplatFormat) -> Result<SplatFile, SplatFileError> {
    parse_at(bytes, format, None)
}

fn parse_at(bytes: &[u8], format: SplatFormat, path: Option<&Path>) -> Result<SplatFile, SplatFileError> {
    let (format, (cloud, notes)) = match format {
        SplatFormat::Ply | SplatFormat::CompressedPly => {
            let layout = ply_layout(bytes)?;
            match compressed_ply::looks_like(&layout) {
                true => (SplatFormat::CompressedPly, compressed_ply::parse(bytes, &layout)?),
                false => (SplatFormat::Ply, plain_ply::parse(bytes, &layout)?),
            }
        }
        SplatFormat::Splat => (format, splat_rows::parse(bytes)?),
        SplatFormat::Spz => (format, spz::parse(bytes)?),
        SplatFormat::Glb | SplatFormat::Gltf => (format, gltf::parse(bytes, path)?),
    };
    Ok(SplatFile { cloud, format, notes })
}

/// Reads a splat file. Its first bytes say the format; where these say none, its name does.
pub fn read(path: impl AsRef<Path>) -> Result<SplatFile, SplatFileError> {
    read_from(path.as_ref(), None)
}

/// [`read`] of a file whose format is known.
pub fn read_as(path: impl AsRef<Path>, format: SplatFormat) -> Result<SplatFile, SplatFileError> {
    read_from(path.as_ref(), Some(format))
}

fn read_from(path: &Path, format: Option<SplatFormat>) -> Result<SplatFile, SplatFileError> {
    let bytes =
        std::fs::read(path).map_err(|source| SplatFileError::Io { path: path.to_owned(), action: "read", source })?;
    let format = match format.or_else(|| SplatFormat::from_bytes(&bytes)) {
        Some(format) => format,
        None => match SplatFormat::from_path(path)? {
            SplatFormat::Splat => SplatFormat::Splat,
            other => {
                let start: String = bytes.iter().take(8).map(|b| format!("{b:02x} ")).collect();
                let expected = format!("the start of a .{} file", other.name());
                let found = format!("{} bytes, {start}…", bytes.len());
                let advice = "the file is damaged or has the wrong name";
                return Err(malformed("splat file", "first bytes", expected, found, advice).in_file(path));
            }
        },
    };
    parse_at(&bytes, format, Some(path)).map_err(|e| e.in_file(path))
}

/// The bytes of a file, and what of the cloud is not in them, a sentence each.
pub fn to_bytes(
    cloud: &SplatCloud,
    format: SplatFormat,
    options: &WriteOptions,
) -> Result<(Vec<u8>, Vec<String>), SplatFileError> {
    cloud.validate()?;
    let bytes = match format {
        SplatFormat::Ply => plain_ply::to_bytes(cloud)?,
        SplatFormat::Splat => splat_rows::to_bytes(cloud),
        SplatFormat::Spz => spz::to_bytes(cloud, options.spz_version)?,
        SplatFormat::Glb => gltf::glb_bytes(cloud)?,
        SplatFormat::Gltf => gltf::gltf_bytes(cloud)?,
        SplatFormat::CompressedPly => {
            let advice = "write .spz, or convert the .ply with SuperSplat";
            return Err(malformed(
                "compressed PLY",
                "writing",
                "a format that is written",
                "one that is only read",
                advice,
            ));
        }
    };
    Ok((bytes, losses(cloud, format)))
}

/// Writes a cloud in the format that the name says, whole or not at all. Returns what of it is not in the file.
pub fn write(
    path: impl AsRef<Path>,
    cloud: &SplatCloud,
    options: &WriteOptions,
) -> Result<Vec<String>, SplatFileError> {
    let path = path.as_ref();
    write_as(path, cloud, SplatFormat::from_path(path)?, options)
}

/// [`write`] in a given format.
pub fn write_as(
    path: impl AsRef<Path>,
    cloud: &SplatCloud,
    format: SplatFormat,
    options: &WriteOptions,
) -> Result<Vec<String>, SplatFileError> {
    let path = path.as_ref();
    let (bytes, losses) = to_bytes(cloud, format, options).map_err(|e| e.in_file(path))?;
    replace_file(path, &bytes)?;
    Ok(losses)
}

/// What a format does not hold of a cloud.
fn losses(cloud: &SplatCloud, format: SplatFormat) -> Vec<String> {
    let mut out = Vec::new();
    let compact = matches!(format, SplatFormat::Splat | SplatFormat::Spz);
    if format == SplatFormat::Splat && cloud.degree > 0 {
        out.push(format!("the dependence of colour on direction (degree {}) is not in a .splat", cloud.degree));
    }
    if cloud.normals.is_some() && format != SplatFormat::Ply {
        out.push(format!("normals are not in a .{}", format.name()));
    }
    if cloud.color_space == ColorSpace::Linear && compact {
        out.push(format!("a .{} does not say that colours are linear: viewers will show them too dark", format.name()));
    }
    if cloud.antialiased && format != SplatFormat::Spz {
        out.push(format!("a .{} does not say that the splats were fitted with an antialiasing filter", format.name()));
    }
    let mut clipped = |what: &str, count: usize| {
        if count > 0 {
            out.push(format!("{count} of {} {what} are cut to what the format holds", cloud.len()));
        }
    };
    let width = cloud.coefficients() * 3;
    let rows = || cloud.sh.chunks_exact(width.max(1));
    match format {
        SplatFormat::Splat => {
            let outside = (0..cloud.len()).filter(|i| {
                let c = cloud.base_color(*i);
                c.min_element() < -0.002 || c.max_element() > 1.002
            });
            clipped("colours outside [0, 1]", outside.count());
        }
        SplatFormat::Spz => {
            clipped("colours with |f_dc| above 3.34", rows().filter(|r| r[..3].iter().any(|v| v.abs() > 3.34)).count());
            clipped("harmonics outside [−1, 1]", rows().filter(|r| r[3..].iter().any(|v| v.abs() > 1.0)).count());
            let scales = cloud.log_scales.iter().filter(|s| s.min_element() < -10.04 || s.max_element() > 5.97);
            clipped("scales outside e⁻¹⁰ to e⁵·⁹⁴", scales.count());
        }
        _ => {}
    }
    if compact {
        let steps = match format {
            SplatFormat::Splat => "rounded: 1/255 in colour and opacity, 1/128 in rotations",
            _ => "rounded: 1/255 in opacity, 1/135 in colour, 6 % in scales, 1/128 in harmonics, 0.0014 in rotations",
        };
        out.push(steps.into());
    }
    out
}
