//! Who makes pictures of a view under many lights, if not the CPU: whoever implements [`Relighter`]. The renderer prepares what a light is to the
//! Gaussians (rays, and what a medium sends out), once for all views where it may keep it.
use crate::{ChannelLayout, Model, ReconstructError};
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_shading::{InputScaling, ShadingConfig};
use diamond_splat::RasterConfig;
use glam::Vec3;

/// A view of a model.
#[derive(Debug, Clone, Copy)]
pub struct RelightView<'a> {
    /// From where.
    pub camera: &'a Camera,
    /// What is seen.
    pub model: &'a Model,
    /// Settings of the rasteriser.
    pub raster: &'a RasterConfig,
    /// Settings of the shader.
    pub shading: &'a ShadingConfig,
    /// How the network's inputs are made dimensionless.
    pub scaling: &'a InputScaling,
    /// Channels that the radiance depends on.
    pub layout: &'a ChannelLayout,
}

/// A light as the Gaussians know it.
#[derive(Debug, Clone)]
pub struct RelightLight {
    /// Scaled to the scene.
    pub light: OlatLight,
    /// Traced visibility of every Gaussian; `None` where the harmonics' stands for it or nothing reads it.
    pub visibility: Option<Vec<f32>>,
    /// What a medium sends out of each Gaussian, tinted, linear RGB; empty without a medium.
    pub sent: Vec<Vec3>,
    /// Whether anything reads the light's visibility.
    pub visible: bool,
}

/// Makes pictures of a view under many lights from one projection: the formulas of [`crate::Renderer`], results that agree to rounding, and the same bits from
/// the same input. Errors are text: what is wrong and what to do.
pub trait Relighter: Send {
    /// Name for logs.
    fn name(&self) -> &str;

    /// What of such a model it cannot do, in words of the configuration; `None`: nothing.
    fn lacks(&self, model: &Model) -> Option<String>;

    /// Projects a view and blends what does not depend on the light.
    ///
    /// # Errors
    /// No room, or the device is lost.
    fn view(&mut self, view: &RelightView<'_>) -> Result<(), String>;

    /// Radiance of the last view under each light, linear RGB over black.
    ///
    /// # Errors
    /// No room, or the device is lost.
    fn radiance(&mut self, view: &RelightView<'_>, lights: &[RelightLight]) -> Result<Vec<Image>, String>;
}

pub(crate) fn device(detail: String) -> ReconstructError {
    ReconstructError::Device { detail }
}
