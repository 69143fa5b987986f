//! From raw parameters to a picture under one light, and the way back: the stages between the parameters and the
//! objective, in the order in which they run.
use crate::cpu::Profile;
use crate::{
    Activated, ActivatedGrad, Attribute, CombineVariant, DiffuseVariant, FresnelVariant, IncidentVariant,
    MaskingVariant, Model, ReconstructError, Rendering, StepPlan, error, visibility_cache,
};
use diamond_camera::Camera;
use diamond_light::{OlatLight, spherical_harmonics};
use diamond_shading::{
    BrdfModel, Combine, Diffuse, Fresnel, GBuffer, IncidentModel, InputGradients, InputScaling, LightDistanceInput,
    Masking, Prepared, ResidualInputs, Shaded, ShadedGrad, ShadingConfig, SurfaceVisibility, TransferActivation,
    TransferConfig, channel, shade, transfer_radiance,
};
use diamond_splat::{Cutoff, Features, Raster, RasterConfig, RasterGrad, project, rasterize_projected};
use glam::{Quat, Vec2, Vec3};
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
    shading: ShadingConfig,
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
            use_residual: c.residual.network || c.residual.transfer,
            incident_offset,
            scale_residual_by_light: c.residual.scale_by_light,
        };
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
    /// The shaded picture and its maps.
    pub shaded: &'a Shaded,
    /// Blended features, opacity, depth.
    pub raster: &'a Raster,
}

/// The objective's gradient.
#[derive(Default)]
pub struct ViewGrad {
    /// With respect to radiance and maps.
    pub shaded: ShadedGrad,
    /// With respect to the raster's opacity, if any.
    pub opacity: Option<diamond_image::Image>,
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
}

/// The inputs of the visible Gaussians' residual, row by row.
struct Rows {
    visible: Vec<u32>,
    positions: Vec<Vec3>,
    rotations: Vec<Quat>,
    scales: Vec<Vec3>,
    normals: Vec<Vec3>,
    view_directions: Vec<Vec3>,
    codes: Vec<f32>,
    transfer: Vec<f32>,
}

fn gather(values: &[f32], width: usize, rows: &[u32]) -> Vec<f32> {
    rows.iter().flat_map(|&i| values[i as usize * width..(i as usize + 1) * width].iter().copied()).collect()
}

impl Rows {
    fn new(model: &Model, activated: &Activated, camera: &Camera, visible: &[u32]) -> Self {
        let eye = camera.pose.centre();
        let pick = |v: &[Vec3]| visible.iter().map(|&i| v[i as usize]).collect::<Vec<Vec3>>();
        let g = &activated.gaussians;
        let positions = pick(&g.means);
        let residual = &model.config.residual;
        Self {
            view_directions: positions.iter().map(|p| (eye - *p).try_normalize().unwrap_or(Vec3::Z)).collect(),
            rotations: visible.iter().map(|&i| unit(g.rotations[i as usize])).collect(),
            scales: pick(&g.scales),
            normals: pick(&activated.normals),
            codes: gather(model.parameters.values(Attribute::Codes), residual.codes, visible),
            transfer: gather(model.parameters.values(Attribute::Transfer), residual.transfer_width(), visible),
            positions,
            visible: visible.to_vec(),
        }
    }

    fn len(&self) -> usize {
        self.visible.len()
    }
}

/// Quaternions shorter than this have no direction.
const MIN_QUATERNION: f32 = 1e-12;

fn unit(q: Quat) -> Quat {
    let length = q.length();
    if length > MIN_QUATERNION { q / length } else { Quat::IDENTITY }
}

/// The light-dependent inputs, row by row.
struct LightRows {
    /// Visibility used for shading: traced where it was, else the SH fit.
    visibility: Vec<f32>,
    /// Unit direction to the light.
    directions: Vec<Vec3>,
    /// Distance to the light, scene units; infinite for directional lights.
    distances: Vec<f32>,
}

impl LightRows {
    fn new(model: &Model, rows: &Rows, light: &OlatLight, traced: Option<&[f32]>) -> Result<Self, ReconstructError> {
        let incidence: Vec<_> =
            rows.positions.iter().map(|p| light.incidence(*p, diamond_light::Falloff::None)).collect();
        let directions: Vec<Vec3> = incidence.iter().map(|i| i.direction).collect();
        let visibility = match traced {
            Some(v) => rows.visible.iter().map(|&i| v[i as usize]).collect(),
            None => {
                let sh = gather(
                    model.parameters.values(Attribute::VisibilitySh),
                    spherical_harmonics::COEFFICIENTS,
                    &rows.visible,
                );
                diamond_shading::sh_visibility::visibilities(&sh, &directions).map_err(error::stage("visibility"))?
            }
        };
        Ok(Self { visibility, directions, distances: incidence.iter().map(|i| i.distance).collect() })
    }
}

fn residual_inputs<'a>(model: &Model, rows: &'a Rows, lit: &'a LightRows) -> ResidualInputs<'a> {
    ResidualInputs {
        positions: &rows.positions,
        rotations: &rows.rotations,
        scales: &rows.scales,
        view_directions: &rows.view_directions,
        light_directions: &lit.directions,
        normals: &rows.normals,
        visibility: &lit.visibility,
        light_distances: &lit.distances,
        codes: &rows.codes,
        code_size: model.config.residual.codes,
    }
}

fn input_scaling(model: &Model) -> InputScaling {
    let (centre, half) = (model.scene.centre(), Vec3::splat(model.scene.radius));
    let mut scaling = InputScaling::of_bounds(centre - half, centre + half);
    scaling.light_distance = LightDistanceInput::Bounded { reference: model.scene.light_distance };
    scaling
}

fn transfer_config(model: &Model) -> Option<TransferConfig> {
    let residual = &model.config.residual;
    let degree = residual.transfer_degree as usize;
    residual.transfer.then_some(TransferConfig { degree, activation: TransferActivation::Linear })
}

/// Runs one pair forward, asks `objective` for the gradient, and runs the pair backward.
pub fn value_and_grad(
    model: &Model,
    activated: &Activated,
    camera: &Camera,
    light: &OlatLight,
    traced: Option<&[f32]>,
    settings: &Settings,
    profile: &mut Profile,
    objective: impl FnOnce(&View<'_>) -> Result<ViewGrad, ReconstructError>,
) -> Result<PairGrad, ReconstructError> {
    let n = model.len();
    let t = Instant::now();
    let projection = project(&activated.gaussians, camera, &raster_config(model)).map_err(error::stage("project"))?;
    let t = profile.add("project", t);
    let rows = Rows::new(model, activated, camera, projection.visible());
    let lit = LightRows::new(model, &rows, light, traced)?;
    let inputs = residual_inputs(model, &rows, &lit);
    let scaling = input_scaling(model);
    let assembled = match &model.network {
        Some(_) => Some(inputs.assemble(&scaling).map_err(error::stage("residual inputs"))?),
        None => None,
    };
    let network = match (&model.network, &assembled) {
        (Some(network), Some((matrix, _))) => {
            Some(network.forward(matrix, rows.len()).map_err(error::stage("residual network"))?)
        }
        _ => None,
    };
    let transfer = match transfer_config(model) {
        Some(config) => {
            Some(transfer_radiance(&rows.transfer, &lit.directions, config).map_err(error::stage("transfer vectors"))?)
        }
        None => None,
    };
    let t = profile.add("residual forward", t);
    let mut features = geometry_features(activated, &rows);
    write_transport(
        &mut features,
        channel::TRANSPORT.start,
        &rows,
        network.as_ref().map(|(out, _)| (out.residual.as_slice(), out.incident.as_slice())),
        transfer.as_ref().map(|(radiance, _)| radiance.as_slice()),
        &lit.visibility,
    );
    let t = profile.add("features", t);
    let (raster, raster_pullback) =
        rasterize_projected(&projection, &activated.gaussians, &features).map_err(error::stage("rasterize"))?;
    let t = profile.add("rasterize forward", t);
    let gbuffer = GBuffer { features: &raster.features, opacity: &raster.opacity, depth: &raster.depth };
    let (shaded, shade_pullback) = shade(&gbuffer, camera, light, &settings.shading).map_err(error::stage("shade"))?;
    let t = profile.add("shade forward", t);

    let grad = objective(&View { shaded: &shaded, raster: &raster })?;
    let t = profile.add("objective", t);

    let mut d = shade_pullback.pull(&grad.shaded).map_err(error::stage("shade.pull"))?;
    if let Some(d_opacity) = grad.opacity {
        d.opacity.data_mut().iter_mut().zip(d_opacity.data()).for_each(|(a, b)| *a += b);
    }
    let t = profile.add("shade backward", t);
    let pulled = raster_pullback
        .pull(&RasterGrad { features: d.features, opacity: d.opacity, depth: d.depth })
        .map_err(error::stage("rasterize.pull"))?;
    let t = profile.add("rasterize backward", t);

    let mut out = ActivatedGrad { gaussians: pulled.gaussians, ..zero_materials(n) };
    let count = channel::COUNT;
    let mut d_residual = vec![0.0; 3 * rows.len()];
    let mut d_incident = vec![0.0; rows.len()];
    for (row, &i) in rows.visible.iter().enumerate() {
        let i = i as usize;
        let d = &pulled.features[i * count..(i + 1) * count];
        out.base_color[i] = Vec3::from_slice(&d[channel::BASE_COLOR]);
        out.roughness[i] = d[channel::ROUGHNESS];
        out.metalness[i] = d[channel::METALNESS];
        out.subsurfaceness[i] = d[channel::SUBSURFACENESS];
        out.normals[i] = Vec3::from_slice(&d[channel::NORMAL]);
        d_residual[3 * row..3 * row + 3].copy_from_slice(&d[channel::RESIDUAL]);
        d_incident[row] = d[channel::INCIDENT];
    }
    let mut network_grad = Vec::new();
    if let (Some((_, pullback)), Some((_, inputs_pullback))) = (&network, &assembled) {
        let has_incident = model.network.as_ref().is_some_and(|n| n.incident_head.is_some());
        let d_incident: &[f32] = if has_incident && settings.incident_gradient { &d_incident } else { &[] };
        let codes = model.config.residual.codes;
        let grad = pullback
            .pull(&d_residual, d_incident, codes > 0 || settings.normal_gradient)
            .map_err(error::stage("residual network.pull"))?;
        if let Some(d_inputs) = &grad.inputs {
            let d = inputs_pullback
                .pull(d_inputs, InputGradients::Learned)
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
        network_grad = vec![grad.trunk, grad.residual_head];
        if let (Some(head), Some(network)) = (grad.incident_head, &model.network)
            && network.incident_head.is_some()
        {
            network_grad.push(head);
        }
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
    Ok(PairGrad {
        activated: out,
        network: network_grad,
        screen: pulled.screen,
        radii: projection.radii().to_vec(),
        visible: rows.len(),
    })
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

/// Feature rows of the visible Gaussians with the light-independent channels filled in.
fn geometry_features(activated: &Activated, rows: &Rows) -> Features {
    let mut features = Features::zeros(activated.gaussians.len(), channel::COUNT);
    for &i in &rows.visible {
        let i = i as usize;
        let row = features.row_mut(i);
        row[channel::BASE_COLOR].copy_from_slice(&activated.base_color[i].to_array());
        row[channel::ROUGHNESS] = activated.roughness[i];
        row[channel::METALNESS] = activated.metalness[i];
        row[channel::SUBSURFACENESS] = activated.subsurfaceness[i];
        row[channel::NORMAL].copy_from_slice(&activated.normals[i].to_array());
    }
    features
}

/// Writes residual, incident light and visibility of one light into channels `first..first + 5` of the visible rows.
fn write_transport(
    features: &mut Features,
    first: usize,
    rows: &Rows,
    network: Option<(&[f32], &[f32])>,
    transfer: Option<&[f32]>,
    visibility: &[f32],
) {
    let base = channel::TRANSPORT.start;
    let at = |c: usize| first + c - base;
    for (row, &i) in rows.visible.iter().enumerate() {
        let out = features.row_mut(i as usize);
        for k in 0..3 {
            let network = network.map_or(0.0, |(residual, _)| residual[3 * row + k]);
            out[at(channel::RESIDUAL.start + k)] = network + transfer.map_or(0.0, |t| t[3 * row + k]);
        }
        out[at(channel::INCIDENT)] = network.map_or(0.0, |(_, incident)| incident.get(row).copied().unwrap_or(0.0));
        out[at(channel::VISIBILITY)] = visibility[row];
    }
}

/// Lights whose residuals are blended in one rasterisation: bounds the memory of their channels.
const LIGHTS_PER_RASTERISATION: usize = 16;

/// Renders one camera under each light: one projection, one rasterisation for every [`LIGHTS_PER_RASTERISATION`] lights,
/// residual and shading per light.
pub fn render(model: &Model, camera: &Camera, lights: &[OlatLight]) -> Result<Vec<Rendering>, ReconstructError> {
    let activated = model.parameters.activate();
    let settings = Settings::rendering(model);
    let projection = project(&activated.gaussians, camera, &raster_config(model)).map_err(error::stage("project"))?;
    let rows = Rows::new(model, &activated, camera, projection.visible());
    let tracer = match model.config.visibility.traced {
        true => Some(visibility_cache::Tracer::new(&activated.gaussians)?),
        false => None,
    };
    let geometry = geometry_features(&activated, &rows);
    let scaling = input_scaling(model);
    let mut out = Vec::with_capacity(lights.len());
    for group in lights.chunks(LIGHTS_PER_RASTERISATION) {
        let (fixed, per_light) = (channel::GEOMETRY.len(), channel::TRANSPORT.len());
        let mut features = Features::zeros(activated.gaussians.len(), fixed + per_light * group.len());
        for &i in &rows.visible {
            let i = i as usize;
            features.row_mut(i)[channel::GEOMETRY].copy_from_slice(&geometry.row(i)[channel::GEOMETRY]);
        }
        for (k, light) in group.iter().enumerate() {
            let traced = match &tracer {
                Some(tracer) => Some(tracer.trace(&activated.gaussians, &activated.normals, light)?),
                None => None,
            };
            let lit = LightRows::new(model, &rows, light, traced.as_deref())?;
            let network = match &model.network {
                Some(network) => {
                    let inputs = residual_inputs(model, &rows, &lit);
                    let (matrix, _) = inputs.assemble(&scaling).map_err(error::stage("residual inputs"))?;
                    Some(network.forward(&matrix, rows.len()).map_err(error::stage("residual network"))?.0)
                }
                None => None,
            };
            let transfer = match transfer_config(model) {
                Some(config) => Some(
                    transfer_radiance(&rows.transfer, &lit.directions, config)
                        .map_err(error::stage("transfer vectors"))?
                        .0,
                ),
                None => None,
            };
            write_transport(
                &mut features,
                fixed + per_light * k,
                &rows,
                network.as_ref().map(|o| (o.residual.as_slice(), o.incident.as_slice())),
                transfer.as_deref(),
                &lit.visibility,
            );
        }
        let (raster, _) =
            rasterize_projected(&projection, &activated.gaussians, &features).map_err(error::stage("rasterize"))?;
        let blended = raster.features.channels_range(channel::GEOMETRY);
        let gbuffer = GBuffer { features: &blended, opacity: &raster.opacity, depth: &raster.depth };
        let prepared = Prepared::new(&gbuffer, camera, &settings.shading).map_err(error::stage("shade"))?;
        for (k, light) in group.iter().enumerate() {
            let first = fixed + per_light * k;
            let transport = raster.features.channels_range(first..first + per_light);
            let shaded =
                prepared.shade(&model.scene.scaled_light(light), Some(&transport)).map_err(error::stage("shade"))?;
            out.push(Rendering {
                radiance: shaded.radiance,
                surface: shaded.surface,
                subsurface: shaded.subsurface,
                opacity: raster.opacity.clone(),
                maps: shaded.maps,
            });
        }
    }
    Ok(out)
}
