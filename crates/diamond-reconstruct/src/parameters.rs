//! The raw parameters of the Gaussians, their activations, and the way back.
//!
//! Raw values are what Adam sees: unbounded numbers. [`GaussianParameters::activate`] turns them into Gaussians,
//! normals and materials; [`GaussianParameters::pull`] takes the gradient back. `[eq:activations]`
use crate::adam::{Moments, Rows, adam_step};
use crate::{Config, Covariance};
use diamond_light::spherical_harmonics::COEFFICIENTS;
use diamond_splat::{Gaussians, GaussiansGrad, LowerFactor};
use glam::{Quat, Vec3};

/// An attribute that every Gaussian has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Attribute {
    /// World position, scene units (3).
    Mean,
    /// Natural log of the standard deviations, or of the diagonal of the lower factor (3).
    Scale,
    /// Quaternion w, x, y, z, any length but 0 (4); none where there is a factor.
    Rotation,
    /// Entries yx, zx, zy of the lower factor over the geometric mean of its diagonal (3); none where there is a rotation.
    Shear,
    /// Logit (1).
    Opacity,
    /// Normal, any length but 0 (3).
    Normal,
    /// Logit (3).
    BaseColor,
    /// Logit (1).
    Roughness,
    /// Logit (1).
    Metalness,
    /// Logit (1).
    Subsurfaceness,
    /// SH coefficients of visibility (16).
    VisibilitySh,
    /// Transfer vectors: SH coefficients of the residual in the light's direction, 3 × K.
    Transfer,
    /// Latent codes that the residual network reads.
    Codes,
}

impl Attribute {
    /// All attributes, in the order in which they are stored.
    pub const ALL: [Attribute; 13] = [
        Attribute::Mean,
        Attribute::Scale,
        Attribute::Rotation,
        Attribute::Shear,
        Attribute::Opacity,
        Attribute::Normal,
        Attribute::BaseColor,
        Attribute::Roughness,
        Attribute::Metalness,
        Attribute::Subsurfaceness,
        Attribute::VisibilitySh,
        Attribute::Transfer,
        Attribute::Codes,
    ];

    /// Name in files and messages.
    pub fn name(self) -> &'static str {
        match self {
            Attribute::Mean => "mean",
            Attribute::Scale => "scale",
            Attribute::Rotation => "rotation",
            Attribute::Shear => "shear",
            Attribute::Opacity => "opacity",
            Attribute::Normal => "normal",
            Attribute::BaseColor => "base_color",
            Attribute::Roughness => "roughness",
            Attribute::Metalness => "metalness",
            Attribute::Subsurfaceness => "subsurfaceness",
            Attribute::VisibilitySh => "visibility_sh",
            Attribute::Transfer => "transfer",
            Attribute::Codes => "codes",
        }
    }
}

/// One attribute of all Gaussians, with its Adam moments.
#[derive(Debug, Clone, PartialEq)]
pub struct Group {
    /// Which attribute.
    pub attribute: Attribute,
    /// Values per Gaussian; may be 0.
    pub width: usize,
    /// Row-major N × width raw values.
    pub values: Vec<f32>,
    /// Adam moments, same shape.
    pub moments: Moments,
}

/// How many raw values each attribute has per Gaussian.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layout {
    /// Form of the covariance.
    pub covariance: Covariance,
    /// Transfer values.
    pub transfer: usize,
    /// Latent codes.
    pub codes: usize,
}

impl Layout {
    /// What a configuration asks for.
    pub fn of(config: &Config) -> Self {
        let residual = &config.residual;
        Self { covariance: config.model.covariance, transfer: residual.transfer_width(), codes: residual.codes }
    }

    /// Raw values of an attribute.
    pub fn width(&self, attribute: Attribute) -> usize {
        let factor = self.covariance == Covariance::Cholesky;
        match attribute {
            Attribute::Mean | Attribute::Scale | Attribute::Normal | Attribute::BaseColor => 3,
            Attribute::Rotation => 4 * usize::from(!factor),
            Attribute::Shear => 3 * usize::from(factor),
            Attribute::VisibilitySh => COEFFICIENTS,
            Attribute::Transfer => self.transfer,
            Attribute::Codes => self.codes,
            Attribute::Opacity | Attribute::Roughness | Attribute::Metalness | Attribute::Subsurfaceness => 1,
        }
    }
}

/// The raw parameters of N Gaussians.
#[derive(Debug, Clone, PartialEq)]
pub struct GaussianParameters {
    groups: Vec<Group>,
    len: usize,
    covariance: Covariance,
}

/// What the raw parameters mean.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Activated {
    /// Means, standard deviations, rotations, opacities.
    pub gaussians: Gaussians,
    /// Unit normals, world.
    pub normals: Vec<Vec3>,
    /// Base colour, each channel in (0, 1).
    pub base_color: Vec<Vec3>,
    /// Perceptual roughness in (0, 1).
    pub roughness: Vec<f32>,
    /// Metalness in (0, 1).
    pub metalness: Vec<f32>,
    /// Subsurfaceness in (0, 1).
    pub subsurfaceness: Vec<f32>,
}

/// Gradient of [`Activated`], and of the attributes that are used raw.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ActivatedGrad {
    /// Gradient of the Gaussians.
    pub gaussians: GaussiansGrad,
    /// Gradient of the unit normals.
    pub normals: Vec<Vec3>,
    /// Gradient of base colour.
    pub base_color: Vec<Vec3>,
    /// Gradient of roughness.
    pub roughness: Vec<f32>,
    /// Gradient of metalness.
    pub metalness: Vec<f32>,
    /// Gradient of subsurfaceness.
    pub subsurfaceness: Vec<f32>,
    /// Gradient of the SH visibility coefficients, N × 16.
    pub visibility_sh: Vec<f32>,
    /// Gradient of the transfer vectors.
    pub transfer: Vec<f32>,
    /// Gradient of the codes.
    pub codes: Vec<f32>,
}

/// Normals shorter than this are replaced by +z and get no gradient (their direction is undefined).
const MIN_NORMAL: f32 = 1e-12;

/// Smallest diagonal entry of a factor, × its largest standard deviation, so that its logarithm exists.
const MIN_DIAGONAL: f32 = 1e-7;
/// Standard deviations outside their limits by less than this, × the largest, are left alone.
const CLAMP_SLACK: f32 = 1e-6;

/// Logistic function.
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + libm::expf(-x))
}

/// Inverse of [`sigmoid`] for p in (0, 1); clamped 1e-6 inside so that it is finite.
pub fn logit(p: f32) -> f32 {
    let p = p.clamp(1e-6, 1.0 - 1e-6);
    libm::logf(p / (1.0 - p))
}

fn vec3s(values: &[f32]) -> impl Iterator<Item = Vec3> + '_ {
    values.chunks_exact(3).map(|c| Vec3::new(c[0], c[1], c[2]))
}

/// `[eq:cholesky-raw]` L from raw values: e^a on the diagonal, g·shear below it, with g = e^(mean of a), so that shears have
/// no unit, a change of size moves the diagonal alone, and one learning rate suits Gaussians of any size. `shear` holds
/// yx, zx, zy.
fn lower_factor(log_diagonal: Vec3, shear: Vec3) -> LowerFactor {
    let [x, y, z] = log_diagonal.map(libm::expf).to_array();
    let [yx, zx, zy] = (shear * libm::expf(log_diagonal.element_sum() / 3.0)).to_array();
    LowerFactor([x, yx, y, zx, zy, z])
}

/// Pullback of [`lower_factor`]: to the log-diagonal and to the shear.
fn lower_factor_pull(log_diagonal: Vec3, shear: Vec3, d: &LowerFactor) -> (Vec3, Vec3) {
    let [xx, yx, yy, zx, zy, zz] = d.0;
    let size = libm::expf(log_diagonal.element_sum() / 3.0);
    let d_shear = Vec3::new(yx, zx, zy) * size;
    (Vec3::new(xx, yy, zz) * log_diagonal.map(libm::expf) + Vec3::splat(d_shear.dot(shear) / 3.0), d_shear)
}

/// Raw values of a factor; diagonal entries count as at least `least` (above 0).
fn raw_of_factor(factor: &LowerFactor, least: f32) -> (Vec3, Vec3) {
    let [xx, yx, yy, zx, zy, zz] = factor.0;
    let log_diagonal = Vec3::new(xx, yy, zz).max(Vec3::splat(least)).map(libm::logf);
    let size = libm::expf(log_diagonal.element_sum() / 3.0);
    (log_diagonal, Vec3::new(yx, zx, zy) / size)
}

impl GaussianParameters {
    /// Gives Gaussian `i` these standard deviations (above 0) and this rotation, in whichever form is used.
    pub fn set_covariance(&mut self, i: usize, scale: Vec3, rotation: Quat) {
        match self.covariance {
            Covariance::RotationScale => {
                self.row_mut(Attribute::Scale, i).copy_from_slice(&scale.map(libm::logf).to_array());
                let wxyz = [rotation.w, rotation.x, rotation.y, rotation.z];
                self.row_mut(Attribute::Rotation, i).copy_from_slice(&wxyz);
            }
            Covariance::Cholesky => {
                let least = scale.max_element() * MIN_DIAGONAL;
                let (log_diagonal, shear) = raw_of_factor(&LowerFactor::from_scale_rotation(scale, rotation), least);
                self.row_mut(Attribute::Scale, i).copy_from_slice(&log_diagonal.to_array());
                self.row_mut(Attribute::Shear, i).copy_from_slice(&shear.to_array());
            }
        }
    }

    /// Multiplies all standard deviations of Gaussian `i`: in either form the same number is added to three logarithms.
    pub fn scale_covariance(&mut self, i: usize, factor: f32) {
        self.row_mut(Attribute::Scale, i).iter_mut().for_each(|s| *s += libm::logf(factor));
    }

    /// Keeps every standard deviation in `low..=high` (scene units): eigenvalues of the covariance, whatever its form.
    /// A projection after the step, so that it stops no gradient.
    pub fn clamp_covariances(&mut self, low: f32, high: f32) {
        if self.covariance == Covariance::RotationScale {
            let (low, high) = (libm::logf(low), libm::logf(high));
            self.values_mut(Attribute::Scale).iter_mut().for_each(|s| *s = s.clamp(low, high));
            return;
        }
        for i in 0..self.len {
            let (scale, shear) =
                (Vec3::from_slice(self.row(Attribute::Scale, i)), Vec3::from_slice(self.row(Attribute::Shear, i)));
            let (scale, rotation) = lower_factor(scale, shear).scale_rotation();
            let clamped = scale.clamp(Vec3::splat(low), Vec3::splat(high));
            // Rounding of the decomposition alone must not move anything.
            if (clamped - scale).abs().max_element() > CLAMP_SLACK * high.min(scale.max_element()) {
                self.set_covariance(i, clamped, rotation);
            }
        }
    }

    /// Opacities in (0, 1).
    pub fn opacities(&self) -> Vec<f32> {
        self.values(Attribute::Opacity).iter().map(|&x| sigmoid(x)).collect()
    }

    /// The raw values of one Gaussian.
    pub fn row(&self, attribute: Attribute, i: usize) -> &[f32] {
        let group = self.group(attribute);
        &group.values[i * group.width..(i + 1) * group.width]
    }

    /// The raw values of one Gaussian, mutable.
    pub fn row_mut(&mut self, attribute: Attribute, i: usize) -> &mut [f32] {
        let group = self.group_mut(attribute);
        &mut group.values[i * group.width..(i + 1) * group.width]
    }

    /// `len` Gaussians of zeros.
    pub fn zeros(len: usize, layout: &Layout) -> Self {
        let groups = Attribute::ALL
            .iter()
            .map(|&attribute| {
                let width = layout.width(attribute);
                Group { attribute, width, values: vec![0.0; len * width], moments: Moments::zeros(len * width) }
            })
            .collect();
        Self { groups, len, covariance: layout.covariance }
    }

    /// Form of the covariances.
    pub fn covariance(&self) -> Covariance {
        self.covariance
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// All groups, in the order of [`Attribute::ALL`].
    pub fn groups(&self) -> &[Group] {
        &self.groups
    }

    /// The group of an attribute.
    pub fn group(&self, attribute: Attribute) -> &Group {
        &self.groups[attribute as usize]
    }

    /// The group of an attribute, mutable.
    pub fn group_mut(&mut self, attribute: Attribute) -> &mut Group {
        &mut self.groups[attribute as usize]
    }

    /// Raw values of an attribute.
    pub fn values(&self, attribute: Attribute) -> &[f32] {
        &self.group(attribute).values
    }

    /// Raw values of an attribute, mutable.
    pub fn values_mut(&mut self, attribute: Attribute) -> &mut [f32] {
        &mut self.group_mut(attribute).values
    }

    /// Raw → meaning.
    pub fn activate(&self) -> Activated {
        let scalar = |a: Attribute| self.values(a).iter().map(|&x| sigmoid(x)).collect::<Vec<f32>>();
        let mut gaussians = Gaussians {
            means: vec3s(self.values(Attribute::Mean)).collect(),
            opacities: scalar(Attribute::Opacity),
            ..Default::default()
        };
        match self.covariance {
            Covariance::RotationScale => {
                gaussians.scales = vec3s(self.values(Attribute::Scale)).map(|log: Vec3| log.map(libm::expf)).collect();
                let quaternions = self.values(Attribute::Rotation).chunks_exact(4);
                gaussians.rotations = quaternions.map(|q| Quat::from_xyzw(q[1], q[2], q[3], q[0])).collect();
            }
            Covariance::Cholesky => {
                let rows = vec3s(self.values(Attribute::Scale)).zip(vec3s(self.values(Attribute::Shear)));
                gaussians.factors = rows.map(|(log_diagonal, shear)| lower_factor(log_diagonal, shear)).collect();
                gaussians.decompose_factors();
            }
        }
        Activated {
            gaussians,
            normals: vec3s(self.values(Attribute::Normal))
                .map(|n| if n.length() > MIN_NORMAL { n / n.length() } else { Vec3::Z })
                .collect(),
            base_color: vec3s(self.values(Attribute::BaseColor))
                .map(|c| Vec3::new(sigmoid(c.x), sigmoid(c.y), sigmoid(c.z)))
                .collect(),
            roughness: scalar(Attribute::Roughness),
            metalness: scalar(Attribute::Metalness),
            subsurfaceness: scalar(Attribute::Subsurfaceness),
        }
    }

    /// Pullback of [`GaussianParameters::activate`]: one flat gradient per group, in the order of [`Attribute::ALL`].
    /// Rows of `grad` that are empty count as zero.
    pub fn pull(&self, at: &Activated, grad: &ActivatedGrad) -> Vec<Vec<f32>> {
        let of_vec3 = |g: &[Vec3], f: &dyn Fn(usize, Vec3) -> Vec3| -> Vec<f32> {
            if g.is_empty() {
                return vec![0.0; 3 * self.len];
            }
            g.iter().enumerate().flat_map(|(i, &d)| f(i, d).to_array()).collect()
        };
        let of_logit = |g: &[f32], y: &[f32]| -> Vec<f32> {
            if g.is_empty() {
                return vec![0.0; self.len];
            }
            g.iter().zip(y).map(|(d, y)| d * y * (1.0 - y)).collect()
        };
        let raw = |g: &[f32], a: Attribute| {
            if g.is_empty() { vec![0.0; self.values(a).len()] } else { g.to_vec() }
        };
        let factors = |part: &dyn Fn((Vec3, Vec3)) -> Vec3| -> Vec<f32> {
            if grad.gaussians.factors.is_empty() {
                return vec![0.0; 3 * self.len];
            }
            let raw = vec3s(self.values(Attribute::Scale)).zip(vec3s(self.values(Attribute::Shear)));
            let rows = raw.zip(&grad.gaussians.factors);
            rows.flat_map(|((log_diagonal, shear), d)| part(lower_factor_pull(log_diagonal, shear, d)).to_array())
                .collect()
        };
        Attribute::ALL
            .iter()
            .map(|&attribute| match attribute {
                Attribute::Mean => of_vec3(&grad.gaussians.means, &|_, d| d),
                Attribute::Scale if self.covariance == Covariance::Cholesky => factors(&|(scale, _)| scale),
                Attribute::Scale => of_vec3(&grad.gaussians.scales, &|i, d| d * at.gaussians.scales[i]),
                Attribute::Shear if self.covariance == Covariance::Cholesky => factors(&|(_, shear)| shear),
                Attribute::Shear => Vec::new(),
                Attribute::Rotation if self.covariance == Covariance::Cholesky => Vec::new(),
                Attribute::Rotation if grad.gaussians.rotations.is_empty() => vec![0.0; 4 * self.len],
                Attribute::Rotation => grad.gaussians.rotations.iter().flat_map(|d| [d.w, d.x, d.y, d.z]).collect(),
                Attribute::Opacity => of_logit(&grad.gaussians.opacities, &at.gaussians.opacities),
                Attribute::Normal => of_vec3(&grad.normals, &|i, d| {
                    let raw = &self.values(Attribute::Normal)[3 * i..3 * i + 3];
                    let length = Vec3::new(raw[0], raw[1], raw[2]).length();
                    let n = at.normals[i];
                    if length > MIN_NORMAL { (d - n * n.dot(d)) / length } else { Vec3::ZERO }
                }),
                Attribute::BaseColor => of_vec3(&grad.base_color, &|i, d| {
                    let y = at.base_color[i];
                    d * y * (Vec3::ONE - y)
                }),
                Attribute::Roughness => of_logit(&grad.roughness, &at.roughness),
                Attribute::Metalness => of_logit(&grad.metalness, &at.metalness),
                Attribute::Subsurfaceness => of_logit(&grad.subsurfaceness, &at.subsurfaceness),
                Attribute::VisibilitySh => raw(&grad.visibility_sh, attribute),
                Attribute::Transfer => raw(&grad.transfer, attribute),
                Attribute::Codes => raw(&grad.codes, attribute),
            })
            .collect()
    }

    /// One Adam step: `gradients` as from [`GaussianParameters::pull`], `rate` per attribute, `t` from 1.
    /// With `sparse` an attribute of a Gaussian whose gradient is 0 is left alone: see [`Rows::Seen`].
    pub fn adam_step(&mut self, gradients: &[Vec<f32>], rate: impl Fn(Attribute) -> f32, t: u64, sparse: bool) {
        for (group, gradient) in self.groups.iter_mut().zip(gradients) {
            let rate = rate(group.attribute);
            if rate > 0.0 {
                let rows = if sparse { Rows::Seen { width: group.width } } else { Rows::All };
                adam_step(&mut group.values, &mut group.moments, gradient, rate, t, rows);
            }
        }
    }

    /// A new set whose Gaussian `i` is a copy of Gaussian `sources[i].0`; its moments are copied where `sources[i].1`
    /// says so and are zero otherwise.
    pub fn gather(&self, sources: &[(u32, bool)]) -> Self {
        let groups = self
            .groups
            .iter()
            .map(|group| {
                let w = group.width;
                let take = |from: &[f32], keep_all: bool| -> Vec<f32> {
                    let mut out = Vec::with_capacity(sources.len() * w);
                    for &(source, keep) in sources {
                        if keep || keep_all {
                            out.extend_from_slice(&from[source as usize * w..(source as usize + 1) * w]);
                        } else {
                            out.resize(out.len() + w, 0.0);
                        }
                    }
                    out
                };
                Group {
                    attribute: group.attribute,
                    width: w,
                    values: take(&group.values, true),
                    moments: Moments {
                        first: take(&group.moments.first, false),
                        second: take(&group.moments.second, false),
                    },
                }
            })
            .collect();
        Self { groups, len: sources.len(), covariance: self.covariance }
    }

    /// The first value that is not finite: attribute and Gaussian.
    pub fn first_non_finite(&self) -> Option<(Attribute, usize)> {
        self.groups.iter().find_map(|g| {
            let i = g.values.iter().position(|v| !v.is_finite())?;
            Some((g.attribute, i / g.width))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::{Dual, Real};

    fn layout(covariance: Covariance) -> Layout {
        Layout { covariance, transfer: 2, codes: 1 }
    }

    /// `[eq:cholesky-raw]`: the pullback of both forms' raw values against dual numbers.
    #[test]
    fn the_pullback_of_cholesky_values_agrees_with_dual_numbers() {
        let mut random = crate::random::Random::new(5, crate::random::Purpose::Initial, 0);
        for _ in 0..64 {
            let (a, shear) = (random.normal3(), random.normal3());
            let d = LowerFactor(std::array::from_fn(|_| random.normal()));
            let x: Vec<f64> = a.to_array().into_iter().chain(shear.to_array()).map(f64::from).collect();
            let oracle = |x: &[Dual]| {
                let size = ((x[0] + x[1] + x[2]) / Dual::of(3.0)).exp();
                vec![x[0].exp(), x[3] * size, x[1].exp(), x[4] * size, x[5] * size, x[2].exp()]
            };
            let expected = diamond_testkit::vjp(oracle, &x, &d.0.map(f64::from));
            let (d_a, d_shear) = lower_factor_pull(a, shear, &d);
            for (found, expected) in d_a.to_array().into_iter().chain(d_shear.to_array()).zip(expected) {
                assert!((f64::from(found) - expected).abs() < 1e-5 * (1.0 + expected.abs()), "{found} {expected}");
            }
            // There and back.
            let (b, back) = raw_of_factor(&lower_factor(a, shear), 1e-9);
            assert!((a - b).length() + (shear - back).length() < 1e-4, "{a} {b}, {shear} {back}");
        }
    }

    /// The same covariance is set, scaled and clamped in both forms.
    #[test]
    fn both_forms_hold_the_same_covariance() {
        let mut random = crate::random::Random::new(6, crate::random::Purpose::Initial, 0);
        let forms = [Covariance::RotationScale, Covariance::Cholesky];
        let mut both = forms.map(|f| GaussianParameters::zeros(8, &layout(f)));
        for i in 0..8 {
            let (scale, rotation) =
                ((random.normal3() - 3.0).exp(), Quat::from_array(std::array::from_fn(|_| random.normal())));
            both.iter_mut().for_each(|p| p.set_covariance(i, scale, rotation));
        }
        both.iter_mut().for_each(|p| {
            p.scale_covariance(2, 0.5);
            p.clamp_covariances(0.02, 0.2);
        });
        let [a, b] = both.map(|p| p.activate().gaussians);
        assert!(a.factors.is_empty() && b.factors.len() == 8);
        for i in 0..8 {
            let sigma = |g: &Gaussians| {
                let m = glam::Mat3::from_quat(g.rotations[i].normalize()) * glam::Mat3::from_diagonal(g.scales[i]);
                m * m.transpose()
            };
            let difference = (sigma(&a) - sigma(&b)).to_cols_array().iter().fold(0.0f32, |m, v| m.max(v.abs()));
            assert!(difference < 1e-5 * a.scales[i].max_element().powi(2), "Gaussian {i}: {difference:e}");
            assert!(b.scales[i].max_element() < 0.2001 && b.scales[i].min_element() > 0.01999, "{}", b.scales[i]);
        }
    }

    fn example() -> GaussianParameters {
        let mut p = GaussianParameters::zeros(3, &layout(Covariance::RotationScale));
        let mut random = crate::random::Random::new(3, crate::random::Purpose::Initial, 0);
        for a in Attribute::ALL {
            p.values_mut(a).iter_mut().for_each(|v| *v = random.normal());
        }
        p
    }

    /// `[eq:activations]`: each activation against dual numbers.
    #[test]
    fn pull_agrees_with_dual_numbers() {
        let p = example();
        let at = p.activate();
        let mut random = crate::random::Random::new(4, crate::random::Purpose::Initial, 0);
        let n = p.len();
        let mut grad = ActivatedGrad { gaussians: GaussiansGrad::zeros(n), ..Default::default() };
        grad.gaussians.scales.iter_mut().for_each(|v| *v = random.normal3());
        grad.gaussians.opacities.iter_mut().for_each(|v| *v = random.normal());
        grad.normals = (0..n).map(|_| random.normal3()).collect();
        grad.base_color = (0..n).map(|_| random.normal3()).collect();
        let pulled = p.pull(&at, &grad);
        let close =
            |a: f32, b: f64, what: &str| assert!((a as f64 - b).abs() < 1e-5 * (1.0 + b.abs()), "{what} {a} {b}");
        for i in 0..n {
            let logit = p.values(Attribute::Opacity)[i] as f64;
            let y = Dual::new(logit, 1.0).sigmoid();
            close(pulled[Attribute::Opacity as usize][i], y.d * grad.gaussians.opacities[i] as f64, "opacity");
            for c in 0..3 {
                let s = Dual::new(p.values(Attribute::Scale)[3 * i + c] as f64, 1.0).exp();
                close(pulled[Attribute::Scale as usize][3 * i + c], s.d * grad.gaussians.scales[i][c] as f64, "scale");
                let b = Dual::new(p.values(Attribute::BaseColor)[3 * i + c] as f64, 1.0).sigmoid();
                close(pulled[Attribute::BaseColor as usize][3 * i + c], b.d * grad.base_color[i][c] as f64, "base");
                let raw = &p.values(Attribute::Normal)[3 * i..3 * i + 3];
                let x: Vec<Dual> = (0..3).map(|k| Dual::new(raw[k] as f64, if k == c { 1.0 } else { 0.0 })).collect();
                let length = (x[0] * x[0] + x[1] * x[1] + x[2] * x[2]).sqrt();
                let expected: f64 = (0..3).map(|k| (x[k] / length).d * grad.normals[i][k] as f64).sum();
                close(pulled[Attribute::Normal as usize][3 * i + c], expected, "normal");
            }
        }
    }

    #[test]
    fn gather_moves_values_and_moments() {
        let mut p = example();
        for a in Attribute::ALL {
            p.group_mut(a).moments.first.iter_mut().for_each(|v| *v = 7.0);
        }
        let q = p.gather(&[(2, true), (0, false)]);
        assert_eq!(q.len(), 2);
        assert_eq!(q.values(Attribute::Mean)[..3], p.values(Attribute::Mean)[6..9]);
        assert_eq!(q.values(Attribute::Mean)[3..], p.values(Attribute::Mean)[..3]);
        assert_eq!(q.group(Attribute::Rotation).moments.first, [7.0, 7.0, 7.0, 7.0, 0.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn a_zero_normal_is_finite() {
        let p = GaussianParameters::zeros(1, &layout(Covariance::RotationScale));
        let at = p.activate();
        let grad = ActivatedGrad { normals: vec![Vec3::ONE], ..Default::default() };
        assert!(p.pull(&at, &grad).iter().flatten().all(|v| v.is_finite()));
        assert_eq!(at.normals[0], Vec3::Z);
    }
}
