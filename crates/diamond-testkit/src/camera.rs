//! Oracles of the pinhole camera: projection, unprojection and ray coordinates, term by term in any [`Real`].
//!
//! A camera is its pinhole numbers `[fx, fy, cx, cy]`, its row-major rotation from world to camera axes and its
//! translation, all of them `R`, so that derivatives with respect to the camera itself are to be had as well.
use crate::Real;

/// World point → camera coordinates: `rotation · world + translation`.
pub fn to_camera<R: Real>(rotation: [[R; 3]; 3], translation: [R; 3], world: [R; 3]) -> [R; 3] {
    [0, 1, 2].map(|i| {
        let mut sum = translation[i];
        for j in 0..3 {
            sum += rotation[i][j] * world[j];
        }
        sum
    })
}

/// Camera coordinates → world point: `rotationᵀ · (camera − translation)`.
pub fn to_world<R: Real>(rotation: [[R; 3]; 3], translation: [R; 3], camera: [R; 3]) -> [R; 3] {
    [0, 1, 2].map(|j| {
        let mut sum = R::of(0.0);
        for i in 0..3 {
            sum += rotation[i][j] * (camera[i] - translation[i]);
        }
        sum
    })
}

/// π: `[u, v, z]` of a world point, without any guard (z must be positive).
pub fn project<R: Real>(pinhole: [R; 4], rotation: [[R; 3]; 3], translation: [R; 3], world: [R; 3]) -> [R; 3] {
    let [fx, fy, cx, cy] = pinhole;
    let [x, y, z] = to_camera(rotation, translation, world);
    [fx * x / z + cx, fy * y / z + cy, z]
}

/// π⁻¹ for a view-space z.
pub fn unproject_z<R: Real>(
    pinhole: [R; 4],
    rotation: [[R; 3]; 3],
    translation: [R; 3],
    pixel: [R; 2],
    z: R,
) -> [R; 3] {
    let [fx, fy, cx, cy] = pinhole;
    to_world(rotation, translation, [(pixel[0] - cx) / fx * z, (pixel[1] - cy) / fy * z, z])
}

/// π⁻¹ for a Euclidean distance from the camera centre.
pub fn unproject_distance<R: Real>(
    pinhole: [R; 4],
    rotation: [[R; 3]; 3],
    translation: [R; 3],
    pixel: [R; 2],
    distance: R,
) -> [R; 3] {
    let [fx, fy, cx, cy] = pinhole;
    let (a, b) = ((pixel[0] - cx) / fx, (pixel[1] - cy) / fy);
    let z = distance / (a * a + b * b + R::of(1.0)).sqrt();
    to_world(rotation, translation, [a * z, b * z, z])
}

/// Plücker coordinates (d, o × d) of the ray through `pixel`: unit direction, then moment about the world origin.
pub fn plucker<R: Real>(pinhole: [R; 4], rotation: [[R; 3]; 3], translation: [R; 3], pixel: [R; 2]) -> [R; 6] {
    let zero = R::of(0.0);
    let o = to_world(rotation, translation, [zero, zero, zero]);
    let p = unproject_distance(pinhole, rotation, translation, pixel, R::of(1.0));
    let d = [p[0] - o[0], p[1] - o[1], p[2] - o[2]];
    let m = [o[1] * d[2] - o[2] * d[1], o[2] * d[0] - o[0] * d[2], o[0] * d[1] - o[1] * d[0]];
    [d[0], d[1], d[2], m[0], m[1], m[2]]
}

#[cfg(test)]
mod tests {
    use super::*;

    const EYE: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

    #[test]
    fn a_point_worked_by_hand() {
        let k = [100.0, 200.0, 32.0, 20.0];
        assert_eq!(project(k, EYE, [0.0, 0.0, 1.0], [0.5, -0.25, 1.0]), [57.0, -5.0, 2.0]);
        assert_eq!(unproject_z(k, EYE, [0.0, 0.0, 1.0], [57.0, -5.0], 2.0), [0.5, -0.25, 1.0]);
        let p = unproject_distance([1.0, 1.0, 0.0, 0.0], EYE, [0.0; 3], [2.0, 2.0], 6.0);
        assert_eq!(p, [4.0, 4.0, 2.0]);
    }

    #[test]
    fn a_line_through_the_origin_has_no_moment() {
        let l = plucker([50.0, 50.0, 10.0, 10.0], EYE, [0.0; 3], [13.0, 4.0]);
        assert!(l[3..].iter().all(|m| m.abs() < 1e-15));
        assert!((l[0] * l[0] + l[1] * l[1] + l[2] * l[2] - 1.0).abs() < 1e-12);
    }
}
