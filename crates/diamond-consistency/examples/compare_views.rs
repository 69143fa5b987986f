//! Do depth maps and silhouettes of several views belong to one object? Without a renderer, without training.
//!
//! ```text
//! cargo run --release -p diamond-consistency --example compare_views                              # a sphere, computed
//! cargo run --release -p diamond-consistency --example compare_views assets/captures/spot-small   # a capture's geometry
//! ```
//!
//! Prints both terms for each view against its two nearest, then plots how they grow when the second view's depth is
//! scaled and a hole is cut into its silhouette, and writes the error of each pixel of the first pair as `consistency.ppm`
//! (grey: agrees; red: depth differs; blue: silhouette differs; dark green: hidden, dark blue: outside) and, as numbers,
//! `consistency.exr`. Whoever has maps from elsewhere fills [`Seen`] with them.
use diamond_camera::{Camera, Depth, Intrinsics, Pose};
use diamond_consistency::*;
use diamond_dataset::{Capture, OpenOptions, encode_exr};
use diamond_image::Image;
use glam::{Vec2, Vec3};
use std::error::Error;

/// What is known of a view.
struct Seen {
    name: String,
    camera: Camera,
    silhouette: Image,
    depth: DepthMap,
}

impl Seen {
    fn view(&self) -> ViewGeometry<'_> {
        ViewGeometry {
            camera: &self.camera,
            silhouette: &self.silhouette,
            depth: DepthSource::Given(&self.depth),
            mask: None,
        }
    }
}

/// Six views of the unit sphere.
fn sphere() -> Vec<Seen> {
    let size = 96;
    (0..6)
        .map(|k| {
            let (s, c) = (k as f32 * std::f32::consts::TAU / 6.0).sin_cos();
            let pose = Pose::look_at(3.0 * Vec3::new(c, s, 0.5).normalize(), Vec3::ZERO, Vec3::Z);
            let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.9, size, size), pose };
            let (mut silhouette, mut depth) =
                (Image::new(96, 96, 1), DepthMap::unknown(DepthKind::Z, size as usize, size as usize));
            for i in 0..(size * size) as usize {
                let pixel = Vec2::new((i % 96) as f32 + 0.5, (i / 96) as f32 + 0.5);
                let ray = camera.ray(pixel);
                let b = ray.origin.dot(ray.direction);
                let under = b * b - ray.origin.length_squared() + 1.0;
                if under > 0.0 {
                    silhouette.data_mut()[i] = 1.0;
                    depth.values.data_mut()[i] = camera.to_z(pixel, Depth::Distance(-b - under.sqrt()));
                }
            }
            Seen { name: format!("sphere {k}"), camera, silhouette, depth }
        })
        .collect()
}

/// The views of a capture that come with geometry: depth from its files, silhouettes where something is hit.
fn capture(folder: &str) -> Result<Vec<Seen>, Box<dyn Error>> {
    let capture = Capture::open(folder.as_ref(), &OpenOptions::default())?;
    let mut seen = Vec::new();
    for view in capture.train.iter().chain(&capture.test) {
        if let Some(geometry) = view.ground_truth_geometry()? {
            let silhouette = geometry.depth.map(|z| if z > 0.0 { 1.0 } else { 0.0 });
            let depth = DepthMap { kind: DepthKind::Z, values: geometry.depth };
            seen.push(Seen { name: view.name.clone(), camera: view.camera, silhouette, depth });
        }
    }
    Ok(seen)
}

fn main() -> Result<(), Box<dyn Error>> {
    let seen = match std::env::args().nth(1) {
        Some(folder) => capture(&folder)?,
        None => sphere(),
    };
    if seen.len() < 2 {
        return Err("two views with depth are needed; this capture has no geometry/*.exr".into());
    }
    let known = || seen.iter().flat_map(|s| s.depth.values.data().iter().copied()).filter(|z| *z > 0.0);
    let range = DepthRange { near: known().fold(f32::INFINITY, f32::min), far: known().fold(0.0, f32::max) };
    // Nearer than the nearest depth by a little, which rounding must not cut off.
    let range = DepthRange { near: 0.9 * range.near, far: 1.1 * range.far };
    let options = ConsistencyOptions { penalty: SilhouettePenalty::L1, ..ConsistencyOptions::new(range) };
    let cameras: Vec<Camera> = seen.iter().map(|s| s.camera).collect();
    let near = nearest_views(&cameras, Vec3::ZERO, 2);

    println!(
        "{:12} {:12} {:>10} {:>10} {:>8} {:>8}",
        "points of", "looked up in", "silhouette", "depth", "landed", "seen"
    );
    for (i, others) in near.iter().enumerate() {
        for &j in others {
            let pixels = draw_pixels(&seen[i].view(), &options, 4096, 0);
            let (value, _) = pair_consistency(&seen[i].view(), &seen[j].view(), &pixels, &options)?;
            println!(
                "{:12} {:12} {:10.2e} {:10.2e} {:8} {:8}",
                seen[i].name, seen[j].name, value.silhouette, value.depth, value.silhouette_count, value.depth_count
            );
        }
    }

    let (a, b) = (&seen[0], &seen[near[0][0]]);
    let pixels = draw_pixels(&a.view(), &options, usize::MAX, 0);
    println!("\nplanted in {}: depth scaled, and a hole in the middle of the silhouette", b.name);
    for k in 0..8 {
        let scale = 1.0 + 0.005 * k as f32;
        let depth = DepthMap { kind: b.depth.kind, values: b.depth.values.map(|z| scale * z) };
        let scaled = ViewGeometry { depth: DepthSource::Given(&depth), ..b.view() };
        let mut holed = b.silhouette.clone();
        let (w, h, _) = holed.shape();
        for i in 0..w * h {
            if (i % w).abs_diff(w / 2).max((i / w).abs_diff(h / 2)) < 2 * k {
                holed.data_mut()[i] = 0.0;
            }
        }
        let hole = ViewGeometry { silhouette: &holed, ..b.view() };
        let depth = pair_consistency(&a.view(), &scaled, &pixels, &options)?.0.depth;
        let silhouette = pair_consistency(&a.view(), &hole, &pixels, &options)?.0.silhouette;
        let bar = |v: f32, full: f32| "█".repeat((40.0 * v / full).round().clamp(0.0, 40.0) as usize);
        println!(
            "  ×{scale:.3} {depth:9.2e} {:40}  {:2} px {silhouette:9.2e} {}",
            bar(depth, 0.06),
            4 * k,
            bar(silhouette, 0.5)
        );
    }

    let (_, pullback) = pair_consistency(&a.view(), &b.view(), &pixels, &options)?;
    let (width, height, _) = a.silhouette.shape();
    let mut picture = vec![0u8; 3 * width * height];
    let (mut silhouette, mut depth) = (vec![0.0f32; width * height], vec![0.0f32; width * height]);
    for c in pullback.correspondences() {
        let i = c.pixel as usize;
        (silhouette[i], depth[i]) = (c.silhouette_cost, c.depth_cost);
        let shade = |v: f32, full: f32| (255.0 * (v / full).clamp(0.0, 1.0)) as u8;
        picture[3 * i..3 * i + 3].copy_from_slice(&match c.fate {
            Fate::Empty | Fate::NoDepth => [0, 0, 0],
            Fate::Behind | Fate::Outside => [0, 0, 60],
            Fate::Hidden | Fate::Averted => [0, 90, 0],
            Fate::Hollow | Fate::Seen => {
                let (red, blue) = (shade(c.depth_cost, 0.01), shade(c.silhouette_cost, 1.0));
                [90.max(red), 90, 90.max(blue)]
            }
        });
    }
    let mut ppm = format!("P6\n{width} {height}\n255\n").into_bytes();
    ppm.extend(picture);
    std::fs::write("consistency.ppm", ppm)?;
    std::fs::write("consistency.exr", encode_exr(width, height, [("depth", depth), ("silhouette", silhouette)])?)?;
    println!("\n{} in {}: consistency.ppm, consistency.exr", a.name, b.name);
    Ok(())
}
