//! The rasteriser's error against the oracle in f64, on some pixels.
//!
//! The image is compared value by value. For the gradient of `Σ c·pixel` over these pixels with random `c`, dual numbers
//! in f64 give the exact derivative along two directions per group of parameters: along our own gradient, and along it
//! with random signs. Both are compared with the inner product of our gradient and the direction, relative to the
//! product of their lengths. Pixels within rounding of a threshold, where the image jumps, are left out.
use crate::scene::BenchScene;
use diamond_splat::{RasterGrad, rasterize};
use diamond_testkit::splat::{SPLAT_PARAMETERS, SplatCamera, SplatRules, sorted_splats, splat_alpha, splat_pixel};
use diamond_testkit::{Dual, Real};
use rayon::prelude::*;

/// Pixels that are compared.
const PIXELS: usize = 200;
/// Relative distance from a threshold below which f32 may fall on the other side.
const AMBIGUOUS: f64 = 1e-5;

/// The worst errors.
pub struct Errors {
    /// Largest absolute difference of features, opacity and depth.
    pub image: f64,
    /// Largest relative difference of a derivative, over mean, scale, rotation, opacity and features.
    pub gradient: f64,
    /// Pixels that were compared.
    pub pixels: usize,
}

pub fn against_f64(scene: &BenchScene) -> Result<Errors, String> {
    let fail = |e: diamond_splat::SplatError| e.to_string();
    let (g, f) = (&scene.gaussians, &scene.features);
    let (n, channels, side) = (g.len(), f.channels, scene.camera.intrinsics.width as usize);
    let stride = SPLAT_PARAMETERS + channels;
    let mut x = Vec::with_capacity(n * stride);
    for i in 0..n {
        x.extend(g.means[i].to_array().map(f64::from));
        x.extend(g.scales[i].to_array().map(f64::from));
        x.extend(g.rotations[i].to_array().map(f64::from));
        x.push(f64::from(g.opacities[i]));
        x.extend(f.row(i).iter().map(|&v| f64::from(v)));
    }
    let camera = SplatCamera {
        rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        translation: [0.0; 3],
        focal: [side as f64; 2],
        centre: [0.5 * side as f64; 2],
        size: [side; 2],
    };
    let config = &scene.config;
    let rules = SplatRules {
        low_pass: f64::from(config.low_pass),
        max_alpha: f64::from(config.max_alpha),
        min_alpha: f64::from(config.min_alpha),
        min_transmittance: f64::from(config.min_transmittance),
        near: f64::from(config.near),
        smooth: false,
    };
    let (raster, pullback) = rasterize(g, f, &scene.camera, config).map_err(fail)?;
    // A fixed scatter over the image, without the pixels that sit on a threshold.
    let splats = sorted_splats(&x, stride, &camera, &rules);
    let candidates: Vec<[usize; 2]> = (0..PIXELS)
        .map(|k| [0.754_877_666, 0.569_840_291].map(|r: f64| ((k as f64 * r + 0.5).fract() * side as f64) as usize))
        .collect();
    let kept: Vec<([usize; 2], Vec<f64>)> = candidates
        .par_iter()
        .filter_map(|&[px, py]| {
            let centre = [px as f64 + 0.5, py as f64 + 0.5];
            let mut transmittance = 1.0;
            for (i, mean, conic, _) in &splats {
                let offset = [centre[0] - mean[0], centre[1] - mean[1]];
                let opacity = x[i * stride + 10];
                let lenient = SplatRules { min_alpha: rules.min_alpha * (1.0 - 2.0 * AMBIGUOUS), ..rules.clone() };
                let alpha = splat_alpha(conic, opacity, offset, &lenient);
                let near = |value: f64, threshold: f64| (value / threshold - 1.0).abs() < AMBIGUOUS;
                if near(alpha, rules.min_alpha) || near(alpha, rules.max_alpha) {
                    return None;
                }
                let next = transmittance * (1.0 - alpha);
                if near(next, rules.min_transmittance) {
                    return None;
                }
                if next <= rules.min_transmittance {
                    break;
                }
                transmittance = next;
            }
            Some(([px, py], splat_pixel(&splats, &x, channels, centre, &rules)))
        })
        .collect();
    let mut image = 0.0f64;
    let mut d = RasterGrad::zeros(side, side, channels);
    let mut cotangents = Vec::with_capacity(kept.len());
    for (k, ([px, py], expected)) in kept.iter().enumerate() {
        let found = raster.features.pixel(*px, *py).iter();
        let found = found.chain(raster.opacity.pixel(*px, *py)).chain(raster.depth.pixel(*px, *py));
        for (a, b) in found.zip(expected) {
            image = image.max((f64::from(*a) - b).abs());
        }
        let c: Vec<f32> = (0..channels + 2).map(|j| ((k * 31 + j * 17) as f32 * 0.618_034).fract() - 0.4).collect();
        d.features.pixel_mut(*px, *py).copy_from_slice(&c[..channels]);
        d.opacity.pixel_mut(*px, *py)[0] = c[channels];
        d.depth.pixel_mut(*px, *py)[0] = c[channels + 1];
        cotangents.push(c);
    }
    let pull = pullback.pull(&d).map_err(fail)?;
    let mut ours = vec![0.0f64; x.len()];
    for i in 0..n {
        let to = &mut ours[i * stride..(i + 1) * stride];
        let grad = &pull.gaussians;
        let row = &pull.features[i * channels..(i + 1) * channels];
        let from = grad.means[i].to_array().into_iter().chain(grad.scales[i].to_array());
        let from = from.chain(grad.rotations[i].to_array()).chain([grad.opacities[i]]).chain(row.iter().copied());
        to.iter_mut().zip(from).for_each(|(t, v)| *t = f64::from(v));
    }
    let groups = [0..3, 3..6, 6..10, 10..11, 11..stride];
    let gradient = groups
        .into_iter()
        .flat_map(|group| [false, true].map(|signs| (group.clone(), signs)))
        .map(|(group, signs)| {
            let direction = |i: usize| {
                let sign = if signs && (i.wrapping_mul(2_654_435_761) >> 16) & 1 == 1 { -1.0 } else { 1.0 };
                if group.contains(&(i % stride)) { sign * ours[i] } else { 0.0 }
            };
            let dual: Vec<Dual> = x.iter().enumerate().map(|(i, &v)| Dual::new(v, direction(i))).collect();
            let splats = sorted_splats(&dual, stride, &camera, &rules);
            let exact: f64 = kept
                .par_iter()
                .zip(&cotangents)
                .map(|(([px, py], _), c)| {
                    let centre = [*px as f64 + 0.5, *py as f64 + 0.5];
                    let pixel = splat_pixel(&splats, &dual, channels, centre, &rules);
                    pixel.iter().zip(c).map(|(p, &c)| p.d * f64::from(c)).sum::<f64>()
                })
                .collect::<Vec<f64>>()
                .iter()
                .sum();
            let (along, length2) = (0..x.len())
                .filter(|i| group.contains(&(i % stride)))
                .fold((0.0, 0.0), |(a, l), i| (a + ours[i] * direction(i), l + ours[i] * ours[i]));
            if length2 > 0.0 { (exact - along).abs() / length2 } else { exact.abs() }
        })
        .fold(0.0, f64::max);
    debug_assert!(Dual::of(1.0).value() == 1.0);
    Ok(Errors { image, gradient, pixels: kept.len() })
}
