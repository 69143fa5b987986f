//! The surface BRDF: a microfacet mirror over a diffuse base, in the variants that the literature mixes.
//!
//! f = D·G·F / (4·n·v·n·l) + diffuse, per steradian and per colour channel. [`BrdfModel::evaluate`] is f itself, without
//! the cosine; [`BrdfModel::reflect`] is what a light of some irradiance sends to the viewer, f·irradiance·max(0, n·l).
//! Both are exactly zero where the light or the viewer is at or below the horizon.
//!
//! ```
//! use diamond_shading::{BrdfModel, Material};
//! use glam::Vec3;
//! let clay = Material { base_color: Vec3::new(0.8, 0.5, 0.3), roughness: 0.6, metalness: 0.0 };
//! let light = Vec3::new(0.6, 0.0, 0.8);
//! let radiance = BrdfModel::default().reflect(&clay, Vec3::Z, Vec3::Z, light, Vec3::ONE);
//! assert!(radiance.x > radiance.z && radiance.z > 0.0);
//! assert_eq!(BrdfModel::default().reflect(&clay, Vec3::Z, Vec3::Z, -light, Vec3::ONE), Vec3::ZERO);
//! ```
use crate::angles::{Angles, AnglesGrad, AnglesOf, DirectionsGrad, DirectionsGradOf};
use crate::fresnel::Fresnel;
use crate::ggx::{self, Masking};
use crate::material::{DIELECTRIC_F0, Material, MaterialGrad, Surface};
use crate::number::Number;
use crate::vector::Vector;
use glam::Vec3;
use std::f32::consts::FRAC_1_PI;

/// Which diffuse lobe lies under the mirror.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Diffuse {
    /// (1 − metalness)·base_color/π. Together with the mirror it may return more light than arrives.
    Lambert,
    /// (1 − F)·0.96·(1 − metalness)·base_color/π: what the facet between viewer and light mirrored is not diffused again
    /// (SSS-3DGS). White dielectrics seen from above lose a little; seen at grazing angles they still gain up to a quarter.
    #[default]
    FresnelWeighted,
    /// None: what is diffused comes from transport under the surface instead.
    Omitted,
}

/// One choice of masking, Fresnel and diffuse term. The default is the physical one of each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct BrdfModel {
    /// Masking and shadowing.
    pub masking: Masking,
    /// Fresnel reflectance.
    pub fresnel: Fresnel,
    /// Diffuse lobe.
    pub diffuse: Diffuse,
}

/// Gradient of a scalar with respect to everything that [`BrdfModel::reflect`] reads.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ReflectGrad {
    /// With respect to the material.
    pub material: MaterialGrad,
    /// With respect to the normal, as a free vector (see [`DirectionsGrad`]).
    pub normal: Vec3,
    /// With respect to the direction to the viewer, as a free vector.
    pub view: Vec3,
    /// With respect to the direction to the light, as a free vector.
    pub light: Vec3,
    /// With respect to the irradiance, linear RGB.
    pub irradiance: Vec3,
}

/// The least that the cosines toward the viewer and the light are taken for. 0 is physical: no light at or below the
/// horizon. A positive floor keeps shading, and hence learning, alive beyond it; where a floor is in force, its cosine has
/// no gradient and everything else keeps its own.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CosineFloor {
    /// Least n·v.
    pub view: f32,
    /// Least n·l.
    pub light: f32,
}

impl BrdfModel {
    /// The terms of SSS-3DGS: Schlick masking with k = (r+1)²/8, spherical-Gaussian Fresnel, Fresnel-weighted diffuse.
    pub const SSS_3DGS: BrdfModel = BrdfModel {
        masking: Masking::SchlickRoughness,
        fresnel: Fresnel::SphericalGaussian,
        diffuse: Diffuse::FresnelWeighted,
    };

    /// f at the given angles, linear RGB per steradian, for cosines in `(0, 1]` (no horizon test).
    /// `[eq:brdf]` `[eq:diffuse]`
    #[inline]
    pub fn evaluate_at(&self, material: &Material, angles: &Angles) -> Vec3 {
        self.evaluate_of(&material.into(), &angles.into()).into()
    }

    /// [`BrdfModel::evaluate_at`] of one pixel or many.
    #[inline(always)]
    pub(crate) fn evaluate_of<T: Number>(&self, material: &Surface<T>, angles: &AnglesOf<T>) -> Vector<T> {
        let roughness = material.shaded_roughness();
        let f = self.fresnel.reflectance_of(material.f0(), angles.cos_theta_d);
        let specular = ggx::distribution_of(roughness * roughness, angles.sin2_theta_h)
            * self.masking.over_cosines_of(roughness, angles.cos_theta_o, angles.cos_theta_i);
        let lambert = material.base_color * (material.metalness.complement() * FRAC_1_PI);
        let diffuse = match self.diffuse {
            Diffuse::Lambert => lambert,
            Diffuse::FresnelWeighted => f.complement() * specular.same(1.0 - DIELECTRIC_F0) * lambert,
            Diffuse::Omitted => lambert * specular.same(0.0),
        };
        f * specular + diffuse
    }

    /// Pullback of [`BrdfModel::evaluate_at`].
    /// `[eq:brdf]` `[eq:diffuse]`
    #[inline]
    pub fn evaluate_at_pull(&self, material: &Material, angles: &Angles, d_out: Vec3) -> (MaterialGrad, AnglesGrad) {
        let (material, d) = self.evaluate_pull_of(&material.into(), &angles.into(), d_out.into());
        let AnglesOf { cos_theta_i, cos_theta_o, cos_theta_d, sin2_theta_h } = d;
        (material.into(), AnglesGrad { cos_theta_i, cos_theta_o, cos_theta_d, sin2_theta_h })
    }

    /// [`BrdfModel::evaluate_at_pull`] of one pixel or many.
    #[inline(always)]
    pub(crate) fn evaluate_pull_of<T: Number>(
        &self,
        material: &Surface<T>,
        angles: &AnglesOf<T>,
        d_out: Vector<T>,
    ) -> (Surface<T>, AnglesOf<T>) {
        let roughness = material.shaded_roughness();
        let alpha = roughness * roughness;
        let (f0, co, ci) = (material.f0(), angles.cos_theta_o, angles.cos_theta_i);
        let f = self.fresnel.reflectance_of(f0, angles.cos_theta_d);
        let d = ggx::distribution_of(alpha, angles.sin2_theta_h);
        let g = self.masking.over_cosines_of(roughness, co, ci);

        // Specular: d·g·F.
        let d_product = d_out.dot(f);
        let mut d_f = d_out * (d * g);
        let (d_alpha, d_sin2) = ggx::distribution_pull_of(alpha, angles.sin2_theta_h, d_product * g);
        let masking = self.masking.over_cosines_pull_of(roughness, co, ci, d_product * d);
        let d_roughness = material.shaded_roughness_pull(masking.roughness + roughness * 2.0 * d_alpha);

        // Diffuse.
        let dielectric = material.metalness.complement() * FRAC_1_PI;
        let d_lambert = match self.diffuse {
            Diffuse::Lambert => d_out,
            Diffuse::Omitted => d_out * d.same(0.0),
            Diffuse::FresnelWeighted => {
                let weighted = d_out * d.same(1.0 - DIELECTRIC_F0);
                d_f = d_f - weighted * material.base_color * dielectric;
                weighted * f.complement()
            }
        };

        let (d_f0, d_cos_theta_d) = self.fresnel.reflectance_pull_of(f0, angles.cos_theta_d, d_f);
        let (by_f0, metal_by_f0) = material.f0_pull(d_f0);
        let material = Surface {
            base_color: d_lambert * dielectric + by_f0,
            roughness: d_roughness,
            metalness: metal_by_f0 - d_lambert.dot(material.base_color) * FRAC_1_PI,
        };
        let angles = AnglesOf {
            cos_theta_i: masking.cos_theta_i,
            cos_theta_o: masking.cos_theta_o,
            cos_theta_d: d_cos_theta_d,
            sin2_theta_h: d_sin2,
        };
        (material, angles)
    }

    /// The BRDF f, linear RGB per steradian, without the cosine; zero where n·l ≤ 0 or n·v ≤ 0.
    /// Directions are unit vectors that point away from the surface.
    /// `[eq:brdf]`
    pub fn evaluate(&self, material: &Material, normal: Vec3, view: Vec3, light: Vec3) -> Vec3 {
        let angles = Angles::new(normal, view, light);
        if angles.cos_theta_i >= MIN_COSINE && angles.cos_theta_o >= MIN_COSINE {
            self.evaluate_at(material, &angles)
        } else {
            Vec3::ZERO
        }
    }

    /// Radiance toward the viewer, linear RGB: irradiance·f·max(0, n·l); exactly zero where n·l ≤ 0 or n·v ≤ 0.
    /// `irradiance` is measured on a plane that faces the light; directions are unit vectors away from the surface.
    /// `[eq:reflect]`
    pub fn reflect(&self, material: &Material, normal: Vec3, view: Vec3, light: Vec3, irradiance: Vec3) -> Vec3 {
        self.reflect_above(CosineFloor::default(), material, normal, view, light, irradiance)
    }

    /// Pullback of [`BrdfModel::reflect`]; zero where it is zero.
    /// `[eq:reflect]`
    pub fn reflect_pull(
        &self,
        material: &Material,
        normal: Vec3,
        view: Vec3,
        light: Vec3,
        irradiance: Vec3,
        d_out: Vec3,
    ) -> ReflectGrad {
        self.reflect_above_pull(CosineFloor::default(), material, normal, view, light, irradiance, d_out)
    }

    /// [`BrdfModel::reflect`] with both cosines raised to a floor first.
    /// `[eq:reflect]`
    pub fn reflect_above(
        &self,
        floor: CosineFloor,
        material: &Material,
        normal: Vec3,
        view: Vec3,
        light: Vec3,
        irradiance: Vec3,
    ) -> Vec3 {
        let facing = Facing { normal: normal.into(), view: view.into(), light: light.into() };
        self.reflect_of(floor, &material.into(), &facing, irradiance.into()).into()
    }

    /// [`BrdfModel::reflect_above`] of one pixel or many.
    #[inline(always)]
    pub(crate) fn reflect_of<T: Number>(
        &self,
        floor: CosineFloor,
        material: &Surface<T>,
        facing: &Facing<T>,
        irradiance: Vector<T>,
    ) -> Vector<T> {
        if floor.turned_away(facing) {
            return Vector::same(facing.normal.x, Vec3::ZERO);
        }
        let (angles, lit) = floor.raise(AnglesOf::new(facing.normal, facing.view, facing.light));
        (irradiance * self.evaluate_of(material, &angles) * angles.cos_theta_i).only_where(lit)
    }

    /// Pullback of [`BrdfModel::reflect_above`].
    /// `[eq:reflect]`
    pub fn reflect_above_pull(
        &self,
        floor: CosineFloor,
        material: &Material,
        normal: Vec3,
        view: Vec3,
        light: Vec3,
        irradiance: Vec3,
        d_out: Vec3,
    ) -> ReflectGrad {
        let facing = Facing { normal: normal.into(), view: view.into(), light: light.into() };
        let (_, d) = self.reflect_pull_of(floor, &material.into(), &facing, irradiance.into(), d_out.into());
        let DirectionsGrad { normal, view, light } = d.directions.into();
        ReflectGrad { material: d.material.into(), normal, view, light, irradiance: d.irradiance.into() }
    }

    /// [`BrdfModel::reflect_above_pull`] of one pixel or many, after the value.
    #[inline(always)]
    pub(crate) fn reflect_pull_of<T: Number>(
        &self,
        floor: CosineFloor,
        material: &Surface<T>,
        facing: &Facing<T>,
        irradiance: Vector<T>,
        d_out: Vector<T>,
    ) -> (Vector<T>, ReflectGradOf<T>) {
        let (n, v, l) = (facing.normal, facing.view, facing.light);
        if floor.turned_away(facing) {
            let (zero, none) = (n.x.same(0.0), Vector::same(n.x, Vec3::ZERO));
            let material = Surface { base_color: none, roughness: zero, metalness: zero };
            let directions = DirectionsGradOf { normal: none, view: none, light: none };
            return (none, ReflectGradOf { material, directions, irradiance: none });
        }
        let free = AnglesOf::new(n, v, l);
        let (angles, lit) = floor.raise(free);
        let f = self.evaluate_of(material, &angles);
        let value = (irradiance * f * angles.cos_theta_i).only_where(lit);
        // Beyond the horizon the cosines are replaced by 1, so that everything is finite, and the cotangent by 0.
        let d_out = d_out.only_where(lit);
        let d_lit = d_out * irradiance;
        let (material, mut d) = self.evaluate_pull_of(material, &angles, d_lit * angles.cos_theta_i);
        d.cos_theta_i = (d.cos_theta_i + d_lit.dot(f)).only_where(!free.cos_theta_i.under(floor.light));
        d.cos_theta_o = d.cos_theta_o.only_where(!free.cos_theta_o.under(floor.view));
        let directions = AnglesOf::pull(n, v, l, &d);
        (value, ReflectGradOf { material, directions, irradiance: d_out * f * angles.cos_theta_i })
    }
}

/// The three unit directions of one pixel or many.
pub(crate) struct Facing<T> {
    pub normal: Vector<T>,
    pub view: Vector<T>,
    pub light: Vector<T>,
}

/// [`ReflectGrad`] of one pixel or many.
pub(crate) struct ReflectGradOf<T> {
    pub material: Surface<T>,
    pub directions: DirectionsGradOf<T>,
    pub irradiance: Vector<T>,
}

impl CosineFloor {
    /// Whether the light is behind the surface in every lane by more than rounding, so that nothing is reflected and nothing need
    /// be computed. With a floor there is always something.
    #[inline(always)]
    fn turned_away<T: Number>(&self, facing: &Facing<T>) -> bool {
        self.light < MIN_COSINE && T::everywhere(facing.normal.dot(facing.light).under(-TURNED_AWAY))
    }

    /// The angles with both cosines raised, and where both are positive; elsewhere they are 1.
    #[inline(always)]
    fn raise<T: Number>(&self, angles: AnglesOf<T>) -> (AnglesOf<T>, T::Mask) {
        let cos_theta_i = angles.cos_theta_i.at_least(self.light);
        let cos_theta_o = angles.cos_theta_o.at_least(self.view);
        let lit = cos_theta_i.reaches(MIN_COSINE) & cos_theta_o.reaches(MIN_COSINE);
        let one = cos_theta_i.same(1.0);
        let cos_theta_i = cos_theta_i.or_where_not(lit, one);
        let cos_theta_o = cos_theta_o.or_where_not(lit, one);
        (AnglesOf { cos_theta_i, cos_theta_o, ..angles }, lit)
    }
}

/// n·l in `f32` is off by a few units of the last place: below minus this it is negative.
const TURNED_AWAY: f32 = 1e-5;

/// Cosines count as positive from here on: the reciprocal of a subnormal one is infinite.
const MIN_COSINE: f32 = f32::MIN_POSITIVE;

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::adjoint::{relative_l2, worst_relative};
    use diamond_testkit::strategies::{colour, unit_vector, upper_direction};
    use diamond_testkit::{Dual, Real, ggx as naive, gradient};
    use proptest::prelude::*;

    /// All sixteen models beside the oracle's.
    pub(crate) fn models() -> Vec<(BrdfModel, naive::Model)> {
        let maskings = [
            (Masking::SmithSeparable, naive::Masking::SmithSeparable),
            (Masking::SmithCorrelated, naive::Masking::SmithCorrelated),
            (Masking::SchlickRoughness, naive::Masking::SchlickRoughness),
            (Masking::SchlickHalfAlpha, naive::Masking::SchlickHalfAlpha),
        ];
        let fresnels = [
            (Fresnel::Schlick, naive::Fresnel::Schlick),
            (Fresnel::SphericalGaussian, naive::Fresnel::SphericalGaussian),
        ];
        let diffuses = [
            (Diffuse::Lambert, naive::Diffuse::Lambert),
            (Diffuse::FresnelWeighted, naive::Diffuse::FresnelWeighted),
            (Diffuse::Omitted, naive::Diffuse::Omitted),
        ];
        let mut all = Vec::new();
        for (masking, m) in maskings {
            for (fresnel, f) in fresnels {
                for (diffuse, d) in diffuses {
                    all.push((
                        BrdfModel { masking, fresnel, diffuse },
                        naive::Model { masking: m, fresnel: f, diffuse: d },
                    ));
                }
            }
        }
        all
    }

    /// base 3, roughness, metalness, n, v, l, irradiance 3 → 17 numbers.
    fn pack(material: &Material, n: Vec3, v: Vec3, l: Vec3, irradiance: Vec3) -> Vec<f64> {
        let scalars = [material.roughness, material.metalness];
        [material.base_color.to_array().as_slice(), &scalars, &n.to_array(), &v.to_array(), &l.to_array()]
            .concat()
            .into_iter()
            .chain(irradiance.to_array())
            .map(f64::from)
            .collect()
    }

    fn oracle<R: Real>(model: naive::Model, x: &[R]) -> [R; 3] {
        let at = |i: usize| [x[i], x[i + 1], x[i + 2]];
        [0, 1, 2].map(|c| naive::reflect(model, x[c], x[3], x[4], at(5), at(8), at(11), x[14 + c]))
    }

    /// Gradient in the order of [`pack`], directions projected on their tangent planes as the oracle's are.
    fn flatten(g: &ReflectGrad, n: Vec3, v: Vec3, l: Vec3) -> Vec<f64> {
        let tangent = |g: Vec3, u: Vec3| (g - u * u.dot(g)).to_array();
        let scalars = [g.material.roughness, g.material.metalness];
        [
            g.material.base_color.to_array().as_slice(),
            &scalars,
            &tangent(g.normal, n),
            &tangent(g.view, v),
            &tangent(g.light, l),
            &g.irradiance.to_array(),
        ]
        .concat()
        .into_iter()
        .map(f64::from)
        .collect()
    }

    /// The worst relative L2 error over the seven arguments, each against its own norm and a share of all of it.
    fn gap(actual: &[f64], expected: &[f64]) -> f64 {
        let all = expected.iter().map(|v| v * v).sum::<f64>().sqrt();
        [0..3, 3..4, 4..5, 5..8, 8..11, 11..14, 14..17]
            .into_iter()
            .map(|r| relative_l2(&actual[r.clone()], &expected[r], 1e-2 * all.max(1e-6)))
            .fold(0.0, f64::max)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(192))]

        /// `[eq:brdf]` `[eq:diffuse]` `[eq:reflect]`
        #[test]
        fn reflect_and_its_pullback_agree_with_the_oracle(
            base_color in colour(), roughness in 0.2f32..1.0, metalness in 0.0f32..1.0, n in unit_vector(),
            v in upper_direction(0.02), l in upper_direction(0.02), irradiance in colour(),
            d_out in [-1.0f32..1.0, -1.0f32..1.0, -1.0f32..1.0], model in 0usize..16,
        ) {
            // v and l are drawn about z: turn them so that they lie about n.
            let n = Vec3::from(n).normalize();
            let (t, b) = n.any_orthonormal_pair();
            let turn = |u: [f32; 3]| (t * u[0] + b * u[1] + n * u[2]).normalize();
            let (v, l) = (turn(v), turn(l));
            // Not quite black: of a black metal the Fresnel term leaves (1 − v·h)⁵ alone, and v·h has seven digits.
            let base_color = Vec3::from(base_color) * 0.95 + 0.05;
            let material = Material { base_color, roughness, metalness };
            let (irradiance, d_out) = (Vec3::from(irradiance), Vec3::from(d_out));
            let (model, theirs) = models()[model];
            let x = pack(&material, n, v, l, irradiance);
            let expected = oracle::<f64>(theirs, &x);
            let actual = model.reflect(&material, n, v, l, irradiance).to_array().map(f64::from);
            prop_assert!(worst_relative(&actual, &expected, 1e-9) <= 1e-5, "{actual:?} {expected:?}");
            let expected = gradient(|x| {
                let f = oracle(theirs, x);
                (0..3).fold(Dual::of(0.0), |s, c| s + f[c] * Dual::of(f64::from(d_out[c])))
            }, &x);
            let grad = model.reflect_pull(&material, n, v, l, irradiance, d_out);
            let actual = flatten(&grad, n, v, l);
            prop_assert!(gap(&actual, &expected) <= 1e-4, "{:e}\n{actual:?}\n{expected:?}", gap(&actual, &expected));
        }
    }

    /// A wrong derivative of any one argument, by a percent, is seen.
    #[test]
    fn planted_errors_are_noticed() {
        let material = Material { base_color: Vec3::new(0.8, 0.4, 0.2), roughness: 0.4, metalness: 0.3 };
        let (n, v, l) = (Vec3::Z, Vec3::new(0.6, 0.0, 0.8), Vec3::new(-0.48, 0.36, 0.8));
        let (model, theirs) = models()[5];
        let x = pack(&material, n, v, l, Vec3::ONE);
        let expected = gradient(|x| oracle(theirs, x).into_iter().fold(Dual::of(0.0), |s, f| s + f), &x);
        let actual = flatten(&model.reflect_pull(&material, n, v, l, Vec3::ONE, Vec3::ONE), n, v, l);
        assert!(gap(&actual, &expected) <= 1e-5);
        for i in 0..actual.len() {
            let mut wrong = actual.clone();
            wrong[i] *= 1.05;
            assert!(actual[i] == 0.0 || actual[i].abs() < 1e-3 || gap(&wrong, &expected) > 1e-4, "argument {i}");
        }
    }

    /// `[eq:reflect]`
    #[test]
    fn floors_keep_the_back_alive_and_zero_floors_do_not() {
        let material = Material { base_color: Vec3::splat(0.5), roughness: 0.5, metalness: 0.0 };
        let (n, v) = (Vec3::Z, Vec3::new(0.6, 0.0, -0.8));
        let l = Vec3::new(0.0, 0.6, 0.8);
        let model = BrdfModel::default();
        assert_eq!(model.reflect(&material, n, v, l, Vec3::ONE), Vec3::ZERO);
        assert_eq!(model.reflect_pull(&material, n, v, l, Vec3::ONE, Vec3::ONE), ReflectGrad::default());
        let floor = CosineFloor { view: 1e-4, light: 0.0 };
        assert!(model.reflect_above(floor, &material, n, v, l, Vec3::ONE).min_element() > 0.0);
        let grad = model.reflect_above_pull(floor, &material, n, v, l, Vec3::ONE, Vec3::ONE);
        assert!(grad.normal.is_finite() && grad.normal.length() > 0.0 && grad.material.base_color.min_element() > 0.0);
    }
}
