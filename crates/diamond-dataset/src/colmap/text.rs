//! Text models: a record per line (two per image), `#` begins a comment line.
use super::{ColmapCamera, ColmapImage, ColmapPoints, EXPORT, camera, error, pose, position};
use crate::DatasetError;
use std::path::Path;
use std::str::FromStr;

/// The next word of a line as a number.
fn word<T: FromStr>(
    path: &Path,
    line: usize,
    words: &mut std::str::SplitAsciiWhitespace,
    what: &str,
) -> Result<T, DatasetError> {
    let text = words.next();
    text.and_then(|t| t.parse().ok()).ok_or_else(|| {
        let found = match text {
            None => "the end of the line".to_string(),
            Some(t) => format!("\"{}\"", t.chars().take(40).collect::<String>()),
        };
        error(path, format!("line {}", line + 1), what, found, EXPORT)
    })
}

/// Lines that are neither blank nor comments, numbered from 0.
fn records<'a>(path: &Path, bytes: &'a [u8]) -> Result<impl Iterator<Item = (usize, &'a str)>, DatasetError> {
    let text = crate::folder::as_text(path, bytes)?;
    Ok(text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty() && !l.trim_start().starts_with('#')))
}

pub(super) fn cameras(path: &Path, bytes: &[u8]) -> Result<Vec<ColmapCamera>, DatasetError> {
    let mut out = Vec::new();
    for (n, line) in records(path, bytes)? {
        let mut words = line.split_ascii_whitespace();
        let id = word(path, n, &mut words, "a camera's number")?;
        let model: String = word(path, n, &mut words, "a camera's model")?;
        let size = (word(path, n, &mut words, "a width in pixels")?, word(path, n, &mut words, "a height in pixels")?);
        let mut values = Vec::new();
        // No model has more than 16.
        while values.len() < 17 && words.clone().next().is_some() {
            values.push(word::<f64>(path, n, &mut words, "a parameter of the camera")?);
        }
        out.push(camera(path, &format!("line {}", n + 1), id, &model, size, &values)?);
    }
    Ok(out)
}

pub(super) fn images(path: &Path, bytes: &[u8]) -> Result<Vec<ColmapImage>, DatasetError> {
    let text = crate::folder::as_text(path, bytes)?;
    let mut out = Vec::new();
    let mut lines = text.lines().enumerate();
    while let Some((n, line)) = lines.next() {
        if line.trim().is_empty() || line.trim_start().starts_with('#') {
            continue;
        }
        let mut words = line.split_ascii_whitespace();
        let id = word(path, n, &mut words, "an image's number")?;
        let mut values = [0.0f64; 7];
        for v in &mut values {
            *v = word(path, n, &mut words, "qw qx qy qz tx ty tz of the image")?;
        }
        let camera = word(path, n, &mut words, "the number of the image's camera")?;
        let name = words.collect::<Vec<_>>().join(" ");
        if name.is_empty() {
            return Err(error(path, format!("line {}", n + 1), "the image's name", "the end of the line", EXPORT));
        }
        out.push(ColmapImage { id, pose: pose(path, &format!("line {} (\"{name}\")", n + 1), values)?, name, camera });
        // The features of the image, on a line of their own even where there are none.
        if let Some((m, features)) = lines.next() {
            check_features(path, m, features)?;
        }
    }
    Ok(out)
}

/// Features are triples; anything else means that a line is missing, and the next image would be taken for features.
fn check_features(path: &Path, line: usize, text: &str) -> Result<(), DatasetError> {
    if text.split_ascii_whitespace().count().is_multiple_of(3) {
        return Ok(());
    }
    let found = format!("\"{}\"", text.chars().take(60).collect::<String>());
    let advice = "each image has two lines, the second with its features; leave the second empty where there are none";
    Err(error(path, format!("line {}", line + 1), "features of the image before, as triples x y point", found, advice))
}

pub(super) fn points(path: &Path, bytes: &[u8]) -> Result<ColmapPoints, DatasetError> {
    let mut out = ColmapPoints::default();
    for (n, line) in records(path, bytes)? {
        let mut words = line.split_ascii_whitespace();
        let id: u64 = word(path, n, &mut words, "a point's number")?;
        let mut at = [0.0f64; 3];
        for v in &mut at {
            *v = word(path, n, &mut words, "a coordinate of the point")?;
        }
        out.positions.push(position(path, &format!("line {} (point {id})", n + 1), at)?);
        let mut rgb = [0u8; 3];
        for v in &mut rgb {
            *v = word(path, n, &mut words, "a colour of the point, 0 to 255")?;
        }
        out.colours.push(rgb);
    }
    Ok(out)
}
