//! The vocabulary: a cloud of Gaussians with colour in spherical harmonics, as splat files hold it.
//!
//! Values are raw where files hold them raw (logarithm of the scales, logit of the opacity), because that is what the most
//! exact of the formats stores; the others are converted in double precision and rounded once.
use crate::SplatFileError;
use crate::error::malformed;
use diamond_light::spherical_harmonics::basis;
use diamond_splat::{Gaussians, SH_DC};
use glam::{Quat, Vec3};

/// Largest degree of spherical harmonics that a cloud holds.
pub const MAX_DEGREE: usize = 3;

/// Opacities 0 and 1 have this logit: σ(20) is 1 in 32 bits and σ(−20) is 2·10⁻⁹.
pub const MAX_LOGIT: f32 = 20.0;

/// Scales of 0 and infinity have this logarithm, e⁻⁴⁰ ≈ 4·10⁻¹⁸.
pub const MAX_LOG_SCALE: f32 = 40.0;

/// What the colour's numbers mean. Splats are blended in it as they are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ColorSpace {
    /// sRGB with its transfer, for display: what photographs as files hold, and what splat programs take for granted.
    #[default]
    Display,
    /// Linear, with the primaries of sRGB.
    Linear,
}

/// A cloud of Gaussians. Every list has one entry per Gaussian.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SplatCloud {
    /// Centres, world coordinates as in the file, scene units.
    pub means: Vec<Vec3>,
    /// Natural logarithm of the standard deviations along the local axes, scene units.
    pub log_scales: Vec<Vec3>,
    /// Local → world rotations, perhaps not normalised.
    pub rotations: Vec<Quat>,
    /// Logit of the peak opacity.
    pub opacity_logits: Vec<f32>,
    /// Degree of the colour, 0 to [`MAX_DEGREE`].
    pub degree: usize,
    /// Colour in real spherical harmonics, N × (degree + 1)² × 3: coefficient `l² + l + m` after coefficient, red green
    /// blue within. The colour toward a viewer is ½ + Σ coefficient · Y(direction from the viewer to the Gaussian).
    pub sh: Vec<f32>,
    /// Normals, where the file has some that are not zero. Only PLY holds them.
    pub normals: Option<Vec<Vec3>>,
    /// Whether the splats were fitted with an antialiasing filter in place of dilation. Only SPZ says it.
    pub antialiased: bool,
    /// What the colour's numbers mean. Only glTF says it.
    pub color_space: ColorSpace,
}

/// Coefficients of a degree and all below it.
pub(crate) const fn coefficients(degree: usize) -> usize {
    (degree + 1) * (degree + 1)
}

/// σ in double precision, rounded once.
pub(crate) fn sigmoid(logit: f32) -> f32 {
    (1.0 / (1.0 + libm::exp(-f64::from(logit)))) as f32
}

/// The logit of an opacity, within ± [`MAX_LOGIT`].
pub(crate) fn logit(opacity: f64) -> f32 {
    let o = opacity.clamp(0.0, 1.0);
    (libm::log(o / (1.0 - o)) as f32).clamp(-MAX_LOGIT, MAX_LOGIT)
}

/// The logarithm of a scale, within ± [`MAX_LOG_SCALE`].
pub(crate) fn log_scale(scale: f64) -> f32 {
    (libm::log(scale.max(0.0)) as f32).clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE)
}

/// The scale, in double precision and rounded once; finite whatever the logarithm.
pub(crate) fn scale(log: f32) -> f32 {
    libm::exp(f64::from(log.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE))) as f32
}

/// The unit quaternion; the identity in place of zero.
pub(crate) fn unit(q: Quat) -> Quat {
    let [x, y, z, w] = q.to_array().map(f64::from);
    let length = (x * x + y * y + z * z + w * w).sqrt();
    if length > 0.0 && length.is_finite() {
        Quat::from_xyzw((x / length) as f32, (y / length) as f32, (z / length) as f32, (w / length) as f32)
    } else {
        Quat::IDENTITY
    }
}

impl SplatCloud {
    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Coefficients per Gaussian and channel, (degree + 1)².
    pub fn coefficients(&self) -> usize {
        coefficients(self.degree)
    }

    /// `count` Gaussians of a degree, all zero but for the rotations.
    pub fn zeros(count: usize, degree: usize) -> Self {
        Self {
            means: vec![Vec3::ZERO; count],
            log_scales: vec![Vec3::ZERO; count],
            rotations: vec![Quat::IDENTITY; count],
            opacity_logits: vec![0.0; count],
            degree,
            sh: vec![0.0; count * coefficients(degree) * 3],
            ..Self::default()
        }
    }

    /// Errors unless the lists have equal lengths, the degree is at most [`MAX_DEGREE`] and every value is finite.
    pub fn validate(&self) -> Result<(), SplatFileError> {
        const CLOUD: &str = "splat cloud";
        const ADVICE: &str = "correct the cloud before writing it";
        let n = self.len();
        if self.degree > MAX_DEGREE {
            return Err(malformed(CLOUD, "degree", format!("0 to {MAX_DEGREE}"), self.degree.to_string(), ADVICE));
        }
        let lengths = [
            ("log_scales", self.log_scales.len(), n),
            ("rotations", self.rotations.len(), n),
            ("opacity_logits", self.opacity_logits.len(), n),
            ("sh", self.sh.len(), n * self.coefficients() * 3),
            ("normals", self.normals.as_ref().map_or(n, Vec::len), n),
        ];
        for (field, found, expected) in lengths {
            if found != expected {
                return Err(malformed(CLOUD, field, format!("{expected} values"), found.to_string(), ADVICE));
            }
        }
        let bad = |v: &Vec3| !v.is_finite();
        let width = self.coefficients() * 3;
        let finite = [
            ("means", self.means.iter().position(bad)),
            ("log_scales", self.log_scales.iter().position(bad)),
            ("rotations", self.rotations.iter().position(|q| !q.is_finite())),
            ("opacity_logits", self.opacity_logits.iter().position(|v| !v.is_finite())),
            ("sh", self.sh.iter().position(|v| !v.is_finite()).map(|i| i / width)),
            ("normals", self.normals.as_ref().and_then(|n| n.iter().position(bad))),
        ];
        for (field, position) in finite {
            if let Some(index) = position {
                let found = format!("NaN or infinity in Gaussian {index}");
                return Err(malformed(CLOUD, field, "finite numbers", found, ADVICE));
            }
        }
        Ok(())
    }

    /// Peak opacity of Gaussian `i`, [0, 1].
    pub fn opacity(&self, i: usize) -> f32 {
        sigmoid(self.opacity_logits[i])
    }

    /// The colour of Gaussian `i` without its dependence on direction: ½ + Y₀₀ · coefficient 0, not clamped.
    pub fn base_color(&self, i: usize) -> Vec3 {
        let at = i * self.coefficients() * 3;
        Vec3::from_slice(&self.sh[at..at + 3]) * SH_DC + 0.5
    }

    /// The colour of Gaussian `i` seen along the unit `direction` (from the viewer to it), not below 0.
    pub fn color(&self, i: usize, direction: Vec3) -> Vec3 {
        let k = self.coefficients();
        let sum: Vec3 = self.sh[i * k * 3..(i + 1) * k * 3]
            .chunks_exact(3)
            .zip(basis(direction))
            .map(|(c, y)| Vec3::from_slice(c) * y)
            .sum();
        (sum + 0.5).max(Vec3::ZERO)
    }

    /// The Gaussians after activation, for the rasteriser: σ, exp with the exponent within ±[`MAX_LOG_SCALE`].
    pub fn to_gaussians(&self) -> Gaussians {
        Gaussians {
            means: self.means.clone(),
            scales: self.log_scales.iter().map(|s| Vec3::new(scale(s.x), scale(s.y), scale(s.z))).collect(),
            rotations: self.rotations.iter().map(|q| unit(*q)).collect(),
            opacities: self.opacity_logits.iter().map(|v| sigmoid(*v)).collect(),
            factors: Vec::new(),
        }
    }

    /// Drops the colour's degrees above `degree`.
    pub fn limit_degree(&mut self, degree: usize) {
        if degree < self.degree {
            let (old, new) = (self.coefficients() * 3, coefficients(degree) * 3);
            self.sh = self.sh.chunks_exact(old).flat_map(|row| row[..new].iter().copied()).collect();
            self.degree = degree;
        }
    }

    /// Adds coefficients of zero up to `degree`.
    pub fn raise_degree(&mut self, degree: usize) {
        if degree > self.degree {
            let (old, new) = (self.coefficients() * 3, coefficients(degree) * 3);
            let mut sh = vec![0.0; self.len() * new];
            for (to, from) in sh.chunks_exact_mut(new).zip(self.sh.chunks_exact(old)) {
                to[..old].copy_from_slice(from);
            }
            (self.sh, self.degree) = (sh, degree);
        }
    }

    /// Appends another cloud; the degree becomes the larger of the two, normals stay where both have them.
    pub fn append(&mut self, mut other: SplatCloud) {
        if self.is_empty() {
            *self = other;
            return;
        }
        self.raise_degree(other.degree);
        other.raise_degree(self.degree);
        self.means.append(&mut other.means);
        self.log_scales.append(&mut other.log_scales);
        self.rotations.append(&mut other.rotations);
        self.opacity_logits.append(&mut other.opacity_logits);
        self.sh.append(&mut other.sh);
        self.normals = match (self.normals.take(), other.normals) {
            (Some(mut a), Some(mut b)) => {
                a.append(&mut b);
                Some(a)
            }
            _ => None,
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn activations_invert_and_stay_finite() {
        for o in [0.0, 1e-9, 1e-3, 0.25, 0.5, 0.999, 1.0] {
            assert!((f64::from(sigmoid(logit(o))) - o).abs() <= 6e-8, "{o}");
        }
        for s in [1e-17, 1e-5, 1.0, 3e4] {
            assert!((f64::from(scale(log_scale(s))) / s - 1.0).abs() <= 3e-6, "{s}");
        }
        assert_eq!(log_scale(0.0), -MAX_LOG_SCALE);
        assert!(scale(f32::MAX).is_finite() && sigmoid(f32::MIN) == 0.0);
        assert_eq!(unit(Quat::from_xyzw(0.0, 0.0, 0.0, 0.0)), Quat::IDENTITY);
    }

    #[test]
    fn degrees_change_without_touching_what_stays() {
        let mut cloud = SplatCloud::zeros(2, 1);
        cloud.sh = (0..24).map(|v| v as f32).collect();
        let before = cloud.clone();
        cloud.raise_degree(3);
        assert_eq!(cloud.sh.len(), 2 * 48);
        cloud.validate().unwrap();
        cloud.limit_degree(1);
        assert_eq!(cloud, before);
        let mut both = SplatCloud::zeros(1, 0);
        both.append(before.clone());
        assert_eq!((both.len(), both.degree, both.sh[12..36].to_vec()), (3, 1, before.sh.clone()));
    }

    #[test]
    fn what_cannot_be_written_is_named() {
        let mut cloud = SplatCloud::zeros(2, 0);
        cloud.sh[4] = f32::NAN;
        assert!(
            cloud
                .validate()
                .unwrap_err()
                .to_string()
                .contains("sh: expected finite numbers, found NaN or infinity in Gaussian 1")
        );
        cloud.sh.pop();
        assert!(cloud.validate().unwrap_err().to_string().contains("sh: expected 6 values, found 5"));
    }
}
