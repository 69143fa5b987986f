//! Walks that were recorded, under lamps.
use super::record::{enclosing, has_wide_lobe, kept};
use super::{RadianceMoments, ViewWalks};
use crate::bulk::lamps::Lamps;
use crate::bulk::light_map::{LightMaps, Ways};
use crate::bulk::points::SurfacePoints;
use crate::bulk::refracting::entering;
use crate::geometry::Facing;
use crate::medium::henyey_greenstein;
use crate::{Frame, Light, PathtraceError};
use rayon::prelude::*;

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
                Some((cone, points)) => match has_wide_lobe(self.boundary) {
                    true => self.connect_lobes(&lamps, points, cone.eta2, &mut values, width),
                    false => self.connect_entrances(&lamps, &mut values, width),
                },
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

    /// Through the lobe of a rough boundary.
    fn connect_lobes(&self, lamps: &Lamps, points: &SurfacePoints, eta2: f32, values: &mut [f32], width: usize) {
        let lights = lamps.len();
        // Direction to each lamp and what it sends, at each entrance.
        let shines: Vec<_> = points
            .points()
            .par_iter()
            .flat_map_iter(|point| {
                (0..lights).map(move |l| {
                    let shine = lamps.shine(l, point.position);
                    let (to, far, skip) = (shine.direction, shine.distance, point.primitive);
                    let dark = to.dot(point.normal) <= 0.0
                        || self.geometry.occluded(point.position, to, far, Facing::Entering, skip);
                    (to, if dark { 0.0 } else { shine.factor })
                })
            })
            .collect();
        let bins = self.bins.ends.len();
        let scale = 1.0 / (self.options.walks as f32 * eta2);
        values.par_chunks_exact_mut(width).enumerate().with_min_len(4).for_each(|(k, h)| {
            for connection in &self.connections[self.starts[k]..self.starts[k + 1]] {
                let normal = points.points()[connection.entrance()].smooth_normal;
                let back = -Frame::new(normal).to_world(connection.direction());
                let bin = self.bins.of[usize::from(connection.scatterings)] as usize;
                let row = &shines[connection.entrance() * lights..][..lights];
                for ((to, factor), h) in row.iter().zip(h[bin..].iter_mut().step_by(bins)) {
                    if *factor > 0.0 && to.dot(normal) > 0.0 {
                        *h += scale * factor * self.boundary.evaluate(back, *to, normal).0;
                    }
                }
            }
        });
    }

    fn connect_entrances(&self, lamps: &Lamps, values: &mut [f32], width: usize) {
        let Some((cone, points)) = &self.entrances else { return };
        let entering = entering(self.geometry, lamps, points, cone);
        let (bins, lights) = (self.bins.ends.len(), lamps.len());
        // Radiance is smaller outside by the squared index.
        let scale = 1.0 / (self.options.walks as f32 * cone.eta2);
        values.par_chunks_exact_mut(width).enumerate().with_min_len(4).for_each(|(k, h)| {
            for connection in &self.connections[self.starts[k]..self.starts[k + 1]] {
                let kernel = cone.kernel(connection.direction());
                let rows = &entering[connection.entrance() * kernel.len() * lights..][..kernel.len() * lights];
                let bin = self.bins.of[usize::from(connection.scatterings)] as usize;
                for (l, h) in h[bin..].iter_mut().step_by(bins).enumerate() {
                    let value: f32 = kernel.iter().enumerate().map(|(b, g)| g * rows[b * lights + l]).sum();
                    *h += scale * value;
                }
            }
        });
    }
}
