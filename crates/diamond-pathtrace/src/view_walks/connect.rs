//! Walks that were recorded, under lamps.
use super::entering_kernel::{EnteringKernel, MIN_INNER_COSINE};
use super::record::{enclosing, kept};
use super::{RadianceMoments, ViewWalks};
use crate::bulk::directions::carried;
use crate::bulk::lamps::Lamps;
use crate::bulk::light_map::{LightMaps, Ways};
use crate::bulk::points::SurfacePoint;
use crate::bulk::refracting::Cone;
use crate::geometry::Facing;
use crate::medium::henyey_greenstein;
use crate::{Frame, Light, PathtraceError};
use glam::Vec3;
use rayon::prelude::*;

/// Towards outlines, as lamps see them, light maps are not precise enough: a lamp from behind would be short of 3 %.
const MIN_COSINE: f32 = 0.35;

impl ViewWalks<'_> {
    /// What every start gets from every lamp through walks of each bin of scatterings, for lamps of colour 1: what a fit of the albedo
    /// reads.
    ///
    /// Errors: lamps that are neither points nor directions, or stand inside the object.
    /// `[eq:view-walks]`
    pub fn moments(&self, lights: &[Light]) -> Result<RadianceMoments, PathtraceError> {
        lights.iter().try_for_each(Light::validate)?;
        let lamps = Lamps::new(lights)?;
        lamps.check_outside(self.geometry)?;
        let width = lights.len() * self.bins.ends.len();
        let mut values = vec![0.0f32; self.starts() * width];
        if !values.is_empty() {
            match &self.entrances {
                None => self.connect_scatterings(&lamps, &mut values, width),
                Some(_) => self.connect_entrances(&lamps, &mut values, width),
            }
        }
        Ok(RadianceMoments { exponents: self.bins.exponents.clone(), values })
    }

    fn connect_scatterings(&self, lamps: &Lamps, values: &mut [f32], width: usize) {
        let mut maps = LightMaps::new(self.geometry, lamps, self.options.visibility);
        maps.min_cosine = MIN_COSINE;
        let maps = &maps;
        let (low, size) = enclosing(self.geometry);
        let bins = self.bins.ends.len();
        let scale = 1.0 / self.options.walks as f32;
        values.par_chunks_exact_mut(width).enumerate().with_min_len(4).for_each(|(k, h)| {
            let mut ways = Ways::default();
            for connection in &self.connections[self.starts[k]..self.starts[k + 1]] {
                let (position, direction) = (connection.position(low, size), connection.direction());
                let probability = kept(self.geometry, self.sigma_t, position, self.options.connections);
                if probability <= 0.0 {
                    continue;
                }
                let weight = scale / probability;
                maps.look_up(lamps, position, &mut ways);
                let bin = self.bins.of[usize::from(connection.scatterings)] as usize;
                let to = h[bin..].iter_mut().step_by(bins);
                for ((h, shine), length) in to.zip(&ways.shines).zip(&ways.lengths) {
                    let phase = henyey_greenstein(self.g, direction, shine.direction);
                    *h += weight * shine.factor * (-self.sigma_t * length).exp() * phase;
                }
            }
        });
    }

    fn connect_entrances(&self, lamps: &Lamps, values: &mut [f32], width: usize) {
        let Some((cone, points)) = &self.entrances else { return };
        let (lights, kernel) = (lamps.len(), EnteringKernel::new());
        let kernel = &kernel;
        let rays: Vec<InnerRay> = points
            .points()
            .par_iter()
            .flat_map_iter(|point| (0..lights).map(move |l| self.inner_ray(lamps, l, point, cone, kernel)))
            .collect();
        let bins = self.bins.ends.len();
        // Radiance is smaller outside by the squared index.
        let scale = 1.0 / (self.options.walks as f32 * cone.eta2);
        values.par_chunks_exact_mut(width).enumerate().with_min_len(4).for_each(|(k, h)| {
            for connection in &self.connections[self.starts[k]..self.starts[k + 1]] {
                let direction = connection.direction();
                if direction.z < MIN_INNER_COSINE {
                    continue;
                }
                let weight = scale / direction.z;
                let bin = self.bins.of[usize::from(connection.scatterings)] as usize;
                let row = &rays[connection.entrance() * lights..][..lights];
                for (ray, h) in row.iter().zip(h[bin..].iter_mut().step_by(bins)) {
                    if ray.power > 0.0 {
                        *h += weight * ray.power * kernel.at(&ray.kernel, ray.direction.dot(direction), direction.z);
                    }
                }
            }
        });
    }

    /// A lamp's light just under the surface.
    fn inner_ray(
        &self,
        lamps: &Lamps,
        lamp: usize,
        point: &SurfacePoint,
        cone: &Cone,
        kernel: &EnteringKernel,
    ) -> InnerRay {
        let shine = lamps.shine(lamp, point.position);
        let cos = shine.direction.dot(point.normal);
        let (far, skip) = (shine.distance, point.primitive);
        if cos <= 0.0 || self.geometry.occluded(point.position, shine.direction, far, Facing::Entering, skip) {
            return InnerRay { direction: Vec3::Z, power: 0.0, kernel: [0.0; 3] };
        }
        let (passed, sum) = cone.pass(shine.direction, point.normal);
        let local = carried(sum, point.normal, Frame::new(point.smooth_normal));
        let direction = local.normalize_or(Vec3::Z);
        InnerRay { direction, power: shine.factor * cos * passed, kernel: kernel.around(direction.z) }
    }
}

/// Light that has entered.
struct InnerRay {
    /// Mean direction from which it comes, turned back: outward, in the entrance's frame.
    direction: Vec3,
    /// Power per area.
    power: f32,
    /// See [`EnteringKernel::around`].
    kernel: [f32; 3],
}
