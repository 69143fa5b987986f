//! Time of exit walks: a sphere as a mesh of about 5000 surfels at several optical radii, with and without a boundary.
//!
//!     cargo run --release -p diamond-pathtrace --example exit_walks_timing
use diamond_pathtrace::{Boundary, ExitWalkOptions, ExitWalks, Geometry, Mesh};
use glam::Vec3;
use std::time::Instant;

fn main() {
    let mesh = Mesh::icosphere(Vec3::ZERO, 1.0, 4);
    let patches = mesh.patches(1.0).expect("a mesh");
    let geometry = Geometry::from_mesh(mesh).expect("a mesh");
    println!(
        "| radius / mfp | g | boundary | surfels | trace s | collapse s | moments s (4 lights) | bins | MB | left | lost | albedo .9 |"
    );
    for (sigma_t, g) in [(3.0, 0.0), (20.0, 0.0), (60.0, 0.8)] {
        for boundary in [Boundary::IndexMatched, Boundary::Rough { eta: 1.4, alpha: 0.5 }] {
            let options = ExitWalkOptions::default();
            let start = Instant::now();
            let walks = ExitWalks::trace(&geometry, sigma_t, g, boundary, &patches, &options, &|_| ()).expect("walks");
            let traced = start.elapsed().as_secs_f64();
            let start = Instant::now();
            let operator = walks.collapse(0.9).expect("an albedo");
            let collapsed = start.elapsed().as_secs_f64();
            let cosines: Vec<f32> =
                patches.iter().flat_map(|p| p.normal.to_array().into_iter().chain([-p.normal.x])).collect();
            let irradiance: Vec<f32> = cosines.iter().map(|c| c.max(0.0)).collect();
            let start = Instant::now();
            let moments = walks.moments(&irradiance, &cosines).expect("lights");
            println!(
                "| {sigma_t} | {g} | {boundary:?} | {} | {traced:.2} | {collapsed:.3} | {:.3} | {} | {:.1} | {:.3} | {:.1e} | {:.4} |",
                operator.surfels(),
                start.elapsed().as_secs_f64(),
                moments.exponents.len(),
                walks.bytes() as f64 * 1e-6,
                walks.fates().left,
                walks.fates().lost,
                walks.diffuse_albedo(0.9),
            );
        }
    }
}
