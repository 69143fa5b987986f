//! What every kernel knows of a picture, and how a Gaussian looks on the screen: the structs that Rust and WGSL share.
use bytemuck::{Pod, Zeroable};
use diamond_camera::Camera;
use diamond_splat::{JACOBIAN_MARGIN, RasterConfig};

/// `Frame` of `frame.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct Frame {
    /// First row of the rotation from world to camera, then x of the translation.
    pub row_x: [f32; 4],
    /// Second row.
    pub row_y: [f32; 4],
    /// Third row.
    pub row_z: [f32; 4],
    /// Focal lengths, px.
    pub focal: [f32; 2],
    /// Principal point, px.
    pub principal: [f32; 2],
    /// Lower limits of x/z and y/z where the perspective map is linearised.
    pub tangent_low: [f32; 2],
    /// Upper limits.
    pub tangent_high: [f32; 2],
    /// Width and height, px.
    pub size: [u32; 2],
    /// Columns and rows of tiles.
    pub tiles: [u32; 2],
    /// How many Gaussians.
    pub gaussians: u32,
    /// 1 where Gaussians are given by lower factors, else 0.
    pub factors: u32,
    /// Always 0, which compilers must not know.
    pub zero: u32,
    /// Entries that there is room for.
    pub capacity: u32,
    /// [`RasterConfig::low_pass`]
    pub low_pass: f32,
    /// [`RasterConfig::min_alpha`]
    pub min_alpha: f32,
    /// [`RasterConfig::max_alpha`]
    pub max_alpha: f32,
    /// [`RasterConfig::min_transmittance`]
    pub min_transmittance: f32,
    /// [`RasterConfig::near`]
    pub near: f32,
    /// Padding.
    pub unused_0: f32,
    /// Padding.
    pub unused_1: f32,
    /// Padding.
    pub unused_2: f32,
}

impl Frame {
    /// Of a view.
    pub(crate) fn new(camera: &Camera, config: &RasterConfig, gaussians: u32, factors: bool, capacity: u32) -> Self {
        let k = &camera.intrinsics;
        let r = camera.pose.rotation.to_cols_array_2d();
        let t = camera.pose.translation.to_array();
        let row = |i: usize| [r[0][i], r[1][i], r[2][i], t[i]];
        let (focal, centre, size) = ([k.fx, k.fy], [k.cx, k.cy], [k.width, k.height]);
        let limit = |axis: usize, upper: bool| {
            let (f, c, side) = (f64::from(focal[axis]), f64::from(centre[axis]), f64::from(size[axis]));
            let margin = JACOBIAN_MARGIN * 0.5 * side / f;
            if upper { ((side - c) / f + margin) as f32 } else { (-c / f - margin) as f32 }
        };
        Self {
            row_x: row(0),
            row_y: row(1),
            row_z: row(2),
            focal,
            principal: centre,
            tangent_low: [limit(0, false), limit(1, false)],
            tangent_high: [limit(0, true), limit(1, true)],
            size,
            tiles: size.map(|side| side.div_ceil(TILE)),
            gaussians,
            factors: factors.into(),
            zero: 0,
            capacity,
            low_pass: config.low_pass,
            min_alpha: config.min_alpha,
            max_alpha: config.max_alpha,
            min_transmittance: config.min_transmittance,
            near: config.near,
            unused_0: 0.0,
            unused_1: 0.0,
            unused_2: 0.0,
        }
    }
}

/// Side of a tile, px: a workgroup has a thread per pixel.
pub const TILE: u32 = 16;

/// `Splat` of `frame.wgsl`: a Gaussian on the screen. Pairs are (high, low): their sum is the number.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct Splat {
    /// Projected mean, px: x high, x low, y high, y low.
    pub mean: [f32; 4],
    /// κ times the lower Cholesky factor of the inverse covariance, 1/px, κ² = ½ log2 e: l11 high, low, l21 high, low.
    pub chol: [f32; 4],
    /// l22 high, low; opacity (0: culled); view-space z, scene units.
    pub rest: [f32; 4],
}

/// `Coverage` of `blend.wgsl` and `blend_pull.wgsl`: what a pixel knows besides its channels.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct Coverage {
    /// Σ w.
    pub opacity: f32,
    /// Σ w z, scene units.
    pub depth: f32,
    /// Behind the last that was blended.
    pub transmittance: f32,
    /// One past the place of the last that was blended in the tile's list.
    pub reach: u32,
}

/// `GaussianGrad` of `projection_pull.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub struct GaussianGrad {
    /// Mean, opacity.
    pub mean: [f32; 4],
    /// Quaternion x, y, z, w; or xx, yx, yy, zx of the lower factor.
    pub form_a: [f32; 4],
    /// Standard deviations; or zy, zz of the lower factor.
    pub form_b: [f32; 4],
    /// Projected mean, per px, in the first two.
    pub screen: [f32; 4],
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::adam::Update;
    use crate::image_terms::ImageTerms;
    use crate::losses::Photometric;
    use crate::model_view::{ModelView, Sample};
    use crate::network::Product;
    use crate::parameter_arrays::Raw;
    use crate::step_arrays::{Limits, Reduction};
    use crate::{Lighting, Module, Sources};
    use std::mem::{offset_of, size_of};

    /// Names, offsets and size of a struct as the WGSL compiler lays it out.
    fn of_wgsl(module: Module, name: &str) -> (Vec<(String, usize)>, usize) {
        let text = Sources::default().of(module);
        let parsed = naga::front::wgsl::parse_str(&text).unwrap_or_else(|e| panic!("{}", e.emit_to_string(&text)));
        let (_, ty) =
            parsed.types.iter().find(|(_, ty)| ty.name.as_deref() == Some(name)).expect("the struct is there");
        let naga::TypeInner::Struct { members, span } = &ty.inner else {
            panic!("{name} is no struct");
        };
        let named = |m: &naga::StructMember| (m.name.clone().unwrap_or_default(), m.offset as usize);
        (members.iter().map(named).collect(), *span as usize)
    }

    macro_rules! same_layout {
        ($module:expr, $type:ident { $($field:ident),* $(,)? }) => {
            let fields = vec![$((stringify!($field).to_string(), offset_of!($type, $field))),*];
            assert_eq!(of_wgsl($module, stringify!($type)), (fields, size_of::<$type>()), "{:?}", $module);
        };
    }

    #[test]
    fn rust_and_wgsl_agree_on_every_layout() {
        for module in Module::ALL {
            same_layout!(
                module,
                Frame {
                    row_x,
                    row_y,
                    row_z,
                    focal,
                    principal,
                    tangent_low,
                    tangent_high,
                    size,
                    tiles,
                    gaussians,
                    factors,
                    zero,
                    capacity,
                    low_pass,
                    min_alpha,
                    max_alpha,
                    min_transmittance,
                    near,
                    unused_0,
                    unused_1,
                    unused_2,
                }
            );
            same_layout!(module, Splat { mean, chol, rest });
        }
        for module in [Module::Blend, Module::BlendPull] {
            same_layout!(module, Coverage { opacity, depth, transmittance, reach });
        }
        for module in [Module::Shade, Module::ShadePull] {
            same_layout!(
                module,
                Lighting {
                    place,
                    directional,
                    intensity,
                    reference,
                    masking,
                    fresnel,
                    diffuse,
                    additive,
                    learned_incident,
                    normalise,
                    surface_visibility,
                    use_residual,
                    scale_residual,
                    fixed_roughness,
                    roughness,
                    horizon_leak,
                    incident_offset,
                    unused_0,
                    unused_1,
                    unused_2,
                }
            );
        }
        same_layout!(
            Module::Photometric,
            Photometric {
                width,
                height,
                channels,
                border,
                space,
                step_ssim,
                step_l1,
                step_l2,
                stride,
                weighted,
                unused_0,
                unused_1,
            }
        );
        same_layout!(Module::Adam, Update { step, scale, width, seen });
        same_layout!(
            Module::Product,
            Product {
                m,
                n,
                k,
                part,
                a_i,
                a_k,
                b_k,
                b_j,
                a_first,
                b_first,
                c_first,
                activation,
                slope,
                bias_first,
                add,
                unused_1,
            }
        );
        for module in [Module::Activate, Module::ActivatePull] {
            same_layout!(
                module,
                Raw {
                    mean,
                    scale,
                    rotation,
                    opacity,
                    normal,
                    base_color,
                    roughness,
                    metalness,
                    subsurfaceness,
                    channels,
                    unused_0,
                    unused_1,
                }
            );
        }
        for module in Module::ALL.into_iter().filter(|module| module.files().contains(&"model_view.wgsl")) {
            same_layout!(
                module,
                ModelView {
                    eye,
                    directional,
                    centre,
                    inverse_half,
                    light,
                    light_reference,
                    channels,
                    codes,
                    harmonics,
                    network,
                    first,
                    rows,
                    width,
                    weight,
                    local,
                    whole,
                    falloff_reference,
                    tint,
                    sample_distance,
                    unused_0,
                }
            );
        }
        for module in [Module::SampledInputs, Module::SampledPull, Module::SampledScatter] {
            same_layout!(module, Sample { viewer, gaussian, light, visibility });
        }
        same_layout!(
            Module::ImageTerms,
            ImageTerms {
                masked,
                pseudo,
                mask,
                normal,
                smooth_base_color,
                smooth_metalness,
                smooth_roughness,
                smooth_subsurfaceness,
                enhancement,
                incident,
                stride,
                unused_0,
            }
        );
        same_layout!(Module::ClampScales, Limits { low, high, count, unused_0 });
        same_layout!(Module::Reduce, Reduction { count, stride, out_stride, out_first });
        for module in [Module::ActivatePull, Module::MediumPull] {
            same_layout!(module, GaussianGrad { mean, form_a, form_b, screen });
        }
        same_layout!(Module::ProjectionPull, GaussianGrad { mean, form_a, form_b, screen });
    }

    /// A field that is moved is noticed.
    #[test]
    fn another_layout_is_another_layout() {
        let (fields, size) = of_wgsl(Module::Blend, "Coverage");
        assert_eq!(size, 16);
        assert_eq!(fields[3], ("reach".to_string(), 12));
        assert_ne!(fields[2].1, offset_of!(Coverage, reach));
    }
}
