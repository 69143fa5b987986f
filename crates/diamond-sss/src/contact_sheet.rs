//! Many pictures of a capture on one sheet: a row for each view, a column for each light.
//!
//! Small pictures are means of linear radiance over squares, encoded afterwards, so that they have the brightness of the large ones.
use crate::SssError;
use crate::picture::encode_png_linear;
use diamond_dataset::{Capture, View};
use diamond_image::Image;
use rayon::prelude::*;

/// What fits on a sheet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SheetOptions {
    /// Rows at most: views of a capture, members of a family.
    pub rows: usize,
    /// Columns at most: lights.
    pub columns: usize,
    /// Longer side of a picture, pixels.
    pub side: usize,
}

impl Default for SheetOptions {
    fn default() -> Self {
        Self { rows: 12, columns: 14, side: 64 }
    }
}

/// At most `most` numbers below `n`, evenly.
fn spread(n: usize, most: usize) -> impl Iterator<Item = usize> {
    let count = most.min(n);
    (0..count).map(move |k| k * n / count)
}

/// A picture of at most `side` pixels along its longer side.
fn small(capture: &Capture, view: &View, shot: usize, side: usize) -> Result<Image, SssError> {
    let radiance = capture.observation(&view.shots[shot])?.radiance.clone();
    let (width, height, _) = radiance.shape();
    let scale = (side as f64 / width.max(height) as f64).min(1.0);
    let size = |n: usize| ((n as f64 * scale).round() as usize).max(1);
    radiance.resize_area(size(width), size(height)).map_err(|e| SssError::Internal(e.to_string()))
}

/// Pictures side by side, on black.
fn sheet(rows: &[Vec<Image>], side: usize) -> Result<Vec<u8>, SssError> {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    if columns == 0 {
        return Err(SssError::Usage("a contact sheet needs at least one picture".into()));
    }
    let mut all = Image::new(columns * side, rows.len() * side, 3);
    for (r, row) in rows.iter().enumerate() {
        for (c, picture) in row.iter().enumerate() {
            let (width, height, _) = picture.shape();
            let (left, top) = (c * side + (side - width) / 2, r * side + (side - height) / 2);
            for y in 0..height {
                let to = ((top + y) * columns * side + left) * 3;
                all.data_mut()[to..to + 3 * width].copy_from_slice(&picture.data()[3 * width * y..3 * width * (y + 1)]);
            }
        }
    }
    encode_png_linear(&all)
}

/// PNG of training images of a capture: views from top to bottom, lights from left to right, both spread evenly where there are more than
/// fit.
///
/// # Errors
/// Images that cannot be read.
pub fn contact_sheet(capture: &Capture, options: &SheetOptions) -> Result<Vec<u8>, SssError> {
    let views: Vec<usize> = spread(capture.train.len(), options.rows).collect();
    let rows: Vec<Vec<Image>> = views
        .par_iter()
        .map(|&v| {
            let view = &capture.train[v];
            spread(view.shots.len(), options.columns).map(|l| small(capture, view, l, options.side)).collect()
        })
        .collect::<Result<_, SssError>>()?;
    sheet(&rows, options.side)
}

/// PNG of several captures, a row for each: another view and another light in each column (on domes, light `k` stands near camera `k`, so they do
/// not go together).
///
/// # Errors
/// Images that cannot be read.
pub fn family_sheet(captures: &[Capture], options: &SheetOptions) -> Result<Vec<u8>, SssError> {
    let chosen: Vec<usize> = spread(captures.len(), options.rows).collect();
    let rows: Vec<Vec<Image>> = chosen
        .par_iter()
        .map(|&i| {
            let views = &captures[i].train;
            let columns = spread(views.len(), options.columns).enumerate();
            columns
                .map(|(k, v)| small(&captures[i], &views[v], (3 * k + 1) % views[v].shots.len(), options.side))
                .collect()
        })
        .collect::<Result<_, SssError>>()?;
    sheet(&rows, options.side)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_lie_in_rows_and_keep_their_brightness() {
        assert_eq!(spread(10, 4).collect::<Vec<_>>(), [0, 2, 5, 7]);
        assert_eq!(spread(3, 9).collect::<Vec<_>>(), [0, 1, 2]);
        let rows =
            vec![vec![Image::filled(4, 4, 3, 1.0), Image::filled(4, 2, 3, 0.25)], vec![Image::filled(2, 4, 3, 0.0)]];
        let png = sheet(&rows, 4).unwrap();
        let picture = image::load_from_memory(&png).unwrap().to_rgb8();
        assert_eq!(picture.dimensions(), (8, 8));
        assert_eq!(picture.get_pixel(0, 0).0, [255; 3]);
        // In the middle of its square.
        assert_eq!(
            (picture.get_pixel(5, 0).0, picture.get_pixel(5, 1).0, picture.get_pixel(5, 4).0),
            ([0; 3], [137; 3], [0; 3])
        );
        assert!(sheet(&[], 4).is_err());
    }
}
