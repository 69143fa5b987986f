//! Pictures of a model: what does not depend on the light is done once for all lights of a view, and what does not
//! depend on the view once for all views.
//!
//! For a view: projection, who is seen in which pixel and how much ([`BlendWeights`]), the light-independent channels, the
//! shader's half, and the sums of the network's first layer. For a light remain, of the Gaussians that are seen: rays and
//! the rest of the network; and of the blocks of pixels that show anything: three to five channels and the
//! shader's other half. Blending and shading of a block happen in the first cache, for twelve lights one after the other.
//!
//! A picture has the same bits however many lights it is rendered among.
use crate::channel_layout::ChannelLayout;
use crate::forward::{Settings, raster_config};
use crate::light_half::LightHalf;
use crate::needs::RenderNeeds;
use crate::region::Region;
use crate::rows::{LightRows, Rows, VisibilitySource, input_scaling, residual_inputs, transfer_config, write_geometry};
use crate::visibility_cache::{LightKey, Tracer, key};
use crate::{Activated, CaptureFacts, MediumTerm, Model, Needs, ReconstructError, Relighter, Rendering, error};
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_shading::{
    BlendedBlock, BlockShader, LightChannels, LitRows, PreparedBlock, Shaded, ShadedMaps, ShadedRecords, ShadingError,
    TransportChannels, channel,
};
use diamond_simd::{BLOCK, Level};
use diamond_splat::{BlendBlock, BlendWeights, BlockBlender, Features, KeepAll, project, rasterize};
use glam::Vec3;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, OnceLock};

/// Lights that go through the rows and pixels of a view together, unless told otherwise: bounds the memory of their
/// channels.
pub const LIGHTS_TOGETHER: usize = 12;
/// Bytes of the pictures of lights that go together, unless told otherwise: large pictures go in smaller groups.
pub const PICTURE_BYTES: usize = 256 << 20;

/// A model ready to be rendered from any number of views.
pub struct Renderer<'m> {
    pub(crate) model: &'m Model,
    pub(crate) activated: Activated,
    pub(crate) needs: RenderNeeds,
    /// Built when the first light needs it.
    tracer: OnceLock<Tracer>,
    lights_together: usize,
    picture_bytes: usize,
    /// Bytes of what is kept of lights from one view to the next.
    pub(crate) kept_bytes: usize,
    /// Who makes radiance, if not the CPU.
    pub(crate) relighter: Option<Mutex<Box<dyn Relighter>>>,
    kept: Mutex<BTreeMap<LightKey, Arc<LightHalf>>>,
}

/// What a view sees of the shape of a model.
#[derive(Debug, Clone, PartialEq)]
pub struct RenderedShape {
    /// Σ w: the coverage of each pixel.
    pub opacity: Image,
    /// Σ w·z, scene units.
    pub depth: Image,
}

/// How much work a view was.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RenderWork {
    /// Gaussians in the view.
    pub visible: usize,
    /// Gaussians whose residual and visibility were computed, per light.
    pub rows: usize,
    /// Channels blended once.
    pub fixed_channels: usize,
    /// Channels blended per light.
    pub light_channels: usize,
    /// Pixels of the picture.
    pub pixels: usize,
    /// Pixels of the blocks that were shaded.
    pub shaded: usize,
}

impl<'m> Renderer<'m> {
    /// Of a model as it stands.
    pub fn new(model: &'m Model) -> Self {
        let activated = model.parameters.activate();
        let needs = Needs::decide(&model.config, &CaptureFacts::default()).rendering(&activated);
        Self::of(model, activated, needs)
    }

    /// Of a model with given decisions on what is computed.
    pub fn with_needs(model: &'m Model, needs: RenderNeeds) -> Self {
        Self::of(model, model.parameters.activate(), needs)
    }

    fn of(model: &'m Model, activated: Activated, needs: RenderNeeds) -> Self {
        Self {
            model,
            activated,
            needs,
            tracer: OnceLock::new(),
            lights_together: LIGHTS_TOGETHER,
            picture_bytes: PICTURE_BYTES,
            kept_bytes: 0,
            relighter: None,
            kept: Mutex::default(),
        }
    }

    /// With so many lights going through a view together (at least 1; [`LIGHTS_TOGETHER`] unless told otherwise): memory
    /// and time depend on it, pictures do not.
    pub fn with_lights_together(self, lights: usize) -> Self {
        Self { lights_together: lights.max(1), ..self }
    }

    /// With groups of lights whose pictures occupy at most so many bytes ([`PICTURE_BYTES`] unless told otherwise), or
    /// of one light.
    pub fn with_picture_bytes(self, bytes: usize) -> Self {
        Self { picture_bytes: bytes, ..self }
    }

    /// Keeps the traced visibility of lights, which does not depend on the view, for the views that follow: four bytes
    /// per Gaussian and light, so many bytes in all (none unless told otherwise). A light is then traced for all
    /// Gaussians and not only for those that a view shows. Pictures have the same bits.
    pub fn with_kept_visibility(self, bytes: usize) -> Self {
        Self { kept_bytes: bytes, ..self }
    }

    /// Lights that go together where a picture has so many pixels.
    pub(crate) fn group_of(&self, (width, height): (usize, usize)) -> usize {
        let bytes = (width * height).saturating_mul(3 * size_of::<f32>()).max(1);
        (self.picture_bytes / bytes).clamp(1, self.lights_together)
    }

    /// What is computed, and why.
    pub fn needs(&self) -> &RenderNeeds {
        &self.needs
    }

    /// The radiance of one view under each light: linear RGB over black.
    pub fn radiance(&self, camera: &Camera, lights: &[OlatLight]) -> Result<Vec<Image>, ReconstructError> {
        if lights.is_empty() {
            return Ok(Vec::new());
        }
        let mut out = Vec::with_capacity(lights.len());
        if let Some(relighter) = &self.relighter {
            let mut see = |_, image| -> Result<(), ReconstructError> {
                out.push(image);
                Ok(())
            };
            self.relit(relighter, camera, lights, &mut see)?;
            return Ok(out);
        }
        let view = self.view(camera, &self.needs.layout())?;
        let mut buffers = Buffers::default();
        for group in lights.chunks(self.group_of(view.size)) {
            self.radiance_group(&view, group, &mut buffers)?;
            out.append(&mut buffers.images);
        }
        Ok(out)
    }

    /// As [`Renderer::radiance`], but calls `see` with the number of each light and its picture, in order, and uses the
    /// memory of a picture again: for pictures that are written or compared one by one.
    ///
    /// # Errors
    /// The renderer's, and whatever `see` returns, which ends it.
    pub fn each_radiance<E: From<ReconstructError>>(
        &self,
        camera: &Camera,
        lights: &[OlatLight],
        mut see: impl FnMut(usize, &Image) -> Result<(), E>,
    ) -> Result<(), E> {
        if lights.is_empty() {
            return Ok(());
        }
        if let Some(relighter) = &self.relighter {
            return self.relit(relighter, camera, lights, &mut |k, image| see(k, &image));
        }
        let view = self.view(camera, &self.needs.layout())?;
        let (mut buffers, together) = (Buffers::default(), self.group_of(view.size));
        for (g, group) in lights.chunks(together).enumerate() {
            self.radiance_group(&view, group, &mut buffers)?;
            for (k, image) in buffers.images.iter().enumerate() {
                see(g * together + k, image)?;
            }
        }
        Ok(())
    }

    /// Radiance of one view under a group of lights; `buffers` may hold another group's.
    fn radiance_group(
        &self,
        view: &ViewHalf,
        group: &[OlatLight],
        buffers: &mut Buffers,
    ) -> Result<(), ReconstructError> {
        let whole = Region::whole(view.size.0, view.size.1);
        let gain = self.model.exposure.of_renderings(self.model.config.exposure.mode);
        let shade = |block: &PreparedBlock, lights: &[OlatLight], sums: &[[f32; BLOCK]], out: &mut [_]| {
            view.shader.radiance(block, lights, &view.channels, sums, out)?;
            if gain != Vec3::ONE {
                out.iter_mut().for_each(|out| expose(out, gain));
            }
            Ok(())
        };
        self.group::<3>(view, group, &whole, shade, buffers)
    }

    /// As [`Renderer::radiance`], with both parts of the light and all maps.
    pub fn renderings(&self, camera: &Camera, lights: &[OlatLight]) -> Result<Vec<Rendering>, ReconstructError> {
        // The maps show every channel, whether or not the radiance depends on it.
        let view = self.view(camera, &ChannelLayout::full())?;
        let (width, height) = view.size;
        let region = view.region();
        let opacity = view.opacity();
        let gain = self.model.exposure.of_renderings(self.model.config.exposure.mode);
        let mut out = Vec::with_capacity(lights.len());
        let mut buffers = Buffers::default();
        // Records are eight times as large as pictures.
        for group in lights.chunks(self.group_of(view.size).div_ceil(8)) {
            let shade = |block: &PreparedBlock, lights: &[OlatLight], sums: &[[f32; BLOCK]], out: &mut [_]| {
                view.shader.records(block, lights, &view.channels, sums, out)?;
                // Radiance, surface and subsurface.
                for record in out.iter_mut().filter(|_| gain != Vec3::ONE) {
                    record.as_chunks_mut::<3>().0[..3].iter_mut().for_each(|rgb| expose(rgb, gain));
                }
                Ok(())
            };
            self.group::<{ ShadedRecords::WIDTH }>(&view, group, &region, shade, &mut buffers)?;
            for records in &buffers.images {
                let shaded = ShadedRecords::unpack(records).map_err(error::stage("shade"))?;
                out.push(rendering(shaded, &region, opacity.clone(), width, height));
            }
        }
        Ok(out)
    }

    /// What one view sees of the shape, without any light: Σ w in [0, 1) and Σ w·z (view-space z, scene units, not divided by Σ w),
    /// of one channel each, as in training.
    pub fn shape(&self, camera: &Camera) -> Result<RenderedShape, ReconstructError> {
        let nothing = Features { channels: 0, data: Vec::new() };
        let (raster, _) = rasterize(&self.activated.gaussians, &nothing, camera, &raster_config(self.model))
            .map_err(error::stage("rasterize"))?;
        Ok(RenderedShape { opacity: raster.opacity, depth: raster.depth })
    }

    /// How much work [`Renderer::radiance`] of one view is.
    pub fn work(&self, camera: &Camera) -> Result<RenderWork, ReconstructError> {
        let layout = self.needs.layout();
        let view = self.view(camera, &layout)?;
        let blocks = (0..view.weights.lines()).flat_map(|line| view.line(line));
        let shaded = blocks.filter(|(_, prepared)| prepared.is_some()).map(|(block, _)| block.size[0] * block.size[1]);
        Ok(RenderWork {
            visible: view.visible,
            rows: view.rows.len(),
            fixed_channels: layout.count() - view.channels.per_light,
            light_channels: view.channels.per_light,
            pixels: view.size.0 * view.size.1,
            shaded: shaded.sum(),
        })
    }

    pub(crate) fn tracer(&self) -> Result<&Tracer, ReconstructError> {
        if let Some(tracer) = self.tracer.get() {
            return Ok(tracer);
        }
        let tracer = Tracer::new(&self.activated.gaussians, &self.activated.normals)?;
        Ok(self.tracer.get_or_init(|| tracer))
    }

    /// The light-independent half of a view.
    fn view(&self, camera: &Camera, layout: &ChannelLayout) -> Result<ViewHalf, ReconstructError> {
        let (model, gaussians) = (self.model, &self.activated.gaussians);
        let projection = project(gaussians, camera, &raster_config(model)).map_err(error::stage("project"))?;
        let keep = KeepAll { hidden_rows: self.needs.hidden_rows.needed, empty_blocks: self.needs.empty_pixels.needed };
        let weights = BlendWeights::new(&projection, gaussians, &keep).map_err(error::stage("rasterize"))?;
        let visible = projection.visible().len();
        drop(projection);
        let rows = Rows::new(model, &self.activated, camera, weights.rows());
        let scaling = input_scaling(model);
        let network = match &model.network {
            Some(network) if self.needs.subsurface.needed || self.needs.incident.needed => {
                let dark = LightRows::dark(rows.len());
                let inputs = residual_inputs(model, &rows, &dark);
                let (matrix, _) = inputs.assemble(&scaling).map_err(error::stage("residual inputs"))?;
                Some(network.many_lights(&matrix, rows.len()).map_err(error::stage("residual network"))?)
            }
            _ => None,
        };
        let transfer = transfer_config(model).filter(|_| self.needs.subsurface.needed);
        let transfer = transfer.map(|config| (rows.transfer.as_slice(), config));
        let tints = match &model.medium {
            Some(medium) if self.needs.subsurface.needed => {
                let tints = MediumTerm::tints(&self.activated, &rows.visible);
                let toward = rows.normals.iter().zip(&rows.view_directions).map(|(n, v)| medium.toward(*n, *v));
                tints.into_iter().zip(toward).map(|(tint, toward)| tint * toward).collect()
            }
            _ => Vec::new(),
        };
        let lit =
            LitRows::new(&rows.positions, network, transfer, &scaling).map_err(error::stage("transfer vectors"))?;
        let mut settings = Settings::rendering(self.model);
        settings.shading.use_residual &= self.needs.subsurface.needed;
        let shader = BlockShader::new(camera, &settings.shading).map_err(error::stage("shade"))?;
        let prepared = self.prepare(&weights, &shader, layout);
        let per_light = layout.filtered(|c| channel::TRANSPORT.contains(&c));
        let places = TransportChannels {
            residual: per_light.place(channel::RESIDUAL.start),
            incident: per_light.place(channel::INCIDENT),
            visibility: per_light.place(channel::VISIBILITY),
        };
        let size = (weights.size()[0], weights.size()[1]);
        let channels = LightChannels { places, per_light: per_light.count() };
        Ok(ViewHalf { channels, size, visible, weights, rows, tints, lit, shader, prepared })
    }

    /// Blends the light-independent channels and prepares the blocks that show anything, line by line.
    fn prepare(
        &self,
        weights: &BlendWeights,
        shader: &BlockShader,
        layout: &ChannelLayout,
    ) -> Vec<Vec<Option<PreparedBlock>>> {
        let fixed = layout.filtered(|c| channel::GEOMETRY.contains(&c));
        let count = fixed.count();
        let mut features = vec![0.0; weights.rows().len() * count];
        for (row, &i) in features.chunks_exact_mut(count.max(1)).zip(weights.rows()) {
            write_geometry(&self.activated, i as usize, &fixed, row);
        }
        let empty_too = self.needs.empty_pixels.needed;
        let prepare = |block: BlendBlock<'_>, blender: &mut BlockBlender, sums: &mut [[f32; BLOCK]]| {
            let mut blended = BlendedBlock {
                centres: block.centres(),
                sums: [[0.0; BLOCK]; channel::GEOMETRY.end],
                opacity: *block.opacity,
                depth: *block.depth,
            };
            if blended.is_empty() && !empty_too {
                return None;
            }
            blender.blend(&block, &features, sums);
            for c in channel::GEOMETRY {
                if let Some(place) = fixed.place(c) {
                    blended.sums[c] = sums[place];
                }
            }
            Some(shader.prepare(&blended))
        };
        let line = |line| {
            let (mut blender, mut sums) = (BlockBlender::new(), vec![[0.0; BLOCK]; count]);
            weights.line(line).map(|block| prepare(block, &mut blender, &mut sums)).collect()
        };
        (0..weights.lines()).into_par_iter().map(line).collect()
    }

    /// Images of `region` with `WIDTH` channels, one for each light of a group, of what `shade` makes of the blocks. `buffers`
    /// are empty or hold those of other lights: blocks that show nothing show nothing under any light.
    fn group<const WIDTH: usize>(
        &self,
        view: &ViewHalf,
        lights: &[OlatLight],
        region: &Region,
        shade: impl ShadeBlock<WIDTH>,
        Buffers { features, images }: &mut Buffers,
    ) -> Result<(), ReconstructError> {
        view.features(lights, &self.light_rows(view, lights)?, features)?;
        let features = features.as_slice();
        let lights: Vec<OlatLight> = lights.iter().map(|light| self.model.scene.scaled_light(light)).collect();
        images.resize_with(lights.len(), || Image::new(region.width, region.height, WIDTH));
        let lines = region.height.div_ceil(BlendWeights::BLOCK);
        let mut bands: Vec<Vec<&mut [f32]>> = (0..lines).map(|_| Vec::with_capacity(lights.len())).collect();
        let band = region.width * WIDTH * BlendWeights::BLOCK;
        for image in images.iter_mut() {
            for (bands, band) in bands.iter_mut().zip(image.data_mut().chunks_mut(band.max(1))) {
                bands.push(band);
            }
        }
        let first = region.y / BlendWeights::BLOCK;
        bands.into_par_iter().enumerate().try_for_each(|(line, mut images)| -> Result<(), ReconstructError> {
            let mut blender = BlockBlender::new();
            let mut sums = vec![[0.0; BLOCK]; lights.len() * view.channels.per_light];
            let mut pixels = vec![[[0.0; BLOCK]; WIDTH]; lights.len()];
            for (block, prepared) in view.line(first + line) {
                let Some(prepared) = prepared else { continue };
                blender.blend(&block, features, &mut sums);
                shade(prepared, &lights, &sums, &mut pixels).map_err(error::stage("shade"))?;
                for (pixels, image) in pixels.iter().zip(&mut images) {
                    put(pixels, image, &block, region);
                }
            }
            Ok(())
        })
    }

    /// What each light is to the rows of a view, whatever is known of it from before.
    fn light_rows(&self, view: &ViewHalf, lights: &[OlatLight]) -> Result<Vec<LightHalf>, ReconstructError> {
        let Activated { gaussians, normals, .. } = &self.activated;
        let rows = &view.rows.visible;
        let seen = self.needs.visibility.needed || view.channels.places.visibility.is_some();
        let traced = self.model.config.visibility.traced;
        let medium = self.model.medium.as_ref().filter(|_| !view.tints.is_empty());
        let found: Vec<Option<Arc<LightHalf>>> = {
            let kept = self.kept();
            lights.iter().map(|light| kept.get(&key(light)).cloned()).collect()
        };
        let fresh: Vec<OlatLight> =
            lights.iter().zip(&found).filter(|(_, found)| found.is_none()).map(|(light, _)| *light).collect();
        let leaving = medium.map_or(Ok(Vec::new()), |medium| medium.leaving(&fresh))?;
        let leaving: BTreeMap<LightKey, _> = fresh.iter().map(key).zip(leaving).collect();
        // Without room for one more light what is kept stays: with more lights than that, each would push out the next.
        let bytes = LightHalf::bytes(gaussians.len(), seen, medium.is_some());
        let room = |kept: &BTreeMap<_, _>| (kept.len() + 1) * bytes <= self.kept_bytes;
        let half = |light: &OlatLight, leaving: Option<&[f32]>, of: &[u32]| -> Result<LightHalf, ReconstructError> {
            let visibility = match (seen, traced) {
                (false, _) => Vec::new(),
                (true, false) => LightRows::new(self.model, &view.rows, light, VisibilitySource::Fitted)?.visibility,
                (true, true) => self.tracer()?.trace_rows(gaussians, normals, light, of)?,
            };
            let medium = medium.zip(leaving).map_or(Vec::new(), |(medium, leaving)| {
                let places = of.iter().map(|&i| (i as usize, gaussians.means[i as usize], normals[i as usize]));
                medium.sent(places, &light.of_unit_intensity(), leaving, &visibility)
            });
            Ok(LightHalf { visibility, medium })
        };
        lights
            .par_iter()
            .zip(found)
            .map(|(light, found)| -> Result<LightHalf, ReconstructError> {
                let leaving = leaving.get(&key(light)).map(|leaving| leaving.as_slice());
                let all = match found {
                    Some(all) => all,
                    // Fitted visibility is that of a view's rows.
                    None if (seen && !traced) || !room(&self.kept()) => return half(light, leaving, rows),
                    None => {
                        let every: Vec<u32> = (0..gaussians.len() as u32).collect();
                        let all = Arc::new(half(light, leaving, &every)?);
                        let mut kept = self.kept();
                        if room(&kept) {
                            kept.insert(key(light), Arc::clone(&all));
                        }
                        all
                    }
                };
                Ok(all.of(rows))
            })
            .collect()
    }

    pub(crate) fn kept(&self) -> std::sync::MutexGuard<'_, BTreeMap<LightKey, Arc<LightHalf>>> {
        // Whoever panicked with the lock held left whole entries behind.
        self.kept.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }
}

/// What the next group of lights uses again.
#[derive(Default)]
struct Buffers {
    /// Rows × (lights × channels).
    features: Vec<f32>,
    /// One per light.
    images: Vec<Image>,
}

/// Makes the pixels of a block under each light from the lights' blended channels.
trait ShadeBlock<const WIDTH: usize>:
    Fn(&PreparedBlock, &[OlatLight], &[[f32; BLOCK]], &mut [[[f32; BLOCK]; WIDTH]]) -> Result<(), ShadingError> + Sync
{
}

impl<const WIDTH: usize, F> ShadeBlock<WIDTH> for F where
    F: Fn(&PreparedBlock, &[OlatLight], &[[f32; BLOCK]], &mut [[[f32; BLOCK]; WIDTH]]) -> Result<(), ShadingError>
        + Sync
{
}

/// Multiplies three channels by the gain.
fn expose(rgb: &mut [[f32; BLOCK]; 3], gain: Vec3) {
    for (channel, gain) in rgb.iter_mut().zip(gain.to_array()) {
        channel.iter_mut().for_each(|v| *v *= gain);
    }
}

/// Writes a block into its line of an image of `region`.
fn put<const WIDTH: usize>(pixels: &[[f32; BLOCK]; WIDTH], image: &mut [f32], block: &BlendBlock<'_>, region: &Region) {
    const SIDE: usize = BlendWeights::BLOCK;
    let at = (block.at[0] - region.x) * WIDTH;
    for (row, image) in image.chunks_exact_mut(region.width * WIDTH).enumerate() {
        let mut line = [[0.0; WIDTH]; SIDE];
        for c in 0..WIDTH {
            let plane = &pixels[c].as_chunks::<SIDE>().0[row];
            for column in 0..SIDE {
                line[column][c] = plane[column];
            }
        }
        let to = &mut image[at..at + block.size[0] * WIDTH];
        match to.as_chunks_mut::<SIDE>() {
            // All columns: a copy of known length.
            (to, []) if to.len() == WIDTH => to.copy_from_slice(line.as_flattened().as_chunks().0),
            _ => to.copy_from_slice(&line.as_flattened()[..to.len()]),
        }
    }
}

/// The light-independent half of a view.
struct ViewHalf {
    /// The light-dependent channels of one light.
    channels: LightChannels,
    /// Width and height.
    size: (usize, usize),
    /// Gaussians in the view.
    visible: usize,
    weights: BlendWeights,
    /// Of the Gaussians that pass something to a pixel.
    rows: Rows,
    /// Their tints times what depends on the view in what the medium sends out, where there is one.
    tints: Vec<Vec3>,
    /// The same, ready for lights.
    lit: LitRows,
    shader: BlockShader,
    /// By line, the blocks that show something.
    prepared: Vec<Vec<Option<PreparedBlock>>>,
}

impl ViewHalf {
    /// The blocks of a line, with those that show something prepared.
    fn line(&self, line: usize) -> impl Iterator<Item = (BlendBlock<'_>, &Option<PreparedBlock>)> {
        self.weights.line(line).zip(&self.prepared[line])
    }

    /// The least rectangle of whole lines of blocks that holds all blocks.
    fn region(&self) -> Region {
        let mut region: Option<Region> = None;
        for (block, _) in (0..self.weights.lines()).flat_map(|line| self.line(line)) {
            let [x, y] = block.at;
            let one = Region { x, y, width: block.size[0], height: block.size[1] };
            region = Region::union(region, Some(one));
        }
        region.unwrap_or(Region::whole(self.size.0, self.size.1))
    }

    /// Σ w of the whole picture.
    fn opacity(&self) -> Image {
        let mut image = Image::new(self.size.0, self.size.1, 1);
        let whole = Region::whole(self.size.0, self.size.1);
        let band = (self.size.0 * BlendWeights::BLOCK).max(1);
        for (line, band) in image.data_mut().chunks_mut(band).enumerate() {
            for (block, _) in self.line(line) {
                put(&[*block.opacity], band, &block, &whole);
            }
        }
        image
    }

    /// The channels of all `lights`, row by row.
    fn features(
        &self,
        lights: &[OlatLight],
        halves: &[LightHalf],
        features: &mut Vec<f32>,
    ) -> Result<(), ReconstructError> {
        let lit: Vec<(OlatLight, &[f32])> =
            lights.iter().zip(halves).map(|(light, half)| (*light, half.visibility.as_slice())).collect();
        let width = self.channels.per_light * lights.len();
        features.resize(self.rows.len() * width, 0.0);
        // Asked here: the setting belongs to the thread that called.
        let level = Level::current();
        let tasks = features.par_chunks_mut((LitRows::TASK_ROWS * width).max(1));
        tasks.enumerate().try_for_each(|(task, piece)| {
            let first = task * LitRows::TASK_ROWS;
            let put = |row: usize, values: &[f32]| {
                let to = &mut piece[(row - first) * width..][..width];
                to.copy_from_slice(values);
                let (Some(tint), Some(at)) = (self.tints.get(row), self.channels.places.residual) else { return };
                for (to, half) in to.chunks_exact_mut(self.channels.per_light).zip(halves) {
                    let rgb = half.medium[row] * *tint;
                    to[at..at + 3].iter_mut().zip(rgb.to_array()).for_each(|(o, v)| *o += v);
                }
            };
            self.lit.task(task, level, &lit, &self.channels, put).map_err(error::stage("residual network"))
        })
    }
}

fn rendering(shaded: Shaded, region: &Region, opacity: Image, width: usize, height: usize) -> Rendering {
    let whole = |part: &Image| region.paste(part, width, height);
    let m = &shaded.maps;
    Rendering {
        radiance: whole(&shaded.radiance),
        surface: whole(&shaded.surface),
        subsurface: whole(&shaded.subsurface),
        opacity,
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
