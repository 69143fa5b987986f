//! What is in a splat file, for a person: figures, and the cloud seen along the three axes.
use crate::SssError;
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_splat::{Features, RasterConfig, rasterize};
use diamond_splat_files::{ColorSpace, SplatCloud, SplatFile};
use glam::Vec3;
use std::path::Path;

/// Side of each of the views, pixels.
const SIDE: u32 = 400;

/// Horizontal field of view, radians.
const FIELD: f32 = 0.7;

/// The figures as text.
pub fn inspect_splats(path: &Path, file: &SplatFile) -> String {
    let mut out = format!("{}: {}\n", path.display(), file.format.name());
    out += &file.cloud.summary().to_text(&file.cloud);
    for note in &file.notes {
        out += &format!("note: {note}\n");
    }
    out
}

/// The cloud from three sides over black, next to each other: along +z with y down (as cameras of captures see it), along −y
/// with z up, and along −x with z up. Width, height and sRGB bytes.
pub fn splat_picture(cloud: &SplatCloud) -> Result<(usize, usize, Vec<u8>), SssError> {
    let splats = |e: diamond_splat::SplatError| SssError::Splats(e.into());
    let gaussians = cloud.to_gaussians();
    let summary = cloud.summary();
    let (low, high) = summary.core.unwrap_or((Vec3::ZERO, Vec3::ONE));
    let centre = 0.5 * (low + high);
    let radius = (0.5 * (high - low).length()).max(1e-3);
    let distance = 1.2 * radius / libm::tanf(0.5 * FIELD);
    let config = RasterConfig { near: (0.01 * distance).max(1e-6), ..RasterConfig::default() };
    let side = SIDE as usize;
    let mut out = vec![0; 3 * side * side * 3];
    for (panel, (from, up)) in [(-Vec3::Z, -Vec3::Y), (Vec3::Y, Vec3::Z), (Vec3::X, Vec3::Z)].into_iter().enumerate() {
        let eye = centre + from * distance;
        let camera =
            Camera { intrinsics: Intrinsics::from_fov_x(FIELD, SIDE, SIDE), pose: Pose::look_at(eye, centre, up) };
        let color = |i: usize| cloud.color(i, (cloud.means[i] - eye).normalize_or(Vec3::Z)).to_array();
        let data = (0..cloud.len()).flat_map(color).collect();
        let features = Features { channels: 3, data };
        let (raster, _) = rasterize(&gaussians, &features, &camera, &config).map_err(splats)?;
        for (i, v) in raster.features.data().iter().enumerate() {
            let (row, rest) = (i / (side * 3), i % (side * 3));
            let display = match cloud.color_space {
                ColorSpace::Display => *v,
                ColorSpace::Linear => diamond_image::Transfer::Srgb.encode(*v),
            };
            out[(row * 3 + panel) * side * 3 + rest] = (display.clamp(0.0, 1.0) * 255.0).round() as u8;
        }
    }
    Ok((3 * side, side, out))
}
