//! Pictures of a medium in its surface, by rays: no Gaussians, no network.
use crate::{Attachment, Exitance, Medium, MediumError, Surface};
use diamond_camera::Camera;
use diamond_image::{Image, Mask};
use diamond_light::{Falloff, OlatLight};
use diamond_pathtrace::{Facing, NO_PRIMITIVE};
use diamond_shading::{BrdfModel, Material};
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Rays per pixel and axis.
const RAYS: usize = 2;

/// What one camera sees of a surface: where the rays of each pixel meet it.
#[derive(Debug, Clone)]
pub struct Sight {
    width: usize,
    height: usize,
    /// In order of pixels.
    pixels: Vec<u32>,
    positions: Vec<Vec3>,
    /// Of the triangles.
    normals: Vec<Vec3>,
    /// Interpolated between vertices.
    shading: Vec<Vec3>,
    toward_eye: Vec<Vec3>,
    attachment: Attachment,
}

impl Sight {
    /// What `camera` sees, by 2 × 2 rays per pixel.
    pub fn new(surface: &Surface, camera: &Camera) -> Self {
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        let geometry = surface.geometry();
        let hits = (0..width * height).into_par_iter().flat_map_iter(|pixel| {
            let (x, y) = ((pixel % width) as f32, (pixel / width) as f32);
            (0..RAYS * RAYS).filter_map(move |k| {
                let at = |k: usize| (k as f32 + 0.5) / RAYS as f32;
                let ray = camera.ray(Vec2::new(x + at(k % RAYS), y + at(k / RAYS)));
                let reach = f32::INFINITY;
                let hit = geometry.closest_hit(ray.origin, ray.direction, reach, Facing::Entering, NO_PRIMITIVE)?;
                Some((pixel as u32, hit.position, hit.normal, geometry.shading_normal(&hit), -ray.direction))
            })
        });
        let hits: Vec<(u32, Vec3, Vec3, Vec3, Vec3)> = hits.collect();
        let positions: Vec<Vec3> = hits.iter().map(|h| h.1).collect();
        let normals: Vec<Vec3> = hits.iter().map(|h| h.2).collect();
        Self {
            width,
            height,
            pixels: hits.iter().map(|h| h.0).collect(),
            shading: hits.iter().map(|h| h.3).collect(),
            toward_eye: hits.iter().map(|h| h.4).collect(),
            attachment: surface.attach(&positions, &normals),
            positions,
            normals,
        }
    }

    /// The share of each pixel's rays that meet the surface, one channel.
    pub fn coverage(&self) -> Image {
        let mut share = Image::new(self.width, self.height, 1);
        self.pixels.iter().for_each(|p| share.data_mut()[*p as usize] += 1.0 / (RAYS * RAYS) as f32);
        share
    }

    /// View-space z where rays meet the surface, the mean over those of a pixel, 0 where none does. `camera` is the one that it was made for.
    pub fn depth(&self, camera: &Camera) -> Image {
        self.mean_over_rays(1, |i| [camera.pose.transform_point(self.positions[i]).z])
    }

    /// Unit normals in world axes as shading uses them, 0 where no ray meets the surface.
    pub fn normals(&self) -> Image {
        let mut normals = self.mean_over_rays(3, |i| self.shading[i].to_array());
        for n in normals.data_mut().chunks_exact_mut(3) {
            n.copy_from_slice(&Vec3::from_slice(n).normalize_or_zero().to_array());
        }
        normals
    }

    fn mean_over_rays<const N: usize>(&self, channels: usize, value: impl Fn(usize) -> [f32; N]) -> Image {
        let mut mean = Image::new(self.width, self.height, channels);
        let mut count = vec![0.0f32; self.width * self.height];
        for (i, pixel) in self.pixels.iter().enumerate() {
            let at = *pixel as usize;
            mean.data_mut()[at * channels..][..channels].iter_mut().zip(value(i)).for_each(|(sum, v)| *sum += v);
            count[at] += 1.0;
        }
        mean.data_mut().chunks_exact_mut(channels).zip(&count).for_each(|(sum, n)| {
            sum.iter_mut().for_each(|v| *v /= n.max(1.0));
        });
        mean
    }

    /// A picture whose outline is the photographs': radiance where the surface is met, times the photographs' coverage. Without a mask as it is.
    pub fn over_mask(&self, mut radiance: Image, mask: Option<&Mask>) -> Image {
        let Some(mask) = mask else { return radiance };
        let coverage = self.coverage();
        for (i, pixel) in radiance.data_mut().chunks_exact_mut(3).enumerate() {
            let met = coverage.data()[i];
            let factor = if met > 0.0 { mask.data()[i] / met } else { 0.0 };
            pixel.iter_mut().for_each(|v| *v *= factor);
        }
        radiance
    }

    /// One channel: at each pixel the mean over its rays that meet the surface of the values of surfels, 0 where none does.
    pub fn mean_of(&self, surfels: &[f32]) -> Image {
        let mut mean = Image::new(self.width, self.height, 1);
        let mut count = vec![0.0f32; self.width * self.height];
        for (i, pixel) in self.pixels.iter().enumerate() {
            mean.data_mut()[*pixel as usize] += self.attachment.of(i).map(|(j, w)| w * surfels[j]).sum::<f32>();
            count[*pixel as usize] += 1.0;
        }
        mean.data_mut().iter_mut().zip(&count).for_each(|(s, n)| *s /= n.max(1.0));
        mean
    }

    /// The reverse of [`Sight::mean_of`]: adds each pixel's value to the surfels that it shows, and the weights with which it did.
    pub fn spread_on(&self, values: impl Fn(usize) -> Option<f32>, sum: &mut [f64], weight: &mut [f64]) {
        let mut rays = vec![0u32; self.width * self.height];
        self.pixels.iter().for_each(|p| rays[*p as usize] += 1);
        for (i, pixel) in self.pixels.iter().enumerate() {
            let Some(value) = values(*pixel as usize) else { continue };
            let share = 1.0 / f64::from(rays[*pixel as usize]);
            for (j, w) in self.attachment.of(i) {
                sum[j] += share * f64::from(w) * f64::from(value);
                weight[j] += share * f64::from(w);
            }
        }
    }
}

/// A medium in a surface, ready for pictures under any light.
#[derive(Debug)]
pub struct MediumPictures {
    surface: Surface,
    medium: Medium,
    exitance: Exitance,
    falloff: Falloff,
    /// What leaves the surfels, for lights that were asked for.
    kept: BTreeMap<[u32; 4], Arc<Vec<f32>>>,
}

/// Lights whose light under the surface is kept.
const KEPT_LIGHTS: usize = 256;

impl MediumPictures {
    /// Prepares transport.
    pub fn new(surface: Surface, medium: Medium, falloff: Falloff) -> Result<Self, MediumError> {
        let exitance = Exitance::new(&surface, &medium)?;
        Ok(Self { surface, medium, exitance, falloff, kept: BTreeMap::new() })
    }

    /// The surface.
    pub fn surface(&self) -> &Surface {
        &self.surface
    }

    /// The medium.
    pub fn medium(&self) -> &Medium {
        &self.medium
    }

    /// Computes together what leaves the surface under lights that are not known yet.
    pub fn prepare(&mut self, lights: &[OlatLight]) -> Result<(), MediumError> {
        let mut missing: Vec<OlatLight> = Vec::new();
        for light in lights {
            let key = crate::fit::key(light);
            if !self.kept.contains_key(&key) && !missing.iter().any(|m| crate::fit::key(m) == key) {
                missing.push(*light);
            }
        }
        if missing.is_empty() {
            return Ok(());
        }
        if self.kept.len() + missing.len() > KEPT_LIGHTS {
            self.kept.clear();
            missing.clear();
            for light in lights {
                if !missing.iter().any(|m| crate::fit::key(m) == crate::fit::key(light)) {
                    missing.push(*light);
                }
            }
        }
        let leaving = self.exitance.under(&self.surface, &missing, self.falloff)?;
        self.kept.extend(missing.iter().map(crate::fit::key).zip(leaving.into_iter().map(Arc::new)));
        Ok(())
    }

    /// The picture under one light: linear RGB over black, what leaves the medium, and the coat. What is predicted is what the fit compares with photographs
    /// ([`crate::fit_profile`]), but with the one coat that the medium ended with.
    pub fn radiance(&mut self, sight: &Sight, light: &OlatLight) -> Result<Image, MediumError> {
        self.prepare(&[*light])?;
        let leaving = self.kept.get(&crate::fit::key(light)).cloned().unwrap_or_default();
        let lamp = light.of_unit_intensity();
        let visibility = self.surface.visibility(&sight.positions, &sight.normals, &[lamp]);
        let (brdf, coat, local) = (BrdfModel::default(), &self.medium.coat, self.medium.local());
        let material = Material { base_color: Vec3::ZERO, roughness: coat.roughness, metalness: 0.0 };
        let strength = light.intensity() * self.medium.unit;
        let values: Vec<Vec3> = (0..sight.pixels.len())
            .into_par_iter()
            .map(|i| {
                let (normal, eye) = (sight.shading[i], sight.toward_eye[i]);
                let arriving = lamp.incidence(sight.positions[i], self.falloff);
                let lit = arriving.irradiance * visibility[i];
                let around = sight.attachment.rgb(i, &leaving) * self.exitance.toward(normal.dot(eye).max(0.0));
                let own = local * lit.x * normal.dot(arriving.direction).max(0.0);
                let gloss = coat.scale * brdf.reflect(&material, normal, eye, arriving.direction, lit).x;
                (strength * (around + own + Vec3::splat(gloss))).max(Vec3::ZERO)
            })
            .collect();
        let mut image = Image::new(sight.width, sight.height, 3);
        for (pixel, value) in sight.pixels.iter().zip(values) {
            let at = 3 * *pixel as usize;
            let share = value / (RAYS * RAYS) as f32;
            image.data_mut()[at..at + 3].iter_mut().zip(share.to_array()).for_each(|(to, v)| *to += v);
        }
        Ok(image)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Coat, Transport};
    use diamond_camera::{Intrinsics, Pose};
    use diamond_pathtrace::Mesh;

    fn pictures(local: f32) -> MediumPictures {
        let surface = Surface::new(Mesh::icosphere(Vec3::ZERO, 1.0, 4), 900).unwrap();
        let transport =
            Transport::Profile { widths: vec![0.15, 0.4], weights: vec![[0.5, 0.3, 0.1]; 2], local: [local; 3] };
        let coat = Coat { roughness: 0.3, scale: 1.0 };
        let medium = Medium { unit: 1.0, transport, coat, quality: None, described: None };
        MediumPictures::new(surface, medium, Falloff::InverseSquare { reference: 1.0 }).unwrap()
    }

    fn camera(side: u32) -> Camera {
        let pose = Pose::look_at(Vec3::new(0.5, 0.3, 3.5), Vec3::ZERO, Vec3::Y);
        Camera { intrinsics: Intrinsics::from_fov_x(0.8, side, side), pose }
    }

    fn lamp(factor: f32) -> OlatLight {
        OlatLight::Point { position: Vec3::new(1.0, 2.0, 3.0), intensity: Vec3::splat(9.0 * factor) }
    }

    #[test]
    fn pictures_are_linear_and_lie_inside_the_outline() {
        let mut pictures = pictures(0.1);
        let sight = Sight::new(pictures.surface(), &camera(32));
        let (one, two) =
            (pictures.radiance(&sight, &lamp(1.0)).unwrap(), pictures.radiance(&sight, &lamp(2.0)).unwrap());
        let coverage = sight.coverage();
        // A ball of radius 1 at 3.57 fills a third of this picture.
        let area = coverage.data().iter().sum::<f32>() / (32.0 * 32.0);
        assert!((0.3..0.5).contains(&area), "{area}");
        assert!(one.data().iter().any(|v| *v > 0.05));
        for (i, (a, b)) in one.data().iter().zip(two.data()).enumerate() {
            assert!((2.0 * a - b).abs() <= 1e-6 * b.abs() && (*a == 0.0 || coverage.data()[i / 3] > 0.0));
        }
        // Light from behind is dimmer on this side, and not nothing: it goes through.
        let behind = OlatLight::Point { position: -Vec3::new(1.0, 2.0, 3.0), intensity: Vec3::splat(9.0) };
        let through = pictures.radiance(&sight, &behind).unwrap();
        assert!(through.mean() < 0.5 * one.mean() && through.mean() > 0.0);
    }

    #[test]
    fn what_is_spread_on_surfels_is_seen_again() {
        let pictures = pictures(0.0);
        let sight = Sight::new(pictures.surface(), &camera(48));
        let n = pictures.surface().positions().len();
        let (mut sum, mut weight) = (vec![0.0; n], vec![0.0; n]);
        let value = |pixel: usize| 0.2 + 0.6 * (pixel % 48) as f32 / 48.0;
        sight.spread_on(|p| Some(value(p)), &mut sum, &mut weight);
        let surfels: Vec<f32> =
            sum.iter().zip(&weight).map(|(s, w)| if *w > 0.0 { (s / w) as f32 } else { 0.0 }).collect();
        assert!(weight.iter().filter(|w| **w == 0.0).count() > n / 3, "the far side is not seen");
        let (seen, coverage) = (sight.mean_of(&surfels), sight.coverage());
        for p in (0..48 * 48).filter(|p| coverage.data()[*p] == 1.0) {
            assert!((seen.data()[p] - value(p)).abs() < 0.06, "{} {}", seen.data()[p], value(p));
        }
    }

    /// A ball of radius 1 in front of a camera: the nearest place is at distance − 1 and faces the camera; outlines become those of a mask.
    #[test]
    fn shape_is_that_of_the_surface() {
        let (pictures, camera) = (pictures(0.0), camera(33));
        let sight = Sight::new(pictures.surface(), &camera);
        let (depth, normals) = (sight.depth(&camera), sight.normals());
        let eye = camera.pose.centre();
        assert!((depth.pixel(16, 16)[0] - (eye.length() - 1.0)).abs() < 0.02, "{}", depth.pixel(16, 16)[0]);
        assert!(Vec3::from_slice(normals.pixel(16, 16)).dot(eye.normalize()) > 0.99);
        assert_eq!((depth.pixel(0, 0), normals.pixel(0, 0)), (&[0.0f32][..], &[0.0f32; 3][..]));
        let half = Mask::from_channel(&Image::filled(33, 33, 1, 0.5), 0).unwrap();
        let one = sight.over_mask(Image::filled(33, 33, 3, 1.0), Some(&half));
        assert_eq!((one.pixel(16, 16)[0], one.pixel(0, 0)[0]), (0.5, 0.0));
    }
}
