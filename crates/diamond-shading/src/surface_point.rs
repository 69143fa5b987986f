//! Shading one pixel: from the features of a surface point to its radiance, and back.
//!
//! The light-independent half is [`SurfacePoint`]; what the light and the light's own features add is
//! [`SurfacePoint::light`]. The deferred shader maps both over the pixels of a view.
use crate::brdf::CosineFloor;
use crate::brdf::Facing;
use crate::deferred::{Combine, IncidentModel, ShadingConfig, SurfaceVisibility};
use crate::gbuffer::channel;
use crate::incidence::Arriving;
use crate::material::Surface;
use crate::number::Number;
use crate::vector::Vector;
use diamond_camera::Camera;
use diamond_light::{Falloff, OlatLight};
use glam::{Mat3, Vec3};

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

/// Components below this are not divided by, where a blended normal's length is taken: it has no direction then.
const MIN_NORMAL_COMPONENT: f32 = 0.5 * MIN_NORMAL_LENGTH;

/// The camera as pixels see it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Eye {
    focal: (f32, f32),
    principal: (f32, f32),
    to_camera: Mat3,
    to_world: Mat3,
    translation: Vec3,
}

impl Eye {
    pub fn new(camera: &Camera) -> Self {
        let (k, pose) = (&camera.intrinsics, &camera.pose);
        Self {
            focal: (k.fx, k.fy),
            principal: (k.cx, k.cy),
            to_camera: pose.rotation,
            to_world: pose.rotation.transpose(),
            translation: pose.translation,
        }
    }

    /// Direction through a pixel in camera axes, z = 1.
    #[inline(always)]
    fn through<T: Number>(&self, (x, y): (T, T)) -> Vector<T> {
        let ((fx, fy), (cx, cy)) = (self.focal, self.principal);
        Vector::new((x - cx) / fx, (y - cy) / fy, x.same(1.0))
    }
}

/// A visible point of the surface, without a light; of one pixel or many.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SurfacePoint<T> {
    /// Material as shaded: with the roughness of the configuration where it has one.
    pub material: Surface<T>,
    /// Share of the subsurface residual.
    pub subsurfaceness: T,
    /// Unit normal, world axes.
    pub normal: Vector<T>,
    /// Unit direction to the camera.
    view: Vector<T>,
    /// World position, scene units.
    position: Vector<T>,
    /// View-space z, scene units.
    pub depth: T,
}

/// What the pullback of [`SurfacePoint::new`] needs beside the point.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Seen<T> {
    /// Length of the blended normal; 0 where it has no direction.
    normal_length: T,
    /// Direction through the pixel, camera axes, z = 1.
    through: Vector<T>,
}

/// Numbers of a [`SurfacePoint`].
pub(crate) const POINT: usize = 16;

/// The features of a surface point that depend on the light.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Transport<T> {
    /// Subsurface residual, linear RGB.
    pub residual: Vector<T>,
    /// Learned incident light.
    pub incident: T,
    /// Visibility of the light.
    pub visibility: T,
}

/// The two parts of a point's radiance, weighted by subsurfaceness.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Lit<T> {
    /// From the surface.
    pub surface: Vector<T>,
    /// From below it.
    pub subsurface: Vector<T>,
}

/// Cotangents of a surface point as far as they do not come from its light: those of the maps.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PointGrad<T> {
    pub base_color: Vector<T>,
    pub roughness: T,
    pub metalness: T,
    pub subsurfaceness: T,
    pub normal: Vector<T>,
    pub residual: Vector<T>,
    pub incident: T,
    pub visibility: T,
    pub depth: T,
}

impl<T: Number> Transport<T> {
    /// From the light-dependent channels.
    #[inline(always)]
    pub fn new(features: [T; TRANSPORT]) -> Self {
        let [r, g, b, incident, visibility] = features;
        Self { residual: Vector::new(r, g, b), incident, visibility }
    }
}

/// How the two parts are weighted by subsurfaceness: `(surface, residual)` and their derivatives.
#[inline(always)]
fn combine_weights<T: Number>(config: &ShadingConfig, s: T) -> ((T, T), (f32, f32)) {
    let one = s.same(1.0);
    match (config.use_residual, config.combine) {
        (false, _) => ((one, s.same(0.0)), (0.0, 0.0)),
        (true, Combine::Lerp) => ((s.complement(), s), (-1.0, 1.0)),
        (true, Combine::Additive) => ((one, s), (0.0, 1.0)),
    }
}

/// The falloff that a light's irradiance follows, and the factor of the learned incident light on it.
#[inline(always)]
fn incident_model<T: Number>(config: &ShadingConfig, incident: T) -> (Falloff, T) {
    match config.incident {
        IncidentModel::Learned => (Falloff::None, incident + config.incident_offset),
        IncidentModel::Physical(falloff) => (falloff, incident.same(1.0)),
    }
}

impl ShadingConfig {
    #[inline(always)]
    fn cosine_floor(&self) -> CosineFloor {
        CosineFloor { view: MIN_COS_THETA_O, light: self.horizon_leak }
    }

    #[inline(always)]
    fn residual_scale<T: Number>(&self, light: &OlatLight, like: T) -> Vector<T> {
        Vector::same(like, if self.scale_residual_by_light { light.intensity() } else { Vec3::ONE })
    }

    #[inline(always)]
    fn surface_visibility<T: Number>(&self, visibility: T) -> T {
        match self.visibility {
            SurfaceVisibility::Multiplied => visibility,
            SurfaceVisibility::Ignored => visibility.same(1.0),
        }
    }
}

impl<T: Number> SurfacePoint<T> {
    /// From the light-independent channels of a pixel, divided by its opacity.
    /// `[eq:surface-point]`
    #[inline(always)]
    pub fn new(features: [T; GEOMETRY], depth: T, pixel: (T, T), eye: &Eye, config: &ShadingConfig) -> (Self, Seen<T>) {
        let [r, g, b, roughness, metalness, subsurfaceness, x, y, z] = features;
        let through = eye.through(pixel);
        let ray = through.rotated(&eye.to_world);
        let view = ray / -ray.dot(ray).root();
        let position = (through * depth - Vector::same(depth, eye.translation)).rotated(&eye.to_world);

        // The largest component is divided out first, so that no square leaves the range of f32.
        let largest = x.magnitude().larger(y.magnitude()).larger(z.magnitude());
        let blended = Vector::new(x, y, z) / largest.at_least(MIN_NORMAL_COMPONENT);
        let part = blended.dot(blended).root();
        let length = part * largest.at_least(MIN_NORMAL_COMPONENT);
        let directed = length.reaches(MIN_NORMAL_LENGTH) & length.under(f32::INFINITY);
        let normal = (blended / part.or_where_not(directed, part.same(1.0))).or_where_not(directed, view);

        let roughness = match config.roughness {
            Some(constant) => roughness.same(constant),
            None => roughness,
        };
        let material = Surface { base_color: Vector::new(r, g, b), roughness, metalness };
        let seen = Seen { normal_length: length.only_where(directed), through };
        (Self { material, subsurfaceness, normal, view, position, depth }, seen)
    }

    /// All numbers, to be kept.
    #[inline(always)]
    pub fn numbers(&self) -> [T; POINT] {
        let (m, n, v, p) = (&self.material, self.normal, self.view, self.position);
        let c = m.base_color;
        let s = self.subsurfaceness;
        [c.x, c.y, c.z, m.roughness, m.metalness, s, n.x, n.y, n.z, v.x, v.y, v.z, p.x, p.y, p.z, self.depth]
    }

    /// The inverse of [`SurfacePoint::numbers`].
    #[inline(always)]
    pub fn of_numbers(k: [T; POINT]) -> Self {
        Self {
            material: Surface { base_color: Vector::new(k[0], k[1], k[2]), roughness: k[3], metalness: k[4] },
            subsurfaceness: k[5],
            normal: Vector::new(k[6], k[7], k[8]),
            view: Vector::new(k[9], k[10], k[11]),
            position: Vector::new(k[12], k[13], k[14]),
            depth: k[15],
        }
    }

    /// Pullback of [`SurfacePoint::new`], given that of the position.
    /// `[eq:surface-point]`
    #[inline(always)]
    fn pull(
        &self,
        seen: &Seen<T>,
        d: &PointGrad<T>,
        d_position: Vector<T>,
        eye: &Eye,
        config: &ShadingConfig,
    ) -> ([T; GEOMETRY], T) {
        let d_z = d_position.rotated(&eye.to_camera).dot(seen.through);
        let directed = seen.normal_length.reaches(MIN_NORMAL_LENGTH);
        let length = seen.normal_length.or_where_not(directed, d_z.same(1.0));
        let d_normal = ((d.normal - self.normal * self.normal.dot(d.normal)) / length).only_where(directed);
        let d_roughness = if config.roughness.is_some() { d.roughness.same(0.0) } else { d.roughness };
        let [r, g, b] = d.base_color.array();
        let [x, y, z] = d_normal.array();
        ([r, g, b, d_roughness, d.metalness, d.subsurfaceness, x, y, z], d.depth + d_z)
    }

    #[inline(always)]
    fn facing(&self, light: Vector<T>) -> Facing<T> {
        Facing { normal: self.normal, view: self.view, light }
    }

    /// The radiance toward the camera under one light, before it is multiplied by the opacity.
    /// `[eq:deferred-incident]` `[eq:deferred-combine]`
    #[inline(always)]
    pub fn light(&self, transport: &Transport<T>, light: &OlatLight, config: &ShadingConfig) -> Lit<T> {
        let (falloff, factor) = incident_model(config, transport.incident);
        let arriving = Arriving::new(light, falloff, self.position);
        let (facing, irradiance) = (self.facing(arriving.direction), arriving.irradiance * factor);
        let reflected = config.brdf.reflect_of(config.cosine_floor(), &self.material, &facing, irradiance);
        self.combine(transport, light, config, reflected)
    }

    /// Both parts, given what the surface reflects.
    #[inline(always)]
    fn combine(
        &self,
        transport: &Transport<T>,
        light: &OlatLight,
        config: &ShadingConfig,
        reflected: Vector<T>,
    ) -> Lit<T> {
        let (weights, _) = combine_weights(config, self.subsurfaceness);
        let surface = reflected * config.surface_visibility(transport.visibility);
        let residual = transport.residual * config.residual_scale(light, weights.0);
        Lit { surface: surface * weights.0, subsurface: residual * weights.1 }
    }

    /// Pullback of [`SurfacePoint::new`] after [`SurfacePoint::light`]: what was lit, then the cotangents of the
    /// light-independent and the light-dependent channels and of the depth, for the cotangent `d_radiance` of the sum of both
    /// parts and the cotangents `maps` that come from elsewhere.
    /// `[eq:deferred-incident]` `[eq:deferred-combine]`
    #[inline(always)]
    pub fn light_pull(
        &self,
        seen: &Seen<T>,
        transport: &Transport<T>,
        (light, eye, config): (&OlatLight, &Eye, &ShadingConfig),
        d_radiance: Vector<T>,
        maps: PointGrad<T>,
    ) -> (Lit<T>, [T; GEOMETRY], [T; TRANSPORT], T) {
        let mut d = maps;
        let (falloff, factor) = incident_model(config, transport.incident);
        let arriving = Arriving::new(light, falloff, self.position);
        let (facing, irradiance) = (self.facing(arriving.direction), arriving.irradiance * factor);
        let (weights, slopes) = combine_weights(config, self.subsurfaceness);
        let visibility = config.surface_visibility(transport.visibility);
        let d_surface = d_radiance * weights.0;

        // Surface.
        let (reflected, g) = config.brdf.reflect_pull_of(
            config.cosine_floor(),
            &self.material,
            &facing,
            irradiance,
            d_surface * visibility,
        );
        d.base_color = d.base_color + g.material.base_color;
        d.roughness = d.roughness + g.material.roughness;
        d.metalness = d.metalness + g.material.metalness;
        d.normal = d.normal + g.directions.normal;

        // Combination.
        let scale = config.residual_scale(light, visibility);
        d.residual = d.residual + d_radiance * weights.1 * scale;
        let (by_surface, by_residual) = (visibility.same(slopes.0), visibility.same(slopes.1));
        let by_subsurfaceness = reflected * (visibility * by_surface) + transport.residual * scale * by_residual;
        d.subsurfaceness = d.subsurfaceness + d_radiance.dot(by_subsurfaceness);
        if config.visibility == SurfaceVisibility::Multiplied {
            d.visibility = d.visibility + d_surface.dot(reflected);
        }

        // Light. The direction to the camera is the pixel's ray whatever the depth: that of the view goes nowhere.
        if config.incident == IncidentModel::Learned {
            d.incident = d.incident + g.irradiance.dot(arriving.irradiance);
        }
        let d_position = arriving.pull(light, falloff, g.directions.light, g.irradiance * factor);

        let (geometry, d_depth) = self.pull(seen, &d, d_position, eye, config);
        let [r, g, b] = d.residual.array();
        let lit = self.combine(transport, light, config, reflected);
        (lit, geometry, [r, g, b, d.incident, d.visibility], d_depth)
    }
}
