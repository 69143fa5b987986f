//! Pictures of a model under many lights, in bounded memory.
use crate::{AtOnce, SssError};
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_reconstruct::{Model, Renderer};

/// Renders one camera under each light and hands each picture (linear RGB over black) to `take`, in order; not more of
/// them are held than `at_once` says.
pub fn render_lights(
    renderer: &Renderer<'_>,
    at_once: &AtOnce,
    camera: &Camera,
    lights: &[OlatLight],
    mut take: impl FnMut(usize, Image) -> Result<(), SssError>,
) -> Result<(), SssError> {
    let pixels = u64::from(camera.intrinsics.width) * u64::from(camera.intrinsics.height);
    let group = at_once.pictures_together(pixels);
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
    let at_once = AtOnce::default();
    render_lights(&at_once.renderer(model), &at_once, camera, lights, |_, picture| {
        sum.data_mut().iter_mut().zip(picture.data()).for_each(|(s, v)| *s += v);
        Ok(())
    })?;
    Ok(sum)
}
