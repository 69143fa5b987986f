//! Where the object is, as far as cameras alone can tell.
use crate::{Capture, View};
use diamond_light::OlatLight;
use glam::{DMat3, DVec3, Vec3};

/// Weight of the world's origin against the optical axes: decides where they leave the centre open (one camera,
/// parallel axes) and is lost in rounding where they do not.
const ORIGIN_WEIGHT: f64 = 1e-6;

/// Lengths shorter than this are treated as no extent at all, scene units.
const MIN_EXTENT: f32 = 1e-6;

/// Estimates of centre and size of the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scene {
    /// The point nearest to all optical axes of the training cameras, world coordinates. With one camera: the point of
    /// its axis nearest to the origin. Never behind the cameras: then it lies in front of them at their mean distance
    /// from the origin.
    pub centre: Vec3,
    /// 1.1 × the largest distance of a training camera from the mean of all, scene units: the unit of position learning
    /// rates. With cameras in one place: their distance from the centre (1 where that is 0 too).
    pub camera_extent: f32,
    /// Radius of the largest sphere round the centre that lies wholly in every training image, scene units, at least
    /// a thousandth of `camera_extent`: the size of the object if the photographer framed it.
    pub framed_radius: f32,
}

impl Capture {
    /// Centre and size of the scene, from the training cameras.
    pub fn scene(&self) -> Scene {
        scene_of(&self.train)
    }

    /// Whether `light` coincides, seen from the centre of the scene and within half a degree, with the light of any
    /// training shot of this capture (of the selection, if this is one).
    pub fn is_seen_light(&self, light: &OlatLight) -> bool {
        let centre = self.scene().centre;
        let direction = light_direction(light, centre);
        let lights = self.train.iter().flat_map(|view| &view.shots).map(|shot| &shot.light);
        lights.map(|seen| light_direction(seen, centre)).any(|seen| angle(seen, direction) < SEEN_ANGLE)
    }
}

/// Half a degree, in radians: less than the spacing of any light stage, more than the rounding of its calibration.
const SEEN_ANGLE: f32 = 0.5 * std::f32::consts::PI / 180.0;

/// Angle between unit vectors in radians, exact for small angles.
fn angle(a: Vec3, b: Vec3) -> f32 {
    2.0 * libm::asinf((0.5 * (a - b).length()).min(1.0))
}

/// Unit direction from `centre` to a light; +z where the light is at the centre.
pub fn light_direction(light: &OlatLight, centre: Vec3) -> Vec3 {
    match *light {
        OlatLight::Point { position, .. } => (position - centre).try_normalize().unwrap_or(Vec3::Z),
        OlatLight::Directional { direction, .. } => direction.try_normalize().unwrap_or(Vec3::Z),
    }
}

fn scene_of(views: &[View]) -> Scene {
    let centres: Vec<Vec3> = views.iter().map(|view| view.camera.pose.centre()).collect();
    // Row 2 of the rotation is the camera's +z axis in world coordinates.
    let axes: Vec<Vec3> = views.iter().map(|view| view.camera.pose.rotation.row(2)).collect();
    let n = centres.len().max(1) as f32;
    let mean = centres.iter().sum::<Vec3>() / n;
    let centre = nearest_to_axes(&centres, &axes).unwrap_or_else(|| {
        let forward = (axes.iter().sum::<Vec3>() / n).try_normalize().unwrap_or(Vec3::Z);
        let distance = centres.iter().map(|c| c.length()).sum::<f32>() / n;
        mean + forward * if distance > MIN_EXTENT { distance } else { 1.0 }
    });
    let spread = centres.iter().map(|c| c.distance(mean)).fold(0.0, f32::max);
    let to_centre = centres.iter().map(|c| c.distance(centre)).fold(0.0, f32::max);
    let camera_extent = match (spread > MIN_EXTENT, to_centre > MIN_EXTENT) {
        (true, _) => 1.1 * spread,
        (false, true) => to_centre,
        (false, false) => 1.0,
    };
    let framed = views.iter().map(|view| framed_radius(view, centre)).fold(f32::INFINITY, f32::min);
    let framed_radius = if framed.is_finite() { framed } else { camera_extent }.max(1e-3 * camera_extent);
    Scene { centre, camera_extent, framed_radius }
}

/// The point with the least sum of squared distances to the axes; `None` where it is behind most cameras.
fn nearest_to_axes(centres: &[Vec3], axes: &[Vec3]) -> Option<Vec3> {
    let mut normal = DMat3::IDENTITY * (ORIGIN_WEIGHT * centres.len().max(1) as f64);
    let mut right = DVec3::ZERO;
    for (centre, axis) in centres.iter().zip(axes) {
        // Unit to rounding in f64, else what is lost in f32 outweighs the origin.
        let d = axis.as_dvec3().normalize_or(DVec3::Z);
        let projector = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        normal += projector;
        right += projector * centre.as_dvec3();
    }
    let point = (normal.inverse() * right).as_vec3();
    let behind = centres.iter().zip(axes).filter(|(c, d)| (point - **c).dot(**d) <= 0.0).count();
    (point.is_finite() && 2 * behind < centres.len().max(1)).then_some(point)
}

/// Radius of the largest sphere round `centre` that a view sees whole: its distance to the nearest side of the frustum.
fn framed_radius(view: &View, centre: Vec3) -> f32 {
    let k = &view.camera.intrinsics;
    let p = view.camera.pose.transform_point(centre);
    // Distance to the plane through the camera and the border `u` pixels from the principal point, inside positive
    // where `inward` is +1 for a left or upper border and -1 for a right or lower one.
    let side = |u: f32, f: f32, along: f32, inward: f32| {
        let slope = u / f;
        inward * (along - slope * p.z) / (1.0 + slope * slope).sqrt()
    };
    [
        side(-k.cx, k.fx, p.x, 1.0),
        side(k.width as f32 - k.cx, k.fx, p.x, -1.0),
        side(-k.cy, k.fy, p.y, 1.0),
        side(k.height as f32 - k.cy, k.fy, p.y, -1.0),
    ]
    .into_iter()
    .fold(f32::INFINITY, f32::min)
}
