//! A light's direction as nine numbers.
use crate::error::{DiffusionError, Result};
use crate::unet::LIGHT_CHANNELS;
use candle_core::{Device, Tensor};
use diamond_camera::Pose;
use diamond_light::spherical_harmonics::basis;
use glam::Vec3;

/// Real spherical harmonics of bands 0 to 2 of the direction to a light, in the axes of a viewer: x right, y *up*, z toward the
/// viewer (not this workspace's camera axes).
/// `[eq:light-code]`
pub fn light_code(direction: Vec3, pose: &Pose) -> Result<[f32; LIGHT_CHANNELS]> {
    let d = pose.rotation * direction;
    let length = d.length();
    if !(length.is_finite() && length > 0.0) {
        return Err(DiffusionError::setting("direction to a light", "a finite vector, not zero", direction));
    }
    let all = basis(Vec3::new(d.x, -d.y, -d.z) / length);
    let mut code = [0.0; LIGHT_CHANNELS];
    code.copy_from_slice(&all[..LIGHT_CHANNELS]);
    Ok(code)
}

/// Codes of several lights of one view, (lights, 9).
pub fn light_codes(directions: &[Vec3], pose: &Pose) -> Result<Tensor> {
    let codes = directions.iter().map(|d| light_code(*d, pose)).collect::<Result<Vec<_>>>()?;
    Ok(Tensor::from_vec(codes.concat(), (directions.len(), LIGHT_CHANNELS), &Device::Cpu)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Mat3;

    /// [eq:light-code]: the published constants, in viewer's axes.
    #[test]
    fn codes_have_the_published_constants_in_viewers_axes() {
        let pose = Pose { rotation: Mat3::IDENTITY, translation: Vec3::new(1.0, 2.0, 3.0) };
        let camera = Vec3::new(0.6, -0.48, -0.64);
        let (x, y, z) = (0.6, 0.48, 0.64);
        let expected = [
            0.2820948,
            -0.4886025 * y,
            0.4886025 * z,
            -0.4886025 * x,
            1.0925484 * x * y,
            -1.0925484 * y * z,
            0.9461747 * z * z - 0.3153916,
            -1.0925484 * x * z,
            0.5462742 * (x * x - y * y),
        ];
        let code = light_code(camera * 3.0, &pose).unwrap();
        for (a, b) in code.into_iter().zip(expected) {
            assert!((a - b).abs() < 1e-6, "{code:?}");
        }
        assert!(light_code(Vec3::ZERO, &pose).is_err() && light_code(Vec3::NAN, &pose).is_err());
        assert_eq!(light_codes(&[camera, Vec3::Z], &pose).unwrap().dims(), [2, 9]);
    }

    #[test]
    fn codes_are_orthonormal_over_the_sphere() {
        let pose = Pose { rotation: Mat3::IDENTITY, translation: Vec3::ZERO };
        let mut products = [[0.0f64; 9]; 9];
        let (heights, azimuths) = (400, 12);
        for i in 0..heights * azimuths {
            let z = (2.0 * (i / azimuths) as f32 + 1.0) / heights as f32 - 1.0;
            let phi = (i % azimuths) as f32 / azimuths as f32 * std::f32::consts::TAU;
            let r = (1.0 - z * z).sqrt();
            let code = light_code(Vec3::new(r * phi.cos(), r * phi.sin(), z), &pose).unwrap();
            let weight = 4.0 * std::f64::consts::PI / f64::from(heights * azimuths);
            for (a, row) in products.iter_mut().enumerate() {
                for (b, sum) in row.iter_mut().enumerate() {
                    *sum += weight * f64::from(code[a]) * f64::from(code[b]);
                }
            }
        }
        for (a, row) in products.iter().enumerate() {
            for (b, sum) in row.iter().enumerate() {
                assert!((sum - f64::from(u8::from(a == b))).abs() < 1e-4, "{a} {b}: {sum}");
            }
        }
    }
}
