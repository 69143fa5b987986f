//! From raw parameters to a picture under one light, and the way back: the stages between the parameters and the
//! objective, in the order in which they run.
use crate::agreement::{self, Comparison};
use crate::cpu::Profile;
use crate::needs::StepNeeds;
use crate::objective::TermValue;
use crate::region::{NEIGHBOUR_REACH, Region, SSIM_REACH};
use crate::rows::{
    LightRows, Rows, Transported, VisibilitySource, geometry_features, input_scaling, residual_inputs, transfer_config,
};
use crate::{
    Activated, ActivatedGrad, Blender, CombineVariant, Counters, DiffuseVariant, FresnelVariant, IncidentVariant,
    MaskingVariant, MediumTerm, Model, ReconstructError, StepPlan, error,
};
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_shading::{
    BrdfModel, Combine, Diffuse, Fresnel, GBuffer, IncidentModel, InputGradients, Masking, ResidualNetworkGrad, Shaded,
    ShadedGrad, ShadingConfig, SurfaceVisibility, channel, shade, transfer_radiance,
};
use diamond_splat::{Cutoff, RasterConfig, RasterGrad, project, rasterize_projected};
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
        ..RasterConfig::default()
    }
}

/// Settings of one forward pass.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Of the shader.
    pub shading: ShadingConfig,
    incident_gradient: bool,
    normal_gradient: bool,
}

impl Settings {
    fn new(model: &Model, roughness: Option<f32>, incident_offset: f32) -> Self {
        let c = &model.config;
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
            use_residual: c.residual.network || c.residual.transfer || model.medium.is_some(),
            incident_offset,
            scale_residual_by_light: c.residual.scale_by_light,
        };
        let mut shading = shading;
        if model.medium.is_some() {
            shading.brdf.diffuse = Diffuse::Omitted;
            shading.combine = Combine::Additive;
        }
        Self { shading, incident_gradient: c.residual.incident_gradient, normal_gradient: c.residual.normal_gradient }
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

/// What the objective sees of a forward pass.
pub struct View<'a> {
    /// The shaded picture and its maps, of the region.
    pub shaded: &'a Shaded,
    /// Opacity, of the region.
    pub opacity: &'a Image,
    /// The camera of the region.
    pub camera: &'a Camera,
    /// The part of the picture that is compared; outside of it everything is empty.
    pub region: Region,
}

/// The objective's gradient.
#[derive(Default)]
pub struct ViewGrad {
    /// With respect to radiance and maps.
    pub shaded: ShadedGrad,
    /// With respect to the opacity, if any.
    pub opacity: Option<Image>,
}

/// Gradient of one pair with respect to what the parameters mean, and to the network.
pub struct PairGrad {
    /// Gradient of activated attributes.
    pub activated: ActivatedGrad,
    /// Gradient of trunk, residual head, incident head; empty without a network.
    pub network: Vec<Vec<f32>>,
    /// Gradient of each projected mean, per pixel.
    pub screen: Vec<Vec2>,
    /// Radius on screen, pixels; 0 where not seen.
    pub radii: Vec<f32>,
    /// Gaussians that could contribute.
    pub visible: usize,
    /// Terms that compare this view with another one, not yet multiplied by the share.
    pub agreement: Vec<TermValue>,
}

/// What one pair's forward and backward pass works on.
pub struct Pass<'a> {
    /// The model.
    pub model: &'a Model,
    /// Its parameters' meaning.
    pub activated: &'a Activated,
    /// From where.
    pub camera: &'a Camera,
    /// Under which light, scaled to the scene.
    pub light: &'a OlatLight,
    /// Traced visibility of every Gaussian, where it is traced.
    pub traced: Option<&'a [f32]>,
    /// The rectangle of the photograph outside of which it and its mask are empty; `None` where they are everywhere.
    pub content: Option<Region>,
    /// Settings of the pass.
    pub settings: &'a Settings,
    /// What is computed.
    pub needs: &'a StepNeeds,
    /// Another view that this one is compared with.
    pub comparison: Option<Comparison<'a>>,
}

/// Where the time of a pass goes, and how much work it is.
pub struct Meters<'a> {
    /// Seconds.
    pub profile: &'a mut Profile,
    /// Work.
    pub counters: &'a mut Counters,
    /// Who blends, if not the CPU.
    pub blender: Option<&'a mut Box<dyn Blender>>,
}

impl Pass<'_> {
    /// The part of the picture that is shaded and compared: photograph, mask and `opacity` are empty outside of it.
    fn region(&self, opacity: &Image) -> Region {
        let (width, height, _) = opacity.shape();
        if self.needs.all_pixels {
            return Region::whole(width, height);
        }
        let margin = if self.needs.window { SSIM_REACH } else { NEIGHBOUR_REACH };
        match Region::union(self.content, Region::of_image(opacity)) {
            Some(region) => region.grown(margin, width, height),
            None => Region::whole(width, height),
        }
    }
}

/// Runs one pair forward, asks `objective` for the gradient, and runs the pair backward.
pub fn value_and_grad(
    pass: &Pass<'_>,
    meters: &mut Meters<'_>,
    objective: impl FnOnce(&View<'_>) -> Result<ViewGrad, ReconstructError>,
) -> Result<PairGrad, ReconstructError> {
    let Pass { model, activated, camera, light, settings, needs, .. } = *pass;
    let Meters { profile, counters, blender } = meters;
    let layout = &needs.layout;
    let n = model.len();
    let t = Instant::now();
    let projection = project(&activated.gaussians, camera, &raster_config(model)).map_err(error::stage("project"))?;
    let t = profile.add("project", t);
    let rows = Rows::new(model, activated, camera, projection.visible());
    let source = match pass.traced {
        _ if !needs.visibility => VisibilitySource::Unread,
        Some(traced) => VisibilitySource::Traced(traced),
        None => VisibilitySource::Fitted,
    };
    let lit = LightRows::new(model, &rows, light, source)?;
    let inputs = residual_inputs(model, &rows, &lit);
    let scaling = input_scaling(model);
    let assembled = match &model.network {
        Some(_) => Some(inputs.assemble(&scaling).map_err(error::stage("residual inputs"))?),
        None => None,
    };
    let network = match (&model.network, &assembled) {
        (Some(network), Some((matrix, _))) => {
            Some(network.forward(matrix, rows.len()).map_err(error::stage("residual network"))?.0)
        }
        _ => None,
    };
    let transfer = match transfer_config(model) {
        Some(config) => {
            Some(transfer_radiance(&rows.transfer, &lit.directions, config).map_err(error::stage("transfer vectors"))?)
        }
        None => None,
    };
    let medium = match &model.medium {
        Some(term) => Some(term.rows(&rows, &lit, light, MediumTerm::tints(activated, &rows.visible))?),
        None => None,
    };
    let t = profile.add("residual forward", t);
    let mut features = geometry_features(activated, &rows.visible, layout);
    let transported = Transported {
        network: network.as_ref().map(|out| (out.residual.as_slice(), out.incident.as_slice())),
        transfer: transfer.as_ref().map(|(radiance, _)| radiance.as_slice()),
        medium: medium.as_ref(),
        visibility: &lit.visibility,
    };
    transported.write(&mut features, 0, &rows.visible, layout);
    let t = profile.add("features", t);
    let device = |detail| ReconstructError::Device { detail };
    let (raster, raster_pullback) = match blender {
        Some(blender) => {
            let config = projection.config();
            (blender.blend(&activated.gaussians, &features, camera, config).map_err(device)?, None)
        }
        None => {
            let blended = rasterize_projected(&projection, &activated.gaussians, &features);
            let (raster, pullback) = blended.map_err(error::stage("rasterize"))?;
            (raster, Some(pullback))
        }
    };
    let t = profile.add("rasterize forward", t);
    let (width, height, _) = raster.opacity.shape();
    let region = pass.region(&raster.opacity);
    let cropped = |image: &Image| region.crop(image).map_err(error::stage("region"));
    let blended = layout.unpack(&raster.features, &region);
    let (opacity, depth) = (cropped(&raster.opacity)?, cropped(&raster.depth)?);
    let gbuffer = GBuffer { features: &blended, opacity: &opacity, depth: &depth };
    let part = region.camera(camera);
    let (shaded, shade_pullback) = shade(&gbuffer, &part, light, &settings.shading).map_err(error::stage("shade"))?;
    let t = profile.add("shade forward", t);

    let agreement = match &pass.comparison {
        Some(c) if needs.silhouette_consistency || needs.depth_consistency => {
            Some(agreement::agree(model, activated, camera, &raster, c, needs, profile, counters)?)
        }
        _ => None,
    };
    let t = if agreement.is_some() { Instant::now() } else { t };
    let grad = objective(&View { shaded: &shaded, opacity: &opacity, camera: &part, region })?;
    let t = profile.add("objective", t);

    let mut d = shade_pullback.pull(&grad.shaded).map_err(error::stage("shade.pull"))?;
    if let Some(d_opacity) = grad.opacity {
        d.opacity.data_mut().iter_mut().zip(d_opacity.data()).for_each(|(a, b)| *a += b);
    }
    let mut d = RasterGrad {
        features: layout.pack(&d.features, &region, width, height),
        opacity: region.paste(&d.opacity, width, height),
        depth: region.paste(&d.depth, width, height),
    };
    if let Some(agreement) = &agreement {
        for (to, from) in [(&mut d.opacity, &agreement.d_opacity), (&mut d.depth, &agreement.d_depth)] {
            to.data_mut().iter_mut().zip(from.data()).for_each(|(a, b)| *a += b);
        }
    }
    let t = profile.add("shade backward", t);
    let pulled = match (raster_pullback, blender) {
        (Some(pullback), _) => pullback.pull(&d).map_err(error::stage("rasterize.pull"))?,
        (None, Some(blender)) => blender.pull(&d).map_err(device)?,
        (None, None) => return Err(error::stage("rasterize.pull")("nobody blended the picture")),
    };
    let t = profile.add("rasterize backward", t);

    let mut out = ActivatedGrad { gaussians: pulled.gaussians, ..zero_materials(n) };
    if let Some(agreement) = &agreement {
        out.gaussians.add_assign(&agreement.gaussians).map_err(error::stage("consistency"))?;
    }
    let count = layout.count();
    let mut d_residual = vec![0.0; 3 * rows.len()];
    let mut d_incident = vec![0.0; rows.len()];
    for (row, &i) in rows.visible.iter().enumerate() {
        let i = i as usize;
        let d = &pulled.features[i * count..(i + 1) * count];
        let vector = |c: std::ops::Range<usize>| Vec3::from_array(std::array::from_fn(|k| layout.get(d, c.start + k)));
        out.base_color[i] = vector(channel::BASE_COLOR);
        out.roughness[i] = layout.get(d, channel::ROUGHNESS);
        out.metalness[i] = layout.get(d, channel::METALNESS);
        out.subsurfaceness[i] = layout.get(d, channel::SUBSURFACENESS);
        out.normals[i] = vector(channel::NORMAL);
        d_residual[3 * row..3 * row + 3].copy_from_slice(&vector(channel::RESIDUAL).to_array());
        d_incident[row] = layout.get(d, channel::INCIDENT);
    }
    if let (Some(term), Some(medium)) = (&model.medium, &medium) {
        let grad = term.pull(&rows, &lit, light, medium, &d_residual)?;
        for (row, &i) in rows.visible.iter().enumerate() {
            let i = i as usize;
            out.base_color[i] += grad.base_color[row];
            out.normals[i] += grad.normals[row];
            out.gaussians.means[i] += grad.positions[row];
        }
    }
    let mut network_grad = Vec::new();
    let mut backward_rows = 0;
    if let (Some(network), Some((matrix, inputs_pullback))) = (&model.network, &assembled) {
        let has_incident = network.incident_head.is_some() && settings.incident_gradient;
        let codes = model.config.residual.codes;
        // Gaussians that no pixel passes a gradient to add exactly nothing to the network's.
        let live: Vec<usize> = (0..rows.len())
            .filter(|&row| {
                needs.hidden_rows
                    || d_residual[3 * row..3 * row + 3] != [0.0; 3]
                    || (has_incident && d_incident[row] != 0.0)
            })
            .collect();
        let width = network.inputs();
        let incident: &[f32] = if has_incident { &d_incident } else { &[] };
        let d = if 16 * live.len() > 15 * rows.len() {
            // So few are hidden that leaving them out would cost more than it saves.
            backward_rows = rows.len();
            let pullback = network.pullback(matrix, rows.len());
            pullback.and_then(|pullback| pullback.pull(&d_residual, incident, needs.input_gradient))
        } else {
            backward_rows = live.len();
            let take = |values: &[f32], width: usize| -> Vec<f32> {
                let mut taken = Vec::with_capacity(live.len() * width);
                live.iter().for_each(|&row| taken.extend_from_slice(&values[row * width..(row + 1) * width]));
                taken
            };
            let (matrix, d_live) = (take(matrix, width), take(&d_residual, 3));
            let d_live_incident = if has_incident { take(&d_incident, 1) } else { Vec::new() };
            let pullback = network.pullback(&matrix, live.len());
            pullback.and_then(|pullback| pullback.pull(&d_live, &d_live_incident, needs.input_gradient)).map(
                |mut grad| {
                    grad.inputs = grad.inputs.take().map(|d_inputs| {
                        let mut all = vec![0.0; rows.len() * width];
                        for (&row, d) in live.iter().zip(d_inputs.chunks_exact(width)) {
                            all[row * width..(row + 1) * width].copy_from_slice(d);
                        }
                        all
                    });
                    grad
                },
            )
        };
        let mut grad = d.map_err(error::stage("residual network.pull"))?;
        if let Some(d_inputs) = grad.inputs.take() {
            let d = inputs_pullback
                .pull(&d_inputs, InputGradients::Learned)
                .map_err(error::stage("residual inputs.pull"))?;
            out.codes = vec![0.0; n * codes];
            for (row, &i) in rows.visible.iter().enumerate() {
                let i = i as usize;
                out.codes[i * codes..(i + 1) * codes].copy_from_slice(&d.codes[row * codes..(row + 1) * codes]);
                if settings.normal_gradient {
                    out.normals[i] += d.normals[row];
                }
            }
        }
        network_grad = parts_of(grad, network.incident_head.is_some());
    }
    if let Some((_, pullback)) = &transfer {
        let grad = pullback.pull(&d_residual, false).map_err(error::stage("transfer vectors.pull"))?;
        let width = model.config.residual.transfer_width();
        out.transfer = vec![0.0; n * width];
        for (row, &i) in rows.visible.iter().enumerate() {
            out.transfer[i as usize * width..(i as usize + 1) * width]
                .copy_from_slice(&grad.transfer[row * width..(row + 1) * width]);
        }
    }
    profile.add("residual backward", t);
    for (name, count) in [
        ("pairs", 1),
        ("Gaussians", n),
        ("visible Gaussians", rows.len()),
        ("network rows forward", if model.network.is_some() { rows.len() } else { 0 }),
        ("network rows backward", backward_rows),
        ("channels", channel::COUNT),
        ("channels rasterised", layout.count()),
        ("pixels", width * height),
        ("pixels shaded", region.pixels()),
        ("visibility rows", if needs.visibility { rows.len() } else { 0 }),
    ] {
        counters.add(name, count);
    }
    Ok(PairGrad {
        activated: out,
        network: network_grad,
        screen: pulled.screen,
        radii: projection.radii().to_vec(),
        visible: rows.len(),
        agreement: agreement.map_or_else(Vec::new, |a| a.terms),
    })
}

/// The network's gradient: trunk, residual head, and incident head where there is one.
fn parts_of(grad: ResidualNetworkGrad, has_incident: bool) -> Vec<Vec<f32>> {
    let mut parts = vec![grad.trunk, grad.residual_head];
    parts.extend(grad.incident_head.filter(|_| has_incident));
    parts
}

fn zero_materials(n: usize) -> ActivatedGrad {
    ActivatedGrad {
        normals: vec![Vec3::ZERO; n],
        base_color: vec![Vec3::ZERO; n],
        roughness: vec![0.0; n],
        metalness: vec![0.0; n],
        subsurfaceness: vec![0.0; n],
        ..Default::default()
    }
}
