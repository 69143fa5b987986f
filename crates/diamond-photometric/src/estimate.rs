//! The estimate: normals and relief of a view in turns.
use crate::PhotometricError;
use crate::cast_shadow::Occluder;
use crate::confidence::Doubts;
use crate::normal_fit::{Fitted, Shown, fit_normal, median};
use crate::object_pixels::{NONE, ObjectPixels};
use crate::relief::{inflated, integrated};
use crate::response::leaned;
use crate::sharpest_channel::{Channels, first_non_finite, medians, pick, sharpened};
use crate::spread::map_pixels;
use diamond_camera::Camera;
use diamond_image::{Image, Mask};
use diamond_light::{Falloff, OlatLight};
use glam::Vec3;

/// One view under several lights.
#[derive(Debug, Clone, Copy)]
pub struct PhotometricView<'a> {
    /// Where it was seen from.
    pub camera: &'a Camera,
    /// Where the object is.
    pub mask: &'a Mask,
    /// Linear radiance under each light, of the camera's size, all with one channel or all with three.
    pub images: &'a [&'a Image],
    /// The light of each image.
    pub lights: &'a [OlatLight],
    /// How point lights fall off.
    pub falloff: Falloff,
    /// Distance of the object's middle from the camera's centre, scene units. Near lights are only as near as this says, and
    /// the depth that comes out has this scale.
    pub distance: f32,
}

/// Settings; the defaults are what measured best.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhotometricOptions {
    /// How far lights lean toward the camera, β of [`crate::leaned`], 0 to 2; `None` finds what explains the images best.
    pub lean: Option<f32>,
    /// Share κ of the softest channel that is taken off the sharpest, in [0, 0.9].
    pub sharpening: f32,
    /// Pull of each pixel's normal toward those of the relief, in units of a light's information, above 0. The more lights,
    /// the less it counts.
    pub pull: f32,
    /// Rounds of normals and relief, at least 1.
    pub rounds: u32,
    /// Pull of the relief toward that of the round before, in [0, 1].
    pub anchoring: f32,
    /// How much a light is doubted where the relief shades it, in [0, 1].
    pub shadow_doubt: f32,
}

impl Default for PhotometricOptions {
    fn default() -> Self {
        Self { lean: None, sharpening: 0.6, pull: 0.3, rounds: 3, anchoring: 0.001, shadow_doubt: 0.9 }
    }
}

/// What was found in a view.
#[derive(Debug, Clone, PartialEq)]
pub struct PhotometricStereo {
    /// Unit outward normals, world; 0 off the object. Three channels.
    pub normals: Image,
    /// How much each is to be believed, in [0, 1]; 0 off the object. See [`crate::Doubts`].
    pub confidence: Image,
    /// View-space z of the relief whose normals are nearest to these, scene units; 0 off the object. Right up to a scale and a
    /// shift, since steps within the outline cannot be seen.
    pub depth: Image,
    /// Which channels were used.
    pub channels: Channels,
    /// Lights on the camera's side of the object.
    pub lights_in_front: usize,
    /// The lean of the lights that was used.
    pub lean: f32,
    /// Median over pixels of the robust residual over the albedo.
    pub residual: f32,
}

/// Leans that are tried.
const LEANS: [f32; 8] = [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7];
/// With fewer lights than this nothing is left over to judge by: three explain a normal and an albedo.
const ENOUGH_LIGHTS: usize = 5;
/// What is taken then: between wax and marble.
const FEW_LIGHTS_LEAN: f32 = 0.25;
/// Residual over the albedo at which the pull is what the options say.
const FEW_LIGHTS_NOISE: f32 = 0.05;
/// Least and largest residual that the pull follows.
const NOISE: [f32; 2] = [0.02, 0.1];
/// Pixels that judge a lean.
const JUDGES: usize = 1000;
/// Irradiance below this is none.
const LEAST_IRRADIANCE: f32 = 1e-12;
/// A visible normal's least cosine toward the camera.
const LEAST_FACING: f32 = 0.05;

fn setting(what: &'static str, value: f32, ok: bool, expected: &'static str) -> Result<(), PhotometricError> {
    if ok { Ok(()) } else { Err(PhotometricError::Setting { what, expected, found: value }) }
}

/// `Err` unless the view can be used.
pub(crate) fn checked(view: &PhotometricView<'_>) -> Result<(), PhotometricError> {
    view.camera.validate()?;
    let k = &view.camera.intrinsics;
    let (width, height) = (k.width as usize, k.height as usize);
    let shape = |what: String, expected: String, found: String| {
        if expected == found { Ok(()) } else { Err(PhotometricError::Shape { what, expected, found }) }
    };
    shape("mask".into(), format!("{width}×{height}"), format!("{}×{}", view.mask.width(), view.mask.height()))?;
    shape("lights".into(), format!("{} lights", view.images.len()), format!("{} lights", view.lights.len()))?;
    if view.images.len() < 3 {
        return Err(PhotometricError::TooFewLights { found: view.images.len() });
    }
    let channels = if view.images[0].channels() == 1 { 1 } else { 3 };
    for (i, image) in view.images.iter().enumerate() {
        let (w, h, c) = image.shape();
        shape(format!("image {i}"), format!("{width}×{height}×{channels}"), format!("{w}×{h}×{c}"))?;
        if let Some(at) = first_non_finite(image) {
            return Err(PhotometricError::NonFinite { what: format!("image {i}"), at });
        }
    }
    for light in view.lights {
        light.validate()?;
    }
    let d = view.distance;
    setting("distance of the object", d, d.is_finite() && d > 0.0, "a finite length above 0")?;
    if !view.mask.data().iter().any(|m| *m >= 0.5) {
        return Err(PhotometricError::EmptyMask);
    }
    Ok(())
}

fn checked_options(o: &PhotometricOptions) -> Result<(), PhotometricError> {
    let lean = o.lean.unwrap_or(0.0);
    setting("lean", lean, (0.0..=2.0).contains(&lean), "0 to 2")?;
    setting("sharpening", o.sharpening, (0.0..=0.9).contains(&o.sharpening), "0 to 0.9")?;
    setting("pull", o.pull, o.pull.is_finite() && o.pull > 0.0, "a finite number above 0")?;
    setting("rounds", o.rounds as f32, (1..=100).contains(&o.rounds), "1 to 100")?;
    setting("anchoring", o.anchoring, (0.0..=1.0).contains(&o.anchoring), "0 to 1")?;
    setting("shadow_doubt", o.shadow_doubt, (0.0..=1.0).contains(&o.shadow_doubt), "0 to 1")
}

/// Where the lights are as seen from each pixel, and what it shows of them: `[pixel · lights + light]`.
struct Incident {
    directions: Vec<Vec3>,
    /// Irradiance of a light that faces the surface, all channels.
    irradiance: Vec<Vec3>,
}

impl Incident {
    fn at(view: &PhotometricView<'_>, pixels: &ObjectPixels, distances: &[f32]) -> Self {
        let centre = view.camera.pose.centre();
        let mut out = Self { directions: Vec::new(), irradiance: Vec::new() };
        for (ray, distance) in pixels.rays.iter().zip(distances) {
            for light in view.lights {
                let incidence = light.incidence(centre + *ray * *distance, view.falloff);
                out.directions.push(incidence.direction);
                out.irradiance.push(incidence.irradiance);
            }
        }
        out
    }
}

/// Estimates normals and depth of a view from how its brightness changes with the light.
///
/// The relief begins as the inflated silhouette ([eq:inflated-silhouette]). In each round the lights are placed as seen from
/// the relief, a normal is fitted to each pixel by a robust wrapped response ([eq:robust-normal]) to the sharpened shading
/// ([eq:sharpened-shading]), pulled a little toward the relief's normals, and a relief is integrated from the normals
/// ([eq:relief-from-normals]); from the second round on lights are doubted where the relief shades them.
///
/// The same bits on any number of threads.
///
/// # Errors
/// Fewer than three images; sizes that differ from the camera's; values that are not finite; an empty mask; images that are
/// black on the object; lights that are all behind it; settings outside their ranges.
pub fn photometric_stereo(
    view: &PhotometricView<'_>,
    options: &PhotometricOptions,
) -> Result<PhotometricStereo, PhotometricError> {
    checked(view)?;
    checked_options(options)?;
    let pixels = ObjectPixels::of(view.camera, view.mask);
    let lights = view.lights.len();
    let mut relief = inflated(&pixels);
    let silhouette_normals = pixels.relief_normals(&relief);
    let mut prior = silhouette_normals.clone();
    let mut normals = prior.clone();
    let mut fitted: Vec<Fitted> = Vec::new();
    let mut channels = Channels { sharp: 0, soft: 0 };
    let mut lights_in_front = 0;
    let (mut lean, mut pull) = (0.0, options.pull);
    for round in 0..options.rounds {
        let distances: Vec<f32> = relief.iter().map(|h| pixels.distance(*h, view.distance)).collect();
        let incident = Incident::at(view, &pixels, &distances);
        let albedo = |p: usize, l: usize, c: usize| {
            let image = view.images[l];
            let e = incident.irradiance[p * lights + l][c];
            if e > LEAST_IRRADIANCE {
                image.data()[pixels.places[p] as usize * image.channels() + c].max(0.0) / e
            } else {
                0.0
            }
        };
        if round == 0 {
            let facing = |l: usize| {
                (0..pixels.len()).map(|p| pixels.frames[p].toward.dot(incident.directions[p * lights + l])).sum::<f32>()
            };
            lights_in_front = (0..lights).filter(|&l| facing(l) > 0.0).count();
            if lights_in_front == 0 {
                return Err(PhotometricError::LightsBehind { lights });
            }
            channels = pick(pixels.len(), lights, view.images[0].channels(), albedo);
        }
        let all = |c: usize| (0..pixels.len()).flat_map(move |p| (0..lights).map(move |l| (p, l, c)));
        let mut middle = medians(|c| all(c).map(|(p, l, c)| albedo(p, l, c)).collect(), channels);
        // Where more than half is black the mean stands for the median.
        for (m, c) in middle.iter_mut().zip([channels.sharp, channels.soft]) {
            if *m <= 0.0 {
                *m = all(c).map(|(p, l, c)| albedo(p, l, c)).sum::<f32>() / (pixels.len() * lights) as f32;
            }
        }
        if !(middle[0] > 0.0 && middle[1] > 0.0 && middle.iter().all(|m| m.is_finite())) {
            return Err(PhotometricError::Dark);
        }
        let share = if channels.sharp == channels.soft { 0.0 } else { options.sharpening };
        let occluder =
            (round > 0 && options.shadow_doubt > 0.0).then(|| Occluder::new(&pixels, view.camera, &distances));
        let fit = |p: usize, lean: f32, pull: f32| {
            let directions = &incident.directions[p * lights..(p + 1) * lights];
            let toward = pixels.frames[p].toward;
            let leaned: Vec<Vec3> = directions.iter().map(|l| leaned(*l, toward, lean)).collect();
            let brightness: Vec<f32> = (0..lights)
                .map(|l| sharpened(albedo(p, l, channels.sharp), albedo(p, l, channels.soft), middle, share).min(1e6))
                .collect();
            let trust: Vec<f32> = (0..lights)
                .map(|l| match &occluder {
                    _ if incident.irradiance[p * lights + l][channels.sharp] <= LEAST_IRRADIANCE => 0.0,
                    Some(o) if o.shades(p, directions[l]) => 1.0 - options.shadow_doubt,
                    _ => 1.0,
                })
                .collect();
            let shown = Shown { directions: &leaned, brightness: &brightness, trust: &trust };
            let mut found = fit_normal(&shown, normals[p], prior[p], pull);
            // A visible surface faces the camera.
            let turn = (LEAST_FACING - found.normal.dot(toward)).max(0.0);
            found.normal = (found.normal + toward * turn).try_normalize().unwrap_or(toward);
            found
        };
        if round == 0 {
            // A subset that is spread evenly says as much.
            let stride = pixels.len().div_ceil(JUDGES);
            let residual = |lean: f32| {
                let judges = pixels.len().div_ceil(stride);
                median(&mut map_pixels(judges, |k| fit(k * stride, lean, options.pull).residual))
            };
            let mut noise = FEW_LIGHTS_NOISE;
            lean = options.lean.unwrap_or(FEW_LIGHTS_LEAN);
            if lights >= ENOUGH_LIGHTS {
                let candidates = match options.lean {
                    Some(lean) => vec![lean],
                    None => LEANS.to_vec(),
                };
                let mut least = f32::INFINITY;
                for candidate in candidates {
                    let found = residual(candidate);
                    if found < least {
                        (lean, least) = (candidate, found);
                    }
                }
                noise = (least * (lights as f32 / (lights - 3) as f32).sqrt()).clamp(NOISE[0], NOISE[1]);
            }
            pull = options.pull * (noise / FEW_LIGHTS_NOISE).powi(2);
        }
        fitted = map_pixels(pixels.len(), |p| fit(p, lean, pull));
        normals = fitted.iter().map(|f| f.normal).collect();
        relief = integrated(&pixels, &normals, &relief, options.anchoring);
        prior = pixels.relief_normals(&relief);
    }
    let smooth = smoothed(&pixels, &normals);
    let confidence = (0..pixels.len())
        .map(|i| Doubts::of(&fitted[i], lights, smooth[i], prior[i], silhouette_normals[i]).confidence());
    let confidence = pixels.map(confidence);
    let mut residuals: Vec<f32> = fitted.iter().map(|f| f.residual).collect();
    Ok(PhotometricStereo {
        normals: pixels.vector_map(&smooth),
        confidence,
        depth: pixels.map(relief.iter().zip(&pixels.cosines).map(|(h, c)| pixels.distance(*h, view.distance) * c)),
        channels,
        lights_in_front,
        lean,
        residual: median(&mut residuals),
    })
}

/// The normals that silhouettes alone suggest ([eq:inflated-silhouette]): world, 0 off the object. For comparison, and for
/// views that have too few lights.
///
/// # Errors
/// A mask of another size than the camera's; an empty one.
pub fn silhouette_normals(camera: &Camera, mask: &Mask) -> Result<Image, PhotometricError> {
    camera.validate()?;
    let k = &camera.intrinsics;
    if (mask.width(), mask.height()) != (k.width as usize, k.height as usize) {
        return Err(PhotometricError::Shape {
            what: "mask".into(),
            expected: format!("{}×{}", k.width, k.height),
            found: format!("{}×{}", mask.width(), mask.height()),
        });
    }
    let pixels = ObjectPixels::of(camera, mask);
    if pixels.len() == 0 {
        return Err(PhotometricError::EmptyMask);
    }
    Ok(pixels.vector_map(&pixels.relief_normals(&inflated(&pixels))))
}

/// Weights of a pixel's sides and corners: a Gaussian of 0.7 pixels.
const SIDE: f32 = 0.36;
const CORNER: f32 = 0.13;

/// Normals averaged a little over the neighbours on the object.
fn smoothed(pixels: &ObjectPixels, normals: &[Vec3]) -> Vec<Vec3> {
    (0..pixels.len())
        .map(|i| {
            let (x, y) = (pixels.places[i] as usize % pixels.width, pixels.places[i] as usize / pixels.width);
            let mut sum = Vec3::ZERO;
            for ny in y.saturating_sub(1)..(y + 2).min(pixels.height) {
                for nx in x.saturating_sub(1)..(x + 2).min(pixels.width) {
                    let number = pixels.numbers[ny * pixels.width + nx];
                    if number != NONE {
                        let weight = match (nx == x, ny == y) {
                            (true, true) => 1.0,
                            (false, false) => CORNER,
                            _ => SIDE,
                        };
                        sum += normals[number as usize] * weight;
                    }
                }
            }
            sum.try_normalize().unwrap_or(normals[i])
        })
        .collect()
}
