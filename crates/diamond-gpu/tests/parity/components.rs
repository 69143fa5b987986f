//! Parts of the training step that are called one by one, each against the CPU's own function.
use crate::compare::relative_l2;
use crate::scenes::uniform;
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_gpu::{
    COMPONENTS, Device, adam_step, mask_bce, mlp_forward, mlp_pull, photometric, record_view, shade, shade_pull,
};
use diamond_image::{Image, Mask, Transfer};
use diamond_light::{Falloff, OlatLight};
use diamond_losses::PhotometricOptions;
use diamond_metrics::SsimWindow;
use diamond_reconstruct::adam::{self, Moments, Rows};
use diamond_shading::{
    Activation, BrdfModel, Combine, Diffuse, Fresnel, GBuffer, IncidentModel, Masking, Mlp, MlpShape, ShadedGrad,
    ShadedMapsGrad, ShadingConfig, SurfaceVisibility, channel,
};
use diamond_splat::density::DensityStats;
use glam::{Vec2, Vec3};
use rand_pcg::Pcg64Mcg;
use rand_pcg::rand_core::SeedableRng;

/// The worst error of a part on all its scenes, or where it is too large.
pub fn component(device: &Device, name: &str) -> Result<f64, String> {
    let row = COMPONENTS.iter().find(|row| row.name == name).ok_or("no such component")?;
    let errors = match name {
        "mlp_forward" => networks(device, false),
        "mlp_pull" => networks(device, true),
        "shade" => shading(device, false),
        "shade_pull" => shading(device, true),
        "photometric" => pictures(device),
        "mask_bce" => masks(device),
        "adam_step" => updates(device),
        "record_view" => views(device),
        _ => return Err("no test of this component".into()),
    }?;
    let mut worst = 0.0f64;
    for (what, error) in errors {
        if error.is_nan() || error > row.tolerance {
            return Err(format!("{what}: relative error {error:.2e}"));
        }
        worst = worst.max(error);
    }
    Ok(worst)
}

type Errors = Result<Vec<(String, f64)>, String>;

fn numbers(rng: &mut Pcg64Mcg, n: usize, low: f32, high: f32) -> Vec<f32> {
    (0..n).map(|_| uniform(rng, low, high)).collect()
}

fn networks(device: &Device, backward: bool) -> Errors {
    let rng = &mut Pcg64Mcg::seed_from_u64(21);
    let mut errors = Vec::new();
    let shapes = [
        (vec![42, 64, 32, 32], Activation::LeakyRelu(0.01), Activation::LeakyRelu(0.01)),
        (vec![32, 3], Activation::Relu, Activation::Sigmoid),
        (vec![46, 64, 64, 64, 64, 3], Activation::Relu, Activation::Sigmoid),
        (vec![5, 70, 1], Activation::Relu, Activation::Relu),
        (vec![1, 1], Activation::Linear, Activation::Linear),
    ];
    for (widths, hidden, output) in shapes {
        for batch in [0, 1, 77, 4500] {
            let shape = MlpShape { widths: widths.clone(), hidden, output };
            let mlp = Mlp::initialise(shape, false, &mut || uniform(rng, 0.0, 1.0)).map_err(|e| e.to_string())?;
            let inputs = numbers(rng, batch * mlp.shape.inputs(), -1.0, 1.0);
            let what = format!("{widths:?}, {batch} rows");
            let (outputs, pullback) = mlp.forward(&inputs, batch).map_err(|e| e.to_string())?;
            if !backward {
                let found = mlp_forward(device, &mlp, &inputs, batch).map_err(|e| e.to_string())?;
                errors.push((what, relative_l2(&found, &outputs)));
                continue;
            }
            let d = numbers(rng, outputs.len(), -1.0, 1.0);
            let expected = pullback.pull(&d, true).map_err(|e| e.to_string())?;
            let found = mlp_pull(device, &mlp, &inputs, batch, &d, true).map_err(|e| e.to_string())?;
            errors.push((format!("{what}, parameters"), relative_l2(&found.parameters, &expected.parameters)));
            let (a, b) = (found.inputs.unwrap_or_default(), expected.inputs.unwrap_or_default());
            errors.push((format!("{what}, inputs"), relative_l2(&a, &b)));
        }
    }
    Ok(errors)
}

const SIZE: [usize; 2] = [37, 12];

fn image(channels: usize, data: Vec<f32>) -> Image {
    Image::from_vec(SIZE[0], SIZE[1], channels, data).expect("as many numbers as pixels have channels")
}

/// Random pixels; some are degenerate.
fn gbuffer(rng: &mut Pcg64Mcg, camera: &Camera) -> [Image; 3] {
    let pixels = SIZE[0] * SIZE[1];
    let (mut features, mut opacities, mut depths) = (Vec::new(), Vec::new(), Vec::new());
    for i in 0..pixels {
        let (x, y) = (i % SIZE[0], i / SIZE[0]);
        let mut f = numbers(rng, channel::COUNT, 0.0, 1.0);
        f[channel::NORMAL].iter_mut().for_each(|v| *v = 2.0 * *v - 1.0);
        f[channel::ROUGHNESS] = f[channel::ROUGHNESS].max(0.05);
        let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)).direction;
        let (mut opacity, mut depth) = (uniform(rng, 0.05, 1.0), uniform(rng, 2.0, 4.0));
        let mut normal = |n: Vec3| f[channel::NORMAL].copy_from_slice(&n.to_array());
        match i % 26 {
            1 => opacity = 0.0,
            3 => opacity = 1e-6,
            7 => normal(Vec3::ZERO),
            9 => normal(Vec3::splat(1e-7)),
            11 => normal(ray.any_orthogonal_vector()),
            13 => normal(ray),
            15 => normal(Vec3::splat(1e30)),
            17 => f[channel::ROUGHNESS] = 0.0,
            19 => f[channel::ROUGHNESS] = 3.0,
            21 => depth = 0.0,
            23 => normal(-ray),
            _ => {}
        }
        if opacity > 1e-5 {
            f.iter_mut().for_each(|v| *v *= opacity);
        }
        features.extend(f);
        opacities.push(opacity);
        depths.push(depth * opacity);
    }
    [image(channel::COUNT, features), image(1, opacities), image(1, depths)]
}

fn configs() -> Vec<ShadingConfig> {
    let mut configs = Vec::new();
    for masking in
        [Masking::SmithSeparable, Masking::SmithCorrelated, Masking::SchlickRoughness, Masking::SchlickHalfAlpha]
    {
        for fresnel in [Fresnel::Schlick, Fresnel::SphericalGaussian] {
            let diffuse = if fresnel == Fresnel::Schlick { Diffuse::FresnelWeighted } else { Diffuse::Lambert };
            configs.push(ShadingConfig {
                brdf: BrdfModel { masking, fresnel, diffuse },
                incident_offset: 0.25,
                ..Default::default()
            });
        }
    }
    configs.push(ShadingConfig {
        incident: IncidentModel::Physical(Falloff::InverseSquare { reference: 2.0 }),
        combine: Combine::Additive,
        normalise: false,
        visibility: SurfaceVisibility::Multiplied,
        horizon_leak: 0.001,
        scale_residual_by_light: true,
        ..Default::default()
    });
    configs.push(ShadingConfig {
        brdf: BrdfModel { diffuse: Diffuse::Omitted, ..BrdfModel::default() },
        incident: IncidentModel::Physical(Falloff::None),
        roughness: Some(0.5),
        use_residual: false,
        ..Default::default()
    });
    configs
}

fn shading(device: &Device, backward: bool) -> Errors {
    let rng = &mut Pcg64Mcg::seed_from_u64(22);
    let [width, height] = SIZE.map(|side| side as u32);
    let intrinsics = Intrinsics { fx: 40.0, fy: 38.0, cx: 18.3, cy: 5.9, width, height };
    let pose = Pose::look_at(Vec3::new(0.3, -0.4, -3.0), Vec3::new(0.1, 0.0, 0.2), Vec3::Y);
    let camera = Camera { intrinsics, pose };
    let [features, opacity, depth] = gbuffer(rng, &camera);
    let gbuffer = GBuffer { features: &features, opacity: &opacity, depth: &depth };
    let pixels = SIZE[0] * SIZE[1];
    let mut d = |channels: usize| Some(image(channels, numbers(rng, pixels * channels, -1.0, 1.0)));
    let d = ShadedGrad {
        radiance: d(3),
        maps: ShadedMapsGrad {
            base_color: d(3),
            roughness: d(1),
            metalness: d(1),
            subsurfaceness: d(1),
            normal: d(3),
            residual: d(3),
            incident: None,
            visibility: d(1),
            depth: d(1),
        },
    };
    let point = OlatLight::Point { position: Vec3::new(1.0, -1.0, -2.0), intensity: Vec3::new(1.0, 1.2, 0.8) };
    let far = OlatLight::Directional { direction: Vec3::new(0.0, -0.6, -0.8), irradiance: Vec3::ONE };
    let mut errors = Vec::new();
    for (k, config) in configs().iter().enumerate() {
        for (name, light) in [("point", point), ("directional", far)] {
            let (shaded, pullback) =
                diamond_shading::shade(&gbuffer, &camera, &light, config).map_err(|e| e.to_string())?;
            let mut compare = |what: &str, a: &Image, b: &Image| {
                errors.push((format!("configuration {k}, {name}, {what}"), relative_l2(a.data(), b.data())));
            };
            if backward {
                let expected = pullback.pull(&d).map_err(|e| e.to_string())?;
                let found = shade_pull(device, &gbuffer, &camera, &light, config, &d).map_err(|e| e.to_string())?;
                for c in 0..channel::COUNT {
                    let part = |image: &Image| image.channels_range(c..c + 1);
                    compare(&format!("d channel {c}"), &part(&found.features), &part(&expected.features));
                }
                compare("d opacity", &found.opacity, &expected.opacity);
                compare("d depth", &found.depth, &expected.depth);
                continue;
            }
            let found = shade(device, &gbuffer, &camera, &light, config).map_err(|e| e.to_string())?;
            let (a, b) = (&found.maps, &shaded.maps);
            compare("radiance", &found.radiance, &shaded.radiance);
            compare("surface", &found.surface, &shaded.surface);
            compare("subsurface", &found.subsurface, &shaded.subsurface);
            compare("base colour", &a.base_color, &b.base_color);
            compare("roughness", &a.roughness, &b.roughness);
            compare("metalness", &a.metalness, &b.metalness);
            compare("subsurfaceness", &a.subsurfaceness, &b.subsurfaceness);
            compare("normal", &a.normal, &b.normal);
            compare("residual", &a.residual, &b.residual);
            compare("incident", &a.incident, &b.incident);
            compare("visibility", &a.visibility, &b.visibility);
            compare("depth", &a.depth, &b.depth);
        }
    }
    Ok(errors)
}

fn updates(device: &Device) -> Errors {
    let rng = &mut Pcg64Mcg::seed_from_u64(23);
    let mut errors = Vec::new();
    for (width, rows) in [(1, Rows::All), (3, Rows::Seen { width: 3 }), (16, Rows::Seen { width: 16 })] {
        let n = 701 * width;
        let mut values = numbers(rng, n, -2.0, 2.0);
        let mut moments = Moments::zeros(n);
        let (mut other, mut other_moments) = (values.clone(), moments.clone());
        for t in 1..=5 {
            let mut gradient = numbers(rng, n, -1e-6, 1e-6);
            gradient.chunks_mut(width).skip(t as usize % 3).step_by(3).for_each(|row| row.fill(0.0));
            adam::adam_step(&mut values, &mut moments, &gradient, 0.01, t, rows);
            adam_step(device, &mut other, &mut other_moments, &gradient, 0.01, t, rows).map_err(|e| e.to_string())?;
        }
        let what = format!("{rows:?}");
        errors.push((format!("{what}, values"), relative_l2(&other, &values)));
        errors.push((format!("{what}, first moments"), relative_l2(&other_moments.first, &moments.first)));
        errors.push((format!("{what}, second moments"), relative_l2(&other_moments.second, &moments.second)));
    }
    Ok(errors)
}

fn views(device: &Device) -> Errors {
    let rng = &mut Pcg64Mcg::seed_from_u64(24);
    let n = 513;
    let (mut a, mut b) = (DensityStats::new(n), DensityStats::new(n));
    for _ in 0..3 {
        let d: Vec<Vec2> = (0..n).map(|_| Vec2::new(uniform(rng, -1.0, 1.0), uniform(rng, -1.0, 1.0))).collect();
        let radii: Vec<f32> = (0..n).map(|_| uniform(rng, -5.0, 9.0).max(0.0)).collect();
        a.record(&d, &radii, 320, 200).map_err(|e| e.to_string())?;
        record_view(device, &mut b, &d, &radii, 320, 200).map_err(|e| e.to_string())?;
    }
    if a.views != b.views {
        return Err("views are counted otherwise".into());
    }
    Ok(vec![
        ("gradient sums".into(), relative_l2(&b.gradient_sum, &a.gradient_sum)),
        ("radii".into(), relative_l2(&b.max_radius, &a.max_radius)),
    ])
}

/// A smooth picture, and one a little different from it.
fn picture(rng: &mut Pcg64Mcg, [width, height]: [usize; 2], channels: usize) -> [Image; 2] {
    let phase = numbers(rng, 3 * channels, 0.0, 6.0);
    let mut a = Image::new(width, height, channels);
    let mut b = a.clone();
    for y in 0..height {
        for x in 0..width {
            for c in 0..channels {
                let wave = libm::sinf(0.3 * x as f32 + phase[3 * c]) * libm::cosf(0.21 * y as f32 + phase[3 * c + 1]);
                // Darkness on one side, where encodings are steep, and a flat part.
                let value = if x > 2 * width / 3 { 0.4 } else { 0.5 + 0.5 * wave };
                let dim = if y < height / 4 { 1e-3 } else { 1.0 };
                b.pixel_mut(x, y)[c] = value * dim;
                a.pixel_mut(x, y)[c] = (value + uniform(rng, -0.1, 0.1)) * dim;
            }
        }
    }
    [a, b]
}

fn pictures(device: &Device) -> Errors {
    let rng = &mut Pcg64Mcg::seed_from_u64(25);
    let mut errors = Vec::new();
    for (size, channels) in [([45, 37], 3), ([16, 16], 1), ([1, 1], 3), ([12, 70], 2)] {
        for space in [Transfer::Linear, Transfer::Srgb, Transfer::Gamma22] {
            for (window, lambda_ssim, lambda_l2) in
                [(SsimWindow::ZeroPadded, 0.2, 0.0), (SsimWindow::Valid, 1.0, 0.0), (SsimWindow::ZeroPadded, 0.0, 0.7)]
            {
                if window == SsimWindow::Valid && size[0].min(size[1]) < 11 {
                    continue;
                }
                let [a, b] = picture(rng, size, channels);
                let options = PhotometricOptions { lambda_ssim, lambda_l2, space, window };
                let expected = diamond_losses::photometric(&a, &b, &options, 0.7).map_err(|e| e.to_string())?;
                let found = photometric(device, &a, &b, &options, 0.7).map_err(|e| e.to_string())?;
                let what = format!("{size:?}, {options:?}");
                let mut compare = |part: &str, a: f32, b: f32| {
                    // Of a loss near 0 only so many digits are worth anything.
                    let error = f64::from((a - b).abs()) / f64::from(b.abs()).max(1e-2);
                    errors.push((format!("{what}, {part}"), error));
                };
                compare("value", found.value, expected.value);
                compare("l1", found.l1, expected.l1);
                compare("l2", found.l2, expected.l2);
                compare("dssim", found.dssim, expected.dssim);
                errors.push((format!("{what}, gradient"), relative_l2(found.grad.data(), expected.grad.data())));
            }
        }
    }
    Ok(errors)
}

fn masks(device: &Device) -> Errors {
    let rng = &mut Pcg64Mcg::seed_from_u64(26);
    let (width, height) = (53, 29);
    let mut opacity = numbers(rng, width * height, 0.0, 1.0);
    let mut mask = numbers(rng, width * height, -0.5, 1.5);
    mask.iter_mut().for_each(|m| *m = m.clamp(0.0, 1.0));
    opacity[..6].copy_from_slice(&[0.0, 1.0, 1e-7, 1.0 - 1e-7, 1e-6, 0.5]);
    let opacity = Image::from_vec(width, height, 1, opacity).map_err(|e| e.to_string())?;
    let mask = Mask::from_vec(width, height, mask).map_err(|e| e.to_string())?;
    let expected = diamond_losses::mask_bce(&opacity, &mask).map_err(|e| e.to_string())?;
    let found = mask_bce(device, &opacity, &mask).map_err(|e| e.to_string())?;
    Ok(vec![
        ("value".into(), relative_l2(&[found.value], &[expected.value])),
        ("gradient".into(), relative_l2(found.grad.data(), expected.grad.data())),
    ])
}
