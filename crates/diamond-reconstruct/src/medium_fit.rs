//! The surface and the medium of a model as it stands, from its shape and from the photographs.
//!
//! Points of the surface come from the depth of the training views, where they are opaque; where no view sees, the Gaussians themselves stand in, with
//! little weight. Silhouettes come from the masks. See [`diamond_medium::carve`].
use crate::medium_term::{MediumTerm, TINT};
use crate::{Config, InitialSource, Model, ReconstructError, Renderer, error};
use diamond_dataset::{Capture, Observation, Shot, View};
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_medium::{
    CarveOptions, FitImage, FitOptions, FitPhotograph, Medium, MediumError, OrientedPoint, Prior, PriorOptions,
    Silhouette, Surface, carve, fit_profile, fit_walk, hull_bounds, outward_normals,
};
use diamond_pathtrace::RepairOptions;
use diamond_shading::pseudo_normals;
use diamond_splat::mean_squared_distance_to_nearest;
use glam::{Vec2, Vec3};
use std::path::Path;
use std::sync::Arc;

/// Views from which the surface is looked at, at most.
const SHAPE_VIEWS: usize = 48;
/// Points from all views together, at most about.
const SHAPE_POINTS: usize = 200_000;
/// Opacity above which a pixel shows the surface.
const OPAQUE: f32 = 0.7;
/// Weight of a Gaussian that no view shows, beside a pixel that shows the surface.
const HIDDEN_WEIGHT: f32 = 1e-3;
/// Photographs that a medium is fitted to, at most.
const FIT_IMAGES: usize = 64;

fn spread<T>(all: &[T], most: usize) -> impl Iterator<Item = &T> {
    let n = all.len();
    let count = n.min(most);
    (0..count).map(move |k| &all[k * n / count])
}

/// Standard deviation of the weight of a point of the cloud, distances between points.
const POINT_SMOOTHING: f32 = 1.5;
/// Weight of a pixel that shows the surface beside a point of the capture's own cloud.
const PIXEL_WEIGHT: f32 = 0.03;

/// The capture's own points with their normals, if it has such; and the mean distance between them.
fn cloud(capture: &Capture, config: &Config) -> Result<(Vec<OrientedPoint>, f32), ReconstructError> {
    let wanted = matches!(config.initial.source, InitialSource::Auto | InitialSource::Points);
    if !wanted || capture.points.is_none() {
        return Ok((Vec::new(), 0.0));
    }
    let (_, points) = crate::survey(capture, config)?;
    if points.splats.is_some() {
        return Ok((Vec::new(), 0.0));
    }
    let computed;
    let normals = match points.normals.iter().any(|n| n.is_normalized()) {
        true => &points.normals,
        false => {
            computed = outward_normals(&points.positions);
            &computed
        }
    };
    let each = points.positions.iter().zip(normals).filter(|(_, n)| n.is_normalized());
    let out: Vec<OrientedPoint> = each.map(|(p, n)| OrientedPoint { position: *p, normal: *n, weight: 1.0 }).collect();
    let positions: Vec<Vec3> = out.iter().map(|p| p.position).collect();
    let squares = mean_squared_distance_to_nearest(&positions, 3);
    let spacing = (squares.iter().sum::<f32>() / squares.len().max(1) as f32).sqrt();
    Ok((out, spacing))
}

/// The surface of a model, as the training views show it.
pub fn surface_of(model: &Model, capture: &Capture) -> Result<Surface, ReconstructError> {
    if let Some(path) = &model.config.subsurface.surface {
        // An absolute path stays what it is.
        let beside = capture.root.join(path);
        return given(if beside.exists() { &beside } else { path }, model.config.subsurface.surfels);
    }
    let renderer = Renderer::new(model);
    let views: Vec<&View> = spread(&capture.train, SHAPE_VIEWS).collect();
    let (mut points, spacing) = cloud(capture, &model.config)?;
    let pixel_weight = if points.is_empty() { 1.0 } else { PIXEL_WEIGHT };
    let mut silhouettes = Vec::new();
    for view in &views {
        let camera = &view.camera;
        let shape = renderer.shape(camera)?;
        let (w, h, _) = shape.opacity.shape();
        let each = shape.depth.data().iter().zip(shape.opacity.data());
        let depth: Vec<f32> = each.map(|(d, o)| if *o > 0.0 { d / o } else { 0.0 }).collect();
        let depth = Image::from_vec(w, h, 1, depth).map_err(error::stage("surface"))?;
        let (normals, _) = pseudo_normals(camera, &depth, &shape.opacity).map_err(error::stage("surface"))?;
        let shown = shape.opacity.data().iter().filter(|o| **o >= OPAQUE).count();
        let stride = ((shown * views.len()) as f32 / SHAPE_POINTS as f32).sqrt().ceil().max(1.0) as usize;
        for y in (0..h).step_by(stride) {
            for x in (0..w).step_by(stride) {
                let Some(normal) = Vec3::from_slice(normals.pixel(x, y)).try_normalize() else { continue };
                if shape.opacity.pixel(x, y)[0] < OPAQUE {
                    continue;
                }
                let pixel = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
                let position = camera.unproject(pixel, diamond_camera::Depth::Z(depth.pixel(x, y)[0]));
                let toward = (camera.pose.centre() - position).normalize_or_zero();
                // Grazing pixels know the depth badly.
                let weight = normal.dot(toward).max(0.0).powi(2);
                if weight > 0.01 && position.is_finite() {
                    points.push(OrientedPoint { position, normal, weight: pixel_weight * weight });
                }
            }
        }
        if let Some(shot) = view.shots.first()
            && let Some(mask) = &capture.observation(shot)?.mask
        {
            silhouettes.push(Silhouette::new(*camera, mask));
        }
    }
    let activated = model.parameters.activate();
    let g = &activated.gaussians;
    for i in 0..g.means.len() {
        let (position, normal) = (g.means[i], activated.normals[i]);
        if position.is_finite() && normal.is_normalized() {
            points.push(OrientedPoint { position, normal, weight: pixel_weight * HIDDEN_WEIGHT });
        }
    }
    let (centre, reach) = (model.scene.centre(), 1.5 * model.scene.radius);
    let mut bounds = (centre - reach, centre + reach);
    if !silhouettes.is_empty()
        && let Some((low, high)) = hull_bounds(&silhouettes, centre, reach * 1.2)
    {
        bounds = (bounds.0.max(low), bounds.1.min(high));
    }
    let settings = &model.config.subsurface;
    let options = CarveOptions {
        resolution: settings.resolution,
        smoothing: settings.smoothing,
        surfels: settings.surfels,
        least_width: POINT_SMOOTHING * spacing,
        match_silhouettes: true,
    };
    carve(&points, &silhouettes, bounds, &options).map_err(|e| ReconstructError::Unusable { detail: e.to_string() })
}

/// The surface of a mesh file.
fn given(path: &Path, surfels: usize) -> Result<Surface, ReconstructError> {
    let fail = |detail: String| ReconstructError::Unusable { detail: format!("subsurface.surface: {detail}") };
    let mesh = match path.extension().is_some_and(|e| e.eq_ignore_ascii_case("obj")) {
        true => diamond_pathtrace::read_obj(path),
        false => diamond_pathtrace::read_ply(path),
    };
    let repaired = mesh.and_then(|m| m.repair(&RepairOptions::default())).map_err(|e| fail(e.to_string()))?;
    Surface::new(repaired.0, surfels).map_err(|e| fail(e.to_string()))
}

/// A photograph that a medium is compared with.
struct Taken<'a> {
    view: &'a View,
    shot: &'a Shot,
    /// Times the photograph's gain: light is linear.
    light: OlatLight,
}

impl<'a> Taken<'a> {
    /// Training photographs, spread over all of them, each under its gain so far.
    fn of(model: &Model, capture: &'a Capture) -> Vec<Self> {
        let views = capture.train.iter().enumerate();
        let shots: Vec<(usize, &View, &Shot)> =
            views.flat_map(|(v, view)| view.shots.iter().map(move |s| (v, view, s))).collect();
        let numbered: Vec<_> = shots.into_iter().enumerate().collect();
        let chosen = spread(&numbered, FIT_IMAGES);
        chosen
            .map(|&(image, (v, view, shot))| {
                let gain = model.exposure.index(model.config.exposure.mode, v, image);
                Self { view, shot, light: shot.light.scaled(gain.map_or(Vec3::ONE, |i| model.exposure.gain(i))) }
            })
            .collect()
    }

    /// What it shows, with a factor on what leaves the medium where there is one.
    fn image(&'a self, observation: &'a Observation, tint: Option<&'a Image>) -> FitImage<'a> {
        FitImage {
            camera: &self.view.camera,
            light: &self.light,
            radiance: &observation.radiance,
            mask: observation.mask.as_ref(),
            tint,
            known: None,
        }
    }
}

/// Fits a medium within `surface` to the training photographs, each under its gain so far.
pub fn medium_of(model: &Model, capture: &Capture, surface: &Surface) -> Result<Medium, ReconstructError> {
    let chosen = Taken::of(model, capture);
    let options = FitOptions {
        widths: model.config.subsurface.widths,
        falloff: model.scene.falloff(&model.config),
        unit: model.scene.light_scale,
        ..FitOptions::default()
    };
    let unusable = |e: MediumError| ReconstructError::Unusable { detail: e.to_string() };
    let mut seen: Vec<FitPhotograph> = Vec::with_capacity(chosen.len());
    let mut tint = None;
    for (i, taken) in chosen.iter().enumerate() {
        // Neighbouring photographs of one view share what its tints look like.
        if model.medium.is_some() && (i == 0 || !std::ptr::eq(taken.view, chosen[i - 1].view)) {
            tint = Some(tint_map(model, taken)?);
        }
        let observation = capture.observation(taken.shot)?;
        let image = taken.image(&observation, tint.as_ref());
        seen.push(options.sample(surface, &image, chosen.len()).map_err(unusable)?);
    }
    let fit = if model.config.subsurface.model.walks() { fit_walk } else { fit_profile };
    fit(surface, &seen, &options).map_err(unusable)
}

/// The physical prior as a source of pictures: a surface with a medium, and its error on the training photographs.
pub(crate) fn prior_of(
    model: &Model,
    capture: &Capture,
    surface: Surface,
    medium: Medium,
) -> Result<Prior, ReconstructError> {
    let settings = &model.config.augmentation;
    let options = PriorOptions { half_error: settings.half_error, ..PriorOptions::default() };
    let (chosen, falloff) = (Taken::of(model, capture), model.scene.falloff(&model.config));
    let observations: Vec<Arc<Observation>> =
        chosen.iter().map(|taken| capture.observation(taken.shot)).collect::<Result<_, _>>()?;
    let images: Vec<FitImage<'_>> = chosen.iter().zip(&observations).map(|(t, o)| t.image(o, None)).collect();
    Prior::new(surface, medium, falloff, &images, options)
        .map_err(|e| ReconstructError::Unusable { detail: e.to_string() })
}

/// Tints as a view shows them.
fn tint_map(model: &Model, taken: &Taken<'_>) -> Result<Image, ReconstructError> {
    let rendering = Renderer::new(model).renderings(&taken.view.camera, &[taken.light])?;
    Ok(rendering[0].maps.base_color.map(|v| TINT * v))
}

/// Surface and medium of a model as it stands; `Unusable` where there is no surface, or light in the object is not what a medium of this kind explains.
pub(crate) fn surface_and_medium(model: &Model, capture: &Capture) -> Result<(Surface, Medium), ReconstructError> {
    let surface = surface_of(model, capture)?;
    let medium = medium_of(model, capture, &surface)?;
    match medium.unfit() {
        Some(detail) => Err(ReconstructError::Unusable { detail }),
        None => Ok((surface, medium)),
    }
}

/// Surface and medium of a model as it stands, ready to be adopted; see [`Medium::unfit`] for what is refused.
pub fn fit_medium(model: &Model, capture: &Capture) -> Result<MediumTerm, ReconstructError> {
    let (surface, medium) = surface_and_medium(model, capture)?;
    let activated = model.parameters.activate();
    let falloff = model.scene.falloff(&model.config);
    MediumTerm::new(surface, medium, falloff, &activated.gaussians.means, &activated.normals)
}
