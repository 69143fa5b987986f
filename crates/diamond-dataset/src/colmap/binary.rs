//! Binary models: little-endian records behind a count.
//!
//! Counts are checked against the bytes that are left before anything is allocated for them.
use super::{ColmapCamera, ColmapImage, ColmapPoints, EXPORT, MODELS, camera, error, pose, position};
use crate::DatasetError;
use std::path::Path;

/// Bytes and a place in them.
struct Reader<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    fn new(path: &'a Path, bytes: &'a [u8]) -> Self {
        Self { path, bytes, at: 0 }
    }

    fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    fn short(&self, what: &str, needed: impl std::fmt::Display) -> DatasetError {
        error(
            self.path,
            format!("byte {}", self.at),
            format!("{what} ({needed} bytes)"),
            format!("{} bytes to the end of the file", self.left()),
            "the file is cut short or no COLMAP model: copy or export it again",
        )
    }

    fn take<const N: usize>(&mut self, what: &str) -> Result<[u8; N], DatasetError> {
        let piece = self.bytes[self.at..].first_chunk::<N>().ok_or_else(|| self.short(what, N))?;
        self.at += N;
        Ok(*piece)
    }

    fn u8(&mut self, what: &str) -> Result<u8, DatasetError> {
        self.take::<1>(what).map(|b| b[0])
    }

    fn u32(&mut self, what: &str) -> Result<u32, DatasetError> {
        self.take(what).map(u32::from_le_bytes)
    }

    fn u64(&mut self, what: &str) -> Result<u64, DatasetError> {
        self.take(what).map(u64::from_le_bytes)
    }

    fn f64(&mut self, what: &str) -> Result<f64, DatasetError> {
        self.take(what).map(f64::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self, what: &str) -> Result<[f64; N], DatasetError> {
        let mut out = [0.0; N];
        for v in &mut out {
            *v = self.f64(what)?;
        }
        Ok(out)
    }

    /// A count of records of at least `least` bytes each, which must fit into what is left.
    fn count(&mut self, what: &str, least: u64) -> Result<usize, DatasetError> {
        let start = self.at;
        let n = self.u64(what)?;
        if n.saturating_mul(least) > self.left() as u64 {
            let left = self.left();
            self.at = start;
            return Err(error(
                self.path,
                format!("byte {start}"),
                format!("the number of {what} that follow, at least {least} bytes each"),
                format!("{n}, with {left} bytes to the end of the file"),
                "the file is cut short or no COLMAP model: copy or export it again",
            ));
        }
        Ok(n as usize)
    }

    fn skip(&mut self, count: u64, size: u64, what: &str) -> Result<(), DatasetError> {
        let bytes = count.saturating_mul(size);
        if bytes > self.left() as u64 {
            return Err(self.short(what, format!("{count} × {size}")));
        }
        self.at += bytes as usize;
        Ok(())
    }

    /// A name that ends with a zero byte.
    fn name(&mut self, what: &str) -> Result<String, DatasetError> {
        /// No file system has longer paths.
        const MAX_NAME: usize = 4096;
        let rest = &self.bytes[self.at..];
        let Some(length) = rest.iter().take(MAX_NAME).position(|&b| b == 0) else {
            return Err(error(
                self.path,
                format!("byte {}", self.at),
                format!("{what}, ended by a zero byte within {MAX_NAME} bytes"),
                "no zero byte",
                EXPORT,
            ));
        };
        let name = std::str::from_utf8(&rest[..length]).map_err(|e| {
            error(self.path, format!("byte {}", self.at), format!("{what} in UTF-8"), e.to_string(), "rename the image")
        })?;
        self.at += length + 1;
        Ok(name.to_string())
    }

    fn finished(&self) -> Result<(), DatasetError> {
        if self.left() == 0 {
            return Ok(());
        }
        Err(error(
            self.path,
            format!("byte {}", self.at),
            "the end of the file",
            format!("{} more bytes", self.left()),
            EXPORT,
        ))
    }
}

pub(super) fn cameras(path: &Path, bytes: &[u8]) -> Result<Vec<ColmapCamera>, DatasetError> {
    let mut r = Reader::new(path, bytes);
    let count = r.count("cameras", 4 + 4 + 16 + 24)?;
    let mut out = Vec::with_capacity(count);
    for _ in 0..count {
        let id = r.u32("a camera's number")?;
        let at = format!("camera {id}");
        let model = r.u32("a camera's model")?;
        let size = (r.u64("a camera's width")?, r.u64("a camera's height")?);
        let (name, parameters) = MODELS.get(model as usize).copied().ok_or_else(|| {
            let advice = crate::lens::UNDISTORT;
            error(path, at.as_str(), "the number of a camera model this reader knows", model.to_string(), advice)
        })?;
        let mut values = Vec::with_capacity(parameters);
        for _ in 0..parameters {
            values.push(r.f64("a camera's parameters")?);
        }
        out.push(camera(path, &at, id, name, size, &values)?);
    }
    r.finished()?;
    Ok(out)
}

pub(super) fn images(path: &Path, bytes: &[u8]) -> Result<Vec<ColmapImage>, DatasetError> {
    let mut r = Reader::new(path, bytes);
    let count = r.count("images", 4 + 56 + 4 + 1 + 8)?;
    let mut out = Vec::with_capacity(count);
    for _ in 0..count {
        let id = r.u32("an image's number")?;
        let values = r.f64s::<7>("an image's pose")?;
        let camera = r.u32("an image's camera")?;
        let name = r.name("an image's name")?;
        let features = r.u64("an image's number of features")?;
        r.skip(features, 24, "an image's features")?;
        out.push(ColmapImage { id, pose: pose(path, &format!("image {id} (\"{name}\")"), values)?, name, camera });
    }
    r.finished()?;
    Ok(out)
}

pub(super) fn points(path: &Path, bytes: &[u8]) -> Result<ColmapPoints, DatasetError> {
    let mut r = Reader::new(path, bytes);
    let count = r.count("points", 8 + 24 + 3 + 8 + 8)?;
    let mut out = ColmapPoints { positions: Vec::with_capacity(count), colours: Vec::with_capacity(count) };
    for _ in 0..count {
        let id = r.u64("a point's number")?;
        let at = r.f64s::<3>("a point's position")?;
        out.positions.push(position(path, &format!("point {id}"), at)?);
        out.colours.push([r.u8("a point's colour")?, r.u8("a point's colour")?, r.u8("a point's colour")?]);
        r.f64("a point's error")?;
        let track = r.u64("a point's track length")?;
        r.skip(track, 8, "a point's track")?;
    }
    r.finished()?;
    Ok(out)
}
