//! From the file of a shot to the image that is kept: its mask put in, its lens distortion taken out.
//!
//! Undistortion keeps size, focal lengths and principal point: nothing is scaled in the middle of the picture, and the
//! field of view is that of a pinhole with these numbers. Barrel distortion had room for more than that; what it showed
//! beyond is cut off. Pincushion distortion had room for less; the rim is empty and not covered by the mask.
use crate::background::subtract;
use crate::decode::{DecodeOptions, decode, read_image_bytes};
use crate::stored::{Samples, StoredImage};
use crate::{Capture, DatasetError, MaskSource, Observation, Place, Shot};
use diamond_camera::{Distortion, Intrinsics};
use diamond_image::{Image, Mask};
use std::path::Path;

/// A lens to take out of an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Undistortion {
    /// Intrinsics of the image as stored, and of the undistorted one.
    pub intrinsics: Intrinsics,
    /// Distortion of the image as stored.
    pub distortion: Distortion,
}

impl Undistortion {
    /// Pixel coordinates in the stored image of a pixel of the undistorted one; `None` where the lens has no such point.
    /// `[eq:undistort-map]` K·distort(K⁻¹·p), within the radius up to which the distortion grows.
    pub fn source(&self) -> impl Fn(f32, f32) -> Option<[f32; 2]> + use<> {
        let Undistortion { intrinsics: k, distortion } = *self;
        let [fx, fy, cx, cy] = [k.fx, k.fy, k.cx, k.cy].map(f64::from);
        let limit = distortion.monotonic_radius();
        move |u, v| {
            let p = [(f64::from(u) - cx) / fx, (f64::from(v) - cy) / fy];
            if (p[0] * p[0] + p[1] * p[1]).sqrt() > limit {
                return None;
            }
            let [x, y] = distortion.distort(p);
            Some([(x * fx + cx) as f32, (y * fy + cy) as f32])
        }
    }

    /// Undistorts linear values (premultiplied where there is alpha). The mask says which pixels have a source.
    pub fn apply(&self, image: &Image) -> Result<(Image, Mask), diamond_image::ImageError> {
        image.remap(self.intrinsics.width as usize, self.intrinsics.height as usize, self.source())
    }
}

impl Capture {
    /// The options for decoding this capture's images.
    pub(crate) fn decode_options(&self) -> DecodeOptions {
        DecodeOptions { max_pixels: self.options.max_pixels, exr_transfer: self.options.exr_transfer }
    }

    /// Reads and decodes an image file, which must not have changed since the capture was hashed.
    fn read_unchanged(&self, path: &Path, named_by: &Place) -> Result<StoredImage, DatasetError> {
        let options = self.decode_options();
        let bytes = read_image_bytes(path, named_by, options.max_pixels)?;
        self.check_unchanged(path, &bytes).map_err(|reason| DatasetError::Image {
            path: path.to_path_buf(),
            named_by: named_by.clone().into(),
            reason,
            advice: "put it back as it was, or start anew with the capture as it is",
        })?;
        decode(&bytes, &options).map_err(|e| e.at(path, named_by, options.max_pixels))
    }

    /// The image of a shot as in its file, of the size that its frame says.
    pub(crate) fn read_shot(&self, shot: &Shot) -> Result<StoredImage, DatasetError> {
        let image = self.read_unchanged(&shot.path, &shot.named_by)?;
        if (image.width, image.height) != (shot.width, shot.height) {
            return Err(DatasetError::Image {
                path: shot.path.clone(),
                named_by: shot.named_by.clone().into(),
                reason: format!(
                    "the image is {}×{} pixels, its frame says {}×{}",
                    image.width, image.height, shot.width, shot.height
                ),
                advice: "correct width and height in the frame, or scale the image; all images of a frame have one size",
            });
        }
        Ok(image)
    }

    /// The image of a shot as it is kept.
    pub(crate) fn develop(&self, shot: &Shot) -> Result<StoredImage, DatasetError> {
        let mut image = self.read_shot(shot)?;
        match &shot.mask {
            MaskSource::Alpha => {}
            MaskSource::File(path) => {
                let mask = self.read_beside(path, shot, "mask")?;
                let coverage: Vec<f32> = (0..mask.pixels())
                    .map(|i| {
                        let [grey, _, _, alpha] = mask.rgba(i);
                        (grey * alpha).clamp(0.0, 1.0)
                    })
                    .collect();
                image = image.with_coverage(&coverage);
            }
            MaskSource::Background(path) => {
                if image.alpha_channel().is_none() {
                    let background = self.read_beside(path, shot, "background")?;
                    let (mask, _) = subtract(&image, &background);
                    image = image.with_coverage(mask.data()).cut_out();
                }
            }
        }
        match &shot.undistortion {
            None => Ok(image),
            Some(lens) => {
                let premultiplied = self.is_premultiplied(&image);
                let wrong = |e: diamond_image::ImageError| self.unusable(shot, e.to_string());
                let observed =
                    crate::observation::observe(&image, self.options.transfer, premultiplied).map_err(wrong)?;
                undistorted(lens, &observed).map_err(wrong)
            }
        }
    }

    /// A mask or background: of the size of the image that it belongs to.
    fn read_beside(&self, path: &Path, shot: &Shot, what: &str) -> Result<StoredImage, DatasetError> {
        let image = self.read_unchanged(path, &Place::file(path))?;
        if (image.width, image.height) != (shot.width, shot.height) {
            return Err(DatasetError::Image {
                path: path.to_path_buf(),
                named_by: Place::file(&shot.path).into(),
                reason: format!(
                    "the {what} is {}×{} pixels, the image {}×{}",
                    image.width, image.height, shot.width, shot.height
                ),
                advice: "scale it to the size of the image, or remove it",
            });
        }
        Ok(image)
    }

    pub(crate) fn unusable(&self, shot: &Shot, reason: String) -> DatasetError {
        DatasetError::Image {
            path: shot.path.clone(),
            named_by: shot.named_by.clone().into(),
            reason,
            advice: "export the image again",
        }
    }
}

/// Radiance and coverage resampled once, together. An image without a mask stays without: that its rim is empty says
/// nothing about the object.
fn undistorted(lens: &Undistortion, observed: &Observation) -> Result<StoredImage, diamond_image::ImageError> {
    let (radiance, _) = lens.apply(&observed.radiance)?;
    let mask = observed.mask.as_ref().map(|m| lens.apply(m.as_image())).transpose()?;
    let (width, height) = (lens.intrinsics.width, lens.intrinsics.height);
    let (channels, samples) = match mask {
        None => (3, radiance.into_vec()),
        Some((mask, _)) => {
            let pixels = radiance.data().chunks_exact(3).zip(mask.data());
            (4, pixels.flat_map(|(rgb, &a)| [rgb[0], rgb[1], rgb[2], a]).collect())
        }
    };
    Ok(StoredImage { width, height, channels, samples: Samples::Linear(samples), premultiplied: Some(true) })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The values of a `.npy` file of `f32`.
    fn npy(name: &str) -> Vec<f32> {
        let path = format!("{}/../../assets/fixtures/distortion/{name}.npy", env!("CARGO_MANIFEST_DIR"));
        let bytes = std::fs::read(path).unwrap();
        let start = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
        bytes[start..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
    }

    /// `[eq:undistort-map]`: maps and pictures of OpenCV, for five lenses.
    #[test]
    fn maps_and_pictures_are_those_of_opencv() {
        let intrinsics = Intrinsics { fx: 40.0, fy: 41.5, cx: 24.75, cy: 17.25, width: 48, height: 36 };
        let brown = |k1, k2, p1, p2, k3| Distortion::Brown { k1, k2, k3, p1, p2 };
        let picture = Image::from_vec(48, 36, 3, npy("picture")).unwrap();
        let (mut worst_map, mut worst_picture, mut empty) = (0.0f32, 0.0f32, 0);
        for (name, distortion) in [
            ("barrel", brown(-0.28, 0.07, 0.0, 0.0, 0.0)),
            ("pincushion", brown(0.15, 0.02, 0.0, 0.0, 0.0)),
            ("tangential", brown(-0.12, 0.03, 0.004, -0.006, -0.002)),
            ("fisheye", Distortion::Fisheye { k1: 0.05, k2: -0.012, k3: 0.004, k4: -0.001 }),
            ("fisheye_plain", Distortion::Fisheye { k1: 0.0, k2: 0.0, k3: 0.0, k4: 0.0 }),
        ] {
            let lens = Undistortion { intrinsics, distortion };
            let (map, expected) = (npy(&format!("{name}_map")), npy(&format!("{name}_picture")));
            let (undistorted, covered) = lens.apply(&picture).unwrap();
            let source = lens.source();
            for y in 0..36 {
                for x in 0..48 {
                    let i = y * 48 + x;
                    let p = source(x as f32 + 0.5, y as f32 + 0.5).unwrap();
                    worst_map = worst_map.max((p[0] - map[2 * i]).abs()).max((p[1] - map[2 * i + 1]).abs());
                    if covered.coverage(x, y) == 0.0 {
                        empty += 1;
                        continue;
                    }
                    for c in 0..3 {
                        worst_picture = worst_picture.max((undistorted.pixel(x, y)[c] - expected[3 * i + c]).abs());
                    }
                }
            }
        }
        assert!(worst_map < 1e-5 && worst_picture < 1e-5, "map {worst_map:.1e} px, picture {worst_picture:.1e}");
        assert!(empty > 100, "pincushion leaves a rim: {empty}");
        eprintln!("maps differ by at most {worst_map:.1e} px, pictures by {worst_picture:.1e}");
    }
}
