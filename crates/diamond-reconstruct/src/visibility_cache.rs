//! Traced visibility of every Gaussian toward every light, traced again only when it is old.
use crate::{Config, ReconstructError, error};
use diamond_light::OlatLight;
use diamond_splat::{GaussianBvh, Gaussians, VisibilityConfig};
use glam::Vec3;
use std::collections::BTreeMap;

/// Bits that identify a light: position or direction. Intensity does not change visibility.
type LightKey = [u32; 4];

/// Visibility per light, with the step at which it was traced.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct VisibilityCache {
    entries: BTreeMap<LightKey, (u64, Vec<f32>)>,
    /// Lights traced so far: what the cache saved is the difference to the number of look-ups.
    pub traced: u64,
    /// Look-ups so far.
    pub lookups: u64,
}

/// Entries beyond this many lights are dropped, oldest first: turntable captures have one light per image.
const MAX_LIGHTS: usize = 512;

fn key(light: &OlatLight) -> LightKey {
    let (kind, v) = match *light {
        OlatLight::Point { position, .. } => (0, position),
        OlatLight::Directional { direction, .. } => (1, direction),
    };
    [kind, v.x.to_bits(), v.y.to_bits(), v.z.to_bits()]
}

/// A hierarchy over the Gaussians as they stand, for any number of lights.
pub struct Tracer(GaussianBvh);

impl Tracer {
    /// Builds the hierarchy.
    pub fn new(gaussians: &Gaussians) -> Result<Self, ReconstructError> {
        GaussianBvh::build(gaussians).map(Self).map_err(error::stage("visibility"))
    }

    /// Visibility of every Gaussian toward one light.
    pub fn trace(
        &self,
        gaussians: &Gaussians,
        normals: &[Vec3],
        light: &OlatLight,
    ) -> Result<Vec<f32>, ReconstructError> {
        self.0
            .visibility_to_light(gaussians, Some(normals), light, &VisibilityConfig::default())
            .map_err(error::stage("visibility"))
    }
}

impl VisibilityCache {
    /// Visibility of all Gaussians toward `light` at `step`, traced anew if older than the configuration allows.
    pub fn get(
        &mut self,
        config: &Config,
        gaussians: &Gaussians,
        normals: &[Vec3],
        light: &OlatLight,
        step: u64,
    ) -> Result<&[f32], ReconstructError> {
        self.lookups += 1;
        let key = key(light);
        let fresh = self.entries.get(&key).is_some_and(|(traced, values)| {
            step.saturating_sub(*traced) < config.visibility.every_steps && values.len() == gaussians.len()
        });
        if !fresh {
            self.traced += 1;
            let values = Tracer::new(gaussians)?.trace(gaussians, normals, light)?;
            self.entries.insert(key, (step, values));
            if self.entries.len() > MAX_LIGHTS
                && let Some(oldest) = self.entries.iter().min_by_key(|(k, (s, _))| (*s, **k)).map(|(k, _)| *k)
            {
                self.entries.remove(&oldest);
            }
        }
        Ok(self.entries.get(&key).map_or(&[], |(_, values)| values))
    }

    /// Follows a change of the set of Gaussians.
    pub fn gather(&mut self, sources: &[(u32, bool)]) {
        for (_, values) in self.entries.values_mut() {
            *values = sources.iter().map(|&(s, _)| values.get(s as usize).copied().unwrap_or(1.0)).collect();
        }
    }

    /// All entries as (key bits, step, values), for checkpoints.
    pub(crate) fn entries(&self) -> impl Iterator<Item = (&LightKey, u64, &[f32])> {
        self.entries.iter().map(|(k, (s, v))| (k, *s, v.as_slice()))
    }

    /// Puts back what [`VisibilityCache::entries`] gave.
    pub(crate) fn restore(&mut self, key: LightKey, step: u64, values: Vec<f32>) {
        self.entries.insert(key, (step, values));
    }
}
