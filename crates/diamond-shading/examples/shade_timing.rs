//! Nanoseconds per pixel of deferred shading, forward alone and forward with backward, on every instruction set of this
//! machine, and the largest difference of the image and of the gradient from those of the portable one.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_shading::{BrdfModel, GBuffer, ShadedGrad, ShadingConfig, ShadingError, channel, shade_at};
use diamond_simd::Level;
use glam::Vec3;
use std::hint::black_box;
use std::time::Instant;

const SIZE: usize = 256;
const CALLS: usize = 30;

/// Least nanoseconds per pixel of some calls.
fn best(mut f: impl FnMut()) -> f64 {
    let seconds = (0..CALLS).fold(f64::INFINITY, |least, _| {
        let start = Instant::now();
        f();
        least.min(start.elapsed().as_secs_f64())
    });
    seconds * 1e9 / (SIZE * SIZE) as f64
}

/// The largest difference, as a share of the largest value.
fn difference(a: &[f32], b: &[f32]) -> f32 {
    let largest = b.iter().fold(f32::MIN_POSITIVE, |m, v| m.max(v.abs()));
    a.iter().zip(b).fold(0.0, |m: f32, (a, b)| m.max((a - b).abs())) / largest
}

fn main() -> Result<(), ShadingError> {
    let mut state = 1u32;
    let mut uniform = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / 16_777_216.0
    };
    let intrinsics = Intrinsics::from_fov_x(0.7, SIZE as u32, SIZE as u32);
    let camera = Camera { intrinsics, pose: Pose::look_at(Vec3::new(0.0, 0.0, -3.0), Vec3::ZERO, Vec3::Y) };
    let light = OlatLight::Point { position: Vec3::new(1.0, -1.0, -2.5), intensity: Vec3::ONE };
    let mut features = Image::new(SIZE, SIZE, channel::COUNT);
    let (mut opacity, mut depth) = (Image::new(SIZE, SIZE, 1), Image::new(SIZE, SIZE, 1));
    // A disc that covers two thirds of the view.
    for y in 0..SIZE {
        for x in 0..SIZE {
            let (u, v) = (x as f32 / SIZE as f32 - 0.5, y as f32 / SIZE as f32 - 0.5);
            if u * u + v * v > 0.21 {
                continue;
            }
            let o = 0.3 + 0.7 * uniform();
            features.pixel_mut(x, y).iter_mut().for_each(|f| *f = o * uniform());
            let normal = Vec3::new(u + 0.2 * uniform(), v, -0.4).normalize() * o;
            features.pixel_mut(x, y)[channel::NORMAL].copy_from_slice(&normal.to_array());
            opacity.pixel_mut(x, y)[0] = o;
            depth.pixel_mut(x, y)[0] = o * (2.5 + uniform());
        }
    }
    let gbuffer = GBuffer { features: &features, opacity: &opacity, depth: &depth };
    let d = ShadedGrad { radiance: Some(Image::filled(SIZE, SIZE, 3, 1.0)), ..ShadedGrad::default() };
    for (name, brdf) in [("default", BrdfModel::default()), ("SSS-3DGS", BrdfModel::SSS_3DGS)] {
        let config = ShadingConfig { brdf, ..ShadingConfig::default() };
        let run = |level| {
            let (shaded, pullback) = shade_at(level, &gbuffer, &camera, &light, &config)?;
            Ok::<_, ShadingError>((shaded, pullback.pull(&d)?))
        };
        let (expected, expected_grad) = run(Level::PORTABLE)?;
        let mut base = None;
        for set in diamond_simd::InstructionSet::available().into_iter().rev() {
            let Ok(level) = Level::of(set) else { continue };
            let (shaded, grad) = run(level)?;
            let forward = best(|| drop(black_box(shade_at(level, &gbuffer, &camera, &light, &config))));
            let both = best(|| drop(black_box(run(level))));
            println!(
                "{name:8} {set:9} forward {forward:6.1} ns/pixel, with backward {both:6.1}; largest difference: image {:.1e}, \
                 gradient {:.1e}",
                difference(shaded.radiance.data(), expected.radiance.data()),
                difference(grad.features.data(), expected_grad.features.data()),
            );
            let (f, b) = *base.get_or_insert((forward, both));
            if f != forward {
                println!("{name:8} {set:9} {:.2} and {:.2} times as fast as the first", f / forward, b / both);
            }
        }
    }
    Ok(())
}
