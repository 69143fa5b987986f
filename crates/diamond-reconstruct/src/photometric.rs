//! Normals and depth of single views by photometric stereo, for whoever asks for them: the first normals, a term that
//! supervises normals, and the depth that other views are compared with.
//!
//! A view takes part where it has a mask and at least three photographs, each under a light of its own. What the estimate
//! says of a pixel counts by its confidence; its error is that of a blurred cue (see `diamond_photometric`), so supervision
//! fades out, and the estimate never sees another view.
use crate::scene::InitialPoints;
use crate::{Config, IncidentVariant, ReconstructError, Scene, error};
use diamond_consistency::{AlignmentFit, DepthKind, DepthMap, EstimateForm, align_depth};
use diamond_dataset::{Capture, View};
use diamond_image::Image;
use diamond_light::{Falloff, OlatLight};
use diamond_photometric::{
    PhotometricError, PhotometricOptions, PhotometricStereo, PhotometricView, photometric_stereo,
};
use glam::Vec3;

/// At most so many photographs of a view are looked at, evenly spread over its list.
const MOST_LIGHTS: usize = 32;

/// What photometric stereo says of the view of a training pair.
#[derive(Debug, Clone, Copy)]
pub struct Guide<'a> {
    /// Normals, confidence and depth.
    pub stereo: &'a PhotometricStereo,
    /// Weight of the normal term at this step; 0 for none.
    pub weight: f32,
    /// Whether its depth takes the place of the rendered one where views are compared.
    pub depth: bool,
}

/// The estimate of each training view, `None` where the view cannot be used.
pub(crate) fn estimates(
    capture: &Capture,
    scene: &Scene,
    config: &Config,
) -> Result<Vec<Option<PhotometricStereo>>, ReconstructError> {
    capture.train.iter().map(|view| estimate(capture, view, scene, config)).collect()
}

fn estimate(
    capture: &Capture,
    view: &View,
    scene: &Scene,
    config: &Config,
) -> Result<Option<PhotometricStereo>, ReconstructError> {
    if view.shots.len() < 3 {
        return Ok(None);
    }
    let count = view.shots.len().min(MOST_LIGHTS);
    let shots: Vec<_> = (0..count).map(|i| &view.shots[i * view.shots.len() / count]).collect();
    let observations = shots.iter().map(|s| capture.observation(s)).collect::<Result<Vec<_>, _>>()?;
    let Some(mask) = observations.iter().find_map(|o| o.mask.as_ref()) else { return Ok(None) };
    let images: Vec<&Image> = observations.iter().map(|o| &o.radiance).collect();
    let lights: Vec<OlatLight> = shots.iter().map(|s| s.light).collect();
    // Lights that do not fall off in the model may do so in the world, where they are near.
    let falloff = match config.shading.incident {
        IncidentVariant::Learned => Falloff::InverseSquare { reference: scene.light_distance },
        _ => scene.falloff(config),
    };
    let distance = view.camera.pose.centre().distance(scene.centre());
    let stereo_view =
        PhotometricView { camera: &view.camera, mask, images: &images, lights: &lights, falloff, distance };
    match photometric_stereo(&stereo_view, &PhotometricOptions::default()) {
        Ok(found) => Ok(Some(found)),
        Err(PhotometricError::LightsBehind { .. } | PhotometricError::EmptyMask | PhotometricError::Dark) => Ok(None),
        Err(e) => Err(error::stage("photometric stereo")(e)),
    }
}

/// Cells of the depth buffer along the longer side of a picture: coarse enough that points of a surface leave no holes.
const CELLS: usize = 32;
/// A point may be this far behind the nearest of its cell, × scene radius, and still be seen.
const THICKNESS: f32 = 0.15;
/// Weight of the normal that a point had, where one view with confidence 1 that it faces has weight 1.
const OWN_WEIGHT: f32 = 0.25;

/// Turns the normals of points that views see toward what those views' estimates say; a point is seen by a view that it
/// faces, where nothing is before it. Returns how many were turned.
pub(crate) fn turn_normals(
    points: &mut InitialPoints,
    capture: &Capture,
    estimates: &[Option<PhotometricStereo>],
    scene: &Scene,
) -> usize {
    let mut sums = vec![Vec3::ZERO; points.positions.len()];
    for (view, stereo) in capture.train.iter().zip(estimates) {
        let Some(stereo) = stereo else { continue };
        let (width, height, _) = stereo.normals.shape();
        let side = width.max(height) as f32 / CELLS as f32;
        let mut nearest = vec![f32::INFINITY; (CELLS + 1) * (CELLS + 1)];
        let seen: Vec<Option<(usize, usize, f32)>> = points
            .positions
            .iter()
            .map(|p| {
                let (at, z) = view.camera.project(*p)?;
                if !(at.x >= 0.0 && at.y >= 0.0 && at.x < width as f32 && at.y < height as f32) {
                    return None;
                }
                let cell = (at.y / side) as usize * (CELLS + 1) + (at.x / side) as usize;
                nearest[cell] = nearest[cell].min(z);
                Some((at.y as usize * width + at.x as usize, cell, z))
            })
            .collect();
        let eye = view.camera.pose.centre();
        for (i, seen) in seen.into_iter().enumerate() {
            let Some((pixel, cell, z)) = seen else { continue };
            let outward = match points.normals[i].try_normalize() {
                Some(normal) => normal,
                None => (points.positions[i] - scene.centre()).try_normalize().unwrap_or(Vec3::Z),
            };
            let facing = outward.dot((eye - points.positions[i]).try_normalize().unwrap_or(Vec3::Z));
            if facing > 0.0 && z <= nearest[cell] + THICKNESS * scene.radius {
                let normal = Vec3::from_slice(&stereo.normals.data()[3 * pixel..3 * pixel + 3]);
                sums[i] += normal * (facing * stereo.confidence.data()[pixel]);
            }
        }
    }
    let mut turned = 0;
    for (normal, sum) in points.normals.iter_mut().zip(sums) {
        if sum != Vec3::ZERO {
            *normal = (sum + *normal * OWN_WEIGHT).try_normalize().unwrap_or(*normal);
            turned += 1;
        }
    }
    turned
}

/// `[eq:guided-normal]` Mean over pixels of c·‖n − t‖²/2 between rendered normals n and estimated ones t with confidence c, and
/// its gradient c·(n − t)/pixels.
pub(crate) fn guided_normal(rendered: &Image, target: &Image, confidence: &Image) -> (f32, Image) {
    let (width, height, _) = rendered.shape();
    let mut grad = Image::new(width, height, 3);
    let share = 1.0 / (width * height).max(1) as f32;
    let mut sum = 0f64;
    for (i, c) in confidence.data().iter().enumerate() {
        for k in 3 * i..3 * i + 3 {
            let gap = rendered.data()[k] - target.data()[k];
            sum += f64::from(0.5 * c * gap * gap);
            grad.data_mut()[k] = c * gap * share;
        }
    }
    ((sum * f64::from(share)) as f32, grad)
}

/// The estimate's depth, brought to the scale of a rendered one by what both say where the estimate is confident; `None`
/// where it cannot be.
pub(crate) fn aligned_depth(stereo: &PhotometricStereo, depth: &Image, opacity: &Image) -> Option<DepthMap> {
    let mut reference = DepthMap { kind: DepthKind::Z, values: depth.clone() };
    for (z, o) in reference.values.data_mut().iter_mut().zip(opacity.data()) {
        *z = if *o > 0.5 { *z / *o } else { 0.0 };
    }
    // Off the object nothing is known, which an estimate says by NaN.
    let estimate = stereo.depth.map(|z| if z > 0.0 { z } else { f32::NAN });
    let weight = Some(&stereo.confidence);
    let (aligned, how) = align_depth(&estimate, EstimateForm::Depth, &reference, weight, AlignmentFit::Robust).ok()?;
    (how.scale > 0.0).then_some(aligned)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CaptureFacts, Needs};
    use diamond_dataset::{OpenOptions, Selection};
    use diamond_testkit::{Dual, Real, gradient};

    /// [eq:guided-normal]: value and gradient against dual numbers.
    #[test]
    fn the_term_agrees_with_dual_numbers() {
        let values = |seed: usize, n: usize| -> Vec<f32> {
            (0..n).map(|i| ((i * 37 + seed) % 23) as f32 / 11.5 - 1.0).collect()
        };
        let image = |seed, c| Image::from_vec(3, 2, c, values(seed, 6 * c)).unwrap();
        let (n, t, c) = (image(3, 3), image(8, 3), image(5, 1).map(f32::abs));
        let (value, grad) = guided_normal(&n, &t, &c);
        let wide: Vec<f64> = n.data().iter().map(|v| f64::from(*v)).collect();
        let oracle = |x: &[Dual]| {
            (0..18).fold(Dual::of(0.0), |sum, k| {
                let gap = x[k] - Dual::of(f64::from(t.data()[k]));
                sum + Dual::of(f64::from(c.data()[k / 3]) / 12.0) * gap * gap
            })
        };
        let constant: Vec<Dual> = wide.iter().map(|v| Dual::of(*v)).collect();
        assert!((f64::from(value) - oracle(&constant).v).abs() < 1e-6);
        for (a, b) in grad.data().iter().zip(gradient(oracle, &wide)) {
            assert!((f64::from(*a) - b).abs() < 1e-6);
        }
    }

    fn candle(lights: usize) -> Capture {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/captures/candle-small");
        Capture::open(folder.as_ref(), &OpenOptions::default())
            .and_then(|c| c.select(&Selection::Count(3), &Selection::Count(lights)))
            .unwrap()
    }

    /// Normals of a hull of three masks come nearer to the truth where a view sees them; views with two lights say nothing.
    #[test]
    fn first_normals_come_nearer_to_the_truth() {
        let config = Config::preset("resolved").unwrap();
        let capture = candle(6);
        let (scene, mut points) = crate::scene::survey(&capture, &config).unwrap();
        let found = estimates(&capture, &scene, &config).unwrap();
        assert!(found.iter().all(Option::is_some));
        // Points from the file have no normals: outward.
        let before: Vec<Vec3> = points
            .positions
            .iter()
            .zip(&points.normals)
            .map(|(p, n)| n.try_normalize().unwrap_or((*p - scene.centre()).normalize()))
            .collect();
        points.normals = before.clone();
        let turned = turn_normals(&mut points, &capture, &found, &scene);
        let truth = capture.train[0].ground_truth_geometry().unwrap().unwrap();
        let errors = |normals: &[Vec3]| {
            let mut errors = Vec::new();
            for (p, n) in points.positions.iter().zip(normals) {
                if let Some((at, z)) = capture.train[0].camera.project(*p) {
                    let (x, y) = (at.x as usize, at.y as usize);
                    let t = Vec3::from_slice(truth.normal.pixel(x, y));
                    if t.length() > 0.5 && (truth.depth.pixel(x, y)[0] - z).abs() < 0.05 {
                        errors.push(n.angle_between(t).to_degrees());
                    }
                }
            }
            errors.sort_by(f32::total_cmp);
            errors[errors.len() / 2]
        };
        let (was, is) = (errors(&before), errors(&points.normals));
        println!("{turned} of {} normals turned: {was:.1}° to {is:.1}°", points.positions.len());
        assert!(turned > 100 && is < 0.8 * was, "{was} {is}");
        let two = candle(2);
        assert!(estimates(&two, &scene, &config).unwrap().iter().all(Option::is_none));
    }

    #[test]
    fn depth_takes_the_scale_of_what_was_rendered() {
        let config = Config::preset("resolved").unwrap();
        let capture = candle(6);
        let (scene, _) = crate::scene::survey(&capture, &config).unwrap();
        let found = estimates(&capture, &scene, &config).unwrap();
        let truth = capture.train[0].ground_truth_geometry().unwrap().unwrap();
        let opacity = truth.depth.map(|z| if z > 0.0 { 1.0 } else { 0.0 });
        let aligned = aligned_depth(found[0].as_ref().unwrap(), &truth.depth, &opacity).unwrap();
        let mut gaps: Vec<f32> = (0..aligned.values.data().len())
            .filter(|&i| opacity.data()[i] > 0.0 && aligned.values.data()[i] > 0.0)
            .map(|i| (aligned.values.data()[i] - truth.depth.data()[i]).abs())
            .collect();
        gaps.sort_by(f32::total_cmp);
        assert!(gaps[gaps.len() / 2] < 0.08, "{} of a body of size 2", gaps[gaps.len() / 2]);
        assert!(aligned_depth(found[0].as_ref().unwrap(), &truth.depth, &truth.depth.map(|_| 0.0)).is_none());
    }

    /// A use is left out, with the reason, where no view has three photographs, and where it would have nothing to do.
    #[test]
    fn what_cannot_be_used_is_left_out() {
        let mut config = Config::preset("resolved").unwrap();
        config.subsurface.model = crate::SubsurfaceModel::Mlp;
        config.photometric = crate::Photometric { initial: true, supervise: 0.1, until: 0.5, depth: true };
        let facts = |most_view_images| CaptureFacts { views: 3, most_view_images, ..Default::default() };
        let two = Needs::decide(&config, &facts(2));
        for decision in [&two.guided_normal, &two.guided_start] {
            assert!(!decision.needed && decision.reason.contains("three photographs"), "{decision:?}");
        }
        let three = Needs::decide(&config, &facts(3));
        assert!(three.guided_normal.needed && three.guided_start.needed);
        assert!(!three.guided_depth.needed && three.guided_depth.reason.contains("no depths are compared"));
        config.loss.depth_consistency = 0.1;
        assert!(Needs::decide(&config, &facts(3)).guided_depth.needed);
        let plain = Needs::decide(&Config::preset("paper").unwrap(), &facts(9));
        assert!(!plain.guided_normal.needed && !plain.guided_start.needed && !plain.guided_depth.needed);
    }
}
