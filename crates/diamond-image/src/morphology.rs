//! Shapes of binary masks: growing, shrinking, the largest connected part, holes.
//!
//! A pixel is in the shape where its coverage is at least ½; results are 0 or 1. Outside the picture is not in the shape
//! when growing, and is when shrinking, so that a shape that is cut by the border stays there.
//!
//! ```
//! use diamond_image::Mask;
//! let mask = Mask::from_vec(5, 1, vec![1.0, 0.0, 1.0, 1.0, 0.0])?;
//! assert_eq!(mask.largest_part().data(), [0.0, 0.0, 1.0, 1.0, 0.0]);
//! assert_eq!(mask.grown(1).shrunk(1).data(), [1.0; 5]);
//! # Ok::<(), diamond_image::ImageError>(())
//! ```
use crate::Mask;

/// Coverage from which a pixel is in the shape.
const INSIDE: f32 = 0.5;

impl Mask {
    fn shape(&self) -> Vec<bool> {
        self.data().iter().map(|&v| v >= INSIDE).collect()
    }

    fn of_shape(&self, shape: &[bool]) -> Self {
        let coverage = shape.iter().map(|&inside| f32::from(inside)).collect();
        // The length is that of this mask.
        Mask::from_vec(self.width(), self.height(), coverage).unwrap_or_default()
    }

    /// The shape with every pixel that has a pixel of it within `radius` columns and rows (a square of 2·radius + 1).
    pub fn grown(&self, radius: usize) -> Self {
        self.of_shape(&self.square(&self.shape(), radius, true))
    }

    /// The shape without every pixel that has a pixel outside it within `radius` columns and rows.
    pub fn shrunk(&self, radius: usize) -> Self {
        self.of_shape(&self.square(&self.shape(), radius, false))
    }

    /// Rows, then columns: whether any (or, with `any` false, every) pixel in the square is set.
    fn square(&self, shape: &[bool], radius: usize, any: bool) -> Vec<bool> {
        let (w, h) = (self.width(), self.height());
        let line = |from: &[bool], count: usize, length: usize, at: &dyn Fn(usize, usize) -> usize| {
            let mut to = vec![!any; from.len()];
            for l in 0..count {
                // The distance since the last pixel that decides, from either end.
                for backward in [false, true] {
                    let mut since = usize::MAX;
                    for k in 0..length {
                        let i = at(l, if backward { length - 1 - k } else { k });
                        since = if from[i] == any { 0 } else { since.saturating_add(1) };
                        if since <= radius {
                            to[i] = any;
                        }
                    }
                }
            }
            to
        };
        let rows = line(shape, h, w, &|row, k| row * w + k);
        line(&rows, w, h, &|column, k| k * w + column)
    }

    /// The largest part whose pixels touch by sides or corners; of equal ones the first in reading order. Empty where the
    /// shape is.
    pub fn largest_part(&self) -> Self {
        let shape = self.shape();
        let (labels, sizes) = self.parts(&shape, true, true);
        let mut best = (0, 0usize);
        for (label, &size) in sizes.iter().enumerate() {
            if size > best.1 {
                best = (label, size);
            }
        }
        let kept: Vec<bool> = labels.iter().map(|&l| best.1 > 0 && l == best.0).collect();
        self.of_shape(&kept)
    }

    /// The shape with its holes filled: every pixel from which no path of sides outside the shape leads to the border.
    pub fn filled(&self) -> Self {
        let shape = self.shape();
        let (w, h) = (self.width(), self.height());
        let (labels, sizes) = self.parts(&shape, false, false);
        let mut open = vec![false; sizes.len()];
        for (i, &label) in labels.iter().enumerate() {
            let (x, y) = (i % w.max(1), i / w.max(1));
            if label < open.len() && (x == 0 || y == 0 || x + 1 == w || y + 1 == h) {
                open[label] = true;
            }
        }
        let kept: Vec<bool> = labels.iter().map(|&l| open.get(l).is_none_or(|open| !open)).collect();
        self.of_shape(&kept)
    }

    /// Labels of the connected parts of the pixels that equal `inside` (`usize::MAX` elsewhere) and their sizes.
    fn parts(&self, shape: &[bool], inside: bool, corners: bool) -> (Vec<usize>, Vec<usize>) {
        let (w, h) = (self.width(), self.height());
        let mut labels = vec![usize::MAX; shape.len()];
        let mut sizes = Vec::new();
        let mut stack = Vec::new();
        for start in 0..shape.len() {
            if shape[start] != inside || labels[start] != usize::MAX {
                continue;
            }
            let label = sizes.len();
            let mut size = 0;
            labels[start] = label;
            stack.push(start);
            while let Some(i) = stack.pop() {
                size += 1;
                let (x, y) = (i % w, i / w);
                for ny in y.saturating_sub(1)..(y + 2).min(h) {
                    for nx in x.saturating_sub(1)..(x + 2).min(w) {
                        let j = ny * w + nx;
                        if (corners || nx == x || ny == y) && shape[j] == inside && labels[j] == usize::MAX {
                            labels[j] = label;
                            stack.push(j);
                        }
                    }
                }
            }
            sizes.push(size);
        }
        (labels, sizes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mask(rows: &[&str]) -> Mask {
        let data = rows.iter().flat_map(|r| r.bytes().map(|b| f32::from(b == b'#'))).collect();
        Mask::from_vec(rows[0].len(), rows.len(), data).unwrap()
    }

    #[test]
    fn growing_and_shrinking_are_naive_maxima_and_minima() {
        let m = mask(&["#....#.", ".......", "..###..", "..###..", "..###.#"]);
        for radius in 0..4 {
            let naive = |any: bool| -> Vec<f32> {
                (0..35)
                    .map(|i: usize| {
                        let (x, y) = (i % 7, i / 7);
                        let near =
                            (0..35usize).filter(|j| (j % 7).abs_diff(x) <= radius && (j / 7).abs_diff(y) <= radius);
                        let mut values = near.map(|j| m.data()[j] >= 0.5);
                        f32::from(if any { values.any(|v| v) } else { values.all(|v| v) })
                    })
                    .collect()
            };
            assert_eq!(m.grown(radius).data(), naive(true), "grown by {radius}");
            assert_eq!(m.shrunk(radius).data(), naive(false), "shrunk by {radius}");
        }
    }

    #[test]
    fn the_largest_part_and_its_holes() {
        let m = mask(&["####...", "#..#.##", "#.##..#", "####...", "....#.."]);
        assert_eq!(m.largest_part(), mask(&["####...", "#..#...", "#.##...", "####...", "....#.."]));
        assert_eq!(m.filled(), mask(&["####...", "####.##", "####..#", "####...", "....#.."]));
        let empty = mask(&["...", "..."]);
        assert_eq!((empty.largest_part(), empty.filled()), (empty.clone(), empty.clone()));
        assert_eq!(mask(&["##", "##"]).filled().area(), 4.0);
        assert_eq!(Mask::default().largest_part().grown(3).filled().area(), 0.0);
    }
}
