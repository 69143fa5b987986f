//! Whole-map proof of deferred shading: values, and the adjoint identity, against the naive oracle, over random views,
//! cameras, lights and configurations; and the self-test of that comparison.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::Image;
use diamond_light::{Falloff, OlatLight};
use diamond_shading::{
    BlendedBlock, BlockShader, BrdfModel, Combine, Diffuse, Fresnel, GBuffer, GBufferGrad, IncidentModel,
    LightChannels, MIN_COS_THETA_O, Masking, Prepared, Shaded, ShadedGrad, ShadedMapsGrad, ShadedRecords,
    ShadingConfig, SurfaceVisibility, TransportChannels, channel, shade,
};
use diamond_testkit::adjoint::{dot, worst, worst_relative};
use diamond_testkit::deferred::{Incident, OUTPUTS, Setting};
use diamond_testkit::{Dual, Real, ggx, jvp};
use glam::Vec3;
use proptest::prelude::*;

const W: usize = 4;
const H: usize = 3;
/// Sums, opacity and depth of one pixel.
const INPUTS: usize = channel::COUNT + 2;

/// One pixel of a G-buffer before blending: plausible features, some normals facing away.
fn pixel() -> impl Strategy<Value = Vec<f32>> {
    let unit = || 0.02f32..0.98;
    (
        [unit(), unit(), unit()],
        [0.15f32..0.95, unit(), unit()],
        [-1.0f32..1.0, -1.0f32..1.0, -1.0f32..1.0],
        [unit(), unit(), unit(), 0.1f32..1.5, unit()],
        0.05f32..0.99,
        2.0f32..4.0,
    )
        .prop_filter("a normal with a direction", |p| Vec3::from(p.2).length() > 0.2)
        .prop_map(|(color, scalars, normal, transport, opacity, depth)| {
            let f = [color.as_slice(), &scalars, &normal, &transport].concat();
            f.into_iter().chain([1.0, depth]).map(|v| v * opacity).collect()
        })
}

fn view() -> impl Strategy<Value = Vec<f32>> {
    proptest::collection::vec(pixel(), W * H).prop_map(|p| p.concat())
}

fn config() -> impl Strategy<Value = ShadingConfig> {
    let brdf = (
        prop::sample::select(vec![
            Masking::SmithSeparable,
            Masking::SmithCorrelated,
            Masking::SchlickRoughness,
            Masking::SchlickHalfAlpha,
        ]),
        prop::sample::select(vec![Fresnel::Schlick, Fresnel::SphericalGaussian]),
        prop::sample::select(vec![Diffuse::Lambert, Diffuse::FresnelWeighted]),
    )
        .prop_map(|(masking, fresnel, diffuse)| BrdfModel { masking, fresnel, diffuse });
    let incident = prop::sample::select(vec![
        IncidentModel::Learned,
        IncidentModel::Physical(Falloff::None),
        IncidentModel::Physical(Falloff::InverseSquare { reference: 3.0 }),
    ]);
    (brdf, incident, any::<[bool; 8]>()).prop_map(|(brdf, incident, b)| ShadingConfig {
        brdf,
        incident,
        combine: if b[0] { Combine::Lerp } else { Combine::Additive },
        normalise: b[1],
        visibility: if b[2] { SurfaceVisibility::Multiplied } else { SurfaceVisibility::Ignored },
        horizon_leak: if b[3] { 0.001 } else { 0.0 },
        roughness: b[4].then_some(0.5),
        use_residual: b[5] || b[1],
        incident_offset: if b[6] { 0.3 } else { 0.0 },
        scale_residual_by_light: b[7],
    })
}

fn light() -> impl Strategy<Value = OlatLight> {
    let rgb = || [0.2f32..2.0, 0.2f32..2.0, 0.2f32..2.0].prop_map(Vec3::from);
    let at = [-3.0f32..3.0, -3.0f32..3.0, -3.0f32..-1.0].prop_map(Vec3::from);
    let point = (at.clone(), rgb()).prop_map(|(position, intensity)| OlatLight::Point { position, intensity });
    let far = (at, rgb()).prop_map(|(d, irradiance)| OlatLight::Directional { direction: d.normalize(), irradiance });
    prop_oneof![2 => point, 1 => far]
}

fn camera() -> Camera {
    let intrinsics = Intrinsics { fx: 5.0, fy: 4.5, cx: 1.7, cy: 1.6, width: W as u32, height: H as u32 };
    Camera { intrinsics, pose: Pose::look_at(Vec3::new(0.3, -0.4, -3.0), Vec3::new(0.1, 0.0, 0.2), Vec3::Y) }
}

/// The oracle's setting for ours.
fn setting(camera: &Camera, light: &OlatLight, config: &ShadingConfig) -> Setting {
    let wide = |v: Vec3| v.to_array().map(f64::from);
    let k = &camera.intrinsics;
    Setting {
        model: ggx::Model {
            masking: match config.brdf.masking {
                Masking::SmithSeparable => ggx::Masking::SmithSeparable,
                Masking::SmithCorrelated => ggx::Masking::SmithCorrelated,
                Masking::SchlickRoughness => ggx::Masking::SchlickRoughness,
                Masking::SchlickHalfAlpha => ggx::Masking::SchlickHalfAlpha,
            },
            fresnel: match config.brdf.fresnel {
                Fresnel::Schlick => ggx::Fresnel::Schlick,
                Fresnel::SphericalGaussian => ggx::Fresnel::SphericalGaussian,
            },
            diffuse: match config.brdf.diffuse {
                Diffuse::Lambert => ggx::Diffuse::Lambert,
                Diffuse::FresnelWeighted => ggx::Diffuse::FresnelWeighted,
                Diffuse::Omitted => ggx::Diffuse::Omitted,
            },
        },
        incident: match config.incident {
            IncidentModel::Learned => Incident::Learned { offset: f64::from(config.incident_offset) },
            IncidentModel::Physical(Falloff::None) => Incident::Physical { reference: None },
            IncidentModel::Physical(Falloff::InverseSquare { reference }) => {
                Incident::Physical { reference: Some(f64::from(reference)) }
            }
        },
        additive: config.combine == Combine::Additive,
        normalise: config.normalise,
        shadowed: config.visibility == SurfaceVisibility::Multiplied,
        horizon_leak: f64::from(config.horizon_leak),
        min_cos_theta_o: f64::from(MIN_COS_THETA_O),
        roughness: config.roughness.map(f64::from),
        use_residual: config.use_residual,
        scale_residual: config.scale_residual_by_light,
        pinhole: [k.fx, k.fy, k.cx, k.cy].map(f64::from),
        rotation: camera.pose.rotation.transpose().to_cols_array_2d().map(|row| row.map(f64::from)),
        translation: wide(camera.pose.translation),
        light: wide(match *light {
            OlatLight::Point { position, .. } => position,
            OlatLight::Directional { direction, .. } => direction,
        }),
        directional: matches!(light, OlatLight::Directional { .. }),
        intensity: wide(light.intensity()),
    }
}

/// All pixels' outputs, [`OUTPUTS`] each.
fn oracle<R: Real>(setting: &Setting, x: &[R]) -> Vec<R> {
    x.chunks(INPUTS)
        .enumerate()
        .flat_map(|(i, p)| {
            let centre = [(i % W) as f64 + 0.5, (i / W) as f64 + 0.5];
            setting.shade_pixel(centre, &p[..channel::COUNT], p[channel::COUNT], p[channel::COUNT + 1])
        })
        .collect()
}

/// Splits interleaved pixels into images of the given channel counts.
fn split(values: &[f32], channels: &[usize]) -> Vec<Image> {
    let total = channels.iter().sum();
    let packed = Image::from_vec(W, H, total, values.to_vec()).expect("shape");
    let mut from = 0;
    channels
        .iter()
        .map(|&n| {
            from += n;
            packed.channels_range(from - n..from)
        })
        .collect()
}

/// The inverse of [`split`], widened.
fn join(images: &[&Image]) -> Vec<f64> {
    let mut out = Vec::new();
    for y in 0..H {
        for x in 0..W {
            out.extend(images.iter().flat_map(|i| i.pixel(x, y)).map(|&v| f64::from(v)));
        }
    }
    out
}

fn join_shaded(s: &Shaded) -> Vec<f64> {
    let m = &s.maps;
    join(&[
        &s.radiance,
        &s.surface,
        &s.subsurface,
        &m.base_color,
        &m.roughness,
        &m.metalness,
        &m.subsurfaceness,
        &m.normal,
        &m.residual,
        &m.incident,
        &m.visibility,
        &m.depth,
    ])
}

/// Cotangents in the oracle's order of outputs; those of the two parts, which have none, are set to zero in `d`.
fn cotangents(d: &mut [f32]) -> ShadedGrad {
    for pixel in d.chunks_mut(OUTPUTS) {
        pixel[3..9].fill(0.0);
    }
    let mut parts = split(d, &[3, 6, 3, 1, 1, 1, 3, 3, 1, 1, 1]).into_iter().map(Some);
    let mut next = || parts.next().flatten();
    let radiance = next();
    next();
    ShadedGrad {
        radiance,
        maps: ShadedMapsGrad {
            base_color: next(),
            roughness: next(),
            metalness: next(),
            subsurfaceness: next(),
            normal: next(),
            residual: next(),
            incident: next(),
            visibility: next(),
            depth: next(),
        },
    }
}

/// Everything that one comparison needs.
struct Case {
    x: Vec<f32>,
    cotangent: Vec<f32>,
    setting: Setting,
    shaded: Shaded,
    grad: GBufferGrad,
}

fn case(x: Vec<f32>, mut cotangent: Vec<f32>, light: &OlatLight, config: &ShadingConfig) -> Case {
    let camera = camera();
    let images = split(&x, &[channel::COUNT, 1, 1]);
    let gbuffer = GBuffer { features: &images[0], opacity: &images[1], depth: &images[2] };
    let (shaded, pullback) = shade(&gbuffer, &camera, light, config).expect("shapes agree");
    let grad = pullback.pull(&cotangents(&mut cotangent)).expect("shapes agree");
    Case { x, cotangent, setting: setting(&camera, light, config), shaded, grad }
}

fn wide(v: &[f32]) -> Vec<f64> {
    v.iter().map(|&v| f64::from(v)).collect()
}

impl Case {
    /// Worst error of the forward values, relative with a floor of a thousandth.
    fn value_gap(&self) -> f64 {
        worst_relative(&join_shaded(&self.shaded), &oracle(&self.setting, &wide(&self.x)), 1e-3)
    }

    /// Gap of the adjoint identity for one tangent: |⟨ū, J·ẋ⟩ − ⟨Jᵀ·ū, ẋ⟩| against the larger of the value itself, a
    /// tenth of the products that it is the sum of, and 1e-4 (where everything cancels, rounding is all that is left).
    fn adjoint_gap(&self, tangent: &[f64]) -> f64 {
        let vjp = join(&[&self.grad.features, &self.grad.opacity, &self.grad.depth]);
        let (left, floor) = self.directional(&wide(&self.x), tangent);
        (left - dot(&vjp, tangent)).abs() / left.abs().max(floor)
    }

    /// ⟨ū, J·ẋ⟩ of the oracle at `x`, and the floor of [`Case::adjoint_gap`].
    fn directional(&self, x: &[f64], tangent: &[f64]) -> (f64, f64) {
        let forward = jvp(|x: &[Dual]| oracle(&self.setting, x), x, tangent);
        let cotangent = wide(&self.cotangent);
        let products: f64 = cotangent.iter().zip(&forward).map(|(a, b)| (a * b).abs()).sum();
        (dot(&cotangent, &forward), (0.1 * products).max(1e-4))
    }

    /// The inputs, each moved by up to half a unit in the last place of an `f32`, a few times.
    fn neighbours(&self) -> impl Iterator<Item = Vec<f64>> {
        (0..8u64).map(|seed| {
            let mut z = seed;
            let mut nudge = |v: &f32| {
                z = z.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                f64::from(*v) * (1.0 + 6e-8 * ((z >> 33) as f64 / 2f64.powi(30) - 1.0))
            };
            self.x.iter().map(&mut nudge).collect()
        })
    }

    /// What rounding alone may do to the values: smooth facets and grazing angles magnify the last place of the inputs,
    /// and some ten roundings of that size happen on the way.
    fn value_rounding(&self) -> f64 {
        let x = oracle(&self.setting, &wide(&self.x));
        10.0 * worst(self.neighbours().map(|n| worst_relative(&oracle(&self.setting, &n), &x, 1e-3)))
    }

    /// What rounding alone may do to [`Case::adjoint_gap`].
    fn adjoint_rounding(&self, tangent: &[f64]) -> f64 {
        let (value, floor) = self.directional(&wide(&self.x), tangent);
        let moved = self.neighbours().map(|n| (self.directional(&n, tangent).0 - value).abs());
        10.0 * worst(moved) / value.abs().max(floor)
    }
}

fn one_hot(i: usize) -> Vec<f64> {
    let mut t = vec![0.0; W * H * INPUTS];
    t[i] = 1.0;
    t
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(192))]

    /// `[eq:deferred-composite]` `[eq:deferred-combine]` `[eq:deferred-incident]` `[eq:surface-point]`
    #[test]
    fn values_and_pullback_agree_with_the_oracle(
        x in view(), d in proptest::collection::vec(-1.0f32..1.0, W * H * OUTPUTS),
        tangent in proptest::collection::vec(-1.0f32..1.0, W * H * INPUTS),
        light in light(), config in config(), only in prop::option::of(0usize..3), place in 0usize..W * H,
    ) {
        // A third of the draws look at the radiance alone.
        let mut d = d;
        if only == Some(0) {
            d.chunks_mut(OUTPUTS).for_each(|p| p[3..].fill(0.0));
        }
        let case = case(x, d, &light, &config);
        let gap = case.value_gap();
        prop_assert!(gap <= 1e-4 || gap <= case.value_rounding(), "values {gap:e}");
        let gap = case.adjoint_gap(&wide(&tangent));
        prop_assert!(gap <= 1e-4 || gap <= case.adjoint_rounding(&wide(&tangent)), "all inputs {gap:e}");
        // Each input of one pixel alone.
        for k in 0..INPUTS {
            let tangent = one_hot(place * INPUTS + k);
            let gap = case.adjoint_gap(&tangent);
            prop_assert!(gap <= 1e-4 || gap <= case.adjoint_rounding(&tangent), "input {k}: {gap:e}");
        }
    }

    /// Many lights of one view: the same bits as one at a time, from nine or fourteen channels.
    #[test]
    fn prepared_shading_has_the_same_bits(x in view(), light in light(), config in config()) {
        let camera = camera();
        let images = split(&x, &[channel::COUNT, 1, 1]);
        let gbuffer = GBuffer { features: &images[0], opacity: &images[1], depth: &images[2] };
        let (expected, _) = shade(&gbuffer, &camera, &light, &config).expect("shapes agree");
        let transport = images[0].channels_range(channel::TRANSPORT);
        let prepared = Prepared::new(&gbuffer, &camera, &config).expect("shapes agree");
        prop_assert_eq!(&prepared.shade(&light, Some(&transport)).expect("shapes agree"), &expected);
        let nine = images[0].channels_range(channel::GEOMETRY);
        let prepared = Prepared::new(&GBuffer { features: &nine, ..gbuffer }, &camera, &config).expect("shapes agree");
        prop_assert_eq!(&prepared.shade(&light, Some(&transport)).expect("shapes agree"), &expected);
        // The radiance alone, from channels among others: channels 9 to 13 of all fourteen.
        let channels = TransportChannels { residual: Some(9), incident: Some(12), visibility: Some(13) };
        let radiance = prepared.radiance(&light, &images[0], &channels).expect("shapes agree");
        prop_assert_eq!(&radiance, &expected.radiance);
        let beyond = TransportChannels { visibility: Some(14), ..channels };
        prop_assert!(prepared.radiance(&light, &images[0], &beyond).is_err());
    }

    /// Blocks of pixels from anywhere, shaded without images: the same bits, whatever light comes before.
    #[test]
    fn blocks_have_the_bits_of_images(x in view(), lights in [light(), light()], config in config()) {
        let camera = camera();
        let images = split(&x, &[channel::COUNT, 1, 1]);
        let gbuffer = GBuffer { features: &images[0], opacity: &images[1], depth: &images[2] };
        let shader = BlockShader::new(&camera, &config).expect("settings are in range");
        let places = TransportChannels { residual: Some(0), incident: Some(3), visibility: Some(4) };
        let channels = LightChannels { places, per_light: 5 };
        // Pixels in an order of their own; those beyond the last are empty.
        let pixels: Vec<(usize, usize)> = (0..W * H).map(|i| (i / H, i % H)).collect();
        for pixels in pixels.chunks(16) {
            let mut block = BlendedBlock {
                centres: [[0.5; 16]; 2], sums: [[0.0; 16]; 9], opacity: [0.0; 16], depth: [0.0; 16],
            };
            let mut sums = [[0.0; 16]; 10];
            for (lane, &(x, y)) in pixels.iter().enumerate() {
                (block.centres[0][lane], block.centres[1][lane]) = (x as f32 + 0.5, y as f32 + 0.5);
                let features = images[0].pixel(x, y);
                (0..9).for_each(|c| block.sums[c][lane] = features[c]);
                (0..10).for_each(|c| sums[c][lane] = features[9 + c % 5]);
                (block.opacity[lane], block.depth[lane]) = (images[1].pixel(x, y)[0], images[2].pixel(x, y)[0]);
            }
            let prepared = shader.prepare(&block);
            let (mut radiance, mut records) = ([[[0.0; 16]; 3]; 2], [[[0.0; 16]; ShadedRecords::WIDTH]; 2]);
            shader.radiance(&prepared, &lights, &channels, &sums, &mut radiance).expect("lengths agree");
            shader.records(&prepared, &lights, &channels, &sums, &mut records).expect("lengths agree");
            for (k, light) in lights.iter().enumerate() {
                let (expected, _) = shade(&gbuffer, &camera, light, &config).expect("shapes agree");
                let record = Image::from_vec(16, 1, ShadedRecords::WIDTH, (0..16).flat_map(|lane| {
                    records[k].iter().map(move |c| c[lane]).collect::<Vec<f32>>()
                }).collect()).expect("sizes agree");
                let record = ShadedRecords::unpack(&record).expect("records");
                for (lane, &(x, y)) in pixels.iter().enumerate() {
                    let found = [radiance[k][0][lane], radiance[k][1][lane], radiance[k][2][lane]];
                    prop_assert_eq!(expected.radiance.pixel(x, y), &found);
                    prop_assert_eq!(record.radiance.pixel(lane, 0), &found);
                    prop_assert_eq!(record.subsurface.pixel(lane, 0), expected.subsurface.pixel(x, y));
                    prop_assert_eq!(record.maps.normal.pixel(lane, 0), expected.maps.normal.pixel(x, y));
                    prop_assert_eq!(record.maps.depth.pixel(lane, 0), expected.maps.depth.pixel(x, y));
                }
            }
            prop_assert!(shader.radiance(&prepared, &lights, &channels, &sums[1..], &mut radiance).is_err());
            prop_assert!(shader.radiance(&prepared, &lights, &channels, &sums, &mut radiance[1..]).is_err());
            let few = LightChannels { places, per_light: 4 };
            prop_assert!(shader.radiance(&prepared, &lights, &few, &sums[..8], &mut radiance).is_err());
        }
    }
}

/// A deterministic case for the tests below.
fn example() -> Case {
    let x: Vec<f32> = (0..W * H)
        .flat_map(|i| {
            let t = i as f32 / 12.0;
            let f = [0.7, 0.4 + 0.3 * t, 0.2, 0.4, 0.3, 0.4, 0.3 - t, 0.2, -0.9, 0.3, 0.2, 0.1 + t, 0.8, 0.7, 1.0, 3.0];
            f.map(|v| v * (0.4 + 0.5 * t))
        })
        .collect();
    let d: Vec<f32> = (0..W * H * OUTPUTS).map(|i| ((i * 53) % 17) as f32 / 8.0 - 1.0).collect();
    let light = OlatLight::Point { position: Vec3::new(1.0, -1.0, -2.0), intensity: Vec3::new(1.0, 1.2, 0.8) };
    let config = ShadingConfig { visibility: SurfaceVisibility::Multiplied, ..ShadingConfig::default() };
    case(x, d, &light, &config)
}

/// The comparison notices a lost channel, a lost opacity or depth gradient, a sign, and one part in a hundred.
#[test]
fn planted_errors_are_noticed() {
    let good = example();
    let worst = |case: &Case| worst((0..W * H * INPUTS).map(|i| case.adjoint_gap(&one_hot(i))));
    assert!(good.value_gap() <= 1e-5 && worst(&good) <= 1e-4, "{:e} {:e}", good.value_gap(), worst(&good));
    for k in 0..INPUTS {
        for factor in [0.0, -1.0, 1.01] {
            let mut bad = example();
            let image = match k {
                channel::COUNT => &mut bad.grad.opacity,
                15 => &mut bad.grad.depth,
                _ => &mut bad.grad.features,
            };
            let c = if k < channel::COUNT { k } else { 0 };
            image.pixel_mut(2, 1)[c] *= factor;
            assert!(worst(&bad) > 1e-3, "input {k} times {factor} went unnoticed");
        }
    }
    let mut bad = example();
    bad.shaded.radiance.pixel_mut(1, 1)[2] *= 1.001;
    assert!(bad.value_gap() > 1e-4);
}

/// Wrong shapes and settings are errors that name what is wrong.
#[test]
fn shapes_and_settings_are_checked() {
    let camera = camera();
    let light = OlatLight::Point { position: Vec3::ZERO, intensity: Vec3::ONE };
    let config = ShadingConfig::default();
    let (features, one) = (Image::new(W, H, channel::COUNT), Image::new(W, H, 1));
    let good = GBuffer { features: &features, opacity: &one, depth: &one };
    let (_, pullback) = shade(&good, &camera, &light, &config).expect("shapes agree");
    let thirteen = Image::new(W, H, 13);
    let turned = Image::new(H, W, 1);
    for (bad, name) in [
        (GBuffer { features: &thirteen, ..good }, "features"),
        (GBuffer { opacity: &turned, ..good }, "opacity"),
        (GBuffer { depth: &turned, ..good }, "depth"),
    ] {
        let error = shade(&bad, &camera, &light, &config).expect_err("must be refused").to_string();
        assert!(error.contains(name), "{error}");
        assert!(Prepared::new(&bad, &camera, &config).is_err());
    }
    let prepared = Prepared::new(&good, &camera, &config).expect("shapes agree");
    assert!(prepared.shade(&light, Some(&thirteen)).is_err() && prepared.shade(&light, None).is_ok());
    let wrong = ShadedGrad { radiance: Some(Image::new(W, H, 1)), ..ShadedGrad::default() };
    assert!(pullback.pull(&wrong).expect_err("must be refused").to_string().contains("radiance"));
    let maps = ShadedMapsGrad { normal: Some(Image::new(1, 1, 3)), ..ShadedMapsGrad::default() };
    assert!(pullback.pull(&ShadedGrad { radiance: None, maps }).is_err());
    for bad in [
        ShadingConfig { horizon_leak: -0.1, ..config },
        ShadingConfig { horizon_leak: f32::NAN, ..config },
        ShadingConfig { incident_offset: f32::INFINITY, ..config },
        ShadingConfig { roughness: Some(1.5), ..config },
    ] {
        assert!(shade(&good, &camera, &light, &bad).is_err());
    }
}
