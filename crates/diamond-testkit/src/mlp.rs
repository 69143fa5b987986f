//! Oracles of the subsurface residual: dense network, positional encoding, network inputs, light-linear transfer.
//! Naive loops over any [`Real`].
use crate::Real;
use std::f64::consts::PI;

/// What follows a dense layer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Nonlinearity {
    /// x.
    Linear,
    /// x for x > 0, else slope·x (0: rectifier).
    Leaky(f64),
    /// 1 / (1 + e^−x).
    Sigmoid,
}

fn apply<T: Real>(nonlinearity: Nonlinearity, x: T) -> T {
    match nonlinearity {
        Nonlinearity::Linear => x,
        Nonlinearity::Leaky(slope) => {
            if x.value() > 0.0 {
                x
            } else {
                T::of(slope) * x
            }
        }
        Nonlinearity::Sigmoid => x.sigmoid(),
    }
}

/// One row through a dense network. `parameters`: per layer the weights `[outputs × inputs]`, then the bias.
pub fn dense_network<T: Real>(
    widths: &[usize],
    hidden: Nonlinearity,
    output: Nonlinearity,
    parameters: &[T],
    inputs: &[T],
) -> Vec<T> {
    let mut x = inputs.to_vec();
    let mut offset = 0;
    for layer in 0..widths.len() - 1 {
        let (n, m) = (widths[layer], widths[layer + 1]);
        let mut y = Vec::new();
        for o in 0..m {
            let mut sum = parameters[offset + n * m + o];
            for i in 0..n {
                sum += parameters[offset + o * n + i] * x[i];
            }
            y.push(apply(if layer + 2 == widths.len() { output } else { hidden }, sum));
        }
        offset += m * (n + 1);
        x = y;
    }
    assert_eq!(offset, parameters.len(), "parameters of a dense network");
    x
}

/// sin and cos of 2^k·π·x per frequency k: for each k the sines of all coordinates, then their cosines.
pub fn positional_encoding<T: Real>(x: &[T], frequencies: usize) -> Vec<T> {
    let mut encoded = Vec::new();
    for k in 0..frequencies {
        let factor = T::of(PI * f64::powi(2.0, k as i32));
        encoded.extend(x.iter().map(|&v| (factor * v).sin()));
        encoded.extend(x.iter().map(|&v| (factor * v).cos()));
    }
    encoded
}

/// The geometry of one row of network inputs.
#[derive(Debug, Clone)]
pub struct ResidualRow<T> {
    /// World position.
    pub position: [T; 3],
    /// Unit quaternion w, x, y, z.
    pub rotation: [T; 4],
    /// Standard deviations along the axes.
    pub scale: [T; 3],
    /// Direction to the viewer.
    pub view: [T; 3],
    /// Direction to the light.
    pub light: [T; 3],
    /// Normal.
    pub normal: [T; 3],
    /// Visibility of the light.
    pub visibility: T,
    /// Distance to the light; infinite for a directional one.
    pub light_distance: T,
    /// Latent code.
    pub code: Vec<T>,
}

/// How lengths enter the network inputs.
#[derive(Debug, Clone)]
pub struct LengthScales {
    /// Corner of the scene's box.
    pub bounds_min: [f64; 3],
    /// Opposite corner.
    pub bounds_max: [f64; 3],
    /// If given, scales enter as ln(s / this) / 8; otherwise as they are.
    pub log_scale_reference: Option<f64>,
    /// If given, the distance enters as (d − ℓ)/(d + ℓ), 1 at infinity; otherwise as it is, 0 at infinity.
    pub distance_reference: Option<f64>,
}

/// The 42 + K inputs of one row, in the order encoding, rotation, scale, view, light, normal, visibility, distance, code.
pub fn residual_inputs<T: Real>(row: &ResidualRow<T>, lengths: &LengthScales) -> Vec<T> {
    let unit: Vec<T> = (0..3)
        .map(|i| {
            let (low, high) = (lengths.bounds_min[i], lengths.bounds_max[i]);
            (row.position[i] - T::of(0.5 * (low + high))) * T::of(2.0 / (high - low))
        })
        .collect();
    let mut x = positional_encoding(&unit, 4);
    x.extend(row.rotation);
    x.extend(row.scale.iter().map(|&s| match lengths.log_scale_reference {
        Some(reference) => (s / T::of(reference)).ln() / T::of(8.0),
        None => s,
    }));
    x.extend(row.view);
    x.extend(row.light);
    x.extend(row.normal);
    x.push(row.visibility);
    let infinite = row.light_distance.value().is_infinite();
    x.push(match lengths.distance_reference {
        Some(_) if infinite => T::of(1.0),
        None if infinite => T::of(0.0),
        Some(l) => (row.light_distance - T::of(l)) / (row.light_distance + T::of(l)),
        None => row.light_distance,
    });
    x.extend(&row.code);
    x
}

/// Real spherical harmonic (l, m), orthonormal, with the Condon–Shortley phase, of the unit vector `d`, from associated
/// Legendre polynomials in Cartesian form.
pub fn real_harmonic<T: Real>(l: usize, m: i32, d: [T; 3]) -> T {
    let order = m.unsigned_abs() as usize;
    let [x, y, z] = d;
    // (x + i·y)^order = r^order·(cos, sin)(order·φ).
    let (mut re, mut im) = (T::of(1.0), T::of(0.0));
    for _ in 0..order {
        (re, im) = (re * x - im * y, re * y + im * x);
    }
    // P_l^m(z) / r^m by the three-term recurrence; the phase is (−1)^m.
    let mut p_mm = T::of(1.0);
    for i in 0..order {
        p_mm = p_mm * T::of(-(2.0 * i as f64 + 1.0));
    }
    let (mut before, mut p) = (T::of(0.0), p_mm);
    for n in order + 1..=l {
        let next = (z * p * T::of(2.0 * n as f64 - 1.0) - before * T::of((n + order) as f64 - 1.0))
            / T::of((n - order) as f64);
        (before, p) = (p, next);
    }
    let mut ratio = 1.0;
    for i in l - order + 1..=l + order {
        ratio /= i as f64;
    }
    let scale = ((2.0 * l as f64 + 1.0) / (4.0 * PI) * ratio).sqrt() * if m == 0 { 1.0 } else { 2.0f64.sqrt() };
    T::of(scale) * p * if m < 0 { im } else { re }
}

/// Σ_k t[c][k]·Y_k(light) per channel c, k = l² + l + m up to `degree`; if `softplus` is β, ln(1 + e^{β·x})/β of it.
pub fn transfer_radiance<T: Real>(transfer: &[T], light: [T; 3], degree: usize, softplus: Option<f64>) -> Vec<T> {
    let coefficients = (degree + 1) * (degree + 1);
    transfer
        .chunks(coefficients)
        .map(|t| {
            let mut sum = T::of(0.0);
            for l in 0..=degree {
                for m in -(l as i32)..=l as i32 {
                    sum += t[(l * l + l).wrapping_add_signed(m as isize)] * real_harmonic(l, m, light);
                }
            }
            match softplus {
                None => sum,
                Some(beta) => {
                    let x = T::of(beta) * sum;
                    // ln(1 + e^x) = max(x, 0) + ln(1 + e^−|x|).
                    (x.max(T::of(0.0)) + (T::of(1.0) + (-x.abs()).exp()).ln()) / T::of(beta)
                }
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Orthonormality over a product quadrature exact to the degree used.
    #[test]
    fn harmonics_are_orthonormal() {
        let (rings, steps) = (400, 16);
        let index: Vec<(usize, i32)> =
            (0..4usize).flat_map(|l| (-(l as i32)..=l as i32).map(move |m| (l, m))).collect();
        for (i, &a) in index.iter().enumerate() {
            for (j, &b) in index.iter().enumerate() {
                let mut sum = 0.0;
                for ring in 0..rings {
                    let z = -1.0 + (ring as f64 + 0.5) * 2.0 / rings as f64;
                    let r = (1.0 - z * z).sqrt();
                    for step in 0..steps {
                        let phi = step as f64 * 2.0 * PI / steps as f64;
                        let d = [r * phi.cos(), r * phi.sin(), z];
                        sum += real_harmonic(a.0, a.1, d) * real_harmonic(b.0, b.1, d);
                    }
                }
                sum *= 4.0 * PI / (rings * steps) as f64;
                assert!((sum - if i == j { 1.0 } else { 0.0 }).abs() < 1e-3, "{a:?} {b:?} {sum}");
            }
        }
    }

    #[test]
    fn one_layer_by_hand() {
        // y = relu(2·3 + 1·(−1) + ½) and relu(−6 + …).
        let parameters = [2.0, 1.0, -2.0, 0.0, 0.5, 0.25];
        let y = dense_network(&[2, 2], Nonlinearity::Linear, Nonlinearity::Leaky(0.0), &parameters, &[3.0, -1.0]);
        assert_eq!(y, [5.5, 0.0]);
    }
}
