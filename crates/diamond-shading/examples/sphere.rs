//! Shades a sphere under one point light with this crate alone, and writes it as a PPM picture.
//!
//! `cargo run --release -p diamond-shading --example sphere -- sphere.ppm`
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::{Image, Transfer};
use diamond_light::{Falloff, OlatLight};
use diamond_shading::{GBuffer, IncidentModel, ShadingConfig, SurfaceVisibility, channel, shade};
use glam::{Vec2, Vec3};

/// Pixels on a side.
const SIZE: usize = 256;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).unwrap_or_else(|| "sphere.ppm".into());
    let camera = Camera {
        intrinsics: Intrinsics::from_fov_x(0.7, SIZE as u32, SIZE as u32),
        pose: Pose::look_at(Vec3::new(0.0, 0.0, 3.5), Vec3::ZERO, Vec3::Y),
    };

    // A G-buffer by ray casting: a unit sphere, opaque, of one waxy material, with a made-up glow as residual.
    let mut features = Image::new(SIZE, SIZE, channel::COUNT);
    let mut opacity = Image::new(SIZE, SIZE, 1);
    let mut depth = Image::new(SIZE, SIZE, 1);
    for y in 0..SIZE {
        for x in 0..SIZE {
            let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
            let along = -ray.origin.dot(ray.direction);
            let discriminant = along * along - ray.origin.length_squared() + 1.0;
            if discriminant <= 0.0 {
                continue;
            }
            let point = ray.origin + ray.direction * (along - discriminant.sqrt());
            let pixel = features.pixel_mut(x, y);
            pixel[channel::BASE_COLOR].copy_from_slice(&[0.85, 0.55, 0.35]);
            pixel[channel::ROUGHNESS] = 0.35;
            pixel[channel::SUBSURFACENESS] = 0.3;
            pixel[channel::NORMAL].copy_from_slice(&point.to_array());
            pixel[channel::RESIDUAL].copy_from_slice(&[0.35, 0.12, 0.06]);
            pixel[channel::VISIBILITY] = 1.0;
            opacity.pixel_mut(x, y)[0] = 1.0;
            depth.pixel_mut(x, y)[0] = camera.pose.transform_point(point).z;
        }
    }

    let gbuffer = GBuffer { features: &features, opacity: &opacity, depth: &depth };
    let light = OlatLight::Point { position: Vec3::new(2.5, 2.0, 3.0), intensity: Vec3::splat(3.0) };
    let config = ShadingConfig {
        incident: IncidentModel::Physical(Falloff::InverseSquare { reference: 4.0 }),
        visibility: SurfaceVisibility::Multiplied,
        ..ShadingConfig::default()
    };
    let (shaded, _pullback) = shade(&gbuffer, &camera, &light, &config)?;

    let mut ppm = format!("P6\n{SIZE} {SIZE}\n255\n").into_bytes();
    ppm.extend(shaded.radiance.data().iter().map(|&v| (Transfer::Srgb.encode(v).clamp(0.0, 1.0) * 255.0 + 0.5) as u8));
    std::fs::write(&path, ppm)?;
    println!("{path}: {SIZE}×{SIZE}, sRGB");
    Ok(())
}
