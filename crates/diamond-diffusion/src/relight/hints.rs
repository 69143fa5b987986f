//! What a ControlNet is shown: the source picture, its shape, and what lights do to that shape.
use super::base::Base;
use super::ratio::encode_ratio;
use crate::error::{DiffusionError, Result};
use diamond_camera::{Camera, Depth};
use diamond_image::{Image, Transfer};
use glam::{Vec2, Vec3};

/// Number of hint planes: source colours 3, coverage, depth, normals 3, n·l of the target and of the source, highlights of the target and of the source,
/// direction to the target light 3, colours of the target as predicted 3, ratio of the source to its prediction 3, whether a physical model predicted.
pub const HINTS: usize = 22;

/// Exponent of the highlight's cosine: about the lobe of a roughness of 0.5.
const HIGHLIGHT: i32 = 32;

/// A view of an object under a light, with its shape. All pictures have the camera's size.
#[derive(Debug, Clone)]
pub struct RelightView {
    /// Who saw it.
    pub camera: Camera,
    /// Linear radiance times coverage, 3 channels, divided by the light's intensity.
    pub source: Image,
    /// How much of a pixel the object covers, 0 to 1.
    pub coverage: Image,
    /// View-space z, 0 where nothing is.
    pub depth: Image,
    /// Unit normals in world axes, 0 where nothing is.
    pub normals: Image,
    /// Position of the light of `source`, if it is known.
    pub source_light: Option<Vec3>,
}

/// From the camera's axes to a viewer's: y up, z toward the viewer.
fn to_viewer(v: Vec3) -> Vec3 {
    Vec3::new(v.x, -v.y, -v.z)
}

impl RelightView {
    /// Checks sizes and numbers.
    pub fn validate(&self) -> Result<()> {
        let (width, height) = (self.camera.intrinsics.width as usize, self.camera.intrinsics.height as usize);
        let maps = [
            ("source picture", &self.source, 3),
            ("coverage", &self.coverage, 1),
            ("depth", &self.depth, 1),
            ("normals", &self.normals, 3),
        ];
        for (what, image, channels) in maps {
            if image.shape() != (width, height, channels) {
                return Err(DiffusionError::shape(what, (width, height, channels), image.shape()));
            }
            if let Some((x, y, _)) = image.first_non_finite() {
                return Err(DiffusionError::NonFinite { what: format!("{what}, pixel ({x}, {y})") });
            }
        }
        if !self.coverage.data().iter().any(|c| *c > 0.0) {
            return Err(DiffusionError::setting("coverage", "an object somewhere in the picture", "none"));
        }
        Ok(())
    }

    /// A surface point, where there is one.
    pub(super) fn point(&self, x: usize, y: usize) -> Option<Vec3> {
        let z = self.depth.pixel(x, y)[0];
        (z > 0.0).then(|| self.camera.unproject(Vec2::new(x as f32 + 0.5, y as f32 + 0.5), Depth::Z(z)))
    }

    /// The mean of the visible points, and half of the object's width as it appears.
    pub fn centre_and_radius(&self) -> Option<(Vec3, f32)> {
        let (width, height, _) = self.depth.shape();
        let points = (0..width * height).filter_map(|i| self.point(i % width, i / width));
        let (sum, count) = points.fold((Vec3::ZERO, 0usize), |(sum, count), p| (sum + p, count + 1));
        if count == 0 {
            return None;
        }
        let centre = sum / count as f32;
        let z = self.camera.pose.transform_point(centre).z;
        let radius = 0.5 * (count as f32).sqrt() * z / self.camera.intrinsics.fx;
        (radius > 0.0).then_some((centre, radius))
    }

    /// The view at another size: means over areas; depth and normals of what is there.
    pub fn resized(&self, width: usize, height: usize) -> Result<Self> {
        let wrong = |e: diamond_image::ImageError| DiffusionError::shape("resized picture", "at least 1 × 1", e);
        let resize = |image: &Image| image.resize_area(width, height).map_err(wrong);
        let there = resize(&self.depth.map(|z| f32::from(u8::from(z > 0.0))))?;
        let mut depth = resize(&self.depth)?;
        for (z, share) in depth.data_mut().iter_mut().zip(there.data()) {
            *z = if *share > 0.0 { *z / share } else { 0.0 };
        }
        let mut normals = resize(&self.normals)?;
        for n in normals.data_mut().chunks_exact_mut(3) {
            let unit = Vec3::from_slice(n).normalize_or_zero();
            n.copy_from_slice(&unit.to_array());
        }
        Ok(Self {
            camera: self.camera.resized(width as u32, height as u32),
            source: resize(&self.source)?,
            coverage: resize(&self.coverage)?,
            depth,
            normals,
            source_light: self.source_light,
        })
    }
}

/// The [`HINTS`] planes of a view under a target light at a position in the world, one after the other, about in [−1, 1]. What `base` predicts has the
/// view's size, see [`Base::of`].
pub fn hint_planes(view: &RelightView, target_light: Vec3, base: &Base) -> Result<Vec<f32>> {
    view.validate()?;
    if !target_light.is_finite() {
        return Err(DiffusionError::setting("target light", "a finite position", target_light));
    }
    let predicted = &base.prediction;
    for image in [&predicted.source, &predicted.target] {
        if image.shape() != view.source.shape() {
            return Err(DiffusionError::shape("prediction", view.source.shape(), image.shape()));
        }
    }
    let (width, height, _) = view.source.shape();
    let pixels = width * height;
    let mut planes = vec![0.0; HINTS * pixels];
    let shape = view.centre_and_radius();
    let eye = view.camera.pose.centre();
    let display = |radiance: f32| 2.0 * Transfer::Srgb.encode(radiance.clamp(0.0, 1.0)) - 1.0;
    for p in 0..pixels {
        let (x, y) = (p % width, p / width);
        let mut hints = [0.0; HINTS];
        for c in 0..3 {
            let [source, base_source, base_target] =
                [&view.source, &predicted.source, &predicted.target].map(|image| image.data()[3 * p + c]);
            hints[c] = display(source);
            hints[15 + c] = display(base_target);
            hints[18 + c] = encode_ratio(base_source, source);
        }
        hints[3] = view.coverage.pixel(x, y)[0];
        hints[21] = f32::from(u8::from(base.physical));
        if let (Some((centre, radius)), Some(point)) = (shape, view.point(x, y)) {
            let normal = Vec3::from_slice(view.normals.pixel(x, y));
            let depth_of = |p: Vec3| view.camera.pose.transform_point(p).z;
            hints[4] = ((depth_of(point) - depth_of(centre)) / radius).clamp(-1.0, 1.0);
            let in_view = |v: Vec3| to_viewer(view.camera.pose.rotation * v);
            hints[5..8].copy_from_slice(&in_view(normal).to_array());
            let to_eye = (eye - point).normalize_or_zero();
            // Cosine and highlight of a light.
            let lit = |light: Vec3| {
                let to_light = (light - point).normalize_or_zero();
                let half = (to_light + to_eye).normalize_or_zero();
                (to_light, normal.dot(to_light), normal.dot(half).max(0.0).powi(HIGHLIGHT))
            };
            let to_light;
            (to_light, hints[8], hints[10]) = lit(target_light);
            if let Some(light) = view.source_light {
                (_, hints[9], hints[11]) = lit(light);
            }
            hints[12..15].copy_from_slice(&in_view(to_light).to_array());
        }
        for (c, hint) in hints.into_iter().enumerate() {
            planes[c * pixels + p] = hint;
        }
    }
    Ok(planes)
}
