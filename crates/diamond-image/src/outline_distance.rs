//! How far a place is from the outline of a mask, with a sign.
use crate::{Image, Mask};

/// Coverage at the outline.
const OUTLINE: f32 = 0.5;

impl Mask {
    /// Distance of each pixel's centre from the outline (coverage ½), pixels, negative inside. Where there is no outline: the sum of width and
    /// height, with the sign of what there is.
    ///
    /// The outline is taken at the places between neighbouring pixel centres where the coverage passes ½, so that it is finer than the
    /// pixels; next to it the distance is that along the row or column, up to √2 too long where the outline is slanted, and zero in the right place.
    pub fn outline_distance(&self) -> Image {
        let (width, height) = (self.width(), self.height());
        // Where the outline crosses a row, or the gap between two rows: by row.
        let mut crossings: Vec<Vec<[f32; 2]>> = vec![Vec::new(); height];
        for y in 0..height {
            for x in 0..width {
                let here = self.coverage(x, y) - OUTLINE;
                for (dx, dy) in [(1, 0), (0, 1)] {
                    if x + dx < width && y + dy < height {
                        let there = self.coverage(x + dx, y + dy) - OUTLINE;
                        if (here >= 0.0) != (there >= 0.0) {
                            let t = here / (here - there);
                            crossings[y].push([x as f32 + t * dx as f32, y as f32 + t * dy as f32]);
                        }
                    }
                }
            }
        }
        let mut out = Image::filled(width, height, 1, (width + height) as f32);
        for y in 0..height {
            for x in 0..width {
                let mut best = (width + height) as f32;
                // Crossings of row r lie within [r, r + 1).
                for reach in 0..height {
                    if reach as f32 > best + 1.0 {
                        break;
                    }
                    let rows = [y.checked_sub(reach), (reach > 0).then_some(y + reach)];
                    for row in rows.into_iter().flatten().filter(|row| *row < height) {
                        for [cx, cy] in &crossings[row] {
                            let (dx, dy) = (cx - x as f32, cy - y as f32);
                            best = best.min((dx * dx + dy * dy).sqrt());
                        }
                    }
                }
                out.pixel_mut(x, y)[0] = if self.coverage(x, y) >= OUTLINE { -best } else { best };
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disc_has_the_distances_of_a_circle() {
        let (size, radius, centre) = (40usize, 11.3f32, 19.2f32);
        let from_centre = |i: usize| ((i % size) as f32 - centre).hypot((i / size) as f32 - centre);
        let disc: Vec<f32> = (0..size * size).map(|i| (0.5 + radius - from_centre(i)).clamp(0.0, 1.0)).collect();
        let distance = Mask::from_vec(size, size, disc).unwrap().outline_distance();
        for (i, d) in distance.data().iter().enumerate() {
            let exact = from_centre(i) - radius;
            assert!((d - exact).abs() < 0.45, "{i}: {d} {exact}");
            assert!(exact.abs() < 3.0 || (d - exact).abs() < 0.1, "{i}: {d} {exact}");
            assert!(exact.abs() < 0.02 || (*d < 0.0) == (exact < 0.0), "{i}: {d} {exact}");
        }
        assert_eq!(Mask::full(3, 2).outline_distance().data(), &[-5.0; 6]);
    }
}
