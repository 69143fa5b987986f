//! Deferred shading on a device: what `diamond_shading::shade` and its pullback do, a thread per pixel.
use crate::frame::Frame;
use crate::job::{Job, words};
use crate::kernels::Module;
use crate::{Device, GpuError};
use bytemuck::{Pod, Zeroable};
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::{Falloff, OlatLight};
use diamond_shading::{
    Combine, Diffuse, Fresnel, GBuffer, GBufferGrad, IncidentModel, Masking, Shaded, ShadedGrad, ShadedMaps,
    ShadingConfig, SurfaceVisibility, channel,
};
use diamond_splat::RasterConfig;

/// `Lighting` of `shading.wgsl`: a light and the choices of shading.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct Lighting {
    /// Of a point light its position, of a directional one its direction.
    pub place: [f32; 3],
    /// 1: directional.
    pub directional: u32,
    /// Intensity or irradiance, linear RGB.
    pub intensity: [f32; 3],
    /// Reference distance of the inverse square, scene units; 0: no falloff.
    pub reference: f32,
    /// Number of the [`Masking`].
    pub masking: u32,
    /// Number of the [`Fresnel`].
    pub fresnel: u32,
    /// Number of the [`Diffuse`].
    pub diffuse: u32,
    /// 1: [`Combine::Additive`].
    pub additive: u32,
    /// 1: [`IncidentModel::Learned`].
    pub learned_incident: u32,
    /// [`ShadingConfig::normalise`]
    pub normalise: u32,
    /// 1: [`SurfaceVisibility::Multiplied`].
    pub surface_visibility: u32,
    /// [`ShadingConfig::use_residual`]
    pub use_residual: u32,
    /// [`ShadingConfig::scale_residual_by_light`]
    pub scale_residual: u32,
    /// 1: `roughness` instead of the channel.
    pub fixed_roughness: u32,
    /// [`ShadingConfig::roughness`]
    pub roughness: f32,
    /// [`ShadingConfig::horizon_leak`]
    pub horizon_leak: f32,
    /// [`ShadingConfig::incident_offset`]
    pub incident_offset: f32,
    /// Padding.
    pub unused_0: f32,
    /// Padding.
    pub unused_1: f32,
    /// Padding.
    pub unused_2: f32,
}

impl Lighting {
    /// As numbers.
    pub fn new(light: &OlatLight, config: &ShadingConfig) -> Self {
        let (place, intensity, directional) = match *light {
            OlatLight::Point { position, intensity } => (position, intensity, 0),
            OlatLight::Directional { direction, irradiance } => (direction, irradiance, 1),
        };
        let reference = match config.incident {
            IncidentModel::Physical(Falloff::InverseSquare { reference }) => reference,
            _ => 0.0,
        };
        Self {
            place: place.to_array(),
            directional,
            intensity: intensity.to_array(),
            reference,
            masking: match config.brdf.masking {
                Masking::SmithSeparable => 0,
                Masking::SmithCorrelated => 1,
                Masking::SchlickRoughness => 2,
                Masking::SchlickHalfAlpha => 3,
            },
            fresnel: (config.brdf.fresnel == Fresnel::SphericalGaussian).into(),
            diffuse: match config.brdf.diffuse {
                Diffuse::Lambert => 0,
                Diffuse::FresnelWeighted => 1,
                Diffuse::Omitted => 2,
            },
            additive: (config.combine == Combine::Additive).into(),
            learned_incident: (config.incident == IncidentModel::Learned).into(),
            normalise: config.normalise.into(),
            surface_visibility: (config.visibility == SurfaceVisibility::Multiplied).into(),
            use_residual: config.use_residual.into(),
            scale_residual: config.scale_residual_by_light.into(),
            fixed_roughness: config.roughness.is_some().into(),
            roughness: config.roughness.unwrap_or(0.0),
            horizon_leak: config.horizon_leak,
            incident_offset: config.incident_offset,
            unused_0: 0.0,
            unused_1: 0.0,
            unused_2: 0.0,
        }
    }
}

/// Numbers of a pixel's record, of its cotangent with padding, and of its channels with padding.
const RECORD: usize = 24;
const COTANGENT: usize = 20;
const CHANNELS: usize = 16;

/// The G-buffer's arrays on the device: light, channels, coverage.
fn upload<'d>(
    device: &'d Device,
    gbuffer: &GBuffer<'_>,
    camera: &Camera,
    light: &OlatLight,
    config: &ShadingConfig,
) -> Result<(Job<'d>, [crate::job::Array; 3]), GpuError> {
    // The CPU checks shapes and settings, on one pixel where the picture itself need not be shaded.
    check(gbuffer, camera, light, config)?;
    let mut job = Job::new(device, &Frame::new(camera, &RasterConfig::default(), 0, false, 0))?;
    let lighting = Lighting::new(light, config);
    let lighting = job.input("light", bytemuck::cast_slice(bytemuck::bytes_of(&lighting)))?;
    let mut channels = vec![0.0f32; gbuffer.opacity.pixels() * CHANNELS];
    for (to, from) in channels.chunks_exact_mut(CHANNELS).zip(gbuffer.features.data().chunks_exact(channel::COUNT)) {
        to[..channel::COUNT].copy_from_slice(from);
    }
    let picture = job.input("channels", words(&channels))?;
    let coverage: Vec<f32> =
        gbuffer.opacity.data().iter().zip(gbuffer.depth.data()).flat_map(|(o, d)| [*o, *d, 0.0, 0.0]).collect();
    let coverage = job.input("coverage", words(&coverage))?;
    Ok((job, [lighting, picture, coverage]))
}

fn check(gbuffer: &GBuffer<'_>, camera: &Camera, light: &OlatLight, config: &ShadingConfig) -> Result<(), GpuError> {
    let mut pixel = *camera;
    (pixel.intrinsics.width, pixel.intrinsics.height) = (1, 1);
    let (features, one) = (Image::new(1, 1, channel::COUNT), Image::new(1, 1, 1));
    let (shaded, _) =
        diamond_shading::shade(&GBuffer { features: &features, opacity: &one, depth: &one }, &pixel, light, config)?;
    debug_assert_eq!(shaded.radiance.pixels(), 1);
    let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
    for (what, image, channels) in [
        ("GBuffer::features", gbuffer.features, channel::COUNT),
        ("GBuffer::opacity", gbuffer.opacity, 1),
        ("GBuffer::depth", gbuffer.depth, 1),
    ] {
        shape(what, image, (width, height, channels))?;
    }
    Ok(())
}

fn shape(what: &'static str, image: &Image, expected: (usize, usize, usize)) -> Result<(), GpuError> {
    if image.shape() == expected {
        return Ok(());
    }
    let (expected, found) = (format!("{expected:?}"), format!("{:?}", image.shape()));
    Err(diamond_splat::SplatError::Shape { what, expected, found }.into())
}

/// Shades one view under one light, as [`diamond_shading::shade`] does `[eq:deferred-composite]`.
///
/// # Errors
/// What the CPU refuses; arrays beyond the device's limits or memory; a lost device.
pub fn shade(
    device: &Device,
    gbuffer: &GBuffer<'_>,
    camera: &Camera,
    light: &OlatLight,
    config: &ShadingConfig,
) -> Result<Shaded, GpuError> {
    let (mut job, [lighting, picture, coverage]) = upload(device, gbuffer, camera, light, config)?;
    let pixels = gbuffer.opacity.pixels();
    let record = job.zeros("shaded picture", (pixels * RECORD) as u64)?;
    job.over(Module::Shade, "shade", &[lighting, picture, coverage, record], pixels as u64)?;
    let data = job.finish(&[(record, (pixels * RECORD) as u64)])?.swap_remove(0);
    let (width, height, _) = gbuffer.opacity.shape();
    let all = Image::from_vec(width, height, RECORD, data)
        .map_err(|e| GpuError::Kernel { kernel: "shade".into(), problem: e.to_string() })?;
    let part = |range: std::ops::Range<usize>| all.channels_range(range);
    Ok(Shaded {
        radiance: part(0..3),
        surface: part(3..6),
        subsurface: part(6..9),
        maps: ShadedMaps {
            base_color: part(9..12),
            roughness: part(12..13),
            metalness: part(13..14),
            subsurfaceness: part(14..15),
            normal: part(15..18),
            residual: part(18..21),
            incident: part(21..22),
            visibility: part(22..23),
            depth: part(23..24),
        },
    })
}

/// The reverse of [`shade`] `[eq:deferred-composite]`: cotangents of the shaded view for those of the G-buffer.
///
/// # Errors
/// As [`shade`]; cotangents of another shape than what they belong to.
pub fn shade_pull(
    device: &Device,
    gbuffer: &GBuffer<'_>,
    camera: &Camera,
    light: &OlatLight,
    config: &ShadingConfig,
    d: &ShadedGrad,
) -> Result<GBufferGrad, GpuError> {
    let (mut job, [lighting, picture, coverage]) = upload(device, gbuffer, camera, light, config)?;
    let (width, height, _) = gbuffer.opacity.shape();
    let pixels = gbuffer.opacity.pixels();
    let m = &d.maps;
    let mut record = vec![0.0f32; pixels * COTANGENT];
    let mut first = 0;
    for (what, image, channels) in [
        ("ShadedGrad::radiance", &d.radiance, 3),
        ("ShadedMapsGrad::base_color", &m.base_color, 3),
        ("ShadedMapsGrad::roughness", &m.roughness, 1),
        ("ShadedMapsGrad::metalness", &m.metalness, 1),
        ("ShadedMapsGrad::subsurfaceness", &m.subsurfaceness, 1),
        ("ShadedMapsGrad::normal", &m.normal, 3),
        ("ShadedMapsGrad::residual", &m.residual, 3),
        ("ShadedMapsGrad::incident", &m.incident, 1),
        ("ShadedMapsGrad::visibility", &m.visibility, 1),
        ("ShadedMapsGrad::depth", &m.depth, 1),
    ] {
        if let Some(image) = image {
            shape(what, image, (width, height, channels))?;
            for (to, from) in record.chunks_exact_mut(COTANGENT).zip(image.data().chunks_exact(channels)) {
                to[first..first + channels].copy_from_slice(from);
            }
        }
        first += channels;
    }
    let record = job.input("gradient of the shaded picture", words(&record))?;
    let d_picture = job.zeros("gradient of the channels", (pixels * CHANNELS) as u64)?;
    let d_coverage = job.zeros("gradient of the coverage", (2 * pixels) as u64)?;
    let arrays = [lighting, picture, coverage, record, d_picture, d_coverage];
    job.over(Module::ShadePull, "shade_pull", &arrays, pixels as u64)?;
    let read = job.finish(&[(d_picture, (pixels * CHANNELS) as u64), (d_coverage, (2 * pixels) as u64)])?;
    let mut out = GBufferGrad {
        features: Image::new(width, height, channel::COUNT),
        opacity: Image::new(width, height, 1),
        depth: Image::new(width, height, 1),
    };
    for (to, from) in out.features.data_mut().chunks_exact_mut(channel::COUNT).zip(read[0].chunks_exact(CHANNELS)) {
        to.copy_from_slice(&from[..channel::COUNT]);
    }
    let both = out.opacity.data_mut().iter_mut().zip(out.depth.data_mut());
    for ((opacity, depth), from) in both.zip(read[1].chunks_exact(2)) {
        (*opacity, *depth) = (from[0], from[1]);
    }
    Ok(out)
}
