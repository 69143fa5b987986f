//! Speed of the convolution here against candle's own, forward and backward, in one run.
//!
//!     cargo run --release -p diamond-diffusion --example conv_speed
use candle_core::{Device, Tensor, Var};
use diamond_diffusion::Noise;
use diamond_diffusion::nn::conv2d;
use std::time::Instant;

/// Seconds of the fastest of three runs.
fn fastest(mut run: impl FnMut() -> candle_core::Result<()>) -> candle_core::Result<f64> {
    let mut best = f64::INFINITY;
    for _ in 0..3 {
        let start = Instant::now();
        run()?;
        best = best.min(start.elapsed().as_secs_f64());
    }
    Ok(best)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("threads {}, batch 4, kernel 3 × 3, f32; GFLOP/s", rayon::current_num_threads());
    println!("{:>14} {:>9} {:>9} {:>9} {:>9}", "channels, side", "forward", "candle's", "backward", "candle's");
    for (channels, side) in [(48, 64), (48, 32), (96, 16), (128, 8), (320, 32)] {
        let draw = |name: &str, shape: [usize; 4]| -> Result<Var, Box<dyn std::error::Error>> {
            Ok(Var::from_tensor(&Noise::new(1, name, 0).normal_tensor(&shape, &Device::Cpu)?)?)
        };
        let (x, w) = (draw("x", [4, channels, side, side])?, draw("w", [channels, channels, 3, 3])?);
        let flop = 2.0 * 9.0 * (4 * channels * channels * side * side) as f64;
        let mut line = format!("{:>14}", format!("{channels}, {side}"));
        let forward: [Box<dyn Fn() -> candle_core::Result<Tensor>>; 2] =
            [Box::new(|| conv2d(&x, &w, 1, 1)), Box::new(|| x.conv2d(&w, 1, 1, 1, 1))];
        let mut speeds = Vec::new();
        for run in &forward {
            let seconds = fastest(|| run().map(drop))?;
            let both = fastest(|| run()?.sum_all()?.backward().map(drop))?;
            speeds.push((flop / seconds / 1e9, 2.0 * flop / (both - seconds) / 1e9));
        }
        for value in [speeds[0].0, speeds[1].0, speeds[0].1, speeds[1].1] {
            line += &format!(" {value:>9.1}");
        }
        println!("{line}");
    }
    Ok(())
}
