//! Shading one pixel: from the features of a surface point to its radiance, and back.
//!
//! The light-independent half is [`SurfacePoint`]; what the light and the light's own features add is
//! [`SurfacePoint::light`]. The deferred shader maps both over the pixels of a view.
use crate::brdf::CosineFloor;
use crate::deferred::{Combine, IncidentModel, ShadingConfig, SurfaceVisibility};
use crate::gbuffer::channel;
use crate::material::Material;
use diamond_camera::{Camera, Depth};
use diamond_light::{Falloff, IncidenceGrad, OlatLight};
use glam::{Vec2, Vec3};

/// n·v is taken for at least this in deferred shading. A blended normal may face away from the camera that sees it; the
/// physical answer, black without a gradient, would leave it so forever. At the floor the surface is still lit, by the
/// remaining angles, and turns with n·l and the half vector.
pub const MIN_COS_THETA_O: f32 = 1e-4;

/// A blended normal shorter than this has no direction (opposite normals cancelled): the view direction stands in for it,
/// without a gradient.
pub const MIN_NORMAL_LENGTH: f32 = 1e-6;

/// Number of light-independent channels.
pub(crate) const GEOMETRY: usize = channel::GEOMETRY.end - channel::GEOMETRY.start;
/// Number of light-dependent channels.
pub(crate) const TRANSPORT: usize = channel::TRANSPORT.end - channel::TRANSPORT.start;

/// A visible point of the surface, without a light.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SurfacePoint {
    /// Material as shaded: with the roughness of the configuration where it has one.
    pub material: Material,
    /// Share of the subsurface residual.
    pub subsurfaceness: f32,
    /// Unit normal, world axes.
    pub normal: Vec3,
    /// Length of the blended normal; 0 where it has no direction.
    normal_length: f32,
    /// Unit direction to the camera.
    view: Vec3,
    /// World position, scene units.
    position: Vec3,
    /// Where it is seen, pixels.
    pixel: Vec2,
    /// View-space z, scene units.
    pub depth: f32,
}

/// The features of a surface point that depend on the light.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Transport {
    /// Subsurface residual, linear RGB.
    pub residual: Vec3,
    /// Learned incident light.
    pub incident: f32,
    /// Visibility of the light.
    pub visibility: f32,
}

/// The two parts of a point's radiance, weighted by subsurfaceness.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Lit {
    /// From the surface.
    pub surface: Vec3,
    /// From below it.
    pub subsurface: Vec3,
}

/// Cotangents of a surface point as far as they do not come from its light: those of the maps.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct PointGrad {
    pub base_color: Vec3,
    pub roughness: f32,
    pub metalness: f32,
    pub subsurfaceness: f32,
    pub normal: Vec3,
    pub residual: Vec3,
    pub incident: f32,
    pub visibility: f32,
    pub depth: f32,
}

impl Transport {
    /// From the light-dependent channels.
    pub fn new(features: &[f32; TRANSPORT]) -> Self {
        let [r, g, b, incident, visibility] = *features;
        Self { residual: Vec3::new(r, g, b), incident, visibility }
    }
}

/// How the two parts are weighted by subsurfaceness: `(surface, residual)` and their derivatives.
fn combine_weights(config: &ShadingConfig, s: f32) -> ((f32, f32), (f32, f32)) {
    match (config.use_residual, config.combine) {
        (false, _) => ((1.0, 0.0), (0.0, 0.0)),
        (true, Combine::Lerp) => ((1.0 - s, s), (-1.0, 1.0)),
        (true, Combine::Additive) => ((1.0, s), (0.0, 1.0)),
    }
}

/// The falloff that a light's irradiance follows, and the factor of the learned incident light on it.
fn incident_model(config: &ShadingConfig, incident: f32) -> (Falloff, f32) {
    match config.incident {
        IncidentModel::Learned => (Falloff::None, incident + config.incident_offset),
        IncidentModel::Physical(falloff) => (falloff, 1.0),
    }
}

impl ShadingConfig {
    fn cosine_floor(&self) -> CosineFloor {
        CosineFloor { view: MIN_COS_THETA_O, light: self.horizon_leak }
    }

    fn residual_scale(&self, light: &OlatLight) -> Vec3 {
        if self.scale_residual_by_light { light.intensity() } else { Vec3::ONE }
    }
}

impl SurfacePoint {
    /// From the light-independent channels of a pixel, divided by its opacity.
    /// `[eq:surface-point]`
    pub fn new(features: &[f32; GEOMETRY], depth: f32, pixel: Vec2, camera: &Camera, config: &ShadingConfig) -> Self {
        let view = -camera.ray(pixel).direction;
        let [r, g, b, roughness, metalness, subsurfaceness, x, y, z] = *features;
        let blended = Vec3::new(x, y, z);
        // In f64, whose range holds the square of any f32.
        let length = blended.as_dvec3().length() as f32;
        let has_direction = length >= MIN_NORMAL_LENGTH && length.is_finite();
        let (normal, normal_length) = if has_direction { (blended / length, length) } else { (view, 0.0) };
        let roughness = config.roughness.unwrap_or(roughness);
        Self {
            material: Material { base_color: Vec3::new(r, g, b), roughness, metalness },
            subsurfaceness,
            normal,
            normal_length,
            view,
            position: camera.unproject(pixel, Depth::Z(depth)),
            pixel,
            depth,
        }
    }

    /// Pullback of [`SurfacePoint::new`], given that of the position.
    /// `[eq:surface-point]`
    fn pull(&self, d: &PointGrad, d_position: Vec3, camera: &Camera, config: &ShadingConfig) -> ([f32; GEOMETRY], f32) {
        let (_, d_z) = camera.unproject_pull(self.pixel, Depth::Z(self.depth), d_position);
        let d_normal = if self.normal_length > 0.0 {
            (d.normal - self.normal * self.normal.dot(d.normal)) / self.normal_length
        } else {
            Vec3::ZERO
        };
        let d_roughness = if config.roughness.is_some() { 0.0 } else { d.roughness };
        let [r, g, b] = d.base_color.to_array();
        let [x, y, z] = d_normal.to_array();
        ([r, g, b, d_roughness, d.metalness, d.subsurfaceness, x, y, z], d.depth + d_z)
    }

    /// The radiance toward the camera under one light, before it is multiplied by the opacity.
    /// `[eq:deferred-incident]` `[eq:deferred-combine]`
    pub fn light(&self, transport: &Transport, light: &OlatLight, config: &ShadingConfig) -> Lit {
        let (falloff, factor) = incident_model(config, transport.incident);
        let incidence = light.incidence(self.position, falloff);
        let mut surface = config.brdf.reflect_above(
            config.cosine_floor(),
            &self.material,
            self.normal,
            self.view,
            incidence.direction,
            incidence.irradiance * factor,
        );
        if config.visibility == SurfaceVisibility::Multiplied {
            surface *= transport.visibility;
        }
        let ((surface_weight, residual_weight), _) = combine_weights(config, self.subsurfaceness);
        let residual = transport.residual * config.residual_scale(light);
        Lit { surface: surface * surface_weight, subsurface: residual * residual_weight }
    }

    /// Pullback of [`SurfacePoint::new`] after [`SurfacePoint::light`]: the cotangents of the light-independent and the
    /// light-dependent channels and of the depth, for the cotangent `d_radiance` of the sum of both parts and the cotangents `maps`
    /// that come from elsewhere.
    /// `[eq:deferred-incident]` `[eq:deferred-combine]`
    pub fn light_pull(
        &self,
        transport: &Transport,
        light: &OlatLight,
        camera: &Camera,
        config: &ShadingConfig,
        d_radiance: Vec3,
        maps: PointGrad,
    ) -> ([f32; GEOMETRY], [f32; TRANSPORT], f32) {
        let mut d = maps;
        let (falloff, factor) = incident_model(config, transport.incident);
        let incidence = light.incidence(self.position, falloff);
        let irradiance = incidence.irradiance * factor;
        let floor = config.cosine_floor();
        let (m, n, v, l) = (&self.material, self.normal, self.view, incidence.direction);
        let reflected = config.brdf.reflect_above(floor, m, n, v, l, irradiance);
        let (weights, slopes) = combine_weights(config, self.subsurfaceness);
        let visibility = match config.visibility {
            SurfaceVisibility::Multiplied => transport.visibility,
            SurfaceVisibility::Ignored => 1.0,
        };

        // Combination.
        let scale = config.residual_scale(light);
        d.residual += d_radiance * weights.1 * scale;
        let by_subsurfaceness = reflected * visibility * slopes.0 + transport.residual * scale * slopes.1;
        d.subsurfaceness += d_radiance.dot(by_subsurfaceness);
        let d_surface = d_radiance * weights.0;
        if config.visibility == SurfaceVisibility::Multiplied {
            d.visibility += d_surface.dot(reflected);
        }

        // Surface.
        let g = config.brdf.reflect_above_pull(floor, m, n, v, l, irradiance, d_surface * visibility);
        d.base_color += g.material.base_color;
        d.roughness += g.material.roughness;
        d.metalness += g.material.metalness;
        d.normal += g.normal;

        // Light. The direction to the camera is the pixel's ray whatever the depth: g.view goes nowhere.
        if config.incident == IncidentModel::Learned {
            d.incident += g.irradiance.dot(incidence.irradiance);
        }
        let d_incidence = IncidenceGrad { direction: g.light, distance: 0.0, irradiance: g.irradiance * factor };
        let d_position = light.incidence_pull(self.position, falloff, &d_incidence).d_at;

        let (geometry, d_depth) = self.pull(&d, d_position, camera, config);
        let [r, g, b] = d.residual.to_array();
        (geometry, [r, g, b, d.incident, d.visibility], d_depth)
    }
}
