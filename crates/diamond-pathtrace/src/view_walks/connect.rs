//! Walks that were recorded, under lamps.
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
use std::f32::consts::TAU;

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
        let maps = LightMaps::new(self.geometry, lamps, self.options.visibility);
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

    /// `[eq:entering-kernel]`
    fn connect_entrances(&self, lamps: &Lamps, values: &mut [f32], width: usize) {
        let Some((cone, points)) = &self.entrances else { return };
        let lights = lamps.len();
        let rays: Vec<InnerRay> = points
            .points()
            .par_iter()
            .flat_map_iter(|point| (0..lights).map(move |l| self.inner_ray(lamps, l, point, cone)))
            .collect();
        let bins = self.bins.ends.len();
        // Radiance is smaller outside by the squared index.
        let scale = 1.0 / (self.options.walks as f32 * cone.eta2);
        values.par_chunks_exact_mut(width).enumerate().with_min_len(4).for_each(|(k, h)| {
            for connection in &self.connections[self.starts[k]..self.starts[k + 1]] {
                let direction = connection.direction();
                let weight = scale / direction.z.max(MIN_INNER_COSINE);
                let bin = self.bins.of[usize::from(connection.scatterings)] as usize;
                let row = &rays[connection.entrance() * lights..][..lights];
                for (ray, h) in row.iter().zip(h[bin..].iter_mut().step_by(bins)) {
                    if ray.power > 0.0 {
                        *h += weight * ray.power * entering_kernel(ray.direction.dot(direction));
                    }
                }
            }
        });
    }

    /// A lamp's light just under the surface.
    fn inner_ray(&self, lamps: &Lamps, lamp: usize, point: &SurfacePoint, cone: &Cone) -> InnerRay {
        let shine = lamps.shine(lamp, point.position);
        let cos = shine.direction.dot(point.normal);
        let (far, skip) = (shine.distance, point.primitive);
        if cos <= 0.0 || self.geometry.occluded(point.position, shine.direction, far, Facing::Entering, skip) {
            return InnerRay { direction: Vec3::Z, power: 0.0 };
        }
        let (passed, sum) = cone.pass(shine.direction, point.normal);
        let local = carried(sum, point.normal, Frame::new(point.smooth_normal));
        InnerRay { direction: local.normalize_or(Vec3::Z), power: shine.factor * cos * passed }
    }
}

/// Light that has entered.
struct InnerRay {
    /// Mean direction from which it comes, turned back: outward, in the entrance's frame.
    direction: Vec3,
    /// Power per area.
    power: f32,
}

/// Concentration of the kernel: at this value its noise is that of a lobe of some 15°.
const CONCENTRATION: f32 = 8.0;

/// Cosines that the kernel is divided by are at least this; behind a boundary light comes from a cone of larger ones.
pub(crate) const MIN_INNER_COSINE: f32 = 0.1;

/// What light from a direction counts for a walk whose direction differs from it by an angle of this cosine, in place of the Dirac function that no
/// walk meets: a Fisher distribution times a + b·x, so that the integral over all directions is 1 and that of a linear function is its value at the
/// centre. With A = coth κ − 1/κ the mean of x, and its variance V = 1 − 2A/κ − A²: b = (1 − A)/V, a = 1 − b·A.
/// `[eq:entering-kernel]`
#[inline]
fn entering_kernel(x: f32) -> f32 {
    // e^(−2κ) is nothing in `f32`: coth κ = 1.
    const MEAN: f32 = 1.0 - 1.0 / CONCENTRATION;
    const VARIANCE: f32 = 1.0 - 2.0 * MEAN / CONCENTRATION - MEAN * MEAN;
    const B: f32 = (1.0 - MEAN) / VARIANCE;
    const A: f32 = 1.0 - B * MEAN;
    CONCENTRATION / TAU * (CONCENTRATION * (x - 1.0)).exp() * (A + B * x)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `[eq:entering-kernel]`
    #[test]
    fn the_kernel_reproduces_linear_functions() {
        let n = 200_000;
        let (mut one, mut x_mean) = (0.0f64, 0.0f64);
        for i in 0..n {
            let x = (f64::from(i) + 0.5) / f64::from(n) * 2.0 - 1.0;
            let value = f64::from(entering_kernel(x as f32)) * std::f64::consts::TAU * 2.0 / f64::from(n);
            one += value;
            x_mean += value * x;
        }
        assert!((one - 1.0).abs() < 1e-4 && (x_mean - 1.0).abs() < 1e-4, "{one} {x_mean}");
    }
}
