//! Pictures of a model under many lights, in bounded memory.
use crate::SssError;
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_reconstruct::Renderer;

/// Renders one camera under each light and hands each picture (linear RGB over black) to `take`, in order; not more of
/// them are held than the renderer was told.
pub fn render_lights(
    renderer: &Renderer<'_>,
    camera: &Camera,
    lights: &[OlatLight],
    take: impl FnMut(usize, &Image) -> Result<(), SssError>,
) -> Result<(), SssError> {
    renderer.each_radiance(camera, lights, take)
}

/// The sum of the renders under each light: light is linear. Linear RGB over black.
pub(crate) fn render_sum(renderer: &Renderer<'_>, camera: &Camera, lights: &[OlatLight]) -> Result<Image, SssError> {
    let mut sum = Image::new(camera.intrinsics.width as usize, camera.intrinsics.height as usize, 3);
    render_lights(renderer, camera, lights, |_, picture| {
        sum.data_mut().iter_mut().zip(picture.data()).for_each(|(s, v)| *s += v);
        Ok(())
    })?;
    Ok(sum)
}
