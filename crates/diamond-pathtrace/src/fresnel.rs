//! What a boundary between two transparent media reflects.

/// Reflectance of a smooth dielectric for unpolarised light, and the cosine on the other side. `cos_theta_i` ≥ 0 is the
/// cosine on the side from which the light comes, `eta` the index of refraction of the other side divided by that of this one.
/// Under total reflection the result is `(1, 0)`.
/// `[eq:fresnel-dielectric]`
#[inline]
pub fn dielectric(cos_theta_i: f32, eta: f32) -> (f32, f32) {
    let cos_i = cos_theta_i.clamp(0.0, 1.0);
    let sin2_t = (1.0 - cos_i * cos_i) / (eta * eta);
    if sin2_t >= 1.0 {
        return (1.0, 0.0);
    }
    let cos_t = (1.0 - sin2_t).sqrt();
    // Grazing light on a boundary that is none would be 0/0.
    let ratio = |a: f32, b: f32| if a + b > 0.0 { (a - b) / (a + b) } else { 1.0 };
    let parallel = ratio(eta * cos_i, cos_t);
    let perpendicular = ratio(cos_i, eta * cos_t);
    (0.5 * (parallel * parallel + perpendicular * perpendicular), cos_t)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `[eq:fresnel-dielectric]`: normal incidence, Brewster's angle, total reflection, and the way back.
    #[test]
    fn reflectance_has_its_known_values() {
        assert!((dielectric(1.0, 1.5).0 - 0.04).abs() < 1e-6);
        assert!((dielectric(1.0, 1.0 / 1.5).0 - 0.04).abs() < 1e-6);
        // At Brewster's angle only the perpendicular part is left: ((1 − η²)/(1 + η²))²/2.
        let eta = 1.5f32;
        let brewster = (1.0 / (1.0 + eta * eta)).sqrt();
        let expected = 0.5 * ((1.0 - eta * eta) / (1.0 + eta * eta)).powi(2);
        assert!((dielectric(brewster, eta).0 - expected).abs() < 1e-6);
        assert_eq!(dielectric(0.5, 1.0 / 1.5), (1.0, 0.0));
        assert!((dielectric(0.0, 1.5).0 - 1.0).abs() < 1e-6);
        for cos in [0.0, 0.1, 0.7, 1.0] {
            assert!(dielectric(cos, 1.0).0 <= if cos > 0.0 { 1e-12 } else { 1.0 });
            let (forward, cos_t) = dielectric(cos, 1.4);
            assert!((dielectric(cos_t, 1.0 / 1.4).0 - forward).abs() < 1e-5);
        }
    }
}
