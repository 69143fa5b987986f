//! The estimate that everything better is compared with.
use crate::PhotometricError;
use crate::estimate::{PhotometricView, checked};
use crate::object_pixels::ObjectPixels;
use diamond_image::Image;
use glam::{Mat3, Vec3};

/// Share of the lights, the brightest at each pixel, that take part.
const BRIGHTEST: f32 = 0.6;

/// `[eq:naive-photometric-stereo]` Normals by Woodham's least squares, per pixel over the brightest 60 % of the lights (at
/// least three), mean over channels, all pixels taken to lie at the world's origin: world normals, 0 off the object. For
/// comparison only.
///
/// # Errors
/// Those of [`crate::photometric_stereo`].
pub fn naive_normals(view: &PhotometricView<'_>) -> Result<Image, PhotometricError> {
    checked(view)?;
    let pixels = ObjectPixels::of(view.camera, view.mask);
    let directions: Vec<Vec3> = view.lights.iter().map(|l| l.direction_from_origin()).collect();
    let kept = ((BRIGHTEST * directions.len() as f32).round() as usize).max(3);
    let normals: Vec<Vec3> = (0..pixels.len())
        .map(|p| {
            let place = pixels.places[p] as usize;
            let bright = |l: usize| {
                let c = view.images[l].channels();
                view.images[l].data()[place * c..(place + 1) * c].iter().sum::<f32>()
            };
            let mut order: Vec<usize> = (0..directions.len()).collect();
            order.sort_by(|&a, &b| bright(b).total_cmp(&bright(a)));
            let (mut matrix, mut right) = (Mat3::ZERO, Vec3::ZERO);
            for &l in &order[..kept] {
                let d = directions[l];
                matrix += Mat3::from_cols(d * d.x, d * d.y, d * d.z);
                right += d * bright(l);
            }
            // Three lights in a plane would have no answer without it.
            let matrix = matrix + Mat3::from_diagonal(Vec3::splat(1e-6));
            (matrix.inverse() * right).try_normalize().unwrap_or(pixels.frames[p].toward)
        })
        .collect();
    Ok(pixels.vector_map(&normals))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes::Ellipsoid;
    use diamond_image::Image;
    use diamond_light::{Falloff, OlatLight};

    /// [eq:naive-photometric-stereo]: exact where its assumptions hold: distant lights, Lambert, all lights in front.
    #[test]
    fn distant_lights_on_a_matte_body_are_exact() {
        let scene = Ellipsoid::tilted(48);
        let eye = scene.camera.pose.centre().normalize();
        let lights: Vec<OlatLight> = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X]
            .iter()
            .map(|o| OlatLight::directional(eye + 0.2 * *o, Vec3::ONE).unwrap())
            .collect();
        let images: Vec<Image> = lights.iter().map(|l| scene.image(l, Falloff::None, |t, _| t.max(0.0))).collect();
        let images: Vec<&Image> = images.iter().collect();
        let mask = scene.mask();
        let view = PhotometricView {
            camera: &scene.camera,
            mask: &mask,
            images: &images,
            lights: &lights,
            falloff: Falloff::None,
            distance: 3.0,
        };
        let found = naive_normals(&view).unwrap();
        let mut errors: Vec<f32> = scene
            .normals()
            .iter()
            .enumerate()
            .filter_map(|(i, n)| {
                let f = Vec3::from_slice(&found.data()[3 * i..]);
                n.map(|n| f.angle_between(n).to_degrees())
            })
            .collect();
        errors.sort_by(f32::total_cmp);
        assert!(errors[errors.len() / 2] < 0.1, "{}", errors[errors.len() / 2]);
    }
}
