//! Pictures of a model under many lights, in bounded memory.
use crate::SssError;
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_reconstruct::{Model, Rendering};

/// Bytes that the renderings of one group of lights may occupy.
const GROUP_BYTES: usize = 256 << 20;
/// Values per pixel of a rendering with its maps.
const VALUES_PER_PIXEL: usize = 32;

/// Renders one camera under each light and hands each rendering to `take`, in order.
pub fn render_lights(
    model: &Model,
    camera: &Camera,
    lights: &[OlatLight],
    mut take: impl FnMut(usize, Rendering) -> Result<(), SssError>,
) -> Result<(), SssError> {
    let pixels = camera.intrinsics.width as usize * camera.intrinsics.height as usize;
    let group = (GROUP_BYTES / (pixels * VALUES_PER_PIXEL * 4).max(1)).clamp(1, 64);
    for (g, chunk) in lights.chunks(group).enumerate() {
        for (i, rendering) in model.render(camera, chunk)?.into_iter().enumerate() {
            take(g * group + i, rendering)?;
        }
    }
    Ok(())
}

/// The sum of the renders under each light: light is linear. Linear RGB over black.
pub(crate) fn render_sum(model: &Model, camera: &Camera, lights: &[OlatLight]) -> Result<Image, SssError> {
    let mut sum = Image::new(camera.intrinsics.width as usize, camera.intrinsics.height as usize, 3);
    render_lights(model, camera, lights, |_, rendering| {
        sum.data_mut().iter_mut().zip(rendering.radiance.data()).for_each(|(s, v)| *s += v);
        Ok(())
    })?;
    Ok(sum)
}
