//! A medium from photographs: non-negative least squares over what a profile's widths, local light and a coat would show.
//!
//! Everything is linear in the unknowns, so a few photographs are enough, and other lights cost nothing. Unknown are, per channel,
//! a weight ≥ 0 for each width and for light that leaves where it enters, and for all channels one scale ≥ 0 of a GGX coat at three roughnesses. Rows are weighted
//! by the slope of the sRGB curve between photograph and prediction, so that what is minimised is close to the error of the displayed
//! picture; a few rounds make it consistent.
use crate::medium::{Coat, Described, Medium, Quality, Transport};
use crate::{FitImage, FitPhotograph, MediumError, Surface};
use diamond_camera::Camera;
use diamond_image::Transfer;
use diamond_light::{Falloff, OlatLight};
use diamond_shading::{
    Balance, Entry, NormalEquations, NormalizedDiffusion, RadialProfile, SolveOptions, SurfelLighting, SurfelTransport,
    Surfels,
};
use glam::Vec3;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Roughnesses at which the coat is offered.
pub const COATS: [f32; 3] = [0.2, 0.35, 0.6];
/// Values at and above this are full film: they only say that there was at least as much.
pub(crate) const FULL: f32 = 0.995;
/// Rounds of weighting.
const ROUNDS: usize = 3;

/// How a fit goes about it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitOptions {
    /// Gaussians of the profile.
    pub widths: usize,
    /// Width of the widest, radii of the object.
    pub widest: f32,
    /// About this many pixels of all photographs together are looked at; see [`FitOptions::pixels_of_each`].
    pub pixels: usize,
    /// Falloff of the lights.
    pub falloff: Falloff,
    /// Irradiance of a light of intensity 1 (the scene's light scale).
    pub unit: f32,
    /// Ridge of the least squares, as a fraction of the diagonal.
    pub ridge: f64,
}

impl FitOptions {
    /// Pixels of each of so many photographs, at least one.
    pub fn pixels_of_each(&self, photographs: usize) -> usize {
        (self.pixels / photographs.max(1)).max(1)
    }

    /// The pixels of a photograph that are looked at, where it is one of so many.
    pub fn sample(
        &self,
        surface: &Surface,
        image: &FitImage<'_>,
        photographs: usize,
    ) -> Result<FitPhotograph, MediumError> {
        FitPhotograph::new(surface, image, self.pixels_of_each(photographs), self.falloff)
    }
}

impl Default for FitOptions {
    fn default() -> Self {
        Self { widths: 12, widest: 1.0, pixels: 40_000, falloff: Falloff::None, unit: 1.0, ridge: 1e-6 }
    }
}

/// One photograph's pixels and what each unknown would show there.
pub(crate) struct Rows<'a> {
    pub photograph: &'a FitPhotograph,
    /// pixels × (shared + coats), under a light of intensity 1.
    pub values: Vec<f32>,
    pub intensity: Vec3,
}

pub(crate) fn key(light: &OlatLight) -> [u32; 4] {
    let (kind, v) = match *light {
        OlatLight::Point { position, .. } => (0, position),
        OlatLight::Directional { direction, .. } => (1, direction),
    };
    [kind, v.x.to_bits(), v.y.to_bits(), v.z.to_bits()]
}

/// Scalar irradiance of places under lights of intensity 1: places × lights.
pub(crate) fn irradiance(
    surface: &Surface,
    positions: &[Vec3],
    normals: &[Vec3],
    lights: &[OlatLight],
    falloff: Falloff,
) -> Result<Vec<f32>, MediumError> {
    let visibility = surface.visibility(positions, normals, lights);
    let lighting = SurfelLighting { positions, normals, visibility: &visibility, lights, falloff, entry: Entry::Full };
    Ok(lighting.irradiance()?.into_iter().step_by(3).collect())
}

/// Transport between the surfels of a surface.
pub(crate) fn surfel_transport(surface: &Surface, widths: Vec<f32>) -> Result<SurfelTransport, MediumError> {
    let surfels =
        Surfels { positions: surface.positions().to_vec(), areas: surface.patches().iter().map(|p| p.area).collect() };
    Ok(SurfelTransport::new(surfels, widths, Balance::Plain)?)
}

pub(crate) fn normals_of(surface: &Surface) -> Vec<Vec3> {
    surface.patches().iter().map(|p| p.normal).collect()
}

/// What the photographs say, as columns of unknowns.
pub(crate) struct Evidence<'a> {
    pub rows: Vec<Rows<'a>>,
    pub shared: usize,
    coats: usize,
    unit: f32,
}

/// The lights of photographs, each once, and which photograph has which.
pub(crate) fn lights_of(photographs: &[FitPhotograph]) -> (Vec<OlatLight>, Vec<usize>) {
    let (mut lights, mut index, mut places) = (Vec::new(), Vec::new(), BTreeMap::new());
    for photograph in photographs {
        let place = *places.entry(key(&photograph.light)).or_insert_with(|| {
            lights.push(photograph.light.of_unit_intensity());
            lights.len() - 1
        });
        index.push(place);
    }
    (lights, index)
}

/// What surfels send out, before it is fitted.
pub(crate) struct Columns<'c> {
    /// Columns.
    pub count: usize,
    /// surfels × lights × columns: radiosity under lights of intensity 1.
    pub values: &'c [f32],
    /// Factor on each column toward the outer cosine, over π.
    pub exit: &'c (dyn Fn(f32) -> Vec<f32> + Sync),
}

impl<'a> Evidence<'a> {
    /// A column of light that leaves where it enters is added.
    pub(crate) fn new(
        photographs: &'a [FitPhotograph],
        columns: &Columns<'_>,
        index: &[usize],
        lights: usize,
        unit: f32,
    ) -> Result<Self, MediumError> {
        if photographs.iter().all(|p| p.pixels.is_empty()) {
            return Err(MediumError::Unusable {
                detail: "no pixel of any photograph shows the surface; is it in the frame of the cameras?".into(),
            });
        }
        let coats = if photographs.iter().any(|p| p.has_known) { 0 } else { COATS.len() };
        let shared = columns.count + 1;
        let width = shared + coats;
        let rows = photographs.iter().zip(index).map(|(photograph, light)| {
            let mut values = vec![0.0f32; width * photograph.pixels.len()];
            values.par_chunks_exact_mut(width).zip(&photograph.pixels).enumerate().for_each(|(n, (row, pixel))| {
                for (j, weight) in photograph.attachment.of(n) {
                    let from = &columns.values[(j * lights + light) * columns.count..][..columns.count];
                    row.iter_mut().zip(from).for_each(|(to, v)| *to += weight * v);
                }
                let factors = (columns.exit)(pixel.cos_theta_o);
                row.iter_mut().zip(factors).for_each(|(v, f)| *v *= f);
                row[columns.count] = pixel.local;
                row[shared..].iter_mut().zip(pixel.coats).for_each(|(out, v)| *out = v);
            });
            Rows { photograph, values, intensity: photograph.light.intensity() * unit }
        });
        Ok(Self { rows: rows.collect(), shared, coats, unit })
    }

    fn unknowns(&self) -> usize {
        3 * self.shared + self.coats
    }

    pub(crate) fn width(&self) -> usize {
        self.shared + self.coats
    }

    /// What is predicted for channel `c` of pixel `n` (without what is known), from coefficients of shared columns per channel and coats.
    fn predicted(&self, rows: &Rows<'_>, x: &[f64], n: usize, c: usize) -> f32 {
        let row = &rows.values[n * self.width()..(n + 1) * self.width()];
        let tint = rows.photograph.pixels[n].tint[c];
        let under: f64 = row[..self.shared].iter().zip(&x[c * self.shared..]).map(|(v, x)| f64::from(*v) * x).sum();
        let coat: f64 = row[self.shared..].iter().zip(&x[3 * self.shared..]).map(|(v, x)| f64::from(*v) * x).sum();
        rows.intensity[c] * (tint * under as f32 + coat as f32)
    }

    fn equations(&self, x: Option<&[f64]>) -> NormalEquations {
        let parts: Vec<NormalEquations> = self
            .rows
            .par_iter()
            .map(|rows| {
                let mut equations = NormalEquations::new(self.unknowns());
                let mut row = vec![0.0; self.unknowns()];
                for (n, pixel) in rows.photograph.pixels.iter().enumerate() {
                    let values = &rows.values[n * self.width()..(n + 1) * self.width()];
                    for c in 0..3 {
                        let (tint, known, b) = (pixel.tint[c], pixel.known[c], pixel.radiance[c]);
                        if b >= FULL {
                            continue;
                        }
                        row.fill(0.0);
                        for (k, v) in values.iter().enumerate() {
                            let (at, factor) =
                                if k < self.shared { (c * self.shared + k, tint) } else { (2 * self.shared + k, 1.0) };
                            row[at] = f64::from(*v * rows.intensity[c] * factor);
                        }
                        let guess = x.map_or(b, |x| (known + self.predicted(rows, x, n, c)).clamp(0.0, 1.0));
                        let slope = slope(b, guess);
                        equations.add(&row, f64::from(b - known), f64::from(slope * slope));
                    }
                }
                equations
            })
            .collect();
        let mut all = NormalEquations::new(self.unknowns());
        for part in &parts {
            // Of equal size by construction.
            let _ = all.merge(part);
        }
        all
    }

    fn solve(&self, ridge: f64) -> (Vec<f64>, NormalEquations) {
        let mut equations = self.equations(None);
        let mut x = equations.solve(&SolveOptions { ridge });
        for _ in 1..ROUNDS {
            equations = self.equations(Some(&x));
            x = equations.solve(&SolveOptions { ridge });
        }
        (x, equations)
    }

    /// How well `x` explains the photographs.
    pub(crate) fn quality(&self, x: &[f64]) -> Quality {
        let encode = |v: f32| Transfer::Srgb.encode(v.clamp(0.0, 1.0));
        let (mut squares, mut truth, mut count) = (0.0f64, 0.0f64, 0u64);
        // Differences of a pixel under all lights of its view, where there are several.
        let mut views: Vec<(&Camera, BTreeMap<usize, Left>)> = Vec::new();
        for rows in &self.rows {
            let place = views.iter().position(|v| *v.0 == rows.photograph.camera).unwrap_or_else(|| {
                views.push((&rows.photograph.camera, BTreeMap::new()));
                views.len() - 1
            });
            let view = &mut views[place].1;
            for (n, pixel) in rows.photograph.pixels.iter().enumerate() {
                let left = view.entry(pixel.index).or_default();
                left.lights += 1;
                for c in 0..3 {
                    let (known, b) = (pixel.known[c], pixel.radiance[c]);
                    let d = f64::from(encode(known + self.predicted(rows, x, n, c)) - encode(b));
                    squares += d * d;
                    truth += f64::from(encode(b)).powi(2);
                    count += 1;
                    left.sum[c] += d;
                    left.squares += d * d;
                }
            }
        }
        let (mut same, mut all) = (0.0f64, 0.0f64);
        for left in views.iter().flat_map(|v| v.1.values()).filter(|l| l.lights > 1) {
            same += left.sum.iter().map(|s| s * s).sum::<f64>() / f64::from(left.lights);
            all += left.squares;
        }
        let mean = squares / count.max(1) as f64;
        Quality {
            images: self.rows.len(),
            relative_error: (squares / truth.max(1e-12)).sqrt() as f32,
            psnr: (-10.0 * libm::log10(mean.max(1e-12))) as f32,
            constant_part: if all > 0.0 { (same / all) as f32 } else { 0.0 },
        }
    }

    /// Roughness and scale of the coat that the coefficients amount to.
    fn coat(&self, x: &[f64]) -> Coat {
        let scales = &x[3 * self.shared..];
        let sum: f64 = scales.iter().sum();
        if sum <= 0.0 {
            return Coat { roughness: 0.5, scale: 0.0 };
        }
        let roughness = scales.iter().zip(COATS).map(|(s, r)| s * f64::from(r)).sum::<f64>() / sum;
        Coat { roughness: roughness as f32, scale: sum as f32 }
    }
}

/// What is left of a pixel's value under the lights of its view.
#[derive(Default)]
struct Left {
    sum: [f64; 3],
    squares: f64,
    lights: u32,
}

/// Slope of the sRGB curve between two values.
pub(crate) fn slope(a: f32, b: f32) -> f32 {
    if (a - b).abs() < 1e-3 {
        return Transfer::Srgb.encode_pull(0.5 * (a + b), 1.0);
    }
    (Transfer::Srgb.encode(a) - Transfer::Srgb.encode(b)) / (a - b)
}

/// Widths that a profile between the surfels of a surface is offered.
pub fn offered_widths(surface: &Surface, options: &FitOptions) -> Vec<f32> {
    let widest = (options.widest * surface.radius()).max(1.1 * surface.spacing());
    RadialProfile::geometric_widths(surface.spacing(), widest, options.widths)
}

/// Fits a profile and a coat to photographs.
pub fn fit_profile(
    surface: &Surface,
    photographs: &[FitPhotograph],
    options: &FitOptions,
) -> Result<Medium, MediumError> {
    Ok(fit_profile_and_coats(surface, photographs, options)?.0)
}

/// [`fit_profile`], and the scale of the coat at each of [`COATS`] (none where the rest of the light is known).
pub(crate) fn fit_profile_and_coats(
    surface: &Surface,
    photographs: &[FitPhotograph],
    options: &FitOptions,
) -> Result<(Medium, Vec<f32>), MediumError> {
    let (lights, index) = lights_of(photographs);
    if lights.is_empty() {
        return Err(MediumError::Unusable { detail: "a fit needs at least one photograph".into() });
    }
    let transport = surfel_transport(surface, offered_widths(surface, options))?;
    let entering = irradiance(surface, surface.positions(), &normals_of(surface), &lights, options.falloff)?;
    let basis = transport.receivers(surface.positions())?.basis(&entering)?;
    let places = surface.positions().len() * lights.len();
    let values: Vec<f32> = (0..places).flat_map(|p| basis.iter().map(move |b| b[p])).collect();
    drop(basis);
    let diffuse = vec![1.0 / std::f32::consts::PI; options.widths];
    let columns = Columns { count: options.widths, values: &values, exit: &|_| diffuse.clone() };
    let evidence = Evidence::new(photographs, &columns, &index, lights.len(), options.unit)?;
    let (x, equations) = evidence.solve(options.ridge);
    let s = evidence.shared;
    let coats = x[3 * s..].iter().map(|v| *v as f32).collect();
    let weights = (0..s - 1).map(|k| std::array::from_fn(|c| x[c * s + k] as f32)).collect();
    let local = std::array::from_fn(|c| x[c * s + s - 1] as f32);
    let described = describe(transport.widths(), &equations, &x, s)?;
    let medium = Medium {
        unit: evidence.unit,
        transport: Transport::Profile { widths: transport.widths().to_vec(), weights, local },
        coat: evidence.coat(&x),
        quality: Some(evidence.quality(&x)),
        described: Some(described),
    };
    Ok((medium, coats))
}

/// Steps of the search along each of reflectance and mean free path, and its rounds.
const SEARCH: (i32, usize) = (10, 3);

/// The two-parameter profile that fits the same equations best, the rest as in `x`.
fn describe(widths: &[f32], equations: &NormalEquations, x: &[f64], s: usize) -> Result<Described, MediumError> {
    let mut found = Described { reflectance: [0.0; 3], mean_free_path: [0.0; 3] };
    let mut best = x.to_vec();
    for c in 0..3 {
        let mut at = (f64::INFINITY, 0.0, 0.0);
        let (mut low, mut high) =
            ([0.02f32, libm::logf(0.2 * widths[0])], [1.0f32, libm::logf(widths[widths.len() - 1])]);
        for _ in 0..SEARCH.1 {
            for i in 0..=SEARCH.0 {
                for j in 0..=SEARCH.0 {
                    let t = |k: i32| k as f32 / SEARCH.0 as f32;
                    let a = low[0] + (high[0] - low[0]) * t(i);
                    let l = libm::expf(low[1] + (high[1] - low[1]) * t(j));
                    let mut trial = best.clone();
                    place(&mut trial[c * s..(c + 1) * s], widths, a, l)?;
                    let error = equations.error(&trial);
                    if error < at.0 {
                        at = (error, a, l);
                    }
                }
            }
            let half = [0.2 * (high[0] - low[0]), 0.2 * (high[1] - low[1])];
            low = [(at.1 - half[0]).max(0.01), libm::logf(at.2) - half[1]];
            high = [(at.1 + half[0]).min(1.0), libm::logf(at.2) + half[1]];
        }
        (found.reflectance[c], found.mean_free_path[c]) = (at.1, at.2);
        place(&mut best[c * s..(c + 1) * s], widths, at.1, at.2)?;
    }
    Ok(found)
}

/// Normalised diffusion as coefficients of the widths; nothing local.
fn place(to: &mut [f64], widths: &[f32], reflectance: f32, mean_free_path: f32) -> Result<(), MediumError> {
    let one = NormalizedDiffusion { albedo: Vec3::splat(reflectance), mean_free_path: Vec3::splat(mean_free_path) };
    to.fill(0.0);
    one.on_widths(widths)?.weights.iter().zip(to).for_each(|(w, to)| *to = f64::from(w.x));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Exitance, fit_walk};
    use diamond_camera::{Intrinsics, Pose};
    use diamond_image::Image;
    use diamond_pathtrace::Mesh;

    fn surface() -> Surface {
        // No sphere, on which every place is like every other.
        let mut mesh = Mesh::icosphere(Vec3::ZERO, 1.0, 4);
        mesh.positions.iter_mut().for_each(|p| *p *= Vec3::new(1.0, 0.7, 0.5));
        Surface::new(mesh, 900).unwrap()
    }

    fn cameras() -> Vec<Camera> {
        let intrinsics = Intrinsics::from_fov_x(0.8, 40, 40);
        let eyes = [Vec3::new(0.5, 0.2, 3.0), Vec3::new(3.0, -0.5, 0.4)];
        eyes.iter().map(|e| Camera { intrinsics, pose: Pose::look_at(*e, Vec3::ZERO, Vec3::Y) }).collect()
    }

    fn light(at: Vec3) -> OlatLight {
        OlatLight::Point { position: at, intensity: Vec3::new(9.0, 9.0, 9.0) }
    }

    /// The picture of a medium, without a coat.
    fn picture(surface: &Surface, medium: &Medium, camera: &Camera, lamp: &OlatLight) -> Image {
        let exitance = Exitance::new(surface, medium).unwrap();
        let falloff = Falloff::InverseSquare { reference: 1.0 };
        let leaving = exitance.under(surface, &[*lamp], falloff).unwrap();
        let image = Image::new(40, 40, 3);
        let fit = FitImage { camera, light: lamp, radiance: &image, mask: None, tint: None, known: None };
        let places = fit.places(surface, 1);
        let positions: Vec<Vec3> = places.iter().map(|s| s.position).collect();
        let normals: Vec<Vec3> = places.iter().map(|s| s.normal).collect();
        let attachment = surface.attach(&positions, &normals);
        let own = irradiance(surface, &positions, &normals, &[lamp.of_unit_intensity()], falloff).unwrap();
        let mut out = Image::new(40, 40, 3);
        for (n, place) in places.iter().enumerate() {
            let toward = exitance.toward(place.shading.dot(place.toward_eye));
            let rgb = attachment.rgb(n, &leaving[0]) * toward + medium.local() * own[n];
            out.data_mut()[3 * place.pixel..][..3].copy_from_slice(&(rgb * lamp.intensity()).to_array());
        }
        out
    }

    fn fitted(surface: &Surface, truth: &Medium, walk: bool) -> Medium {
        let (cameras, lamps) = (cameras(), [light(Vec3::new(1.0, 1.5, 2.5)), light(Vec3::new(2.5, -1.0, 0.5))]);
        let pairs: Vec<(&Camera, &OlatLight)> =
            cameras.iter().flat_map(|c| lamps.iter().map(move |l| (c, l))).collect();
        let pictures: Vec<Image> = pairs.iter().map(|(c, l)| picture(surface, truth, c, l)).collect();
        let each = pairs.iter().zip(&pictures);
        let images: Vec<FitImage<'_>> = each
            .map(|((camera, light), radiance)| FitImage {
                camera,
                light,
                radiance,
                mask: None,
                tint: None,
                known: None,
            })
            .collect();
        let options = FitOptions { falloff: Falloff::InverseSquare { reference: 1.0 }, ..FitOptions::default() };
        let seen: Vec<FitPhotograph> =
            images.iter().map(|i| options.sample(surface, i, images.len()).unwrap()).collect();
        if walk { fit_walk(surface, &seen, &options) } else { fit_profile(surface, &seen, &options) }.unwrap()
    }

    fn medium(transport: Transport) -> Medium {
        Medium { unit: 1.0, transport, coat: Coat { roughness: 0.3, scale: 0.0 }, quality: None, described: None }
    }

    /// Difference under a light and from a place that were not fitted, relative.
    fn elsewhere(surface: &Surface, truth: &Medium, found: &Medium) -> f64 {
        let intrinsics = Intrinsics::from_fov_x(0.8, 40, 40);
        let camera = Camera { intrinsics, pose: Pose::look_at(Vec3::new(-2.0, 1.0, 2.0), Vec3::ZERO, Vec3::Y) };
        let lamp = light(Vec3::new(-2.5, 0.5, -1.0));
        let (a, b) = (picture(surface, truth, &camera, &lamp), picture(surface, found, &camera, &lamp));
        let square = |v: f32| f64::from(v) * f64::from(v);
        let difference: f64 = a.data().iter().zip(b.data()).map(|(a, b)| square(a - b)).sum();
        (difference / a.data().iter().map(|v| square(*v)).sum::<f64>()).sqrt()
    }

    #[test]
    fn a_profile_is_found_again_and_holds_for_other_lights() {
        let surface = surface();
        let widths = offered_widths(&surface, &FitOptions::default());
        let mut weights = vec![[0.0f32; 3]; widths.len()];
        (weights[3], weights[7]) = ([0.3, 0.2, 0.2], [0.5, 0.3, 0.1]);
        let truth = medium(Transport::Profile { widths, weights, local: [0.1, 0.0, 0.2] });
        let found = fitted(&surface, &truth, false);
        let quality = found.quality.unwrap();
        assert!(quality.psnr > 40.0, "{quality:?}");
        let off = (found.reflectance() - truth.reflectance()).abs().max_element();
        assert!(off < 0.05, "{found:?}");
        let relative = elsewhere(&surface, &truth, &found);
        assert!(relative < 0.02, "{relative}");
        assert!(found.remarks(surface.spacing()).is_empty(), "{:?}", found.remarks(surface.spacing()));
    }

    #[test]
    fn walks_are_found_again_and_hold_for_other_lights() {
        let surface = surface();
        let transport =
            Transport::Walk { sigma_t: [10.0; 3], albedo: [0.97, 0.9, 0.7], g: 0.0, ior: 1.0, gain: [1.0; 3] };
        let truth = medium(transport);
        let found = fitted(&surface, &truth, true);
        let Transport::Walk { sigma_t, albedo, gain, .. } = found.transport else { panic!("{found:?}") };
        // On a coarse list of σ_t, which albedo and gain make up for.
        assert!(sigma_t.iter().all(|s| (6.0..17.0).contains(s)) && (0.7..1.4).contains(&gain[0]), "{found:?}");
        assert!(albedo[0] > albedo[1] && albedo[1] > albedo[2] && (albedo[1] - 0.9).abs() < 0.07, "{found:?}");
        let relative = elsewhere(&surface, &truth, &found);
        assert!(relative < 0.06, "{relative}");
    }

    #[test]
    fn photographs_that_show_nothing_are_an_error() {
        let surface = surface();
        let intrinsics = Intrinsics::from_fov_x(0.3, 16, 16);
        let away = Camera { intrinsics, pose: Pose::look_at(Vec3::Z * 4.0, Vec3::Z * 9.0, Vec3::Y) };
        let (black, lamp) = (Image::new(16, 16, 3), light(Vec3::Z * 4.0));
        let image = FitImage { camera: &away, light: &lamp, radiance: &black, mask: None, tint: None, known: None };
        let options = FitOptions::default();
        let sampled = |image: &FitImage<'_>| options.sample(&surface, image, 1).unwrap();
        for images in [&[sampled(&image)][..], &[]] {
            assert!(fit_profile(&surface, images, &options).is_err());
        }
        // All black photographs have the medium that returns nothing, and the user is told.
        let there = Camera { intrinsics, pose: Pose::look_at(Vec3::Z * 4.0, Vec3::ZERO, Vec3::Y) };
        let image = FitImage { camera: &there, ..image };
        let found = fit_profile(&surface, &[sampled(&image)], &options).unwrap();
        assert_eq!(found.reflectance(), Vec3::ZERO);
        assert!(found.remarks(surface.spacing()).iter().any(|r| r.contains("hardly any light")));
    }
}
