//! Times the image losses of one training step on the CPU.
//!
//! `cargo run --release -p diamond-losses --example loss_timing [side]`, best of 20 repetitions in milliseconds.
use std::time::Instant;

use diamond_image::{Image, Mask, Transfer};
use diamond_losses::*;
use diamond_metrics::{SsimWindow, ssim_mean_and_grad};

fn best_ms<T>(mut f: impl FnMut() -> Result<T, LossError>) -> Result<f64, LossError> {
    let mut best = f64::INFINITY;
    for _ in 0..20 {
        let start = Instant::now();
        std::hint::black_box(f()?);
        best = best.min(start.elapsed().as_secs_f64() * 1e3);
    }
    Ok(best)
}

fn main() -> Result<(), LossError> {
    let side = std::env::args().nth(1).and_then(|s| s.parse().ok()).unwrap_or(128usize);
    let wave = |channels: usize, phase: f32| {
        let values = (0..side * side * channels).map(|i| 0.5 + 0.4 * ((i * i % 1013) as f32 * 0.37 + phase).sin());
        Image::from_vec(side, side, channels, values.collect())
    };
    let (a, b, o) = (wave(3, 0.0)?, wave(3, 0.4)?, wave(1, 0.1)?);
    let mask = Mask::from_vec(side, side, wave(1, 0.3)?.data().iter().map(|v| v.round()).collect())?;
    let linear = PhotometricOptions::default();
    let srgb = PhotometricOptions { space: Transfer::Srgb, ..linear };
    let average = Average::Inside;
    println!("{side}×{side}, value and gradient, ms");
    let one_by_one = best_ms(|| Ok(Transfer::Srgb.encode_image(&a)))?;
    let vectors = best_ms(|| Ok(encode_image(Transfer::Srgb, &a)))?;
    let per_value = 1e6 / a.data().len() as f64;
    println!("instruction set: {}", diamond_simd::current());
    println!("sRGB one by one           {one_by_one:.3} ({:.2} ns per value)", one_by_one * per_value);
    println!("sRGB on vectors           {vectors:.3} ({:.2} ns per value)", vectors * per_value);
    println!("SSIM and gradient         {:.2}", best_ms(|| Ok(ssim_mean_and_grad(&a, &b, SsimWindow::ZeroPadded)?))?);
    println!("photometric, linear       {:.2}", best_ms(|| photometric(&a, &b, &linear, 1.0))?);
    println!("photometric, sRGB         {:.2}", best_ms(|| photometric(&a, &b, &srgb, 1.0))?);
    println!("photometric, sRGB stored  {:.2}", best_ms(|| photometric_encoded(&a, &b, &srgb, 1.0))?);
    println!("mask                      {:.2}", best_ms(|| mask_bce(&o, &mask))?);
    println!("normal                    {:.2}", best_ms(|| normal_consistency(&a, &b, Some(&mask), average))?);
    println!("smoothness, 1 channel     {:.2}", best_ms(|| smoothness(&o, &b, Some(&mask)))?);
    println!("smoothness, 3 channels    {:.2}", best_ms(|| smoothness(&a, &b, Some(&mask)))?);
    let edges = EdgeWeights::new(&b, Some(&mask))?;
    println!("the same, shared weights  {:.2}", best_ms(|| edges.smoothness(&a))?);
    println!("enhancement               {:.2}", best_ms(|| enhancement(&a, &b, Some(&mask), average))?);
    Ok(())
}
