//! A target camera as seen from a source camera, as a map of numbers that a network can read.
use crate::error::{DiffusionError, Result};
use crate::unet::RAY_CHANNELS;
use candle_core::{Device, Tensor};
use diamond_camera::{Camera, Pose, plucker_map};
use glam::Vec3;

/// Sines and cosines of each number, at frequencies π·2^k.
const FREQUENCIES: usize = 6;

/// Distance of the source camera from the object's centre after the rig is rescaled.
const SOURCE_DISTANCE: f32 = 2.0;

/// The target camera in the axes of the source camera (x right, y down, z ahead), lengths scaled so that the source's centre is
/// 2 away from `object`, a point in the world.
pub fn relative_camera(source: &Camera, target: &Camera, object: Vec3) -> Result<Camera> {
    let distance = (source.pose.centre() - object).length();
    if !(distance.is_finite() && distance > 0.0) {
        let expected = "at some distance from the object's centre";
        return Err(DiffusionError::setting("source camera", expected, distance));
    }
    let rotation = target.pose.rotation * source.pose.rotation.transpose();
    let translation = target.pose.translation - rotation * source.pose.translation;
    let pose = Pose { rotation, translation: translation * (SOURCE_DISTANCE / distance) };
    Ok(Camera { intrinsics: target.intrinsics, pose })
}

/// 78 numbers of a ray: sin(π·2^k·p) for each of the six Plücker coordinates and k = 0 to 5, all cosines, the coordinates.
/// `[eq:ray-embedding]`
pub fn ray_embedding(ray: [f32; 6]) -> [f32; RAY_CHANNELS] {
    let mut out = [0.0; RAY_CHANNELS];
    for (i, p) in ray.into_iter().enumerate() {
        for k in 0..FREQUENCIES {
            let (sin, cos) = libm::sincosf(std::f32::consts::PI * (1 << k) as f32 * p);
            out[i * FREQUENCIES + k] = sin;
            out[(6 + i) * FREQUENCIES + k] = cos;
        }
        out[12 * FREQUENCIES + i] = p;
    }
    out
}

/// The ray map (1, 78, height, width) of a target camera relative to a source camera, on a grid of latents: pixel centres at +½.
pub fn ray_map(source: &Camera, target: &Camera, object: Vec3, width: u32, height: u32) -> Result<Tensor> {
    if width == 0 || height == 0 {
        return Err(DiffusionError::setting("size of a ray map", "at least 1 × 1", format!("{width} × {height}")));
    }
    let camera = relative_camera(source, target, object)?.resized(width, height);
    let rays: Vec<[f32; RAY_CHANNELS]> = plucker_map(&camera).into_iter().map(ray_embedding).collect();
    let planes: Vec<f32> = (0..RAY_CHANNELS).flat_map(|c| rays.iter().map(move |ray| ray[c])).collect();
    Ok(Tensor::from_vec(planes, (1, RAY_CHANNELS, height as usize, width as usize), &Device::Cpu)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_camera::Intrinsics;
    use glam::Vec2;

    fn camera(eye: Vec3) -> Camera {
        let pose = Pose::look_at(eye, Vec3::new(1.0, 0.0, 0.0), Vec3::NEG_Y);
        Camera { intrinsics: Intrinsics::from_fov_x(0.8, 64, 64), pose }
    }

    /// The source looks along +z from four units away, the target along −x from four units on the side: by hand, the target's centre is
    /// at (2, 0, 2) in the source's axes, and its moment (2, 0, 2) × (−1, 0, 0) = (0, −2, 0).
    #[test]
    fn a_camera_on_the_side_has_the_coordinates_by_hand() {
        let (source, target) = (camera(Vec3::new(1.0, 0.0, -4.0)), camera(Vec3::new(5.0, 0.0, 0.0)));
        let object = Vec3::new(1.0, 0.0, 0.0);
        let relative = relative_camera(&source, &target, object).unwrap();
        assert!((relative.pose.centre() - Vec3::new(2.0, 0.0, 2.0)).length() < 1e-5);
        let middle = relative.plucker(Vec2::splat(32.0));
        for (a, b) in middle.into_iter().zip([-1.0, 0.0, 0.0, 0.0, -2.0, 0.0]) {
            assert!((a - b).abs() < 1e-5, "{middle:?}");
        }
        // The source itself: at the origin, without a moment.
        let own = relative_camera(&source, &source, object).unwrap().plucker(Vec2::new(3.0, 50.0));
        assert!(own[3..].iter().all(|m| m.abs() < 1e-5));
        assert!(relative_camera(&source, &target, source.pose.centre()).is_err());
        let map = ray_map(&source, &target, object, 8, 6).unwrap();
        assert_eq!(map.dims(), [1, 78, 6, 8]);
        let last = relative.resized(8, 6).plucker(Vec2::new(7.5, 5.5));
        let stored: Vec<f32> = (0..78)
            .map(|c| map.get(0).unwrap().get(c).unwrap().get(5).unwrap().get(7).unwrap().to_scalar().unwrap())
            .collect();
        assert_eq!(stored, ray_embedding(last));
        assert!(ray_map(&source, &target, object, 0, 6).is_err());
    }

    /// [eq:ray-embedding]
    #[test]
    fn the_embedding_has_the_values_by_hand() {
        let e = ray_embedding([0.25, 0.5, 0.0, 0.0, 0.0, -2.0]);
        let root = std::f32::consts::FRAC_1_SQRT_2;
        // sin(π/4), sin(π/2), sin(π); cosines behind all 36 sines; sin(π/2) of the second coordinate.
        for (i, expected) in [(0, root), (1, 1.0), (2, 0.0), (36, root), (37, 0.0), (38, -1.0), (6, 1.0), (42, 0.0)] {
            assert!((e[i] - expected).abs() < 1e-5, "{i}: {}", e[i]);
        }
        assert_eq!(e[72..], [0.25, 0.5, 0.0, 0.0, 0.0, -2.0]);
        assert!((e[5] - libm::sinf(8.0 * std::f32::consts::PI)).abs() < 1e-4);
    }
}
