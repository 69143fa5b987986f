//! What a fit keeps of a photograph: a few of its pixels, and where on the surface they lie.
use crate::fit::COATS;
use crate::{Attachment, MediumError, Surface};
use diamond_camera::Camera;
use diamond_image::{Image, Mask};
use diamond_light::{Falloff, OlatLight};
use diamond_pathtrace::{Facing, NO_PRIMITIVE};
use diamond_shading::{BrdfModel, Material};
use glam::{Vec2, Vec3};
use rayon::prelude::*;

/// Share of a picture without a mask that is taken to show the object.
const COVERED: f32 = 0.3;

/// One photograph.
#[derive(Debug, Clone, Copy)]
pub struct FitImage<'a> {
    /// From where.
    pub camera: &'a Camera,
    /// Under which light.
    pub light: &'a OlatLight,
    /// Linear RGB over black, the camera's size.
    pub radiance: &'a Image,
    /// Coverage: pixels below one half are not looked at.
    pub mask: Option<&'a Mask>,
    /// Factor on what leaves the medium, linear RGB, where something is known of it.
    pub tint: Option<&'a Image>,
    /// What else is there, linear RGB: then no coat is fitted.
    pub known: Option<&'a Image>,
}

/// A pixel of a photograph that shows the surface.
pub(crate) struct Seen {
    pub pixel: usize,
    pub position: Vec3,
    pub normal: Vec3,
    pub shading: Vec3,
    pub toward_eye: Vec3,
}

impl FitImage<'_> {
    /// Every `stride`th pixel that shows the surface.
    pub(crate) fn places(&self, surface: &Surface, stride: usize) -> Vec<Seen> {
        let (w, h) = (self.camera.intrinsics.width as usize, self.camera.intrinsics.height as usize);
        let each = (0..w * h).into_par_iter().filter_map(|pixel| {
            // Diagonal lines of pixels, so that a stride skips in both directions.
            let (x, y) = (pixel % w, pixel / w);
            if (x + 3 * y) % stride != 0 || self.mask.is_some_and(|m| m.coverage(x, y) < 0.5) {
                return None;
            }
            let ray = self.camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
            let geometry = surface.geometry();
            let hit = geometry.closest_hit(ray.origin, ray.direction, f32::INFINITY, Facing::Entering, NO_PRIMITIVE)?;
            let shading = geometry.shading_normal(&hit);
            Some(Seen { pixel, position: hit.position, normal: hit.normal, shading, toward_eye: -ray.direction })
        });
        each.collect()
    }
}

/// A pixel with what a fit needs of it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FitPixel {
    /// Row by row.
    pub index: usize,
    /// Between the shading normal and the direction to the eye, ≥ 0.
    pub cos_theta_o: f32,
    /// Radiance of an ideally diffuse surface of albedo 1, and of the coats, under a light of intensity 1.
    pub local: f32,
    pub coats: [f32; COATS.len()],
    /// Linear RGB of the photograph, of the tint, and of what else is known.
    pub radiance: [f32; 3],
    pub tint: [f32; 3],
    pub known: [f32; 3],
}

/// The pixels of one photograph that a medium is fitted to. Pictures need not stay in memory: a megapixel with its mask takes 16 MB, the pixels of
/// all photographs together some 5.
#[derive(Debug, Clone)]
pub struct FitPhotograph {
    pub(crate) camera: Camera,
    pub(crate) light: OlatLight,
    pub(crate) pixels: Vec<FitPixel>,
    pub(crate) attachment: Attachment,
    pub(crate) has_known: bool,
}

impl FitPhotograph {
    /// Looks at about `count` pixels of a photograph, spread evenly over the object, under lights with this falloff. Errors where pictures differ in size from the camera's.
    pub fn new(surface: &Surface, image: &FitImage<'_>, count: usize, falloff: Falloff) -> Result<Self, MediumError> {
        let size = (image.camera.intrinsics.width as usize, image.camera.intrinsics.height as usize);
        for picture in [Some(image.radiance), image.tint, image.known].into_iter().flatten() {
            if picture.shape() != (size.0, size.1, 3) {
                return Err(MediumError::Value {
                    what: "a picture to fit to",
                    expected: "three channels and the camera's size",
                    found: format!("{:?} for a camera of {size:?}", picture.shape()),
                });
            }
        }
        let covered = image.mask.map_or(COVERED * (size.0 * size.1) as f32, Mask::area);
        let stride = ((covered / count.max(1) as f32).ceil() as usize).max(1);
        let places = image.places(surface, stride);
        let positions: Vec<Vec3> = places.iter().map(|s| s.position).collect();
        let normals: Vec<Vec3> = places.iter().map(|s| s.normal).collect();
        let lamp = [image.light.of_unit_intensity()];
        let visibility = surface.visibility(&positions, &normals, &lamp);
        let brdf = BrdfModel::default();
        let pixel = |(place, visible): (&Seen, &f32)| {
            let arriving = lamp[0].incidence(place.position, falloff);
            let lit = arriving.irradiance * *visible;
            let coat = |roughness: f32| {
                let coat = Material { base_color: Vec3::ZERO, roughness, metalness: 0.0 };
                brdf.reflect(&coat, place.shading, place.toward_eye, arriving.direction, lit).x
            };
            let of = |picture: Option<&Image>, otherwise: f32| match picture {
                Some(picture) => std::array::from_fn(|c| picture.data()[3 * place.pixel + c]),
                None => [otherwise; 3],
            };
            FitPixel {
                index: place.pixel,
                cos_theta_o: place.shading.dot(place.toward_eye).max(0.0),
                local: lit.x * place.shading.dot(arriving.direction).max(0.0) / std::f32::consts::PI,
                coats: COATS.map(coat),
                radiance: of(Some(image.radiance), 0.0),
                tint: of(image.tint, 1.0),
                known: of(image.known, 0.0),
            }
        };
        Ok(Self {
            camera: *image.camera,
            light: *image.light,
            pixels: places.iter().zip(&visibility).map(pixel).collect(),
            attachment: surface.attach(&positions, &normals),
            has_known: image.known.is_some(),
        })
    }
}
