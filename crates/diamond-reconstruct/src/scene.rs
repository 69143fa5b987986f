//! What a capture says about the scene before anything is learned: where it is, how large, how bright.
use crate::{Config, IncidentVariant, InitialSource, ReconstructError, error};
use diamond_camera::Camera;
use diamond_dataset::{Capture, Observation};
use diamond_image::Mask;
use diamond_light::{Falloff, OlatLight};
use diamond_splat::{HullConfig, PointCloud, scene_bounds_from_masks, visual_hull};
use diamond_splat_files::SplatFormat;
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Position, size and brightness of the scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scene {
    /// Centre of the object's bounds, world.
    pub centre: [f32; 3],
    /// Half the side of the cube around `centre` that holds the object, scene units.
    pub radius: f32,
    /// Scale of learning rates and size thresholds, scene units: the spread of the cameras, or for a single camera its
    /// distance from the centre.
    pub extent: f32,
    /// Smallest distance from a camera to the centre, scene units.
    pub camera_distance: f32,
    /// Mean distance of the lights from the centre, scene units; 1 where all are directional.
    pub light_distance: f32,
    /// Irradiance of a light of intensity 1 at `light_distance`, chosen so that the brightest parts of the photographs
    /// correspond to a white surface that faces the light.
    pub light_scale: f32,
}

impl Scene {
    /// Centre as a vector.
    pub fn centre(&self) -> Vec3 {
        Vec3::from(self.centre)
    }

    /// Falloff of physical incident light.
    pub fn falloff(&self, config: &Config) -> Falloff {
        let reference = config.shading.incident_reference;
        match config.shading.incident {
            IncidentVariant::InverseSquare => {
                Falloff::InverseSquare { reference: if reference > 0.0 { reference } else { self.light_distance } }
            }
            _ => Falloff::None,
        }
    }

    /// `light` with its intensity multiplied by [`Scene::light_scale`].
    pub fn scaled_light(&self, light: &OlatLight) -> OlatLight {
        match *light {
            OlatLight::Point { position, intensity } => {
                OlatLight::Point { position, intensity: intensity * self.light_scale }
            }
            OlatLight::Directional { direction, irradiance } => {
                OlatLight::Directional { direction, irradiance: irradiance * self.light_scale }
            }
        }
    }
}

/// First positions with normals (zero where unknown).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct InitialPoints {
    /// World positions.
    pub positions: Vec<Vec3>,
    /// Unit outward normals, or zero.
    pub normals: Vec<Vec3>,
    /// Where they came from, for the log.
    pub origin: String,
    /// Shapes and opacities, where the file of points was one of splats.
    pub splats: Option<InitialSplats>,
}

/// First shapes and opacities of a file of splats, one for each point.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct InitialSplats {
    /// Standard deviations, scene units, above 0.
    pub scales: Vec<Vec3>,
    /// Local → world, of unit length.
    pub rotations: Vec<glam::Quat>,
    /// Logits of the opacity.
    pub opacity_logits: Vec<f32>,
}

/// Half the side of the bounds over the largest distance of an initial point from their centre.
const BOUNDS_MARGIN: f32 = 1.1;

fn masks_of(capture: &Capture) -> Result<Vec<(Camera, Mask)>, ReconstructError> {
    let mut out = Vec::new();
    for view in &capture.train {
        if let Some(shot) = view.shots.first()
            && let Some(mask) = &capture.observation(shot)?.mask
        {
            out.push((view.camera, mask.clone()));
        }
    }
    Ok(out)
}

fn from_cloud(cloud: PointCloud, count: usize) -> InitialPoints {
    // An even subset in file order keeps the choice deterministic and spread out.
    let n = cloud.positions.len();
    let keep: Vec<usize> = if n <= count { (0..n).collect() } else { (0..count).map(|i| i * n / count).collect() };
    let normals = match &cloud.normals {
        Some(normals) => keep.iter().map(|&i| normals[i].try_normalize().unwrap_or(Vec3::ZERO)).collect(),
        None => vec![Vec3::ZERO; keep.len()],
    };
    InitialPoints { positions: keep.iter().map(|&i| cloud.positions[i]).collect(), normals, ..Default::default() }
}

/// Opacities of a file are kept this far from certain, as a logit: nothing could be learned of those beyond.
const MAX_INITIAL_LOGIT: f32 = 4.6;

/// Points of a PLY file or of a COLMAP model, or the Gaussians of a splat file of any format.
fn from_file(path: &Path, count: usize) -> Result<InitialPoints, ReconstructError> {
    let unusable = |detail: String| ReconstructError::Unusable { detail };
    if path.extension().is_some_and(|e| e == "bin" || e == "txt") {
        let points = diamond_dataset::read_colmap_points(path)?;
        let colour = |rgb: &[u8; 3]| Vec3::from(rgb.map(|v| f32::from(v) / 255.0));
        let colors = Some(points.colours.iter().map(colour).collect());
        return Ok(from_cloud(PointCloud { positions: points.positions, normals: None, colors }, count));
    }
    let bytes = std::fs::read(path).map_err(|source| ReconstructError::Io {
        path: path.to_owned(),
        action: "read the initial points",
        source,
    })?;
    if bytes.starts_with(b"ply") && !SplatFormat::is_splat_ply(&bytes) {
        let cloud = PointCloud::read(path).map_err(|e| unusable(e.to_string()))?;
        return Ok(from_cloud(cloud, count));
    }
    drop(bytes);
    let cloud = diamond_splat_files::read(path).map_err(|e| unusable(e.to_string()))?.cloud;
    let n = cloud.len();
    // As for points: an even subset in file order.
    let keep: Vec<usize> = if n <= count { (0..n).collect() } else { (0..count).map(|i| i * n / count).collect() };
    let points = PointCloud { positions: cloud.means.clone(), normals: cloud.normals.clone(), colors: None };
    let gaussians = cloud.to_gaussians();
    let splats = InitialSplats {
        scales: keep.iter().map(|&i| gaussians.scales[i]).collect(),
        rotations: keep.iter().map(|&i| gaussians.rotations[i]).collect(),
        opacity_logits: keep
            .iter()
            .map(|&i| cloud.opacity_logits[i].clamp(-MAX_INITIAL_LOGIT, MAX_INITIAL_LOGIT))
            .collect(),
    };
    Ok(InitialPoints { splats: Some(splats), ..from_cloud(points, count) })
}

fn from_hull(capture: &Capture, config: &Config) -> Result<Option<InitialPoints>, ReconstructError> {
    let masks = masks_of(capture)?;
    if masks.is_empty() {
        return Ok(None);
    }
    let cameras: Vec<Camera> = masks.iter().map(|(c, _)| *c).collect();
    let coverage: Vec<&Mask> = masks.iter().map(|(_, m)| m).collect();
    let fail = error::stage("visual hull");
    let Some(bounds) = scene_bounds_from_masks(&cameras, &coverage).map_err(&fail)? else { return Ok(None) };
    let hull_config = HullConfig { resolution: config.initial.hull_resolution, ..Default::default() };
    let hull = visual_hull(&cameras, &coverage, bounds, &hull_config).map_err(&fail)?;
    if hull.points.is_empty() {
        return Ok(None);
    }
    let cloud = PointCloud { positions: hull.points, normals: Some(hull.normals), colors: None };
    let mut points = from_cloud(cloud, config.initial_count());
    points.origin = format!("{} points of the visual hull of {} masks", points.positions.len(), masks.len());
    Ok(Some(points))
}

fn uniform(centre: Vec3, radius: f32, config: &Config) -> InitialPoints {
    let mut random = crate::random::Random::new(config.seed, crate::random::Purpose::Initial, 0);
    let mut draw = || random.uniform() * 2.0 - 1.0;
    let positions: Vec<Vec3> =
        (0..config.initial_count()).map(|_| centre + radius * Vec3::new(draw(), draw(), draw())).collect();
    let normals = positions.iter().map(|p| (*p - centre).try_normalize().unwrap_or(Vec3::Z)).collect();
    InitialPoints { positions, normals, origin: "uniform in the bounds".into(), splats: None }
}

/// Finds the scene and the first points of a capture under a configuration.
pub fn survey(capture: &Capture, config: &Config) -> Result<(Scene, InitialPoints), ReconstructError> {
    let cameras: Vec<Camera> = capture.train.iter().map(|v| v.camera).collect();
    let surveyed = capture.scene();
    let focus = surveyed.centre;
    let unusable = |detail: &str| ReconstructError::Unusable { detail: detail.to_owned() };
    let points = match config.initial.source {
        InitialSource::Uniform => None,
        InitialSource::Points | InitialSource::Auto if capture.points.is_some() => {
            let path = capture.points.as_ref().ok_or_else(|| unusable("no point cloud"))?;
            let mut points = from_file(path, config.initial_count())?;
            let kind = if points.splats.is_some() { "Gaussians" } else { "points" };
            points.origin = format!("{} {kind} of {}", points.positions.len(), path.display());
            (!points.positions.is_empty()).then_some(points)
        }
        InitialSource::Points => {
            return Err(unusable(
                "initial.source = \"points\", but the capture has no points3d.ply; add one, or use \"auto\"",
            ));
        }
        InitialSource::Hull | InitialSource::Auto => from_hull(capture, config)?,
    };
    if points.is_none() && config.initial.source == InitialSource::Hull {
        return Err(unusable("initial.source = \"hull\", but no mask encloses anything; use \"auto\" or \"points\""));
    }
    let nearest = |centre: Vec3| cameras.iter().map(|c| c.pose.centre().distance(centre)).fold(f32::INFINITY, f32::min);
    let points = points.unwrap_or_else(|| {
        // Without any other cue the object is taken to fill half of the frame that all views share.
        uniform(focus, 0.5 * surveyed.framed_radius, config)
    });
    let low = points.positions.iter().copied().reduce(Vec3::min).unwrap_or(Vec3::ZERO);
    let high = points.positions.iter().copied().reduce(Vec3::max).unwrap_or(Vec3::ZERO);
    let centre = 0.5 * (low + high);
    let radius = (0.5 * (high - low).max_element() * BOUNDS_MARGIN).max(1e-6);
    let camera_distance = nearest(centre).max(1e-6);
    let extent = surveyed.camera_extent;

    let mut distance = (0.0f64, 0u32);
    for shot in capture.train.iter().flat_map(|v| &v.shots) {
        if let OlatLight::Point { position, .. } = shot.light {
            distance = (distance.0 + position.distance(centre) as f64, distance.1 + 1);
        }
    }
    let light_distance = if distance.1 > 0 { (distance.0 / distance.1 as f64).max(1e-6) as f32 } else { 1.0 };
    let light_scale = match config.shading.incident {
        IncidentVariant::Learned => 1.0,
        _ => light_scale(capture)?,
    };
    let scene = Scene { centre: centre.to_array(), radius, extent, camera_distance, light_distance, light_scale };
    Ok((scene, points))
}

/// At most this many images are looked at to estimate brightness.
const BRIGHTNESS_IMAGES: usize = 64;
/// The share of foreground values that may be brighter than white: highlights.
const HIGHLIGHT_SHARE: f64 = 0.01;

/// π × the brightness that all but the highlights stay below, per unit of light intensity.
fn light_scale(capture: &Capture) -> Result<f32, ReconstructError> {
    let shots: Vec<_> = capture.train.iter().flat_map(|v| &v.shots).collect();
    let stride = shots.len().div_ceil(BRIGHTNESS_IMAGES).max(1);
    let mut values = Vec::new();
    for shot in shots.iter().step_by(stride) {
        let observation = capture.observation(shot)?;
        let intensity = match shot.light {
            OlatLight::Point { intensity, .. } => intensity,
            OlatLight::Directional { irradiance, .. } => irradiance,
        }
        .max_element()
        .max(1e-6);
        collect_foreground(&observation, intensity, &mut values);
    }
    if values.is_empty() {
        return Ok(std::f32::consts::PI);
    }
    values.sort_unstable_by(f32::total_cmp);
    let bright = values[((values.len() - 1) as f64 * (1.0 - HIGHLIGHT_SHARE)) as usize];
    Ok((std::f32::consts::PI * bright).max(1e-3))
}

fn collect_foreground(observation: &Observation, intensity: f32, values: &mut Vec<f32>) {
    for (i, pixel) in observation.radiance.data().chunks_exact(3).enumerate() {
        let inside = observation.mask.as_ref().is_none_or(|m| m.data()[i] > 0.5);
        let value = pixel[0].max(pixel[1]).max(pixel[2]);
        if inside && value > 0.0 {
            values.push(value / intensity);
        }
    }
}
