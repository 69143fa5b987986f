//! What arrives from a light at many points at once: [`OlatLight::incidence`] over a [`Number`].
//!
//! The formula is the light's; it stands here again because lights know nothing of vectors of pixels, and a test holds both to
//! the same values.
use crate::number::Number;
use crate::vector::Vector;
use diamond_light::{Falloff, MIN_LIGHT_DISTANCE, OlatLight};
use glam::Vec3;

/// Offsets from point to light are cut to this per axis (scene units): its square still fits an `f32`.
const MAX_OFFSET: f32 = 1e15;
/// reference/distance is cut to this: its square times an intensity of 10⁸ still fits an `f32`.
const MAX_RATIO: f32 = 1e15;

/// Direction and irradiance, and what the pullback needs beside them.
pub(crate) struct Arriving<T> {
    /// Unit direction from the point to the light.
    pub direction: Vector<T>,
    /// Linear RGB on a plane that faces the light.
    pub irradiance: Vector<T>,
    /// At least [`MIN_LIGHT_DISTANCE`]; 1 for directional lights.
    pub distance: T,
    /// reference/distance of the inverse square.
    ratio: T,
}

impl<T: Number> Arriving<T> {
    /// At the world point `at`.
    /// `[eq:light-incidence]`
    #[inline(always)]
    pub fn new(light: &OlatLight, falloff: Falloff, at: Vector<T>) -> Self {
        let one = at.x.same(1.0);
        match *light {
            OlatLight::Point { position, intensity } => {
                let offset = (Vector::same(one, position) - at).within(-MAX_OFFSET, MAX_OFFSET);
                let length = offset.dot(offset).root();
                // Below, not even the reciprocal is finite: the light is above the point.
                let apart = length.reaches(f32::MIN_POSITIVE);
                let up = Vector::same(one, Vec3::Z);
                let direction = (offset * length.or_where_not(apart, one).inverse()).or_where_not(apart, up);
                let distance = length.at_least(MIN_LIGHT_DISTANCE);
                let ratio = match falloff {
                    Falloff::None => one,
                    Falloff::InverseSquare { reference } => {
                        (one.same(reference) / distance).at_least(-MAX_RATIO).at_most(MAX_RATIO)
                    }
                };
                let irradiance = (Vector::same(one, intensity) * (ratio * ratio)).within(f32::MIN, f32::MAX);
                Self { direction, irradiance, distance, ratio }
            }
            OlatLight::Directional { direction, irradiance } => Self {
                direction: Vector::same(one, direction),
                irradiance: Vector::same(one, irradiance),
                distance: one,
                ratio: one,
            },
        }
    }

    /// Cotangent of the point, for those of the direction and the irradiance.
    /// `[eq:light-incidence]`
    #[inline(always)]
    pub fn pull(
        &self,
        light: &OlatLight,
        falloff: Falloff,
        d_direction: Vector<T>,
        d_irradiance: Vector<T>,
    ) -> Vector<T> {
        let zero = self.distance.same(0.0);
        let OlatLight::Point { intensity, .. } = *light else { return Vector::same(zero, Vec3::ZERO) };
        let mut d_at = (self.direction * d_direction.dot(self.direction) - d_direction) / self.distance;
        if let Falloff::InverseSquare { .. } = falloff {
            let d_factor = d_irradiance.dot(Vector::same(zero, intensity));
            let d_distance = d_factor * 2.0 * self.ratio * self.ratio / self.distance;
            // Nearer than the least distance, the distance is constant.
            let free = !(-self.distance).reaches(-MIN_LIGHT_DISTANCE);
            d_at = d_at + self.direction * d_distance.only_where(free);
        }
        d_at
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_light::IncidenceGrad;
    use diamond_testkit::adjoint::relative_l2;

    /// `[eq:light-incidence]`: what the light itself says, near, far and inside.
    #[test]
    fn arrives_what_the_light_says() {
        let wide = |v: Vec3| v.to_array().map(f64::from);
        let intensity = Vec3::new(1.0, 2.0, 0.5);
        let lights = [
            OlatLight::Point { position: Vec3::new(1.0, -2.0, 3.0), intensity },
            OlatLight::Directional { direction: Vec3::new(0.6, 0.0, 0.8), irradiance: intensity },
        ];
        let near = Vec3::new(1.0, -2.0, 3.0 - 5e-5);
        for light in lights {
            for falloff in [Falloff::None, Falloff::InverseSquare { reference: 2.0 }] {
                for at in [Vec3::ZERO, Vec3::new(1.0, -2.0, 3.0), near, Vec3::splat(1e20), Vec3::new(0.3, 0.9, -4.0)] {
                    let expected = light.incidence(at, falloff);
                    let found = Arriving::new(&light, falloff, Vector::from(at));
                    assert!(relative_l2(&wide(found.direction.into()), &wide(expected.direction), 0.0) < 1e-6);
                    assert!(relative_l2(&wide(found.irradiance.into()), &wide(expected.irradiance), 1e-30) < 1e-6);
                    let d = IncidenceGrad {
                        direction: Vec3::new(0.3, -1.0, 0.7),
                        distance: 0.0,
                        irradiance: Vec3::new(-0.4, 0.2, 0.9),
                    };
                    let expected = light.incidence_pull(at, falloff, &d).d_at;
                    let pulled = found.pull(&light, falloff, d.direction.into(), d.irradiance.into());
                    assert!(relative_l2(&wide(pulled.into()), &wide(expected), 1e-30) < 1e-5, "{light:?} {at}");
                }
            }
        }
    }
}
