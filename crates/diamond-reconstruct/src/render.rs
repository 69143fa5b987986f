//! Pictures of a model: what does not depend on the light is done once for all lights of a view, and what does not
//! depend on the view once for all views.
//!
//! For a view: projection, blending of the light-independent channels, the rectangle that is covered, the shader's half,
//! the sums of the network's first layer, and which Gaussians pass anything to a pixel at all (those behind others do
//! not). For a light remain: rays from those Gaussians, the rest of the network, three to five channels in a
//! rasterisation that sixteen lights share, and the shader's other half on covered pixels.
//!
//! A picture has the same bits however many lights it is rendered among.
use crate::channel_layout::ChannelLayout;
use crate::exposure::expose;
use crate::forward::{Settings, raster_config};
use crate::needs::RenderNeeds;
use crate::region::Region;
use crate::rows::{
    LightRows, Rows, VisibilitySource, geometry_features, input_scaling, residual_inputs, transfer_config,
};
use crate::visibility_cache::Tracer;
use crate::{Activated, CaptureFacts, Model, Needs, ReconstructError, Rendering, error};
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_shading::{GBuffer, LightChannels, LitRows, Prepared, Shaded, ShadedMaps, TransportChannels, channel};
use diamond_simd::Level;
use diamond_splat::{Features, Projection, Raster, RasterGrad, project, rasterize_projected};
use glam::Vec3;
use rayon::prelude::*;
use std::sync::OnceLock;

/// Lights whose residuals are blended in one rasterisation, unless told otherwise: bounds the memory of their channels.
pub const LIGHTS_PER_RASTERISATION: usize = 16;
/// From so many lights on it pays to find out which Gaussians pass something to a pixel: it costs about as much as one
/// light, and spares each light the others.
const LIGHTS_TO_LOOK_AHEAD: usize = 4;

/// A model ready to be rendered from any number of views.
pub struct Renderer<'m> {
    model: &'m Model,
    activated: Activated,
    needs: RenderNeeds,
    /// Built when the first light needs it.
    tracer: OnceLock<Tracer>,
    lights_together: usize,
}

/// Shades a group of lights of a view from their channels.
type ShadeGroup<'a> = dyn FnMut(&ViewHalf, &[OlatLight], &Image) -> Result<(), ReconstructError> + 'a;

/// How much work a view was.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RenderWork {
    /// Gaussians in the view.
    pub visible: usize,
    /// Gaussians whose residual and visibility were computed, per light.
    pub rows: usize,
    /// Channels rasterised once.
    pub fixed_channels: usize,
    /// Channels rasterised per light.
    pub light_channels: usize,
    /// Pixels of the picture.
    pub pixels: usize,
    /// Pixels of the rectangle that was shaded.
    pub shaded: usize,
}

impl<'m> Renderer<'m> {
    /// Of a model as it stands.
    pub fn new(model: &'m Model) -> Self {
        let activated = model.parameters.activate();
        let needs = Needs::decide(&model.config, &CaptureFacts::default()).rendering(&activated);
        Self { model, activated, needs, tracer: OnceLock::new(), lights_together: LIGHTS_PER_RASTERISATION }
    }

    /// Of a model with given decisions on what is computed.
    pub fn with_needs(model: &'m Model, needs: RenderNeeds) -> Self {
        let activated = model.parameters.activate();
        Self { model, activated, needs, tracer: OnceLock::new(), lights_together: LIGHTS_PER_RASTERISATION }
    }

    /// With so many lights blended in one rasterisation (at least 1; [`LIGHTS_PER_RASTERISATION`] unless told otherwise):
    /// memory and time depend on it, pictures do not.
    pub fn with_lights_together(self, lights: usize) -> Self {
        Self { lights_together: lights.max(1), ..self }
    }

    /// What is computed, and why.
    pub fn needs(&self) -> &RenderNeeds {
        &self.needs
    }

    /// The radiance of one view under each light: linear RGB over black.
    pub fn radiance(&self, camera: &Camera, lights: &[OlatLight]) -> Result<Vec<Image>, ReconstructError> {
        let (mut out, layout) = (Vec::with_capacity(lights.len()), self.needs.layout());
        self.each_group(camera, lights, &layout, &mut |view, lights, transport| {
            let (width, height) = view.size;
            let per_light = view.per_light.count();
            let images = lights.par_iter().enumerate().map(|(k, light)| {
                let channels = view.channels(k * per_light);
                let light = self.model.scene.scaled_light(light);
                let part = view.prepared.radiance(&light, transport, &channels).map_err(error::stage("shade"))?;
                Ok(view.region.paste(&self.exposed(part), width, height))
            });
            out.extend(images.collect::<Result<Vec<_>, ReconstructError>>()?);
            Ok(())
        })?;
        Ok(out)
    }

    /// As [`Renderer::radiance`], with both parts of the light and all maps.
    pub fn renderings(&self, camera: &Camera, lights: &[OlatLight]) -> Result<Vec<Rendering>, ReconstructError> {
        // The maps show every channel, whether or not the radiance depends on it.
        let (mut out, layout) = (Vec::with_capacity(lights.len()), ChannelLayout::full());
        self.each_group(camera, lights, &layout, &mut |view, lights, transport| {
            let (width, height) = view.size;
            let per_light = view.per_light.count();
            for (k, light) in lights.iter().enumerate() {
                let transport = transport.channels_range(k * per_light..(k + 1) * per_light);
                let light = self.model.scene.scaled_light(light);
                let mut shaded = view.prepared.shade(&light, Some(&transport)).map_err(error::stage("shade"))?;
                shaded.radiance = self.exposed(shaded.radiance);
                shaded.surface = self.exposed(shaded.surface);
                shaded.subsurface = self.exposed(shaded.subsurface);
                out.push(rendering(shaded, &view.region, &view.opacity, width, height));
            }
            Ok(())
        })?;
        Ok(out)
    }

    /// How much work [`Renderer::radiance`] of one view under so many lights is.
    pub fn work(&self, camera: &Camera, lights: usize) -> Result<RenderWork, ReconstructError> {
        let layout = self.needs.layout();
        let view = self.view(camera, lights, &layout)?;
        Ok(RenderWork {
            visible: view.projection.visible().len(),
            rows: view.rows.len(),
            fixed_channels: layout.count() - view.per_light.count(),
            light_channels: view.per_light.count(),
            pixels: view.size.0 * view.size.1,
            shaded: view.region.pixels(),
        })
    }

    /// Under the global gain, where exposure has one.
    fn exposed(&self, image: Image) -> Image {
        let gain = self.model.exposure.of_renderings(self.model.config.exposure.mode);
        if gain == Vec3::ONE { image } else { expose(&image, gain) }
    }

    fn tracer(&self) -> Result<&Tracer, ReconstructError> {
        if let Some(tracer) = self.tracer.get() {
            return Ok(tracer);
        }
        let tracer = Tracer::new(&self.activated.gaussians, &self.activated.normals)?;
        Ok(self.tracer.get_or_init(|| tracer))
    }

    /// The light-independent half of a view that will be rendered under `lights` lights.
    fn view(&self, camera: &Camera, lights: usize, layout: &ChannelLayout) -> Result<ViewHalf, ReconstructError> {
        let (model, gaussians) = (self.model, &self.activated.gaussians);
        let projection = project(gaussians, camera, &raster_config(model)).map_err(error::stage("project"))?;
        let visible = projection.visible();
        let fixed = layout.filtered(|c| channel::GEOMETRY.contains(&c));
        let features = geometry_features(&self.activated, visible, &fixed);
        let (raster, pullback) =
            rasterize_projected(&projection, gaussians, &features).map_err(error::stage("rasterize"))?;
        let (width, height, _) = raster.opacity.shape();
        let rows = if lights >= LIGHTS_TO_LOOK_AHEAD && !self.needs.hidden_rows.needed {
            // The gradient of Σ w·f with respect to f is Σ w: 0 for Gaussians that no pixel takes anything of.
            let mut d = RasterGrad::zeros(width, height, fixed.count());
            d.features.data_mut().iter_mut().step_by(fixed.count()).for_each(|v| *v = 1.0);
            let pulled = pullback.pull(&d).map_err(error::stage("rasterize.pull"))?;
            let passes = |&&i: &&u32| pulled.features[i as usize * fixed.count()] != 0.0;
            visible.iter().filter(passes).copied().collect()
        } else {
            visible.to_vec()
        };
        let rows = Rows::new(model, &self.activated, camera, &rows);
        let network = match &model.network {
            Some(network) if self.needs.subsurface.needed || self.needs.incident.needed => {
                let dark = LightRows::dark(rows.len());
                let inputs = residual_inputs(model, &rows, &dark);
                let (matrix, _) = inputs.assemble(&input_scaling(model)).map_err(error::stage("residual inputs"))?;
                Some(network.many_lights(&matrix, rows.len()).map_err(error::stage("residual network"))?)
            }
            _ => None,
        };
        let scaling = input_scaling(model);
        let transfer = transfer_config(model).filter(|_| self.needs.subsurface.needed);
        let transfer = transfer.map(|config| (rows.transfer.as_slice(), config));
        let lit =
            LitRows::new(&rows.positions, network, transfer, &scaling).map_err(error::stage("transfer vectors"))?;
        let region = match Region::of_image(&raster.opacity) {
            Some(region) if !self.needs.empty_pixels.needed => region,
            _ => Region::whole(width, height),
        };
        let (prepared, opacity) = self.prepare(&raster, &fixed, &region, camera)?;
        Ok(ViewHalf {
            per_light: layout.filtered(|c| channel::TRANSPORT.contains(&c)),
            size: (width, height),
            projection,
            rows,
            lit,
            region,
            prepared,
            opacity,
        })
    }

    fn prepare(
        &self,
        raster: &Raster,
        fixed: &ChannelLayout,
        region: &Region,
        camera: &Camera,
    ) -> Result<(Prepared, Image), ReconstructError> {
        let cropped = |image: &Image| region.crop(image).map_err(error::stage("region"));
        let (opacity, depth) = (cropped(&raster.opacity)?, cropped(&raster.depth)?);
        let features = fixed.unpack(&raster.features, region);
        let gbuffer = GBuffer { features: &features, opacity: &opacity, depth: &depth };
        let mut settings = Settings::rendering(self.model);
        settings.shading.use_residual &= self.needs.subsurface.needed;
        let prepared =
            Prepared::new(&gbuffer, &region.camera(camera), &settings.shading).map_err(error::stage("shade"))?;
        Ok((prepared, opacity))
    }

    /// Calls `shade` with the light-dependent channels of each group of lights, cut to the view's rectangle.
    fn each_group(
        &self,
        camera: &Camera,
        lights: &[OlatLight],
        layout: &ChannelLayout,
        shade: &mut ShadeGroup<'_>,
    ) -> Result<(), ReconstructError> {
        if lights.is_empty() {
            return Ok(());
        }
        let view = self.view(camera, lights.len(), layout)?;
        let gaussians = &self.activated.gaussians;
        let mut features = Features::zeros(0, 0);
        for group in lights.chunks(self.lights_together) {
            let visibility: Vec<Vec<f32>> =
                group.par_iter().map(|light| self.visibility(&view, light, layout)).collect::<Result<_, _>>()?;
            let lit: Vec<(OlatLight, &[f32])> =
                group.iter().zip(&visibility).map(|(light, v)| (*light, v.as_slice())).collect();
            let channels = view.per_light.count() * group.len();
            if features.channels != channels {
                // The memory of the last group before that of this one.
                drop(std::mem::replace(&mut features, Features::zeros(0, 0)));
                features = Features::zeros(gaussians.len(), channels);
            }
            view.write(&lit, &mut features)?;
            let (raster, _) =
                rasterize_projected(&view.projection, gaussians, &features).map_err(error::stage("rasterize"))?;
            let transport = view.region.crop(&raster.features).map_err(error::stage("region"))?;
            shade(&view, group, &transport)?;
        }
        Ok(())
    }

    /// Visibility of one light from the rows of a view; empty where nothing reads it.
    fn visibility(
        &self,
        view: &ViewHalf,
        light: &OlatLight,
        layout: &ChannelLayout,
    ) -> Result<Vec<f32>, ReconstructError> {
        if !self.needs.visibility.needed && layout.place(channel::VISIBILITY).is_none() {
            return Ok(Vec::new());
        }
        if !self.model.config.visibility.traced {
            return Ok(LightRows::new(self.model, &view.rows, light, VisibilitySource::Fitted)?.visibility);
        }
        let Activated { gaussians, normals, .. } = &self.activated;
        self.tracer()?.trace_rows(gaussians, normals, light, &view.rows.visible)
    }
}

/// The light-independent half of a view.
struct ViewHalf {
    /// The light-dependent channels of one light.
    per_light: ChannelLayout,
    /// Width and height.
    size: (usize, usize),
    projection: Projection,
    /// Of the Gaussians that pass something to a pixel.
    rows: Rows,
    /// The same, ready for lights.
    lit: LitRows,
    /// Outside of it no Gaussian covers anything.
    region: Region,
    prepared: Prepared,
    /// Of the region.
    opacity: Image,
}

impl ViewHalf {
    /// Places of a light's channels, of which the first is `first`.
    fn channels(&self, first: usize) -> TransportChannels {
        let at = |c: usize| self.per_light.place(c).map(|place| first + place);
        TransportChannels {
            residual: at(channel::RESIDUAL.start),
            incident: at(channel::INCIDENT),
            visibility: at(channel::VISIBILITY),
        }
    }

    /// Writes the channels of all `lights` into the feature rows of the view's rows.
    fn write(&self, lights: &[(OlatLight, &[f32])], features: &mut Features) -> Result<(), ReconstructError> {
        let (rows, width) = (&self.rows.visible, features.channels);
        let channels = LightChannels { places: self.channels(0), per_light: self.per_light.count() };
        // Rows ascend: each task has a piece of its own.
        let (mut pieces, mut rest, mut start) = (Vec::new(), features.data.as_mut_slice(), 0);
        for rows in rows.chunks(LitRows::TASK_ROWS) {
            let end = rows[rows.len() - 1] as usize + 1;
            let (piece, after) = rest.split_at_mut((end - start) * width);
            pieces.push((start, piece));
            (rest, start) = (after, end);
        }
        // Asked here: the setting belongs to the thread that called.
        let level = Level::current();
        pieces.into_par_iter().enumerate().try_for_each(|(task, (start, piece))| {
            let put = |row: usize, values: &[f32]| {
                let at = (rows[row] as usize - start) * width;
                piece[at..at + width].copy_from_slice(values);
            };
            self.lit.task(task, level, lights, &channels, put).map_err(error::stage("residual network"))
        })
    }
}

fn rendering(shaded: Shaded, region: &Region, opacity: &Image, width: usize, height: usize) -> Rendering {
    let whole = |part: &Image| region.paste(part, width, height);
    let m = &shaded.maps;
    Rendering {
        radiance: whole(&shaded.radiance),
        surface: whole(&shaded.surface),
        subsurface: whole(&shaded.subsurface),
        opacity: whole(opacity),
        maps: ShadedMaps {
            base_color: whole(&m.base_color),
            roughness: whole(&m.roughness),
            metalness: whole(&m.metalness),
            subsurfaceness: whole(&m.subsurfaceness),
            normal: whole(&m.normal),
            residual: whole(&m.residual),
            incident: whole(&m.incident),
            visibility: whole(&m.visibility),
            depth: whole(&m.depth),
        },
    }
}
