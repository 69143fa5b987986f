//! The eight orientations of a picture: light does not know which side of a photograph is up, or left.
use super::hints::RelightView;
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::Image;
use glam::{Mat3, Vec3};

/// Quarter turns of a picture, after mirroring it or not.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Orientation {
    /// Whether left and right are exchanged first; the world is mirrored with the picture.
    pub mirrored: bool,
    /// Quarter turns, 0 to 3.
    pub turns: usize,
}

/// The mirror x → −x, in the world and in the camera.
const MIRROR: Vec3 = Vec3::new(-1.0, 1.0, 1.0);

impl Orientation {
    /// One of eight.
    pub fn new(which: usize) -> Self {
        Self { mirrored: which & 4 != 0, turns: which & 3 }
    }

    /// A picture so turned.
    pub fn image(self, image: &Image) -> Image {
        let mut out = match self.mirrored {
            true => moved(image, image.width(), image.height(), |x, y| (image.width() - 1 - x, y)),
            false => image.clone(),
        };
        for _ in 0..self.turns {
            // What was at (x, y) comes to (height − 1 − y, x).
            out = moved(&out, out.height(), out.width(), |x, y| (y, out.height() - 1 - x));
        }
        out
    }

    /// A place in the world that is mirrored with the picture.
    pub fn place(self, place: Vec3) -> Vec3 {
        if self.mirrored { MIRROR * place } else { place }
    }

    /// Normals in the world, as a picture.
    pub fn normals(self, normals: &Image) -> Image {
        let mut out = self.image(normals);
        if self.mirrored {
            out.data_mut().chunks_exact_mut(3).for_each(|n| n[0] = -n[0]);
        }
        out
    }

    /// The camera that sees the world so.
    pub fn camera(self, camera: &Camera) -> Camera {
        let mut out = *camera;
        if self.mirrored {
            let mirror = Mat3::from_diagonal(MIRROR);
            out.intrinsics.cx = camera.intrinsics.width as f32 - camera.intrinsics.cx;
            out.pose = Pose {
                rotation: mirror * camera.pose.rotation * mirror,
                translation: MIRROR * camera.pose.translation,
            };
        }
        for _ in 0..self.turns {
            let k = out.intrinsics;
            out.intrinsics = Intrinsics {
                fx: k.fy,
                fy: k.fx,
                cx: k.height as f32 - k.cy,
                cy: k.cx,
                width: k.height,
                height: k.width,
            };
            // (x, y, z) → (−y, x, z).
            let turn = Mat3::from_cols(Vec3::Y, Vec3::NEG_X, Vec3::Z);
            out.pose = Pose { rotation: turn * out.pose.rotation, translation: turn * out.pose.translation };
        }
        out
    }

    /// A view so turned.
    pub fn view(self, view: &RelightView) -> RelightView {
        RelightView {
            camera: self.camera(&view.camera),
            source: self.image(&view.source),
            coverage: self.image(&view.coverage),
            depth: self.image(&view.depth),
            normals: self.normals(&view.normals),
            source_light: view.source_light.map(|light| self.place(light)),
        }
    }
}

/// A picture of width × height whose pixel (x, y) is the other's at `from(x, y)`.
fn moved(image: &Image, width: usize, height: usize, from: impl Fn(usize, usize) -> (usize, usize)) -> Image {
    let mut out = Image::new(width, height, image.channels());
    for (x, y) in (0..width * height).map(|i| (i % width, i / width)) {
        let (from_x, from_y) = from(x, y);
        out.pixel_mut(x, y).copy_from_slice(image.pixel(from_x, from_y));
    }
    out
}
