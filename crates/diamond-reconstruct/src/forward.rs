//! From raw parameters to a picture under one light, and the way back: the stages between the parameters and the
//! objective, in the order in which they run.
use crate::cpu::Profile;
use crate::{
    Activated, ActivatedGrad, Attribute, CombineVariant, Config, DiffuseVariant, FresnelVariant, IncidentVariant,
    MaskingVariant, Model, ReconstructError, Rendering, StepPlan, error, visibility_cache,
};
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::{OlatLight, spherical_harmonics};
use diamond_shading::deferred::{
    Combine, GBuffer, IncidentModel, ShadePullback, Shaded, ShadedGrad, ShadingConfig, SurfaceVisibility, channel, shade,
};
use diamond_shading::residual::{ResidualInputs, ResidualPullback};
use diamond_shading::{BrdfModel, Diffuse, Fresnel, Masking};
use diamond_splat::{
    Cutoff, Features, Gaussians, GaussiansGrad, Projection, Raster, RasterConfig, RasterGrad, RasterPullback, project,
    rasterize_projected,
};
use glam::{Vec2, Vec3};
use std::time::Instant;

/// The rasteriser's settings under a configuration.
pub fn raster_config(model: &Model) -> RasterConfig {
    let s = &model.config.splat;
    RasterConfig {
        low_pass: s.low_pass,
        max_alpha: s.max_alpha,
        min_alpha: s.min_alpha,
        min_transmittance: s.min_transmittance,
        near: (s.near * model.scene.camera_distance).max(1e-5),
        cutoff: Cutoff::Hard,
    }
}

/// Settings of one forward pass.
#[derive(Debug, Clone)]
pub struct Settings {
    shading: ShadingConfig,
    incident_gradient: bool,
}

impl Settings {
    fn new(model: &Model, roughness: Option<f32>, incident_offset: f32) -> Self {
        let c: &Config = &model.config;
        let s = &c.shading;
        let shading = ShadingConfig {
            brdf: BrdfModel {
                masking: match s.masking {
                    MaskingVariant::SchlickRoughness => Masking::SchlickRoughness,
                    MaskingVariant::SmithSeparable => Masking::SmithSeparable,
                    MaskingVariant::SmithCorrelated => Masking::SmithCorrelated,
                    MaskingVariant::SchlickHalfAlpha => Masking::SchlickHalfAlpha,
                },
                fresnel: match s.fresnel {
                    FresnelVariant::Schlick => Fresnel::Schlick,
                    FresnelVariant::SphericalGaussian => Fresnel::SphericalGaussian,
                },
                diffuse: match s.diffuse {
                    DiffuseVariant::Lambert => Diffuse::Lambert,
                    DiffuseVariant::FresnelWeighted => Diffuse::FresnelWeighted,
                },
            },
            incident: match s.incident {
                IncidentVariant::Learned => IncidentModel::Learned,
                _ => IncidentModel::Physical(model.scene.falloff(c)),
            },
            combine: match s.combine {
                CombineVariant::Lerp => Combine::Lerp,
                CombineVariant::Additive => Combine::Additive,
            },
            normalise: s.normalise,
            visibility: if s.surface_visibility { SurfaceVisibility::Multiplied } else { SurfaceVisibility::Ignored },
            horizon_leak: s.horizon_leak,
            roughness,
            use_residual: c.residual.network || c.residual.transfer_degree.is_some(),
            incident_offset,
            scale_residual_by_light: c.residual.scale_by_light,
        };
        Self { shading, incident_gradient: c.residual.incident_gradient }
    }

    /// For a training step.
    pub fn training(model: &Model, plan: &StepPlan) -> Self {
        Self::new(model, plan.roughness_frozen.then_some(FROZEN_ROUGHNESS), plan.incident_offset)
    }

    /// For rendering a finished model.
    pub fn rendering(model: &Model) -> Self {
        Self::new(model, None, 0.0)
    }
}

/// Roughness until the unfreeze.
const FROZEN_ROUGHNESS: f32 = 0.5;
