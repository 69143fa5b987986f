//! Pictures as file bytes: PNG for display, EXR for linear light; and maps made visible.
use crate::SssError;
use diamond_dataset::to_display;
use diamond_image::Image;

fn encode(bytes: &[u8], width: usize, height: usize, colour: image::ExtendedColorType) -> Result<Vec<u8>, SssError> {
    let mut out = std::io::Cursor::new(Vec::new());
    image::write_buffer_with_format(&mut out, bytes, width as u32, height as u32, colour, image::ImageFormat::Png)
        .map_err(|e| SssError::Internal(format!("a {width}×{height} picture cannot be encoded as PNG: {e}")))?;
    Ok(out.into_inner())
}

/// PNG of 8-bit RGB bytes, row-major.
pub fn encode_png_rgb(bytes: &[u8], width: usize, height: usize) -> Result<Vec<u8>, SssError> {
    encode(bytes, width, height, image::ExtendedColorType::Rgb8)
}

/// PNG of 8-bit grey bytes, row-major.
pub fn encode_png_grey(bytes: &[u8], width: usize, height: usize) -> Result<Vec<u8>, SssError> {
    encode(bytes, width, height, image::ExtendedColorType::L8)
}

/// PNG in display sRGB of linear RGB radiance.
pub(crate) fn encode_png_linear(image: &Image) -> Result<Vec<u8>, SssError> {
    encode_png_rgb(&to_display(image), image.width(), image.height())
}

/// EXR (32-bit float) of linear RGB radiance.
pub fn encode_exr(image: &Image) -> Result<Vec<u8>, SssError> {
    use exr::prelude::{Image as Exr, SpecificChannels, WritableImage};
    let (width, height) = (image.width(), image.height());
    let channels = SpecificChannels::rgb(|at: exr::prelude::Vec2<usize>| {
        let p = image.pixel(at.0, at.1);
        (p[0], p[1], p[2])
    });
    let mut out = std::io::Cursor::new(Vec::new());
    Exr::from_channels((width, height), channels)
        .write()
        .to_buffered(&mut out)
        .map_err(|e| SssError::Internal(format!("a {width}×{height} picture cannot be encoded as EXR: {e}")))?;
    Ok(out.into_inner())
}

/// One channel in `[low, high]` as grey bytes.
pub(crate) fn grey_bytes(image: &Image, low: f32, high: f32) -> Vec<u8> {
    let scale = 1.0 / (high - low).max(1e-12);
    image.data().iter().step_by(image.channels().max(1)).map(|v| byte((v - low) * scale)).collect()
}

/// Values already between 0 and 1 as bytes, without any transfer.
pub(crate) fn byte(v: f32) -> u8 {
    (v.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// A perceptually rising ramp from black over violet and orange to a pale yellow, display sRGB.
const HEAT: [[f32; 3]; 6] = [
    [0.0, 0.0, 0.02],
    [0.22, 0.06, 0.42],
    [0.55, 0.13, 0.45],
    [0.86, 0.30, 0.30],
    [0.98, 0.62, 0.20],
    [0.99, 0.98, 0.75],
];

/// One channel in `[0, high]` as RGB bytes of the heat ramp.
pub(crate) fn heat_bytes(image: &Image, high: f32) -> Vec<u8> {
    image
        .data()
        .iter()
        .step_by(image.channels().max(1))
        .flat_map(|v| {
            let at = (v / high.max(1e-12)).clamp(0.0, 1.0) * (HEAT.len() - 1) as f32;
            let i = (at as usize).min(HEAT.len() - 2);
            let t = at - i as f32;
            [0, 1, 2].map(|c| byte(HEAT[i][c] * (1.0 - t) + HEAT[i + 1][c] * t))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_comes_back_from_png_and_exr() {
        let image = Image::from_vec(3, 2, 3, (0..18).map(|i| i as f32 / 17.0).collect()).unwrap();
        let png = encode_png_linear(&image).unwrap();
        let again = image::load_from_memory(&png).unwrap().to_rgb8();
        assert_eq!(again.as_raw(), &to_display(&image));
        let exr = encode_exr(&image).unwrap();
        assert_eq!(&exr[..4], [0x76, 0x2f, 0x31, 0x01]);
        let heat = heat_bytes(&Image::from_vec(2, 1, 1, vec![0.0, 9.0]).unwrap(), 1.0);
        assert!(heat[0] < 10 && heat[3] > 240);
    }
}
