//! What a view is made of, as pictures: materials, normals, depth, the parts of the light.
use crate::SssError;
use crate::picture::{byte, encode_png_grey, encode_png_linear, encode_png_rgb, grey_bytes};
use base64::Engine as _;
use diamond_reconstruct::Rendering;

/// A PNG as the source of an `<img>`.
pub fn data_uri(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", base64::engine::general_purpose::STANDARD.encode(png))
}

/// Name, remark and encoded PNG of one map.
pub type MapPicture = (&'static str, String, Vec<u8>);

/// Name, remark and PNG of each map of a rendering.
pub fn map_pictures(r: &Rendering) -> Result<Vec<MapPicture>, SssError> {
    let (width, height) = (r.radiance.width(), r.radiance.height());
    let opacity = r.opacity.data();
    let over_black = |v: f32, i: usize| v * opacity[i];
    let grey = |image: &diamond_image::Image| {
        let bytes: Vec<u8> = image.data().iter().enumerate().map(|(i, v)| byte(over_black(*v, i))).collect();
        encode_png_grey(&bytes, width, height)
    };
    let normals: Vec<u8> =
        r.maps.normal.data().iter().enumerate().map(|(i, v)| byte(over_black(0.5 + 0.5 * v, i / 3))).collect();
    let mut colour = r.maps.base_color.clone();
    colour.data_mut().iter_mut().enumerate().for_each(|(i, v)| *v = over_black(*v, i / 3));
    let solid: Vec<f32> = r.maps.depth.data().iter().zip(opacity).filter(|(_, o)| **o > 0.5).map(|(d, _)| *d).collect();
    let low = solid.iter().copied().fold(f32::INFINITY, f32::min);
    let high = solid.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let (depth, depth_note) = if solid.is_empty() {
        (vec![0; width * height], "nothing opaque".to_owned())
    } else {
        // Near is bright: a margin keeps the farthest point apart from the background.
        let span = (high - low).max(1e-6);
        let bytes = r.maps.depth.data().iter().enumerate();
        let bytes: Vec<u8> = bytes.map(|(i, d)| byte(over_black(1.0 - 0.85 * (d - low) / span, i))).collect();
        (bytes, format!("near {low:.2}, far {high:.2}"))
    };
    Ok(vec![
        ("Render", "as photographed".into(), encode_png_linear(&r.radiance)?),
        ("Surface part", "reflected at the surface".into(), encode_png_linear(&r.surface)?),
        ("Subsurface part", "scattered inside".into(), encode_png_linear(&r.subsurface)?),
        ("Base colour", "sRGB".into(), encode_png_linear(&colour)?),
        ("Subsurfaceness", "0 black, 1 white".into(), grey(&r.maps.subsurfaceness)?),
        ("Roughness", "0 black, 1 white".into(), grey(&r.maps.roughness)?),
        ("Metalness", "0 black, 1 white".into(), grey(&r.maps.metalness)?),
        ("Normals", "world x y z as r g b".into(), encode_png_rgb(&normals, width, height)?),
        ("Depth", depth_note, encode_png_grey(&depth, width, height)?),
        ("Light visibility", "0 black, 1 white".into(), grey(&r.maps.visibility)?),
        ("Opacity", "0 black, 1 white".into(), encode_png_grey(&grey_bytes(&r.opacity, 0.0, 1.0), width, height)?),
    ])
}
