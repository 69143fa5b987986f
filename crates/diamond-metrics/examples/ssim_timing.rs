//! Times SSIM on the CPU: value only, fused value and gradient, and FLIP for comparison.
//!
//! `cargo run --release -p diamond-metrics --example ssim_timing [side]`, best of several repetitions in milliseconds.
use std::time::Instant;

use diamond_image::Image;
use diamond_metrics::{FlipOptions, MetricError, SsimWindow, flip_ldr, ssim_mean, ssim_mean_and_grad};

fn best_ms<T>(repetitions: usize, mut f: impl FnMut() -> Result<T, MetricError>) -> Result<f64, MetricError> {
    let mut best = f64::INFINITY;
    for _ in 0..repetitions {
        let start = Instant::now();
        std::hint::black_box(f()?);
        best = best.min(start.elapsed().as_secs_f64() * 1e3);
    }
    Ok(best)
}

fn main() -> Result<(), MetricError> {
    let only: Option<usize> = std::env::args().nth(1).and_then(|s| s.parse().ok());
    println!("side   value ms   value+gradient ms   FLIP ms");
    for side in only.map_or(vec![128, 256, 512], |s| vec![s]) {
        let wave = |phase: f32| {
            let values = (0..side * side * 3).map(|i| 0.5 + 0.4 * ((i * i % 1013) as f32 * 0.37 + phase).sin());
            Image::from_vec(side, side, 3, values.collect())
        };
        let (a, b) = (wave(0.0)?, wave(0.4)?);
        let window = SsimWindow::ZeroPadded;
        let value = best_ms(30, || ssim_mean(&a, &b, window))?;
        let both = best_ms(30, || ssim_mean_and_grad(&a, &b, window))?;
        let flip = best_ms(2, || flip_ldr(&a, &b, FlipOptions::default()))?;
        println!("{side:4}   {value:8.2}   {both:17.2}   {flip:7.1}");
    }
    Ok(())
}
