//! The raw parameters of the Gaussians, their activations, and the way back.
//!
//! Raw values are what Adam sees: unbounded numbers. [`GaussianParameters::activate`] turns them into Gaussians,
//! normals and materials; [`GaussianParameters::pull`] takes the gradient back. `[eq:activations]`
use crate::adam::{Moments, adam_step};
use diamond_light::spherical_harmonics::COEFFICIENTS;
use diamond_splat::{Gaussians, GaussiansGrad};
use glam::{Quat, Vec3};

/// An attribute that every Gaussian has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Attribute {
    /// World position, scene units (3).
    Mean,
    /// Natural log of the standard deviations (3).
    Scale,
    /// Quaternion w, x, y, z, any length but 0 (4).
    Rotation,
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
    pub const ALL: [Attribute; 12] = [
        Attribute::Mean,
        Attribute::Scale,
        Attribute::Rotation,
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

/// The raw parameters of N Gaussians.
#[derive(Debug, Clone, PartialEq)]
pub struct GaussianParameters {
    groups: Vec<Group>,
    len: usize,
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

/// Logistic function.
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

/// Inverse of [`sigmoid`] for p in (0, 1); clamped 1e-6 inside so that it is finite.
pub fn logit(p: f32) -> f32 {
    let p = p.clamp(1e-6, 1.0 - 1e-6);
    (p / (1.0 - p)).ln()
}

fn vec3s(values: &[f32]) -> impl Iterator<Item = Vec3> + '_ {
    values.chunks_exact(3).map(|c| Vec3::new(c[0], c[1], c[2]))
}

impl GaussianParameters {
    /// `len` Gaussians of zeros with `transfer` transfer values and `codes` codes each.
    pub fn zeros(len: usize, transfer: usize, codes: usize) -> Self {
        let groups = Attribute::ALL
            .iter()
            .map(|&attribute| {
                let width = match attribute {
                    Attribute::Mean | Attribute::Scale | Attribute::Normal | Attribute::BaseColor => 3,
                    Attribute::Rotation => 4,
                    Attribute::VisibilitySh => COEFFICIENTS,
                    Attribute::Transfer => transfer,
                    Attribute::Codes => codes,
                    _ => 1,
                };
                Group { attribute, width, values: vec![0.0; len * width], moments: Moments::zeros(len * width) }
            })
            .collect();
        Self { groups, len }
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
        Activated {
            gaussians: Gaussians {
                means: vec3s(self.values(Attribute::Mean)).collect(),
                scales: vec3s(self.values(Attribute::Scale))
                    .map(|s| Vec3::new(s.x.exp(), s.y.exp(), s.z.exp()))
                    .collect(),
                rotations: self
                    .values(Attribute::Rotation)
                    .chunks_exact(4)
                    .map(|q| Quat::from_xyzw(q[1], q[2], q[3], q[0]))
                    .collect(),
                opacities: scalar(Attribute::Opacity),
            },
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
        Attribute::ALL
            .iter()
            .map(|&attribute| match attribute {
                Attribute::Mean => of_vec3(&grad.gaussians.means, &|_, d| d),
                Attribute::Scale => of_vec3(&grad.gaussians.scales, &|i, d| d * at.gaussians.scales[i]),
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
    pub fn adam_step(&mut self, gradients: &[Vec<f32>], rate: impl Fn(Attribute) -> f32, t: u64) {
        for (group, gradient) in self.groups.iter_mut().zip(gradients) {
            let rate = rate(group.attribute);
            if rate > 0.0 {
                adam_step(&mut group.values, &mut group.moments, gradient, rate, t);
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
        Self { groups, len: sources.len() }
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

    fn example() -> GaussianParameters {
        let mut p = GaussianParameters::zeros(3, 2, 1);
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
        let p = GaussianParameters::zeros(1, 0, 0);
        let at = p.activate();
        let grad = ActivatedGrad { normals: vec![Vec3::ONE], ..Default::default() };
        assert!(p.pull(&at, &grad).iter().flatten().all(|v| v.is_finite()));
        assert_eq!(at.normals[0], Vec3::Z);
    }
}
