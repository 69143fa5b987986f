//! Oracles of lights and of real spherical harmonics.
use crate::Real;

/// Real spherical harmonics to `degree` in the direction `[x, y, z]`, orthonormal, with the Condon–Shortley phase, in
/// the order `l² + l + m`. From the definition: K(l,|m|)·P(l,|m|)(z)/sin^|m|θ times the real (m > 0) or imaginary
/// (m < 0) part of (x + iy)^|m|, with P by its three-term recurrence, so no constant is shared with closed forms.
pub fn sh_basis<R: Real>(direction: [R; 3], degree: usize) -> Vec<R> {
    let [x, y, z] = direction;
    let mut out = vec![R::of(0.0); (degree + 1) * (degree + 1)];
    // (re, im) = (x + iy)^m and p_mm = (−1)^m·(2m − 1)!!.
    let (mut re, mut im, mut p_mm) = (R::of(1.0), R::of(0.0), 1.0f64);
    for m in 0..=degree {
        let (mut below, mut here) = (R::of(0.0), R::of(p_mm));
        for l in m..=degree {
            let k = normalisation(l, m);
            if m == 0 {
                out[l * l + l] = R::of(k) * here;
            } else {
                let k = R::of(k * std::f64::consts::SQRT_2);
                out[l * l + l + m] = k * here * re;
                out[l * l + l - m] = k * here * im;
            }
            // (l + 1 − m)·P(l+1) = (2l + 1)·z·P(l) − (l + m)·P(l−1).
            let next =
                (R::of((2 * l + 1) as f64) * z * here - R::of((l + m) as f64) * below) / R::of((l + 1 - m) as f64);
            (below, here) = (here, next);
        }
        (re, im) = (re * x - im * y, re * y + im * x);
        p_mm *= -((2 * m + 1) as f64);
    }
    out
}

/// √((2l + 1)/4π · (l − m)!/(l + m)!).
fn normalisation(l: usize, m: usize) -> f64 {
    let ratio: f64 = ((l - m + 1)..=(l + m)).map(|k| 1.0 / k as f64).product();
    ((2 * l + 1) as f64 / (4.0 * std::f64::consts::PI) * ratio).sqrt()
}

/// What a point light sends to `at`: unit direction to the light (3), distance (1), RGB irradiance on a facing plane
/// (3). With `reference` the irradiance is intensity·(reference/distance)², without it the intensity.
pub fn point_incidence<R: Real>(position: [R; 3], intensity: [R; 3], at: [R; 3], reference: Option<R>) -> [R; 7] {
    let v = [position[0] - at[0], position[1] - at[1], position[2] - at[2]];
    let distance = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    let factor = match reference {
        Some(r) => r * r / (distance * distance),
        None => R::of(1.0),
    };
    let e = intensity.map(|i| i * factor);
    [v[0] / distance, v[1] / distance, v[2] / distance, distance, e[0], e[1], e[2]]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn low_degrees_have_their_textbook_values() {
        let d = [0.48, -0.6, 0.64];
        let y = sh_basis(d, 2);
        let pi = std::f64::consts::PI;
        let expected = [
            0.5 / pi.sqrt(),
            -(0.75 / pi).sqrt() * d[1],
            (0.75 / pi).sqrt() * d[2],
            -(0.75 / pi).sqrt() * d[0],
            0.5 * (15.0 / pi).sqrt() * d[0] * d[1],
            -0.5 * (15.0 / pi).sqrt() * d[1] * d[2],
            0.25 * (5.0 / pi).sqrt() * (3.0 * d[2] * d[2] - 1.0),
            -0.5 * (15.0 / pi).sqrt() * d[0] * d[2],
            0.25 * (15.0 / pi).sqrt() * (d[0] * d[0] - d[1] * d[1]),
        ];
        for (i, (a, b)) in y.iter().zip(expected).enumerate() {
            assert!((a - b).abs() < 1e-14, "coefficient {i}: {a} instead of {b}");
        }
    }

    #[test]
    fn a_light_three_away_at_reference_six_is_four_times_as_bright() {
        let i = point_incidence([0.0, 0.0, 3.0], [1.0, 2.0, 0.0], [0.0; 3], Some(6.0));
        assert_eq!(i, [0.0, 0.0, 1.0, 3.0, 4.0, 8.0, 0.0]);
    }
}
