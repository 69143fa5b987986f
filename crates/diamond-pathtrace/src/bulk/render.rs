//! One view under all lamps: camera rays, stored light, single scattering, reflections.
use super::directions::{CONE, HEMISPHERE, HEMISPHERE_MEAN, basis, carried};
use super::light_map::Ways;
use super::matched::forced_flight_quantile;
use super::refracting::Cone;
use super::{Bulk, Stored};
use crate::geometry::Facing;
use crate::medium::henyey_greenstein;
use crate::{Boundary, Frame, Hit, PathtraceError, Rng};
use diamond_camera::{Camera, Ray};
use diamond_image::Image;
use glam::{Vec2, Vec3};
use rayon::prelude::*;

/// Stretches of a camera ray behind others of which less than this comes through are left out.
const OPAQUE: f32 = 1e-4;

/// Reflections below this fraction of the incident light (a white diffuse surface reflects 0.3) get no shadow ray.
const INVISIBLE: f32 = 1e-5;

/// Attempts at a reflected direction; the rest is mostly transmission and hits nothing by reflection.
const REFLECTIONS: u32 = 16;

/// Pixels on outlines get this many times more samples per axis.
const EDGE: u32 = 3;

/// Highlights whose radiance differs by more than the first number between samples of a pixel (for an irradiance of 1) get so many times more samples per
/// axis: a polished coat shows a lamp smaller than a pixel.
const SHARP: [(f32, u32); 2] = [(0.01, 3), (0.2, 8)];

/// Places of single scattering along each stretch of a camera ray.
const PLACES: u32 = 4;

/// The golden ratio's fractional part: its multiples fill the unit interval evenly, however many there are.
const STEP: f32 = 0.618_034;

/// Pictures of one view.
#[derive(Debug, Clone, PartialEq)]
pub struct BulkView {
    /// Linear RGB radiance under each lamp, black where no object is (premultiplied by coverage). Noise may
    /// leave values slightly below 0 where there is hardly any light: cutting them off would brighten the mean.
    pub lights: Vec<Image>,
    /// Fraction of each pixel that the object covers.
    pub coverage: Image,
    /// Mean view-space z of what each pixel sees of the object, scene units; 0 where it sees none.
    pub depth: Image,
    /// Mean world normal of it (interpolated where the mesh has normals), unit length; 0 where there is none.
    pub normal: Image,
}

/// What one pixel has gathered.
struct Pixel {
    values: Vec<f32>,
    coverage: f32,
    depth: f32,
    normal: Vec3,
}

/// Weights of stored numbers: for a point, for each function and channel.
type Wanted<const N: usize> = Vec<(u32, [[f32; 3]; N])>;

fn want<const N: usize>(wanted: &mut Wanted<N>, point: u32) -> &mut [[f32; 3]; N] {
    let at = wanted.iter().position(|(k, _)| *k == point).unwrap_or_else(|| {
        wanted.push((point, [[0.0; 3]; N]));
        wanted.len() - 1
    });
    &mut wanted[at].1
}

/// What a pixel's samples share.
struct Gather<'a, const N: usize> {
    bulk: &'a Bulk<'a>,
    wanted: Wanted<N>,
    weights: Vec<(u32, f32)>,
    /// For each channel, each light.
    values: Vec<f32>,
    ways: Ways,
    rng: Rng,
    sequence: f32,
}

impl Bulk<'_> {
    /// The pictures of all lamps from a camera outside the object. `seed` moves samples within pixels: views with different ones have independent
    /// noise of that kind.
    pub fn render(&self, camera: &Camera, seed: u64) -> Result<BulkView, PathtraceError> {
        let bad = |what: &str, expected, found: String| PathtraceError::Value { what: what.into(), expected, found };
        camera.validate().map_err(|e| bad("the camera", "a valid camera", e.to_string()))?;
        let centre = camera.pose.centre();
        if self.scene.geometry.contains(centre) {
            return Err(bad("the camera's centre", "a point outside the object", format!("{centre}")));
        }
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        let pixels: Vec<Pixel> = (0..width * height)
            .into_par_iter()
            .with_max_len(64)
            .map(|i| {
                let corner = Vec2::new((i % width) as f32, (i / width) as f32);
                let rng = Rng::new(self.options.seed ^ seed.rotate_left(32), (1 << 40) + i as u64);
                match &self.stored {
                    Stored::Scattered => {
                        Gather::<HEMISPHERE>::new(self, rng).pixel(camera, corner, |g, ray, hit, share| {
                            g.scattered(ray, hit, share);
                        })
                    }
                    Stored::UnderSurface(cone) => {
                        Gather::<CONE>::new(self, rng).pixel(camera, corner, |g, ray, hit, share| {
                            g.refracted(cone, ray, hit, share);
                        })
                    }
                }
            })
            .collect();
        let blank = |channels| Image::new(width, height, channels);
        let mut view = BulkView {
            lights: (0..self.lamps.len()).map(|_| blank(3)).collect(),
            coverage: blank(1),
            depth: blank(1),
            normal: blank(3),
        };
        let lights = self.lamps.len();
        for (i, pixel) in pixels.iter().enumerate() {
            for (l, image) in view.lights.iter_mut().enumerate() {
                let colour = self.lamps.colour(l);
                for c in 0..3 {
                    image.data_mut()[3 * i + c] = pixel.values[c * lights + l] * colour[c];
                }
            }
            view.coverage.data_mut()[i] = pixel.coverage;
            view.depth.data_mut()[i] = pixel.depth;
            view.normal.data_mut()[3 * i..3 * i + 3].copy_from_slice(&pixel.normal.to_array());
        }
        Ok(view)
    }
}

impl<'a, const N: usize> Gather<'a, N> {
    fn new(bulk: &'a Bulk<'a>, mut rng: Rng) -> Self {
        let sequence = rng.uniform();
        let values = vec![0.0; 3 * bulk.lamps.len()];
        Self { bulk, wanted: Vec::new(), weights: Vec::new(), values, ways: Ways::default(), rng, sequence }
    }

    /// The mean over a pixel's square of what `see` adds for each ray that meets the object.
    fn pixel(mut self, camera: &Camera, corner: Vec2, see: impl Fn(&mut Self, Ray, &Hit, f32)) -> Pixel {
        let geometry = &self.bulk.scene.geometry;
        let n = self.bulk.options.samples_per_axis;
        let forward = camera.pose.forward();
        let meet = |n: u32, i: u32| {
            let at = Vec2::new((i % n) as f32 + 0.5, (i / n) as f32 + 0.5) / n as f32;
            let ray = camera.ray(corner + at);
            let facing = Facing::Entering;
            geometry
                .closest_hit(ray.origin, ray.direction, f32::INFINITY, facing, crate::NO_PRIMITIVE)
                .map(|h| (ray, h))
        };
        let mut met: Vec<(Ray, Hit)> = (0..n * n).filter_map(|i| meet(n, i)).collect();
        let mut count = n * n;
        if !met.is_empty() && met.len() < count as usize {
            // An outline: how much of the pixel is covered decides its value.
            let fine = EDGE * n;
            count = fine * fine;
            met = (0..count).filter_map(|i| meet(fine, i)).collect();
        }
        // Of an outline's many samples only as many are shaded as elsewhere.
        let stride = met.len().div_ceil((n * n) as usize).max(1);
        let coverage = met.len() as f32 / count as f32;
        let shaded = met.iter().skip(stride / 2).step_by(stride);
        let hits = shaded.len().max(1) as f32;
        let share = coverage / hits;
        let (mut depth, mut normal) = (0.0, Vec3::ZERO);
        for (ray, hit) in shaded {
            depth += (hit.position - ray.origin).dot(forward);
            normal += geometry.shading_normal(hit);
            see(&mut self, *ray, hit, share);
        }
        let shaded = met.iter().skip(stride / 2).step_by(stride);
        self.coat(shaded, coverage, |times| (0..(n * n * times * times)).filter_map(|i| meet(n * times, i)).collect());
        self.collect();
        Pixel { values: self.values, coverage, depth: depth / hits, normal: normal.normalize_or_zero() }
    }

    /// Adds the stored light that was asked for.
    fn collect(&mut self) {
        let lights = self.bulk.lamps.len();
        for (point, weights) in &self.wanted {
            let rows = &self.bulk.coefficients[*point as usize * N * 3 * lights..][..N * 3 * lights];
            for (row, weight) in rows.chunks_exact(3 * lights).zip(weights) {
                for ((row, weight), out) in
                    row.chunks_exact(lights).zip(weight).zip(self.values.chunks_exact_mut(lights))
                {
                    out.iter_mut().zip(row).for_each(|(out, v)| *out += weight * v);
                }
            }
        }
    }

    #[inline]
    fn add(&mut self, light: usize, value: Vec3) {
        let lights = self.bulk.lamps.len();
        for c in 0..3 {
            self.values[c * lights + light] += value[c];
        }
    }

    /// Lights mirrored in the coat; lamps whose highlight has an edge here are looked at with more rays, of which `finer` makes so many
    /// times more per axis.
    fn coat<'h>(
        &mut self,
        shaded: impl Iterator<Item = &'h (Ray, Hit)>,
        coverage: f32,
        finer: impl Fn(u32) -> Vec<(Ray, Hit)>,
    ) {
        let bulk = self.bulk;
        let Some(coat) = bulk.scene.material.coat else { return };
        let geometry = &bulk.scene.geometry;
        let hits: Vec<(Ray, Hit, Vec3)> = shaded.map(|(ray, hit)| (*ray, *hit, geometry.shading_normal(hit))).collect();
        let radiance = |l: usize, ray: &Ray, hit: &Hit, normal: Vec3| {
            let shine = bulk.lamps.shine(l, hit.position);
            match shine.direction.dot(hit.normal) > 0.0 {
                true => coat.evaluate(-ray.direction, shine.direction, normal).0 * shine.factor,
                false => Vec3::ZERO,
            }
        };
        let lit = |l: usize, hit: &Hit, value: Vec3| {
            // Written so that NaN fails it.
            value.max_element() > INVISIBLE && {
                let shine = bulk.lamps.shine(l, hit.position);
                let facing = Facing::Entering;
                !geometry.occluded(hit.position, shine.direction, shine.distance, facing, hit.primitive)
            }
        };
        let mut fine: [Option<Vec<(Ray, Hit, Vec3)>>; SHARP.len()] = [const { None }; SHARP.len()];
        let mut values = Vec::with_capacity(hits.len());
        for l in 0..bulk.lamps.len() {
            values.clear();
            values.extend(hits.iter().map(|(ray, hit, normal)| radiance(l, ray, hit, *normal)));
            let brightness = values.iter().map(|v| v.max_element());
            let (least, most) = brightness.fold((f32::MAX, 0.0f32), |(a, b), v| (a.min(v), b.max(v)));
            let level = SHARP.iter().rposition(|(contrast, _)| most - least > *contrast);
            let mut sum = Vec3::ZERO;
            let count = match level {
                None => {
                    for ((_, hit, _), value) in hits.iter().zip(&values) {
                        if lit(l, hit, *value) {
                            sum += *value;
                        }
                    }
                    hits.len()
                }
                Some(level) => {
                    let made = || {
                        let all = finer(SHARP[level].1).into_iter();
                        all.map(|(ray, hit)| (ray, hit, geometry.shading_normal(&hit))).collect()
                    };
                    let rays = fine[level].get_or_insert_with(made);
                    for (ray, hit, normal) in rays.iter() {
                        let value = radiance(l, ray, hit, *normal);
                        if lit(l, hit, value) {
                            sum += value;
                        }
                    }
                    rays.len()
                }
            };
            self.add(l, sum * (coverage / count.max(1) as f32));
        }
    }

    /// Light that comes straight from the lamps and leaves by `reflectance` (scattering function times cosine).
    fn reflect(&mut self, hit: &Hit, share: f32, reflectance: impl Fn(Vec3) -> Vec3) {
        let bulk = self.bulk;
        for l in 0..bulk.lamps.len() {
            let shine = bulk.lamps.shine(l, hit.position);
            if shine.direction.dot(hit.normal) <= 0.0 {
                continue;
            }
            let value = reflectance(shine.direction);
            // Written so that NaN fails it.
            let visible = value.max_element() > INVISIBLE;
            let blocked = || {
                let facing = Facing::Entering;
                bulk.scene.geometry.occluded(hit.position, shine.direction, shine.distance, facing, hit.primitive)
            };
            if visible && !blocked() {
                self.add(l, value * (shine.factor * share));
            }
        }
    }
}

impl Gather<'_, HEMISPHERE> {
    /// Light that is scattered along a ray through an index-matched object, stretch by stretch.
    fn scattered(&mut self, ray: Ray, first: &Hit, share: f32) {
        let bulk = self.bulk;
        let (geometry, medium) = (&bulk.scene.geometry, bulk.scene.material.medium);
        let mut throughput = Vec3::splat(share);
        let mut hit = *first;
        while throughput.max_element() > OPAQUE * share {
            let end = geometry.closest_hit(hit.position, ray.direction, f32::INFINITY, Facing::Leaving, hit.primitive);
            let Some(end) = end else { return };
            // 1 − e^(−σs) without cancellation.
            let scattered =
                throughput * Vec3::from_array((medium.sigma_t * end.distance).to_array().map(|x| -(-x).exp_m1()));
            self.stored(&hit, -ray.direction, scattered);
            self.once(&hit, ray.direction, end.distance, scattered);
            throughput *= medium.transmittance(end.distance);
            let next =
                geometry.closest_hit(end.position, ray.direction, f32::INFINITY, Facing::Entering, end.primitive);
            let Some(next) = next else { return };
            hit = next;
        }
    }

    /// Light that was scattered several times, from the points around.
    fn stored(&mut self, hit: &Hit, outgoing: Vec3, weight: Vec3) {
        let points = &self.bulk.points;
        let normal = self.bulk.scene.geometry.shading_normal(hit);
        let mut weights = std::mem::take(&mut self.weights);
        points.weights(hit.position, normal, &mut weights);
        for &(k, w) in &weights {
            let frame = Frame::new(points.points()[k as usize].smooth_normal);
            let values = basis::<HEMISPHERE>(carried(outgoing, normal, frame), HEMISPHERE_MEAN);
            for (sums, b) in want(&mut self.wanted, k).iter_mut().zip(values) {
                (0..3).for_each(|c| sums[c] += w * b * weight[c]);
            }
        }
        self.weights = weights;
    }

    /// Light that was scattered once, at a few places of the stretch.
    /// `[eq:single-scattering]`
    fn once(&mut self, hit: &Hit, direction: Vec3, length: f32, weight: Vec3) {
        let bulk = self.bulk;
        let medium = bulk.scene.material.medium;
        for _ in 0..PLACES {
            self.sequence += STEP;
            self.sequence -= self.sequence.floor();
            let (distance, ratio) = forced_flight_quantile(medium.sigma_t, length, self.sequence);
            let at = hit.position + direction * distance;
            let weight = weight * ratio * medium.albedo * medium.variation(at) / PLACES as f32;
            let mut ways = std::mem::take(&mut self.ways);
            bulk.maps.look_up(&bulk.lamps, at, &mut ways);
            for (l, (shine, inside)) in ways.shines.iter().zip(&ways.lengths).enumerate() {
                let phase = henyey_greenstein(medium.g, direction, shine.direction);
                self.add(l, weight * medium.transmittance(*inside) * (phase * shine.factor));
            }
            self.ways = ways;
        }
    }
}

impl Gather<'_, CONE> {
    /// Light under the surface that passes it, and light that the surface reflects.
    fn refracted(&mut self, cone: &Cone, ray: Ray, hit: &Hit, share: f32) {
        let geometry = &self.bulk.scene.geometry;
        let boundary = self.bulk.scene.material.boundary;
        let outgoing = -ray.direction;
        let reflectance = |outgoing: Vec3, hit: &Hit| {
            let normal = hit.normal;
            move |direction| Vec3::splat(boundary.evaluate(outgoing, direction, normal).0)
        };
        let rough = matches!(boundary.effective(), Boundary::Rough { .. });
        if rough {
            self.reflect(hit, share, reflectance(outgoing, hit));
        }
        self.under(cone, hit, outgoing, share);
        // What another part of the object sends to this one.
        for _ in 0..REFLECTIONS {
            let Some(s) = boundary.sample(outgoing, hit.normal, &mut self.rng) else { continue };
            if s.transmitted {
                continue;
            }
            // The first reflection stands for all, with the reflectance of its facet.
            let eta = cone.eta2.sqrt();
            let (fresnel, _) =
                crate::fresnel::dielectric(outgoing.dot((outgoing + s.direction).normalize_or(hit.normal)), eta);
            let facing = Facing::Entering;
            let other = geometry.closest_hit(hit.position, s.direction, f32::INFINITY, facing, hit.primitive);
            if let Some(other) = other {
                let share = share * fresnel * s.weight;
                if rough {
                    self.reflect(&other, share, reflectance(-s.direction, &other));
                }
                self.under(cone, &other, -s.direction, share);
            }
            break;
        }
    }

    /// Stored light that leaves at a hit.
    fn under(&mut self, cone: &Cone, hit: &Hit, outgoing: Vec3, share: f32) {
        let points = &self.bulk.points;
        let (passed, sum) = cone.pass(outgoing, hit.normal);
        let normal = self.bulk.scene.geometry.shading_normal(hit);
        let mut weights = std::mem::take(&mut self.weights);
        points.weights(hit.position, normal, &mut weights);
        for &(k, w) in &weights {
            let frame = Frame::new(points.points()[k as usize].smooth_normal);
            let local = carried(sum, hit.normal, frame);
            let scale = w * share / cone.eta2;
            let values = [passed, local.z - cone.mean_cos * passed, local.x, local.y];
            for (sums, b) in want(&mut self.wanted, k).iter_mut().zip(values) {
                sums.iter_mut().for_each(|s| *s += scale * b);
            }
        }
        self.weights = weights;
    }
}
