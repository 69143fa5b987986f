//! What keeps a set of Gaussians exploring where density control is by relocation: noise on the means, and pressure on
//! opacities and sizes, so that what is not needed dies and can be moved (Kheradmand et al. 2024).
//!
//! Lengths are in units of the scene's extent throughout, so that the same weights serve scenes of any unit.
use crate::objective::{TermValue, Terms};
use crate::random::Random;
use crate::{ActivatedGrad, Attribute, DensityStrategy, GaussianParameters, Mcmc, Model, sigmoid};
use diamond_splat::{Gaussians, LowerFactor};
use glam::{Mat3, Quat, Vec3};

/// Gaussians whose gate is below this are left alone, and no random numbers are drawn for them.
const CLOSED: f32 = 1e-4;

/// Σ·v of Gaussian `i`.
fn covariance_times(g: &Gaussians, i: usize, v: Vec3) -> Vec3 {
    let rotation = g.rotations[i].normalize();
    let rotation = if rotation.is_finite() { rotation } else { Quat::IDENTITY };
    rotation * (g.scales[i] * g.scales[i] * (rotation.conjugate() * v))
}

/// Moves the means at random. `g` are the activated parameters, `rate` the learning rate of the means (× extent still to
/// come), `extent` in scene units.
///
/// `[eq:langevin-noise]` mean += noise · rate · extent · σ(−k(o − t)) · (Σ/extent²) · η with η standard normal: along
/// each Gaussian's own axes, and hardly where the opacity o exceeds t.
pub fn disturb(
    parameters: &mut GaussianParameters,
    g: &Gaussians,
    mcmc: &Mcmc,
    rate: f32,
    extent: f32,
    random: &mut Random,
) {
    let strength = mcmc.noise * rate / extent;
    if strength <= 0.0 {
        return;
    }
    for i in 0..g.len() {
        let gate = sigmoid(-mcmc.noise_sharpness * (g.opacities[i] - mcmc.noise_opacity));
        if gate > CLOSED {
            let step = strength * gate * covariance_times(g, i, random.normal3());
            if step.is_finite() {
                let mean = parameters.row_mut(Attribute::Mean, i);
                mean.iter_mut().zip(step.to_array()).for_each(|(m, s)| *m += s);
            }
        }
    }
}

/// `[eq:mcmc-regularisers]` mean of o, and mean of (s₁ + s₂ + s₃)/extent, with their gradients × weights added to `grad`.
/// For a lower factor the sum of the standard deviations is its nuclear norm, with gradient (L Lᵀ)^(−½) L.
pub fn pressure(g: &Gaussians, mcmc: &Mcmc, extent: f32, grad: &mut ActivatedGrad) -> [TermValue; 2] {
    let share = 1.0 / g.len().max(1) as f32;
    let (d_opacity, d_scale) = (mcmc.opacity_weight * share, mcmc.scale_weight * share / extent);
    grad.gaussians.opacities.iter_mut().for_each(|d| *d += d_opacity);
    if g.factors.is_empty() {
        grad.gaussians.scales.iter_mut().for_each(|d| *d += Vec3::splat(d_scale));
    } else {
        grad.gaussians.factors.resize(g.len(), LowerFactor::default());
        for (i, d) in grad.gaussians.factors.iter_mut().enumerate() {
            let [xx, yx, yy, zx, zy, zz] = g.factors[i].0;
            let columns = [Vec3::new(xx, yx, zx), Vec3::new(0.0, yy, zy), Vec3::new(0.0, 0.0, zz)];
            let rotation = Mat3::from_quat(g.rotations[i]);
            let inverse = g.scales[i].map(|s| if s > 0.0 { 1.0 / s } else { 0.0 });
            let [x, y, z] = columns.map(|c| rotation * (inverse * (rotation.transpose() * c)));
            let polar = [x.x, x.y, y.y, x.z, y.z, z.z];
            d.0.iter_mut().zip(polar).filter(|(_, p)| p.is_finite()).for_each(|(d, p)| *d += d_scale * p);
        }
    }
    let mean = |values: &mut dyn Iterator<Item = f32>| (values.map(f64::from).sum::<f64>() * f64::from(share)) as f32;
    let opacity = mean(&mut g.opacities.iter().copied());
    let size = mean(&mut g.scales.iter().map(|s| s.element_sum() / extent));
    [
        TermValue { name: "mcmc_opacity", weight: mcmc.opacity_weight, value: opacity },
        TermValue { name: "mcmc_scale", weight: mcmc.scale_weight, value: size },
    ]
}

/// [`pressure`] on a batch's gradient and terms, where the configuration asks for it.
pub fn regularise(model: &Model, g: &Gaussians, total: &mut ActivatedGrad, terms: &mut Terms) {
    let density = &model.config.density;
    if density.strategy == DensityStrategy::Mcmc {
        terms.add(&pressure(g, &density.mcmc, model.scene.extent, total), 1.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Purpose;
    use crate::{Config, Covariance, Layout};
    use diamond_splat::GaussiansGrad;
    use diamond_testkit::{Dual, Real, gradient};

    fn mcmc() -> Mcmc {
        Config::preset("resolved").unwrap().density.mcmc
    }

    /// `[eq:langevin-noise]`: the spread of the displacements is the formula's, along the Gaussian's own axes; opaque
    /// Gaussians stay.
    #[test]
    fn noise_has_the_spread_of_the_formula() {
        let n = 20_000;
        let settings = Mcmc { noise: 100.0, noise_sharpness: 100.0, noise_opacity: 0.005, ..mcmc() };
        let layout = Layout { covariance: Covariance::RotationScale, transfer: 0, codes: 0 };
        let mut parameters = GaussianParameters::zeros(n + 1, &layout);
        let (scale, rotation) = (Vec3::new(0.1, 0.2, 0.05), Quat::from_rotation_z(0.6));
        let mut g = Gaussians::default();
        (0..n).for_each(|_| g.push(Vec3::ZERO, scale, rotation, 0.005));
        g.push(Vec3::ZERO, scale, rotation, 0.9);
        let (rate, extent) = (1e-3, 2.0);
        disturb(&mut parameters, &g, &settings, rate, extent, &mut Random::new(1, Purpose::Noise, 0));
        let means = parameters.values(Attribute::Mean);
        assert_eq!(means[3 * n..], [0.0; 3], "an opaque Gaussian moved");
        // At o = t the gate is ½.
        let expected = scale * scale * (100.0 * rate / extent * 0.5);
        let mut variance = Vec3::ZERO;
        for m in means[..3 * n].chunks_exact(3) {
            let local = rotation.conjugate() * Vec3::from_slice(m);
            variance += local * local / n as f32;
        }
        let ratio = Vec3::new(variance.x.sqrt(), variance.y.sqrt(), variance.z.sqrt()) / expected;
        assert!((ratio - Vec3::ONE).abs().max_element() < 0.03, "{ratio}");
    }

    type Matrix = [[Dual; 3]; 3];

    fn inverse_transpose(m: &Matrix) -> Matrix {
        let minor = |r: usize, c: usize| {
            let (a, b, e, f) = ((r + 1) % 3, (r + 2) % 3, (c + 1) % 3, (c + 2) % 3);
            m[a][e] * m[b][f] - m[a][f] * m[b][e]
        };
        let det = (0..3).fold(Dual::of(0.0), |sum, c| sum + m[0][c] * minor(0, c));
        std::array::from_fn(|r| std::array::from_fn(|c| minor(r, c) / det))
    }

    /// Sum of the singular values: trace of Uᵀ L with U from Newton's iteration for the polar decomposition.
    fn nuclear_norm(l: &Matrix) -> Dual {
        let mut u = *l;
        for _ in 0..40 {
            let other = inverse_transpose(&u);
            u = std::array::from_fn(|r| std::array::from_fn(|c| Dual::of(0.5) * (u[r][c] + other[r][c])));
        }
        (0..9).fold(Dual::of(0.0), |sum, k| sum + u[k / 3][k % 3] * l[k / 3][k % 3])
    }

    /// `[eq:mcmc-regularisers]`: value and gradient of the size term on factors, against dual numbers of the nuclear norm.
    #[test]
    fn pressure_on_factors_agrees_with_dual_numbers() {
        let mut random = Random::new(9, Purpose::Initial, 0);
        for _ in 0..32 {
            let l: [f32; 6] = std::array::from_fn(|k| match k {
                0 | 2 | 5 => 0.2 + random.uniform(),
                _ => random.normal(),
            });
            let mut g = Gaussians { factors: vec![LowerFactor(l)], ..Default::default() };
            g.means.push(Vec3::ZERO);
            g.opacities.push(0.3);
            g.decompose_factors();
            let settings = Mcmc { scale_weight: 0.5, opacity_weight: 0.25, ..mcmc() };
            let mut grad = ActivatedGrad { gaussians: GaussiansGrad::zeros(1), ..Default::default() };
            let [opacity, size] = pressure(&g, &settings, 2.0, &mut grad);
            assert!(opacity.value == 0.3 && grad.gaussians.opacities == [0.25]);
            let zero = Dual::of(0.0);
            let oracle = |x: &[Dual]| {
                nuclear_norm(&[[x[0], zero, zero], [x[1], x[2], zero], [x[3], x[4], x[5]]]) / Dual::of(2.0)
            };
            let x = l.map(f64::from);
            let constants = x.map(Dual::of);
            assert!((f64::from(size.value) - oracle(&constants).v).abs() < 1e-5);
            for (a, b) in grad.gaussians.factors[0].0.iter().zip(gradient(oracle, &x)) {
                assert!((f64::from(*a) - 0.5 * b).abs() < 2e-5, "{l:?}: {a} {}", 0.5 * b);
            }
        }
    }
}
