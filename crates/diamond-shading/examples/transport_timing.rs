//! Time of transport between surfels: `cargo run --release -p diamond-shading --features parallel --example transport_timing -- [SURFELS [LIGHTS [ROUNDS]]]`.
//!
//! Surfels lie evenly on a unit sphere and are their own receivers; 14 widths from one distance of neighbours to the radius. Error: against the
//! plain double sum at 200 receivers, relative to the largest radiosity.
use diamond_shading::{Balance, RadialProfile, SurfelTransport, Surfels, plane_gaussian};
use glam::Vec3;
use std::time::Instant;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<usize> = std::env::args().skip(1).map(|a| a.parse()).collect::<Result<_, _>>()?;
    let number = |i: usize, default: usize| arguments.get(i).copied().unwrap_or(default);
    let (count, lights, rounds) = (number(0, 20_000), number(1, 1), number(2, 5));
    let golden = std::f32::consts::PI * (3.0 - 5f32.sqrt());
    let place = |i: usize| {
        let z = 1.0 - (2.0 * i as f32 + 1.0) / count as f32;
        let (sin, cos) = (golden * i as f32).sin_cos();
        Vec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z)
    };
    let positions: Vec<Vec3> = (0..count).map(place).collect();
    let area = 4.0 * std::f32::consts::PI / count as f32;
    let widths = RadialProfile::geometric_widths(area.sqrt(), 1.0, 14);
    let profile = RadialProfile::new(widths.clone(), vec![Vec3::splat(0.06); 14])?;
    let irradiance: Vec<f32> = positions.iter().flat_map(|p| vec![p.z.max(0.0); 3 * lights]).collect();
    for balance in [Balance::Plain, Balance::Conserving] {
        let start = Instant::now();
        let surfels = Surfels { positions: positions.clone(), areas: vec![area; count] };
        let transport = SurfelTransport::new(surfels, widths.clone(), balance)?;
        let receivers = transport.receivers(&positions)?;
        println!("{balance:?}: prepared in {:.1} ms", 1e3 * start.elapsed().as_secs_f64());
        let mut best = f64::INFINITY;
        let mut found = Vec::new();
        for _ in 0..rounds.max(1) {
            let start = Instant::now();
            found = receivers.exitance(&profile, &irradiance)?.0;
            best = best.min(start.elapsed().as_secs_f64());
        }
        println!("  {count} surfels, {lights} lights × 3 channels, 14 widths: {:.1} ms at best", 1e3 * best);
        if balance == Balance::Plain {
            let mut worst = 0.0f64;
            for i in (0..count).step_by((count / 200).max(1)) {
                let mut sum = 0.0f64;
                for p in &positions {
                    let r2 = p.distance_squared(positions[i]);
                    let r: f32 = widths.iter().map(|s| 0.06 * plane_gaussian(r2, *s)).sum();
                    sum += f64::from(r * area * p.z.max(0.0));
                }
                worst = worst.max((f64::from(found[3 * lights * i]) - sum).abs());
            }
            let largest = f64::from(found.iter().fold(0.0f32, |m, v| m.max(*v)));
            println!("  worst error {:.1e} of the largest", worst / largest);
        }
    }
    Ok(())
}
