//! Writes a capture in another format:
//! `cargo run -p diamond-dataset --example convert -- FROM TO blender|nerfstudio|colmap-text|colmap-binary`
//!
//! Images become 8-bit PNGs with undistorted pictures and masks as alpha. Points of a COLMAP model, or a `points3d.ply`,
//! come along.
use diamond_dataset::{
    Capture, ColmapEncoding, ColmapPoints, OpenOptions, read_colmap_points, write_capture, write_colmap,
    write_nerfstudio,
};
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [from, to, format] = arguments.as_slice() else {
        return Err("usage: convert FROM TO blender|nerfstudio|colmap-text|colmap-binary".into());
    };
    let capture = Capture::open(Path::new(from), &OpenOptions::default())?;
    capture.notes.iter().for_each(|note| println!("{note}"));
    let description = capture.describe();
    let pixels = |split, view, shot| capture.pixels_of(split, view, shot);
    let points = match &capture.points {
        Some(path) if path.extension().is_some_and(|e| e == "bin" || e == "txt") => read_colmap_points(path)?,
        _ => ColmapPoints::default(),
    };
    let to = Path::new(to);
    match format.as_str() {
        "blender" => write_capture(to, &description, pixels)?,
        "nerfstudio" => write_nerfstudio(to, &description, pixels)?,
        "colmap-text" => write_colmap(to, &description, ColmapEncoding::Text, &points, pixels)?,
        "colmap-binary" => write_colmap(to, &description, ColmapEncoding::Binary, &points, pixels)?,
        other => return Err(format!("{other} is no format").into()),
    }
    println!("wrote {}", to.display());
    Ok(())
}
