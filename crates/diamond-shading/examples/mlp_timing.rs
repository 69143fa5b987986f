//! Milliseconds and GFLOP/s of the subsurface residual network, forward and backward, for 10,000 rows.
//!
//! Floating-point operations count what the mathematics needs: two per weight and row forward, four backward (less the
//! first layer's input gradient where none is wanted); the backward pass really does two more, since it recomputes the
//! activations. A checksum of all bits is printed to compare builds with and without `parallel`.
use diamond_shading::{ResidualNetwork, ResidualNetworkConfig, ShadingError};
use std::hint::black_box;
use std::time::Instant;

/// Seconds that this thread has been running, where the system tells (Linux).
fn processor_seconds() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    text.split_whitespace().next()?.parse::<f64>().ok().map(|ns| ns * 1e-9)
}

/// Least wall seconds and mean processor seconds of this thread, of 100 calls.
fn best(mut f: impl FnMut()) -> (f64, f64) {
    let calls = 100;
    let processor_start = processor_seconds();
    let wall = (0..calls).fold(f64::INFINITY, |wall, _| {
        let start = Instant::now();
        f();
        wall.min(start.elapsed().as_secs_f64())
    });
    let processor = processor_seconds().zip(processor_start).map_or(f64::NAN, |(end, start)| end - start);
    (wall, processor / f64::from(calls))
}

fn checksum(values: &[&[f32]]) -> u64 {
    values.concat().iter().fold(0, |sum: u64, v| sum.rotate_left(7) ^ u64::from(v.to_bits()))
}

fn main() -> Result<(), ShadingError> {
    let batch = 10_000;
    let mut state = 1u32;
    let mut uniform = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / 16_777_216.0
    };
    for (preset, config) in [
        ("sss-3dgs", ResidualNetworkConfig { incident_bias: 1.0, ..ResidualNetworkConfig::sss_3dgs() }),
        ("paper", ResidualNetworkConfig::paper()),
    ] {
        let network = ResidualNetwork::initialise(&config, &mut uniform)?;
        let mut numbers = |count: usize| (0..count).map(|_| 2.0 * uniform() - 1.0).collect::<Vec<f32>>();
        let (inputs, d_residual) = (numbers(batch * config.inputs()), numbers(3 * batch));
        let d_incident = numbers(if network.incident_head.is_some() { batch } else { 0 });
        let backward = |input_gradient: bool| {
            let (output, pullback) = network.forward(&inputs, batch)?;
            Ok::<_, ShadingError>((output, pullback.pull(&d_residual, &d_incident, input_gradient)?))
        };
        let (output, grad) = backward(true)?;
        let incident_head = grad.incident_head.unwrap_or_default();
        let d_inputs = grad.inputs.unwrap_or_default();
        let parts = [&output.residual, &output.incident, &grad.trunk, &grad.residual_head, &incident_head, &d_inputs];
        println!("{preset}: checksum {:016x}", checksum(&parts.map(Vec::as_slice)));
        let shapes = [Some(&network.trunk), Some(&network.residual_head), network.incident_head.as_ref()];
        let widths = shapes.into_iter().flatten().flat_map(|mlp| mlp.shape.widths.windows(2));
        let forward_flop = 2.0 * batch as f64 * widths.map(|w| (w[0] * w[1]) as f64).sum::<f64>();
        let first = 2.0 * batch as f64 * (network.trunk.shape.widths[0] * network.trunk.shape.widths[1]) as f64;
        let times = [
            ("forward", forward_flop, best(|| drop(black_box(network.forward(&inputs, batch))))),
            ("forward + backward", 3.0 * forward_flop - first, best(|| drop(black_box(backward(false))))),
            ("forward + backward with inputs", 3.0 * forward_flop, best(|| drop(black_box(backward(true))))),
        ];
        for (what, flop, (wall, processor)) in times {
            print!("{preset} {what}: best wall {:.2} ms, {:.0} GFLOP/s", wall * 1e3, flop / wall * 1e-9);
            // With `parallel` this thread only waits.
            if cfg!(not(feature = "parallel")) {
                print!("; mean processor time {:.2} ms, {:.0} GFLOP/s", processor * 1e3, flop / processor * 1e-9);
            }
            println!();
        }
    }
    Ok(())
}
