//! Deferred shading: the radiance image of one view under one light, from blended feature channels, and back.
//!
//! Every pixel's features are divided by its opacity, its depth becomes a world position, the light's direction and
//! irradiance at that position meet the normal and the material in the BRDF, the subsurface residual is blended in, and the
//! result is multiplied by the opacity, over black. [`shade`] returns the image, the maps that it was made from, and a
//! pullback to the blended channels. [`Prepared`](crate::Prepared) shades many lights of one view with the light-independent half done once.
//!
//! Radiance is linear RGB, and linear in the light's intensity but for the residual, which is so with
//! [`ShadingConfig::scale_residual_by_light`].
use crate::ShadingError;
use crate::brdf::BrdfModel;
use crate::gbuffer::{GBuffer, GBufferGrad, channel};
use crate::pixels::{INPUTS, PullRow, Scene, ShadeRow};
use crate::row_chunks::map_chunks_mut;
use crate::shaded::{RECORD, Shaded, ShadedGrad, unpack};
use crate::surface_point::Eye;
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::{Falloff, OlatLight};
use diamond_simd::Level;

/// Where the light's irradiance at a point comes from.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum IncidentModel {
    /// (incident channel + offset)·intensity: falloff and shadows are learned.
    #[default]
    Learned,
    /// The light's own irradiance; the incident channel is not used.
    Physical(Falloff),
}

/// How surface and subsurface are put together by subsurfaceness s.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Combine {
    /// (1 − s)·surface + s·residual.
    #[default]
    Lerp,
    /// surface + s·residual.
    Additive,
}

/// What the visibility channel does to the surface part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SurfaceVisibility {
    /// Nothing.
    #[default]
    Ignored,
    /// It multiplies it.
    Multiplied,
}

/// The choices of deferred shading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShadingConfig {
    /// Surface BRDF.
    pub brdf: BrdfModel,
    /// Irradiance.
    pub incident: IncidentModel,
    /// Surface and subsurface.
    pub combine: Combine,
    /// Divide features by opacity. Without, materials fade at silhouettes (SSS-3DGS). The depth is always divided.
    pub normalise: bool,
    /// Shadows of the surface part.
    pub visibility: SurfaceVisibility,
    /// Least n·l, in `[0, 1]`: 0 is black below the horizon, SSS-3DGS has 0.001.
    pub horizon_leak: f32,
    /// A constant in place of the roughness channel, which then has no gradient; also what the roughness map shows.
    pub roughness: Option<f32>,
    /// Without, the subsurface part is left out, and the surface is taken whole, as if s were 0.
    pub use_residual: bool,
    /// Added to the learned incident light (a warm-up).
    pub incident_offset: f32,
    /// Multiply the residual by the light's intensity, which makes the image linear in it.
    pub scale_residual_by_light: bool,
}

impl Default for ShadingConfig {
    fn default() -> Self {
        Self {
            brdf: BrdfModel::default(),
            incident: IncidentModel::default(),
            combine: Combine::default(),
            normalise: true,
            visibility: SurfaceVisibility::default(),
            horizon_leak: 0.0,
            roughness: None,
            use_residual: true,
            incident_offset: 0.0,
            scale_residual_by_light: false,
        }
    }
}

/// Pullback of [`shade`]; borrows what it read.
#[derive(Debug, Clone, Copy)]
pub struct ShadePullback<'a> {
    gbuffer: GBuffer<'a>,
    scene: Scene,
    level: Level,
}

impl ShadingConfig {
    /// Refuses numbers that are not finite or out of range.
    pub(crate) fn check(&self) -> Result<(), ShadingError> {
        let fail = |what, expected: &str, found: f32| {
            Err(ShadingError::Setting { what, expected: expected.into(), found: found.to_string() })
        };
        if !(0.0..=1.0).contains(&self.horizon_leak) {
            return fail("ShadingConfig::horizon_leak", "a number in [0, 1]", self.horizon_leak);
        }
        if !self.incident_offset.is_finite() {
            return fail("ShadingConfig::incident_offset", "a finite number", self.incident_offset);
        }
        match self.roughness {
            Some(roughness) if !(0.0..=1.0).contains(&roughness) => {
                fail("ShadingConfig::roughness", "a number in [0, 1]", roughness)
            }
            _ => Ok(()),
        }
    }
}

/// Shades one view under one light.
///
/// All images of `gbuffer` have the camera's size. The pullback borrows the G-buffer. Empty pixels (opacity below
/// [`MIN_OPACITY`](crate::gbuffer::MIN_OPACITY)) are zero everywhere and have no gradient.
/// `[eq:deferred-composite]`
///
/// # Errors
/// [`ShadingError::Shape`] where an image has another size than the camera or the wrong number of channels;
/// [`ShadingError::Setting`] where the configuration holds a number out of range.
pub fn shade<'a>(
    gbuffer: &GBuffer<'a>,
    camera: &Camera,
    light: &OlatLight,
    config: &ShadingConfig,
) -> Result<(Shaded, ShadePullback<'a>), ShadingError> {
    shade_at(Level::current(), gbuffer, camera, light, config)
}

/// [`shade`] on a chosen instruction set instead of the process's, to compare them.
///
/// # Errors
/// As [`shade`].
pub fn shade_at<'a>(
    level: Level,
    gbuffer: &GBuffer<'a>,
    camera: &Camera,
    light: &OlatLight,
    config: &ShadingConfig,
) -> Result<(Shaded, ShadePullback<'a>), ShadingError> {
    let (width, height) = gbuffer.check(camera, channel::COUNT)?;
    config.check()?;
    let scene = Scene { eye: Eye::new(camera), light: *light, config: *config };
    let pullback = ShadePullback { gbuffer: *gbuffer, scene, level };
    let mut records = Image::new(width, height, RECORD);
    map_chunks_mut(records.data_mut(), width * RECORD, |y, out| {
        level.dispatch(ShadeRow { gbuffer, scene: &scene, y, out });
    });
    Ok((unpack(&records), pullback))
}

impl ShadePullback<'_> {
    /// Cotangents of the blended channels, opacity and depth for those of the shaded view.
    /// `[eq:deferred-composite]`
    ///
    /// # Errors
    /// [`ShadingError::Shape`] where a cotangent does not have the shape of what it belongs to.
    pub fn pull(&self, d: &ShadedGrad) -> Result<GBufferGrad, ShadingError> {
        let (width, height, _) = self.gbuffer.opacity.shape();
        d.check(width, height)?;
        let mut grads = Image::new(width, height, INPUTS);
        let (gbuffer, scene) = (&self.gbuffer, &self.scene);
        map_chunks_mut(grads.data_mut(), width * INPUTS, |y, out| {
            self.level.dispatch(PullRow { gbuffer, scene, d, y, out });
        });
        Ok(GBufferGrad {
            features: grads.channels_range(0..channel::COUNT),
            opacity: grads.channels_range(channel::COUNT..channel::COUNT + 1),
            depth: grads.channels_range(channel::COUNT + 1..INPUTS),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::brdf::{BrdfModel, Diffuse};
    use crate::fresnel::Fresnel;
    use crate::ggx::Masking;
    use crate::pixels::{pull_pixels, shade_pixels};
    use crate::shaded::{COTANGENTS, ShadedMapsGrad};
    use diamond_camera::{Intrinsics, Pose};
    use glam::Vec3;

    const W: usize = 37;
    const H: usize = 6;

    /// Numbers in [0, 1) that look random.
    struct Draw(u32);

    impl Draw {
        fn next(&mut self) -> f32 {
            self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (self.0 >> 8) as f32 / 16_777_216.0
        }
    }

    fn camera() -> Camera {
        let intrinsics = Intrinsics { fx: 40.0, fy: 38.0, cx: 18.3, cy: 2.9, width: W as u32, height: H as u32 };
        Camera { intrinsics, pose: Pose::look_at(Vec3::new(0.3, -0.4, -3.0), Vec3::new(0.1, 0.0, 0.2), Vec3::Y) }
    }

    /// Random pixels; every other one is degenerate in some way. A stretch of a block is empty.
    fn pixels() -> Vec<[f32; INPUTS]> {
        let mut draw = Draw(7);
        let camera = camera();
        (0..W * H)
            .map(|i| {
                let (x, y) = (i % W, i / W);
                let mut f: [f32; INPUTS] = std::array::from_fn(|_| draw.next());
                for k in channel::NORMAL {
                    f[k] = 2.0 * f[k] - 1.0;
                }
                let ray = camera.ray(glam::Vec2::new(x as f32 + 0.5, y as f32 + 0.5)).direction;
                let mut normal = |n: Vec3| f[channel::NORMAL].copy_from_slice(&n.to_array());
                let (mut opacity, mut depth) = (0.05 + 0.95 * draw.next(), 2.0 + 2.0 * draw.next());
                match i % 26 {
                    1 => opacity = 0.0,
                    3 => opacity = 1e-6,
                    5 => opacity = f32::NAN,
                    7 => normal(Vec3::ZERO),
                    9 => normal(Vec3::splat(1e-7)),
                    11 => normal(ray.any_orthogonal_vector()),
                    13 => normal(ray),
                    15 => normal(Vec3::splat(1e30)),
                    17 => f[channel::ROUGHNESS] = 0.0,
                    19 => f[channel::ROUGHNESS] = 3.0,
                    21 => depth = 0.0,
                    23 => normal(-ray),
                    25 => opacity = 1e-5,
                    _ => {}
                }
                if y == 3 && x < 18 {
                    opacity = 0.0;
                }
                for k in 0..channel::COUNT {
                    f[k] *= if opacity > 1e-5 { opacity } else { 1.0 };
                }
                (f[channel::COUNT], f[channel::COUNT + 1]) = (opacity, depth * opacity.max(0.0));
                f
            })
            .collect()
    }

    fn image(channels: usize, values: impl Iterator<Item = f32>) -> Image {
        Image::from_vec(W, H, channels, values.collect()).expect("shape")
    }

    fn cotangent() -> (Vec<[f32; COTANGENTS]>, ShadedGrad) {
        let mut draw = Draw(99);
        let d: Vec<[f32; COTANGENTS]> = (0..W * H).map(|_| std::array::from_fn(|_| 2.0 * draw.next() - 1.0)).collect();
        let part =
            |range: std::ops::Range<usize>| Some(image(range.len(), d.iter().flat_map(|p| p[range.clone()].to_vec())));
        let maps = ShadedMapsGrad {
            base_color: part(3..6),
            roughness: part(6..7),
            metalness: part(7..8),
            subsurfaceness: part(8..9),
            normal: part(9..12),
            residual: part(12..15),
            incident: part(15..16),
            visibility: part(16..17),
            depth: part(17..18),
        };
        let grad = ShadedGrad { radiance: part(0..3), maps };
        (d, grad)
    }

    /// All numbers of a view, pixel by pixel in the order of its record.
    fn records(s: &Shaded) -> Vec<f32> {
        let m = &s.maps;
        let images = [
            &s.radiance,
            &s.surface,
            &s.subsurface,
            &m.base_color,
            &m.roughness,
            &m.metalness,
            &m.subsurfaceness,
            &m.normal,
            &m.residual,
            &m.incident,
            &m.visibility,
            &m.depth,
        ];
        (0..W * H).flat_map(|i| images.iter().flat_map(move |image| image.pixel(i % W, i / W).to_vec())).collect()
    }

    fn grads(g: &GBufferGrad) -> Vec<f32> {
        let images = [&g.features, &g.opacity, &g.depth];
        (0..W * H).flat_map(|i| images.iter().flat_map(move |image| image.pixel(i % W, i / W).to_vec())).collect()
    }

    /// The largest difference, relative with a floor of 1e-3 of the largest number of the same kind.
    fn worst(a: &[f32], b: &[f32], channels: usize) -> f32 {
        let mut scale = vec![1e-3f32; channels];
        b.iter().enumerate().for_each(|(i, v)| scale[i % channels] = scale[i % channels].max(v.abs() * 1e-3));
        let gap = |(i, (a, b)): (usize, (&f32, &f32))| (a - b).abs() / b.abs().max(scale[i % channels]);
        a.iter().zip(b).enumerate().map(gap).fold(0.0, f32::max)
    }

    /// Vectors of any width against single numbers, forward and backward: the same bits, but where e^x takes part, which fused
    /// instruction sets round otherwise.
    /// `[eq:deferred-composite]`
    #[test]
    fn every_instruction_set_shades_as_single_numbers_do() {
        let pixels = pixels();
        let features = image(channel::COUNT, pixels.iter().flat_map(|p| p[..channel::COUNT].to_vec()));
        let opacity = image(1, pixels.iter().map(|p| p[channel::COUNT]));
        let depth = image(1, pixels.iter().map(|p| p[channel::COUNT + 1]));
        let gbuffer = GBuffer { features: &features, opacity: &opacity, depth: &depth };
        let (d, grad) = cotangent();
        let camera = camera();
        let point = OlatLight::Point { position: Vec3::new(1.0, -1.0, -2.0), intensity: Vec3::new(1.0, 1.2, 0.8) };
        let far = OlatLight::Directional { direction: Vec3::new(0.0, -0.6, -0.8), irradiance: Vec3::ONE };
        let mut configs = Vec::new();
        for masking in
            [Masking::SmithSeparable, Masking::SmithCorrelated, Masking::SchlickRoughness, Masking::SchlickHalfAlpha]
        {
            for (i, fresnel) in [Fresnel::Schlick, Fresnel::SphericalGaussian].into_iter().enumerate() {
                let other = i == 1;
                let brdf =
                    BrdfModel { masking, fresnel, diffuse: if other { Diffuse::Lambert } else { Diffuse::default() } };
                let falloff = Falloff::InverseSquare { reference: 2.0 };
                configs.push(ShadingConfig { brdf, ..ShadingConfig::default() });
                configs.push(ShadingConfig {
                    brdf,
                    incident: IncidentModel::Physical(falloff),
                    combine: Combine::Additive,
                    normalise: other,
                    visibility: SurfaceVisibility::Multiplied,
                    horizon_leak: 0.001,
                    scale_residual_by_light: true,
                    ..ShadingConfig::default()
                });
            }
        }
        let (mut worst_of_exp, mut compared) = (0.0f32, 0);
        for config in configs {
            for light in [point, far] {
                let scene = Scene { eye: Eye::new(&camera), light, config };
                let centre = |i: usize| ((i % W) as f32 + 0.5, (i / W) as f32 + 0.5);
                let expected: Vec<f32> = (0..W * H).flat_map(|i| shade_pixels(&scene, pixels[i], centre(i))).collect();
                let expected_grads: Vec<f32> =
                    (0..W * H).flat_map(|i| pull_pixels(&scene, pixels[i], centre(i), d[i])).collect();
                assert!(expected.iter().chain(&expected_grads).all(|v| v.is_finite()), "{config:?}");
                let mut fused: Option<(Vec<f32>, Vec<f32>)> = None;
                for level in Level::testable() {
                    let (shaded, pullback) = shade_at(level, &gbuffer, &camera, &light, &config).expect("shapes");
                    let found = (records(&shaded), grads(&pullback.pull(&grad).expect("shapes")));
                    if config.brdf.fresnel == Fresnel::Schlick || !level.is_fused() {
                        assert!(found.0 == expected, "{level:?} {config:?} {:e}", worst(&found.0, &expected, RECORD));
                        let gap = worst(&found.1, &expected_grads, INPUTS);
                        assert!(found.1 == expected_grads, "{level:?} {config:?} {gap:e}");
                    } else {
                        let gap = worst(&found.0, &expected, RECORD).max(worst(&found.1, &expected_grads, INPUTS));
                        worst_of_exp = worst_of_exp.max(gap);
                        assert!(*fused.get_or_insert_with(|| found.clone()) == found, "{level:?} {config:?}");
                    }
                    compared += 1;
                }
            }
        }
        println!("{compared} comparisons; worst where e^x takes part {worst_of_exp:e}");
        assert!(worst_of_exp <= 2e-4, "{worst_of_exp:e}");
    }
}
