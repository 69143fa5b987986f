//! The part of an image that anything happens in: the rectangle outside of which photograph, mask and render are empty.
//!
//! An object before a black background fills a fraction of the picture. Outside the rectangle every pixel of the render
//! is empty and every pixel of the photograph black, so each term of the objective has there the value that identical
//! pictures have, and no gradient. Shading and objective run on the rectangle, and means over it are scaled by
//! [`Region::fraction`] to means over the picture.
use diamond_camera::Camera;
use diamond_image::{Image, ImageError, Mask};

/// A rectangle of pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Region {
    /// First column.
    pub x: usize,
    /// First row.
    pub y: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

/// Pixels that a window of SSIM (11 × 11) reaches beyond its centre: with this much margin every window that meets
/// something lies in the region, or is cut where the picture is continued by the same zeros.
pub const SSIM_REACH: usize = 5;
/// Pixels that differences between neighbours (smoothness, pseudo-normals) reach.
pub const NEIGHBOUR_REACH: usize = 1;

impl Region {
    /// A whole picture.
    pub fn whole(width: usize, height: usize) -> Self {
        Self { x: 0, y: 0, width, height }
    }

    /// The least rectangle that holds every value other than 0 of `width`-pixel rows of `channels` values; `None` where
    /// all are 0. NaN counts as something.
    fn of_rows(values: &[f32], width: usize, channels: usize) -> Option<Self> {
        let row_length = (width * channels).max(1);
        let (mut top, mut bottom, mut left, mut right) = (usize::MAX, 0, usize::MAX, 0);
        for (y, row) in values.chunks_exact(row_length).enumerate() {
            let Some(first) = row.iter().position(|v| *v != 0.0) else { continue };
            let last = row.iter().rposition(|v| *v != 0.0).unwrap_or(first);
            (top, bottom) = (top.min(y), y + 1);
            (left, right) = (left.min(first / channels), right.max(last / channels + 1));
        }
        (bottom > 0).then(|| Self { x: left, y: top, width: right - left, height: bottom - top })
    }

    /// The least rectangle that holds every value of `image` other than 0.
    pub fn of_image(image: &Image) -> Option<Self> {
        Self::of_rows(image.data(), image.width(), image.channels())
    }

    /// The least rectangle that holds everything of a photograph and its mask.
    pub fn of_photograph(radiance: &Image, mask: Option<&Mask>) -> Option<Self> {
        let mask = mask.and_then(|m| Self::of_rows(m.data(), m.width(), 1));
        Self::union(Self::of_image(radiance), mask)
    }

    /// The least rectangle that holds both.
    pub fn union(a: Option<Self>, b: Option<Self>) -> Option<Self> {
        let (a, b) = match (a, b) {
            (Some(a), Some(b)) => (a, b),
            (one, other) => return one.or(other),
        };
        let (x, y) = (a.x.min(b.x), a.y.min(b.y));
        let right = (a.x + a.width).max(b.x + b.width);
        let bottom = (a.y + a.height).max(b.y + b.height);
        Some(Self { x, y, width: right - x, height: bottom - y })
    }

    /// `margin` pixels more on every side, inside a picture of `width` × `height`.
    pub fn grown(self, margin: usize, width: usize, height: usize) -> Self {
        let (x, y) = (self.x.saturating_sub(margin), self.y.saturating_sub(margin));
        let right = (self.x + self.width + margin).min(width);
        let bottom = (self.y + self.height + margin).min(height);
        Self { x, y, width: right - x, height: bottom - y }
    }

    /// Number of pixels.
    pub fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// Its share of the pixels of a picture of `width` × `height`.
    pub fn fraction(&self, width: usize, height: usize) -> f64 {
        self.pixels() as f64 / (width * height).max(1) as f64
    }

    /// Whether it is all of a picture.
    pub fn is_whole(&self, width: usize, height: usize) -> bool {
        *self == Self::whole(width, height)
    }

    /// The camera that sees this part. Pixel centres relative to the principal point keep their bits.
    pub fn camera(&self, camera: &Camera) -> Camera {
        let intrinsics = camera.intrinsics.cropped(self.x as u32, self.y as u32, self.width as u32, self.height as u32);
        Camera { intrinsics, pose: camera.pose }
    }

    /// This part of an image.
    pub fn crop(&self, image: &Image) -> Result<Image, ImageError> {
        image.crop(self.x, self.y, self.width, self.height)
    }

    /// This part of a mask.
    pub fn crop_mask(&self, mask: &Mask) -> Result<Mask, ImageError> {
        mask.crop(self.x, self.y, self.width, self.height)
    }

    /// A picture of `width` × `height` that is `part` here and zero elsewhere.
    pub fn paste(&self, part: &Image, width: usize, height: usize) -> Image {
        let channels = part.channels();
        let mut out = Image::new(width, height, channels);
        let row_length = self.width * channels;
        for (y, row) in part.data().chunks_exact(row_length.max(1)).enumerate() {
            let start = ((self.y + y) * width + self.x) * channels;
            out.data_mut()[start..start + row_length].copy_from_slice(row);
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_camera::{Depth, Intrinsics, Pose};
    use glam::{Vec2, Vec3};

    #[test]
    fn the_rectangle_is_the_least_and_stays_inside() {
        let mut image = Image::new(9, 7, 3);
        assert_eq!(Region::of_image(&image), None);
        image.pixel_mut(2, 3)[1] = -0.5;
        image.pixel_mut(6, 4)[2] = 1e-30;
        let region = Region::of_image(&image);
        assert_eq!(region, Some(Region { x: 2, y: 3, width: 5, height: 2 }));
        let mut mask = vec![0.0; 63];
        mask[6 * 9 + 8] = 1.0;
        let mask = Mask::from_vec(9, 7, mask).unwrap();
        let both = Region::of_photograph(&image, Some(&mask)).unwrap();
        assert_eq!(both, Region { x: 2, y: 3, width: 7, height: 4 });
        assert_eq!(both.grown(1, 9, 7), Region { x: 1, y: 2, width: 8, height: 5 });
        assert!(both.grown(5, 9, 7).is_whole(9, 7));
        let part = both.crop(&image).unwrap();
        assert_eq!(both.paste(&part, 9, 7), image);
    }

    /// The camera of a part sees every pixel along the same bits.
    #[test]
    fn a_part_is_seen_along_the_same_rays() {
        let intrinsics = Intrinsics { fx: 191.7, fy: 190.3, cx: 63.218, cy: 65.77, width: 128, height: 128 };
        let camera = Camera { intrinsics, pose: Pose::look_at(Vec3::new(3.0, 1.0, 0.5), Vec3::ZERO, Vec3::Z) };
        let region = Region { x: 37, y: 51, width: 60, height: 44 };
        let part = region.camera(&camera);
        for (x, y) in [(0, 0), (59, 43), (17, 30)] {
            let at = |x: usize, y: usize| Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
            let whole = camera.unproject(at(x + region.x, y + region.y), Depth::Z(3.3));
            assert_eq!(part.unproject(at(x, y), Depth::Z(3.3)), whole);
        }
    }
}
