//! Laws of surface shading: reciprocity, energy, positivity, the horizon, linearity, and finite answers everywhere.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::Image;
use diamond_light::{Falloff, OlatLight};
use diamond_shading::sh_visibility::{visibility, visibility_pull};
use diamond_shading::{
    BrdfModel, Diffuse, Fresnel, GBuffer, IncidentModel, Masking, Material, Prepared, ShadedGrad, ShadingConfig,
    SurfaceVisibility, channel, ggx, pseudo_normals, shade,
};
use diamond_testkit::strategies::{colour, extreme, unit_vector, upper_direction, values};
use glam::Vec3;
use proptest::prelude::*;
use std::f64::consts::PI;

const MASKINGS: [Masking; 4] =
    [Masking::SmithSeparable, Masking::SmithCorrelated, Masking::SchlickRoughness, Masking::SchlickHalfAlpha];

fn model() -> impl Strategy<Value = BrdfModel> {
    (
        prop::sample::select(MASKINGS.to_vec()),
        prop::sample::select(vec![Fresnel::Schlick, Fresnel::SphericalGaussian]),
        prop::sample::select(vec![Diffuse::Lambert, Diffuse::FresnelWeighted]),
    )
        .prop_map(|(masking, fresnel, diffuse)| BrdfModel { masking, fresnel, diffuse })
}

fn material() -> impl Strategy<Value = Material> {
    (colour(), 0.0f32..=1.0, 0.0f32..=1.0).prop_map(|(c, roughness, metalness)| Material {
        base_color: c.into(),
        roughness,
        metalness,
    })
}

/// ∫ f(l)·cos θ dω over the upper hemisphere by the midpoint rule, in the half-vector parametrisation: for each facet
/// direction drawn from D·cos θ_h, the mirrored light, so that narrow peaks are resolved.
fn specular_albedo(masking: Masking, roughness: f32, cos_theta_o: f64) -> f64 {
    let alpha = f64::from(roughness * roughness);
    let v = [(1.0 - cos_theta_o * cos_theta_o).sqrt(), 0.0, cos_theta_o];
    let (rings, spokes) = (256, 128);
    let mut sum = 0.0;
    for i in 0..rings {
        // Inverse of the cumulative distribution of D·cos θ_h.
        let u = (i as f64 + 0.5) / f64::from(rings);
        let cos2 = (1.0 - u) / (1.0 + u * (alpha * alpha - 1.0));
        let (c, s) = (cos2.sqrt(), (1.0 - cos2).sqrt());
        for j in 0..spokes {
            let phi = (f64::from(j) + 0.5) / f64::from(spokes) * 2.0 * PI;
            let h = [s * phi.cos(), s * phi.sin(), c];
            let vh = v[0] * h[0] + v[1] * h[1] + v[2] * h[2];
            let cos_theta_i = 2.0 * vh * h[2] - v[2];
            if vh <= 0.0 || cos_theta_i <= 0.0 {
                continue;
            }
            // f·cos θᵢ / pdf with F = 1 and pdf = D·cos θ_h/(4·v·h).
            let g = f64::from(masking.over_cosines(roughness, cos_theta_o as f32, cos_theta_i as f32));
            sum += g * cos_theta_i * 4.0 * vh / h[2];
        }
    }
    sum / f64::from(rings * spokes)
}

/// Energy: a mirror of F = 1 returns at most what arrives, for exact masking at any roughness and angle; and close to all
/// of it where it is smooth, since one bounce is then all there is.
#[test]
fn a_white_furnace_never_gains_energy() {
    for masking in [Masking::SmithSeparable, Masking::SmithCorrelated] {
        for roughness in [0.1, 0.3, 0.5, 0.8, 1.0] {
            for cos_theta_o in [0.02, 0.1, 0.3, 0.7, 1.0] {
                let albedo = specular_albedo(masking, roughness, cos_theta_o);
                assert!(albedo <= 1.0 + 2e-3, "{masking:?} roughness {roughness} cosine {cos_theta_o}: {albedo}");
                assert!(albedo > 0.3, "{masking:?} roughness {roughness} cosine {cos_theta_o}: {albedo}");
                if roughness == 0.1 && cos_theta_o > 0.2 {
                    assert!(albedo > 0.99, "{masking:?} cosine {cos_theta_o}: {albedo}");
                }
            }
        }
    }
}

/// Energy of the whole default BRDF, white, by uniform quadrature. A metal never gains any; a dielectric does not where it
/// is seen from well above, but does at grazing views, where the diffuse base is not told what the mirror took.
#[test]
fn metals_never_gain_energy_and_dielectrics_do_not_from_above() {
    let rings = 400;
    for metalness in [0.0, 0.5, 1.0] {
        for roughness in [0.3, 0.6, 1.0] {
            for cos_theta_o in [0.05f32, 0.3, 0.9] {
                let material = Material { base_color: Vec3::ONE, roughness, metalness };
                let v = Vec3::new((1.0 - cos_theta_o * cos_theta_o).sqrt(), 0.0, cos_theta_o);
                let mut sum = 0.0;
                for i in 0..rings {
                    let c = (i as f32 + 0.5) / rings as f32;
                    let s = (1.0 - c * c).sqrt();
                    for j in 0..rings {
                        let (sp, cp) = ((j as f32 + 0.5) / rings as f32 * std::f32::consts::TAU).sin_cos();
                        let l = Vec3::new(s * cp, s * sp, c);
                        let out = BrdfModel::default().reflect(&material, Vec3::Z, v, l, Vec3::ONE).x;
                        sum += f64::from(out) * 2.0 * PI / f64::from(rings * rings);
                    }
                }
                if metalness == 1.0 || cos_theta_o == 0.9 {
                    assert!(sum <= 1.005, "metalness {metalness} roughness {roughness} cosine {cos_theta_o}: {sum}");
                }
                assert!(sum <= 1.3, "metalness {metalness} roughness {roughness} cosine {cos_theta_o}: {sum}");
            }
        }
    }
}

/// Σ D·cos θ_h over the hemisphere is 1: facets cover the surface once.
#[test]
fn facets_cover_the_surface_once() {
    for roughness in [0.1f32, 0.4, 1.0] {
        let (alpha, n) = (roughness * roughness, 2_000_000);
        // In sin², where dω·cos = π·d(sin²), on a logarithmic grid that resolves the peak.
        let (low, high) = (1e-9f64.ln(), 0.0f64);
        let sum: f64 = (0..n)
            .map(|i| {
                let sin2 = (low + (high - low) * (f64::from(i) + 0.5) / f64::from(n)).exp();
                f64::from(ggx::distribution(alpha, sin2 as f32)) * PI * sin2 * (high - low) / f64::from(n)
            })
            .sum();
        assert!((sum - 1.0).abs() < 1e-4, "{roughness}: {sum}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    /// f(v, l) = f(l, v). Directions of f32 are of unit length to about ε only, so cos θ_d taken from v and from l differ by
    /// ε/|v + l|, which matters where light and viewer are opposite and both graze: relative to cos θ_d = |v + l|/2, to which
    /// the diffuse term is proportional there, by 2ε/|v + l|².
    #[test]
    fn reciprocity(model in model(), m in material(), v in upper_direction(0.01), l in upper_direction(0.01)) {
        let (a, b) = (model.evaluate(&m, Vec3::Z, v.into(), l.into()), model.evaluate(&m, Vec3::Z, l.into(), v.into()));
        let half = (Vec3::from(v) + Vec3::from(l)).length_squared();
        let tolerance = 1e-5 + 4.0 * f32::EPSILON / half;
        prop_assert!((a - b).abs().max_element() <= tolerance * a.max_element(), "{a} {b}");
    }

    /// f ≥ 0, and the light of a linear sum is the sum of the lights.
    #[test]
    fn positive_and_linear_in_irradiance(
        model in model(), m in material(), v in unit_vector(), l in unit_vector(), a in colour(), b in colour(),
    ) {
        let of = |e: Vec3| model.reflect(&m, Vec3::Z, v.into(), l.into(), e);
        let (a, b) = (Vec3::from(a), Vec3::from(b));
        prop_assert!(of(a).min_element() >= 0.0);
        let (whole, parts) = (of(a * 2.0 + b), of(a) * 2.0 + of(b));
        prop_assert!((whole - parts).abs().max_element() <= 1e-5 * parts.max_element().max(1e-30), "{whole} {parts}");
    }

    /// Below the horizon of light or viewer: exactly black, no gradient.
    #[test]
    fn black_below_the_horizon(model in model(), m in material(), v in upper_direction(0.0), l in upper_direction(0.0)) {
        let (v, l) = (Vec3::from(v), Vec3::from(l));
        for (v, l) in [(v, -l), (-v, l), (-v, -l), (v, Vec3::X), (Vec3::Y, l)] {
            prop_assert_eq!(model.evaluate(&m, Vec3::Z, v, l), Vec3::ZERO);
            prop_assert_eq!(model.reflect(&m, Vec3::Z, v, l, Vec3::ONE), Vec3::ZERO);
            prop_assert_eq!(model.reflect_pull(&m, Vec3::Z, v, l, Vec3::ONE, Vec3::ONE), Default::default());
        }
    }

    /// The reflected light does not depend on the frame.
    #[test]
    fn rotation_changes_nothing(
        model in model(), m in material(), v in upper_direction(0.05), l in upper_direction(0.05), n in unit_vector(),
    ) {
        let m = Material { roughness: m.roughness.max(0.2), ..m };
        let turn = glam::Quat::from_rotation_arc(Vec3::Z, Vec3::from(n).normalize());
        let (v, l) = (Vec3::from(v), Vec3::from(l));
        let a = model.reflect(&m, Vec3::Z, v, l, Vec3::ONE);
        let b = model.reflect(&m, turn * Vec3::Z, turn * v, turn * l, Vec3::ONE);
        prop_assert!((a - b).abs().max_element() <= 1e-4 * a.max_element(), "{a} {b}");
    }

    /// Any roughness, any angle, v = −l and v = l included: finite values and gradients.
    #[test]
    fn finite_everywhere(
        model in model(), m in material(), rough in extreme(), v in unit_vector(), l in unit_vector(), tie in 0u8..5,
        tilt in -30.0f32..0.0,
    ) {
        let v = Vec3::from(v);
        let grazing = Vec3::new(1.0, 0.0, tilt.exp()).normalize();
        let (v, l) = match tie {
            0 => (v, -v),
            1 => (v, v),
            2 => (grazing, Vec3::new(-grazing.x, 0.0, grazing.z)),
            3 => (grazing, -grazing),
            _ => (v, l.into()),
        };
        let m = Material { roughness: rough, ..m };
        let out = model.reflect(&m, Vec3::Z, v, l, Vec3::splat(10.0));
        let g = model.reflect_pull(&m, Vec3::Z, v, l, Vec3::splat(10.0), Vec3::ONE);
        prop_assert!(out.is_finite(), "{out}");
        let vectors = [g.material.base_color, g.normal, g.view, g.light, g.irradiance];
        let finite = vectors.iter().all(|v| v.is_finite());
        prop_assert!(finite && g.material.roughness.is_finite() && g.material.metalness.is_finite(), "{g:?}");
    }

    /// V is a visibility, for any coefficients.
    #[test]
    fn visibility_is_between_zero_and_one(c in values(16, -50.0..50.0), l in unit_vector()) {
        let c: [f32; 16] = c.try_into().expect("16 values");
        prop_assert!((0.0..=1.0).contains(&visibility(&c, l.into())));
        let (d_c, d_l) = visibility_pull(&c, l.into(), 1.0);
        prop_assert!(d_c.iter().all(|v| v.is_finite()) && d_l.is_finite());
    }
}

const W: usize = 5;
const H: usize = 4;

fn camera() -> Camera {
    let intrinsics = Intrinsics::from_fov_x(0.8, W as u32, H as u32);
    Camera { intrinsics, pose: Pose::look_at(Vec3::new(0.0, 0.0, -3.0), Vec3::ZERO, Vec3::Y) }
}

/// A view of 14 channels from numbers in [0, 1], opacity, and depth around 3.
fn blend(raw: &[f32], opacity: &[f32]) -> [Image; 3] {
    let features = (0..W * H * channel::COUNT).map(|i| {
        let f = if channel::NORMAL.contains(&(i % channel::COUNT)) { 2.0 * raw[i] - 1.0 } else { raw[i] };
        f * opacity[i / channel::COUNT]
    });
    let depth = opacity.iter().enumerate().map(|(i, o)| o * (2.5 + raw[i]));
    [
        Image::from_vec(W, H, channel::COUNT, features.collect()).expect("shape"),
        Image::from_vec(W, H, 1, opacity.to_vec()).expect("shape"),
        Image::from_vec(W, H, 1, depth.collect()).expect("shape"),
    ]
}

fn buffer(images: &[Image; 3]) -> GBuffer<'_> {
    GBuffer { features: &images[0], opacity: &images[1], depth: &images[2] }
}

const LIGHT: OlatLight = OlatLight::Point { position: Vec3::new(1.0, -2.0, -3.0), intensity: Vec3::new(1.0, 0.8, 0.6) };

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// s = 0: the image is the surface's, whatever the residual, and the same as without a residual.
    #[test]
    fn without_subsurfaceness_there_is_only_surface(raw in values(W * H * 14, 0.0..1.0), o in values(W * H, 0.0..1.0)) {
        let mut images = blend(&raw, &o);
        images[0].data_mut().chunks_mut(channel::COUNT).for_each(|p| p[channel::SUBSURFACENESS] = 0.0);
        let config = ShadingConfig::default();
        let (with, _) = shade(&buffer(&images), &camera(), &LIGHT, &config).expect("shapes agree");
        prop_assert_eq!(&with.radiance, &with.surface);
        prop_assert!(with.subsurface.data().iter().all(|v| *v == 0.0));
        let config = ShadingConfig { use_residual: false, ..config };
        let (without, _) = shade(&buffer(&images), &camera(), &LIGHT, &config).expect("shapes agree");
        prop_assert_eq!(&with.radiance, &without.radiance);
    }

    /// Light is linear: an image under two intensities of one lamp is the sum of the two images.
    #[test]
    fn mixtures_of_lights_are_mixtures_of_images(
        raw in values(W * H * 14, 0.0..1.0), o in values(W * H, 0.0..1.0), a in colour(), b in colour(),
    ) {
        let images = blend(&raw, &o);
        let config = ShadingConfig {
            incident: IncidentModel::Physical(Falloff::InverseSquare { reference: 4.0 }),
            visibility: SurfaceVisibility::Multiplied,
            scale_residual_by_light: true,
            ..ShadingConfig::default()
        };
        let (a, b) = (Vec3::from(a), Vec3::from(b));
        let prepared = Prepared::new(&buffer(&images), &camera(), &config).expect("shapes agree");
        let transport = images[0].channels_range(channel::TRANSPORT);
        let of = |factor| prepared.shade(&LIGHT.scaled(factor), Some(&transport)).expect("shapes agree").radiance;
        let (both, first, second) = (of(a + b), of(a), of(b));
        for ((both, a), b) in both.data().iter().zip(first.data()).zip(second.data()) {
            prop_assert!((both - a - b).abs() <= 1e-5 * both.abs().max(1e-6), "{both} {a} {b}");
        }
    }

    /// Opacity fades to black, and materials do not depend on it.
    #[test]
    fn coverage_scales_radiance_and_leaves_materials(raw in values(W * H * 14, 0.0..1.0), o in 0.01f32..1.0) {
        let (full, thin) = (blend(&raw, &[1.0; W * H]), blend(&raw, &[o; W * H]));
        let config = ShadingConfig::default();
        let (full, _) = shade(&buffer(&full), &camera(), &LIGHT, &config).expect("shapes agree");
        let (thin, _) = shade(&buffer(&thin), &camera(), &LIGHT, &config).expect("shapes agree");
        for (f, t) in full.maps.base_color.data().iter().zip(thin.maps.base_color.data()) {
            prop_assert!((f - t).abs() <= 1e-6);
        }
        // Smooth facets amplify the rounding of the division: compare against the brightest pixel.
        let brightest = full.radiance.data().iter().fold(0.0f32, |a, b| a.max(*b));
        for (f, t) in full.radiance.data().iter().zip(thin.radiance.data()) {
            prop_assert!((f * o - t).abs() <= 1e-3 * (o * f.abs()).max(1e-3 * brightest), "{} {t}", f * o);
        }
    }

    /// Any opacity from nothing to all, any normal, any depth: finite images and gradients, and empty pixels are empty.
    #[test]
    fn views_stay_finite(
        raw in values(W * H * 14, 0.0..1.0), exponent in values(W * H, -20.0..0.0), zero in 0usize..14, far in 0.0f32..30.0,
    ) {
        let mut o: Vec<f32> = exponent.iter().map(|e| e.exp()).collect();
        o[3] = 0.0;
        let mut images = blend(&raw, &o);
        images[0].data_mut().chunks_mut(channel::COUNT).for_each(|p| p[zero] = 0.0);
        images[0].pixel_mut(0, 0)[channel::NORMAL].fill(0.0);
        images[2].pixel_mut(1, 0)[0] *= far.exp();
        images[2].pixel_mut(2, 0)[0] = 0.0;
        for normalise in [true, false] {
            let config = ShadingConfig { normalise, ..ShadingConfig::default() };
            let (shaded, pullback) = shade(&buffer(&images), &camera(), &LIGHT, &config).expect("shapes agree");
            prop_assert_eq!(shaded.radiance.first_non_finite(), None);
            prop_assert_eq!(shaded.maps.normal.first_non_finite(), None);
            prop_assert_eq!(shaded.maps.depth.first_non_finite(), None);
            prop_assert_eq!(shaded.radiance.pixel(3, 0), &[0.0; 3]);
            let d = ShadedGrad { radiance: Some(Image::filled(W, H, 3, 1.0)), ..ShadedGrad::default() };
            let grad = pullback.pull(&d).expect("shapes agree");
            prop_assert_eq!(grad.features.first_non_finite(), None);
            prop_assert_eq!(grad.opacity.first_non_finite(), None);
            prop_assert_eq!(grad.depth.first_non_finite(), None);
            prop_assert_eq!(grad.features.pixel(3, 0), &[0.0; 14]);
        }
        let depth = Image::from_vec(W, H, 1, raw[..W * H].iter().map(|z| z * far.exp()).collect()).expect("shape");
        let opacity = Image::filled(W, H, 1, 1.0);
        let camera = camera();
        let (normals, pullback) = pseudo_normals(&camera, &depth, &opacity).expect("shapes agree");
        prop_assert_eq!(normals.first_non_finite(), None);
        let d_depth = pullback.pull(&Image::filled(W, H, 3, 1.0)).expect("shapes agree");
        prop_assert_eq!(d_depth.first_non_finite(), None);
    }

    /// A surface whose blended normal faces away is lit all the same, and its normal has a gradient.
    #[test]
    fn normals_that_face_away_still_learn(raw in values(W * H * 14, 0.2..0.8)) {
        let mut images = blend(&raw, &[0.9; W * H]);
        // The camera looks along +z and the light comes from −y: this normal faces away from the camera, toward the light.
        for p in images[0].data_mut().chunks_mut(channel::COUNT) {
            p[channel::NORMAL].copy_from_slice(&[0.1, -2.0, 1.5]);
        }
        let light = OlatLight::Directional { direction: Vec3::new(0.0, -1.0, -0.2).normalize(), irradiance: Vec3::ONE };
        let (shaded, pullback) = shade(&buffer(&images), &camera(), &light, &ShadingConfig::default()).expect("shapes");
        prop_assert!(shaded.surface.data().iter().all(|v| *v > 0.0));
        let d = ShadedGrad { radiance: Some(Image::filled(W, H, 3, 1.0)), ..ShadedGrad::default() };
        let grad = pullback.pull(&d).expect("shapes agree").features.channels_range(channel::NORMAL);
        prop_assert!((0..W * H).all(|i| Vec3::from_slice(&grad.data()[3 * i..]).length() > 1e-6));
    }
}
