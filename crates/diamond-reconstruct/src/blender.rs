//! Where Gaussians are blended into pictures: on the CPU, or by whoever implements [`Blender`].
use diamond_camera::Camera;
use diamond_splat::{Features, Gaussians, Raster, RasterConfig, RasterGrad, RasterPull};

/// Does what [`diamond_splat::rasterize`] and its pullback do, elsewhere: same thresholds, same order, results that agree to
/// rounding, and the same bits from the same input.
pub trait Blender {
    /// Name for logs.
    fn name(&self) -> &str;

    /// A view of the Gaussians.
    ///
    /// # Errors
    /// What is wrong and what to do, as text.
    fn blend(
        &mut self,
        gaussians: &Gaussians,
        features: &Features,
        camera: &Camera,
        config: &RasterConfig,
    ) -> Result<Raster, String>;

    /// The reverse of the last [`Blender::blend`]: cotangents of its images to gradients.
    ///
    /// # Errors
    /// What is wrong and what to do, as text; among others that nothing was blended before.
    fn pull(&mut self, d: &RasterGrad) -> Result<RasterPull, String>;
}
