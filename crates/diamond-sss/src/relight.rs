//! Pictures of a model under many lights, in bounded memory.
use crate::SssError;
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_reconstruct::{Model, Renderer};

/// Bytes that the pictures of one group of lights may occupy.
const GROUP_BYTES: usize = 256 << 20;
/// Values per pixel of a picture and its part of the channels that are blended.
const VALUES_PER_PIXEL: usize = 4;

/// Renders one camera under each light and hands each picture (linear RGB over black) to `take`, in order.
pub fn render_lights(
    renderer: &Renderer<'_>,
    camera: &Camera,
    lights: &[OlatLight],
    mut take: impl FnMut(usize, Image) -> Result<(), SssError>,
) -> Result<(), SssError> {
    let pixels = camera.intrinsics.width as usize * camera.intrinsics.height as usize;
    let group = (GROUP_BYTES / (pixels * VALUES_PER_PIXEL * 4).max(1)).clamp(1, 1024);
    for (g, chunk) in lights.chunks(group).enumerate() {
        for (i, picture) in renderer.radiance(camera, chunk)?.into_iter().enumerate() {
            take(g * group + i, picture)?;
        }
    }
    Ok(())
}

/// The sum of the renders under each light: light is linear. Linear RGB over black.
pub(crate) fn render_sum(model: &Model, camera: &Camera, lights: &[OlatLight]) -> Result<Image, SssError> {
    let mut sum = Image::new(camera.intrinsics.width as usize, camera.intrinsics.height as usize, 3);
    render_lights(&Renderer::new(model), camera, lights, |_, picture| {
        sum.data_mut().iter_mut().zip(picture.data()).for_each(|(s, v)| *s += v);
        Ok(())
    })?;
    Ok(sum)
}
