//! Pictures of a view under many lights by a [`Relighter`]: what the renderer prepares for it.
use crate::forward::{Settings, raster_config};
use crate::light_half::LightHalf;
use crate::relighter::{RelightLight, RelightView, Relighter, device};
use crate::rows::input_scaling;
use crate::{Attribute, MediumTerm, ReconstructError, Renderer, error};
use diamond_camera::Camera;
use diamond_image::Image;
use diamond_light::{Falloff, OlatLight};
use diamond_shading::channel;
use glam::Vec3;
use rayon::prelude::*;
use std::sync::{Arc, Mutex, PoisonError};

impl Renderer<'_> {
    /// From now on radiance is made by `relighter`, if it lacks nothing; else what it lacks, in words of the configuration, and radiance is made as before.
    pub fn relight_by(mut self, relighter: Box<dyn Relighter>) -> (Self, Option<String>) {
        let lacking = relighter.lacks(self.model);
        if lacking.is_none() {
            self.relighter = Some(Mutex::new(relighter));
        }
        (self, lacking)
    }

    /// Radiance of one view under each light, in order.
    pub(crate) fn relit<E: From<ReconstructError>>(
        &self,
        relighter: &Mutex<Box<dyn Relighter>>,
        camera: &Camera,
        lights: &[OlatLight],
        see: &mut dyn FnMut(usize, Image) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut relighter = relighter.lock().unwrap_or_else(PoisonError::into_inner);
        let mut settings = Settings::rendering(self.model);
        settings.shading.use_residual &= self.needs.subsurface.needed;
        let (raster, scaling, layout) = (raster_config(self.model), input_scaling(self.model), self.needs.layout());
        let view = RelightView {
            camera,
            model: self.model,
            raster: &raster,
            shading: &settings.shading,
            scaling: &scaling,
            layout: &layout,
        };
        relighter.view(&view).map_err(device)?;
        let seen = self.needs.visibility.needed || layout.place(channel::VISIBILITY).is_some();
        let tints = self.tints(camera);
        let gain = self.model.exposure.of_renderings(self.model.config.exposure.mode);
        let size = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        let together = self.group_of(size);
        for (g, group) in lights.chunks(together).enumerate() {
            let halves: Vec<Arc<LightHalf>> = group
                .par_iter()
                .map(|light| self.whole_half(light, seen, !tints.is_empty()))
                .collect::<Result<_, _>>()?;
            let lit: Vec<RelightLight> = group
                .iter()
                .zip(&halves)
                .map(|(light, half)| RelightLight {
                    light: self.model.scene.scaled_light(light),
                    visibility: seen.then(|| half.visibility.clone()),
                    sent: half.medium.iter().zip(&tints).map(|(sent, tint)| *sent * *tint).collect(),
                    visible: seen,
                })
                .collect();
            for (k, mut image) in relighter.radiance(&view, &lit).map_err(device)?.into_iter().enumerate() {
                if gain != Vec3::ONE {
                    let gains = gain.to_array();
                    image.data_mut().iter_mut().enumerate().for_each(|(i, v)| *v *= gains[i % 3]);
                }
                see(g * together + k, image)?;
            }
        }
        Ok(())
    }

    /// Tints of all Gaussians toward a camera; none without a medium that shows.
    fn tints(&self, camera: &Camera) -> Vec<Vec3> {
        let Some(medium) = self.model.medium.as_ref().filter(|_| self.needs.subsurface.needed) else {
            return Vec::new();
        };
        let eye = camera.pose.centre();
        let all: Vec<u32> = (0..self.activated.gaussians.len() as u32).collect();
        let toward = self.activated.gaussians.means.iter().zip(&self.activated.normals).map(|(p, n)| {
            let view = (eye - *p).try_normalize().unwrap_or(Vec3::Z);
            medium.toward(*n, view)
        });
        MediumTerm::tints(&self.activated, &all).into_iter().zip(toward).map(|(tint, toward)| tint * toward).collect()
    }

    /// What a light is to all Gaussians, kept where there is room.
    fn whole_half(&self, light: &OlatLight, seen: bool, sends: bool) -> Result<Arc<LightHalf>, ReconstructError> {
        let key = crate::visibility_cache::key(light);
        if let Some(found) = self.kept().get(&key) {
            return Ok(Arc::clone(found));
        }
        let (gaussians, normals) = (&self.activated.gaussians, &self.activated.normals);
        let visibility = match (seen, self.model.config.visibility.traced) {
            (false, _) => Vec::new(),
            (true, true) => self.tracer()?.trace(gaussians, normals, light)?,
            (true, false) => {
                let toward = |p: &Vec3| light.incidence(*p, Falloff::None).direction;
                let directions: Vec<Vec3> = gaussians.means.iter().map(toward).collect();
                let harmonics = self.model.parameters.values(Attribute::VisibilitySh);
                diamond_shading::sh_visibility::visibilities(harmonics, &directions)
                    .map_err(error::stage("visibility"))?
            }
        };
        let mut medium = Vec::new();
        if let Some(term) = self.model.medium.as_ref().filter(|_| sends) {
            let leaving = term.leaving(&[*light])?;
            let places = gaussians.means.iter().zip(normals).enumerate().map(|(i, (p, n))| (i, *p, *n));
            medium = term.sent(places, &light.of_unit_intensity(), &leaving[0], &visibility);
        }
        let half = Arc::new(LightHalf { visibility, medium });
        let bytes = LightHalf::bytes(gaussians.len(), seen, sends);
        let mut kept = self.kept();
        if (kept.len() + 1) * bytes <= self.kept_bytes {
            kept.insert(key, Arc::clone(&half));
        }
        Ok(half)
    }
}
